"""Lens, anti-aliasing, shadows, culling, film and the smooth image, each against a known answer."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.world.photometric import augment, neutral
from whill_mjx.world.render import FIRST_BOX, Quality, camera_rotation, look_at, pinhole, render, render_frame
from whill_mjx.world.render.camera import distort, undistort
from whill_mjx.world.render.film import develop, motion_blur, plain_film
from whill_mjx.world.render.soft import render_soft
from whill_mjx.world.scene import Marker, Scene, box, default_looks, no_boxes, stack_boxes
from whill_mjx.world.solids import Solids, person

EYE = jnp.array([0.0, 0.0, 1.0])
LEVEL = camera_rotation(0.0)
K = jnp.array([-0.25, 0.06, 0.001, -0.002, 0.01])
RED = jnp.array([1.0, 0.0, 0.0])


def scene_of(*boxes, **more):
    marker = Marker(jnp.array([-9.0, 0.0, 1.0]), jnp.full(3, 0.1), jnp.zeros(()), jnp.zeros(3))
    return Scene(stack_boxes(list(boxes)) if boxes else no_boxes(1), marker, default_looks(), **more)


@pytest.mark.quick
def test_camera_rotation_is_right_handed_and_looks_where_it_is_told():
    turn = camera_rotation(0.3, 0.2, 0.1)
    np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-6)
    assert np.linalg.det(turn) == pytest.approx(1.0, abs=1e-5)
    np.testing.assert_allclose(LEVEL, [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-7)
    target = jnp.array([2.0, 1.0, 0.5])
    way = (target - EYE) / jnp.linalg.norm(target - EYE)
    np.testing.assert_allclose(look_at(EYE, target, 0.4)[:, 2], way, atol=1e-6)


@pytest.mark.quick
def test_distortion_is_that_of_opencv_and_is_undone():
    cv2 = pytest.importorskip("cv2")
    u, v = jnp.meshgrid(jnp.linspace(-0.6, 0.6, 7), jnp.linspace(-0.6, 0.6, 7))
    bent = distort(u, v, K)
    points = np.stack([u, v, np.ones_like(u)], -1).reshape(-1, 1, 3).astype(np.float64)
    reference, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.asarray(K, np.float64))
    np.testing.assert_allclose(np.stack(bent, -1).reshape(-1, 2), reference[:, 0], atol=1e-6)
    np.testing.assert_allclose(np.stack(undistort(*bent, K)), np.stack([u, v]), atol=2e-3)


def test_a_distorted_image_shows_things_where_the_lens_maps_them():
    lens = pinhole(1.2)
    bent = dataclasses.replace(lens, distortion=K)
    scene = scene_of(box(4.0, 2.2, 0.2, 0.2, 3.0, RED))
    draw = jax.jit(lambda i: render_frame(EYE, LEVEL, i, scene).label == FIRST_BOX)
    straight, curved = (np.argwhere(np.asarray(draw(i))[32])[:, 0].mean() + 0.5 for i in (lens, bent))
    u = (straight - 32) / float(lens.fx)
    assert curved == pytest.approx(float(distort(u, 0.0, K)[0] * lens.fx + 32), abs=0.6) and curved - straight > 0.5


def test_edges_blend_by_coverage_and_one_colour_stays():
    scene = scene_of(box(3.0, 0.0, 1.0, 1.03, 5.0, RED))
    hard, soft = (
        np.asarray(jax.jit(lambda q=q: render(EYE, LEVEL, pinhole(1.2), scene, quality=q))()).astype(int)
        for q in (Quality(), Quality(antialias=True))
    )
    levels = np.unique(soft[20, 16:48, 1])
    assert (np.abs(hard - soft).max(-1) > 8).mean() < 0.15
    assert len(levels[(levels > soft[20, 32, 1] + 20) & (levels < soft[20, 20, 1] - 10)]) >= 1  # a mixed pixel


def test_a_box_throws_its_shadow_away_from_the_sun():
    sun = jnp.array([0.0, 0.6, 0.8])  # from the left: the shadow falls to the right
    looks = dataclasses.replace(default_looks(), sun=sun, noise=jnp.array(0.0), ground=jnp.full((2, 3), 0.5))
    scene = dataclasses.replace(scene_of(box(3.0, 0.0, 0.5, 0.5, 1.0, RED)), looks=looks)
    dark, light = (
        np.asarray(jax.jit(lambda q=q: render(EYE, LEVEL, pinhole(1.2), scene, quality=q))()).astype(int).sum(-1)
        for q in (Quality(shadows=True), Quality())
    )
    below = pinhole(1.2)
    # The ground point (3, y) is seen at column 32 - fx y / 3 and row 32 + fy / 3; the shadow reaches y = -1.
    row = int(32 + float(below.fy) / 3)
    column = [int(32 - float(below.fx) * y / 3) for y in (-0.6, 0.6)]
    assert dark[row, column[0]] < 0.8 * light[row, column[0]] and dark[row, column[1]] == light[row, column[1]]


def test_strips_that_keep_enough_boxes_change_nothing():
    rng = np.random.default_rng(0)
    boxes = [box(x, y, 0.3, 0.3, 1.2, jnp.array(c)) for (x, y), c in zip(rng.uniform((1.5, -3), (8, 3), (40, 2)),
                                                                          rng.uniform(0, 1, (40, 3)), strict=True)]
    scene = scene_of(*boxes)
    full, kept = (np.asarray(jax.jit(lambda s, q=q: render(EYE, LEVEL, pinhole(1.2), s, quality=q))(scene))
                  for q in (Quality(), Quality(keep=20)))
    assert full.std() > 20 and (full != kept).any(-1).sum() <= 4  # rays that graze an edge may fall to either side


@pytest.mark.parametrize("height, width", [(1, 1), (7, 40), (200, 96), (1024, 1024)])
def test_every_size_and_zero_boxes_give_an_image(height, width):
    scene = dataclasses.replace(scene_of(), boxes=no_boxes(0))
    image = jax.jit(lambda s: render(EYE, LEVEL, pinhole(1.2, height, width), s))(scene)
    assert image.shape == (height, width, 3) and np.asarray(image).any()


def test_normals_and_labels_of_a_person_come_with_the_image():
    scene = scene_of(solids=Solids(rounds=person(3.0, 0.0)))
    draw = jax.jit(lambda s: render_frame(EYE, LEVEL, pinhole(1.2), s, normals=True))
    frame = draw(scene)
    body = np.asarray(frame.label) == FIRST_BOX + 2  # one unused box, then legs, trunk, head
    normal = np.asarray(frame.normal)[body]
    assert body.sum() > 20 and (normal @ np.array([1.0, 0.0, 0.0]) < 0.1).all()
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-2)


@pytest.mark.quick
def test_film_scales_light_and_the_plain_one_does_nothing():
    image = jnp.full((8, 8, 3), 100, jnp.uint8)
    np.testing.assert_array_equal(develop(image, plain_film()), image)
    film = dataclasses.replace(plain_film(), exposure=jnp.array(1.5), white_balance=jnp.array([1.0, 0.5, 1.0]))
    assert np.asarray(develop(image, film))[4, 4].tolist() == [150, 75, 150]
    corner = np.asarray(develop(image, dataclasses.replace(plain_film(), vignetting=jnp.array(0.5))))
    assert corner[0, 0, 0] < 65 < 98 < corner[4, 4, 0]


def test_motion_blur_is_the_mean_along_the_way():
    def draw(position, rotation):
        return jnp.full((2, 2, 3), 100.0 * position[0]).astype(jnp.uint8)

    image = motion_blur(draw, (jnp.zeros(3), jnp.eye(3)), (jnp.array([1.0, 0.0, 0.0]), jnp.eye(3)), samples=4)
    assert np.asarray(image).max() == np.asarray(image).min() == 50  # of 12, 37, 62 and 87: 49.5, to the even


@pytest.mark.quick
@pytest.mark.parametrize("saturation, brightness", [(0.8, 1.2), (1.2, 0.9)])
def test_brightness_and_saturation_are_those_of_opencv(saturation, brightness):
    cv2 = pytest.importorskip("cv2")
    image = np.random.default_rng(0).integers(40, 160, (8, 8, 3), np.uint8)
    change = dataclasses.replace(neutral(), saturation=jnp.array(saturation), brightness=jnp.array(brightness))
    bright = image.astype(np.float32) * brightness
    grey = cv2.cvtColor(bright, cv2.COLOR_RGB2GRAY)[..., None]
    expected = np.clip(np.round(grey + saturation * (bright - grey)), 0, 255)
    assert np.abs(np.asarray(augment(jnp.asarray(image), change, jax.random.key(0))) - expected).max() <= 1


def test_the_smooth_image_has_the_derivatives_of_finite_differences_and_finds_a_lost_pose():
    boxes = (box(3.0, 0.6, 0.4, 0.5, 0.7, RED, 0.5), box(4.0, -0.8, 0.4, 0.5, 0.9, jnp.array([0.2, 0.7, 0.2]), 0.3))
    scene = scene_of(*boxes)

    def image(x):
        return render_soft(x[:3], camera_rotation(x[3], x[4], x[5]), pinhole(1.2, 24, 24), scene)[0]

    truth = jnp.array([0.0, 0.0, 0.8, 0.05, 0.15, 0.0])  # no face is seen edge-on: there the image has a kink
    draw, slope = jax.jit(image), jax.jit(jax.jacfwd(image))
    derivative = np.asarray(slope(truth))
    for axis in range(6):
        step = jnp.zeros(6).at[axis].set(2e-4)
        numeric = np.asarray(draw(truth + step) - draw(truth - step)) / 4e-4
        error = np.abs(numeric - derivative[..., axis]).max(-1)
        assert np.linalg.norm(derivative[..., axis]) > 1.0
        assert (error > 0.02 * np.abs(numeric).max()).sum() <= 4  # of 576: pixels at corners, where the image has kinks
    pose, target = truth + jnp.array([0.04, -0.03, 0.02, 0.02, -0.02, 0.02]), draw(truth)
    for _ in range(6):
        residual, matrix = (draw(pose) - target).reshape(-1), slope(pose).reshape(-1, 6)
        pose = pose - jnp.linalg.solve(matrix.T @ matrix + 1e-3 * jnp.eye(6), matrix.T @ residual)
    np.testing.assert_allclose(pose, truth, atol=1e-4)
