import cv2
import numpy as np
import pytest

from canopy_skel.document import Method, build_document
from canopy_skel.exports.overlay import draw_overlay
from canopy_skel.exports.palette import OBSERVED_RGB, OCCLUDED_RGB
from canopy_skel.frame import Intrinsics, View
from canopy_skel.geometry import rotation_from_quaternion, transform_from
from canopy_skel.graph import SkeletonGraph

# A camera at (0.2, 0.1, 0.3) that looks along base x, its image's x along -y, its y along -z.
BASE_FROM_CAMERA = transform_from(
    np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), [0.2, 0.1, 0.3]
)


def view(width=640, height=480, base_from_camera=BASE_FROM_CAMERA) -> View:
    rng = np.random.default_rng(0)
    return View(
        index=3,
        stamp_ns=0,
        color_rgb=rng.integers(0, 256, (height, width, 3), dtype=np.uint8),
        intrinsics=Intrinsics(
            fx_px=0.8 * width,
            fy_px=0.8 * width,
            cx_px=width / 2,
            cy_px=height / 2,
            width_px=width,
            height_px=height,
        ),
        base_from_camera=base_from_camera,
    )


def document(points, edges=None, radius=0.005, occluded=()):
    points = np.array(points, dtype=np.float64).reshape(-1, 3)
    n = len(points)
    edges = [(i, i + 1) for i in range(n - 1)] if edges is None else edges
    return build_document(
        SkeletonGraph(
            vertices_in_base=points,
            edges=np.array(edges, dtype=np.int64).reshape(-1, 2),
            radius_m=np.full(n, radius),
            occluded=np.isin(np.arange(n), occluded),
            confidence=np.ones(n),
        ),
        scan_id="Reihe 3 – Baum ü",
        revision=1,
        method=Method(name="test"),
        views_used=1,
    )


def pixels(seen: View, points) -> np.ndarray:
    """Return where OpenCV says points of the base frame are."""
    camera_from_base = np.linalg.inv(seen.base_from_camera)
    k = seen.intrinsics
    matrix = np.array([[k.fx_px, 0, k.cx_px], [0, k.fy_px, k.cy_px], [0, 0, 1]])
    turn = cv2.Rodrigues(camera_from_base[:3, :3])[0]
    points = np.array(points, dtype=np.float64).reshape(-1, 3)
    return cv2.projectPoints(points, turn, camera_from_base[:3, 3], matrix, None)[0].reshape(-1, 2)


def is_color(image, color):
    return (np.abs(image.astype(int) - color) <= 2).all(axis=2)


def outside_legend(image):
    """Return the image without its lower 120 rows, where the legend is."""
    return image[:-120]


def upright(y=0.1, x=1.2, count=21):
    return np.column_stack([np.full(count, x), np.full(count, y), np.linspace(0.15, 0.65, count)])


def test_lines_lie_where_the_wood_is():
    turn = rotation_from_quaternion([0.5, -0.45, 0.5, -0.55])
    seen = view(base_from_camera=transform_from(turn, [0.2, 0.1, 0.3]))
    ahead = turn @ [0, 0, 1.0] + [0.2, 0.1, 0.3]
    points = [ahead + turn @ [-0.1, -0.2, 0], ahead + turn @ [0.15, 0.1, 0]]
    image = draw_overlay(seen, document(points))
    for share in (0.2, 0.5, 0.8):
        here = points[0] + share * (points[1] - points[0])
        u, v = np.round(pixels(seen, here)[0]).astype(int)
        assert is_color(image, OBSERVED_RGB)[v, u]


def test_observed_wood_is_solid_and_occluded_wood_dashed():
    seen = view()
    half = upright()
    image = draw_overlay(seen, document(half, occluded=range(11, 21)))
    column = np.round(pixels(seen, half)).astype(int)
    u = column[0, 0]
    solid = slice(column[9, 1], column[1, 1])
    dashes = slice(column[20, 1], column[11, 1])
    assert is_color(image, OBSERVED_RGB)[solid, u].all()
    vermillion = is_color(image, OCCLUDED_RGB)[dashes, u]
    assert not is_color(image, OBSERVED_RGB)[dashes, u].any()
    assert 0.2 < vermillion.mean() < 0.9
    gaps = np.count_nonzero(np.diff(vermillion.astype(int)) == 1)
    assert gaps >= 4
    # In the gaps the picture shows, not the line's outline.
    assert (image[dashes, u].max(axis=1) > 60).mean() > 0.9


def test_dashes_go_on_evenly_over_many_short_edges():
    seen = view()
    long = draw_overlay(seen, document(upright(count=2), occluded=[0, 1]))
    short = draw_overlay(seen, document(upright(count=201), occluded=range(201)))
    u = round(pixels(seen, upright())[0, 0])
    on_long, on_short = (is_color(image, OCCLUDED_RGB)[:-120, u] for image in (long, short))
    assert on_long.sum() > 50
    assert (on_long != on_short).sum() <= 0.05 * on_long.sum()


def width_px(radius: float) -> int:
    seen = view()
    image = draw_overlay(seen, document(upright(), radius=radius))
    v = round(pixels(seen, upright())[10, 1])
    return int(is_color(image, OBSERVED_RGB)[v].sum())


def test_thick_wood_gets_a_thick_line_and_thin_wood_a_line_that_can_be_seen():
    assert 1 <= width_px(0.0) <= 3
    assert width_px(0.0) < width_px(0.008) < width_px(0.012)


def test_wood_behind_the_camera_is_not_drawn():
    image = draw_overlay(view(), document(upright(x=-1.0)))
    assert not is_color(outside_legend(image), OBSERVED_RGB).any()


def test_wood_that_passes_the_camera_is_cut_at_the_near_plane():
    seen = view()
    # From 1 m ahead to 1 m behind, 5 cm below the optical axis: it runs down out of the image.
    image = draw_overlay(seen, document([(1.2, 0.1, 0.25), (-0.8, 0.1, 0.25)]))
    (top,) = pixels(seen, [1.2, 0.1, 0.25])
    u, v = np.round(top).astype(int)
    blue = is_color(image, OBSERVED_RGB)
    assert blue[v + 30 : 340, u].all()
    assert not blue[: v - 10].any()


def test_wood_far_outside_the_image_leaves_no_trace():
    far = [(0.3, 50.0, 0.3), (0.26, -2000.0, 400.0)]
    image = draw_overlay(view(), document([*far, (0.3, 60.0, 0.3)], edges=[(0, 2), (1, 0)]))
    assert image.shape == (480, 640, 3)


def test_root_is_marked_with_a_ring():
    seen = view()
    points = upright()
    with_ring = draw_overlay(seen, document(points))
    u, v = np.round(pixels(seen, points[0])[0]).astype(int)
    ring = with_ring[v - 11 : v + 12, u - 11 : u + 12].min(axis=2)
    assert (ring > 240).sum() > 30
    assert (with_ring[100:150].min(axis=2) > 240).sum() == 0


def test_root_outside_the_image_is_pointed_at():
    seen = view()
    below = np.array([(1.2, 0.1, -0.6), (1.2, 0.1, 0.6)])
    image = draw_overlay(seen, document(below))
    u = round(pixels(seen, below)[0, 0])
    arrow = image[-40:, u - 12 : u + 13].min(axis=2) > 240
    assert arrow.sum() > 40


def test_legend_stands_in_the_corner_that_hides_least():
    seen = view()
    # A skeleton in the lower left of the image, where the legend would be otherwise.
    low = np.column_stack([np.full(9, 1.2), np.linspace(0.45, 0.6, 9), np.full(9, -0.05)])
    image = draw_overlay(seen, document(low))
    dark = image.mean(axis=2) < 60
    assert dark[-40:, -150:].mean() > 0.5
    assert dark[-40:, :60].mean() < 0.2


def test_picture_stays_what_it_was_and_is_paler_in_the_overlay():
    seen = view()
    before = seen.color_rgb.copy()
    image = draw_overlay(seen, document(upright()))
    assert np.array_equal(seen.color_rgb, before)
    assert (image.dtype, image.shape) == (np.uint8, before.shape)
    spread = np.ptp(outside_legend(image)[:, :200].astype(int), axis=2).mean()
    assert spread < 0.5 * np.ptp(before[:-120, :200].astype(int), axis=2).mean()
    assert np.array_equal(image, draw_overlay(seen, document(upright())))


@pytest.mark.parametrize("points", [[], [(1.2, 0.1, 0.3)]], ids=["empty", "one vertex"])
def test_nothing_to_draw_is_a_picture_with_a_legend(points):
    image = draw_overlay(view(), document(points))
    assert not is_color(outside_legend(image), OBSERVED_RGB).any()
    assert (image[-100:] > 240).any()


def test_a_tiny_picture_is_no_trouble():
    assert draw_overlay(view(64, 48), document(upright())).shape == (48, 64, 3)
