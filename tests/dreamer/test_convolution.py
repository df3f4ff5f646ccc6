"""The forms that a CPU computes equal the ones of other devices, in value and gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dreamer_toys import tiny_config

from dreamer.layers import convolution, image, nets
from dreamer.model import agent


def random(*shape, seed=0):
    return jax.random.normal(jax.random.PRNGKey(seed), shape)


def assert_same(function, other, *arguments):
    """Values and the gradients of all arguments, up to the rounding of a float32 sum."""

    def value_and_gradients(function):
        @jax.jit
        def both(arguments):
            value, back = jax.vjp(function, *arguments)
            return value, back(jax.tree.map(lambda x: random(*x.shape, seed=9).astype(x.dtype), value))

        return [np.asarray(leaf) for leaf in jax.tree.leaves(both(arguments))]

    for mine, theirs in zip(value_and_gradients(function), value_and_gradients(other), strict=True):
        scale = float(np.max(np.abs(theirs))) + 1e-6
        np.testing.assert_allclose(mine / scale, theirs / scale, atol=2e-6)


@pytest.mark.parametrize("shape", [(3, 4, 6, 5), (2, 5, 3, 4), (1, 1, 2, 3)])
def test_the_gradients_of_a_convolution_on_a_cpu_are_those_of_jax(shape):
    assert_same(convolution.conv_on_cpu, convolution.convolve, random(*shape), random(3, 3, shape[-1], 7, seed=1))


@pytest.mark.quick
def test_the_gradient_of_the_largest_of_four_is_that_of_jax_also_between_equals():
    x = jnp.round(2.0 * random(3, 4, 4, 4, 5))
    assert_same(convolution.block_max_on_cpu, lambda x: x.max(-2), x)


@pytest.mark.quick
def test_a_product_of_blocks_does_not_depend_on_the_device(monkeypatch):
    x, weight = random(2, 3, 4, 5), random(4, 5, 6, seed=1)
    ours, back = jax.vjp(nets.block_product, x, weight)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    theirs, other_back = jax.vjp(nets.block_product, x, weight)
    for mine, other in zip((ours, *back(ours)), (theirs, *other_back(theirs)), strict=True):
        np.testing.assert_allclose(mine, other, rtol=1e-5, atol=1e-5)


def test_image_layers_have_the_same_loss_and_gradient_on_every_device(monkeypatch):
    config = tiny_config(encoder="conv", depth=4)
    shape, frames = (16, 16, 3), 2 * convolution.CHUNK  # two chunks
    params = jax.jit(lambda: agent.init_params(config, shape, 2, jax.random.PRNGKey(0)))()
    images = jax.random.bits(jax.random.PRNGKey(1), (frames, *shape), jnp.uint8)
    deter, stoch = random(frames, config.deter), random(frames, config.stoch_size, seed=2)

    def layers(params, deter, stoch):
        tokens = image.encode(config, params["enc"], images)
        return tokens, image.reconstruction_loss(config, params["dec"], deter, stoch, images)

    def as_elsewhere(*arguments):
        with monkeypatch.context() as patch:
            patch.setattr(jax, "default_backend", lambda: "gpu")
            return layers(*arguments)

    parts = {name: params[name] for name in ("enc", "dec")}
    assert_same(layers, as_elsewhere, parts, deter, stoch)


@pytest.mark.quick
@pytest.mark.parametrize("rows", [1, convolution.CHUNK, 3 * convolution.CHUNK, 67])
def test_chunks_keep_the_order_of_the_rows(rows):
    x = random(rows, 3)
    np.testing.assert_array_equal(convolution.by_chunks(lambda x: x[:, None] + 1.0, x), x[:, None] + 1.0)
