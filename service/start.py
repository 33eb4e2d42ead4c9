"""Where the `canopy` program begins."""

from service.kernels import compile_kernels


def main() -> None:
    """Run the command line, with its kernels compiled."""
    compile_kernels()
    # Imported after that: importing compiles what is missing, on one core.
    from service.cli import main as run

    run()
