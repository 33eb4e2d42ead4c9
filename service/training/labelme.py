"""Folders of LabelMe annotations as labelled pictures."""

import base64
import binascii
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from canopy_skel.errors import UsageError
from service.training.shapes import Shape
from service.training.user_pictures import UserPicture, scan_of

IGNORE = "ignore"
_WIDTH = re.compile(r"\d+(?:\.\d+)?")
_MEND = "save it anew with LabelMe"


def read_labelme(folder: Path, branch: Sequence[str] = ()) -> tuple[list[UserPicture], list[str]]:
    """Return the pictures of all LabelMe files in a folder and those below it, and what to know.

    Polygons are filled. A linestrip is a branch of the width, in pixels, that its description
    gives ("12" or "width=12"). What is labelled "ignore" is ignored, and what has any label but
    `branch` and "ignore" is background.

    Args:
        folder: holds one JSON file for each picture.
        branch: the labels that are branches; may be left out where it is clear.

    Raises:
        UsageError: there is nothing, a file is not LabelMe's, or a picture is not there.
    """
    if not folder.is_dir():
        raise UsageError(f"{folder}: is not a folder; give the one LabelMe saved its files in")
    documents = {path: _document(path) for path in sorted(folder.rglob("*.json"))}
    documents = {path: found for path, found in documents.items() if "shapes" in found}
    if not documents:
        raise UsageError(f"{folder}: holds no LabelMe file (*.json with shapes); check the path")
    labels = {str(shape.get("label")) for found in documents.values() for shape in found["shapes"]}
    wanted = _branch_labels(folder, sorted(labels), branch)
    pictures = [_picture(folder, path, found, wanted) for path, found in documents.items()]
    if not any(picture.branches for picture in pictures):
        raise UsageError(
            f"{folder}: no polygon or linestrip is labelled {' or '.join(sorted(wanted))}; label"
            " branches with polygons"
        )
    return pictures, []


def _document(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{path}: is not JSON ({error}); {_MEND}") from error
    if not isinstance(document, dict):
        return {}
    shapes = document.get("shapes", [])
    if not isinstance(shapes, list) or not all(isinstance(shape, dict) for shape in shapes):
        raise UsageError(f"{path}: its shapes are not a list of objects; {_MEND}")
    return document


def _branch_labels(folder: Path, known: Sequence[str], branch: Sequence[str]) -> set[str]:
    for name in branch:
        if name not in known:
            raise UsageError(f"{folder}: nothing is labelled {name!r}, but {', '.join(known)}")
    rest = [name for name in known if name != IGNORE]
    if branch:
        return set(branch)
    if len(rest) == 1 or "branch" in rest:
        return {"branch"} if "branch" in rest else set(rest)
    raise UsageError(
        f"{folder}: which labels are branches? There are {', '.join(known) or 'none'}; say"
        " --branch LABEL, once for each"
    )


def _picture(
    folder: Path, path: Path, document: Mapping[str, Any], wanted: set[str]
) -> UserPicture:
    branches: list[Shape] = []
    ignored: list[Shape] = []
    for number, item in enumerate(document["shapes"], start=1):
        label = str(item.get("label"))
        if label == IGNORE or label in wanted:
            shape = _shape(path, number, item)
            (ignored if label == IGNORE else branches).append(shape)
    file, data = _source(path, document)
    height, width = document.get("imageHeight"), document.get("imageWidth")
    if not isinstance(height, int) or not isinstance(width, int):
        raise UsageError(f"{path}: does not say the size of its picture; {_MEND}")
    return UserPicture(
        path=file,
        size=(height, width),
        scan=scan_of(path.relative_to(folder).as_posix(), document.get("scan_id")),
        branches=tuple(branches),
        ignored=tuple(ignored),
        data=data,
    )


def _source(path: Path, document: Mapping[str, Any]) -> tuple[Path, bytes | None]:
    """Return the picture's file, or the annotation's own with the picture embedded in it."""
    name, embedded = document.get("imagePath"), document.get("imageData")
    if isinstance(name, str) and (path.parent / name.replace("\\", "/")).is_file():
        return path.parent / name.replace("\\", "/"), None
    if isinstance(embedded, str):
        try:
            return path, base64.b64decode(embedded, validate=True)
        except binascii.Error as error:
            raise UsageError(f"{path}: its embedded picture is damaged; {_MEND}") from error
    raise UsageError(
        f"{path}: its picture {name!r} is not there and not embedded; put it beside the file"
    )


def _shape(path: Path, number: int, item: Mapping[str, Any]) -> Shape:
    kind, called = item.get("shape_type", "polygon"), f"shape {number}"
    least = {"polygon": 3, "linestrip": 2, "line": 2}.get(str(kind))
    if least is None:
        raise UsageError(
            f"{path}: {called} is a {kind}; draw branches as polygons, or as linestrips with their"
            " width in the description"
        )
    try:
        points = np.array(item.get("points"), dtype=np.float64).reshape(-1, 2)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{path}: {called} has points that are none; {_MEND}") from error
    if len(points) < least:
        raise UsageError(f"{path}: {called} has {len(points)} points; a {kind} needs {least}")
    width_px = None if kind == "polygon" else _width_px(path, called, item)
    return Shape(name=called, outlines=(points,), width_px=width_px)


def _width_px(path: Path, called: str, item: Mapping[str, Any]) -> float:
    found = _WIDTH.search(str(item.get("width") or item.get("description") or ""))
    width_px = float(found.group()) if found else 0.0
    if not width_px > 0:
        raise UsageError(
            f"{path}: {called} is a {item.get('shape_type')} without a width; write the branch's"
            ' width in pixels into its description, like "width=12"'
        )
    return width_px
