"""Any bytes give an agent's policy or a PolicyFileError, for agents as ONNX and as parameters."""

import json
import zipfile

import damage
import jax
import numpy as np
import pytest
from dreamer_toys import tiny_config
from hypothesis import given
from hypothesis import strategies as st

from bridge.policy import PolicyFileError
from dreamer import spaces
from dreamer.model import agent
from dreamer.policy import Policy, save

CONFIG = tiny_config()
SHAPE = {"camera": (16, 16, 3), "speed": (2,)}


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    path, rng = tmp_path_factory.mktemp("policies"), np.random.default_rng(0)
    shapes = jax.eval_shape(lambda: agent.init_params(CONFIG, SHAPE, 3, jax.random.PRNGKey(0)))
    params = jax.tree.map(lambda leaf: rng.normal(size=leaf.shape).astype(np.float32), shapes)
    return {"parameters": save(path / "parameters", CONFIG, params, SHAPE, 3), "onnx": write_agent(path / "onnx")}


def write_agent(folder):
    """An agent as `export_agent` writes it, but made by hand: its action is the tanh of what it sees and counts."""
    from onnx import TensorProto, helper

    def value(name, size):
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, [size])

    node = helper.make_node
    graph = helper.make_graph(
        [node("Concat", ["observation", "carry_count"], ["seen"], axis=0), node("Tanh", ["seen"], ["action"]),
         node("Exp", ["carry_count"], ["next_count"])], "agent",
        [value("observation", 2), value("carry_count", 1)], [value("action", 3), value("next_count", 1)])
    table = {
        "schema": 1, "kind": "dreamer-onnx-policy", "observation": [2], "action": {"kind": "box", "size": 3},
        "task": "toy", "carry": [{"name": "count", "shape": [1], "dtype": "float32"}],
        "onnx": {"opset": 18, "inputs": ["observation", "carry_count"], "outputs": ["action", "next_count"]},
        "files": {"policy.onnx": ""},
    }  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=8)
    files = {"policy.json": json.dumps(table).encode(), "policy.onnx": model.SerializeToString()}
    return damage.write(folder, damage.with_hashes(files))


@pytest.fixture(scope="module")
def kinds(folders):
    """The files of both kinds, by name."""
    for folder in folders.values():
        Policy.load(folder)  # what JAX does only once is no cost of a file
    return {kind: {item.name: item.read_bytes() for item in folder.iterdir()} for kind, folder in folders.items()}


def policy_or_refusal(path):
    with damage.Costs():
        try:
            policy = Policy.load(path)
        except PolicyFileError as error:
            message = str(error)
            assert str(path) in message and message.endswith(".") and len(message) < 4000, message
            return None
    assert set(policy.zero_carry)
    return policy


@damage.few(40)
@given(data=st.data(), kind=st.sampled_from(["parameters", "onnx"]))
def test_a_folder_with_any_damaged_table_is_a_policy_or_refused(data, kind, kinds, tmp_path_factory):
    files = kinds[kind]
    text = data.draw(damage.damaged_table(json.loads(files["policy.json"])))
    policy_or_refusal(damage.write(tmp_path_factory.getbasetemp() / "table", {**files, "policy.json": text}))


@damage.few(30)
@given(data=st.data())
def test_any_damaged_weights_are_a_policy_or_refused(data, kinds, tmp_path_factory):
    files = kinds["parameters"]
    broken = {**files, "weights.npz": data.draw(damage.damaged(files["weights.npz"]))}
    if data.draw(st.booleans()):
        broken = damage.with_hashes(broken)
    policy_or_refusal(damage.write(tmp_path_factory.getbasetemp() / "weights", broken))


def of_arrays(folder, files, arrays):
    """A policy of parameters with these arrays, which are packed."""
    folder.mkdir()
    with zipfile.ZipFile(folder / "weights.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, array)
    return damage.write(folder, damage.with_hashes({**files, "weights.npz": (folder / "weights.npz").read_bytes()}))


def arrays_of(folder):
    with np.load(folder / "weights.npz") as archive:
        return {name: archive[name] for name in archive.files}


@pytest.mark.quick
def test_weights_of_another_agent_are_refused_when_they_are_loaded(folders, kinds, tmp_path):
    arrays = arrays_of(folders["parameters"])
    name = next(name for name in arrays if name.startswith("policy/"))
    assert Policy.load(of_arrays(tmp_path / "same", kinds["parameters"], arrays)).step(
        spaces.zeros(SHAPE))[0].shape == (3,)
    less = {key: array for key, array in arrays.items() if key != name}
    other, below = {**arrays, name: np.zeros((7, 7, 7), np.float32)}, {**arrays, f"{name}/x": arrays[name]}
    for i, changed in enumerate((less, other, below)):
        with pytest.raises(PolicyFileError, match="weights.npz"):
            Policy.load(of_arrays(tmp_path / str(i), kinds["parameters"], changed))


@pytest.mark.quick
def test_a_bomb_among_the_weights_is_refused_by_its_name(folders, kinds, tmp_path):
    arrays = {**arrays_of(folders["parameters"]), "policy/bomb": np.zeros(1 << 26, np.float32)}
    with pytest.raises(PolicyFileError, match="bomb.*grow"):
        Policy.load(of_arrays(tmp_path / "bomb", kinds["parameters"], arrays))


@pytest.mark.quick
def test_a_header_that_claims_more_numbers_than_there_are_is_refused(kinds, folders, tmp_path):
    arrays = arrays_of(folders["parameters"])
    name = next(iter(arrays))
    folder = tmp_path / "claims"
    folder.mkdir()
    with zipfile.ZipFile(folder / "weights.npz", "w") as archive:
        with archive.open(f"{name}.npy", "w") as member:
            np.lib.format.write_array_header_1_0(member, {"descr": "<f4", "fortran_order": False, "shape": (2**40,)})
            member.write(bytes(64))
    files = {**kinds["parameters"], "weights.npz": (folder / "weights.npz").read_bytes()}
    with pytest.raises(PolicyFileError, match="in 64 bytes"):
        Policy.load(damage.write(folder, damage.with_hashes(files)))


@pytest.mark.quick
def test_parameters_have_a_hash_and_those_of_earlier_versions_are_read_without_one(kinds, folders, tmp_path):
    files = kinds["parameters"]
    changed = bytearray(files["weights.npz"])
    changed[len(changed) // 2] ^= 1
    with pytest.raises(PolicyFileError, match="weights.npz.*SHA-256"):
        Policy.load(damage.write(tmp_path / "changed", {**files, "weights.npz": bytes(changed)}))
    table = json.loads(files["policy.json"])
    del table["files"]
    earlier = damage.write(tmp_path / "earlier", {**files, "policy.json": json.dumps(table).encode()})
    obs = jax.tree.map(np.asarray, spaces.zeros(SHAPE))
    np.testing.assert_array_equal(Policy.load(earlier).step(obs)[0], Policy.load(folders["parameters"]).step(obs)[0])


@pytest.mark.quick
@pytest.mark.parametrize("field, value", [("deter", "2048"), ("deter", 2.5), ("lr", None), ("mults", [2, "3"]),
                                          ("encoder", "eyes"), ("wings", 2), ("blocks", 0), ("compute_dtype", "x")])
def test_a_setting_that_is_none_is_refused_by_its_name(kinds, tmp_path, field, value):
    files = kinds["parameters"]
    table = json.loads(files["policy.json"])
    table["config"][field] = value
    with pytest.raises(PolicyFileError, match=f"policy.json config: .*{field}"):
        Policy.load(damage.write(tmp_path / "p", {**files, "policy.json": json.dumps(table).encode()}))


@pytest.mark.quick
def test_a_zip_of_either_kind_acts_like_its_folder(folders, kinds, tmp_path):
    for kind, files in kinds.items():
        obs = jax.tree.map(np.asarray, spaces.zeros(SHAPE if kind == "parameters" else (2,)))
        with zipfile.ZipFile(tmp_path / f"{kind}.zip", "w", zipfile.ZIP_DEFLATED) as archive:
            for name, data in files.items():
                archive.writestr(f"{kind}/{name}", data)
        np.testing.assert_array_equal(
            Policy.load(tmp_path / f"{kind}.zip").step(obs)[0], Policy.load(folders[kind]).step(obs)[0])
