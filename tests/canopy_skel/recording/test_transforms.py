"""Poses between frames at a time."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from canopy_skel.geometry import invert, is_rigid, transform_from
from canopy_skel.messages import StampedTransform
from canopy_skel.recording.transforms import TransformBuffer

MS = 1_000_000
numbers = st.floats(-3, 3)
vectors = st.tuples(numbers, numbers, numbers)
quaternions = st.tuples(numbers, numbers, numbers, numbers).filter(
    lambda q: np.linalg.norm(q) > 0.1
)


@st.composite
def poses(draw, parent="base", child="tool0", stamp_ns=0):
    return StampedTransform(
        stamp_ns=stamp_ns,
        parent=parent,
        child=child,
        translation_m=draw(vectors),
        quaternion_xyzw=draw(quaternions),
    )


def matrix(pose: StampedTransform) -> np.ndarray:
    return transform_from(Rotation.from_quat(pose.quaternion_xyzw).as_matrix(), pose.translation_m)


def buffer(*moving: StampedTransform, static=(), gap_ms=100) -> TransformBuffer:
    return TransformBuffer(moving, static, tool_frame="tool0", max_gap_ns=gap_ms * MS)


@given(poses(stamp_ns=0), poses(stamp_ns=100 * MS), st.integers(0, 100 * MS))
def test_between_two_poses_the_body_stays_rigid_and_turns_evenly(first, last, stamp_ns):
    pose = buffer(first, last).lookup("base", "tool0", stamp_ns)

    share = stamp_ns / (100 * MS)
    assert is_rigid(pose)
    one, other = matrix(first), matrix(last)
    np.testing.assert_allclose(
        pose[:3, 3], (1 - share) * one[:3, 3] + share * other[:3, 3], atol=1e-9
    )
    whole = Rotation.from_matrix(one[:3, :3].T @ other[:3, :3]).magnitude()
    part = Rotation.from_matrix(one[:3, :3].T @ pose[:3, :3]).magnitude()
    assert part == pytest.approx(share * whole, abs=1e-6)


@given(poses(), poses(), st.integers(-10 * MS, 10 * MS))
def test_an_exact_stamp_gives_exactly_that_pose(one, other, offset):
    late = replace(other, stamp_ns=offset)
    poses_there = (one, late) if offset else (one,)
    found = buffer(*poses_there).lookup("base", "tool0", 0)
    np.testing.assert_allclose(found, matrix(one), atol=1e-12)


@given(
    poses("base_link", "base"),
    poses("base_link", "arm"),
    poses("arm", "tool0"),
    poses("tool0", "mount"),
    poses("eye", "mount"),
)
def test_chains_may_be_published_in_either_direction(back, arm, tool, mount, eye):
    frames = buffer(arm, tool, mount, eye, static=[back])

    found = frames.lookup("base", "eye", 0)
    expected = (
        invert(matrix(back)) @ matrix(arm) @ matrix(tool) @ matrix(mount) @ invert(matrix(eye))
    )
    np.testing.assert_allclose(found, expected, atol=1e-9)
    np.testing.assert_allclose(frames.lookup("eye", "base", 0), invert(expected), atol=1e-9)


def pose(stamp_ms: float, x: float = 0.0, parent="base", child="tool0") -> StampedTransform:
    return StampedTransform(
        stamp_ns=int(stamp_ms * MS),
        parent=parent,
        child=child,
        translation_m=(x, 0.0, 0.0),
        quaternion_xyzw=(0.0, 0.0, 0.0, 1.0),
    )


def x_of(frames: TransformBuffer, source: str, stamp_ms: float) -> float:
    return float(frames.lookup("base", source, int(stamp_ms * MS))[0, 3])


@pytest.mark.parametrize("stamp_ms", [-1, 50, 301])
def test_a_moving_edge_is_never_extrapolated_nor_bridged_far(stamp_ms):
    frames = buffer(pose(0, 1), pose(101, 2), pose(201, 3), pose(300, 4))
    assert x_of(frames, "tool0", 250.5) == pytest.approx(3.5)
    with pytest.raises(ValueError, match="no pose base -> tool0 at the exposure"):
        frames.lookup("base", "tool0", stamp_ms * MS)


def test_what_is_mounted_on_the_tool_holds_until_it_is_remounted():
    frames = buffer(
        *(pose(t, 0) for t in (0, 50, 500, 1000)),
        pose(10, 7, "tool0", "eye"),
        pose(600, 8, "tool0", "eye"),
    )
    assert [x_of(frames, "eye", t) for t in (0, 50, 500, 1000)] == [7, 7, 7, 8]


def test_static_edges_hold_at_any_time():
    frames = buffer(pose(900, 1), static=[pose(5000, 2, "world", "base")])
    assert frames.lookup("world", "tool0", 900 * MS)[0, 3] == 3


def test_an_arm_pose_published_once_is_not_taken_for_static():
    frames = buffer(pose(0, 1), pose(0, 2, "tool0", "eye"))
    assert x_of(frames, "eye", 0) == 3
    with pytest.raises(ValueError, match=r"nearest is 1500\.0 ms away"):
        frames.lookup("base", "eye", 1500 * MS)


def test_unconnected_frames_are_named():
    with pytest.raises(ValueError, match=r"from 'base' to 'eye' \(frames there: base, tool0\)"):
        buffer(pose(0)).lookup("base", "eye", 0)


def test_a_frame_in_itself_is_the_identity():
    np.testing.assert_array_equal(buffer().lookup("base", "base", 5), np.eye(4))


stamps = st.integers(0, 8).map(lambda tick: 50 * MS * tick)


@given(
    st.lists(stamps.flatmap(lambda stamp: poses(stamp_ns=stamp)), max_size=4),
    st.lists(stamps.flatmap(lambda s: poses("tool0", "camera", stamp_ns=s)), max_size=4),
    st.lists(stamps.flatmap(lambda s: poses("camera", "eye", stamp_ns=s)), max_size=2),
    st.integers(0, 450 * MS),
)
def test_what_lies_around_a_time_is_all_that_a_lookup_needs(arm, mount, eye, stamp_ns):
    whole = buffer(*arm, *mount, static=eye)
    around = buffer(*whole.around(stamp_ns))
    assert len(whole.around(stamp_ns)) <= 5
    for target, source in (("base", "camera"), ("eye", "base"), ("base", "tool0")):
        assert found(around, target, source, stamp_ns) == found(whole, target, source, stamp_ns)


def found(transforms, target, source, stamp_ns):
    try:
        return transforms.lookup(target, source, stamp_ns).tolist()
    except ValueError:
        return None
