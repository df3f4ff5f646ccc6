"""The camera image against known answers and an independent ray caster."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.world.render import (
    FIRST_BOX,
    GROUND,
    MARKER,
    SKY,
    Quality,
    camera_rotation,
    image,
    pinhole,
    render,
    render_frame,
)
from whill_mjx.world.render.blocks import in_blocks
from whill_mjx.world.render.visibility import reciprocal
from whill_mjx.world.scene import Boxes, Marker, Scene, box, default_looks, no_boxes, stack_boxes
from whill_mjx.world.solids import Blocks, Rounds, Solids

EYE = jnp.array([0.0, 0.0, 1.0])
LEVEL = jnp.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # looks along +x
LENS = pinhole(1.2)
RED = jnp.array([1.0, 0.0, 0.0])
frame = jax.jit(render_frame)


def scene_of(*boxes, marker_x=-50.0):
    """Scene with these boxes; the marker is behind the camera unless placed."""
    half, blue = jnp.array([0.02, 0.3, 0.3]), jnp.array([0.0, 0.1, 0.9])
    marker = Marker(jnp.array([marker_x, 0.0, 1.0]), half, jnp.zeros(()), blue)
    return Scene(stack_boxes(list(boxes)) if boxes else no_boxes(1), marker, default_looks())


def random_scene(key, count=12):
    keys = jax.random.split(key, 4)
    place = jax.random.uniform(keys[0], (count, 2), minval=-2.5, maxval=2.5) + jnp.array([4.5, 0.0])
    half = jax.random.uniform(keys[1], (count, 3), minval=0.1, maxval=0.5)
    centre = jnp.concatenate([place, half[:, 2:]], 1)
    yaw = jax.random.uniform(keys[2], (count,), maxval=6.0)
    boxes = Boxes(centre, half, yaw, jax.random.uniform(keys[3], (count, 3)), jnp.ones(count, bool))
    return dataclasses.replace(scene_of(marker_x=6.0), boxes=boxes)


@pytest.mark.quick
def test_a_red_box_ahead_fills_the_centre_of_the_image():
    image = frame(EYE, LEVEL, LENS, scene_of(box(3.0, 0.0, 1.0, 1.0, 2.0, RED)))
    centre = np.asarray(image.rgb[28:36, 28:36]).astype(int)
    assert (centre[..., 0] > 100).all() and (centre[..., 1:] < 20).all()
    assert (np.asarray(image.label[28:36, 28:36]) == FIRST_BOX).all()
    assert (np.asarray(image.rgb[2, :, 2]) > 150).all()  # sky above


@pytest.mark.quick
def test_depth_of_a_wall_three_metres_ahead_is_right_within_a_centimetre():
    image = frame(EYE, LEVEL, LENS, scene_of(box(3.1, 0.0, 0.2, 20.0, 10.0, RED)))
    wall = np.asarray(image.label) == FIRST_BOX
    assert wall.sum() > 2000
    np.testing.assert_allclose(np.asarray(image.depth)[wall], 3.0, atol=0.01)


@pytest.mark.quick
def test_horizon_of_a_level_camera_lies_between_the_middle_rows():
    image = frame(EYE, LEVEL, LENS, scene_of())
    assert (np.asarray(image.label[:32]) == SKY).all() and np.isinf(image.depth[:32]).all()
    assert (np.asarray(image.label[32:]) == GROUND).all()
    np.testing.assert_allclose(image.depth[63], 1.0 / (31.5 / float(LENS.fy)), rtol=1e-4)


def test_nearer_things_hide_farther_ones_and_the_marker_is_labelled():
    near, far = box(3.0, 0.0, 0.5, 0.6, 1.2, RED), box(5.0, 0.0, 0.5, 4.0, 2.0, jnp.ones(3))
    for boxes, (near_label, far_label) in (((near, far), (0, 1)), ((far, near), (1, 0))):
        label = np.asarray(frame(EYE, LEVEL, LENS, scene_of(*boxes)).label)
        assert label[33, 32] == FIRST_BOX + near_label and label[33, 20] == FIRST_BOX + far_label
    assert np.asarray(frame(EYE, LEVEL, LENS, scene_of(far, marker_x=2.0)).label)[32, 32] == MARKER


def test_labels_and_depth_agree_with_a_double_precision_ray_caster():
    scene = random_scene(jax.random.key(1))
    image = frame(EYE, LEVEL, LENS, scene)
    u = (np.arange(64) + 0.5 - 32) / float(LENS.fx)
    columns, rows = np.meshgrid(u, u)
    rays = np.stack([np.ones_like(columns), -columns, -rows], -1)
    best = np.where(rays[..., 2] < 0, -1.0 / rays[..., 2], np.inf)
    label = np.where(rays[..., 2] < 0, GROUND, SKY)
    marker = scene.marker
    parts = [(marker.position, marker.half, marker.yaw)]
    parts += list(zip(scene.boxes.centre, scene.boxes.half, scene.boxes.yaw, strict=True))
    for index, (centre, half, yaw) in enumerate(parts):
        c, s = np.cos(float(yaw)), np.sin(float(yaw))
        into = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        origin, direction = into @ (np.array([0.0, 0.0, 1.0]) - np.asarray(centre, float)), rays @ into.T
        sides = np.stack([(sign * np.asarray(half, float) - origin) / direction for sign in (-1, 1)])
        enter, leave = sides.min(0).max(-1), sides.max(0).min(-1)
        hit = (enter < leave) & (enter > 0) & (enter < best)
        best, label = np.where(hit, enter, best), np.where(hit, MARKER + index, label)
    same = np.asarray(image.label) == label
    assert same.mean() > 0.998  # rays that graze an edge may fall to either side
    assert len(np.unique(label)) > 8
    np.testing.assert_allclose(np.asarray(image.depth)[same], best[same], rtol=3e-4)


def test_a_mirrored_scene_gives_the_mirrored_image():
    scene = random_scene(jax.random.key(2))
    boxes = scene.boxes
    mirrored = dataclasses.replace(boxes, centre=boxes.centre * jnp.array([1.0, -1.0, 1.0]), yaw=-boxes.yaw)
    one = frame(EYE, LEVEL, LENS, scene)
    other = frame(EYE, LEVEL, LENS, dataclasses.replace(scene, boxes=mirrored))
    assert (np.asarray(one.label) == np.asarray(other.label)[:, ::-1]).mean() > 0.999
    seen = np.isfinite(one.depth) & np.isfinite(other.depth[:, ::-1])
    difference = np.abs(np.asarray(one.depth)[seen] - np.asarray(other.depth)[:, ::-1][seen])
    assert seen.sum() > 2000 and np.quantile(difference, 0.99) < 1e-2


def test_a_batch_of_images_equals_images_one_by_one_but_for_pixels_on_edges():
    scenes = jax.vmap(random_scene)(jax.random.split(jax.random.key(3), 3))
    eye = EYE + jnp.array([0.013, 0.007, 0.0])  # above a corner of tiles, rays would meet their edges exactly
    batch = jax.jit(jax.vmap(render, in_axes=(None, None, None, 0)))(eye, LEVEL, LENS, scenes)
    single = jax.jit(render)
    for index in range(3):
        image = single(eye, LEVEL, LENS, jax.tree.map(lambda leaf, i=index: leaf[i], scenes))
        assert (np.abs(np.asarray(batch[index]).astype(int) - np.asarray(image)) <= 1).mean() > 0.998


def test_unused_boxes_leave_no_trace():
    solid = box(3.0, 0.0, 1.0, 1.0, 2.0, RED)
    hidden = dataclasses.replace(solid, mask=jnp.zeros(1, bool))
    with_hidden, without = (frame(EYE, LEVEL, LENS, scene) for scene in (scene_of(hidden), scene_of()))
    np.testing.assert_array_equal(with_hidden.rgb, without.rgb)


def test_a_camera_inside_a_box_sees_only_that_box():
    image = frame(EYE, LEVEL, LENS, scene_of(box(0.0, 0.0, 1.0, 1.0, 2.0, RED)))
    assert (np.asarray(image.label) == FIRST_BOX).all() and (np.asarray(image.depth) < 1e-6).all()


def test_a_pose_that_is_not_finite_gives_a_black_image():
    image = frame(EYE.at[0].set(jnp.nan), LEVEL, LENS, scene_of(box(3.0, 0.0, 1.0, 1.0, 2.0, RED)))
    assert not np.asarray(image.rgb).any() and np.isinf(image.depth).all() and (np.asarray(image.label) == SKY).all()


def test_images_of_other_sizes_keep_the_view():
    wide = frame(EYE, LEVEL, pinhole(1.2, 32, 48), scene_of(box(3.0, 0.0, 1.0, 1.0, 2.0, RED))).rgb
    assert wide.shape == (32, 48, 3) and wide[16, 24, 0] > 100 and wide[16, 24, 1] < 20


def test_more_boxes_than_labels_are_refused():
    with pytest.raises(ValueError, match="3000 boxes"):
        render(EYE, LEVEL, LENS, dataclasses.replace(scene_of(), boxes=no_boxes(3000)))


@pytest.mark.quick
def test_reciprocal_without_division_is_right_to_single_precision():
    x = jnp.concatenate([jnp.logspace(-14, 6, 2000), -jnp.logspace(-14, 6, 2000)])
    np.testing.assert_allclose(reciprocal(x) * x, 1.0, rtol=5e-7)


def test_images_are_drawn_inside_a_loop_of_many_instances():
    """As evaluations do it: each instance has its own loop, and all of them have the same weights."""
    scene = random_scene(jax.random.key(5))

    def drive(weight, start):
        def one(place, _):
            image = render(jnp.array([place, 0.0, 1.0]), LEVEL, LENS, scene)
            return place + weight * jnp.mean(image) / 255, image

        return jax.lax.scan(one, start, None, length=2)[1]

    images = jax.jit(jax.vmap(drive, in_axes=(None, 0)))(0.1, jnp.array([0.0, 0.3]))
    for index, place in enumerate((0.0, 0.3)):
        first = jax.jit(render)(jnp.array([place, 0.0, 1.0]), LEVEL, LENS, scene)
        np.testing.assert_array_equal(images[index, 0], first)


@pytest.mark.quick
@pytest.mark.parametrize("images, traces", [((), 1), ((20,), 2)])
def test_images_in_blocks_are_those_drawn_whole_and_are_traced_once_for_an_image_and_once_for_many(images, traces):
    """Tracing the camera takes a tenth of a second, in each program that has one."""
    traced = []

    def function(rows, level):
        traced.append(level)
        return rows[:, None] * level + jnp.arange(3.0)

    rows, level = jnp.arange(7.0), jnp.linspace(1.0, 2.0, 20).reshape(-1)[: max(images, default=1)].reshape(images)
    drawn = in_blocks(function)
    found = jax.jit(jax.vmap(drawn, (None, 0)) if images else drawn)(rows, level)
    assert len(traced) <= traces
    np.testing.assert_array_equal(found, rows[:, None] * level[..., None, None] + jnp.arange(3.0))


def crowded(key):
    """Upright boxes, blocks and rounds around the camera, which is within some of them."""
    keys = jax.random.split(key, 6)
    boxes = dataclasses.replace(random_scene(keys[0], 30).boxes, mask=jax.random.bernoulli(keys[1], 0.8, (30,)))
    centre = jax.random.uniform(keys[2], (12, 3), minval=-3.0, maxval=3.0) + jnp.array([0.0, 0.0, 1.0])
    way = jax.random.normal(keys[3], (12, 3))
    way = way / jnp.linalg.norm(way, axis=1, keepdims=True)
    colour, there = jax.random.uniform(keys[4], (12, 3)), jax.random.bernoulli(keys[5], 0.8, (12,))
    size = jnp.full(12, 0.3)
    rounds = Rounds(centre, way, size, size / 2, jnp.arange(12) % 2 > 0, colour, there)
    turn = jax.vmap(lambda yaw, pitch: camera_rotation(yaw=yaw, pitch=pitch, roll=0.4))(way[:, 0], way[:, 1])
    blocks = Blocks(-centre, size[:, None] * jnp.array([1.0, 2.0, 0.5]), turn, colour, there)
    return dataclasses.replace(scene_of(marker_x=3.0), boxes=boxes, solids=Solids(blocks, rounds))


@pytest.mark.parametrize("lens, quality", [
    (LENS, Quality()), (pinhole(1.0, width=50, height=40), Quality(antialias=True)),
    (pinhole(1.4, width=33), Quality(shadows=True)),
])  # fmt: skip
def test_an_image_in_strips_that_meet_what_they_can_show_is_the_same_but_for_rounding(lens, quality, monkeypatch):
    scenes = jax.vmap(crowded)(jax.random.split(jax.random.key(2), 6))
    turns = jax.vmap(lambda yaw: camera_rotation(yaw=yaw, pitch=0.3, roll=0.3 * yaw))(jnp.linspace(-3.0, 3.0, 6))
    eyes = jnp.linspace(-1.0, 1.0, 18).reshape(6, 3) + EYE

    def images():
        every = jax.jit(jax.vmap(lambda eye, turn, scene: render(eye, turn, lens, scene, quality)))(eyes, turns, scenes)
        first = jax.jit(lambda eye, turn, scene: render(eye, turn, lens, scene, quality))
        return np.asarray(every), np.asarray(first(eyes[0], turns[0], jax.tree.map(lambda leaf: leaf[0], scenes)))

    in_strips = images()
    monkeypatch.setattr(image, "MANY", 10**6)
    whole = images()
    for one, other in zip(in_strips, whole, strict=True):
        assert len(np.unique(other)) > 50
        apart = np.abs(one.astype(int) - other).max(-1)
        assert apart.max() <= 2 and (apart > 0).mean() < 1e-3


def test_a_camera_just_within_a_box_is_shown_the_box_in_a_scene_of_many():
    boxes = [box(3.0 + 0.1 * number, 2.0, 0.2, 0.1, 0.2, RED) for number in range(30)]
    scene = scene_of(box(0.4995, 0.0, 1.0, 1.0, 2.0, RED), *boxes)  # its face is half a millimetre behind the eye
    assert scene.boxes.mask.shape[0] >= image.MANY
    seen = np.asarray(jax.jit(render)(EYE, LEVEL, LENS, scene)).astype(int)
    assert (seen[..., 0] > 60).all() and (seen[..., 1:] < 20).all()
