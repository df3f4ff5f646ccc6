"""What only the simulator knows, as targets for a world model, and the mirror of left and right."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.batch import make_batch
from whill_mjx.env import make_env, observe, repainted, reset_state, step_state
from whill_mjx.learning.identity import identity_of
from whill_mjx.learning.setup import TRUTH, find_preset, functional_env, learned_env, mirror_of
from whill_mjx.sensors import privileged
from whill_mjx.sensors.camera import Camera
from whill_mjx.sensors.depth import Depth
from whill_mjx.sensors.goal import Goal
from whill_mjx.world.collision import obstacles_of, touches
from whill_mjx.world.maps.walls import map_walls
from whill_mjx.world.scene import box, footprint, no_boxes, stack_boxes
from whill_mjx.world.solids import Solids, post, rod

ENV, PARAMS = make_env("obstacle_course", "whill_cr", height=16, width=16)


def mirrored_state(state):
    """The same moment in the world mirrored left to right; the chair must be at its start."""
    boxes, marker = state.scene.boxes, state.scene.marker
    flip = jnp.array([1.0, -1.0, 1.0])
    boxes = dataclasses.replace(boxes, centre=boxes.centre * flip, yaw=-boxes.yaw)
    marker = dataclasses.replace(marker, position=marker.position * flip, yaw=-marker.yaw)
    looks = dataclasses.replace(state.scene.looks, sun=state.scene.looks.sun * flip)
    scene = dataclasses.replace(state.scene, boxes=boxes, marker=marker, looks=looks)
    position = jnp.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0])  # x y z, quaternion of a mirrored turn
    qpos = state.vehicle.qpos.at[:7].multiply(position)
    return dataclasses.replace(state, scene=scene, vehicle=dataclasses.replace(state.vehicle, qpos=qpos))


@pytest.mark.quick
def test_free_distances_are_those_of_a_walk_along_each_ray():
    boxes = stack_boxes([box(2.0, 0.3, 0.6, 0.4, 0.5, jnp.ones(3), 0.4), box(-0.5, 1.5, 0.2, 3.0, 0.5, jnp.ones(3)),
                         box(0.0, -1.0, 4.0, 0.1, 0.5, jnp.ones(3), mask=False)])  # fmt: skip
    body = footprint(ENV.model.spec, 0.1, -0.2, 0.7)
    steps = np.linspace(0.0, privileged.RANGE, 50001)
    expected = []
    for angle in privileged.ANGLES + 0.7:
        dx = float(body.x) + steps * np.cos(angle) - np.asarray(boxes.centre[:, :1])
        dy = float(body.y) + steps * np.sin(angle) - np.asarray(boxes.centre[:, 1:2])
        c, s = np.cos(np.asarray(boxes.yaw))[:, None], np.sin(np.asarray(boxes.yaw))[:, None]
        half = np.asarray(boxes.half)
        inside = (np.abs(dx * c + dy * s) <= half[:, :1]) & (np.abs(dy * c - dx * s) <= half[:, 1:2])
        inside &= np.asarray(boxes.mask)[:, None]
        met = inside.any(0)
        expected.append(steps[met.argmax()] if met.any() else privileged.RANGE)
    assert 3 <= sum(value < privileged.RANGE for value in expected) < privileged.RAYS
    np.testing.assert_allclose(privileged.free_distances(body, boxes), expected, atol=2e-4)
    np.testing.assert_array_equal(privileged.free_distances(body, no_boxes(2)), privileged.RANGE)


@pytest.mark.quick
def test_some_ray_meets_a_box_of_the_corridor_wherever_it_stands_ahead():
    """As wide as a cardboard box, up to 3 m away and turned in any way."""
    body, rng = footprint(ENV.model.spec, 0.0, 0.0, 0.0), np.random.default_rng(2)
    for _ in range(50):
        far, aside, turned = rng.uniform(0.9, 2.9), rng.uniform(-0.5, 0.5), rng.uniform(-0.8, 0.8)
        boxes = stack_boxes([box(float(body.x) + far, aside, 0.4, 0.4, 0.45, jnp.ones(3), turned)])
        assert float(privileged.free_distances(body, boxes).min()) < far


@pytest.mark.quick
def test_distances_from_the_outline_are_of_its_edge_in_each_direction():
    """Points of a rectangle's edge are at half the length or half the width, and none is farther out."""
    body = footprint(ENV.model.spec, 0.0, 0.0, 0.0)
    edge = np.asarray(privileged.outline(body))
    x, y = edge * np.cos(privileged.ANGLES), edge * np.sin(privileged.ANGLES)
    furthest = np.maximum(np.abs(x) / float(body.half_length), np.abs(y) / float(body.half_width))
    np.testing.assert_allclose(furthest, 1.0, atol=1e-6)
    np.testing.assert_allclose(edge[[0, 12, 24, 36]], np.array([1, 0, 1, 0]) * float(body.half_length)
                               + np.array([0, 1, 0, 1]) * float(body.half_width), atol=1e-6)


GREY = (0.5, 0.5, 0.5)
STEP = 0.01
"""Of the walk along each ray [m]."""
ROUNDS = {
    "post": (post(1.5, 0.1, 1.0, 0.2, GREY), True),
    "low post": (post(1.5, 0.1, 0.15, 0.2, GREY), True),
    "barrier": (rod((1.3, 0.6, 0.7), (1.8, -0.7, 0.75), 0.05, GREY, capsule=True), True),
    "leaning pole": (rod((1.2, 0.5, 0.0), (1.8, 0.1, 2.0), 0.1, GREY, capsule=True), True),
    "ball": (rod((1.4, -0.2, 0.3), (1.4, -0.2, 0.3), 0.25, GREY), True),
    "high bar": (rod((1.3, 0.6, 1.6), (1.8, -0.7, 1.6), 0.05, GREY), False),
}


@pytest.fixture(scope="module")
def beside_a_box():
    """A state in which the axle is at the origin, the vehicle looks along x, and a box stands to its left."""
    state = reset_state(ENV, PARAMS, jax.random.key(3))
    qpos = state.vehicle.qpos.at[:7].set(jnp.array([-ENV.model.spec.reference_x, 0.0, 0.3, 1.0, 0.0, 0.0, 0.0]))
    scene = dataclasses.replace(state.scene, boxes=stack_boxes([box(0.5, 2.0, 3.0, 0.4, 0.5, jnp.ones(3), 0.3)]))
    return dataclasses.replace(state, scene=scene, vehicle=dataclasses.replace(state.vehicle, qpos=qpos))


@pytest.fixture(scope="module")
def walked():
    """Function of a state to what is known and what a walk along each ray finds, both (RAYS,) m."""
    known = jax.jit(lambda state: privileged.truth(ENV, state)[4:] * privileged.UNIT)
    body = footprint(ENV.model.spec, 0.0, 0.0, 0.0)
    far = np.arange(0.0, privileged.RANGE, STEP)

    @jax.jit
    def hits(scene):
        def touched(angle, gone):
            x, y = body.x + gone * jnp.cos(angle), body.y + gone * jnp.sin(angle)
            small = {"half_length": jnp.array(STEP / 2), "half_width": jnp.array(STEP / 2)}
            return touches(dataclasses.replace(body, x=x, y=y, **small), obstacles_of(scene, x, y))

        along = jax.vmap(touched, in_axes=(None, 0))
        return jax.vmap(along, in_axes=(0, None))(jnp.asarray(privileged.ANGLES), jnp.asarray(far))

    def both(state):
        held = np.asarray(hits(state.scene))
        return np.asarray(known(state)), np.where(held.any(1), far[held.argmax(1)], privileged.RANGE)

    return both


@pytest.mark.parametrize("name", ROUNDS)
def test_free_distances_end_where_the_vehicle_would_touch_posts_and_rods(walked, beside_a_box, name):
    rounds, met = ROUNDS[name]
    scene = dataclasses.replace(beside_a_box.scene, solids=Solids(rounds=rounds))
    known, touched = walked(dataclasses.replace(beside_a_box, scene=scene))
    # Where a ray grazes something, the small vehicle touches it earlier, or while the ray misses it.
    assert np.mean(np.abs(known - touched) < 2 * STEP) > 0.9 and (touched <= known + STEP).all()
    assert (known[0] < 1.5) == met


def test_free_distances_end_at_a_wall_of_a_map_that_is_low(walked, beside_a_box):
    walls = map_walls(np.array([[[1.6, 0.5], [1.6, -0.5]]], np.float32), keep=1, height=0.2)
    boxes = stack_boxes([beside_a_box.scene.boxes, no_boxes(1)])
    scene = dataclasses.replace(beside_a_box.scene, walls=walls, boxes=boxes)
    known, touched = walked(dataclasses.replace(beside_a_box, scene=scene))
    assert abs(known[0] - touched[0]) < 2 * STEP and known[0] == pytest.approx(1.6 + ENV.model.spec.reference_x)


def test_the_mirror_shows_what_is_seen_and_known_in_the_mirrored_world():
    state = reset_state(ENV, PARAMS, jax.random.key(3))
    other = mirrored_state(state)
    drive = jax.jit(lambda state, action: step_state(ENV, PARAMS, state, action))
    mirror = mirror_of(make_batch(ENV, PARAMS, 1))
    actions = jax.random.uniform(jax.random.key(1), (12, 2), minval=jnp.array([0.2, -1.0]), maxval=1.0)
    for action in actions:
        state, outcome = drive(state, action)
        other, other_outcome = drive(other, mirror.action(action[None], 1)[0, 0])
    known, other_known = (privileged.truth(ENV, one) for one in (state, other))
    assert abs(float(known[1])) > 0.05 and not np.allclose(known[4:], privileged.mirrored(known)[4:], atol=0.1)
    np.testing.assert_allclose(privileged.mirrored(known), other_known, atol=2e-3)
    assert float(outcome.reward) == pytest.approx(float(other_outcome.reward), abs=1e-3)
    plain = {"noise": jnp.zeros(()), "grain": jnp.zeros(()), "ground": jnp.full((2, 3), 0.4)}  # no tiles
    scenes = [dataclasses.replace(one.scene.looks, **plain) for one in (state, other)]
    images = [np.asarray(observe(ENV, dataclasses.replace(one, scene=dataclasses.replace(one.scene, looks=looks))))
              for one, looks in zip((state, other), scenes, strict=True)]  # fmt: skip
    difference = np.abs(np.asarray(mirror.obs(None, images[0][None], 1)[0, 0], int) - images[1])
    assert images[0].std() > 10 and np.abs(images[0].astype(int) - images[1]).mean() > 5
    assert (difference > 3).mean() < 0.02  # only pixels on an edge


@pytest.mark.quick
@pytest.mark.parametrize("mount", [{"y": 0.1}, {"yaw": 0.3}, {"roll": 0.1}])
def test_what_a_camera_beside_the_middle_sees_has_no_mirror(mount):
    spec = ENV.model.spec
    spec = dataclasses.replace(spec, camera=dataclasses.replace(spec.camera, **mount))
    aside = dataclasses.replace(ENV, model=dataclasses.replace(ENV.model, spec=spec))
    for sensors in ((), (("camera", Camera()), ("goal", Goal())), (("depth", Depth(as_bytes=True)),)):
        assert mirror_of(make_batch(dataclasses.replace(ENV, sensors=sensors), PARAMS, 1)) is not None
        assert mirror_of(make_batch(dataclasses.replace(aside, sensors=sensors), PARAMS, 1)) is None
    for one in (Goal(), Camera(mount=ENV.model.spec.camera)):  # nothing is seen through that camera
        assert mirror_of(make_batch(dataclasses.replace(aside, sensors=(("one", one),)), PARAMS, 1)) is not None


@pytest.mark.long
def test_where_looks_are_random_each_other_world_has_its_own_for_a_whole_episode():
    env, params = make_env("corridor", height=16, width=16)
    batch = make_batch(env, params, 2, second_tries=0.5)
    mirror = mirror_of(batch)
    state, _ = jax.jit(batch.reset)(jax.random.key(0))
    views = []
    for _ in range(3):
        state, frame = jax.jit(batch.step)(state, jnp.array([[-1.0, 0.0]] * 2))  # stands still
        worlds = np.asarray(mirror.obs(state, frame.obs, 3), float)
        as_real = [worlds[0][:, :, ::-1], worlds[1], worlds[2][:, :, ::-1]]
        shown = [np.asarray(frame.obs, float), *as_real]
        apart = [np.abs(a - b).mean((1, 2, 3)).min() for i, a in enumerate(shown) for b in shown[:i]]
        assert min(apart) > 10
        views.append(worlds)
    assert np.abs(views[2] - views[1]).mean() < 12  # grey levels, of noise
    np.testing.assert_array_equal(mirror.action(jnp.array([[0.5, 0.25]]), 3)[:, 0, 1], [-0.25, 0.25, -0.25])
    assert mirror.worlds > 3
    known = jax.random.uniform(jax.random.key(1), (2, privileged.SIZE))
    told = mirror.obs(state, {"camera": frame.obs, TRUTH: known}, 2)[TRUTH]
    np.testing.assert_array_equal(told, [privileged.mirrored(known), known])
    assert mirror_of(make_batch(ENV, PARAMS, 1)).worlds == 1
    one = jax.tree.map(lambda leaf: leaf[0], state)
    other = repainted(env, one.env, jax.random.key(7))
    assert not np.allclose(other.scene.boxes.colour, one.env.scene.boxes.colour, atol=0.05)
    blue = np.array([repainted(env, one.env, key).scene.marker.colour for key in jax.random.split(one.origin, 40)])
    assert blue[:, 2].min() > 0.5 and (blue[:, 2] - blue[:, :2].max(1)).min() > 0.2  # still the goal
    for name in ("centre", "half", "yaw"):
        np.testing.assert_array_equal(getattr(other.scene.boxes, name), getattr(one.env.scene.boxes, name))


@pytest.mark.parametrize("looks", ["paper", pytest.param("rich", marks=pytest.mark.long)])
def test_what_is_kept_of_a_moment_shows_it_again_in_other_looks(looks):
    env, params = make_env("corridor", "whill_cr_ramp", height=16, width=16, looks=looks)
    batch = make_batch(env, params, 2, spread=0.1)
    learned = functional_env(batch, targets=True, redraw=True)
    state, frame = jax.jit(learned.begin)(jax.random.PRNGKey(2))
    for _ in range(3):
        state, frame = jax.jit(learned.advance)(state, jnp.array([[1.0, 0.3], [0.5, -1.0]]))
    held = learned.redraw.keep(state, frame.obs)
    size = sum(leaf[0].size * leaf.dtype.itemsize for leaf in jax.tree.leaves(held))
    assert size < 64 * 64 * 3 / 4  # bytes of what a learner's image would take
    keys = jax.random.split(jax.random.PRNGKey(3), 2)
    again = jax.jit(jax.vmap(learned.redraw.draw))(held, keys)
    whole = jax.jit(jax.vmap(lambda one, key: observe(env, repainted(env, one, key))))(state.env, keys)
    np.testing.assert_array_equal(again["camera"], whole)
    np.testing.assert_array_equal(again[TRUTH], frame.obs[TRUTH])
    other = jax.jit(jax.vmap(learned.redraw.draw))(held, keys[::-1])["camera"]
    assert np.abs(np.asarray(other, int) - whole).mean((1, 2, 3)).min() > 10
    assert learned.mirror.worlds == 1
    flipped = learned.mirror.obs(None, again, 1)
    np.testing.assert_array_equal(flipped["camera"][0], np.asarray(again["camera"])[:, :, ::-1])


@pytest.mark.quick
def test_what_always_looks_the_same_and_what_sensors_observe_is_not_drawn_anew():
    assert functional_env(make_batch(ENV, PARAMS, 1), redraw=True).redraw is None
    env = dataclasses.replace(ENV, rich=True)
    assert functional_env(make_batch(env, PARAMS, 1), redraw=True).redraw is not None
    env = dataclasses.replace(env, sensors=(("camera", Camera()),))
    assert functional_env(make_batch(env, PARAMS, 1), redraw=True).redraw is None


def test_targets_from_the_outline_reach_zero_where_the_vehicle_touches(beside_a_box):
    """Of a wall 5 cm beside the vehicle, the ray to the left has 5 cm; of one it has run into, 0."""
    known, whole = (jax.jit(lambda state, near=near: privileged.truth(ENV, state, near)[4:] * privileged.UNIT)
                    for near in (True, False))  # fmt: skip
    body = footprint(ENV.model.spec, 0.0, 0.0, 0.0)
    near = np.asarray(known(beside_a_box))
    np.testing.assert_allclose(near, np.asarray(whole(beside_a_box)) - privileged.outline(body), atol=1e-5)

    def aside(gap):
        wall = box(0.0, float(body.half_width) + gap + 0.2, 3.0, 0.4, 0.5, jnp.ones(3))
        scene = dataclasses.replace(beside_a_box.scene, boxes=stack_boxes([wall]))
        return np.asarray(known(dataclasses.replace(beside_a_box, scene=scene)))

    assert aside(0.05)[12] == pytest.approx(0.05, abs=1e-3) == aside(0.05).min()
    assert aside(-0.05)[12] == 0.0 and aside(-0.05)[36] > 1.0


def test_the_preset_for_other_rooms_learns_distances_from_the_outline():
    given, paper = (find_preset(name, "corridor") for name in ("transfer", "paper"))
    assert given.from_outline and not paper.from_outline
    batch = make_batch(ENV, PARAMS, 2)
    seen = []
    for preset in (given, dataclasses.replace(given, from_outline=False)):
        env = learned_env(dataclasses.replace(preset, task=ENV.task), batch)
        seen.append(np.asarray(jax.jit(env.reset)(jax.random.key(0))[1].obs[TRUTH]))
    np.testing.assert_array_equal(seen[0][:, :4], seen[1][:, :4])
    assert (seen[0][:, 4:] < seen[1][:, 4:]).all()


def test_a_run_is_another_one_with_other_targets_and_older_runs_stay_the_same():
    preset = find_preset("transfer", "corridor")
    older = dataclasses.replace(preset, from_outline=False)
    now, then = (identity_of(one, "dreamer", 0, "whill_cr", None) for one in (preset, older))
    assert now == then | {"from_outline": True}
    assert identity_of(preset, "ppo", 0, "whill_cr", None) == identity_of(older, "ppo", 0, "whill_cr", None)


def test_the_targets_stand_beside_the_camera_and_are_no_input():
    batch = make_batch(ENV, PARAMS, 2)
    env, plain = functional_env(batch, targets=True), functional_env(batch)
    assert env.obs_shape == {"camera": (16, 16, 3), TRUTH: (privileged.SIZE,)} and plain.obs_shape == (16, 16, 3)
    state, first = jax.jit(env.reset)(jax.random.key(0))
    np.testing.assert_array_equal(first.obs["camera"], jax.jit(plain.reset)(jax.random.key(0))[1].obs)
    _, after = jax.jit(env.step)(state, jnp.ones((2, 2)))
    assert after.obs[TRUTH].shape == (2, privileged.SIZE) and np.isfinite(after.obs[TRUTH]).all()
    assert (np.abs(after.obs[TRUTH] - first.obs[TRUTH]) > 0).any()
