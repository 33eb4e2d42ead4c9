import os
import signal
import subprocess
import sys
import time

import pytest

from drivers.child import Child

ECHO = """
import sys
from multiprocessing.connection import Connection
pipe = Connection(int(sys.argv[1]))
try:
    while True:
        pipe.send(pipe.recv())
except EOFError:
    sys.exit(5)
"""
DEAF = "import time; print('here', flush=True); time.sleep(60)"
HOLDER = f"""
import time
from drivers.child import Child
child = Child([{sys.executable!r}, "-c", {ECHO!r}])
child.send("up")
child.pipe.recv()
print(child.pid, flush=True)
time.sleep(60)
"""


def python(source, **options):
    return Child([sys.executable, "-c", source], **options)


def test_it_talks_and_leaves_when_asked():
    child = python(ECHO)
    child.send({"question": 42})
    assert child.pipe.recv() == {"question": 42}
    child.end(10.0)
    assert child.exit_code(0.0) == 5


def test_one_that_does_not_leave_is_killed():
    child = python(DEAF, captured=True)
    assert child.output.readline() == b"here\n"
    assert child.exit_code(0.0) is None
    child.end(0.1)
    assert child.exit_code(0.0) == -signal.SIGKILL


def test_a_killed_one_is_noticed_and_takes_no_more_messages():
    child = python(ECHO)
    child.kill()
    with pytest.raises(EOFError):
        child.pipe.recv()
    child.send("anybody there?")
    child.kill()
    child.end(10.0)
    assert child.exit_code(0.0) == -signal.SIGKILL


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM])
def test_it_ends_with_its_parent(end):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER], stdout=subprocess.PIPE, env=environment
    ) as parent:
        pid = int(parent.stdout.readline())
        assert os.path.exists(f"/proc/{pid}")
        parent.send_signal(end)
    until = time.perf_counter() + 5.0
    while os.path.exists(f"/proc/{pid}"):
        assert time.perf_counter() < until
        time.sleep(0.01)
