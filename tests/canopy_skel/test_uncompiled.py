import os
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent


def test_kernels_do_the_same_uncompiled():
    """Numba compiles what it understands; Python runs what is written."""
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-x", str(HERE / "test_kernels.py")],
        cwd=HERE.parents[1],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stdout + run.stderr
