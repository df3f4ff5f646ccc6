import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dreamer_toys import SHAPE, tiny_config

from dreamer.config import DreamerConfig, preset
from dreamer.layers import image, nets
from dreamer.model import agent, optim


def random(*shape, seed=0):
    return jax.random.normal(jax.random.PRNGKey(seed), shape)


def init(config, shape=SHAPE):
    return jax.jit(lambda: agent.init_params(config, shape, 2, jax.random.PRNGKey(0)))()


@pytest.mark.quick
@pytest.mark.parametrize("size, millions", [("size1m", 0.686), ("size12m", 10.491078), ("size25m", 23.5),
                                            ("size50m", 41.6)])
def test_sizes_have_the_parameter_counts_of_the_reference(size, millions):
    params = jax.eval_shape(lambda k: agent.init_params(preset(size), (64, 64, 3), 2, k), jax.random.PRNGKey(0))
    digits = len(str(millions).partition(".")[2])
    assert round(sum(x.size for x in jax.tree.leaves(params)) / 1e6, digits) == millions


ZERO_AT_FIRST = {("reward", "out"), ("value", "out")}


def test_every_weight_starts_with_the_deviation_of_its_fan_in():
    params = init(tiny_config(deter=128, hidden=64, units=64, encoder="conv", depth=4, policy_layers=2, value_layers=2))
    weights = [(tuple(key.key for key in path[:-1]), np.asarray(leaf))
               for path, leaf in jax.tree_util.tree_leaves_with_path(params) if path[-1].key == "w"]
    assert len(weights) > 25
    for name, weight in weights:
        if name in ZERO_AT_FIRST:
            assert not np.any(weight), name
            continue
        blocks = weight.ndim == 3  # their fan-in is the full width, not that of a block
        std = 1 / np.sqrt(np.prod(weight.shape[:2] if blocks else weight.shape[:-1]))
        std *= 0.01 if name == ("policy", "out") else 1.0
        assert weight.std() == pytest.approx(std, rel=max(0.03, 4 / np.sqrt(2 * weight.size))), name
        assert np.abs(weight).max() <= 2.0 * 1.1368 * std + 1e-6, name  # cut at two deviations, not at 2
    for leaf in (params["reward"]["out"]["b"], params["value"]["out"]["b"]):
        assert not np.any(leaf)


@pytest.mark.quick
def test_norm_has_unit_root_mean_square_and_no_offset():
    x = random(4, 64) + 5.0
    root = np.asarray(x) / np.sqrt(np.mean(np.square(x), -1, keepdims=True) + 1e-4)
    np.testing.assert_allclose(nets.norm_act(x, jnp.full((64,), 2.0)), jax.nn.silu(2.0 * root), rtol=1e-5)


def plain_conv(x, params):
    return nets.conv(x, params["w"]) + params["b"]


def test_block_convolution_equals_convolution_and_pooling():
    x = random(2, 8, 8, 3)
    params = {**nets.init_conv(jax.random.PRNGKey(1), 5, 3, 4), "b": random(4, seed=2)}
    pooled = plain_conv(x, params).reshape(2, 4, 2, 4, 2, 4).max((2, 4))
    expected = nets.norm_act(pooled, params["scale"])
    np.testing.assert_allclose(nets.conv_pool(params, nets.space_to_depth(x)), expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(nets.conv_pool_pixels(params, x), expected, rtol=1e-4, atol=1e-5)


def test_folded_upsampling_equals_doubling_and_convolution():
    x = random(2, 4, 4, 3)
    params = {**nets.init_conv(jax.random.PRNGKey(1), 5, 3, 4), "b": random(4, seed=2)}
    expected = plain_conv(jnp.repeat(jnp.repeat(x, 2, 1), 2, 2), params)
    blocks = nets.upsample_conv(params, x)
    np.testing.assert_allclose(nets.depth_to_space(blocks.reshape(2, 4, 4, -1)), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.quick
@pytest.mark.parametrize("shape", [(4, 6, 3), (8, 4, 5)])
def test_block_and_patch_layouts_are_inverted_exactly(shape):
    x = jnp.arange(2 * np.prod(shape)).reshape(2, *shape)
    np.testing.assert_array_equal(nets.depth_to_space(nets.space_to_depth(x)), x)
    np.testing.assert_array_equal(image.from_patches(image.to_patches(x, 2), 2, shape), x)


@pytest.mark.parametrize("encoder", ["conv", "patch"])
def test_images_that_are_not_square_keep_their_shape(encoder):
    config, shape = tiny_config(encoder=encoder, depth=4), (32, 48, 3)

    def shown(frames):
        params = agent.init_params(config, shape, 2, jax.random.PRNGKey(0))
        deter, stoch = jnp.zeros((2, config.deter)), jnp.zeros((2, config.stoch_size))
        return image.decode(config, params["dec"], deter, stoch, shape), image.encode(config, params["enc"], frames)

    picture, tokens = jax.eval_shape(shown, jnp.zeros((3, 2, *shape), jnp.uint8))
    assert picture.shape == (2, *shape)
    assert tokens.shape == (3, 2, image.token_size(config, shape))


def test_the_patch_encoder_sees_centred_pixels():
    config = tiny_config()
    frames = jax.random.randint(jax.random.PRNGKey(3), (2, *SHAPE), 0, 256).astype(jnp.uint8)

    @jax.jit
    def both():
        params = agent.init_params(config, SHAPE, 2, jax.random.PRNGKey(0))["enc"]
        x = nets.layer(params["patch"], image.to_patches(frames / 255 - 0.5, config.patch))
        return image.encode(config, params, frames), nets.layer(params["mix"], x.reshape(2, -1))

    np.testing.assert_allclose(*both(), rtol=1e-4, atol=1e-4)


def test_reconstruction_loss_is_the_squared_error_of_the_decoded_image():
    config = tiny_config(encoder="conv", depth=4)
    params = init(config)["dec"]
    deter, stoch = random(2, config.deter), random(2, config.stoch_size)
    frames = jax.random.randint(jax.random.PRNGKey(3), (2, *SHAPE), 0, 256).astype(jnp.uint8)

    @jax.jit
    def both(params):
        return (image.decode(config, params, deter, stoch, SHAPE),
                image.reconstruction_loss(config, params, deter, stoch, frames))

    picture, loss = both(params)
    error = np.asarray(picture) - np.asarray(frames) / 255
    np.testing.assert_allclose(loss, np.square(error).sum((1, 2, 3)), rtol=1e-4)


@pytest.mark.quick
def test_an_image_that_does_not_fit_names_the_rule():
    with pytest.raises(ValueError, match="divisible by 16"):
        image.check_shape(DreamerConfig(), (60, 64, 3))


@pytest.mark.quick
@pytest.mark.parametrize(
    "field, value", [("deter", 2049), ("bins", 254), ("classes", 300), ("train_ratio", 0.0), ("behavior_lr", 0.0)]
)
def test_a_bad_configuration_names_field_value_and_rule(field, value):
    with pytest.raises(ValueError, match=f"{field} = {value}.*must"):
        DreamerConfig(**{field: value})
    with pytest.raises(ValueError, match="size13m.*size12m"):
        preset("size13m")


@pytest.mark.quick
def test_clipping_limits_the_gradient_relative_to_its_tensor():
    param, gradient = jnp.full((4,), 1.0), jnp.full((4,), 10.0)  # norms 2 and 20
    np.testing.assert_allclose(jnp.linalg.norm(optim.clip_adaptively(gradient, param, 0.3, 1e-3)), 0.6, rtol=1e-5)
    small = gradient / 1000
    np.testing.assert_array_equal(optim.clip_adaptively(small, param, 0.3, 1e-3), small)
    at_zero = optim.clip_adaptively(gradient, jnp.zeros((4,)), 0.3, 1e-3)
    np.testing.assert_allclose(jnp.linalg.norm(at_zero), 3e-4, rtol=1e-5)


def test_the_optimiser_scales_first_and_averages_second():
    config = DreamerConfig(lr=0.1, warmup=0, agc=1e9)
    params, state = {"w": jnp.array([1.0])}, optim.init({"w": jnp.array([1.0])})
    mu = nu = 0.0
    expected = 1.0
    for count, gradient in enumerate([2.0, -1.0, 0.5], 1):
        params, state = optim.update(config, params, {"w": jnp.array([gradient])}, state)
        nu = 0.999 * nu + 0.001 * gradient**2
        mu = 0.9 * mu + 0.1 * gradient / np.sqrt(nu / (1 - 0.999**count))
        expected -= 0.1 * mu / (1 - 0.9**count)
    assert float(params["w"][0]) == pytest.approx(expected, rel=1e-4)


@pytest.mark.quick
def test_policy_and_critic_may_learn_more_slowly_than_the_model():
    params = {name: {"w": jnp.ones(3)} for name in ("enc", "policy", "value")}
    gradients = jax.tree.map(jnp.ones_like, params)
    config = DreamerConfig(lr=0.1, warmup=0, behavior_lr=0.25)
    new, _ = optim.update(config, params, gradients, optim.init(params))
    moved = {name: 1.0 - float(part["w"][0]) for name, part in new.items()}
    assert moved["policy"] == moved["value"] == pytest.approx(0.25 * moved["enc"], rel=1e-4)


@pytest.mark.quick
def test_the_learning_rate_rises_linearly_and_then_stays():
    config = DreamerConfig(lr=1.0, warmup=10)
    rates = [float(optim.learning_rate(config, jnp.array(count))) for count in (0, 5, 10, 100)]
    np.testing.assert_allclose(rates, [0.0, 0.5, 1.0, 1.0], rtol=1e-6)


@pytest.mark.quick
def test_the_learning_rate_falls_to_a_twentieth_where_the_length_of_the_run_is_known():
    config = DreamerConfig(lr=1.0, warmup=10, lr_decay=110)
    rates = [float(optim.learning_rate(config, jnp.array(count))) for count in (5, 10, 60, 110, 500)]
    np.testing.assert_allclose(rates, [0.5, 1.0, 0.525, 0.05, 0.05], rtol=1e-6)
    with pytest.raises(ValueError, match="lr_decay"):
        DreamerConfig(warmup=10, lr_decay=10)
