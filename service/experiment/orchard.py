"""The recordings of an orchard: whole, or as far as it has been made."""

import json
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from hashlib import file_digest
from itertools import product
from pathlib import Path
from typing import Any

from canopy_skel.errors import UsageError

MANIFEST = "manifest.json"
_NAME = re.compile(r"(?P<species>[a-z]+)_(?P<topology>\d{3})_fd(?P<foliage>\d)\.mcap")


@dataclass(frozen=True, kw_only=True, slots=True, order=True)
class Tree:
    """One recording of a simulated tree, known by its content.

    v_det, v_det_target, leaf_count: from the manifest; None where it does not say.
    """

    species: str
    topology: int
    foliage: int
    file: str
    sha256: str
    leaf_count: int | None = None
    v_det: float | None = None
    v_det_target: float | None = None

    @property
    def name(self) -> str:
        """The name of the recording without its suffix."""
        return Path(self.file).stem


@dataclass(frozen=True, kw_only=True, slots=True)
class Choice:
    """Which trees of an orchard to use; empty means all."""

    species: tuple[str, ...] = ()
    topologies: tuple[int, ...] = ()
    foliage: tuple[int, ...] = ()

    def has(self, species: str, topology: int, foliage: int) -> bool:
        """Say whether a tree is chosen."""
        return all(
            not chosen or value in chosen
            for chosen, value in (
                (self.species, species),
                (self.topologies, topology),
                (self.foliage, foliage),
            )
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class Orchard:
    """The trees that are there, sorted, what is missing of the full grid, and what is odd."""

    trees: tuple[Tree, ...]
    missing: tuple[str, ...]
    warnings: tuple[str, ...]


def read_orchard(folder: Path, choice: Choice) -> Orchard:
    """Look at a folder of recordings named like oak_003_fd2.mcap; it may still be growing.

    Raises:
        UsageError: there is no such recording in it, or its manifest cannot be read.
    """
    known = _manifest(folder)
    trees, warnings = [], []
    for path in sorted(folder.glob("*.mcap")):
        match = _NAME.fullmatch(path.name)
        if match is None:
            warnings.append(f"{path.name}: left out, its name is not like oak_003_fd2.mcap")
            continue
        species, topology, foliage = match["species"], int(match["topology"]), int(match["foliage"])
        if not choice.has(species, topology, foliage):
            continue
        with path.open("rb") as stream:
            digest = file_digest(stream, "sha256").hexdigest()
        entry = known.get(path.name, {})
        if entry.get("sha256", digest) != digest:
            warnings.append(
                f"{path.name}: is not what {MANIFEST} says (another sha256); used as it is"
            )
        facts = {name: entry.get(name) for name in ("leaf_count", "v_det", "v_det_target")}
        trees.append(
            Tree(
                species=species,
                topology=topology,
                foliage=foliage,
                file=path.name,
                sha256=digest,
                **facts,
            )
        )
    if not trees:
        raise UsageError(
            f"{folder}: no chosen recording named like oak_003_fd2.mcap there; make them with"
            " `canopy simulate`"
        )
    return Orchard(
        trees=tuple(sorted(trees)),
        missing=tuple(_missing(trees, choice)),
        warnings=tuple(warnings),
    )


def _missing(trees: Collection[Tree], choice: Choice) -> list[str]:
    """Name what the full grid of the chosen, or else of the present, values lacks."""
    here = {(tree.species, tree.topology, tree.foliage) for tree in trees}
    axes = (
        choice.species or sorted({tree.species for tree in trees}),
        choice.topologies or sorted({tree.topology for tree in trees}),
        choice.foliage or sorted({tree.foliage for tree in trees}),
    )
    return [f"{s}_{t:03d}_fd{f}" for s, t, f in product(*axes) if (s, t, f) not in here]


def _manifest(folder: Path) -> Mapping[str, Mapping[str, Any]]:
    """Return the manifest's entries by file; none where there is no manifest."""
    path = folder / MANIFEST
    try:
        entries = json.loads(path.read_bytes())["recordings"]
        return {entry["file"]: entry for entry in entries}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(
            f"{path}: not the manifest of an orchard ({error}); make it again with `canopy"
            " simulate`, or move it away to use the recordings without it"
        ) from error
