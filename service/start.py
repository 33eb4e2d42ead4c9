"""Where the `canopy` program begins.

Nothing is imported here: the processes that compile kernels import this module again.
"""


def main() -> None:
    """Run the command line."""
    from service.cli import main as run

    run()
