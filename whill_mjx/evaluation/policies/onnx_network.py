"""Runs an ONNX network as a JAX function, so that the exported file itself is evaluated, thousands of copies at once.

Only the standard operators that small policies use are known. What depends on no input of the network is computed with
numpy while tracing, since JAX needs shapes as plain numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Attributes = dict[str, Any]
Operator = Callable[..., Any]


class Network:
    """An ONNX graph. Call it with its inputs in order to get its outputs in order."""

    def __init__(self, data: bytes, name: str = "network"):
        """Read a serialised model.

        Raises:
            ValueError: an operator is not known here; names it and the remedy.
        """
        import onnx
        from onnx import helper, numpy_helper

        graph = onnx.load_model_from_string(data).graph
        self.inputs = [value.name for value in graph.input]
        self.outputs = [value.name for value in graph.output]
        self._constants = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.initializer}
        self._nodes: list[tuple[Operator, list[str], list[str], Attributes]] = []
        for node in graph.node:
            if node.domain not in ("", "ai.onnx") or node.op_type not in OPERATORS:
                raise ValueError(
                    f"{name}: operator {node.domain or 'ai.onnx'}::{node.op_type} is not known here, so the network "
                    "cannot be compiled with the simulator. Evaluate with the runtime 'onnxruntime' instead."
                )
            attributes = {item.name: helper.get_attribute_value(item) for item in node.attribute}
            for key, value in attributes.items():
                if isinstance(value, onnx.TensorProto):
                    attributes[key] = numpy_helper.to_array(value)
            self._nodes.append((OPERATORS[node.op_type], list(node.input), list(node.output), attributes))

    def __call__(self, *values: Any) -> tuple[jax.Array, ...]:
        """Outputs for the inputs `values`, in the order of `inputs`."""
        known: dict[str, Any] = {**self._constants, **dict(zip(self.inputs, values, strict=True))}
        for operator, inputs, outputs, attributes in self._nodes:
            given = [known[name] if name else None for name in inputs]
            fixed = all(value is None or isinstance(value, np.ndarray | np.generic) for value in given)
            result = operator(np if fixed else jnp, attributes, len(outputs), *given)
            result = result if isinstance(result, tuple | list) else (result,)
            known.update(zip(outputs, result, strict=True))
        return tuple(jnp.asarray(known[name]) for name in self.outputs)


def _ints(values: Any) -> tuple[int, ...]:
    """A tensor of shapes, axes or bounds as plain numbers."""
    if isinstance(values, jax.core.Tracer):
        raise ValueError("a shape or an axis of the network depends on its input; such a network cannot be compiled.")
    return tuple(int(value) for value in np.atleast_1d(np.asarray(values)))


def _dtype(code: int) -> np.dtype:
    from onnx import helper

    return helper.tensor_dtype_to_np_dtype(code)


def _elementwise(name: str) -> Operator:
    return lambda xp, attributes, count, *values: getattr(xp, name)(*values)


def _folded(name: str) -> Operator:
    """An operator of any number of inputs, such as Max."""

    def fold(xp, attributes, count, *values):
        result = values[0]
        for value in values[1:]:
            result = getattr(xp, name)(result, value)
        return result

    return fold


def _reduction(name: str, before: str = "", after: str = "") -> Operator:
    """Along axes: a function of NumPy by name, of values and with a result that others are applied to."""

    def reduce(xp, attributes, count, values, axes=None):
        axes = axes if axes is not None else attributes.get("axes")
        if axes is None and attributes.get("noop_with_empty_axes", 0):
            return values
        axis = None if axes is None else _ints(axes)
        values = getattr(xp, before)(values) if before else values
        found = getattr(xp, name)(values, axis=axis, keepdims=bool(attributes.get("keepdims", 1)))
        return getattr(xp, after)(found) if after else found

    return reduce


def _log_sum_exp(xp, attributes, count, values, axes=None):
    highest = _reduction("max")(xp, {**attributes, "keepdims": 1}, count, values, axes)  # else exp overflows
    found = _reduction("sum", before="exp", after="log")(xp, attributes, count, values - highest, axes)
    return found + xp.reshape(highest, found.shape)


def _div(xp, attributes, count, a, b):
    if np.issubdtype(a.dtype, np.integer):
        return xp.trunc(a / b).astype(a.dtype) if xp is np else jax.lax.div(*jnp.broadcast_arrays(a, b))
    return a / b


def _reshape(xp, attributes, count, values, shape):
    wanted = list(_ints(shape))
    if not attributes.get("allowzero", 0):
        wanted = [values.shape[axis] if size == 0 else size for axis, size in enumerate(wanted)]
    return xp.reshape(values, wanted)


def _expand(xp, attributes, count, values, shape):
    return xp.broadcast_to(values, np.broadcast_shapes(values.shape, _ints(shape)))


def _squeeze(xp, attributes, count, values, axes=None):
    return xp.squeeze(values, axis=None if axes is None else _ints(axes))


def _unsqueeze(xp, attributes, count, values, axes):
    rank = values.ndim + len(_ints(axes))
    for axis in sorted(axis % rank for axis in _ints(axes)):
        values = xp.expand_dims(values, axis)
    return values


def _split(xp, attributes, count, values, sizes=None):
    axis = attributes.get("axis", 0)
    if sizes is None:
        return list(xp.array_split(values, count, axis))
    return xp.split(values, np.cumsum(_ints(sizes))[:-1], axis)


def _slice(xp, attributes, count, values, *where):
    starts, ends, axes, steps = (*where, None, None)[:4]
    chosen = _ints(axes) if axes is not None else tuple(range(len(_ints(starts))))
    strides = _ints(steps) if steps is not None else (1,) * len(chosen)
    index: list[slice] = [slice(None)] * values.ndim
    for axis, start, end, stride in zip(chosen, _ints(starts), _ints(ends), strides, strict=True):
        # Counting down, an end before the first element means "to the first"; numpy would read it as the last.
        stop = None if stride < 0 and end < -values.shape[axis] else end
        index[axis] = slice(start, stop, stride)
    return values[tuple(index)]


def _pad(xp, attributes, count, values, *how):
    pads, constant, axes = (*how, None, None)[:3]
    if attributes.get("mode", b"constant") != b"constant":
        raise ValueError("only constant padding is known here. Evaluate with the runtime 'onnxruntime' instead.")
    bounds = _ints(pads)
    chosen = _ints(axes) if axes is not None else tuple(range(values.ndim))
    widths = [(0, 0)] * values.ndim
    for place, axis in enumerate(chosen):
        widths[axis] = (bounds[place], bounds[place + len(chosen)])
    return xp.pad(values, widths, constant_values=0 if constant is None else constant)


def _gemm(xp, attributes, count, a, b, c=None):
    a = a.T if attributes.get("transA", 0) else a
    b = b.T if attributes.get("transB", 0) else b
    product = attributes.get("alpha", 1.0) * (a @ b)
    return product if c is None else product + attributes.get("beta", 1.0) * c


def _conv(xp, attributes, count, values, kernel, bias=None):
    rank = values.ndim - 2
    pads = attributes.get("pads", [0] * 2 * rank)
    automatic = {b"SAME_UPPER": "SAME", b"SAME_LOWER": "SAME_LOWER", b"VALID": "VALID"}
    padding = automatic.get(attributes.get("auto_pad", b"NOTSET"), list(zip(pads[:rank], pads[rank:], strict=True)))
    result = jax.lax.conv_general_dilated(
        jnp.asarray(values),
        jnp.asarray(kernel),
        window_strides=attributes.get("strides", [1] * rank),
        padding=padding,
        rhs_dilation=attributes.get("dilations", [1] * rank),
        feature_group_count=attributes.get("group", 1),
    )
    return result if bias is None else result + jnp.reshape(bias, (1, -1, *[1] * rank))


def _max_pool(xp, attributes, count, values):
    rank = values.ndim - 2
    pads = attributes.get("pads", [0] * 2 * rank)
    if attributes.get("ceil_mode", 0) or attributes.get("auto_pad", b"NOTSET") != b"NOTSET" or count > 1:
        raise ValueError("only plain max-pooling is known here. Evaluate with the runtime 'onnxruntime' instead.")
    return jax.lax.reduce_window(
        jnp.asarray(values),
        -jnp.inf,
        jax.lax.max,
        window_dimensions=(1, 1, *attributes["kernel_shape"]),
        window_strides=(1, 1, *attributes.get("strides", [1] * rank)),
        padding=((0, 0), (0, 0), *zip(pads[:rank], pads[rank:], strict=True)),
        window_dilation=(1, 1, *attributes.get("dilations", [1] * rank)),
    )


def _softmax(xp, attributes, count, values):
    return jax.nn.softmax(jnp.asarray(values), axis=attributes.get("axis", -1))


def _argmax(xp, attributes, count, values):
    axis = attributes.get("axis", 0)
    index = xp.argmax(values, axis=axis)
    index = xp.expand_dims(index, axis) if attributes.get("keepdims", 1) else index
    return index.astype(np.int64 if xp is np else jnp.int32)


def _range(xp, attributes, count, start, limit, delta):
    bounds = (np.asarray(bound).item() for bound in (start, limit, delta))
    return np.arange(*bounds, dtype=np.asarray(start).dtype)


def _cast(xp, attributes, count, values):
    wanted = _dtype(attributes["to"])
    if xp is jnp:
        wanted = jax.dtypes.canonicalize_dtype(wanted)
    return values.astype(wanted)


def _clip(xp, attributes, count, values, low=None, high=None):
    values = values if low is None else xp.maximum(values, low)
    return values if high is None else xp.minimum(values, high)


def _flatten(xp, attributes, count, values):
    axis = attributes.get("axis", 1) % (values.ndim + 1)
    return xp.reshape(values, (int(np.prod(values.shape[:axis])), -1))


def _elu(xp, attributes, count, values):
    return xp.where(values > 0, values, attributes.get("alpha", 1.0) * xp.expm1(xp.minimum(values, 0)))


def _layer_normalization(xp, attributes, count, values, scale, bias=None):
    axes = tuple(range(attributes.get("axis", -1) % values.ndim, values.ndim))
    variance = xp.var(values, axis=axes, keepdims=True) + attributes.get("epsilon", 1e-5)
    result = (values - xp.mean(values, axis=axes, keepdims=True)) / xp.sqrt(variance) * scale
    return result if bias is None else result + bias


def _batch_normalization(xp, attributes, count, values, *statistics):
    scale, bias, mean, variance = (xp.reshape(one, (-1, *[1] * (values.ndim - 2))) for one in statistics)
    return (values - mean) / xp.sqrt(variance + attributes.get("epsilon", 1e-5)) * scale + bias


def _mod(xp, attributes, count, a, b):
    return xp.fmod(a, b) if attributes.get("fmod", 0) else xp.mod(a, b)


OPERATORS: dict[str, Operator] = {
    "Abs": _elementwise("abs"),
    "Add": _elementwise("add"),
    "And": _elementwise("logical_and"),
    "ArgMax": _argmax,
    "Atan": _elementwise("arctan"),
    "BatchNormalization": _batch_normalization,
    "Cast": _cast,
    "CastLike": lambda xp, a, count, values, like: values.astype(like.dtype),
    "Ceil": _elementwise("ceil"),
    "Clip": _clip,
    "Concat": lambda xp, a, count, *values: xp.concatenate(values, axis=a["axis"]),
    "Constant": lambda xp, a, count: np.asarray(next(iter(a.values()))),
    "ConstantOfShape": lambda xp, a, count, shape: np.full(_ints(shape), a.get("value", np.zeros(1, np.float32))[0]),
    "Conv": _conv,
    "Cos": _elementwise("cos"),
    "Div": _div,
    "Dropout": lambda xp, a, count, values, *unused: values,
    "Einsum": lambda xp, a, count, *values: xp.einsum(a["equation"].decode(), *values),
    "Elu": _elu,
    "Equal": _elementwise("equal"),
    "Erf": lambda xp, a, count, values: jax.scipy.special.erf(jnp.asarray(values)),
    "Exp": _elementwise("exp"),
    "Expand": _expand,
    "Flatten": _flatten,
    "Floor": _elementwise("floor"),
    "Gather": lambda xp, a, count, values, index: xp.take(values, index, axis=a.get("axis", 0)),
    "Gemm": _gemm,
    "Greater": _elementwise("greater"),
    "GreaterOrEqual": _elementwise("greater_equal"),
    "Identity": lambda xp, a, count, value: value,
    "LayerNormalization": _layer_normalization,
    "LeakyRelu": lambda xp, a, count, values: xp.where(values > 0, values, a.get("alpha", 0.01) * values),
    "Less": _elementwise("less"),
    "LessOrEqual": _elementwise("less_equal"),
    "Log": _elementwise("log"),
    "LogSoftmax": lambda xp, a, count, values: jax.nn.log_softmax(jnp.asarray(values), axis=a.get("axis", -1)),
    "MatMul": _elementwise("matmul"),
    "Max": _folded("maximum"),
    "MaxPool": _max_pool,
    "Mean": lambda xp, a, count, *values: _folded("add")(xp, a, count, *values) / len(values),
    "Min": _folded("minimum"),
    "Mod": _mod,
    "Mul": _elementwise("multiply"),
    "Neg": _elementwise("negative"),
    "Not": _elementwise("logical_not"),
    "Or": _elementwise("logical_or"),
    "Pad": _pad,
    "Pow": _elementwise("power"),
    "Range": _range,
    "Reciprocal": lambda xp, a, count, value: 1 / value,
    "ReduceL1": _reduction("sum", before="abs"),
    "ReduceL2": _reduction("sum", before="square", after="sqrt"),
    "ReduceLogSum": _reduction("sum", after="log"),
    "ReduceLogSumExp": _log_sum_exp,
    "ReduceMax": _reduction("max"),
    "ReduceMean": _reduction("mean"),
    "ReduceMin": _reduction("min"),
    "ReduceProd": _reduction("prod"),
    "ReduceSum": _reduction("sum"),
    "ReduceSumSquare": _reduction("sum", before="square"),
    "Relu": lambda xp, a, count, value: xp.maximum(value, 0),
    "Reshape": _reshape,
    "Round": _elementwise("rint"),
    "Shape": lambda xp, a, count, value: np.asarray(value.shape[slice(a.get("start", 0), a.get("end"))], np.int64),
    "Sigmoid": lambda xp, a, count, value: jax.nn.sigmoid(jnp.asarray(value)),
    "Sign": _elementwise("sign"),
    "Sin": _elementwise("sin"),
    "Slice": _slice,
    "Softmax": _softmax,
    "Softplus": lambda xp, a, count, value: jax.nn.softplus(jnp.asarray(value)),
    "Split": _split,
    "Sqrt": _elementwise("sqrt"),
    "Squeeze": _squeeze,
    "Sub": _elementwise("subtract"),
    "Sum": _folded("add"),
    "Tan": _elementwise("tan"),
    "Tanh": _elementwise("tanh"),
    "Tile": lambda xp, a, count, values, repeats: xp.tile(values, _ints(repeats)),
    "Transpose": lambda xp, a, count, values: xp.transpose(values, a.get("perm")),
    "Unsqueeze": _unsqueeze,
    "Where": _elementwise("where"),
}
