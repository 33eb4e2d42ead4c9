import os
import signal
import sys
import time

from service.supervisor import Supervised

SLEEPER = [sys.executable, "-c", "import time; time.sleep(60)"]


def wait_for(condition, timeout_s=10.0):
    until = time.perf_counter() + timeout_s
    while not condition():
        assert time.perf_counter() < until
        time.sleep(0.01)


def test_a_killed_process_is_started_again():
    with Supervised("sleeper", SLEEPER) as child:
        first = child.pid
        os.kill(first, signal.SIGKILL)
        wait_for(lambda: child.pid not in (None, first))


def test_leaving_ends_it_even_if_it_does_not_listen():
    deaf = (
        "import signal,time; signal.signal(15, signal.SIG_IGN); print(flush=True); time.sleep(60)"
    )
    with Supervised("deaf", [sys.executable, "-c", deaf]) as child:
        pid = child.pid
        time.sleep(0.3)
    assert child.pid is None
    wait_for(lambda: not os.path.exists(f"/proc/{pid}"))
