"""A calibration is what its lists say, with R turned into the rotation it means."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from canopy_skel.calibration import calibration_from_lists

K = [500.0, 0, 320, 0, 501, 240, 0, 0, 1]


def read(r, p=()):
    return calibration_from_lists(
        stamp_ns=1, frame_id="eye", size=(640, 480), model="plumb_bob", d=[0.1], k=K, r=r, p=p
    )


@given(st.integers(0, 2**32), st.integers(4, 17))
def test_a_rounded_rotation_becomes_one(seed, decimals):
    rotation = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    found = read(np.round(rotation, decimals).ravel().tolist()).r
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(found, rotation, atol=2 * 10.0**-decimals + 1e-14)


def test_missing_r_and_p_are_those_of_a_camera_alone():
    for r, p in (([], []), ([0.0] * 9, [0.0] * 12)):
        found = read(r, p)
        np.testing.assert_array_equal(found.r, np.eye(3))
        np.testing.assert_array_equal(found.p, np.column_stack([found.k, np.zeros(3)]))


def test_the_identity_stays_exact():
    np.testing.assert_array_equal(read(np.eye(3).ravel().tolist()).r, np.eye(3))
