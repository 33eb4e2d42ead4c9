"""Mask R-CNN as a segmenter: a view in, merged and disjoint branch instances out."""

import copy
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch

from canopy_skel.errors import UsageError, ViewError
from canopy_skel.frame import UInt8Array, View
from canopy_skel.segment import BranchMask
from canopy_skel.segmenters.maskrcnn.merging import disjoint, merged
from canopy_skel.segmenters.maskrcnn.weights import Detector

_INSIDE = 0.5


class MaskRcnnSegmenter:
    """Finds branches with Mask R-CNN.

    Pictures are scaled to fit the detector's size, so that a large one needs no more memory.
    """

    def __init__(self, detector: Detector, *, threads: int = 1, device: str = "cpu") -> None:
        """Make a detector ready to run; see `weights.load`. threads: of torch in this process.

        Raises:
            UsageError: this machine lacks the device.
        """
        if device.startswith("cuda") and not torch.cuda.is_available():
            raise UsageError(f"torch finds no device {device!r}; install its CUDA build or use cpu")
        torch.set_num_threads(threads)
        self._network = copy.deepcopy(detector.network).eval().to(device)
        self._detector, self._device = detector, device

    def segment(self, view: View) -> Sequence[BranchMask]:
        """Return the branches found in the colour picture, the surest first.

        Raises:
            ViewError: the picture is not 8-bit colour, or memory does not suffice for it.
        """
        color = view.color_rgb
        if color.dtype != np.uint8 or color.ndim != 3 or color.shape[2] != 3:
            raise ViewError(
                f"view {view.index}: the picture is {color.dtype} of shape {color.shape}; the"
                " maskrcnn segmenter needs (H, W, 3) uint8"
            )
        try:
            found = self._found(_fitting(color, self._detector.size_px))
        except torch.OutOfMemoryError as error:
            raise ViewError(
                f"view {view.index}: no memory left on {self._device}; free some, or use cpu"
            ) from error
        size = color.shape[0], color.shape[1]
        sharp = [_scaled(mask, *found[1], size) for mask in merged(found[0])]
        return disjoint([mask for mask in sharp if mask.mask.any()], size)

    def _found(self, color: UInt8Array) -> tuple[list[BranchMask], tuple[int, int]]:
        """Return the masks of at least the least score, and the size of the picture they are in."""
        picture = torch.from_numpy(color).permute(2, 0, 1).float() / 255.0
        with torch.inference_mode():
            output = self._network([picture.to(self._device)])[0]
        scores = output["scores"].cpu().numpy()
        size = color.shape[0], color.shape[1]
        masks: list[BranchMask] = []
        for k in np.flatnonzero(scores >= self._detector.least_score).tolist():
            inside = (output["masks"][k, 0] > _INSIDE).cpu().numpy()
            rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
            if len(rows):
                masks.append(
                    BranchMask(
                        instance=k + 1,
                        left_px=int(columns[0]),
                        top_px=int(rows[0]),
                        mask=inside[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1],
                        confidence=float(scores[k]),
                    )
                )
        return masks, size


def _fitting(color: UInt8Array, size_px: tuple[int, int]) -> UInt8Array:
    """Return the picture, made smaller if it is larger than the network looks at."""
    long, short = max(color.shape[:2]), min(color.shape[:2])
    scale = min(max(size_px) / long, min(size_px) / short)
    if scale >= 1:
        return np.array(color)  # views cannot be written, which torch warns of
    size = max(round(color.shape[1] * scale), 1), max(round(color.shape[0] * scale), 1)
    return np.asarray(cv2.resize(color, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _scaled(mask: BranchMask, height: int, width: int, size: tuple[int, int]) -> BranchMask:
    """Return a mask of a picture (height, width) in one of another size."""
    if (height, width) == size:
        return mask
    v, u = size[0] / height, size[1] / width
    top, left = round(mask.top_px * v), round(mask.left_px * u)
    bottom = min(round((mask.top_px + mask.mask.shape[0]) * v), size[0])
    right = min(round((mask.left_px + mask.mask.shape[1]) * u), size[1])
    own = cv2.resize(
        mask.mask.astype(np.uint8),
        (max(right - left, 1), max(bottom - top, 1)),
        interpolation=cv2.INTER_NEAREST,
    )
    return replace(mask, left_px=left, top_px=top, mask=own > 0)
