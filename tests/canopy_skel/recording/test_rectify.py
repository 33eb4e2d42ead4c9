"""Whatever the lens, a View is a pinhole's, and its pose is that pinhole's."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from canopy_skel.calibration import Calibration
from canopy_skel.document import RejectedView
from canopy_skel.geometry import invert, transform_from, transform_points
from canopy_skel.messages import (
    encode_calibration,
    encode_compressed_image,
    encode_raw_image,
    encode_scores,
)
from canopy_skel.recording import TopicOptions, read_recording

FRAME = "camera_color_optical_frame"
SIZE = (320, 240)
K = np.array([[260.0, 0, 161], [0, 255.0, 118], [0, 0, 1]])
LENSES = {
    "plumb_bob": [-0.2, 0.06, 0.002, -0.003, 0.01],
    "rational_polynomial": [-0.2, 0.06, 0.002, -0.003, 0.01, 0.02, -0.01, 0.001],
    "kannala_brandt": [0.05, -0.02, 0.01, -0.004],
}
POINTS = np.array([[0.0, 0, 1], [0.3, -0.2, 1.2], [-0.4, 0.3, 1.5], [-0.3, -0.25, 1.1]])


def calibration(stamp_ns: int, model: str, **changes) -> Calibration:
    whole = Calibration(
        stamp_ns=stamp_ns,
        frame_id=FRAME,
        width_px=SIZE[0],
        height_px=SIZE[1],
        distortion_model=model,
        d=np.array(LENSES.get(model, [0.0] * 5)),
        k=K,
        r=np.eye(3),
        p=np.column_stack([K, np.zeros(3)]),
    )
    return replace(whole, **changes)


def project(points, c: Calibration) -> np.ndarray:
    """Project points of the raw camera's frame with its distortion."""
    if c.distortion_model == "kannala_brandt":
        uv, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), c.k, c.d)
    else:
        uv, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), c.k, c.d)
    return uv[:, 0]


def spots(uv, values, background, dtype) -> np.ndarray:
    """Draw a soft-edged disc per point."""
    picture = np.full(SIZE[::-1], background, dtype)
    for (u, v), value in zip(uv, values, strict=True):
        cv2.circle(picture, (round(u), round(v)), 4, value, -1)
    return picture


def centre(mask) -> np.ndarray:
    v, u = np.nonzero(mask)
    return np.array([u.mean(), v.mean()])


@pytest.fixture
def record(kit, tmp_path):
    """Write one view with the given pictures and calibrations and read it back."""

    def write(pictures, options=None):
        view = kit.views[0]
        messages = {"/tf": kit.messages_of(view)["/tf"]}
        template = messages["/tf"]
        for topic, data in pictures(view.stamp_ns).items():
            messages[topic] = replace(template, topic=topic, data=data)
        path = kit.write_raw(tmp_path / "a.mcap", messages.values())
        (found,) = read_recording(path, options).views()
        return found, view

    return write


@pytest.mark.parametrize("model", LENSES)
def test_colour_depth_and_instances_are_undistorted_alike(record, model):
    def pictures(stamp_ns):
        c = calibration(stamp_ns, model)
        uv = project(POINTS, c)
        ids = np.arange(1, len(POINTS) + 1)
        depth = spots(uv, [int(z * 1000) for z in POINTS[:, 2]], 5000, np.uint16)
        color = spots(uv, [255] * len(uv), 0, np.uint8)
        png = cv2.imencode(".png", cv2.merge([color] * 3))[1].tobytes()
        return {
            "/camera/color/image": encode_compressed_image(png, "png", stamp_ns, FRAME),
            "/camera/color/calibration": encode_calibration(c),
            "/camera/depth/image": encode_raw_image(depth, "16UC1", stamp_ns, FRAME),
            "/camera/branches/instances": encode_raw_image(
                spots(uv, ids.tolist(), 0, np.uint16), "16UC1", stamp_ns, FRAME
            ),
            "/camera/branches/scores": encode_scores([1.0] * len(ids)),
        }

    view, posed = record(pictures)

    assert view.intrinsics.fx_px == K[0, 0]
    np.testing.assert_allclose(view.base_from_camera, posed.base_from_camera, atol=1e-12)
    for i, uv in enumerate(view.intrinsics.project(POINTS), start=1):
        mask = view.instances == i
        np.testing.assert_allclose(centre(mask), uv, atol=0.8)
        u, v = np.rint(uv).astype(int)
        assert view.depth_m[v, u] == np.float32(POINTS[i - 1, 2])
        assert view.color_rgb[v, u].tolist() == [255, 255, 255]
    assert set(np.unique(view.depth_m[np.isfinite(view.depth_m)])) <= {
        *POINTS[:, 2].astype(np.float32),
        np.float32(5),
    }


def test_pictures_that_are_rectified_already_stay_and_use_p(record, kit):
    p = np.column_stack([np.diag([200.0, 200.0, 1.0]), np.zeros(3)])
    p[:2, 2] = 160, 120

    def pictures(stamp_ns):
        c = calibration(stamp_ns, "plumb_bob", p=p)
        mono = np.arange(SIZE[0] * SIZE[1], dtype=np.uint32).reshape(SIZE[::-1]).astype(np.uint8)
        return {
            "/camera/color/image": encode_compressed_image(
                cv2.imencode(".png", mono)[1].tobytes(), "png", stamp_ns, FRAME
            ),
            "/camera/color/calibration": encode_calibration(c),
            "/camera/depth/image": encode_raw_image(
                np.full(SIZE[::-1], 900, np.uint16), "16UC1", stamp_ns, FRAME
            ),
        }

    view, _ = record(pictures, TopicOptions(rectified=True))
    lens = view.intrinsics
    assert (lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px) == (200, 200, 160, 120)
    assert view.color_rgb[3, 5].tolist() == [(3 * SIZE[0] + 5) % 256] * 3
    assert np.isfinite(view.depth_m).all()


def test_a_raw_pair_is_rectified_and_its_pose_turned_along(record):
    """A point seen by two turned, distorting cameras comes back where it was."""
    right_from_left = transform_from(
        Rotation.from_euler("xyz", [1.0, -1.5, 2.0], degrees=True).as_matrix(),
        [-0.08, 0.002, 0.003],
    )
    d = np.array(LENSES["plumb_bob"])
    r1, r2, p1, p2, *_ = cv2.stereoRectify(
        K, d, K, d, SIZE, right_from_left[:3, :3], right_from_left[:3, 3:], alpha=0
    )
    points_in_left = np.array([[0.05, -0.03, 1.0], [-0.2, 0.1, 1.3], [0.1, 0.15, 0.9]])
    ids = [60, 120, 180]

    def pictures(stamp_ns):
        left = calibration(stamp_ns, "plumb_bob", r=r1, p=p1)
        right = calibration(stamp_ns, "plumb_bob", r=r2, p=p2)
        seen_left = spots(project(points_in_left, left), ids, 0, np.uint8)
        seen_right = spots(
            project(transform_points(right_from_left, points_in_left), right), ids, 0, np.uint8
        )
        return {
            "/camera/left/image": encode_raw_image(seen_left, "mono8", stamp_ns, FRAME),
            "/camera/left/calibration": encode_calibration(left),
            "/camera/right/image": encode_raw_image(seen_right, "mono8", stamp_ns, FRAME),
            "/camera/right/calibration": encode_calibration(right),
        }

    view, posed = record(pictures)

    pair = view.stereo
    assert pair.baseline_m == pytest.approx(np.linalg.norm(right_from_left[:3, 3]), rel=1e-6)
    np.testing.assert_array_equal(view.color_rgb[..., 0], pair.left_mono)
    in_base = transform_points(posed.base_from_camera, points_in_left)
    expected_left = transform_points(invert(view.base_from_camera), in_base)
    for i, expected in zip(ids, expected_left, strict=True):
        left = centre(np.abs(pair.left_mono.astype(int) - i) < 1)
        right = centre(np.abs(pair.right_mono.astype(int) - i) < 1)
        np.testing.assert_allclose(left, view.intrinsics.project(expected[None])[0], atol=0.8)
        assert left[1] == pytest.approx(right[1], abs=0.8)
        disparity_px = pair.intrinsics.fx_px * pair.baseline_m / expected[2]
        assert left[0] - right[0] == pytest.approx(disparity_px, abs=1.0)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"p": np.column_stack([K, np.zeros(3)])}, "P carries no baseline"),
        ({"k": np.diag([300.0, 255.0, 1.0])}, "left and right differ in K or size"),
    ],
)
def test_a_pair_that_is_none(kit, tmp_path, changes, text):
    reason = _reason(kit, tmp_path, right=changes)
    assert f"view 0: /camera/right/calibration: {text}" in reason


def test_an_unknown_lens(kit, tmp_path):
    reason = _reason(kit, tmp_path, left={"distortion_model": "fisheye62", "d": np.ones(6)})
    assert "view 0: /camera/left/calibration: distortion model 'fisheye62' with 6 coeff" in reason


def _reason(kit, tmp_path, left=None, right=None) -> str:
    """Return the reason of a view with these changed calibrations, next to a good view."""
    good, bad = kit.messages_of(kit.views[1]), kit.messages_of(kit.views[0])
    messages = [m for m in (*good.values(), *bad.values()) if "depth" not in m.topic]
    stamp_ns = kit.views[0].stamp_ns
    lens = kit.lens
    k = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1]])
    size = {"width_px": lens.width_px, "height_px": lens.height_px, "k": k}
    p = np.column_stack([k, [-4.5, 0, 0]])
    for side, changes in (("left", left), ("right", right)):
        if changes is not None:
            data = encode_calibration(calibration(stamp_ns, "", **{**size, "p": p, **changes}))
            messages = [
                replace(m, data=data)
                if (m.topic, m.sequence) == (f"/camera/{side}/calibration", 0)
                else m
                for m in messages
            ]
    first, _ = read_recording(kit.write_raw(tmp_path / "a.mcap", messages)).views()
    assert isinstance(first, RejectedView)
    return first.reason
