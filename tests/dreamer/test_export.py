"""The policy file: what the writer promises, checked on a small network with every operation a real policy has."""

import dataclasses
import json
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from dreamer.policy_files.export import PolicyContract, export_policy, flatten_weights
from dreamer.policy_files.network import Network, parity, to_onnx

CONTRACT = PolicyContract(action_low=(0.0, -0.6), action_high=(0.3, 0.6), task="corridor", height=16, width=16)
DETER, GROUPS, STOCH, CLASSES, HIDDEN, PATCH = 32, 4, 4, 4, 16, 8


def make_parameters(key):
    """Random parameters of a world model and actor in miniature."""
    shapes = {"conv": (5, 5, 3, 8), "conv2": (5, 5, 8, 8), "embed": (4 * 4 * 8, HIDDEN), "patch": (PATCH**2 * 3, 8),
              "patch_embed": (4 * 8, HIDDEN), "input": (STOCH * CLASSES + 2, HIDDEN),
              "gru": (GROUPS, HIDDEN + DETER // GROUPS, 3 * DETER // GROUPS),
              "posterior": (DETER + 2 * HIDDEN, STOCH * CLASSES), "actor": (DETER + STOCH * CLASSES, 2)}
    keys = jax.random.split(key, len(shapes))
    scaled = {name: jax.random.normal(k, shape) / np.sqrt(np.prod(shape[:-1])) for k, (name, shape) in
              zip(keys, shapes.items(), strict=True)}
    return {"model": scaled, "scale": jnp.ones(HIDDEN)}


def rms_norm(x, scale):
    return x * lax.rsqrt(jnp.mean(x * x, axis=-1, keepdims=True) + 1e-4) * scale


def make_step(params):
    """Return step(carry, image) of one instance: conv and patch encoder, block GRU, argmax latent, tanh mode."""
    model = params["model"]

    def step(carry, image):
        x = image.astype(jnp.float32) / 255 - 0.5
        y = x
        for kernel in (model["conv"], model["conv2"]):
            y = lax.conv_general_dilated(y[None], kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))[0]
            y = jax.nn.silu(lax.reduce_window(y, -jnp.inf, lax.max, (2, 2, 1), (2, 2, 1), "VALID"))
        conv = rms_norm(y.reshape(-1) @ model["embed"], params["scale"])
        n = x.shape[0] // PATCH
        patches = x.reshape(n, PATCH, n, PATCH, 3).transpose(0, 2, 1, 3, 4).reshape(n * n, -1) @ model["patch"]
        patch = jax.nn.silu(rms_norm(patches.reshape(-1) @ model["patch_embed"], params["scale"]))
        latent = jnp.concatenate([carry["stoch"].reshape(-1), carry["previous_action"]]) @ model["input"]
        hidden = jax.nn.silu(rms_norm(latent, params["scale"]))
        blocks = carry["deter"].reshape(GROUPS, -1)
        gates = jnp.einsum("gi,gio->go", jnp.concatenate([jnp.tile(hidden, (GROUPS, 1)), blocks], -1), model["gru"])
        reset, candidate, update = jnp.split(gates, 3, axis=-1)
        candidate = jnp.tanh(jax.nn.sigmoid(reset) * candidate)
        update = jax.nn.sigmoid(update - 1)
        deter = (update * candidate + (1 - update) * blocks).reshape(-1)
        logits = (jnp.concatenate([deter, conv, patch]) @ model["posterior"]).reshape(STOCH, CLASSES)
        stoch = jax.nn.one_hot(jnp.argmax(logits, -1), CLASSES)
        action = jnp.tanh(jnp.concatenate([deter, stoch.reshape(-1)]) @ model["actor"])
        return {"deter": deter, "stoch": stoch, "previous_action": action}, action

    return step


ZERO_CARRY = {"deter": np.zeros(DETER, np.float32), "stoch": np.zeros((STOCH, CLASSES), np.float32),
              "previous_action": np.zeros(2, np.float32)}


@pytest.fixture(scope="module")
def params():
    return make_parameters(jax.random.key(0))


@pytest.fixture(scope="module")
def exported(tmp_path_factory, params):
    vehicle = tmp_path_factory.mktemp("vehicle") / "chair.toml"
    vehicle.write_text("schema = 1\n")
    path = tmp_path_factory.mktemp("policy") / "corridor"
    return export_policy(path, make_step(params), ZERO_CARRY, params, CONTRACT, vehicle_file=vehicle, check_steps=50)


def test_exported_network_acts_like_the_jax_network_over_many_recurrent_steps(exported, params):
    from bridge.policy import Policy

    policy = Policy.load(exported)
    step, carry = jax.jit(make_step(params)), ZERO_CARRY
    rng = np.random.default_rng(7)
    low, high = np.array(CONTRACT.action_low), np.array(CONTRACT.action_high)
    for _ in range(100):
        image = rng.integers(0, 256, (16, 16, 3), np.uint8)
        carry, action = step(carry, image)
        np.testing.assert_allclose(policy.step(image), low + (high - low) * (np.asarray(action) + 1) / 2, atol=2e-6)


def test_description_records_contract_hashes_and_parity(exported):
    description = json.loads((exported / "policy.json").read_text())
    assert description["schema"] == 1 and description["kind"] == "micromobility-policy"
    assert description["action"]["high"] == [0.3, 0.6] and description["rate_hz"] == 10
    assert [entry["name"] for entry in description["carry"]] == list(ZERO_CARRY)
    assert set(description["files"]) == {"policy.onnx", "weights.npz", "vehicle.toml"}
    assert description["vehicle_sha256"] == description["files"]["vehicle.toml"]
    assert description["parity"]["steps"] == 50 and description["parity"]["max_abs_action_difference"] < 1e-5


def test_network_uses_only_standard_operators_of_the_stated_version(exported):
    onnx = pytest.importorskip("onnx")
    model = onnx.load(exported / "policy.onnx")
    assert {node.domain for node in model.graph.node} <= {"", "ai.onnx"}
    assert [(entry.domain, entry.version) for entry in model.opset_import] == [("", 18)] and not model.functions


def test_archived_weights_are_the_parameters_without_pickle(exported, params):
    with np.load(exported / "weights.npz", allow_pickle=False) as weights:
        assert set(weights.files) == {"scale", *(f"model/{name}" for name in params["model"])}
        np.testing.assert_array_equal(weights["model/gru"], params["model"]["gru"])


@pytest.mark.quick
def test_half_precision_weights_are_archived_as_float32():
    (value,) = flatten_weights({"w": jnp.ones(3, jnp.bfloat16)}).values()
    assert value.dtype == np.float32 and (value == 1).all()


def test_second_export_replaces_the_first_and_leaves_nothing_behind(tmp_path):
    def step(carry, image):
        return {"h": carry["h"] + image.mean()}, jnp.tanh(carry["h"][:2])

    carry = {"h": np.zeros(3, np.float32)}
    for task in ("first", "second"):
        contract = dataclasses.replace(CONTRACT, task=task)
        export_policy(tmp_path / "p", step, carry, {"none": np.zeros(1)}, contract, check_steps=3)
    assert json.loads((tmp_path / "p" / "policy.json").read_text())["task"] == "second"
    assert [item.name for item in tmp_path.iterdir()] == ["p"]


def test_zip_of_the_folder_is_a_policy_file_too(exported, tmp_path):
    from bridge.policy import Policy

    with zipfile.ZipFile(tmp_path / "p.zip", "w") as archive:
        for item in exported.iterdir():
            archive.write(item, f"corridor/{item.name}")
    image = np.full((16, 16, 3), 90, np.uint8)
    np.testing.assert_array_equal(Policy.load(tmp_path / "p.zip").step(image), Policy.load(exported).step(image))


def test_stablehlo_gives_the_same_action_as_the_step(tmp_path):
    pytest.importorskip("flatbuffers")
    from jax import export

    def step(carry, image):
        return {"h": 0.5 * carry["h"] + image.mean() / 255}, jnp.tanh(carry["h"][:2])

    carry = {"h": np.arange(3, dtype=np.float32)}
    path = export_policy(tmp_path / "p", step, carry, {}, CONTRACT, stablehlo=True, check_steps=3)
    restored = export.deserialize(bytearray((path / "policy.stablehlo").read_bytes()))
    image = np.full((16, 16, 3), 40, np.uint8)
    np.testing.assert_allclose(restored.call(carry, image)[1], step(carry, jnp.asarray(image))[1], rtol=1e-6)


@pytest.mark.quick
@pytest.mark.parametrize("step, message", [
    (lambda carry, image: (carry, jnp.zeros(3)), r"action of shape \(3,\)"),
    (lambda carry, image: ({"h": carry["h"].astype(jnp.bfloat16)}, jnp.zeros(2)), "changes its carry"),
])
def test_step_that_breaks_the_contract_is_refused_and_nothing_is_written(tmp_path, step, message):
    with pytest.raises(ValueError, match=message):
        export_policy(tmp_path / "p", step, {"h": np.zeros(2, np.float32)}, {}, CONTRACT)
    assert not list(tmp_path.iterdir())


def test_step_that_onnx_computes_differently_is_refused(tmp_path, monkeypatch):
    import dreamer.policy_files.export

    def step(carry, image):
        return carry, jnp.tanh(image[0, 0, :2] / 255.0)

    def wrong_model(network):
        wrong = lambda carry, obs: (carry, (jnp.tanh(obs["image"][0, 0, 1:] / 255.0),))  # noqa: E731
        return original(dataclasses.replace(network, step=wrong))

    original = dreamer.policy_files.export.to_onnx
    monkeypatch.setattr(dreamer.policy_files.export, "to_onnx", wrong_model)
    with pytest.raises(ValueError, match="it differs from JAX"):
        export_policy(tmp_path / "p", step, {"h": np.zeros(2, np.float32)}, {}, CONTRACT, check_steps=5)
    assert not list(tmp_path.iterdir())


@pytest.mark.quick
def test_existing_folder_that_is_no_policy_is_never_replaced(tmp_path):
    (tmp_path / "p").mkdir()
    (tmp_path / "p" / "thesis.txt").write_text("work")
    with pytest.raises(ValueError, match="not a policy file"):
        export_policy(tmp_path / "p", lambda carry, image: (carry, jnp.zeros(2) + image[0, 0, 0] * 0.0),
                      {"h": np.zeros(2, np.float32)}, {}, CONTRACT, check_steps=1)
    assert (tmp_path / "p" / "thesis.txt").read_text() == "work"


@pytest.mark.quick
def test_vehicle_file_must_be_the_one_of_the_contract(tmp_path):
    (tmp_path / "chair.toml").write_text("schema = 1\n")
    with pytest.raises(ValueError, match="SHA-256"):
        export_policy(tmp_path / "p", lambda carry, image: (carry, jnp.zeros(2) + image[0, 0, 0] * 0.0),
                      {"h": np.zeros(2, np.float32)}, {}, dataclasses.replace(CONTRACT, vehicle_sha256="0" * 64),
                      vehicle_file=tmp_path / "chair.toml", check_steps=1)


@pytest.mark.quick
@pytest.mark.parametrize("change", [{"action_low": (1.0, 0.0)}, {"rate_hz": 0.0}, {"action_high": (np.nan, 1.0)}])
def test_contract_without_meaning_is_refused(change):
    with pytest.raises(ValueError, match="PolicyContract"):
        dataclasses.replace(CONTRACT, **change)


@pytest.mark.parametrize("encoder", ["conv", "patch"])
def test_policy_of_the_learner_runs_on_the_vehicle_as_it_does_in_jax(tmp_path, encoder):
    from bridge.policy import Policy
    from dreamer.config import DreamerConfig
    from dreamer.model import agent

    config = DreamerConfig(encoder=encoder, deter=32, hidden=16, units=16, stoch=4, classes=4, blocks=4, depth=4,
                           mults=(1, 2), patch_units=4, policy_outscale=1.0, learning_starts=0)
    params = agent.init_params(config, (16, 16, 3), 2, jax.random.key(1))

    def step(carry, image):
        return agent.policy_step(config, params, carry, image)

    carry = agent.policy_carry(config, 2)
    path = export_policy(tmp_path / "p", step, carry, params, CONTRACT, check_steps=30)
    policy, jitted = Policy.load(path), jax.jit(step)
    rng = np.random.default_rng(3)
    commands = []
    for _ in range(20):
        image = rng.integers(0, 256, (16, 16, 3), np.uint8)
        carry, action = jitted(carry, image)
        commands.append(policy.step(image))
        low, high = np.array(CONTRACT.action_low), np.array(CONTRACT.action_high)
        np.testing.assert_allclose(commands[-1], low + (high - low) * (np.asarray(action) + 1) / 2, atol=1e-5)
    assert np.ptp(commands, axis=0).min() > 1e-3  # the actions do depend on what is seen


def test_windows_over_a_batch_of_images_run_on_the_vehicle(tmp_path):
    def step(carry, image):
        x = image[None].astype(jnp.float32) / 255
        top = lax.reduce_window(x, -jnp.inf, lax.max, (1, 4, 2, 1), (1, 4, 2, 1), "VALID")
        return {"h": carry["h"] + top.mean()}, jnp.tanh(top[0, 1, 2, :2] - carry["h"])

    path = export_policy(tmp_path / "p", step, {"h": np.zeros(2, np.float32)}, {}, CONTRACT, check_steps=5)
    assert json.loads((path / "policy.json").read_text())["parity"]["max_abs_action_difference"] < 1e-6


def test_frame_reads_no_weight_that_only_the_state_before_it_meets(tmp_path):
    """A product with (state, image) side by side is two products: the state's is over when the frame comes."""
    from bridge.policy.halves import Cut

    weights = jax.random.normal(jax.random.key(0), (1024 + 768, 64)) / 50

    def step(carry, image):
        deter = jnp.tanh(carry["deter"] + 1)
        both = jnp.concatenate([deter[None], image.reshape(1, -1).astype(jnp.float32) / 255], -1)
        return {"deter": deter}, jnp.tanh(both @ weights)[0, :2]

    carry = {"deter": np.zeros(1024, np.float32)}
    path = export_policy(tmp_path / "p", step, carry, {}, CONTRACT, check_steps=20)
    cut = Cut((path / "policy.onnx").read_bytes(), frozenset(["image"]))
    assert len(cut.first()) > 4 * 1024 * 64 and len(cut.second([])) < 4 * 1024 * 64


def test_exporting_leaves_jax_as_it_was(tmp_path):
    before = dict(vars(jnp))
    step = lambda carry, image: (carry, jnp.tanh(jnp.cumsum(carry["h"])))  # noqa: E731
    export_policy(tmp_path / "p", step, {"h": np.zeros(2, np.float32)}, {}, CONTRACT, check_steps=1)
    assert all(vars(jnp)[name] is value for name, value in before.items())


def test_rounding_that_a_recurrent_state_amplifies_is_noted_and_not_refused(tmp_path):
    """A logistic map doubles the rounding of its exp and log each step: in the end the two runs share nothing."""

    def step(carry, image):
        mapped = jnp.clip(3.9 * carry["h"] * (1 - carry["h"]), 0.05, 0.99)
        h = jnp.where(carry["h"] == 0, 0.3, jnp.exp(jnp.log(mapped) / 3) ** 3)
        return {"h": h}, jnp.tanh(h * jnp.array([1.0, -1.0])) + 0.0 * image[0, 0, 0]

    path = export_policy(tmp_path / "p", step, {"h": np.zeros((), np.float32)}, {}, CONTRACT, check_steps=150)
    parity = json.loads((path / "policy.json").read_text())["parity"]
    assert parity["max_abs_action_difference"] < 1e-5 < parity["max_abs_action_drift"]


def test_a_gpu_that_rounds_by_default_is_no_reason_to_refuse():
    """The file is compared with JAX at full float32; TF32 and the like round to fewer bits than the check allows."""

    def step(carry, obs, rounded=0.0):
        return carry, (jnp.tanh(carry["h"]) + rounded + 0.0 * obs["image"][0, 0, 0],)

    def on_a_gpu(carry, obs):
        return step(carry, obs, 0.0 if jax.config.jax_default_matmul_precision == "highest" else 1e-3)

    shapes = {"h": jax.ShapeDtypeStruct((2,), np.float32)}, {"image": jax.ShapeDtypeStruct((16, 16, 3), np.uint8)}
    checked = parity(to_onnx(Network(step, *shapes)), Network(on_a_gpu, *shapes), 5)
    assert checked["max_abs_action_difference"] < 1e-5


def test_a_rare_step_may_round_and_may_not_be_wrong():
    shapes = {"h": jax.ShapeDtypeStruct((1,), np.float32)}, {"image": jax.ShapeDtypeStruct((16, 16, 3), np.uint8)}

    def network(off):
        """The third step is off."""

        def step(carry, obs):
            late = jnp.where(carry["h"] == 2.0, off, 0.0)
            return {"h": carry["h"] + 1.0}, (jnp.tanh(obs["image"][0, 0, :1] / 510.0) + late,)

        return Network(step, *shapes)

    checked = parity(to_onnx(network(2e-5)), network(0.0), 20)
    assert checked["median_abs_action_difference"] < 1e-6 and checked["max_abs_action_difference"] > 1e-5
    with pytest.raises(ValueError, match="0.002 at most"):
        parity(to_onnx(network(2e-3)), network(0.0), 20)
