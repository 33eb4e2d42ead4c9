"""A folder of simulated recordings, and the manifest that says how each was made.

`manifest.json` lists what is finished; a file beside it that it does not list is not.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from hashlib import file_digest
from pathlib import Path
from typing import Any, get_type_hints

from canopy_skel.errors import CanopyError, UsageError
from canopy_skel.recording import read_recording
from mock_hw.orchard.camera import Camera, scaled
from mock_hw.orchard.files import write_whole
from mock_hw.orchard.simulate import Options, require_known

MANIFEST = "manifest.json"
SCHEMA = "canopy-orchard/1"
SIMULATION_KEY = "simulation"


@dataclass(frozen=True, kw_only=True, slots=True)
class Settings:
    """What all recordings of a folder have in common; see `simulate.Options`.

    stereo: record the stereo pair instead of depth images. picture_scale: size of the pictures.
    """

    views: int = 10
    noise: str = "nominal"
    stereo: bool = False
    wind_m: float = 0.0
    weather: str = "any"
    seed: int = 0
    picture_scale: float = 1.0


@dataclass(frozen=True, kw_only=True, slots=True)
class LeafyTree:
    """One tree under one foliage density."""

    species: str
    topology: int
    foliage: int

    @property
    def file(self) -> str:
        """The name of its recording."""
        return f"{self.species}_{self.topology:03d}_fd{self.foliage}.mcap"

    def options(self, settings: Settings) -> Options:
        """Return what its recording is made from."""
        camera = Camera(depth=not settings.stereo, pair=settings.stereo)
        return Options(
            species=self.species,
            topology=self.topology,
            foliage=self.foliage,
            views=settings.views,
            seed=settings.seed,
            noise=settings.noise,
            wind_m=settings.wind_m,
            weather=settings.weather,
            camera=scaled(camera, settings.picture_scale),
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class Recorded:
    """A finished recording.

    leaf_count, v_det, v_det_target: of the foliage density, from the 10 standard views of the tree
    at rest. segmented: share of the framed true skeleton that the instances of this very recording
    cover; the same as v_det where it has those views, that rest and full-size pictures.
    """

    file: str
    sha256: str
    bytes: int
    species: str
    topology: int
    foliage: int
    views: int
    leaf_count: int
    v_det: float
    v_det_target: float
    segmented: float

    @property
    def tree(self) -> LeafyTree:
        """The tree and its foliage."""
        return LeafyTree(species=self.species, topology=self.topology, foliage=self.foliage)


def leafy_trees(
    species: Sequence[str], topologies: Sequence[int], foliage: Sequence[int]
) -> list[LeafyTree]:
    """Return all trees under all densities: the first tree of every species first."""
    return [
        LeafyTree(species=name, topology=number, foliage=density)
        for number in topologies
        for name in species
        for density in foliage
    ]


def require_possible(wanted: Iterable[LeafyTree], settings: Settings) -> None:
    """Check every option before any work is done.

    Raises:
        UsageError: one of them is unknown or out of range.
    """
    for tree in wanted:
        require_known(tree.options(settings))


def metadata_of(tree: LeafyTree, settings: Settings, software: str) -> dict[str, str]:
    """Return the metadata of a recording: what it is of, and how to make it again."""
    return {
        "tree_id": f"{tree.species}_{tree.topology:03d}",
        "rig": "simulated orchard",
        "software": software,
        SIMULATION_KEY: json.dumps({**asdict(tree), **asdict(settings)}, sort_keys=True),
    }


def finished(folder: Path, settings: Settings, software: str) -> dict[LeafyTree, Recorded]:
    """Return what the manifest of a folder lists; nothing if there is none.

    Raises:
        UsageError: the manifest is of other settings or another version, or cannot be read.
    """
    path = folder / MANIFEST
    if not path.exists():
        return {}
    document = read_manifest(folder)
    ours = {"software": software, "settings": asdict(settings)}
    for key, wanted in ours.items():
        if document[key] != wanted:
            raise UsageError(
                f"{path}: is of {_difference(document[key], wanted)}; choose another folder, or"
                " move this one away"
            )
    return {one.tree: one for one in recorded_in(document)}


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of a folder.

    Raises:
        UsageError: it cannot be read, or is no manifest.
    """
    path = folder / MANIFEST
    try:
        document: dict[str, Any] = json.loads(path.read_bytes())
        if document["schema"] != SCHEMA or not {"software", "settings"} <= document.keys():
            raise ValueError(document["schema"])
        recorded_in(document)
    except OSError as error:
        raise UsageError(
            f"{path}: cannot be read ({error.strerror}); give the folder of a `canopy simulate`"
        ) from error
    except (ValueError, TypeError, KeyError) as error:
        raise UsageError(
            f"{path}: is no {SCHEMA} manifest; move it away, and its recordings are made anew"
        ) from error
    return document


def recorded_in(document: Mapping[str, Any]) -> list[Recorded]:
    """Return the recordings that a manifest lists.

    Raises:
        KeyError: an entry lacks something.
        TypeError: an entry has something of another type.
    """
    kinds = get_type_hints(Recorded)
    recordings = []
    for entry in document["recordings"]:
        own = {name: entry[name] for name in kinds}
        for name, kind in kinds.items():
            if not isinstance(own[name], int | float if kind is float else kind):
                raise TypeError(f"{name} is {own[name]!r}")
        recordings.append(Recorded(**own))
    return recordings


def write_manifest(
    folder: Path, recordings: Iterable[Recorded], settings: Settings, software: str
) -> None:
    """Write the manifest, whole or not at all; the same recordings give the same bytes.

    Raises:
        RecordingError: it cannot be written.
    """
    document = {
        "schema": SCHEMA,
        "software": software,
        "settings": asdict(settings),
        "recordings": [
            {**asdict(one), "options": asdict(settings)}
            for one in sorted(recordings, key=lambda one: one.file)
        ],
    }
    write_whole(folder / MANIFEST, [(json.dumps(document, indent=1) + "\n").encode()])


def flaw_of(folder: Path, one: Recorded) -> str | None:
    """Say what is wrong with a recording that the manifest lists; None if nothing is."""
    path = folder / one.file
    try:
        same = sha256_of(path) == one.sha256
    except OSError as error:
        return f"{path}: cannot be read ({error.strerror})"
    return None if same else f"{path}: has other bytes than the manifest says"


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as stream:
        return file_digest(stream, "sha256").hexdigest()


def require_ours(path: Path, tree: LeafyTree, settings: Settings, software: str) -> None:
    """Check that a recording which is about to be replaced would come out as itself.

    Raises:
        UsageError: it was made by something else, or nobody knows.
    """
    wanted = metadata_of(tree, settings, software)
    try:
        metadata = read_recording(path).metadata
    except CanopyError:
        metadata = {}
    if any(metadata.get(key) != value for key, value in wanted.items()):
        raise UsageError(
            f"{path}: is there already and was not made with these options; choose another folder,"
            " or move it away"
        )


def _difference(found: object, wanted: object) -> str:
    if not isinstance(found, dict) or not isinstance(wanted, dict):
        return f"{found}, not {wanted}"
    pairs = [
        f"{name} {found.get(name)}, not {value}"
        for name, value in wanted.items()
        if found.get(name) != value
    ]
    return "; ".join(pairs) or "other settings"
