"""Contact sheets of the orchard: `python -m mock_hw.orchard.gallery docs/images`."""

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np

from canopy_skel.document import SkeletonDocument
from canopy_skel.frame import Intrinsics, UInt8Array, UInt16Array, View
from canopy_skel.geometry import FloatArray, invert, transform_points
from mock_hw.orchard.camera import Camera, render_view
from mock_hw.orchard.foliage import DENSITIES, MOST_LEAVES, canopy_of, fit_canopy
from mock_hw.orchard.light import fair_weather
from mock_hw.orchard.path import look_at
from mock_hw.orchard.presets import SPECIES
from mock_hw.orchard.scene import build_scene
from mock_hw.orchard.simulate import Options, prepare, trellised, truth, views
from mock_hw.orchard.species import Species
from mock_hw.orchard.tree import TRUNK_X_M, Tree, grow

TILE = (480, 300)
PROFILE_TILE = (300, 375)
SHOWN_VIEW = 7
LARGEST_BYTES = 400_000
_SEEN, _SMALL, _HIDDEN = (70, 150, 255), (255, 190, 60), (255, 70, 70)


def main(argv: list[str] | None = None) -> int:
    """Write one sheet of views and one of profiles per species."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("directory", type=Path)
    parser.add_argument("--species", choices=list(SPECIES), action="append")
    parser.add_argument("--topology", type=int, default=0)
    arguments = parser.parse_args(argv)
    arguments.directory.mkdir(parents=True, exist_ok=True)
    for name in arguments.species or SPECIES:
        for kind, sheet in (
            ("views", sheet_of_views(SPECIES[name], arguments.topology)),
            ("profiles", sheet_of_profiles(SPECIES[name], range(5))),
        ):
            path = arguments.directory / f"orchard_{name}_{kind}.jpg"
            path.write_bytes(_jpeg(sheet))
            sys.stderr.write(f"{path}\n")
    return 0


def sheet_of_views(species: Species, topology: int) -> UInt8Array:
    """Return a sheet: foliage density across; picture, depth, instances and truth down."""
    tree, most = grow(species, topology), MOST_LEAVES[species.name]
    trellis = trellised(species)
    canopy = canopy_of(tree, seed=topology, trellis=trellis, most_leaves=most)
    columns = []
    for density in DENSITIES:
        fit = fit_canopy(canopy, density, most)
        options = Options(
            species=species.name, topology=topology, foliage=density, seed=density, weather="any"
        )
        simulation = prepare(options, fit)
        view = next(v for v in views(simulation) if v.index == SHOWN_VIEW)
        true_pose = simulation.true_poses[SHOWN_VIEW]
        tiles = [
            np.array(view.color_rgb),
            _depth_colours(view),
            _instance_colours(view),
            _truth_colours(view, truth(simulation), true_pose),
        ]
        caption = f"{species.name} FD{density}: {fit.leaf_count} leaves, V_det {fit.v_det:.2f}"
        columns.append(np.vstack([_framed(_fitted(tile, TILE)) for tile in tiles]))
        _write(columns[-1], caption)
    return np.hstack(columns)


def sheet_of_profiles(species: Species, topologies: range) -> UInt8Array:
    """Return a sheet: topologies across; leafless, thin and full crowns down, seen from afar."""
    tall = Intrinsics(fx_px=700, fy_px=700, cx_px=240, cy_px=300, width_px=480, height_px=600)
    camera = Camera(intrinsics=tall, noise=None)
    pose = look_at([TRUNK_X_M - 3.1, 0.0, 0.15], [TRUNK_X_M, 0.0, -0.02])
    columns = []
    for topology in topologies:
        tree = grow(species, topology)
        tiles = [
            _profile(tree, leaves, camera, pose)
            for leaves in (0, MOST_LEAVES[species.name] // 8, MOST_LEAVES[species.name] // 2)
        ]
        columns.append(np.vstack([_framed(_fitted(tile, PROFILE_TILE)) for tile in tiles]))
        _write(columns[-1], f"{species.name} {topology}")
    return np.hstack(columns)


def _profile(tree: Tree, leaves: int, camera: Camera, pose: FloatArray) -> UInt8Array:
    scene = build_scene(
        tree, leaves, fair_weather(), seed=0, rows=False, trellis=trellised(tree.species)
    )
    view = render_view(scene, pose, camera, index=0, stamp_ns=0, seed=0)
    return np.array(view.color_rgb)


def _instance_colours(view: View) -> UInt8Array:
    if view.instances is None:
        raise ValueError("the view has no instances")
    image: UInt16Array = view.instances
    palette = np.random.default_rng(0).integers(70, 256, (int(image.max()) + 1, 3))
    palette[0] = 0
    grey = np.array(view.color_rgb).mean(axis=2, keepdims=True) * 0.35
    return np.where(image[..., None] > 0, palette[image], grey).astype(np.uint8)


def _depth_colours(view: View) -> UInt8Array:
    if view.depth_m is None:
        raise ValueError("the view has no depth")
    shown = np.nan_to_num((2.6 - view.depth_m) / 2.2, nan=0.0).clip(0, 1)
    colours = cv2.applyColorMap((255 * shown).astype(np.uint8), cv2.COLORMAP_TURBO)
    return np.asarray(np.where(np.isnan(view.depth_m)[..., None], 0, colours[..., ::-1])).astype(
        np.uint8
    )


def _truth_colours(view: View, document: SkeletonDocument, pose: FloatArray) -> UInt8Array:
    """Draw the true skeleton: covered by an instance, seen only in part, never seen."""
    canvas = (np.array(view.color_rgb) * 0.3).astype(np.uint8)
    uv = view.intrinsics.project(transform_points(invert(pose), document.position))
    segmented = np.array(document.extra["segmented"], dtype=bool)
    for a, b in document.edges:
        colour = _SEEN if segmented[b] else _HIDDEN if document.occluded[b] else _SMALL
        start, end = (tuple(int(x) for x in np.rint(uv[k])) for k in (a, b))
        cv2.line(canvas, start, end, colour, 3, cv2.LINE_AA)
    return canvas


def _fitted(image: UInt8Array, size: tuple[int, int]) -> UInt8Array:
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA)).astype(np.uint8)


def _framed(tile: UInt8Array) -> UInt8Array:
    tile[-1:], tile[:, -1:] = 255, 255
    return tile


def _write(tile: UInt8Array, text: str) -> None:
    width = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)[0][0]
    tile[:28, : width + 16] //= 3
    cv2.putText(tile, text, (8, 19), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)


def _jpeg(image: UInt8Array) -> bytes:
    """Encode with the best quality that stays under the size limit."""
    for quality in (90, 84, 78, 70, 60, 50):
        data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        if len(data) <= LARGEST_BYTES:
            break
    return bytes(data)


if __name__ == "__main__":
    sys.exit(main())
