"""The `canopy` program: its verbs, and how it ends."""

import sys

import typer

from canopy_skel.errors import CanopyError, UsageError
from service.cli.batch import batch
from service.cli.calibrate import calibrate
from service.cli.coco import coco
from service.cli.doctor import doctor
from service.cli.experiment import experiment
from service.cli.export import export
from service.cli.export_onnx import export_onnx
from service.cli.fit_confidence import fit_confidence
from service.cli.fit_wood import fit_wood
from service.cli.inspect import inspect
from service.cli.recover import recover
from service.cli.replay import replay
from service.cli.scan import scan
from service.cli.score import score
from service.cli.segment import segment
from service.cli.serve import serve, worker
from service.cli.shell import Exit, complain
from service.cli.simulate import simulate
from service.cli.train import train

app = typer.Typer(
    name="canopy",
    help="Skeletons of leafy orchard trees from one-sided robot scans.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
for verb in (
    replay,
    batch,
    inspect,
    score,
    recover,
    export,
    serve,
    scan,
    calibrate,
    simulate,
    coco,
    segment,
    train,
    export_onnx,
    doctor,
    fit_confidence,
    fit_wood,
):
    app.command()(verb)
app.command(context_settings={"ignore_unknown_options": True, "help_option_names": []})(worker)
app.add_typer(experiment)


def main() -> None:
    """Run the command line; what is the input's fault ends as one line on stderr."""
    try:
        app()
    except CanopyError as error:
        complain(error)
        sys.exit(Exit.USAGE if isinstance(error, UsageError) else Exit.FAILED)
