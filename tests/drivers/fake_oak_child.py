"""Stands in for `drivers.oak.child`: the same pipe protocol, misbehaving as a file says.

Run as `fake_oak_child.py BEHAVIOUR_FILE FD`. The file is read anew for every decision; a behaviour
that ends in `-once` is replaced by "well" when it has been shown.
"""

import os
import sys
import time
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from scenes.wood import view_from

from drivers.oak.messages import Beat, Farewell, Picture, Ready
from drivers.protocols import CameraImage

VIEW = view_from(0)
GRAIN = np.random.default_rng(0).integers(0, 255, (*VIEW.depth_m.shape, 3), np.uint8)


def image():
    """Three sticks of wood, sharp enough for the quality gate."""
    return CameraImage(
        stamp_ns=time.monotonic_ns(),
        color_rgb=GRAIN.copy(),
        intrinsics=VIEW.intrinsics,
        depth_m=VIEW.depth_m.copy(),
        instances=VIEW.instances.copy(),
        scores=VIEW.scores,
    )


def behaviour(path):
    text = path.read_text()
    if text.endswith("-once"):
        path.write_text("well")
    return text.removesuffix("-once")


def answer(pipe, grab, how):
    if how == "hang":
        time.sleep(1000)
    if how == "die":
        os._exit(7)
    if how == "unplugged":
        pipe.send(Farewell("OAK: Couldn't read data from stream"))
        os._exit(1)
    if how == "half":
        os.write(pipe.fileno(), b"\x00\x10\x00\x00beginning")
        time.sleep(1000)
    if how == "silent":
        return False
    time.sleep(0.6 if how == "late" else 0.01)
    pipe.send(Picture(grab.number, image()))
    return True


def main():
    path, pipe = Path(sys.argv[1]), Connection(int(sys.argv[2]))
    pipe.recv()
    if path.read_text() == "absent":
        pipe.send(Farewell("no OAK camera found: check cable"))
        return
    if behaviour(path) == "dead on arrival":
        os._exit(3)
    pipe.send(Ready())
    grab = None
    while True:
        try:
            if pipe.poll(0.05):
                grab = pipe.recv()
            if grab is not None:
                if answer(pipe, grab, behaviour(path)):
                    grab = None
                else:
                    pipe.send(Beat())
        except (EOFError, OSError):
            return


main()
