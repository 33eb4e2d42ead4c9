"""`drivers.oak.child` and depthai themselves, with only device and pipeline staged.

Run as `oak_child_on_stage.py BEHAVIOUR_FILE FD`. Nodes are mocks that have what depthai's nodes
have and nothing else; frames and groups are depthai's. The file says "well", "dark" (no frames) or
"lost" (the queue closes, as when the device goes away; "lost-once": and comes back).
"""

import sys
import time
from datetime import timedelta
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import depthai as dai
import numpy as np

from drivers.oak import child

HEIGHT, WIDTH = 40, 64
MATRIX = [[80.0, 0.0, 31.5], [0.0, 80.0, 19.5], [0.0, 0.0, 1.0]]
KINDS = {"depth": (np.uint16, dai.ImgFrame.Type.RAW16), "color": (None, dai.ImgFrame.Type.RGB888i)}
BEHAVIOUR = Path(sys.argv[1])


def frame(name):
    dtype, kind = KINDS.get(name, (np.uint8, dai.ImgFrame.Type.GRAY8))
    pixels = np.full((HEIGHT, WIDTH), 100, dtype) if dtype else np.zeros((HEIGHT, WIDTH, 3), "u1")
    one = dai.ImgFrame()
    one.setCvFrame(pixels, kind)
    one.setTimestamp(timedelta(seconds=time.monotonic() - 0.03))
    one.setTransformation(dai.ImgTransformation(WIDTH, HEIGHT, MATRIX))
    return one


class Queue:
    """A group every 30 ms, 30 ms old: the first after a request was exposed before it."""

    def __init__(self, names):
        self.names = names
        self.next_s = 0.0

    def tryGet(self):  # noqa: N802
        how = BEHAVIOUR.read_text()
        if how.startswith("lost"):
            if how == "lost-once":
                BEHAVIOUR.write_text("well")
            raise dai.MessageQueue.QueueException("MessageQueue was closed")
        if how == "dark" or time.perf_counter() < self.next_s:
            return None
        self.next_s = time.perf_counter() + 0.03
        group = dai.MessageGroup()
        for name in self.names:
            group[name] = frame(name)
        return group


class Pipeline:
    def __init__(self, device):
        self.device = device

    def __enter__(self):
        return self

    def __exit__(self, *reasons):
        pass

    def create(self, kind):
        node = MagicMock(spec=kind)
        if kind is dai.node.Camera:
            node.build.return_value = node
        if kind is dai.node.Sync:
            linked = node.inputs.__getitem__.call_args_list
            node.out.createOutputQueue.side_effect = lambda **options: Queue(
                [call.args[0] for call in linked]
            )
        return node

    def getDefaultDevice(self):  # noqa: N802
        return self.device

    def start(self):
        pass


device = MagicMock(spec=dai.Device)
device.getPlatform.return_value = dai.Platform.RVC2
device.readCalibration.return_value.getBaselineDistance.return_value = 7.5
dai.Device = MagicMock(return_value=device)
dai.Device.getAllAvailableDevices.return_value = [SimpleNamespace(deviceId="A1", name="1.1")]
dai.Pipeline = Pipeline
child.main(Connection(int(sys.argv[2])))
