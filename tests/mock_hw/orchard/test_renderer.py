from dataclasses import replace

import numpy as np
import pytest

from canopy_skel.geometry import invert, transform_from, transform_points
from mock_hw.orchard import renderer
from mock_hw.orchard.light import any_weather, fair_weather
from mock_hw.orchard.mesh import Kind
from mock_hw.orchard.path import camera_path, look_at
from mock_hw.orchard.presets import OAK
from mock_hw.orchard.scene import build_scene
from mock_hw.orchard.tree import GROUND_Z_M, grow

POSE = camera_path(10)[2]


def nearest_hit(mesh, eye, ray):
    """Möller & Trumbore on all triangles; t along an unnormalised ray, or inf."""
    a, b, c = (mesh.points[mesh.triangles[:, k]] for k in range(3))
    edge1, edge2 = b - a, c - a
    p = np.cross(ray, edge2)
    det = np.sum(edge1 * p, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = eye - a
        u = np.sum(s * p, axis=1) / det
        q = np.cross(s, edge1)
        v = q @ ray / det
        t = np.sum(edge2 * q, axis=1) / det
        inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    return np.where(inside & (det != 0), t, np.inf).min()


def test_depth_agrees_with_rays_cast_at_triangles(apple_scene, small, rng):
    mesh = apple_scene.mesh
    picture = renderer.draw(mesh, POSE, small)
    on_mesh = np.argwhere(picture.triangle >= 0)
    anywhere = np.argwhere(picture.triangle < 0)
    pixels = np.concatenate([rng.choice(on_mesh, 120), rng.choice(anywhere, 30)])
    for v, u in pixels:
        ray = POSE[:3, :3] @ [(u - small.cx_px) / small.fx_px, (v - small.cy_px) / small.fy_px, 1]
        expected = nearest_hit(mesh, POSE[:3, 3], ray)
        if ray[2] < 0:
            expected = min(expected, (GROUND_Z_M - POSE[2, 3]) / ray[2])
        assert picture.depth_m[v, u] == pytest.approx(expected, rel=1e-6)


def test_wood_pixels_lie_on_the_vertex_they_name(apple_scene, apple, small):
    picture = renderer.draw(apple_scene.mesh, POSE, small)
    v, u = np.nonzero(picture.vertex >= 0)
    assert len(v) > 500
    vertex = picture.vertex[v, u]
    points = transform_points(invert(POSE), apple.position)
    away = np.linalg.norm(small.project(points)[vertex] - np.stack([u, v], axis=1), axis=1)
    reach = (1.2 * apple.radius_m[vertex] + 0.006) * small.fx_px / points[vertex, 2] + 0.6
    assert (away < reach).all()
    surface = small.back_project(u.astype(float), v.astype(float), picture.depth_m[v, u])
    gap = np.linalg.norm(surface - points[vertex], axis=1)
    assert (gap < 1.25 * apple.radius_m[vertex] + 0.008).all()


def test_kinds_are_where_they_belong(apple_scene, small):
    picture = renderer.draw(apple_scene.mesh, POSE, small)
    assert np.array_equal(picture.kind == Kind.WOOD, picture.vertex >= 0)
    assert np.array_equal(picture.kind == Kind.SKY, np.isinf(picture.depth_m))
    seen = set(np.unique(picture.kind))
    assert {Kind.SKY, Kind.GROUND, Kind.WOOD, Kind.LEAF, Kind.FRUIT, Kind.WIRE} <= seen


def test_neighbour_rows_are_drawn_but_not_labelled(apple, small):
    scene = build_scene(apple, 50, fair_weather(), seed=0, rows=True, trellis=False)
    picture = renderer.draw(scene.mesh, POSE, small)
    far = np.isin(picture.kind, [Kind.FAR_WOOD, Kind.FAR_LEAF])
    assert far.mean() > 0.02
    assert (picture.vertex[far] == -1).all()
    assert picture.depth_m[far].min() > 2.0


def test_the_picture_has_the_colours_of_an_orchard(apple_scene, small, rng):
    picture = renderer.draw(apple_scene.mesh, POSE, small)
    image = renderer.develop(
        renderer.radiance(apple_scene, picture, POSE, small), apple_scene, rng
    ).astype(float)
    leaf, wood, sky = (
        image[picture.kind == kind].mean(axis=0) for kind in (Kind.LEAF, Kind.WOOD, Kind.SKY)
    )
    assert leaf[1] > 1.1 * leaf[0] > 1.2 * leaf[2] or leaf[1] > 1.1 * max(leaf[0], leaf[2])
    assert wood[0] > wood[2]
    assert sky[2] > sky[0]
    assert image[picture.kind == Kind.WOOD].std() > 8


def test_bark_is_locked_to_the_wood_not_to_the_image(small):
    scene = build_scene(grow(OAK, 0), 0, fair_weather(), seed=0, rows=False, trellis=False)
    first = look_at([0.9, 0.0, -0.5], [1.7, 0.0, -0.5])
    second = first @ transform_from(np.eye(3), [0.06, 0.02, 0.0])
    pictures = [renderer.draw(scene.mesh, pose, small) for pose in (first, second)]
    images = [
        renderer.radiance(scene, picture, pose, small)[..., 1]
        for picture, pose in zip(pictures, (first, second), strict=True)
    ]
    v, u = np.nonzero(pictures[0].kind == Kind.WOOD)
    points = small.back_project(u.astype(float), v.astype(float), pictures[0].depth_m[v, u])
    moved = transform_points(invert(second) @ first, points)
    there = np.rint(small.project(moved)).astype(int)
    inside = (there >= 0).all(axis=1) & (there[:, 0] < 320) & (there[:, 1] < 200)
    v, u, there, moved = v[inside], u[inside], there[inside], moved[inside]
    same = np.abs(pictures[1].depth_m[there[:, 1], there[:, 0]] - moved[:, 2]) < 0.004
    a, b = images[0][v, u][same], images[1][there[same, 1], there[same, 0]]
    still = images[1][v[same], u[same]]
    assert np.corrcoef(a, b)[0, 1] > 0.75
    assert np.corrcoef(a, b)[0, 1] > np.corrcoef(a, still)[0, 1] + 0.2


def test_shadow_and_weather_change_the_picture_but_not_depth(apple, small):
    lights = [fair_weather(), any_weather(np.random.default_rng(3))]
    scenes = [build_scene(apple, 80, light, seed=0, rows=False, trellis=False) for light in lights]
    pictures = [renderer.draw(scene.mesh, POSE, small) for scene in scenes]
    assert pictures[0].depth_m.tobytes() == pictures[1].depth_m.tobytes()
    bright, dull = (
        renderer.radiance(scene, picture, POSE, small)
        for scene, picture in zip(scenes, pictures, strict=True)
    )
    assert np.abs(bright - dull).mean() > 0.02
    assert np.isfinite(bright).all()
    assert np.isfinite(dull).all()


def test_trees_cast_shadows(apple, small):
    scene = build_scene(apple, 900, fair_weather(), seed=0, rows=False, trellis=False)
    no_shadow = replace(scene.sun_map, w=np.zeros_like(scene.sun_map.w))
    picture = renderer.draw(scene.mesh, POSE, small)
    dark, bright = (
        renderer.radiance(each, picture, POSE, small)[..., 1]
        for each in (scene, replace(scene, sun_map=no_shadow))
    )
    tree = np.isin(picture.kind, [Kind.WOOD, Kind.LEAF])
    assert (dark <= bright + 1e-6).all()
    assert (dark[tree] < 0.8 * bright[tree]).mean() > 0.1
    assert (dark[tree] > 0.99 * bright[tree]).mean() > 0.1, "no surface shadows itself"


def test_points_behind_the_camera_do_no_harm(apple_scene, small):
    inside = look_at([1.75, 0.05, 0.1], [3.0, 0.0, 0.1])
    picture = renderer.draw(apple_scene.mesh, inside, small)
    assert picture.depth_m.min() >= renderer.NEAR_M
