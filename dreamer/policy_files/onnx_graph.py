"""Rewrites of an ONNX graph that keep what it computes and make it run, or run faster, on a vehicle."""

from __future__ import annotations

from typing import Any

import numpy as np


def repair_pools(graph: Any) -> None:
    """Pool over the two axes of an image alone.

    jax2onnx makes of a window over a batch of images (N, H, W, C) a pooling over four axes, which runtimes refuse.
    """
    from onnx import helper

    made_by, used_by = _makers(graph), _users(graph)
    for pool in [node for node in graph.node if node.op_type == "MaxPool"]:
        about = {item.name: helper.get_attribute_value(item) for item in pool.attribute}
        window, strides = about["kernel_shape"], about["strides"]
        wraps, after = [pool], used_by.get(pool.output[0], [])
        while len(wraps) < 3 and wraps[-1].input[0] in made_by:
            wraps.append(made_by[wraps[-1].input[0]])
        is_image = len(window) == 4 and window[0] == window[3] == strides[0] == strides[3] == 1 and "pads" not in about
        if not is_image or [node.op_type for node in wraps[1:]] != ["Unsqueeze"] * 2 or len(after) != 1:
            continue
        name, place = pool.output[0], list(graph.node).index(pool)
        new = [
            helper.make_node("Transpose", [wraps[2].input[0]], [f"{name}_first"], perm=[0, 3, 1, 2]),
            helper.make_node("MaxPool", [f"{name}_first"], [f"{name}_pooled"],
                             kernel_shape=window[1:3], strides=strides[1:3]),
            helper.make_node("Transpose", [f"{name}_pooled"], [after[0].output[0]], perm=[0, 2, 3, 1]),
        ]
        graph.node.remove(after[0])
        graph.node.remove(pool)
        for i, node in enumerate(new):
            graph.node.insert(place + i, node)
    remove_unused(graph)


def split_products(graph: Any) -> None:
    """Multiply each part of a concatenated row with its own rows of the weight, and add.

    What of it no observation changes can then be computed before the observation comes.
    """
    from onnx import helper, numpy_helper

    made_by = _makers(graph)
    shapes = {value.name: [one.dim_value for one in value.type.tensor_type.shape.dim]
              for value in (*graph.value_info, *graph.input)}
    weights = {tensor.name: tensor for tensor in graph.initializer}
    nodes = []
    for node in graph.node:
        joined = made_by.get(node.input[0]) if node.op_type == "Gemm" else None
        about = {item.name: helper.get_attribute_value(item) for item in node.attribute}
        alone = about.get("beta", 1.0) == 0.0 or len(node.input) == 2
        turned = about.get("transA", 0) or about.get("transB", 0) or about.get("alpha", 1.0) != 1.0
        if joined is None or joined.op_type != "Concat" or node.input[1] not in weights or turned or not alone:
            nodes.append(node)
            continue
        weight = numpy_helper.to_array(weights[node.input[1]])
        sizes = [shapes.get(name, [0])[-1] for name in joined.input]
        if sum(sizes) != weight.shape[0] or helper.get_attribute_value(joined.attribute[0]) not in (1, -1):
            nodes.append(node)
            continue
        total = ""
        for i, (name, rows) in enumerate(zip(joined.input, np.split(weight, np.cumsum(sizes)[:-1]), strict=True)):
            part = f"{node.input[1]}_rows_{i}"
            graph.initializer.append(numpy_helper.from_array(np.ascontiguousarray(rows), part))
            result = node.output[0] if i == len(sizes) - 1 else f"{node.output[0]}_to_{i}"
            nodes.append(helper.make_node("Gemm", [name, part, *([total] if total else [])], [result]))
            total = result
    del graph.node[:]
    graph.node.extend(nodes)
    remove_unused(graph)


def remove_unused(graph: Any) -> None:
    """Remove nodes whose results nobody reads, and weights."""
    used = {value.name for value in graph.output}
    kept = []
    for node in reversed(graph.node):
        if used.intersection(node.output):
            used.update(node.input)
            kept.append(node)
    weights = [tensor for tensor in graph.initializer if tensor.name in used]
    del graph.node[:], graph.initializer[:]
    graph.node.extend(reversed(kept))
    graph.initializer.extend(weights)


def _makers(graph: Any) -> dict[str, Any]:
    return {name: node for node in graph.node for name in node.output}


def _users(graph: Any) -> dict[str, list[Any]]:
    users: dict[str, list[Any]] = {}
    for node in graph.node:
        for name in node.input:
            users.setdefault(name, []).append(node)
    return users
