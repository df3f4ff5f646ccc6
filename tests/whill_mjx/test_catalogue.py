"""Rules that hold for every effect of the catalogue."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from effects_in_hand import chair, motion_at, path, quick, run, yielding

import whill_mjx
from whill_mjx.effects import EFFECTS, equation, make_effect, make_effects
from whill_mjx.effects.base import place_of
from whill_mjx.effects.card import Scale
from whill_mjx.vehicle.dynamics import add_payload, drive, measure, nominal_world, place
from whill_mjx.vehicle.kinematics import body_twist
from whill_mjx.vehicle.model import build_model
from whill_mjx.vehicle.parameters import describe
from whill_mjx.vehicle.presets import preset
from whill_mjx.vehicle.types import parameters_of

DRIVES = {name for name, kind in EFFECTS.items() if kind.card.drives}  # no disturbances: without them nothing drives
OUTSIDE = {name for name, kind in EFFECTS.items() if place_of(kind) == "outside"}  # test_effect_pose_delay.py
CATALOGUE = sorted(set(EFFECTS) - DRIVES - OUTSIDE)


@quick
def test_every_class_of_an_effect_in_the_package_is_in_the_catalogue_in_order_of_the_names():
    texts = [path.read_text() for path in (Path(whill_mjx.__file__).parent / "effects").glob("*.py")]
    names = [name for text in texts for name in re.findall(r'^    name = "(\w+)"$', text, re.MULTILINE)]
    assert list(EFFECTS) == sorted(names) and len(names) == len(set(names))


@quick
def test_effects_that_the_loop_looks_for_have_an_order_of_their_own():
    """Seeds of tests and verdicts depend on it."""
    orders = [kind.card.order for kind in EFFECTS.values() if kind.card.variants]
    assert np.isfinite(orders).all() and len(orders) == len(set(orders))


@quick
def test_cards_name_effects_and_parameters_that_exist():
    spec, params = preset("whill_cr_physical")
    scale = Scale(spec, frozenset(describe(params)))
    for name, kind in EFFECTS.items():
        assert {other for one in kind.card.alike for other in one.names} <= set(EFFECTS) - {name}
        for variant in kind.card.variants_of(scale):
            for parameter in [axis.parameter for axis in variant.axes] + [each for each, _ in variant.constants]:
                holder, _, field = parameter.rpartition(".")
                assert field in parameters_of(EFFECTS[holder or name])


@quick
@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_usual_values_lie_in_the_range_of_a_fit_and_have_a_source(name):
    kind = EFFECTS[name]
    about = parameters_of(kind)
    assert kind.source and kind.typical and set(kind.typical) <= set(about)
    for field, (low, high) in kind.typical.items():
        assert about[field].low <= low <= high <= about[field].high
    assert any({low, high} != {about[field].neutral} for field, (low, high) in kind.typical.items())


@quick
@pytest.mark.parametrize("name", CATALOGUE)
def test_every_effect_vanishes_to_the_last_bit_at_its_neutral_value(name):
    effect = make_effect(name)
    motion = motion_at(0.7, 0.4, 0.1)
    phase = jnp.arange(30.0)
    wave = 1.7 * jnp.sin(phase[:, None] * jnp.array([1.0, 0.7]))
    match place_of(effect):
        case "command":
            np.testing.assert_array_equal(run(effect, wave, motion), wave)
        case "actuation":
            inputs = yielding(wave, 300 * wave, 40 * wave[:, ::-1])
            jax.tree.map(np.testing.assert_array_equal, run(effect, inputs, motion), inputs)
        case "sensing":
            readings = path(0.5 + wave[:, 0], wave[:, 1])
            jax.tree.map(np.testing.assert_array_equal, run(effect, readings, motion), readings)
        case "force":
            memory = effect.init()
            for _ in range(3):
                memory, wrench = effect.force(memory, motion)
                jax.tree.map(lambda leaf: np.testing.assert_array_equal(leaf, 0.0), wrench)
        case "world":
            before = nominal_world(chair()[0])
            _, after = effect.world(effect.init(), before)
            # Springs are the same at their neutral values; their loads are then those of the end of a step.
            assert after.sprung == (name == "suspension")
            after = replace(after, sprung=before.sprung)
            jax.tree.map(np.testing.assert_array_equal, replace(after, payload=None, ground=(), middle=None), before)
            for surface in after.ground:  # that the motion is the same to the last bit: test_ground.py
                for part in surface.height(jnp.array([0.7, -1.2]), jnp.array([0.1, 30.0])):
                    np.testing.assert_array_equal(part, 0.0)
            if after.payload is not None:
                body = jnp.array(60.3), jnp.array([5.1, 4.2, 3.3]), jnp.array([0.1, -0.02, 0.3])
                jax.tree.map(np.testing.assert_array_equal, add_payload(*body, after.payload), body)


@quick
@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_every_effect_is_on_the_page_of_effects_with_its_parameters(name):
    page = (Path(__file__).parents[2] / "docs" / "effects.md").read_text().partition("## What the closed loop")[0]
    rows = [line for line in page.splitlines() if line.startswith(f"| `{name}` |")]
    remedy = "write the page again: python -m benchmarks.effects page"
    assert len(rows) == 1, remedy
    for field, about in parameters_of(EFFECTS[name]).items():
        assert f"`{field}` [{about.unit}]" in rows[0], remedy


@quick
def test_the_equation_of_an_effect_is_the_whole_first_paragraph_of_its_docstring_without_the_source():
    assert equation(EFFECTS["clock_offset"]).endswith("the pose moved back along its arc.")
    assert equation(EFFECTS["air_drag"]) == "F = -1/2 rho C_d A |v_air| v_air along the chassis x axis."
    assert all(equation(kind) for kind in EFFECTS.values())


@quick
def test_effects_of_several_names_come_in_the_order_of_a_vehicle():
    names = [effect.name for effect in make_effects(["wind", "yaw_scrub", "command_delay", "slope", "wind"])]
    assert names == ["command_delay", "wind", "yaw_scrub", "slope"]


@quick
def test_an_unknown_effect_or_parameter_names_the_known_ones():
    with pytest.raises(ValueError, match="unknown effect 'gravity'.*yaw_scrub"):
        make_effect("gravity")
    with pytest.raises(ValueError, match="no parameter 'force'.*torque"):
        make_effect("yaw_scrub", force=1.0)


# Derivatives

ROUNDING = {name for name, kind in EFFECTS.items() if kind.card.stepped} - {"command_quantisation"}
"""Made of steps: their derivatives are finite, and differences across a step mean nothing. Those by the size of a step
of `command_quantisation` are right."""


@lru_cache
def wide_inputs():
    """Sequences of every kind of input in float64; call with 64-bit types enabled."""
    spec, params = preset("whill_cr_physical")
    model = build_model(spec)
    t = jnp.arange(60.0)
    v, omega, sideways = 0.8 * jnp.sin(0.11 * t + 0.3), 0.7 * jnp.cos(0.17 * t), 0.3 * jnp.sin(0.23 * t)

    def one(v, omega, sideways):
        state = place(model, params, 0.0, 0.0, 0.4, (v, omega))
        return measure(model, params, nominal_world(model), replace(state, qvel=state.qvel.at[1].add(sideways)))

    motions = jax.vmap(one)(v, omega, sideways)
    # Held for 6 steps each; some of them small, for the dead zone's edge.
    held = jnp.array([[2.1, 0.3], [0.026, 1.0], [-2.1, 0.05], [1.1, -0.05], [0.4, 0.9]])
    commands = jnp.repeat(jnp.concatenate([held, -0.98 * held]), 6, axis=0)
    wave = jnp.stack([jnp.sin(0.31 * t + 0.1), 0.7 * jnp.cos(0.27 * t)], axis=1)
    inputs = {"command": commands, "actuation": yielding(wave, 150 * wave, 20 * wave), "force": t, "world": t,
              "sensing": path(v, omega)}  # fmt: skip
    return model, motions, inputs


@pytest.mark.parametrize("name", CATALOGUE)
def test_forward_mode_derivatives_of_every_effect_agree_with_central_differences(name):
    """In float64 over 60 steps of changing motion, at usual values and, finite only, at the neutral ones."""
    with jax.enable_x64(True):
        kind, about = EFFECTS[name], parameters_of(EFFECTS[name])
        model, motions, inputs = wide_inputs()
        where = place_of(EFFECTS[name])
        usual = {field: low + 0.37 * (high - low) for field, (low, high) in kind.typical.items()}
        values = np.array([usual.get(field, about[field].neutral) for field in about])

        def outcome(values):
            effect = kind(*values)

            def one(memory, given):
                value, motion = given
                if where == "world":
                    moving = replace(nominal_world(model), speed=motion.velocity[0], drift=jnp.zeros(()),
                                     yaw_rate=motion.angular_velocity[2])
                    return effect.world(memory, moving)
                rest = (motion,) if where == "force" else (value, motion)
                return getattr(effect, where)(memory, *rest)

            outputs = jax.lax.scan(one, effect.init(), (inputs[where], motions))[1]
            return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(outputs)])

        jacobian = jax.jit(jax.jacfwd(outcome))
        forward = np.asarray(jacobian(values))
        steps = 1e-6 * np.maximum(np.abs(values), 1e-2)
        points = np.concatenate([values + np.diag(steps), values - np.diag(steps)])
        results = np.asarray(jax.jit(jax.vmap(outcome))(points))
        central = ((results[: len(values)] - results[len(values) :]) / (2 * steps[:, None])).T
        neutral = np.asarray(jacobian(np.array([about[field].neutral for field in about])))
    assert np.isfinite(neutral).all() and np.isfinite(forward).all()
    if name in ROUNDING:
        return
    assert np.abs(central).max() > 0
    np.testing.assert_allclose(forward, central, rtol=1e-4, atol=1e-5 * np.abs(central).max())


# All at once


def test_all_effects_act_together_in_one_compiled_model():
    """At their neutral values the chair drives as without them; at usual ones it goes elsewhere, and stays finite."""
    spec, params = preset("whill_cr_physical")
    model = build_model(spec)
    have = {effect.name for effect in params.effects}
    more = [name for name in CATALOGUE if name not in have]
    neutral = replace(params, effects=(*params.effects, *(make_effect(name) for name in more)))

    def usual(name):
        # Gentle: a fifth of the way from the neutral value, or from the far end where that is infinite.
        about, values = parameters_of(EFFECTS[name]), {}
        for field, (_, high) in EFFECTS[name].typical.items():
            start = about[field].neutral if np.isfinite(about[field].neutral) else high
            values[field] = start + 0.2 * (high - start)
        return make_effect(name, **values)

    changed = replace(params, effects=(*params.effects, *(usual(name) for name in more)))
    period = jax.jit(lambda params, state, command: drive(model, params, state, command))
    plain = jax.jit(lambda params, state, command: drive(model, params, state, command))
    twists = {}
    for label, vehicle, step in (("plain", params, plain), ("neutral", neutral, period), ("usual", changed, period)):
        state = place(model, vehicle, 0.0, 0.0, 0.0)
        for command in ((0.6, 0.5),) * 8 + ((-0.3, -0.5),) * 8:
            state = step(vehicle, state, jnp.array(command))
        assert not state.diverged
        assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(state))
        twists[label] = np.array([*body_twist(model, state.qpos, state.qvel), state.odometry.gyro, *state.qpos[:2]])
    assert period._cache_size() == 1
    np.testing.assert_allclose(twists["neutral"], twists["plain"], atol=1e-3)
    assert np.abs(twists["usual"] - twists["plain"]).max() > 0.02
