"""COCO instance annotations as labelled pictures."""

import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from canopy_skel.errors import UsageError
from service.training.shapes import Shape
from service.training.user_pictures import UserPicture, scan_of

IGNORE = "ignore"
_MEND = "export it anew as COCO instance segmentation"


def read_coco(
    annotations: Path, images: Path, branch: Sequence[str] = ()
) -> tuple[list[UserPicture], list[str]]:
    """Return the pictures of a COCO file, and one line for each thing to be aware of.

    Crowds (`iscrowd`), what is of a category named "ignore", and boxes without an outline are
    ignored; what is of any category but `branch` and "ignore" is background.

    Args:
        annotations: the JSON file.
        images: the folder its file names are relative to.
        branch: names of the categories that are branches; may be left out where it is clear.

    Raises:
        UsageError: the file is not COCO, has no outline at all, a category or picture is unknown,
            or a picture is not there.
    """
    document = _document(annotations)
    names = _categories(annotations, document["categories"])
    wanted = _branch_names(annotations, list(names.values()), branch)
    pictures = _pictures(annotations, document["images"])
    own: defaultdict[int | str, list[Mapping[str, Any]]] = defaultdict(list)
    for annotation in document["annotations"]:
        _require_known(annotations, annotation, names, pictures)
        own[annotation["image_id"]].append(annotation)
    boxes = sum(not annotation.get("segmentation") for annotation in document["annotations"])
    if boxes == len(document["annotations"]):
        raise UsageError(
            f"{annotations}: its {boxes} annotations have no outline (`segmentation`), boxes at"
            " most; label branches with polygons"
        )
    result = [
        _picture(
            annotations, images, picture, *_sorted_out(annotations, own[number], names, wanted)
        )
        for number, picture in pictures.items()
    ]
    noted = [f"{annotations}: {boxes} annotations are boxes without outline and ignored"]
    return result, noted if boxes else []


def _sorted_out(
    path: Path,
    annotations: Sequence[Mapping[str, Any]],
    names: Mapping[int | str, str],
    wanted: set[str],
) -> tuple[list[Shape], list[Shape]]:
    """Return the shapes of one picture that are branches, and those to be ignored."""
    branches: list[Shape] = []
    ignored: list[Shape] = []
    for annotation in annotations:
        name = names[annotation["category_id"]]
        if name != IGNORE and name not in wanted:
            continue
        shape = _shape(path, annotation)
        if shape is None:
            ignored.append(_box(path, annotation))
        elif name == IGNORE or annotation.get("iscrowd"):
            ignored.append(shape)
        else:
            branches.append(shape)
    return branches, ignored


def _document(path: Path) -> dict[str, list[Any]]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{path}: is not JSON ({error}); {_MEND}") from error
    parts = ("images", "annotations", "categories")
    missing = [
        part
        for part in parts
        if not isinstance(document, dict) or not isinstance(document.get(part), list)
    ]
    if missing:
        raise UsageError(f"{path}: has no list of {', '.join(missing)}; {_MEND}")
    found: dict[str, list[Any]] = document
    for part in parts:
        if not all(isinstance(item, dict) for item in found[part]):
            raise UsageError(f"{path}: not all {part} are objects; {_MEND}")
    return found


def _text(path: Path, what: str, item: Mapping[str, Any], name: str) -> str:
    value = item.get(name)
    if not isinstance(value, str):
        raise UsageError(f"{path}: {what} has {name} {value!r}, not a text; {_MEND}")
    return value


def _key(path: Path, what: str, item: Mapping[str, Any], name: str) -> int | str:
    value = item.get(name)
    if not isinstance(value, int | str):
        raise UsageError(f"{path}: {what} has {name} {value!r}, not a number; {_MEND}")
    return value


def _keys(path: Path, what: str, items: Sequence[Mapping[str, Any]]) -> list[int | str]:
    """Return the ids of images or categories; no two may have the same, as in files put together.

    Raises:
        UsageError: an id is missing, or there twice.
    """
    keys = [_key(path, what, item, "id") for item in items]
    again = next((key for number, key in enumerate(keys) if key in keys[:number]), None)
    if again is not None:
        raise UsageError(f"{path}: {what} has id {again!r} as another one has; {_MEND}")
    return keys


def _categories(path: Path, items: Sequence[Mapping[str, Any]]) -> dict[int | str, str]:
    names = [_text(path, "a category", item, "name") for item in items]
    return dict(zip(_keys(path, "a category", items), names, strict=True))


def _branch_names(path: Path, known: Sequence[str], branch: Sequence[str]) -> set[str]:
    for name in branch:
        if name not in known:
            raise UsageError(f"{path}: has no category {name!r}; it has {', '.join(known)}")
    rest = [name for name in known if name != IGNORE]
    if branch:
        return set(branch)
    if len(rest) == 1:
        return set(rest)
    if "branch" in rest:
        return {"branch"}
    raise UsageError(
        f"{path}: which categories are branches? It has {', '.join(known) or 'none'}; say"
        " --branch NAME, once for each"
    )


def _pictures(path: Path, items: Sequence[Mapping[str, Any]]) -> dict[int | str, Mapping[str, Any]]:
    return dict(zip(_keys(path, "an image", items), items, strict=True))


def _require_known(
    path: Path,
    annotation: Mapping[str, Any],
    names: Mapping[int | str, str],
    pictures: Mapping[int | str, Mapping[str, Any]],
) -> None:
    for name, known in (("category_id", names), ("image_id", pictures)):
        if _key(path, _called(annotation), annotation, name) not in known:
            raise UsageError(
                f"{path}: {_called(annotation)} has {name} {annotation[name]!r}, which the file"
                f" does not define; {_MEND}"
            )


def _called(annotation: Mapping[str, Any]) -> str:
    return f"annotation {annotation.get('id', '?')}"


def _shape(path: Path, annotation: Mapping[str, Any]) -> Shape | None:
    """Return what outlines an annotation, None if nothing does."""
    name, found = _called(annotation), annotation.get("segmentation")
    if not found:
        return None
    if isinstance(found, dict):
        counts = found.get("counts")
        if isinstance(counts, str):
            return Shape(name=name, runs=counts)
        if isinstance(counts, list) and all(type(one) is int for one in counts):
            return Shape(name=name, runs=tuple(counts))
        raise UsageError(f"{path}: {name} has run lengths that are none; {_MEND}")
    try:
        outlines = tuple(np.array(one, dtype=np.float64).reshape(-1, 2) for one in found)
        if any(len(outline) < 3 for outline in outlines):
            raise ValueError("a polygon needs three corners")
    except (TypeError, ValueError) as error:
        raise UsageError(f"{path}: {name} has a polygon that is none ({error}); {_MEND}") from error
    return Shape(name=name, outlines=outlines)


def _box(path: Path, annotation: Mapping[str, Any]) -> Shape:
    try:
        x, y, width, height = np.array(annotation["bbox"], dtype=np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise UsageError(
            f"{path}: {_called(annotation)} has neither an outline nor a box; {_MEND}"
        ) from error
    corners = [(x, y), (x + width, y), (x + width, y + height), (x, y + height)]
    return Shape(name=_called(annotation), outlines=(np.array(corners),))


def _picture(
    path: Path,
    images: Path,
    item: Mapping[str, Any],
    branches: Sequence[Shape],
    ignored: Sequence[Shape],
) -> UserPicture:
    called = f"image {item['id']}"
    name = _text(path, called, item, "file_name")
    file = images / name
    if not file.is_file():
        raise UsageError(
            f"{file}: is not there, but {path.name} has labels for it; give its folder with"
            " --images, or remove it from the annotations"
        )
    height, width = item.get("height"), item.get("width")
    if not isinstance(height, int) or not isinstance(width, int):
        raise UsageError(f"{path}: {called} does not say its width and height; {_MEND}")
    return UserPicture(
        path=file,
        size=(height, width),
        scan=scan_of(name, item.get("scan_id")),
        branches=tuple(branches),
        ignored=tuple(ignored),
    )
