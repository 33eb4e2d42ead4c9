"""`canopy segment`."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from canopy_skel.errors import CanopyError, UsageError
from canopy_skel.segment import Segmenter
from service.cli.labels import Branch, Coco, Images, LabelMe, Labels
from service.cli.shell import AsJson, Exit, complain, progress_bars, stderr
from service.outputs import require_writable
from service.picture_files import SUFFIXES
from service.segmenters import NAMES, make_for_judging, make_segmenter
from service.segmenting import Segmented, segment_picture, segment_recording

if TYPE_CHECKING:
    from service.evaluation import Evaluation

Name = Annotated[str, typer.Option(help=f"One of {', '.join(NAMES)}.")]
Weights = Annotated[Path | None, typer.Option(help="Weights (.pt); the built-in ones if none.")]


def segment(
    sources: Annotated[
        list[Path] | None, typer.Argument(metavar="IMAGE|REC...", help="Pictures or recordings.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder for the results.")
    ] = None,
    segmenter: Name = "unet",
    weights: Weights = None,
    evaluate: Annotated[
        bool, typer.Option("--evaluate", help="Compare with recorded or labelled instances.")
    ] = False,
    coco: Coco = None,
    images: Images = None,
    labelme: LabelMe = None,
    branch: Branch = None,
    as_json: AsJson = False,
) -> None:
    """Find branches in pictures or recordings, or judge how well that is done.

    Pictures get an overlay, their instances and scores; a recording a copy that holds the
    instances, ready for `canopy replay`.
    """
    labels = Labels(coco=coco, images=images, labelme=labelme, branch=branch or ())
    if evaluate:
        _say_evaluated(_evaluated(sources or [], labels, segmenter, weights), as_json)
        return
    if labels.source is not None:
        raise UsageError("labels are for --evaluate; without it give pictures or recordings")
    if not sources or output is None:
        raise UsageError("give pictures or recordings, and a folder for the results (-o)")
    _require_distinct(sources)
    _require_no_folder(sources)
    require_writable(output)
    made = make_segmenter(segmenter, weights)
    results: list[dict[str, object]] = []
    codes = [_segment_one(path, output, made, results, quiet=as_json) for path in sources]
    if as_json:
        typer.echo(json.dumps(results, indent=2))
    raise typer.Exit(codes[0] if len(set(codes)) == 1 else Exit.PARTIAL)


def _segment_one(
    path: Path, output: Path, made: Segmenter, results: list[dict[str, object]], *, quiet: bool
) -> Exit:
    try:
        if path.suffix.lower() in SUFFIXES:
            result = segment_picture(path, output, made)
        else:
            with progress_bars() as progress:
                task = progress.add_task(path.name, total=None)
                result = segment_recording(
                    path,
                    output,
                    made,
                    lambda done, total: progress.update(task, completed=done, total=total),
                )
    except CanopyError as error:
        complain(error)
        results.append({"source": str(path), "error": str(error)})
        return Exit.FAILED
    for line in (*result.warnings, *(view.reason for view in result.rejected)):
        stderr.print(f"warning: {path.name}: {line}", style="yellow", markup=False)
    results.append(result.to_dict())
    if not quiet:
        _say(result)
    return Exit.PARTIAL if result.rejected or result.warnings else Exit.OK


def _say(result: Segmented) -> None:
    sure = sum(one >= 0.9 for one in result.confidences)
    views = f" in {result.views} views" if result.views > 1 else ""
    typer.echo(
        f"{result.source.name}: {len(result.confidences)} branch instances{views},"
        f" {sure} of them with a confidence of 0.9 or more"
    )
    for file in result.files:
        typer.echo(f"  {file}")


def _require_no_folder(sources: list[Path]) -> None:
    for path in sources:
        if path.is_dir():
            raise UsageError(f"{path}: is a folder; name the pictures or recordings in it")


def _require_distinct(sources: list[Path]) -> None:
    names = [path.stem if path.suffix.lower() in SUFFIXES else path.name for path in sources]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(
                f"several sources are named {name}: their results would overwrite each other;"
                " segment them into different folders"
            )


def _evaluated(
    sources: list[Path], labels: Labels, name: str, weights: Path | None
) -> "list[Evaluation]":
    # Imported here: evaluation replays recordings, which takes the whole method to load.
    from service.doctor import available_memory_bytes
    from service.evaluation import Evaluation, evaluate, evaluate_recording
    from service.replay import map_memory_bytes
    from service.training.user_pictures import UserPictures

    for path in sources:
        if path.suffix.lower() in SUFFIXES:
            raise UsageError(f"{path}: is a picture without labels; give them (--coco, --labelme)")
    if bool(sources) is (labels.source is not None):
        raise UsageError("--evaluate needs recordings, or labels (--coco with --images, --labelme)")
    if name == "recorded":
        raise UsageError("recorded instances are what is compared with; choose unet or maskrcnn")
    if not sources:
        pictures = UserPictures(labels.pictures())
        made, threshold = make_for_judging(name, weights)
        every = (pictures[k] for k in range(len(pictures)))
        scores, pace = evaluate(every, made, threshold)
        return [Evaluation(source=str(labels.source), scores=scores, pace=pace, skeleton={})]
    made, threshold = make_for_judging(name, weights)
    memory = map_memory_bytes(available_memory_bytes())
    return [
        evaluate_recording(
            path, made, threshold, name=name, weights=weights, memory_limit_bytes=memory
        )
        for path in sources
    ]


def _say_evaluated(results: "list[Evaluation]", as_json: bool) -> None:
    from service.cli.evaluate import print_evaluation

    if as_json:
        typer.echo(json.dumps([one.to_dict() for one in results], indent=2))
        return
    for one in results:
        print_evaluation(one)
