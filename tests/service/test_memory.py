import subprocess
import sys

PROGRAM = """
import resource, sys, threading
import numpy as np
from service.memory import keep_freed_memory
if sys.argv[1] == "kept":
    assert keep_freed_memory()
def pages():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    pictures = [np.ones(1_000_000, np.float32) for _ in range(20)]
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
def twice():
    pages()
    print(pages())
thread = threading.Thread(target=twice)  # as in the worker
thread.start()
thread.join()
"""


def fresh_pages(how):
    """Return how many pages the system hands out for 80 MB that were used and freed before."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, how], capture_output=True, text=True, check=True
    )
    return int(done.stdout)


def test_memory_that_pictures_took_is_used_again():
    assert fresh_pages("given back") > 3000
    assert fresh_pages("kept") < 1000
