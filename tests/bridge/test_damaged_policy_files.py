"""Any bytes give a policy or a PolicyFileError, within bounds of processor time and memory."""

import json
import os
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import damage
import numpy as np
import pytest
import tiny_policy
from hypothesis import given
from hypothesis import strategies as st

from bridge.policy import Policy, PolicyFileError

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The files of a small policy with its vehicle, by name."""
    folder = tiny_policy.write(tmp_path_factory.mktemp("policy") / "tiny", size=8)
    found = {item.name: item.read_bytes() for item in folder.iterdir()} | {"vehicle.toml": b"schema = 1\n"}
    table = json.loads(found["policy.json"])
    table["files"]["vehicle.toml"] = ""
    table["camera"] = {"frame": "base_footprint", "x": 0.7, "z": 0.68, "pitch": 0.1386, "fov_y": 1.2}
    return damage.with_hashes({**found, "policy.json": json.dumps(table).encode()})


def zipped(path, files, compression=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, data in files.items():
            archive.writestr(f"tiny/{name}", data)
    return path


def policy_or_refusal(path):
    """The policy, or None where it is refused as documented."""
    with damage.Costs():
        try:
            policy = Policy.load(path)
        except PolicyFileError as error:
            message = str(error)
            assert str(path) in message and message.endswith(".") and len(message) < 4000, message
            return None
    contract = policy.contract
    assert policy.step(np.zeros((contract.height, contract.width, 3), np.uint8)).shape == (2,)
    return policy


@damage.few(100)
@given(data=st.one_of(st.binary(max_size=400), st.binary(max_size=200).map(lambda x: b"PK\x03\x04" + x)))
def test_any_bytes_are_a_policy_or_refused(data, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "any.zip"
    path.write_bytes(data)
    assert policy_or_refusal(path) is None


@damage.few(60)
@given(data=st.data())
def test_a_folder_with_any_damaged_table_is_a_policy_or_refused(data, files, tmp_path_factory):
    text = data.draw(damage.damaged_table(json.loads(files["policy.json"])))
    policy_or_refusal(damage.write(tmp_path_factory.getbasetemp() / "table", {**files, "policy.json": text}))


@damage.few(40)
@given(data=st.data())
def test_a_folder_with_any_damaged_part_is_a_policy_or_refused(data, files, tmp_path_factory):
    name = data.draw(st.sampled_from(sorted(files)))
    broken = {**files, name: data.draw(damage.damaged(files[name]))}
    if name != "policy.json" and data.draw(st.booleans()):
        broken = damage.with_hashes(broken)
    policy_or_refusal(damage.write(tmp_path_factory.getbasetemp() / "part", broken))


@damage.few(15)
@given(data=st.data())
def test_any_damaged_network_whose_hash_is_right_is_a_policy_or_refused(data, files, tmp_path_factory):
    broken = damage.with_hashes({**files, "policy.onnx": data.draw(damage.damaged(files["policy.onnx"]))})
    policy_or_refusal(damage.write(tmp_path_factory.getbasetemp() / "network", broken))


@damage.few(60)
@given(data=st.data())
def test_any_damaged_zip_is_a_policy_or_refused(data, files, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "damaged.zip"
    whole = zipped(path, files, data.draw(st.sampled_from([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED]))).read_bytes()
    path.write_bytes(data.draw(damage.damaged(whole)))
    policy_or_refusal(path)


def refusal(path):
    """The message with which a policy is refused by a process of its own, whose memory is looked at."""
    code = """
import resource, sys
from bridge.policy import Policy, PolicyFileError
try:
    Policy.load(sys.argv[1])
except PolicyFileError as error:
    print(error)
# Not RUSAGE_SELF: that begins with the peak of the process that started this one.
own = next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(max(own, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss) * 1024)
"""
    done = subprocess.run([sys.executable, "-c", code, str(path)], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    *message, peak = done.stdout.splitlines()
    assert int(peak) < damage.BYTES
    return " ".join(message)


def sparse(path, size):
    with open(path, "wb") as file:
        file.truncate(size)


@pytest.mark.quick
def test_a_stray_file_is_not_read_however_large(files, tmp_path):
    folder = damage.write(tmp_path / "p", files)
    sparse(folder / "core", 3 << 30)
    assert refusal(folder) == ""


@pytest.mark.quick
@pytest.mark.parametrize("name", ["policy.json", "policy.onnx", "weights.npz", "vehicle.toml"])
def test_a_part_that_is_larger_than_its_limit_is_refused_before_it_is_read(files, tmp_path, name):
    folder = damage.write(tmp_path / "p", files)
    sparse(folder / name, 3 << 30)
    message = refusal(folder)
    assert name in message and f"has {3 << 30} bytes; at most" in message


@pytest.mark.quick
@pytest.mark.parametrize("name", ["policy.json", "policy.onnx", "weights.npz", "junk.bin"])
def test_a_zip_bomb_is_refused_and_a_stray_member_is_not_unpacked(files, tmp_path, name):
    path, chunk = tmp_path / "bomb.zip", bytes(1 << 20)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for part, data in files.items():
            if part != name:
                archive.writestr(f"tiny/{part}", data)
        with archive.open(f"tiny/{name}", "w") as member:
            for _ in range(200):
                member.write(chunk)
    message = refusal(path)
    assert message == "" if name == "junk.bin" else name in message and "grow" in message


@pytest.mark.quick
@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_zip_with_rare_compression_is_refused_with_its_number(files, tmp_path, method):
    assert f"compression method {method}" in refusal(zipped(tmp_path / "rare.zip", files, method))


def test_a_zip_with_a_huge_directory_is_refused(files, tmp_path):
    path = zipped(tmp_path / "many.zip", files)
    with zipfile.ZipFile(path, "a") as archive:
        for i in range(20_000):
            archive.writestr(zipfile.ZipInfo(f"tiny/{i}"), b"")
    assert "directory" in refusal(path)


@pytest.mark.quick
def test_a_pipe_and_a_device_in_the_place_of_a_part_are_refused(files, tmp_path):
    folder = damage.write(tmp_path / "p", files)
    for name in ("policy.onnx", "policy.json"):
        (folder / name).unlink()
        os.mkfifo(folder / name)
        assert f"{name}: is not a regular file" in refusal(folder)
    (folder / "policy.json").unlink()
    (folder / "policy.json").symlink_to("/dev/zero")
    assert "policy.json: is not a regular file" in refusal(folder)


def network(nodes, initializers):
    """A network with the tensors of the small policy, whose action comes from `nodes`."""
    from onnx import TensorProto, helper

    def value(name, shape, kind=TensorProto.FLOAT):
        return helper.make_tensor_value_info(name, kind, shape)

    node = helper.make_node
    nodes = [*nodes, node("Identity", ["carry_count"], ["next_count"]), node("Identity", ["carry_last"], ["next_last"])]
    graph = helper.make_graph(
        nodes, "g", [value("image", [8, 8, 3], TensorProto.UINT8), value("carry_count", [1]), value("carry_last", [2])],
        [value("action", [2]), value("next_count", [1]), value("next_last", [2])], initializers)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=8).SerializeToString()


def endless_loop():
    from onnx import TensorProto, helper, numpy_helper

    boolean, vector = (helper.make_tensor_value_info(name, kind, shape) for name, kind, shape in
                       (("go", TensorProto.BOOL, []), ("x", TensorProto.FLOAT, [2])))
    count = helper.make_tensor_value_info("i", TensorProto.INT64, [])
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["go_on"]), helper.make_node("Neg", ["x"], ["y"])], "body",
        [count, boolean, vector], [helper.make_tensor_value_info("go_on", TensorProto.BOOL, []),
                                   helper.make_tensor_value_info("y", TensorProto.FLOAT, [2])])
    trips, always = numpy_helper.from_array(np.array(2**62), "trips"), numpy_helper.from_array(np.array(True), "always")
    loop = helper.make_node("Loop", ["trips", "always", "carry_last"], ["action"], body=body)
    return network([loop], [trips, always])


def large_tensor(*sides):
    """A step that fills a tensor of these sides."""
    from onnx import helper, numpy_helper

    shape = numpy_helper.from_array(np.array(sides), "shape")
    axes = numpy_helper.from_array(np.arange(len(sides)), "axes")
    return network([helper.make_node("ConstantOfShape", ["shape"], ["large"]),
                    helper.make_node("ReduceSum", ["large", "axes"], ["sum"], keepdims=0),
                    helper.make_node("Add", ["carry_last", "sum"], ["action"])], [shape, axes])


def outside_tensor(place):
    """A network whose numbers lie in another file."""
    from onnx import TensorProto, helper

    tensor = TensorProto(name="w", data_type=TensorProto.FLOAT, dims=[2], data_location=TensorProto.EXTERNAL)
    for key, value in (("location", place), ("offset", "0"), ("length", "8")):
        tensor.external_data.add(key=key, value=value)
    return network([helper.make_node("Add", ["carry_last", "w"], ["action"])], [tensor])


def test_a_network_that_never_ends_is_refused(files, tmp_path):
    message = refusal(damage.write(tmp_path / "p", damage.with_hashes({**files, "policy.onnx": endless_loop()})))
    assert "policy.onnx: a first step is not done" in message and "processor time" in message


@pytest.mark.parametrize("sides", [(30_000, 30_000), (2**40,), (2**31, 2**31)])
def test_a_network_that_asks_for_all_memory_is_refused(files, tmp_path, sides):
    broken = damage.with_hashes({**files, "policy.onnx": large_tensor(*sides)})
    assert "policy.onnx: onnxruntime refuses it" in refusal(damage.write(tmp_path / "p", broken))


def test_a_network_whose_action_has_another_shape_than_it_says_is_refused(files, tmp_path):
    from onnx import helper

    longer = helper.make_node("Concat", ["carry_last", "carry_count"], ["action"], axis=0)
    broken = damage.with_hashes({**files, "policy.onnx": network([longer], [])})
    assert "policy.onnx" in refusal(damage.write(tmp_path / "p", broken))


def test_a_network_that_reads_other_files_is_refused(files, tmp_path, monkeypatch):
    (tmp_path / "outside.bin").write_bytes(struct.pack("2f", 0.5, 0.5))
    monkeypatch.chdir(tmp_path)  # such a name counts from the working folder
    for place in ("outside.bin", str(tmp_path / "outside.bin")):
        broken = damage.with_hashes({**files, "policy.onnx": outside_tensor(place)})
        with pytest.raises(PolicyFileError, match="policy.onnx: onnxruntime refuses it"):
            Policy.load(damage.write(tmp_path / "p", broken))


@pytest.mark.quick
@pytest.mark.parametrize("place, value, words", [
    (("action", "low"), [-(10**400), 0], "action.low.0"), (("action", "low"), [float("nan"), 0], "action.low.0 = nan"),
    (("action", "high"), [float("inf"), 1], "action.high.0 = inf"), (("action", "high"), [0.0, 1], "above low"),
    (("action", "high"), [1e4, 1], "from -100 to 100"), (("rate_hz",), 10**400, "rate_hz"),
    (("action", "units"), ["km/h", "rad/s"], "units"), (("action", "names"), ["omega", "v"], "names"),
    (("image", "encoding"), "bgr8", "encoding"), (("image", "height"), 2.0**12, "height"),
    (("camera", "pitch"), 8.0, "camera: pitch = 8.0"), (("camera", "frame"), "moon", "frame = 'moon'"),
    (("camera", "x"), "ahead", "camera: x = 'ahead'"), (("task",), "\ud800", "Unicode"),
    (("files", "../x"), "0" * 64, "plain file names"), (("files", "policy.onnx"), "0", "64 hexadecimal digits"),
    (("carry",), [{"name": "count", "shape": [2**24], "dtype": "float32"}] * 9, "carry"),
])
def test_a_value_outside_its_rule_is_refused_by_field_and_value(files, tmp_path, place, value, words):
    table = json.loads(files["policy.json"])
    *above, last = place
    owner = table
    for key in above:
        owner = owner[key]
    owner[last] = value
    with pytest.raises(PolicyFileError, match="policy.json") as error:
        Policy.load(damage.write(tmp_path / "p", {**files, "policy.json": json.dumps(table).encode()}))
    assert words in str(error.value) and "Export the policy again" in str(error.value)


@pytest.mark.quick
@pytest.mark.parametrize("text, words", [
    (b"[" * 100_000, "nested too deeply"), (b'{"a":' * 100_000, "nested too deeply"), (b"\xef\xbb\xbf{}", "JSON"),
    (b'{"schema": 1, "schema": 1}', "'schema' is given twice"), (b"1" * 5000, "JSON"), ("{}".encode("utf-16"), "JSON"),
])
def test_a_table_that_breaks_a_decoder_is_refused(files, tmp_path, text, words):
    with pytest.raises(PolicyFileError, match="policy.json") as error:
        Policy.load(damage.write(tmp_path / "p", {**files, "policy.json": text}))
    assert words in str(error.value)


@pytest.mark.quick
def test_a_file_that_names_no_frame_gives_the_camera_in_the_chassis_frame(files, tmp_path):
    table = json.loads(files["policy.json"])
    table["camera"] = {"x": 0.35, "z": 0.55, "pitch": 0.15, "fov_y": 1.2}
    older = damage.write(tmp_path / "p", {**files, "policy.json": json.dumps(table).encode()})
    assert Policy.load(older).contract.camera == {**table["camera"], "frame": "chassis"}
    assert Policy.load(damage.write(tmp_path / "q", files)).contract.camera["frame"] == "base_footprint"
