"""The process that owns depthai: `python -m drivers.oak.child FD`, FD being one end of a pipe.

depthai blocks for ten seconds where there is no device, and its threads may abort the process
when one goes away. So it lives here, alone; the parent starts another process when this one ends.

One thread: if depthai blocks, the beats stop, and the parent ends this process.
"""

import os
import sys
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, NoReturn

from drivers.oak.messages import Beat, Farewell, Grab, OakConfig, Picture, Ready

if TYPE_CHECKING:
    import depthai as dai

    from drivers.oak.frames import Exposure

_POLL_S = 0.005
_BEAT_S = 0.2


class NoDeviceError(Exception):
    """There is no device to open; the message is for the operator."""


def main(pipe: Connection) -> NoReturn:
    """Serve the parent until it goes away."""
    config: OakConfig = pipe.recv()
    try:
        device = find_device(config.device)
        _run(pipe, config, device)
    except NoDeviceError as error:
        _say(pipe, str(error))
    except ImportError as error:
        _say(pipe, f"{error}: pip install 'canopy-skel[oak]'")
    except (EOFError, BrokenPipeError):
        os._exit(0)
    except (RuntimeError, ValueError) as error:
        _say(pipe, f"OAK: {error}")
    os._exit(1)


def find_device(name: str) -> "dai.DeviceInfo":
    """Return the device of this id or address, or the only one; half a second, unlike opening.

    Raises:
        NoDeviceError: it is not there, or there are several and none was named.
        ImportError: depthai is not installed.
    """
    import depthai as dai

    found = dai.Device.getAllAvailableDevices()
    known = ", ".join(f"{info.deviceId} ({info.name})" for info in found)
    if not found:
        raise NoDeviceError(
            "no OAK camera found: check cable, power and network, and that no other program uses it"
        )
    matching = [info for info in found if name in ("", info.deviceId, info.name)]
    if not matching:
        raise NoDeviceError(f"no OAK camera {name!r}; there are: {known}")
    if len(matching) > 1:
        raise NoDeviceError(f"several OAK cameras: {known}; name one in the configuration")
    return matching[0]


def _run(pipe: Connection, config: OakConfig, info: "dai.DeviceInfo") -> None:
    from drivers.oak.pipeline import running

    with running(config, info) as newest:
        pipe.send(Ready())
        _serve(pipe, newest)


def _serve(pipe: Connection, newest: "Callable[[], Exposure | None]") -> NoReturn:
    """Answer until the pipe is closed, which raises EOFError."""
    grab: Grab | None = None
    beat_s = 0.0
    while True:
        if pipe.poll(_POLL_S):
            grab = pipe.recv()
        exposure = newest()
        if grab is None:
            continue
        if exposure is not None and exposure.began_ns >= grab.not_before_ns:
            pipe.send(Picture(grab.number, exposure.image()))
            grab = None
        elif time.perf_counter() - beat_s > _BEAT_S:
            pipe.send(Beat())
            beat_s = time.perf_counter()


def _say(pipe: Connection, text: str) -> None:
    try:
        pipe.send(Farewell(text))
    except OSError:
        return  # nobody is left to hear it


if __name__ == "__main__":
    main(Connection(int(sys.argv[1])))
