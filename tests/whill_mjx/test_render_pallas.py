"""The kernel against the jnp renderer, on the CPU: interpreted, and lowered for CUDA."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AbstractDevice, AbstractMesh, AxisType, use_abstract_mesh

from whill_mjx.world.materials import label_count, make_atlas, plain_finish
from whill_mjx.world.render import Quality, camera_rotation, pinhole, render
from whill_mjx.world.render.draw import draw
from whill_mjx.world.render.pallas import Tiling, fast_level, fast_small, fast_whole, render_pallas
from whill_mjx.world.scene import Boxes, Marker, Scene, default_looks
from whill_mjx.world.solids import Solids, block, person, post, stack_rounds

EYE, TURN = jnp.array([0.0, 0.1, 1.0]), camera_rotation(0.1, 0.15, 0.05)
BEST = Quality(antialias=True, shadows=True)
TILING = Tiling()
DISTORTED = dataclasses.replace(pinhole(1.2, 32, 32), distortion=jnp.array([-0.2, 0.05, 0.001, 0.0, 0.0]))


def crowd(count, key=0):
    keys = jax.random.split(jax.random.key(key), 4)
    place = jax.random.uniform(keys[0], (count, 2), minval=-3.0, maxval=3.0) + jnp.array([4.0, 0.0])
    half = jax.random.uniform(keys[1], (count, 3), minval=0.05, maxval=0.4)
    yaw = jax.random.uniform(keys[2], (count,), maxval=6.0)
    colour = jax.random.uniform(keys[3], (count, 3))
    boxes = Boxes(jnp.concatenate([place, half[:, 2:]], 1), half, yaw, colour, jnp.arange(count) % 5 != 1)
    marker = Marker(jnp.array([5.0, 0.0, 1.0]), jnp.array([0.02, 0.3, 0.3]), jnp.zeros(()), jnp.array([0.0, 0.1, 0.9]))
    return Scene(boxes, marker, default_looks())


def furnished(count=6):
    tilt = camera_rotation(0.4, 0.3, 0.5)
    rounds = stack_rounds([person(3.0, 0.5), post(2.5, -0.5, 1.0, 0.06, (0.9, 0.7, 0.1))])
    blocks = block((3.0, -1.0, 0.5), (0.3, 0.3, 0.3), tilt, (0.3, 0.6, 0.3))
    scene = dataclasses.replace(crowd(count), solids=Solids(blocks, rounds))
    labels = label_count(scene)
    finish = plain_finish(labels)
    picture = np.arange(8 * 8 * 3, dtype=np.uint8).reshape(8, 8, 3)
    finish = dataclasses.replace(
        finish,
        texture=jnp.arange(labels) % 7 + jnp.where(jnp.arange(labels) == 4, 12, 0),
        scale=jnp.full(labels, 0.7),
        lamp_colour=jnp.array([[0.5, 0.4, 0.3]]),
        fog=jnp.array(0.05),
        atlas=make_atlas([picture]),
    )
    return dataclasses.replace(scene, finish=finish)


def unfinished(count=6):
    return dataclasses.replace(furnished(count), finish=None)


def interpreted(tiling=TILING):
    return dataclasses.replace(tiling, interpret=True)


def both(scene, lens, quality, tiling):
    one = jax.jit(lambda s: render(EYE, TURN, lens, s, quality))(scene)
    other = jax.jit(lambda s: render_pallas(EYE, TURN, lens, s, quality, interpreted(tiling)))(scene)
    return np.abs(np.asarray(one).astype(int) - np.asarray(other)).max(-1), np.asarray(one)


@pytest.mark.parametrize(
    "scene, quality, lens, tiling",
    [
        (crowd(12), Quality(), pinhole(1.2, 32, 32), Tiling(8, 8)),
        (crowd(70), Quality(), pinhole(1.2, 32, 32), Tiling(8, 16)),
        (crowd(12), BEST, pinhole(1.2, 32, 32), Tiling(16, 16, words=True)),
        (furnished(), Quality(shadows=True), DISTORTED, Tiling(16, 16)),
        (unfinished(40), BEST, pinhole(1.2, 32, 32), Tiling(16, 16, sort=False)),
    ],
    ids=["plain", "several chunks", "antialias and shadows", "furnished", "rounds in the sun"],
)
def test_kernel_draws_what_the_jnp_renderer_draws(scene, quality, lens, tiling):
    difference, image = both(scene, lens, quality, tiling)
    assert image.std() > 20
    assert (difference > 1).mean() < 5e-3  # a silhouette may fall to either side


def test_order_of_the_primitives_does_not_change_the_image():
    scene, lens = crowd(70), pinhole(1.2, 16, 16)

    def draw(tiling):
        kernel = partial(render_pallas, tiling=interpreted(tiling))
        return np.asarray(jax.jit(lambda s: kernel(EYE, TURN, lens, s))(scene))

    images = [draw(Tiling(8, 8, sort=sort)) for sort in (True, False)]
    np.testing.assert_array_equal(*images)
    assert images[0].std() > 20


def test_kernel_draws_sizes_that_tiles_do_not_divide():
    scene, lens = crowd(5), pinhole(1.0, 20, 28)
    one = jax.jit(lambda s: render(EYE, TURN, lens, s))(scene)
    other = jax.jit(lambda s: render_pallas(EYE, TURN, lens, s, tiling=interpreted()))(scene)
    assert other.shape == (20, 28, 3)
    assert (np.abs(np.asarray(one).astype(int) - np.asarray(other)) > 1).mean() < 5e-3


def test_a_batch_of_kernels_equals_single_ones_and_bad_poses_are_black():
    scenes = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), crowd(4))
    eyes = jnp.stack([EYE, EYE.at[0].set(jnp.nan)])
    lens = pinhole(1.2, 16, 16)
    draw = jax.jit(jax.vmap(lambda p, s: render_pallas(p, TURN, lens, s, tiling=interpreted())))
    images = np.asarray(draw(eyes, scenes))
    single = np.asarray(jax.jit(lambda s: render(EYE, TURN, lens, s))(crowd(4)))
    assert (np.abs(images[0].astype(int) - single) > 1).mean() < 5e-3 and images[0].std() > 10
    assert not images[1].any()


@pytest.mark.parametrize(
    "scene, quality",
    [(crowd(12), Quality()), (furnished(40), BEST), (unfinished(40), Quality(shadows=True))],
    ids=["plain", "all", "rounds in the sun"],
)
def test_kernel_lowers_for_cuda(scene, quality):
    scenes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((4, *leaf.shape), leaf.dtype), scene)
    draw = jax.jit(jax.vmap(lambda s: render_pallas(EYE, TURN, DISTORTED, s, quality)))
    device = AbstractDevice("NVIDIA H200", None, "cuda")  # newer versions of JAX ask for one
    with use_abstract_mesh(AbstractMesh((1,), ("one",), (AxisType.Auto,), abstract_device=device)):
        assert "triton" in draw.trace(scenes).lower(lowering_platforms=("cuda",)).as_text()


@pytest.mark.quick
def test_sums_replace_conversions():
    x = np.linspace(-300.0, 300.0, 10001).astype(np.float32) + np.float32(0.0137)
    np.testing.assert_array_equal(fast_whole(x), np.floor(x))  # eagerly: XLA would merge the sums
    np.testing.assert_array_equal(fast_small(jnp.arange(256, dtype=jnp.uint32)), np.arange(256))
    np.testing.assert_array_equal(fast_level(np.array([0.0, 0.4, 0.6, 254.6, 255.0], np.float32)), [0, 0, 1, 255, 255])


@pytest.mark.quick
def test_tiles_that_triton_cannot_draw_are_refused():
    with pytest.raises(ValueError, match="columns is 12"):
        Tiling(8, 12)


def test_an_image_is_drawn_by_the_kernel_on_nvidia_gpus_and_by_plain_jax_elsewhere(monkeypatch):
    scene, lens = crowd(5), pinhole(1.0, 16, 16)

    def picture(scene):
        return draw(EYE, TURN, lens, scene)

    assert "platform_index" not in str(jax.make_jaxpr(picture)(scene))  # no GPU: nothing of the kernel is traced
    monkeypatch.setattr("whill_mjx.world.render.draw.runs_triton", lambda: True)
    expected = jax.jit(lambda s: render(EYE, TURN, lens, s))(scene)
    np.testing.assert_array_equal(jax.jit(picture)(scene), expected)
    device = AbstractDevice("NVIDIA H200", None, "cuda")
    with use_abstract_mesh(AbstractMesh((1,), ("one",), (AxisType.Auto,), abstract_device=device)):
        assert "triton" in jax.jit(picture).trace(scene).lower(lowering_platforms=("cuda",)).as_text()


def test_what_is_computed_beside_an_image_keeps_its_derivative(monkeypatch):
    monkeypatch.setattr("whill_mjx.world.render.draw.runs_triton", lambda: True)
    scene, lens = crowd(5), pinhole(1.0, 16, 16)

    def height_and_image(eye):
        return eye[2] ** 2, draw(eye, TURN, lens, scene)

    gradient, _ = jax.jit(jax.grad(height_and_image, has_aux=True))(EYE)
    np.testing.assert_allclose(gradient, [0, 0, 2 * EYE[2]])
