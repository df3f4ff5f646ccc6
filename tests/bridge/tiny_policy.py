"""Hand-made policy files for the bridge's tests: no JAX, no exporter.

`write`: v = mean brightness in [-1, 1]; omega = mean red minus mean blue. The state counts the steps and keeps the last
action. `write_sensing`: two cameras, a lidar, odometry and the last command. It drives at full speed until its odometry
says 0.25 m, and not where the lidar shows less than 0.5 m; omega = brightness of the front minus that of the rear.
"""

import hashlib
import json

import numpy as np

LOW, HIGH = [0.0, -0.6], [0.3, 0.6]


def build_onnx(size=64, poison=False):
    """Return the network's bytes. With `poison`, its state becomes infinite although the action stays finite."""
    from onnx import TensorProto, checker, helper, numpy_helper

    def constant(name, values):
        return numpy_helper.from_array(np.asarray(values, np.float32), name)

    node = helper.make_node
    nodes = [
        node("Cast", ["image"], ["x"], to=TensorProto.FLOAT),
        node("Reshape", ["x", "flat"], ["pixels"]),
        node("ReduceMean", ["pixels", "axis"], ["mean"], keepdims=1),
        node("Div", ["mean", "scale"], ["unit"]),
        node("MatMul", ["unit", "mix"], ["mixed"]),
        node("Reshape", ["mixed", "two"], ["pair"]),
        node("Add", ["pair", "shift"], ["action"]),
        node("Add", ["carry_count", "one"], ["next_count"]),
        node("Identity", ["action"], ["next_last"]),
    ]
    initializers = [
        numpy_helper.from_array(np.array([-1, 3]), "flat"), numpy_helper.from_array(np.array([0]), "axis"),
        numpy_helper.from_array(np.array([2]), "two"), constant("scale", 255.0),
        constant("mix", [[2 / 3, 1.0], [2 / 3, 0.0], [2 / 3, -1.0]]), constant("shift", [-1.0, 0.0]),
        constant("one", [np.inf if poison else 1.0]),
    ]

    def value(name, shape, kind=TensorProto.FLOAT):
        return helper.make_tensor_value_info(name, kind, shape)

    image = value("image", [size, size, 3], TensorProto.UINT8)
    graph = helper.make_graph(nodes, "tiny", [image, value("carry_count", [1]), value("carry_last", [2])],
                              [value("action", [2]), value("next_count", [1]), value("next_last", [2])], initializers)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=8)
    checker.check_model(model)
    return model.SerializeToString()


def write(path, size=64, poison=False, **changes):
    """Write the policy folder and return it; `changes` replace top-level fields of policy.json."""
    path.mkdir(parents=True)
    (path / "policy.onnx").write_bytes(build_onnx(size, poison))
    np.savez(path / "weights.npz", mix=np.zeros(3))
    hashes = {name: hashlib.sha256((path / name).read_bytes()).hexdigest() for name in ("policy.onnx", "weights.npz")}
    table = {
        "schema": 1, "kind": "micromobility-policy",
        "image": {"height": size, "width": size, "channels": 3, "encoding": "rgb8"},
        "action": {"names": ["v", "omega"], "units": ["m/s", "rad/s"], "low": LOW, "high": HIGH},
        "rate_hz": 10, "action_repeat": 1,
        "carry": [{"name": "count", "shape": [1], "dtype": "float32"},
                  {"name": "last", "shape": [2], "dtype": "float32"}],
        "onnx": {"opset": 18, "inputs": ["image", "carry_count", "carry_last"],
                 "outputs": ["action", "next_count", "next_last"]},
        "camera": {}, "task": "test", "vehicle_sha256": "",
        "files": hashes,
        "created": "2026-01-01T00:00:00+00:00", "parity": {"steps": 0, "max_abs_action_difference": 0.0},
        **changes,
    }
    (path / "policy.json").write_text(json.dumps(table))
    return path


SENSES = {
    "camera": [8, 8, 3], "commands": [2], "lidar": [4], "odometry": [5], "rear": [6, 8, 3],
}  # fmt: skip
SENSORS = {
    "camera": {"kind": "camera", "settings": {}, "camera": {"fov_y": 1.2}}, "rear": {"kind": "camera"},
    "commands": {"kind": "commands", "settings": {"length": 1}},
    "lidar": {"kind": "lidar", "settings": {"rays": 4, "reach": 8.0, "rate_hz": None}},
    "odometry": {"kind": "odometry", "settings": {}},
}


def build_sensing_onnx():
    """Return the bytes of the network of `write_sensing`; its state keeps the commands that it was shown."""
    from onnx import TensorProto, checker, helper, numpy_helper

    def constant(name, values, kind=np.float32):
        return numpy_helper.from_array(np.asarray(values, kind), name)

    node, value = helper.make_node, helper.make_tensor_value_info
    nodes = [
        node("MatMul", ["odometry", "first"], ["x"]), node("Sub", ["end", "x"], ["left"]),
        node("Mul", ["left", "steep"], ["steeply"]), node("Clip", ["steeply", "zero", "unit"], ["go"]),
        node("ReduceMin", ["lidar"], ["nearest"], keepdims=0), node("Sub", ["nearest", "clear"], ["room"]),
        node("Mul", ["room", "steep"], ["roomy"]), node("Clip", ["roomy", "zero", "unit"], ["free"]),
        node("Mul", ["go", "free"], ["speed"]), node("Mul", ["speed", "two"], ["doubled"]),
        node("Sub", ["doubled", "unit"], ["v"]), node("Reshape", ["v", "one"], ["v1"]),
    ]
    for name in ("camera", "rear"):
        nodes += [node("Cast", [name], [f"{name}_f"], to=TensorProto.FLOAT),
                  node("ReduceMean", [f"{name}_f"], [f"{name}_m"], keepdims=0),
                  node("Div", [f"{name}_m", "scale"], [f"{name}_b"])]
    nodes += [node("Sub", ["camera_b", "rear_b"], ["omega"]), node("Reshape", ["omega", "one"], ["omega1"]),
              node("Concat", ["v1", "omega1"], ["action"], axis=0), node("Identity", ["commands"], ["next_shown"])]
    initializers = [constant("first", [1, 0, 0, 0, 0]), constant("end", 0.25), constant("steep", 1e4),
                    constant("zero", 0.0), constant("unit", 1.0), constant("clear", 0.5), constant("two", 2.0),
                    constant("scale", 255.0), constant("one", [1], np.int64)]
    kinds = {name: TensorProto.UINT8 if len(shape) == 3 else TensorProto.FLOAT for name, shape in SENSES.items()}
    inputs = [value(name, kinds[name], shape) for name, shape in SENSES.items()]
    graph = helper.make_graph(nodes, "tiny", [*inputs, value("carry_shown", TensorProto.FLOAT, [2])],
                              [value("action", TensorProto.FLOAT, [2]), value("next_shown", TensorProto.FLOAT, [2])],
                              initializers)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=8)
    checker.check_model(model)
    return model.SerializeToString()


def write_sensing(path, **changes):
    """Write the folder of a policy that reads several sensors, and return it."""
    path.mkdir(parents=True)
    (path / "policy.onnx").write_bytes(build_sensing_onnx())
    table = {
        "schema": 1, "kind": "dreamer-onnx-policy", "observation": SENSES, "sensors": SENSORS,
        "action": {"kind": "box", "size": 2, "names": ["v", "omega"], "units": ["m/s", "rad/s"], "low": LOW,
                   "high": HIGH},
        "rate_hz": 10, "action_repeat": 1, "carry": [{"name": "shown", "shape": [2], "dtype": "float32"}],
        "onnx": {"opset": 18, "inputs": [*SENSES, "carry_shown"], "outputs": ["action", "next_shown"]},
        "task": "test", "files": {"policy.onnx": hashlib.sha256((path / "policy.onnx").read_bytes()).hexdigest()},
        **changes,
    }
    (path / "policy.json").write_text(json.dumps(table))
    return path
