"""Recordings from elsewhere, kept by the rig beside its own."""

from pathlib import Path

import numpy as np
import pytest
from fake_rig import DEMO_RECORDING

from drivers.guarded_arm import Limits
from service.local_rig import LocalRig
from service.rig import NoRoomError
from service.rig_parts import RigParts

LIMITS = Limits(box_min_m=(-1.0, -1.0, -1.0), box_max_m=(1.0, 1.0, 1.0))


@pytest.fixture
def rig(tmp_path):
    parts = RigParts(
        arm=None,
        camera=None,
        limits=LIMITS,
        tool_from_camera=np.eye(4),
        feed=None,
        data=tmp_path / "data",
    )
    return LocalRig(parts)


def no_links(self, target):
    raise OSError("no links here")


@pytest.mark.parametrize("linked", [True, False])
def test_it_stays_when_the_original_goes(rig, tmp_path, monkeypatch, linked):
    if not linked:
        monkeypatch.setattr(Path, "hardlink_to", no_links)
    original = tmp_path / "a.mcap"
    original.write_bytes(DEMO_RECORDING.read_bytes())
    rig.adopt("replay-1", original)
    assert (original.stat().st_nlink == 2) is linked
    original.unlink()
    assert rig.recording_path("replay-1").read_bytes() == DEMO_RECORDING.read_bytes()
    assert [file.name for file in rig.recording_path("replay-1").parent.iterdir()] == [
        "replay-1.mcap"
    ]


def test_nothing_is_left_of_one_that_does_not_fit(rig, tmp_path, monkeypatch):
    def full(source, target):
        Path(target).write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "hardlink_to", no_links)
    monkeypatch.setattr("shutil.copyfile", full)
    with pytest.raises(NoRoomError, match=r"No space left on device.*make room"):
        rig.adopt("replay-1", DEMO_RECORDING)
    assert list((tmp_path / "data/scans").iterdir()) == []
