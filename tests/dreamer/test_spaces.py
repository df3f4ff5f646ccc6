"""Observations of several keys, and actions that are classes."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dreamer_toys import SHAPE, choice_env, corridor_env, tiny_config
from PIL import Image

from dreamer import spaces, video
from dreamer.config import preset
from dreamer.experience import iteration
from dreamer.layers import distributions as dist
from dreamer.layers import nets, sensors
from dreamer.model import agent, behavior, rssm
from dreamer.model.rssm import Latent
from dreamer.spaces import Box, Discrete
from dreamer.train import TrainingOptions, evaluate, train
from dreamer.training import checkpoint

CONFIG = tiny_config()
KEY = jax.random.PRNGKey(0)
BOTH = {"depth": (16, 16, 1), "camera": SHAPE, "lidar": (5,), "speed": (2,)}


def observation(shapes, batch=(2,)):
    """Noise of these shapes."""
    key = jax.random.PRNGKey(3)

    def one(shape):
        if len(shape) == 3:
            return jax.random.randint(key, (*batch, *shape), 0, 256).astype(jnp.uint8)
        return 100.0 * jax.random.normal(key, (*batch, *shape))

    return {name: one(shape) for name, shape in shapes.items()}


@pytest.mark.quick
def test_images_are_joined_along_channels_and_vectors_end_to_end_in_the_order_of_their_names():
    assert spaces.image_shape(BOTH) == (16, 16, 4) and spaces.vector_size(BOTH) == 7
    obs = observation(BOTH)
    np.testing.assert_array_equal(spaces.image_of(obs), np.concatenate([obs["camera"], obs["depth"]], -1))
    np.testing.assert_array_equal(spaces.vector_of(obs), np.concatenate([obs["lidar"], obs["speed"]], -1))
    assert spaces.image_of({"lidar": obs["lidar"]}) is None and spaces.vector_of(obs["depth"]) is None


@pytest.mark.quick
@pytest.mark.parametrize(
    "shape, rule",
    [
        ({"a": (8, 8, 3), "b": (16, 16, 3)}, "one height and width"),
        ({"a": (4, 4)}, "image .* or a vector"),
        ({}, "there must be"),
    ],
)
def test_an_observation_of_no_known_kind_names_the_rule(shape, rule):
    with pytest.raises(ValueError, match=rule):
        spaces.image_shape(shape)


@pytest.mark.quick
def test_an_environment_that_shows_something_else_than_it_declares_is_refused():
    env = dataclasses.replace(choice_env(4), obs_shape={"camera": SHAPE, "place": (4,)})
    with pytest.raises(ValueError, match="range.*Correct one of them"):
        jax.eval_shape(lambda: iteration.init_state(env, CONFIG, 0))
    with pytest.raises(ValueError, match="at least 2 classes"):
        spaces.actions(Discrete(1))


def test_one_image_alone_has_the_parameters_it_always_had():
    names = {
        jax.tree_util.keystr(path, simple=True, separator=".")
        for path, _ in jax.tree_util.tree_flatten_with_path(
            jax.eval_shape(lambda k: agent.init_params(CONFIG, SHAPE, 2, k), KEY)
        )[0]
    }
    assert {"enc.patch.w", "enc.mix.w", "dec.patch.w", "dec.stoch0.w"} <= names
    assert not any("vector" in name for name in names)
    make = jax.jit(lambda: [agent.init_params(CONFIG, shape, 2, KEY) for shape in (SHAPE, {"camera": SHAPE})])
    alone, named = make()
    jax.tree.map(np.testing.assert_array_equal, alone, named)


@pytest.mark.quick
def test_size1m_on_joint_angles_has_about_the_parameters_of_the_reference():
    """The reference has 0.640 M without saying of which task; inputs of 24 numbers and 6 actions are a walker's."""
    params = jax.eval_shape(lambda k: agent.init_params(preset("size1m"), (24,), 6, k), KEY)
    assert sum(x.size for x in jax.tree.leaves(params)) == pytest.approx(640_000, rel=0.02)


def test_vectors_are_encoded_and_predicted_as_their_symlogs():
    enc = sensors.init_encoder(CONFIG, {"lidar": (5,)}, KEY)
    dec = sensors.init_decoder(CONFIG, {"lidar": (5,)}, KEY)
    lidar = observation(BOTH)["lidar"]
    squeezed = np.sign(lidar) * np.log1p(np.abs(lidar))
    np.testing.assert_allclose(
        sensors.encode(CONFIG, enc, {"lidar": lidar}), nets.mlp(enc["vector"], jnp.asarray(squeezed)), rtol=1e-5
    )
    latent = Latent(jax.random.normal(KEY, (2, CONFIG.deter)), jnp.zeros((2, CONFIG.stoch_size)))
    predicted = np.asarray(sensors.decode_vector(dec, latent.features()))
    losses = sensors.reconstruction_losses(CONFIG, dec, latent, {"lidar": lidar})
    assert set(losses) == {"recon_vector"}
    np.testing.assert_allclose(losses["recon_vector"], np.square(predicted - squeezed).sum(-1), rtol=1e-5)
    heavier = dataclasses.replace(CONFIG, recon_scale=2.0, vector_scale=3.0)
    weighted = sensors.representation_losses(heavier, dec, latent, {"lidar": lidar}, None)
    np.testing.assert_allclose(weighted["recon_vector"], 6.0 * losses["recon_vector"], rtol=1e-5)


def test_tokens_have_the_declared_width_whatever_is_seen():
    for encoder in ("patch", "conv"):
        config = tiny_config(encoder=encoder, depth=4)
        for shape in (SHAPE, (5,), BOTH):
            obs = observation(shape) if isinstance(shape, dict) else observation({"x": shape})["x"]

            def tokens(obs, config=config, shape=shape):
                return sensors.encode(config, sensors.init_encoder(config, shape, KEY), obs)

            assert jax.eval_shape(tokens, obs).shape == (2, sensors.token_size(config, shape))


@pytest.mark.quick
@pytest.mark.parametrize("kind", [Box(1), Box(3), Discrete(2), Discrete(5)])
def test_the_parameters_tell_the_kind_of_action(kind):
    params = jax.eval_shape(lambda k: agent.init_params(CONFIG, (4,), kind, k), KEY)
    assert spaces.actions_of(params) == kind
    assert spaces.actions(3) == Box(3) and spaces.actions(kind) is kind


def test_classes_are_drawn_as_often_as_the_uniform_share_and_the_logits_say():
    kind, raw = Discrete(4), jnp.array([2.0, 0.0, -1.0, -30.0])
    probs = 0.99 * jax.nn.softmax(raw) + 0.01 / 4
    rows = jnp.broadcast_to(raw, (20_000, 4))
    drawn = kind.sample(CONFIG, rows, kind.noise(KEY, (20_000,)))
    np.testing.assert_array_equal(jnp.sum(drawn, -1), 1.0)
    np.testing.assert_allclose(jnp.mean(drawn, 0), probs, atol=0.01)
    assert 10 < float(jnp.sum(drawn[:, 3])) < 100  # the uniform share alone: 50 expected
    log_prob, entropy = kind.score(CONFIG, rows[:4], jnp.eye(4))
    np.testing.assert_allclose(log_prob, np.log(probs), rtol=1e-4)
    np.testing.assert_allclose(entropy, -np.sum(probs * np.log(probs)), rtol=1e-5)
    np.testing.assert_array_equal(kind.to_env(jnp.eye(4)), [0, 1, 2, 3])
    np.testing.assert_array_equal(kind.mode(CONFIG, raw), [1, 0, 0, 0])
    uniform = kind.random(KEY, (20_000,))
    np.testing.assert_allclose(jnp.mean(uniform, 0), 0.25, atol=0.02)


def test_the_policy_gradient_of_a_class_is_that_of_reinforce():
    """d/d logits of -E[log p(a) A] is the mean of -(a - p) A without a uniform share; no gradient passes the draw."""
    kind, config = Discrete(3), dataclasses.replace(CONFIG, unimix=0.0, entropy_scale=0.0)
    raw, advantage = jnp.array([0.3, -0.2, 0.1]), jnp.array([1.0, -2.0, 0.5])

    def loss(raw, index):
        action = dist.one_hot(jnp.array(index), 3)
        log_prob, entropy = kind.score(config, raw, action)
        return behavior.actor_loss(config, log_prob, entropy, advantage[index], jnp.ones(()))

    for index in range(3):
        expected = -(np.eye(3)[index] - np.asarray(jax.nn.softmax(raw))) * float(advantage[index])
        np.testing.assert_allclose(jax.grad(loss)(raw, index), expected, rtol=1e-5)


def test_imagined_classes_are_one_hot_and_the_model_gets_no_gradient_of_the_actor():
    config = tiny_config()
    state = jax.jit(lambda: agent.init_agent(config, (4,), Discrete(3), KEY))()
    actions = jax.jit(lambda p: behavior.imagine(config, p, rssm.initial(config, 6), KEY).actions)(state.params)
    assert actions.shape == (config.imag_horizon + 1, 6, 3)
    np.testing.assert_array_equal(np.sort(actions, -1)[..., -1], 1.0)
    np.testing.assert_array_equal(jnp.sum(actions, -1), 1.0)

    def policy_loss(params):
        norm = state.return_norm
        losses, *_ = behavior.imagination_loss(config, params, state.slow_value, norm, rssm.initial(config, 6), KEY)
        return jnp.sum(losses["policy"])

    gradients = jax.jit(jax.grad(policy_loss))(state.params)
    assert np.any(np.asarray(gradients["policy"]["out"]["b"]))  # at the start by the entropy
    assert not any(np.any(leaf) for leaf in jax.tree.leaves({k: v for k, v in gradients.items() if k != "policy"}))


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    config = tiny_config(lr=1e-3, train_ratio=64.0)
    quiet = TrainingOptions(progress=False, log_every_s=1.0, checkpoint_every_s=1e9)
    return config, train(choice_env(4), config, tmp_path_factory.mktemp("choice"), 600, 0, quiet)


def test_a_corridor_with_classes_and_three_senses_is_learned_to_its_best_return(learned):
    config, run = learned
    result = evaluate(choice_env(4), config, run.agent.params, jax.random.PRNGKey(1), 6)
    np.testing.assert_allclose(result["return"], np.full(6, 1.0 - 0.05 * 2), atol=1e-5)
    assert run.last_metrics["policy_certainty"] > 0.6 and run.last_metrics["loss_recon_vector"] < 1.0


def test_what_follows_is_foreseen_from_the_first_frame_and_the_actions_alone(learned, tmp_path):
    config, run = learned
    params = run.agent.params
    seen = jax.jit(lambda key: video.play(choice_env(6), config, params, key, 4))(jax.random.PRNGKey(4))
    truth = np.asarray(seen["obs"]["camera"])
    imagined = np.asarray(jax.jit(lambda: video.predict(config, params, seen, 1, KEY))())
    moved = truth[-1, :, 0, 0, 0] > 100
    assert moved.sum() >= 4
    assert np.abs(imagined - truth / 255)[1:, moved].mean() < 0.1
    still = {**seen, "prev_action": jnp.broadcast_to(jnp.array([1.0, 0.0, 0.0]), seen["prev_action"].shape)}
    back = np.asarray(jax.jit(lambda: video.predict(config, params, still, 1, KEY))())
    assert back[-1, moved].mean() < 0.4 < truth[-1, moved].mean() / 255  # told that it went back, it imagines so
    pictures = video.frames(truth, imagined, 1)
    assert pictures.shape == (4, 48, 6 * 16, 3) and pictures[0, 16, 5].tolist() == [0, 255, 0]
    np.testing.assert_array_equal(pictures[:, :16, :16], truth[:, 0])
    for name in ("a.gif", "a.png"):
        path = video.write(tmp_path / name, pictures)
        with Image.open(path) as image:
            assert image.size == (192, 96) and getattr(image, "n_frames", 1) == (4 if name == "a.gif" else 1)
    with pytest.raises(ValueError, match="suffix"):
        video.write(tmp_path / "a.mp4", pictures)


def test_every_sense_is_stored_with_its_own_step_and_comes_back_from_the_checkpoint(learned):
    config, run = learned
    template = jax.jit(lambda: iteration.init_state(choice_env(4), config, 0))()
    memory = checkpoint.restore(run.out / "checkpoints", template, config)[0].replay
    rows = int(jnp.minimum(memory.written, memory.reward.shape[0]))
    place = np.asarray(memory.obs["place"])[:rows].argmax(-1)
    assert set(np.unique(place)) == {0, 1, 2, 3}
    np.testing.assert_array_equal(np.asarray(memory.obs["range"])[:rows, :, 0], 50.0 * place)
    np.testing.assert_array_equal(np.asarray(memory.obs["camera"])[:rows, :, 0, 0, 0], np.round(255 * place / 3))
    np.testing.assert_array_equal(np.asarray(memory.action)[:rows].sum(-1), 1.0)
    np.testing.assert_array_equal(np.asarray(memory.is_terminal)[:rows], place == 3)


@pytest.mark.quick
def test_a_checkpoint_from_before_a_field_existed_is_read_with_its_default():
    saved = {name: value for name, value in dataclasses.asdict(CONFIG).items() if name != "vector_layers"}
    saved = json.loads(json.dumps(saved))
    assert checkpoint._check_config(Path("x"), saved, CONFIG) is None
    with pytest.raises(checkpoint.CheckpointError, match="vector_layers: saved 3, now 2"):
        checkpoint._check_config(Path("x"), saved, dataclasses.replace(CONFIG, vector_layers=2))


@pytest.mark.quick
def test_environments_are_told_apart_by_identity_and_can_be_static():
    first, second = corridor_env(2), corridor_env(2)
    assert len({first, second, choice_env(2)}) == 3
