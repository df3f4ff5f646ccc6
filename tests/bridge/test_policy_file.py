"""The policy file's reader: it runs alone, and refuses what it cannot trust."""

import hashlib
import json
import platform
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import tiny_policy

from bridge.policy import Policy, PolicyFileError

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def folder(tmp_path):
    return tiny_policy.write(tmp_path / "tiny", size=8)


def colour(r, g, b):
    return np.tile(np.array([r, g, b], np.uint8), (8, 8, 1))


@pytest.mark.quick
def test_action_is_mapped_linearly_to_the_limits(folder):
    policy = Policy.load(folder)
    black, white, red, blue = (0, 0, 0), (255, 255, 255), (255, 0, 0), (0, 0, 255)
    for rgb, v, omega in [(black, 0.0, 0.0), (white, 0.3, 0.0), (red, 0.1, 0.6), (blue, 0.1, -0.6)]:
        np.testing.assert_allclose(policy.step(colour(*rgb)), [v, omega], atol=1e-6)


@pytest.mark.quick
def test_state_advances_with_each_step_and_reset_forgets_it(folder):
    policy = Policy.load(folder)
    for count in range(3):
        assert policy._carry[0] == count
        policy.step(colour(1, 2, 3))
    policy.reset()
    assert all((value == 0).all() for value in policy._carry)


@pytest.mark.quick
def test_step_that_was_begun_before_its_image_gives_the_same_and_reset_forgets_what_was_begun(folder):
    policy, other = Policy.load(folder), Policy.load(folder)
    assert policy._network.in_halves  # its count needs no image
    for _ in range(3):
        np.testing.assert_array_equal(policy.step(colour(9, 8, 7)), other.step(colour(9, 8, 7)))
        policy.prepare()
    assert policy._carry[0] == other._carry[0] == 3
    policy.reset()
    policy.step(colour(9, 8, 7))
    assert policy._carry[0] == 1


def add_weights(folder, megabytes):
    """Let the state pass through a large product before the image comes."""
    import onnx
    from onnx import helper, numpy_helper

    model, width = onnx.load(folder / "policy.onnx"), 1024
    sizes = {"up": (2, width), "across": (width, round(megabytes * 1e6 / 4 / width))}
    sizes["down"] = (sizes["across"][1], 2)
    graph = model.graph
    graph.initializer.extend(numpy_helper.from_array(np.zeros(size, np.float32), name) for name, size in sizes.items())
    graph.initializer.append(numpy_helper.from_array(np.array([1, 2]), "row"))
    chain = ["last_row", "wide", "wider", "back"]
    nodes = [helper.make_node("Reshape", ["carry_last", "row"], ["last_row"]),
             *(helper.make_node("MatMul", [taken, name], [given])
               for taken, name, given in zip(chain, sizes, chain[1:], strict=False)),
             helper.make_node("Reshape", ["back", "two"], ["flat_back"])]
    (last,) = (node for node in graph.node if "next_last" in node.output)
    last.CopyFrom(helper.make_node("Add", ["action", "flat_back"], ["next_last"]))
    before = [*graph.node][:-1]
    del graph.node[:]
    graph.node.extend([*before, *nodes, last])
    onnx.save(model, folder / "policy.onnx")
    table = json.loads((folder / "policy.json").read_text())
    table["files"]["policy.onnx"] = hashlib.sha256((folder / "policy.onnx").read_bytes()).hexdigest()
    (folder / "policy.json").write_text(json.dumps(table))


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other libraries return memory at once, or have no call")
def test_loaded_policy_keeps_little_more_memory_than_its_weights(folder):
    add_weights(folder, 25)
    code = """
import sys
import onnxruntime
from bridge.policy import Policy
used = lambda: int(open("/proc/self/statm").read().split()[1]) * 4096 / 1e6
before = used()
policy = Policy.load(sys.argv[1])
policy.step(policy.zeros())
print(used() - before)
"""
    command = [sys.executable, "-c", code, str(folder)]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert 25 < float(run.stdout) < 60  # a copy beside the weights, not the three or four of reading the file


@pytest.mark.quick
def test_spoilt_state_makes_the_command_not_finite(tmp_path):
    with pytest.raises(PolicyFileError, match="must be finite"):
        Policy.load(tiny_policy.write(tmp_path / "bad", size=8, poison=True))


def test_policy_runs_where_jax_rclpy_and_the_training_packages_cannot_be_imported(folder):
    code = """
import sys
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("jax", "jaxlib", "flax", "dreamer", "whill_mjx", "sysid", "rclpy", "onnx", "mujoco"):
            raise ImportError("blocked: " + name)
sys.meta_path.insert(0, Block())
import numpy as np
from bridge.policy import Policy
from bridge.driving.controller import Controller
print(Policy.load(sys.argv[1]).step(np.full((8, 8, 3), 255, np.uint8)).round(6).tolist())
"""
    done = subprocess.run([sys.executable, "-c", code, str(folder)], cwd=ROOT, capture_output=True, text=True,
                          timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[0.3, 0.0]"


def edit(folder, change):
    path = folder / "policy.json"
    table = json.loads(path.read_text())
    change(table)
    path.write_text(json.dumps(table))


def refusal(path):
    """The message with which a policy file is refused; it must name the file and end with a remedy."""
    with pytest.raises(PolicyFileError) as error:
        Policy.load(path)
    message = str(error.value)
    assert str(path) in message and message.endswith(".") and ". " in message
    return message


@pytest.mark.quick
@pytest.mark.parametrize("field, value", [
    ("schema", 2), ("schema", None), ("kind", "photo"), ("rate_hz", 0), ("rate_hz", "10"), ("action_repeat", 0),
    ("action_repeat", True), ("carry", {}), ("camera", 3), ("camera", {"fov_y": 0}),
    ("files", {}), ("files", {"../policy.onnx": "0"}),
    ("carry", [{"name": "count", "shape": [-1], "dtype": "float32"}]), ("image", None),
    ("carry", [{"name": "count", "shape": [1], "dtype": "object"}]),
    ("action", {"names": ["omega", "v"], "units": ["m/s", "rad/s"], "low": [0, 0], "high": [1, 1]}),
    ("action", {"names": ["v", "omega"], "units": ["m/s", "rad/s"], "low": [1, 0], "high": [1, 1]}),
    ("image", {"height": 8, "width": 8, "channels": 3, "encoding": "bgr8"}),
    ("image", {"height": 8, "width": 8, "channels": 4, "encoding": "rgb8"}),
    ("onnx", {"inputs": ["image"], "outputs": ["action"]}),
])
def test_field_out_of_its_rule_is_refused_by_name_and_value(folder, field, value):
    edit(folder, lambda table: table.update({field: value}))
    message = refusal(folder)
    assert "policy.json" in message and field in message


@pytest.mark.quick
def test_contract_that_the_network_does_not_keep_is_refused(folder):
    edit(folder, lambda table: table["image"].update(height=16))
    assert "policy.onnx" in refusal(folder)


@pytest.mark.quick
def test_changed_byte_is_refused_with_both_hashes(folder):
    data = bytearray((folder / "policy.onnx").read_bytes())
    data[len(data) // 2] ^= 1
    (folder / "policy.onnx").write_bytes(data)
    message = refusal(folder)
    assert hashlib.sha256(data).hexdigest() in message and "Copy the policy file again" in message


@pytest.mark.quick
@pytest.mark.parametrize("name", ["policy.json", "policy.onnx"])
def test_missing_file_is_refused_by_name(folder, name):
    (folder / name).unlink()
    assert f"{name}: is missing" in refusal(folder)


@pytest.mark.quick
def test_a_vehicle_needs_no_archive_of_the_weights_but_does_not_take_a_damaged_one(folder):
    (folder / "weights.npz").write_bytes(b"PK damaged")
    assert "weights.npz: SHA-256" in refusal(folder)
    (folder / "weights.npz").unlink()
    np.testing.assert_allclose(Policy.load(folder).step(colour(255, 255, 255)), [0.3, 0.0], atol=1e-6)


@pytest.mark.quick
@pytest.mark.parametrize("content", [b"", b"[]", b"{", b"\xff\xfe", b'{"schema": 1}', b"null"])
def test_description_that_is_no_json_object_is_refused(folder, content):
    (folder / "policy.json").write_bytes(content)
    assert "policy.json" in refusal(folder)


@pytest.mark.quick
def test_network_with_a_matching_hash_that_is_no_onnx_is_refused(folder):
    (folder / "policy.onnx").write_bytes(b"not a network")
    edit(folder, lambda table: table["files"].update({"policy.onnx": hashlib.sha256(b"not a network").hexdigest()}))
    assert "onnxruntime" in refusal(folder)


@pytest.mark.quick
def test_vehicle_file_of_another_training_is_refused(folder):
    (folder / "vehicle.toml").write_bytes(b"schema = 1\n")
    digest = hashlib.sha256(b"schema = 1\n").hexdigest()
    edit(folder, lambda table: table["files"].update({"vehicle.toml": digest}))
    assert "vehicle_sha256" in refusal(folder)
    edit(folder, lambda table: table.update(vehicle_sha256=digest))
    assert Policy.load(folder).contract.vehicle_sha256 == digest


@pytest.mark.quick
def test_pickled_weights_are_refused(folder):
    (folder / "weights.npz").write_bytes(b"\x80\x04N.")
    edit(folder, lambda table: table["files"].update({"weights.npz": hashlib.sha256(b"\x80\x04N.").hexdigest()}))
    assert "weights.npz" in refusal(folder)


@pytest.mark.quick
def test_zip_truncated_anywhere_is_refused_and_a_whole_one_loads(folder, tmp_path):
    archive = tmp_path / "tiny.zip"
    with zipfile.ZipFile(archive, "w") as writer:
        for item in folder.iterdir():
            writer.write(item, f"tiny/{item.name}")
    assert Policy.load(archive).step(colour(255, 255, 255))[0] == pytest.approx(0.3)
    whole = archive.read_bytes()
    for length in range(0, len(whole), len(whole) // 7):
        archive.write_bytes(whole[:length])
        assert "zip" in refusal(archive)


@pytest.mark.quick
def test_path_that_does_not_exist_is_refused(tmp_path):
    assert "does not exist" in refusal(tmp_path / "nowhere")


@pytest.mark.quick
@pytest.mark.parametrize("shape, dtype", [((8, 9, 3), np.uint8), ((8, 8, 3), np.float32), ((3, 8, 8), np.uint8)])
def test_image_of_another_shape_or_type_is_refused(folder, shape, dtype):
    with pytest.raises(ValueError, match="to_rgb8"):
        Policy.load(folder).step(np.zeros(shape, dtype))
