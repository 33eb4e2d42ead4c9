"""The learned segmenter: a view in, scored branch instances out."""

import copy
from collections.abc import Sequence
from math import ceil, floor

import cv2
import numpy as np
import torch
from scipy.ndimage import find_objects

from canopy_skel.errors import UsageError, ViewError
from canopy_skel.frame import Float32Array, UInt8Array, View
from canopy_skel.geometry import FloatArray
from canopy_skel.segment import BranchMask
from canopy_skel.segmenters.unet.grouping import Strands, candidates_of, chosen
from canopy_skel.segmenters.unet.network import Known, channels_last, normalised
from canopy_skel.segmenters.unet.precision import has_fast_bfloat16
from canopy_skel.segmenters.unet.targets import STRIDE
from canopy_skel.segmenters.unet.tiles import TILE_PX, enlarged, padded, tiled
from canopy_skel.segmenters.unet.weights import Model, fused

_SMALLEST_TILE_PX = 512


class UNetSegmenter:
    """Finds branches with the U-Net and groups its maps into instances.

    The network sees pictures enlarged by `Model.zoom`. One larger than a tile then is seen tile by
    tile; where memory runs out, the tiles shrink.
    """

    def __init__(
        self,
        model: Model,
        *,
        bfloat16: bool = False,
        threads: int = 1,
        device: str = "cpu",
        tile_px: int = TILE_PX,
    ) -> None:
        """Make a model ready to run; see `weights.load`.

        bfloat16: half the time, results that differ a little from float32; for CPUs that have it.
        threads: of torch in this process; one leaves the other cores to arm, bus and mapping.

        Raises:
            UsageError: this machine lacks bfloat16 or the device.
        """
        if bfloat16 and device == "cpu" and not has_fast_bfloat16():
            raise UsageError("this CPU has no bfloat16 arithmetic; leave bfloat16 off")
        if device.startswith("cuda") and not torch.cuda.is_available():
            raise UsageError(f"torch finds no device {device!r}; install its CUDA build or use cpu")
        torch.set_num_threads(threads)
        self._model = model
        network = fused(copy.deepcopy(model.network).eval())
        self._network = channels_last(network).to(device)
        self._device, self._bfloat16, self._tile_px = device, bfloat16, tile_px

    def segment(self, view: View) -> Sequence[BranchMask]:
        """Return the branches found in the colour picture, scored by how sure they are branches.

        Raises:
            ViewError: the picture is not 8-bit colour, or memory does not suffice for it.
        """
        return self.segment_and_map(view)[0]

    def segment_and_map(self, view: View) -> tuple[Sequence[BranchMask], Float32Array]:
        """Return what `segment` does, and the maps (8, h, w) it rests on, see `network.Maps`.

        Raises: as `segment`.
        """
        color = view.color_rgb
        if color.dtype != np.uint8 or color.ndim != 3 or color.shape[2] != 3:
            raise ViewError(
                f"view {view.index}: the picture is {color.dtype} of shape {color.shape}; the"
                " unet segmenter needs (H, W, 3) uint8"
            )
        try:
            known = self.known(color)
            rough = self._bfloat16 and self._device == "cpu"
            size = color.shape[0], color.shape[1]
            found = instances_of(known, size, self._model, bfloat16=rough)
        except (MemoryError, RuntimeError) as error:
            if not _is_memory(error):
                raise
            raise ViewError(
                f"view {view.index}: no memory left for a picture of {color.shape[1]}x"
                f"{color.shape[0]}; free some, or record smaller pictures"
            ) from error
        return found, known.maps

    def known(self, color_rgb: UInt8Array) -> Known:
        """Return all the network says of an (H, W, 3) picture; h = ceil(zoom H / 2), w alike.

        Raises:
            MemoryError: there is not enough even for small tiles.
        """
        color_rgb = enlarged(color_rgb, self._model.zoom)
        tile = self._tile_px
        while True:
            try:
                return Known(*tiled(color_rgb, self._infer, tile))
            except (MemoryError, RuntimeError) as error:
                if not _is_memory(error):
                    raise
                if tile <= _SMALLEST_TILE_PX:
                    raise MemoryError(str(error)) from error
                tile //= 2

    def _infer(self, color_rgb: UInt8Array) -> tuple[Float32Array, ...]:
        """Return the maps and the features (K, h / 2, w / 2) of a part (h, w, 3) of a picture."""
        height, width = (size // STRIDE for size in color_rgb.shape[:2])
        with torch.inference_mode():
            picture = normalised(padded(color_rgb)[None]).to(
                self._device, memory_format=torch.channels_last
            )
            kind = self._device.split(":")[0]
            with torch.autocast(kind, torch.bfloat16, enabled=self._bfloat16):
                maps, features = self._network.known(picture)
            maps = maps[:, :height, :width].contiguous()
            return tuple(
                part.cpu().float().numpy() for part in (maps, features[:, :height, :width])
            )


def _is_memory(error: MemoryError | RuntimeError) -> bool:
    known = isinstance(error, MemoryError | torch.OutOfMemoryError)
    return known or "allocate memory" in str(error)


def instances_of(
    known: Known, size: tuple[int, int], model: Model, *, bfloat16: bool = False
) -> list[BranchMask]:
    """Return the branches in what is known of a picture of a size (height, width)."""
    candidates = candidates_of(known.maps, model.grouping)
    scores = model.scorer.scores(known, candidates, bfloat16=bfloat16)
    strands, taken = chosen(known.maps, candidates, scores, model.grouping)
    return masks_of(strands, taken, size, model.least_score)


def masks_of(
    strands: Strands, scores: FloatArray, size: tuple[int, int], least_score: float
) -> list[BranchMask]:
    """Return the instances of at least a score at the picture's own size (height, width).

    They keep their numbers in `strands`. Their outlines run where the branch map, interpolated
    between cells, falls to its threshold; how thick they are says the map of radii.
    """
    masks: list[BranchMask] = []
    cell_px = np.array(size) / strands.label.shape
    for number, box in enumerate(find_objects(strands.label), start=1):
        if box is None or not scores[number - 1] >= least_score:
            continue
        pixels = [
            np.arange(floor(span.start * cell), min(ceil(span.stop * cell), most))
            for span, cell, most in zip(box, cell_px, size, strict=True)
        ]
        rows, columns = ((at + 0.5) / cell for at, cell in zip(pixels, cell_px, strict=True))
        mask = strands.label[rows.astype(np.int64)[:, None], columns.astype(np.int64)] == number
        u, v = np.meshgrid((columns - 0.5).astype(np.float32), (rows - 0.5).astype(np.float32))
        rim = cv2.BORDER_REPLICATE
        mask &= cv2.remap(strands.surplus, u, v, cv2.INTER_LINEAR, borderMode=rim) > 0
        top, left = int(pixels[0][0]), int(pixels[1][0])
        if mask.any():
            log_radius = strands.log_radius[box][strands.label[box] == number].mean()
            masks.append(
                BranchMask(
                    instance=number,
                    left_px=left,
                    top_px=top,
                    mask=mask,
                    confidence=float(scores[number - 1]),
                    radius_px=float(np.exp(log_radius) * cell_px.mean()),
                )
            )
    return masks
