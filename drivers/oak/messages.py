"""What the camera's child process and its parent say to each other over their pipe.

The child unpickles the configuration before it looks for a device, so nothing heavy is imported.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from drivers.protocols import CameraImage


@dataclass(frozen=True, kw_only=True, slots=True)
class OakConfig:
    """One OAK-D and what it shall deliver.

    device: id or address; empty: the only one there is.
    eye: whose picture is the colour picture. "color": the colour camera, depth aligned to it.
    "left": the left of the stereo cameras, rectified, with the right one beside it (`stereo`).
    width_px, height_px: of the colour picture; the stereo cameras run at `stereo_size_px`.
    open_timeout_s: a device boots for several seconds. silence_s: a child that owes a picture and
    says nothing for so long hangs.
    """

    device: str = ""
    eye: Literal["color", "left"] = "color"
    width_px: int = 1280
    height_px: int = 800
    stereo_size_px: tuple[int, int] = (1280, 800)
    frames_per_s: float = 10.0
    open_timeout_s: float = 30.0
    silence_s: float = 1.5


@dataclass(frozen=True, slots=True)
class Grab:
    """Send the first picture no part of which was exposed before `not_before_ns`."""

    number: int
    not_before_ns: int


@dataclass(frozen=True, slots=True)
class Ready:
    """The device runs."""


@dataclass(frozen=True, slots=True)
class Beat:
    """The child lives and still waits for a picture it owes."""


@dataclass(frozen=True, slots=True)
class Picture:
    """The picture that was asked for with this number."""

    number: int
    image: "CameraImage"


@dataclass(frozen=True, slots=True)
class Farewell:
    """Why the child ends."""

    text: str


Answer = Ready | Beat | Picture | Farewell
