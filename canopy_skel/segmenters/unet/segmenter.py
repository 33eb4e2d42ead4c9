"""The learned segmenter: a view in, scored branch instances out."""

import copy
from collections.abc import Iterator, Sequence

import cv2
import numpy as np
import torch
from scipy.ndimage import find_objects

from canopy_skel.errors import UsageError, ViewError
from canopy_skel.frame import Float32Array, UInt8Array, View
from canopy_skel.geometry import FloatArray
from canopy_skel.segment import BranchMask
from canopy_skel.segmenters.unet.grouping import Strands, grouped
from canopy_skel.segmenters.unet.network import MULTIPLE_PX, channels_last, normalised
from canopy_skel.segmenters.unet.precision import has_fast_bfloat16
from canopy_skel.segmenters.unet.targets import STRIDE
from canopy_skel.segmenters.unet.weights import Model, fused

TILE_PX = 1536
_OVERLAP_PX = 192
_SMALLEST_TILE_PX = 512


class UNetSegmenter:
    """Finds branches with the U-Net and groups its maps into instances.

    A picture larger than a tile is seen tile by tile; where memory runs out, the tiles shrink.
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
        color = view.color_rgb
        if color.dtype != np.uint8 or color.ndim != 3 or color.shape[2] != 3:
            raise ViewError(
                f"view {view.index}: the picture is {color.dtype} of shape {color.shape}; the"
                " unet segmenter needs (H, W, 3) uint8"
            )
        try:
            maps = self.maps(color)
        except MemoryError as error:
            raise ViewError(
                f"view {view.index}: no memory left for a picture of {color.shape[1]}x"
                f"{color.shape[0]}; free some, or record smaller pictures"
            ) from error
        strands = grouped(maps, self._model.grouping)
        scores = self._model.calibration.scores(strands.features)
        return masks_of(strands, scores, color.shape[:2], self._model.least_score)

    def maps(self, color_rgb: UInt8Array) -> Float32Array:
        """Return the five maps (5, ceil(H / 2), ceil(W / 2)) of an (H, W, 3) picture.

        Raises:
            MemoryError: there is not enough even for small tiles.
        """
        tile = self._tile_px
        while True:
            try:
                return self._tiled(color_rgb, tile)
            except (MemoryError, RuntimeError) as error:
                if not _is_memory(error):
                    raise
                if tile <= _SMALLEST_TILE_PX:
                    raise MemoryError(str(error)) from error
                tile //= 2

    def _tiled(self, color_rgb: UInt8Array, tile_px: int) -> Float32Array:
        height, width = color_rgb.shape[:2]
        out = np.empty((5, -(-height // STRIDE), -(-width // STRIDE)), dtype=np.float32)
        for rows, own_rows in _spans(height, tile_px):
            for columns, own_columns in _spans(width, tile_px):
                part = self._infer(color_rgb[rows, columns])
                top, left = rows.start // STRIDE, columns.start // STRIDE
                target = out[:, own_rows, own_columns]
                i, j = own_rows.start - top, own_columns.start - left
                target[:] = part[:, i : i + target.shape[1], j : j + target.shape[2]]
        return out

    def _infer(self, color_rgb: UInt8Array) -> Float32Array:
        """Run the network once; the edge is continued up to the multiple the network needs."""
        bottom, right = (-size % MULTIPLE_PX for size in color_rgb.shape[:2])
        padded = np.pad(color_rgb, ((0, bottom), (0, right), (0, 0)), mode="edge")
        with torch.inference_mode():
            picture = normalised(padded[None]).to(self._device, memory_format=torch.channels_last)
            kind = self._device.split(":")[0]
            with torch.autocast(kind, torch.bfloat16, enabled=self._bfloat16):
                output = self._network(picture)
        maps: Float32Array = output[0].float().cpu().contiguous().numpy()
        return maps


def _is_memory(error: MemoryError | RuntimeError) -> bool:
    known = isinstance(error, MemoryError | torch.OutOfMemoryError)
    return known or "allocate memory" in str(error)


def _spans(size: int, tile_px: int) -> Iterator[tuple[slice, slice]]:
    """Yield the pixels each tile sees, and the cells of the output that are its own."""
    step = tile_px - _OVERLAP_PX
    count = max(-(-(size - _OVERLAP_PX) // step), 1)
    for k in range(count):
        start, end = k * step, min(k * step + tile_px, size)
        first = start + (_OVERLAP_PX // 2 if k else 0)
        last = end - _OVERLAP_PX // 2 if k + 1 < count else size
        yield slice(start, end), slice(first // STRIDE, -(-last // STRIDE))


def masks_of(
    strands: Strands, scores: FloatArray, size: tuple[int, int], least_score: float
) -> list[BranchMask]:
    """Return the instances of at least a score at the picture's own size (height, width).

    They keep their numbers in `strands`. Their outlines run where the branch map, interpolated
    between cells, falls to its threshold.
    """
    height, width = size
    masks: list[BranchMask] = []
    for number, box in enumerate(find_objects(strands.label), start=1):
        if box is None or scores[number - 1] < least_score:
            continue
        top, left = STRIDE * box[0].start, STRIDE * box[1].start
        own = (strands.label[box] == number).astype(np.uint8)
        full = (own.shape[1] * STRIDE, own.shape[0] * STRIDE)
        sharp = cv2.resize(strands.surplus[box], full, interpolation=cv2.INTER_LINEAR) > 0
        mask = sharp & (cv2.resize(own, full, interpolation=cv2.INTER_NEAREST) > 0)
        mask = mask[: height - top, : width - left]
        if mask.any():
            masks.append(
                BranchMask(
                    instance=number,
                    left_px=left,
                    top_px=top,
                    mask=mask,
                    confidence=float(scores[number - 1]),
                )
            )
    return masks
