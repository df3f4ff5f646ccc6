"""A hand-made policy file that looks for blue pixels and turns towards them: sight without any training."""

import hashlib
import json

import numpy as np

LOW, HIGH = [0.0, -1.0], [1.0, 1.0]


def build_onnx(size=64):
    """The network: v = 0.6; omega from the mean column of the blue pixels; the state counts the steps."""
    from onnx import TensorProto, checker, helper, numpy_helper

    def constant(name, values, kind=np.float32):
        return numpy_helper.from_array(np.asarray(values, kind), name)

    node = helper.make_node
    nodes = [
        node("Cast", ["image"], ["x"], to=TensorProto.FLOAT),
        node("Einsum", ["x", "mix"], ["excess"], equation="hwc,c->hw"),
        node("Sub", ["excess", "threshold"], ["above"]),
        node("Relu", ["above"], ["blue"]),
        node("ReduceSum", ["blue", "rows"], ["by_column"], keepdims=0),
        node("ReduceSum", ["by_column", "rows"], ["total"], keepdims=1),
        node("Add", ["total", "one"], ["weight"]),
        node("Mul", ["by_column", "columns"], ["weighted"]),
        node("ReduceSum", ["weighted", "rows"], ["moment"], keepdims=1),
        node("Div", ["moment", "weight"], ["centre"]),
        node("Mul", ["centre", "gain"], ["turn"]),
        node("Clip", ["turn", "low", "high"], ["omega"]),
        node("Concat", ["speed", "omega"], ["action"], axis=0),
        node("Add", ["carry_count", "one"], ["next_count"]),
    ]
    initializers = [
        constant("mix", [-0.5, -0.5, 1.0]), constant("threshold", 60.0), constant("rows", [0], np.int64),
        constant("one", [1.0]), constant("columns", np.linspace(-1, 1, size)), constant("gain", -3.0),
        constant("low", -1.0), constant("high", 1.0), constant("speed", [0.2]),
    ]  # fmt: skip

    def value(name, shape, kind=TensorProto.FLOAT):
        return helper.make_tensor_value_info(name, kind, shape)

    graph = helper.make_graph(
        nodes, "seeker", [value("image", [size, size, 3], TensorProto.UINT8), value("carry_count", [1])],
        [value("action", [2]), value("next_count", [1])], initializers,
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=8)
    checker.check_model(model)
    return model.SerializeToString()


def write(path, task="obstacle_course", size=64, repeat=2):
    """Write the policy folder and return it."""
    path.mkdir(parents=True)
    data = build_onnx(size)
    (path / "policy.onnx").write_bytes(data)
    table = {
        "schema": 1, "kind": "micromobility-policy",
        "image": {"height": size, "width": size, "channels": 3, "encoding": "rgb8"},
        "action": {"names": ["v", "omega"], "units": ["m/s", "rad/s"], "low": LOW, "high": HIGH},
        "rate_hz": 10.0, "action_repeat": repeat, "carry": [{"name": "count", "shape": [1], "dtype": "float32"}],
        "onnx": {"opset": 18, "inputs": ["image", "carry_count"], "outputs": ["action", "next_count"]},
        "camera": {}, "task": task, "vehicle_sha256": "",
        "files": {"policy.onnx": hashlib.sha256(data).hexdigest()},
        "created": "2026-01-01T00:00:00+00:00", "parity": {"steps": 0, "max_abs_action_difference": 0.0},
    }  # fmt: skip
    (path / "policy.json").write_text(json.dumps(table))
    return path
