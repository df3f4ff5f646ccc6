"""Exported agents: any observations and actions, each observation an ONNX input by its name."""

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import pytest
from dreamer_toys import tiny_config

import dreamer.policy_files.export
from bridge.policy import Policy as Driver
from bridge.policy import PolicyFileError
from dreamer.layers import sensors
from dreamer.model import agent
from dreamer.policy import Policy, of_agent
from dreamer.policy_files.export import PolicyContract, SensingPolicy, export_agent, export_sensing
from dreamer.policy_files.network import Network
from dreamer.spaces import Box, Discrete

CONFIG = tiny_config(policy_outscale=3.0, compute_dtype="bfloat16")
AIDED = dataclasses.replace(CONFIG, decode_only=("bearing", "depth"))
SENSES = {"speed": (2,), "camera": (16, 16, 3), "bearing": (1,), "depth": (16, 16, 1)}
CASES = {"choice": (AIDED, SENSES, Discrete(3)), "vector": (CONFIG, (5,), Box(2))}


def params_of(config, shape, action):
    return jax.jit(lambda: agent.init_params(config, shape, action, jax.random.PRNGKey(0)))()


def noise(rng, shape):
    if isinstance(shape, dict):
        return {name: noise(rng, one) for name, one in shape.items()}
    return rng.integers(0, 256, shape, np.uint8) if len(shape) == 3 else rng.normal(size=shape).astype(np.float32)


@pytest.fixture(scope="module", params=list(CASES))
def exported(request, tmp_path_factory):
    config, shape, action = CASES[request.param]
    params = params_of(config, shape, action)
    path = tmp_path_factory.mktemp("policy") / request.param
    return request.param, export_agent(path, config, params, shape, action, task="toy"), params


def test_an_exported_agent_acts_in_onnxruntime_as_it_does_in_jax(exported):
    name, path, params = exported
    config, shape, action = CASES[name]
    file, memory = Policy.load(path), of_agent(config, params, shape, action)
    assert file.obs_shape == memory.obs_shape == sensors.visible(config, shape)
    rng, carries, taken = np.random.default_rng(1), [None, None], []
    for _ in range(20):
        obs = noise(rng, file.obs_shape)
        (a, carries[0]), (b, carries[1]) = file.step(obs, carries[0]), memory.step(obs, carries[1])
        assert a.dtype == b.dtype and a.shape == b.shape
        np.testing.assert_allclose(a, b, atol=1e-5)
        taken.append(a)
    assert len(np.unique(taken, axis=0)) > 1  # the actions do depend on what is seen
    with pytest.raises(ValueError, match="trained with.*Convert it"):
        file.step(np.zeros(4, np.float32))


def test_the_network_has_an_input_for_each_seen_observation_and_none_for_a_target(exported):
    import onnxruntime

    name, path, _ = exported
    session = onnxruntime.InferenceSession(str(path / "policy.onnx"), providers=["CPUExecutionProvider"])
    inputs = {tensor.name: (tensor.type, tuple(tensor.shape)) for tensor in session.get_inputs()}
    seen = {key: value for key, value in inputs.items() if not key.startswith("carry_")}
    outputs = [tensor.name for tensor in session.get_outputs()]
    table = json.loads((path / "policy.json").read_text())
    assert table["onnx"]["inputs"] == list(inputs) and table["onnx"]["outputs"] == outputs
    assert set(table["files"]) == {"policy.onnx", "weights.npz"} and table["task"] == "toy"
    assert table["parity"]["max_abs_action_difference"] <= 1e-5 and table["parity"]["steps"] == 200
    if name == "vector":
        assert seen == {"observation": ("tensor(float)", (5,))} and outputs[:2] == ["action", "next_deter"]
        assert table["observation"] == [5] and table["action"] == {"kind": "box", "size": 2}
        return
    assert seen == {"camera": ("tensor(uint8)", (16, 16, 3)), "speed": ("tensor(float)", (2,))}
    assert outputs[:2] == ["action", "probabilities"] and table["action"] == {"kind": "discrete", "size": 3}
    feed = {key: np.zeros(shape, np.uint8 if "uint8" in kind else np.float32) for key, (kind, shape) in inputs.items()}
    action, probabilities = session.run(["action", "probabilities"], feed)
    assert int(action) == int(np.argmax(probabilities)) and probabilities.sum() == pytest.approx(1.0, abs=1e-5)


def test_a_file_that_changed_after_the_export_is_refused(exported, tmp_path):
    _, path, _ = exported
    for item in path.iterdir():
        (tmp_path / item.name).write_bytes(item.read_bytes())
    (tmp_path / "weights.npz").write_bytes(b"other")
    with pytest.raises(ValueError, match="weights.npz.*SHA-256.*export the policy again"):
        Policy.load(tmp_path)


def test_a_network_that_prefers_its_classes_otherwise_is_refused(tmp_path, monkeypatch):
    """Logits that are all a little off choose the same class: the probabilities show it."""
    config, shape, action = dataclasses.replace(CONFIG, decode_only=()), (5,), Discrete(3)
    params = params_of(config, shape, action)

    def warped(network):
        def step(carry, obs):
            carry, (chosen, probabilities) = network.step(carry, obs)
            return carry, (chosen, probabilities * 0.999)

        return original(dataclasses.replace(network, step=step))

    original = dreamer.policy_files.export.to_onnx
    monkeypatch.setattr(dreamer.policy_files.export, "to_onnx", warped)
    with pytest.raises(ValueError, match="it differs from JAX"):
        export_agent(tmp_path / "p", config, params, shape, action)
    assert not list(Path(tmp_path).iterdir())


@pytest.mark.quick
def test_parameters_of_other_actions_or_several_seeds_are_refused(tmp_path):
    params = {"policy": {"out": {"b": np.zeros((2, 4))}}}
    with pytest.raises(ValueError, match=r"shape \(2, 4\).*dreamer.training.seeds.pick"):
        export_agent(tmp_path / "p", CONFIG, params, (5,), 2)
    with pytest.raises(ValueError, match=r"Discrete\(classes=4\) needs \(4,\)"):
        export_agent(tmp_path / "p", CONFIG, {"policy": {"out": {"b": np.zeros(3)}}}, (5,), Discrete(4))


@pytest.mark.quick
def test_an_observation_with_the_name_of_another_tensor_is_refused():
    one = {"h": jax.ShapeDtypeStruct((1,), np.float32)}
    network = Network(lambda carry, obs: (carry, ()), one, {"carry_h": one["h"]})
    with pytest.raises(ValueError, match="observation carry_h.*Rename"):
        network.tensors  # noqa: B018


def test_a_vehicle_refuses_an_agent_without_units_and_rates(exported):
    from bridge.policy import Policy as VehiclePolicy
    from bridge.policy import PolicyFileError

    with pytest.raises(PolicyFileError, match="the agent drives no vehicle: its action has no low and high"):
        VehiclePolicy.load(exported[1])


def test_what_is_believed_of_a_vector_is_found_by_its_name_among_all():
    """The decoder predicts all vectors, those before in the alphabet first."""
    shape = {**SENSES, "world": (3,)}  # joined: bearing (1), speed (2), world (3)
    params = params_of(AIDED, shape, Box(2))
    out = params["dec"]["vector"]["out"]
    params["dec"]["vector"]["out"] = {name: jax.numpy.zeros_like(leaf) for name, leaf in out.items()}
    params["dec"]["vector"]["out"]["b"] = jax.numpy.log1p(jax.numpy.arange(6.0))
    carry = agent.policy_carry(AIDED, Box(2))
    for name, expected in (("bearing", [0.0]), ("speed", [1.0, 2.0]), ("world", [3.0, 4.0, 5.0])):
        np.testing.assert_allclose(agent.believed(params, carry, shape, name), expected, atol=1e-5)


def test_an_agent_that_drives_keeps_the_limits_of_its_surprise_and_false_ones_are_refused(tmp_path):
    def step(carry, obs):
        surprise = carry["surprise"] + obs["goal"][:1]
        return {"surprise": surprise}, jax.numpy.clip(obs["goal"], -1.0, 1.0)

    seen = {"camera": {"kind": "camera"}, "goal": {"kind": "goal"}}
    policy = SensingPolicy(step, {"surprise": np.zeros(1, np.float32)}, {"camera": (8, 8, 3), "goal": (2,)}, {}, seen)
    contract = PolicyContract((0.0, -0.6), (0.3, 0.6), novelty=(0.5, 1.5))
    path = export_sensing(tmp_path / "policy", policy, contract)
    driver = Driver.load(path)
    driver.step({"camera": np.zeros((8, 8, 3), np.uint8), "goal": np.array([0.75, 0.0], np.float32)})
    assert driver.contract.novelty == (0.5, 1.5) and driver.novelty == pytest.approx(0.75)
    with pytest.raises(PolicyFileError, match="novelty.*two rising numbers"):
        export_sensing(tmp_path / "falling", policy, dataclasses.replace(contract, novelty=(1.5, 0.5)))
    blind = dataclasses.replace(policy, step=lambda carry, obs: ({}, obs["goal"]), carry={})
    with pytest.raises(PolicyFileError, match="novelty.*beside a carry 'surprise'"):
        export_sensing(tmp_path / "blind", blind, contract)
    assert not (tmp_path / "falling").exists() and not (tmp_path / "blind").exists()
