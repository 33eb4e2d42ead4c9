"""The built-in network run by OpenCV, which every machine has; no torch.

Masks that come from elsewhere (recorded, Mask R-CNN) leave out wood that is too small or too thin
for them; method `canopy` asks this network about what lies beside them.
"""

import gzip
import json
from importlib.resources import files

import cv2
import numpy as np

from canopy_skel.frame import Float32Array, UInt8Array
from canopy_skel.segmenters.unet.targets import STRIDE
from canopy_skel.segmenters.unet.tiles import TILE_PX, enlarged, padded, tiled

MODEL_FILE, DESCRIPTION_FILE = "builtin.onnx.gz", "builtin.json"


class PortableNetwork:
    """The built-in network; float32, on the CPU. Not to be shared between threads."""

    def __init__(self) -> None:
        """Read the model this package ships."""
        folder = files(__package__)
        model = gzip.decompress((folder / MODEL_FILE).read_bytes())
        self._network = cv2.dnn.readNetFromONNX(np.frombuffer(model, dtype=np.uint8))
        self._zoom = float(json.loads((folder / DESCRIPTION_FILE).read_text())["zoom"])

    def maps(self, color_rgb: UInt8Array) -> Float32Array:
        """Return the eight maps (8, h, w) of an (H, W, 3) picture, see `network.Maps`."""
        (maps,) = tiled(enlarged(color_rgb, self._zoom), self._infer, TILE_PX)
        return maps

    def _infer(self, color_rgb: UInt8Array) -> tuple[Float32Array]:
        self._network.setInput(cv2.dnn.blobFromImage(padded(color_rgb)))
        height, width = (size // STRIDE for size in color_rgb.shape[:2])
        maps = self._network.forward()[0, :, :height, :width]
        return (np.ascontiguousarray(maps, dtype=np.float32),)
