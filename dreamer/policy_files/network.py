"""A policy as an ONNX network of standard operators, and the proof that it acts like the JAX function it came from."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import sys
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

from dreamer.policy_files import onnx_graph

OPSET = 18
"""ONNX operator set of the file. 18 is readable by onnxruntime 1.14 and newer, so also by a vehicle's older system."""
IR_VERSION = 8
"""ONNX file version that belongs to opset 18."""
ACTION_TOLERANCE = 1e-5
"""Difference of two actions in [-1, 1], or probabilities, in the median step. A wrong export differs at every step."""
RESOLVED = 1e-3
"""Largest difference in any step: vehicles resolve no more of their range. Where a network is steep, it magnifies the
rounding of float32 by as much as its slope, so a single step may differ by more than the median."""
FLIP_SHARE = 0.02
"""Share of steps in which an argmax may fall to the other side of a tie."""

Carry = dict[str, jax.Array]
Shapes = dict[str, jax.ShapeDtypeStruct]


@dataclasses.dataclass(frozen=True)
class Network:
    """A recurrent policy of one instance as a function of named arrays."""

    step: Callable[[Carry, dict[str, jax.Array]], tuple[Carry, tuple[jax.Array, ...]]]
    """(carry, observations by name) -> (carry, outputs). Deterministic: argmax latent, mode action."""
    carry: Shapes
    """Recurrent state by name; all zeros mean the start of an episode."""
    observations: Shapes
    """uint8 images and float32 vectors by name."""
    outputs: tuple[str, ...] = ("action",)
    """Names of the outputs. The last one is compared, so every difference must show in it."""

    @property
    def tensors(self) -> tuple[list[str], list[str]]:
        """Names of ONNX inputs and outputs; ONNX wants each name once, so a state differs on its way in and out.

        Raises:
            ValueError: an observation has the name of another tensor.
        """
        inputs = [*self.observations, *(f"carry_{name}" for name in self.carry)]
        outputs = [*self.outputs, *(f"next_{name}" for name in self.carry)]
        names = inputs + outputs
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"observation {', '.join(twice)}: the policy has another tensor of this name, and ONNX "
                             "wants each once. Rename the observation.")
        return inputs, outputs


def to_onnx(network: Network) -> bytes:
    """Return the network as a serialised ONNX model of standard operators."""
    import jax2onnx
    import onnx
    import onnx.inliner

    inputs, outputs = network.tensors
    seen = len(network.observations)

    def flat_step(*values: jax.Array) -> tuple[jax.Array, ...]:
        obs, state = (dict(zip(names, part, strict=True)) for names, part in
                      ((network.observations, values[:seen]), (network.carry, values[seen:])))
        carry, results = network.step(state, obs)
        return *results, *(carry[name] for name in network.carry)

    quiet = logging.getLogger("onnx_ir")
    level = quiet.level
    quiet.setLevel(logging.ERROR)  # it warns about shapes it leaves out, which no runtime needs
    try:
        with _jax_restored():
            model = jax2onnx.to_onnx(flat_step, [*network.observations.values(), *network.carry.values()],
                                     model_name="policy", opset=OPSET, input_names=inputs)
    finally:
        quiet.setLevel(level)
    model = onnx.inliner.inline_local_functions(model)
    onnx_graph.repair_pools(model.graph)
    onnx_graph.split_products(model.graph)
    _name_outputs(model, outputs)
    model.ir_version = IR_VERSION
    nodes = model.graph.node
    foreign = sorted({f"{node.domain}::{node.op_type}" for node in nodes if node.domain not in ("", "ai.onnx")})
    if foreign:
        raise ValueError(f"policy.onnx: operators {foreign} are not in the ONNX standard set, so a plain onnxruntime "
                         "cannot run them. Rewrite those operations in the policy step.")
    onnx.checker.check_model(model, full_check=False)
    return model.SerializeToString()


@contextlib.contextmanager
def _jax_restored() -> Iterator[None]:
    """Put back every attribute of JAX's modules that is exchanged inside.

    jax2onnx replaces functions of jax.numpy while it traces and leaves some in place; its cumsum refuses arguments that
    JAX's own takes, so that a program would fail at its next trace.
    """
    modules = [module for name, module in sys.modules.items() if name.partition(".")[0] in ("jax", "flax") and module]
    before = [(module, dict(vars(module))) for module in modules]
    try:
        yield
    finally:
        for module, attributes in before:
            for name, value in attributes.items():
                if vars(module).get(name) is not value:
                    setattr(module, name, value)


def _name_outputs(model: Any, names: list[str]) -> None:
    """Give the graph's outputs their names; one value may be two outputs (the action is often part of the carry)."""
    import onnx

    for output, name in zip(model.graph.output, names, strict=True):
        model.graph.node.append(onnx.helper.make_node("Identity", [output.name], [name], name=f"output_{name}"))
        output.name = name


def parity(model: bytes, network: Network, steps: int) -> dict[str, Any]:
    """Largest differences of ONNX and JAX over random observations.

    The difference of one step, both from JAX's state, shows whether the export is right; it is what is judged. The
    difference after many steps, each from its own state, is noted as well: a recurrent network can amplify rounding,
    most of all on noise, which it was never trained on. Where an argmax latent falls on a tie, rounding decides and
    both continue on different states: such a step is counted as a flip and the states are made equal again.

    Raises:
        ValueError: it is more than rounding.
    """
    import onnxruntime

    onnxruntime.set_default_logger_severity(3)  # errors alone, as in bridge.policy
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    names, (inputs, _), judged = list(network.carry), network.tensors, len(network.outputs) - 1

    def onnx_step(carry: list[np.ndarray], obs: dict[str, np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
        results = session.run(None, dict(zip(inputs, [*obs.values(), *carry], strict=True)))
        return results[judged], results[judged + 1 :]

    @jax.jit
    def jax_step(carry: Any, obs: dict[str, Any]) -> tuple[Any, Any]:
        with jax.default_matmul_precision("highest"):  # a GPU would round float32 to fewer bits
            return network.step(carry, obs)

    carry: Any = {name: np.zeros(shape.shape, shape.dtype) for name, shape in network.carry.items()}
    own_carry = list(carry.values())
    rng = np.random.default_rng(0)
    apart: list[float] = []
    drift, flips = 0.0, 0
    for _ in range(steps):
        obs = {name: _noise(rng, shape) for name, shape in network.observations.items()}
        one_action, one_carry = onnx_step([np.asarray(carry[name]) for name in names], obs)
        own_action, own_carry = onnx_step(own_carry, obs)
        carry, results = jax_step(carry, obs)
        action = results[judged]
        jax_carry = [np.asarray(carry[name]) for name in names]
        if _distance(jax_carry, own_carry) > 0.5:
            own_carry = jax_carry
        else:
            drift = float(np.maximum(drift, _distance([action], [own_action])))
        if _distance(jax_carry, one_carry) > 0.5:
            flips += 1
        else:
            apart.append(_distance([action], [one_action]))
    worst, usual = (float(of(apart)) if apart else 0.0 for of in (np.max, np.median))
    if not (usual <= ACTION_TOLERANCE and worst <= RESOLVED) or flips > FLIP_SHARE * steps:  # a NaN fails too
        raise ValueError(f"policy.onnx: in {steps} steps it differs from JAX by {usual:.2g} in the median and "
                         f"{worst:.2g} at most, with {flips} latent flips; rounding is {ACTION_TOLERANCE}, {RESOLVED}, "
                         f"{FLIP_SHARE:.0%} flips. Export a deterministic step that computes in float32.")
    return {"steps": steps, "max_abs_action_difference": worst, "median_abs_action_difference": usual,
            "max_abs_action_drift": drift, "latent_flips": flips}


def _noise(rng: np.random.Generator, shape: jax.ShapeDtypeStruct) -> np.ndarray:
    """An image of random bytes, or a vector whose size lies anywhere from a hundredth to a hundred."""
    if shape.dtype == np.uint8:
        return rng.integers(0, 256, shape.shape, np.uint8)
    return (10.0 ** rng.uniform(-2, 2) * rng.normal(size=shape.shape)).astype(np.float32)


def _distance(a: list[Any], b: list[Any]) -> float:
    """Return the largest difference of two lists of arrays; NaN where one has it."""
    differences = [np.abs(np.asarray(x, np.float64) - y).max(initial=0) for x, y in zip(a, b, strict=True)]
    return float(np.max(differences, initial=0.0))
