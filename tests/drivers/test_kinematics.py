import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from drivers import kinematics
from drivers.errors import UnreachableError

angles = st.one_of(
    st.floats(-2 * math.pi, 2 * math.pi),
    st.sampled_from([k * math.pi / 2 for k in range(-4, 5)]),
)
postures = st.tuples(*[angles] * 6).map(np.array)


@given(postures)
def test_the_flange_is_where_the_chain_of_links_ends(joints):
    flange = kinematics.forward(joints)
    assert flange[:3, 3] == pytest.approx(kinematics.joint_origins(joints[None])[0, 5], abs=1e-12)
    assert flange[:3, :3] @ flange[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)


def test_the_stretched_arm_is_as_long_as_the_data_sheet_says():
    flange = kinematics.forward([0.0] * 6)
    assert flange[:3, 3] == pytest.approx([-0.81725, -0.19145, -0.005491], abs=1e-9)


@given(postures, st.floats(-0.3, 0.3))
@example(np.array([1.0, math.pi / 2, math.pi, math.pi / 2, 0.0, 0.0]), 0.0)
def test_every_posture_is_found_again_from_nearby(joints, offset_rad):
    near = np.append(joints[:5] + offset_rad, joints[5])
    pose = kinematics.forward(joints)
    found = kinematics.inverse(pose, near)
    assert kinematics.forward(found) == pytest.approx(pose, abs=1e-7)
    assert kinematics.within_limits(found)


@given(st.tuples(*[st.floats(0.3, 1.2)] * 6).map(np.array), st.sampled_from([-1, 1]))
def test_away_from_singularities_the_nearest_solution_is_the_posture_itself(joints, sign):
    joints = joints * sign + [0.0, 0.0, 0.0, 2 * math.pi * -sign, 0.0, 2 * math.pi * -sign]
    found = kinematics.inverse(kinematics.forward(joints), joints + 0.05)
    assert found == pytest.approx(joints, abs=1e-7)


@pytest.mark.parametrize("place", [(1.2, 0.0, 0.0), (0.0, 0.05, 0.4)])
def test_there_are_no_joints_beyond_reach_or_inside_the_column(place):
    pose = np.eye(4)
    pose[:3, 3] = place
    pose[2, 3] += 0.0823
    assert kinematics.inverse(pose, np.zeros(6)) is None


@given(st.tuples(*[st.floats(-1, 1)] * 3), st.floats(0, math.pi))
def test_rotation_vectors_survive_the_way_there_and_back(axis, angle_rad):
    length = np.linalg.norm(axis)
    vector = np.array(axis) / length * angle_rad if length > 1e-3 else np.array([angle_rad, 0, 0])
    rotation = kinematics.rotation_from_vector(vector)
    again = kinematics.rotation_from_vector(kinematics.rotation_vector(rotation))
    assert again == pytest.approx(rotation, abs=1e-9)


def test_a_straight_path_is_straight_and_turns_evenly():
    start_joints = np.array([0.2, -1.4, 1.6, -1.5, -1.4, 0.3])
    start = kinematics.forward(start_joints)
    pose = np.add(kinematics.pose_from_transform(start), [0.1, -0.2, 0.1, 0.3, 0.0, 0.1])
    end = kinematics.transform_from_pose(pose)
    joints = kinematics.straight_joints(start, end, start_joints)

    assert joints[0] == pytest.approx(start_joints, abs=1e-9)
    assert kinematics.forward(joints[-1]) == pytest.approx(end, abs=1e-9)
    for index, fraction in enumerate(np.linspace(0, 1, len(joints))):
        wanted = kinematics.interpolate(start, end, float(fraction))
        assert kinematics.forward(joints[index]) == pytest.approx(wanted, abs=1e-9)
    assert np.abs(np.diff(joints, axis=0)).max() < 0.2


def test_there_is_no_straight_path_through_the_column():
    joints = np.array([0.0, -1.5, 1.6, -1.6, -1.5, 0.0])
    start = kinematics.forward(joints)
    end = start.copy()
    end[:2, 3] *= -1
    assert kinematics.inverse(end, joints) is not None
    with pytest.raises(UnreachableError, match="straight line to"):
        kinematics.straight_joints(start, end, joints)


def tilted_about(joints, axis, angle_rad):
    pose = kinematics.forward(joints)
    turn = kinematics.rotation_from_vector(angle_rad * np.asarray(axis))
    pose[:3, :3] = pose[:3, :3] @ turn
    return pose


@pytest.mark.parametrize("beside_rad", [0.0, 1e-6, 1e-3])
@pytest.mark.parametrize("shift_m", [0.0, 0.1])
def test_there_is_no_straight_path_through_a_straight_wrist(beside_rad, shift_m):
    """Not even where the samples lie to both sides of it."""
    joints = np.array([0.2, -1.4, 1.6, -1.5, 0.3, 0.0])
    end = tilted_about(joints, [-beside_rad, 1.0, 0.0], 0.55)
    end[2, 3] += shift_m
    assert kinematics.inverse(end, joints) is not None
    with pytest.raises(UnreachableError, match="passes a singularity"):
        kinematics.straight_joints(kinematics.forward(joints), end, joints)


def test_a_straight_path_is_sampled_finely_where_joints_turn_fast():
    joints = np.array([0.2, -1.4, 1.6, -1.5, 0.25, 0.0])
    start, end = kinematics.forward(joints), tilted_about(joints, [1.0, 0.0, 0.0], 0.8)
    path = kinematics.straight_joints(start, end, joints)
    assert np.abs(np.diff(path, axis=0)).max() <= 0.1
    places = [kinematics.forward(joints)[:3, 3] for joints in path]
    np.testing.assert_allclose(places, np.tile(start[:3, 3], (len(path), 1)), atol=1e-9)
