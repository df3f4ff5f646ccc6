"""The kernel that steps a whole control period: interpreted on the CPU, lowered for CUDA, its assembly evaluated."""

from __future__ import annotations

import re
import struct
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AbstractDevice, AbstractMesh, AxisType, use_abstract_mesh

from whill_mjx.vehicle import ptx
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.dynamics import drive, one_step, place
from whill_mjx.vehicle.kernel import Launch, Roll, held_in_registers
from whill_mjx.vehicle.model import build_model
from whill_mjx.vehicle.presets import preset
from whill_mjx.vehicle.scalars import in_pieces

quick = pytest.mark.quick
STEPS = 4


def pull(params, state, force):
    """A damped spring with a counter and a flag: one step of 0.1 s."""
    rate = state["rate"] + 0.1 * (force - params["stiffness"] * state["place"] - jnp.tanh(state["rate"]))
    fast = state["fast"] | (jnp.abs(rate) > 1.0).any()
    place = jnp.round(state["place"] * 64) / 64 + 0.1 * rate / jnp.sqrt(1 + params["mass"] ** 2)
    return {"place": place, "rate": rate, "fast": fast, "count": state["count"] + fast.astype(jnp.int32)}


def pulled(params, state, force):
    return jax.lax.fori_loop(0, STEPS, lambda _, state: pull(params, state, force), state)


def springs(count):
    random = np.random.default_rng(0)
    params = {"stiffness": jnp.asarray(random.uniform(1, 5, (count, 2)), jnp.float32), "mass": jnp.float32(1.3)}
    state = {"place": jnp.asarray(random.normal(size=(count, 2)), jnp.float32), "rate": jnp.zeros((count, 2)),
             "fast": jnp.zeros(count, bool), "count": jnp.zeros(count, jnp.int32)}  # fmt: skip
    return params, state, jnp.asarray(random.normal(size=(count, 2)), jnp.float32)


AXES = ({"stiffness": 0, "mass": None}, 0, 0)


def in_kernel(*args, launch=None):
    return held_in_registers(Roll(pull, STEPS, pulled), args, launch or Launch(lanes=4), forced=True)


def close(found, expected):
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6), found, expected)


@quick
@pytest.mark.parametrize("launch", [Launch(lanes=4), Launch(lanes=8)])
def test_a_batch_in_the_kernel_equals_one_by_one_whatever_its_size(launch):
    args = springs(11)
    found = jax.jit(jax.vmap(partial(in_kernel, launch=launch), in_axes=AXES))(*args)
    expected = jax.vmap(pulled, in_axes=AXES)(*args)
    assert 0 < int(expected["count"].sum()) < 11 * STEPS
    close(found, expected)


@quick
def test_a_batch_of_batches_is_one_batch_of_the_kernel():
    params, state, force = springs(6)
    grid = jax.tree.map(lambda leaf: leaf.reshape(2, 3, *leaf.shape[1:]), state)
    inner = ({"stiffness": None, "mass": None}, 0, None)
    outer = ({"stiffness": 0, "mass": None}, 0, 0)
    few = {"stiffness": params["stiffness"][:2], "mass": params["mass"]}, grid, force[:2]
    twice = [jax.vmap(jax.vmap(one, in_axes=inner), in_axes=outer)(*few) for one in (in_kernel, pulled)]
    close(*twice)


@quick
def test_derivatives_of_the_kernel_are_those_of_the_plain_steps():
    params, state, force = springs(3)

    def end(function, stiffness):
        moved = jax.vmap(function, in_axes=AXES)({**params, "stiffness": stiffness}, state, force)
        return moved["rate"] * moved["count"][:, None]

    for derivative in (jax.jacfwd, jax.jacrev):
        close(*(derivative(partial(end, function))(params["stiffness"]) for function in (in_kernel, pulled)))


def test_a_drive_has_the_same_derivatives_in_both_directions():
    spec, params = preset("whill_cr_paper")
    model = build_model(spec, VehicleConfig(control_dt=0.005))
    start = place(model, params, 0.0, 0.0, 0.0)

    def speeds(command):
        return drive(model, params, start, command).qvel

    forward, backward = (jax.jit(derivative(speeds))(jnp.array([0.5, 0.2])) for derivative in (jax.jacfwd, jax.jacrev))
    assert np.abs(forward).max() > 0.01
    np.testing.assert_allclose(backward, forward, rtol=1e-4, atol=1e-6)


@quick
def test_a_step_that_the_kernel_lacks_is_refused_or_taken_without_it():
    def step(params, state, given):
        return jnp.cumsum(state) + jax.scipy.special.erf(given)

    args = jnp.ones(()), jnp.ones(3), jnp.ones(3)
    with pytest.raises(ValueError, match=r"lacks cumsum.*, erf.*; choose kernel=False"):
        held_in_registers(Roll(step, 1, step), args, forced=True)
    with pytest.warns(UserWarning, match="without its GPU kernel, which lacks cumsum"):
        close(held_in_registers(Roll(step, 1, step), args), step(*args))


@quick
def test_a_launch_that_triton_lacks_is_refused():
    with pytest.raises(ValueError, match="lanes is 12"):
        Launch(lanes=12)


def test_the_kernel_of_a_vehicle_lowers_for_cuda():
    spec, params = preset("whill_cr_paper")
    model = build_model(spec, VehicleConfig(kernel=True))
    state = jax.eval_shape(lambda: place(model, params, 0.0, 0.0, 0.0))
    many = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((40, *jnp.shape(leaf)), leaf.dtype), state)
    period = jax.jit(jax.vmap(lambda s, c: drive(model, params, s, c)))
    device = AbstractDevice("NVIDIA H200", None, "cuda")
    with use_abstract_mesh(AbstractMesh((1,), ("one",), (AxisType.Auto,), abstract_device=device)):
        traced = period.trace(many, jax.ShapeDtypeStruct((40, 2), jnp.float32))
        assert "triton" in traced.lower(lowering_platforms=("cuda",)).as_text()


# The assembly

F = np.float32
CODES = {
    "mov.f32": lambda a: a, "add.f32": np.add, "sub.f32": np.subtract, "mul.f32": np.multiply, "neg.f32": np.negative,
    "abs.f32": np.abs, "rcp.approx.ftz.f32": lambda a: F(1) / a, "sqrt.approx.f32": np.sqrt,
    "rsqrt.approx.f32": lambda a: F(1) / np.sqrt(a), "max.NaN.f32": np.maximum, "min.NaN.f32": np.minimum,
    "setp.lt.f32": np.less, "setp.gt.f32": np.greater, "setp.le.f32": np.less_equal, "setp.ge.f32": np.greater_equal,
    "setp.eq.f32": np.equal, "setp.neu.f32": np.not_equal, "setp.ne.b32": np.not_equal, "setp.eq.u32": np.equal,
    "and.pred": np.logical_and, "or.pred": np.logical_or, "xor.pred": np.logical_xor, "not.pred": np.logical_not,
    "selp.f32": lambda a, b, p: np.where(p, a, b), "selp.b32": lambda a, b, p: np.where(p, a, b),
    "testp.finite.f32": np.isfinite, "cvt.rmi.f32.f32": np.floor, "cvt.rpi.f32.f32": np.ceil,
    "cvt.rni.f32.f32": np.rint,
}  # fmt: skip
"""What the instructions do, by the handbook of PTX."""


def executed(code, operands):
    """Registers after a block of assembly; of the `operands` those that it reads are known."""
    registers = dict(operands)

    def read(word):
        if word.startswith("0f"):
            return F(struct.unpack(">f", bytes.fromhex(word[2:]))[0])
        return np.int32(word) if word.isdigit() else registers[word]

    for line in re.findall(r"^(?!\.)(\S+) (.*);$", code, re.M):
        target, *words = line[1].split(", ")
        with np.errstate(all="ignore"):
            registers[target] = CODES[line[0]](*map(read, words))
    return registers


def assembled(jaxpr, inputs):
    """Outputs of a jaxpr of single numbers for arrays of them, by its assembly and the operations between."""
    ends = ptx.variables(jaxpr.outvars)
    values = dict(zip(jaxpr.invars, inputs, strict=True))
    shape = np.shape(inputs[0])

    def block(atom):
        return np.full(shape, atom.val, atom.aval.dtype) if hasattr(atom, "val") else values[atom]

    for stage in ptx.stages(ptx.needed(jaxpr), ends):
        given = [np.asarray(values[v], np.int32) if v.aval.dtype == bool else values[v] for v in stage.inputs]
        first = len(stage.outputs)
        registers = executed(stage.code, {f"${first + place}": value for place, value in enumerate(given)})
        values |= {v: np.asarray(registers[f"${place}"], v.aval.dtype) for place, v in enumerate(stage.outputs)}
        for one in stage.others:
            operands = [jnp.asarray(block(atom)) for atom in one.invars]
            values[one.outvars[0]] = np.asarray(one.primitive.bind(*operands, **one.params))
    return [block(atom) for atom in jaxpr.outvars]


def everything(a, b, flag):
    """One of each operation that is written as assembly."""
    inside = (a > b) ^ flag | (a <= 0.3) & ~(b >= 0.5) | (a < b) & (flag == (b != 0.25)) | jnp.isfinite(a / b)
    either = jnp.where(inside, a, jnp.clip(b, -0.2, 0.7)), jnp.where(flag, inside, a == b)
    powers = a**2 + b**-3 + jax.lax.rsqrt(jnp.abs(a) + 0.1) + jnp.square(b) + jnp.sqrt(jnp.abs(b)) + 1 / b
    whole = jnp.floor(a) + jnp.ceil(b) * jnp.round(a * 2) + jnp.sign(b) - (-a) + flag.astype(a.dtype) * jnp.sin(a)
    return either, jnp.maximum(powers, whole), jnp.minimum(a, b) % 0.3, (a * b).astype(bool), jnp.float32(2.0)


@quick
def test_the_assembly_computes_what_its_operations_do():
    values = np.array([-1.5, -0.4, 0.0, 0.25, 0.5, 1.25, np.inf, np.nan], np.float32)
    a, b = (one.ravel() for one in np.meshgrid(values, values))
    for flag in (True, False):
        flags = np.full(a.shape, flag)
        traced = in_pieces(everything, F(0), F(0), np.bool_(flag))
        expected = jax.tree.leaves(jax.vmap(everything)(jnp.asarray(a), jnp.asarray(b), jnp.asarray(flags)))
        for one, other in zip(assembled(traced.jaxpr, [a, b, flags]), expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-6)


@quick
def test_the_assembly_of_a_vehicle_steps_it():
    spec, params = preset("whill_cr_physical")
    model = build_model(spec, VehicleConfig())
    params = jax.tree.map(jnp.asarray, params)
    state = place(model, params, 0.0, 0.0, 0.3, (0.5, 0.3))
    args = params, state, jnp.array([0.7, -0.2])
    traced = in_pieces(partial(one_step, model), *args)
    numbers = [np.asarray(number).reshape(1) for leaf in jax.tree.leaves(args) for number in np.ravel(leaf)]
    found = iter(np.concatenate(assembled(traced.jaxpr, numbers)))
    expected = jax.jit(partial(one_step, model))(*args)
    assert np.abs(expected.qvel - state.qvel).max() > 1e-3
    jax.tree.map(
        lambda leaf: np.testing.assert_allclose(
            [next(found) for _ in range(leaf.size)], leaf.ravel(), rtol=2e-5, atol=1e-5
        ),
        expected,
    )
