"""Rich looks: one record per world, drawn inside the reset, that changes what is seen and leaves a way through."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.env import RICH, make_env, observe, repainted, reset_state
from whill_mjx.tasks.tasks import make_task, sample_world
from whill_mjx.world.eye import develop, plain_eye
from whill_mjx.world.paint import paint
from whill_mjx.world.render import camera_rotation, pinhole, render
from whill_mjx.world.render.pallas import Tiling, fast_floor, fast_whole, render_pallas
from whill_mjx.world.render.rich import NUMBERS, Surface, _paint, face_of_body, face_of_row
from whill_mjx.world.render.tables import bodies, face_rows, parts_of
from whill_mjx.world.render.textures import whole
from whill_mjx.world.render.visibility import GROUND
from whill_mjx.world.rich import FLOOR, MARKER, PASSAGE, furnish, roles_of
from whill_mjx.world.solids import Blocks, Rounds, Solids

SIZE = 16


def furnished(task: str, key: jax.Array):
    world_key, key = jax.random.split(key)
    return furnish(key, sample_world(make_task(task), world_key).scene, lone=task == "corridor")


@pytest.fixture(scope="module")
def room():
    env, params = make_env("corridor", looks="rich", height=SIZE, width=SIZE)
    reset = jax.jit(lambda key: reset_state(env, params, key))
    return env, reset, jax.jit(lambda state: observe(env, state))


def test_the_looks_of_a_world_are_one_pytree_and_the_same_key_gives_the_same_frame(room):
    env, reset, see = room
    state = reset(jax.random.key(1))
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(state.scene.rich))
    assert state.scene.rich.materials.paint.shape == (len(roles_of(state.scene)), 3)
    first, again, other = see(state), see(reset(jax.random.key(1))), see(reset(jax.random.key(2)))
    np.testing.assert_array_equal(first, again)
    assert np.abs(np.asarray(first, int) - other).mean() > 5
    other_paint = jax.jit(lambda state: repainted(env, state, jax.random.key(3)))(state)
    np.testing.assert_array_equal(other_paint.scene.boxes.centre, state.scene.boxes.centre)
    assert np.abs(np.asarray(first, int) - see(other_paint)).mean() > 5


def test_an_image_may_be_late_by_two_control_periods(room):
    _, reset, see = room
    state = reset(jax.random.key(1))
    eye = dataclasses.replace(state.scene.rich.eye, delay=jnp.array(2))
    state = dataclasses.replace(
        state, scene=dataclasses.replace(state.scene, rich=dataclasses.replace(state.scene.rich, eye=eye))
    )
    moved = state.trail.at[:2, 0].add(0.5)
    late = dataclasses.replace(state, trail=moved)
    np.testing.assert_array_equal(see(state), see(late))  # what is two periods old is still as it was
    there = dataclasses.replace(state, trail=state.trail.at[2, 0].add(0.5))
    assert np.abs(np.asarray(see(state), int) - see(there)).max() > 10


@pytest.mark.parametrize("task", ["corridor", "obstacle_course"])
def test_things_never_close_the_passage(task):
    draw = jax.jit(jax.vmap(lambda key: furnished(task, key).boxes))
    boxes = jax.tree.map(np.asarray, draw(jax.random.split(jax.random.key(0), 300)))
    seen = 0
    for world in range(300):
        one = jax.tree.map(lambda leaf, world=world: leaf[world], boxes)
        walls, rest = one.centre[:2, 1] - np.array([1, -1]) * one.half[:2, 1], slice(3, None)
        reach_x = one.half[:, 0] * np.abs(np.cos(one.yaw)) + one.half[:, 1] * np.abs(np.sin(one.yaw))
        reach_y = one.half[:, 0] * np.abs(np.sin(one.yaw)) + one.half[:, 1] * np.abs(np.cos(one.yaw))
        for x in np.arange(-1.5, 3.6, 0.05):  # where the goal is not yet reached
            near = one.mask[rest] & (np.abs(one.centre[rest, 0] - x) < reach_x[rest])
            low, high = (one.centre[rest, 1] - reach_y[rest])[near], (one.centre[rest, 1] + reach_y[rest])[near]
            seen += near.sum()
            edges = sorted(zip(low, high, strict=True))
            free, reached = 0.0, walls[1]
            for start, end in [*edges, (walls[0], walls[0])]:
                free, reached = max(free, start - reached), max(reached, end)
            assert free > 0.9 and PASSAGE > 0.9, (world, x, free)
    assert seen > 100


@pytest.mark.parametrize("figure", [-1.0, 0.0, 0.5])
def test_the_cells_of_a_material_are_the_same_where_a_gpu_rounds_down_by_a_sum(figure):
    """Eagerly: XLA would merge the sums."""
    rng = np.random.default_rng(0)
    numbers = rng.uniform(0.2, 3.0, NUMBERS).astype(np.float32)
    numbers[16], numbers[26] = 0.2, figure
    s, t, height = (jnp.asarray(rng.uniform(-4, 4, 500), jnp.float32) for _ in range(3))
    label = jnp.asarray(rng.integers(0, 30, 500))
    material = [jnp.float32(value) for value in numbers]
    surface = Surface((s, t), material, label, height, jnp.float32(0.01))

    def paint_by(floor, whole):
        small = lambda integer: integer.astype(jnp.float32)  # noqa: E731
        stage = SimpleNamespace(floor=floor, whole=whole, small=small, ratio=lambda x, y: x / y)
        return _paint(stage, surface, jnp.uint32(7))

    (exact, tones), (fast, other) = paint_by(jnp.floor, whole), paint_by(fast_floor, fast_whole)
    np.testing.assert_array_equal(exact, fast)
    np.testing.assert_array_equal(tones, other)
    assert np.std(tones) > 0.05


@pytest.mark.parametrize(("figure", "fill"), [(0.0, 0.4), (0.5, 0.05)])
def test_figures_have_two_paints_and_the_shapes_of_blotches(figure, fill):
    scene = paint(jax.random.key(1), furnished("corridor", jax.random.key(2)))
    count = scene.rich.materials.fill.shape[0]
    look_down = jnp.array([0.5, 0.0, 1.5]), camera_rotation(0.0, jnp.pi / 2)

    def floor(figure, fill):
        materials = dataclasses.replace(
            scene.rich.materials, paint=jnp.tile(jnp.array([0.5, 0.1, 0.1]), (count, 1)),
            second=jnp.tile(jnp.array([0.1, 0.5, 0.1]), (count, 1)), figure=jnp.full(count, figure),
            fill=jnp.full(count, fill), blotch_size=jnp.full(count, 0.3), cell=jnp.full((count, 2), 0.3),
        )  # fmt: skip
        drawn = dataclasses.replace(scene, rich=dataclasses.replace(scene.rich, materials=materials))
        image = np.asarray(render(*look_down, pinhole(0.5, SIZE, SIZE), drawn), int)
        return image[..., 1] > image[..., 0]

    green = floor(figure, fill)
    assert 0.05 < green.mean() < 0.6
    assert not floor(figure, 0.0).any() and floor(figure, 2.0).all()
    assert (floor(figure, 1.5 * fill) >= green).all()
    assert (floor(-1.0, 0.4) != green).any()  # where cells are filled instead


def test_some_floors_are_figured_and_some_are_blue():
    draw = jax.jit(jax.vmap(lambda key: paint(key, furnished("corridor", jax.random.key(2))).rich.materials))
    drawn = draw(jax.random.split(jax.random.key(0), 2000))
    ground = slice(1, 2)
    assert 0.1 < np.mean(drawn.figure[:, ground] >= 0.0) < 0.25
    assert 0.03 < np.mean(drawn.figure[:, ground] > 0.0) < 0.15
    blue = lambda paint: paint[..., 2] > 2.0 * np.maximum(paint[..., 0], paint[..., 1]) + 0.05  # noqa: E731
    roles = roles_of(furnished("corridor", jax.random.key(2)))
    assert blue(drawn.paint[:, ground]).any() and blue(drawn.second[:, ground]).any()
    assert not blue(drawn.paint[:, (roles != FLOOR) & (roles != MARKER)]).any()


@pytest.mark.long
def test_the_kernel_draws_rich_looks_as_the_renderer_does():
    scene = paint(jax.random.key(1), furnished("corridor", jax.random.key(2)))
    pose = jnp.array([0.5, 0.0, 0.68]), camera_rotation(0.1, 0.15)
    ours = jax.jit(lambda scene: render(*pose, pinhole(1.2, SIZE, SIZE), scene))(scene)
    kernel = jax.jit(lambda scene: render_pallas(*pose, pinhole(1.2, SIZE, SIZE), scene,
                                                 tiling=Tiling(SIZE, SIZE, interpret=True)))(scene)  # fmt: skip
    assert RICH.antialias and np.abs(np.asarray(ours, int) - kernel).max() <= 1
    assert np.std(ours) > 5


def test_the_papers_looks_are_what_the_corridor_shows_by_itself():
    plain, params = make_env("corridor", height=SIZE, width=SIZE)
    named, _ = make_env("corridor", looks="paper", height=SIZE, width=SIZE)
    assert (named.random_looks, named.photometric, named.rich) == (plain.random_looks, plain.photometric, plain.rich)
    with pytest.raises(ValueError, match="looks is 'neon'"):
        make_env("corridor", looks="neon")


def test_a_plain_eye_leaves_an_image_as_it_is():
    image = jax.random.randint(jax.random.key(0), (SIZE, SIZE, 3), 0, 120).astype(jnp.uint8)
    sent = develop(image, plain_eye(), jnp.zeros(()), jax.random.key(1), jnp.array(0))
    assert np.abs(np.asarray(sent, int) - image).max() <= 2


@pytest.mark.parametrize("seed", range(3))
def test_a_face_found_from_its_body_is_that_of_the_table_of_faces(seed):
    """Boxes, blocks and rounds of any turn, and the ground, met from outside: normal, and place on the face."""
    rng, count = np.random.default_rng(seed), 5
    scene = furnished("corridor", jax.random.key(seed))
    turns, axes = (np.linalg.qr(rng.normal(size=(count, 3, 3)))[0] for _ in range(2))
    turns *= np.linalg.det(turns)[:, None, None]  # turned, and not mirrored
    centre, half = rng.uniform(-2, 2, (2, count, 3)), rng.uniform(0.1, 0.5, (count, 3))
    white, on = jnp.ones((count, 3)), jnp.ones(count, bool)
    rounds = Rounds(jnp.asarray(centre[0]), jnp.asarray(axes[:, 0]), half[:, 0], half[:, 1], ~on, white, on)
    blocks = Blocks(jnp.asarray(centre[1]), half, jnp.asarray(turns), white, on)
    parts = parts_of(dataclasses.replace(scene, solids=Solids(blocks=blocks, rounds=rounds)))
    eye, point = rng.uniform(-3, 3, 3), jnp.asarray(rng.uniform(-3, 3, (3, parts.labels)))
    rows, body = face_rows(eye, parts, scene), list(bodies(parts).T)
    for face in range(3):
        code = 4 * np.arange(parts.labels) + face
        way = rng.uniform(-1, 1, (3, parts.labels))
        normal = jnp.stack(face_of_row(list(rows[code].T), list(point), SimpleNamespace(x=0.0, y=0.0, z=0.0))[0])
        way *= -np.sign(jnp.sum(normal * way, 0))  # each ray meets the face that is turned to the eye
        ray = SimpleNamespace(x=way[0], y=way[1], z=way[2])
        _, *place = face_of_row(list(rows[code].T), list(point), ray)
        shown = np.arange(parts.labels) > GROUND if face < 2 else np.arange(parts.labels) >= GROUND
        if face == 1:
            shown &= np.arange(parts.labels) < parts.first_round  # rounds have a side and ends
        found, *there = face_of_body(body, face, list(point), ray)
        np.testing.assert_allclose(jnp.stack(found)[:, shown], normal[:, shown], atol=2e-5)
        np.testing.assert_allclose(jnp.stack(there)[:, shown], jnp.stack(place)[:, shown], atol=2e-5)
