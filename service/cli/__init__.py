"""`canopy`: the command line. Progress on stderr, results on stdout.

Exit codes: 0 ok, 1 failed, 2 usage, 3 partial (something was left out, and said).
"""

from service.cli.main import main

__all__ = ["main"]
