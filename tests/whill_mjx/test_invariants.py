"""Whole drives with every effect at once: derivatives of each parameter, mirror images; and energy without input.

All rows of a question go through one compiled call.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.effects import EFFECTS, make_effect
from whill_mjx.effects.base import place_of
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.dynamics import (
    SMOOTH_LOAD,
    forces,
    mass_distribution,
    one_step,
    place,
    substeps,
    suspension,
)
from whill_mjx.vehicle.ground import footing
from whill_mjx.vehicle.kinematics import reference_pose
from whill_mjx.vehicle.model import build_model
from whill_mjx.vehicle.parameters import describe, get_values, set_values
from whill_mjx.vehicle.presets import preset
from whill_mjx.vehicle.specs import GRAVITY
from whill_mjx.vehicle.types import parameters_of

QUICK_TO_COMPILE = {"xla_llvm_disable_expensive_passes": True, "xla_backend_optimization_level": 1}
STEPPED = {name for name, kind in EFFECTS.items() if kind.card.stepped}
"""Made of steps: no derivative; test_catalogue.py tests that theirs are finite."""
ODD = {"body.com_y"} | {f"{name}.{one}" for name, kind in EFFECTS.items() for one in kind.card.mirrored}
"""Parameters that change their sign in a mirror, where left is right."""
SHOWN = {"bump": {"rise": 0.02, "width": 0.3, "x": 0.9, "y": 0.2},
         "ramp": {"rise": 0.1, "length": 1.0, "distance": 0.65, "direction": 0.2},
         "command_dead_zone": {"linear": 0.02, "angular": 0.1},
         "pid_drive": {"kp": 5.0, "ki": 2.0, "kd": 0.1, "integral_limit": 0.02}}  # fmt: skip
ELSEWHERE = {"unnamed"}
"""Tables, most of whose knots one drive does not reach: test_catalogue.py and test_effect_unnamed.py."""
SILENT = {"command_delay.delay", "command_dead_zone.linear", "command_dead_zone.wheel", "motor_line.no_load_speed",
          "motor_line.droop", "middle_wheels.share"}
"""Parameters that this drive does not tell: the ramp behind a delay swallows it, v and wheel speeds stay large, and the
chair's torques end far below the line of a motor; only a skid drive has wheels in the middle."""


GROUPS = {"drive": ("command", "actuation", "sensing"), "ground": ("force", "world")}
"""Places of the effects that are driven together: one compiled drive each."""


def with_effects_at(places):
    """The physical chair with all other effects of these places, at gentle values that are not neutral."""
    spec, params = preset("whill_cr_physical")
    have = {effect.name for effect in params.effects}

    def gentle(name):
        about, values = parameters_of(EFFECTS[name]), {}
        for field, (low, high) in EFFECTS[name].typical.items():
            start = about[field].neutral if np.isfinite(about[field].neutral) else high
            values[field] = start + 0.23 * ((high if high != start else low) - start)
        return make_effect(name, **{**values, **SHOWN.get(name, {})})

    left_out = have | STEPPED | ELSEWHERE
    names = [name for name in EFFECTS if name not in left_out and place_of(EFFECTS[name]) in places]
    names.sort(key=lambda name: name != "pid_drive")  # what scales its force comes behind it
    body = replace(params.body, com_y=jnp.asarray(0.01), com_z=jnp.asarray(0.1))
    return spec, replace(params, body=body, effects=(*params.effects, *map(gentle, names)))


@lru_cache
def driven(group):
    """Names and steps of the parameters, and for each row of inputs the drive and its derivative, in float64.

    Rows: forward derivatives (P), parameters stepped up and down (2 P), the drive and its mirror image (2).
    """
    with jax.enable_x64(True):
        build_model.cache_clear()
        spec, params = with_effects_at(GROUPS[group])
        model = build_model(spec, VehicleConfig(control_dt=0.05))
        names = list(describe(params))
        values = np.array(get_values(params, names), float)
        values[names.index("command_delay.delay")] += 0.4 * 0.005  # whole steps are a kink: differentiate beside it
        values[names.index("torque_drive.limit")] = 7.0  # low enough to be reached
        held = [[0.9, 0.5], [0.6, -0.7], [-0.5, 0.1]]
        commands = np.repeat(held, 100, axis=0).reshape(-1, 10, 2)  # 1.5 s

        def outcome(values, side):
            # `one_step` on vectors: taken apart, it would run faster but take longer to compile.
            changed = set_values(params, names, values)

            def record(state, command):
                state = jax.lax.scan(
                    lambda s, c: (one_step(model, changed, s, c), None), state, command * jnp.stack([1.0, side]))[0]
                pose, read = reference_pose(model, state.qpos), state.odometry
                return state, jnp.stack([*pose, state.qpos[2], read.x, read.y, read.yaw, read.v, read.omega, read.gyro])

            return jax.lax.scan(record, place(model, changed, 0.0, 0.0, 0.0), jnp.asarray(commands))[1]

        def row(values, side, direction):
            return jax.jvp(lambda v: outcome(v, side), (values,), (direction,))

        count = len(values)
        least = [100.0 if name == "supply_sag.session" else 1e-2 for name in names]  # smaller steps: rounding
        steps = 1e-6 * np.maximum(np.abs(values), least)
        plain = np.where([name == "caster_kick.force_limit" for name in names], 0.0, values)
        mirrored = np.where([name in ODD for name in names], -plain, plain)
        points = np.concatenate([np.tile(values, (count, 1)), values + np.diag(steps), values - np.diag(steps),
                                 plain[None], mirrored[None]])  # fmt: skip
        sides = np.ones(len(points))
        sides[-1] = -1.0
        directions = np.zeros_like(points)
        directions[:count] = np.eye(count)
        compiled = jax.jit(jax.vmap(row), compiler_options=QUICK_TO_COMPILE)
        seen, derivative = (np.asarray(out) for out in compiled(points, sides, directions))
        build_model.cache_clear()
    return names, steps, seen, derivative


@pytest.mark.parametrize("group", GROUPS)
def test_derivatives_of_every_parameter_in_a_drive_agree_with_central_differences(group):
    names, steps, seen, derivative = driven(group)
    count = len(names)
    central = (seen[count : 2 * count] - seen[2 * count : 3 * count]) / (2 * steps[:, None, None])
    assert np.isfinite(seen).all() and np.isfinite(derivative).all()
    for index, name in enumerate(names):
        scale = np.abs(central[index]).max()
        np.testing.assert_allclose(derivative[index], central[index], rtol=0, atol=2e-3 * scale + 1e-7, err_msg=name)
    silent = {name for index, name in enumerate(names) if not central[index].any()}
    assert silent <= SILENT, silent


@pytest.mark.parametrize("group", GROUPS)
def test_a_drive_with_mirrored_parameters_and_commands_is_the_mirror_image(group):
    """All effects but the casters' kick, whose side after an exactly straight reversal is a choice."""
    _, _, seen, _ = driven(group)
    right, left = seen[-2], seen[-1]
    signs = np.array([1, -1, -1, 1, 1, -1, -1, 1, -1, -1])
    assert np.abs(right[:, 1]).max() > 0.002  # it does turn
    np.testing.assert_allclose(left * signs, right, atol=1e-9)


# Energy

PASSIVE = ("air_drag", "caster_kick", "dry_friction", "lateral_damping", "omni_roller_friction", "quadratic_drag",
           "rolling_resistance", "rolling_resistance_speed", "slip_traction", "yaw_scrub", "incline", "ramp", "bump",
           "slope", "payload_shift", "track_width", "wheel_radius_difference", "wind")  # fmt: skip
SOME = {"incline": {"along_x": -0.05, "along_y": 0.03}, "slope": {"along_x": -0.05, "along_y": 0.03}, **SHOWN,
        "payload_shift": {"mass": 20.0, "x": 0.1, "y": 0.1, "z": 0.3}, "wind": {}}  # fmt: skip


def elastic(compression, mass):
    """Energy [J] of a suspension whose force is smooth softplus(stiffness compression / smooth): its integral."""
    stiffness, smooth = float(suspension(mass)[0]), SMOOTH_LOAD * float(mass) * GRAVITY / 4
    grid = np.linspace(-60, 400, 460001)
    force = np.logaddexp(grid, 0)
    table = np.cumsum((force + np.roll(force, 1)) / 2) * (grid[1] - grid[0])
    return smooth**2 / stiffness * np.interp(stiffness * compression / smooth, grid, table)


def test_energy_never_grows_without_input():
    """A chair without drive, thrown forward, sideways and turning, on every ground and with every passive effect.

    Kinetic, potential and elastic energy together fall from one record to the next, within 1 mJ of some 100 J; within
    0.1 J on curved ground, which each wheel takes for its tangent plane.
    """
    with jax.enable_x64(True):
        build_model.cache_clear()
        spec, params = preset("whill_cr")
        model = build_model(spec)
        neutral = replace(params, effects=tuple(make_effect(name) for name in PASSIVE))

        def variant(*names):
            effects = []
            for effect in neutral.effects:
                if effect.name in names:
                    usual = {field: high for field, (_, high) in type(effect).typical.items()}
                    effect = make_effect(effect.name, **SOME.get(effect.name, usual))
                effects.append(effect)
            return replace(neutral, effects=tuple(effects))

        variants = [variant(), *(variant(name) for name in PASSIVE), variant("bump", "slip_traction", "payload_shift")]
        batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *variants)

        def one(params):
            state = place(model, params, 0.0, 0.0, 0.0, (1.0, 0.5))
            state = replace(state, qvel=state.qvel.at[1].add(0.3))

            def record(state, command):
                state = substeps(model, params, state, command)
                return state, (state.qpos, state.qvel, motion_of(params, state))

            def motion_of(params, state):
                motion = forces(model, params, state, jnp.zeros(2))[2]
                mass, inertia, com = mass_distribution(model, params, motion.world)
                under = footing(motion.world, motion.rotation, state.qpos[:3], spec.wheel_radius)
                return {"rotation": motion.rotation, "mass": mass, "inertia": inertia, "com": com,
                        "gravity": motion.world.gravity, "wheels": jnp.asarray(motion.world.wheel_inertia),
                        "compression": spec.wheel_radius - under.height}  # fmt: skip

            return jax.lax.scan(record, state, jnp.zeros((60, 10, 2)))[1]

        qpos, qvel, seen = jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(batch))
        build_model.cache_clear()
        seen["elastic"] = elastic(seen["compression"], params.body.mass)
    energy = mechanical_energy(model, qpos, qvel, seen)  # (variants, records)
    change = np.diff(energy, axis=1)
    assert (energy[:, 0] > 25).all() and np.isfinite(energy).all()
    curved = np.zeros(len(variants), bool)
    curved[[1 + PASSIVE.index("ramp"), 1 + PASSIVE.index("bump"), -1]] = True
    assert change[~curved].max() < 1e-3, change.max(1)
    assert change[curved].max() < 0.1, change.max(1)
    losing = [1 + PASSIVE.index(name) for name in ("rolling_resistance", "dry_friction")]
    assert (energy[losing, -1] < energy[losing, 0] - 5).all()


def mechanical_energy(model, qpos, qvel, seen):
    """Kinetic, potential and elastic energy [J] of each variant and record."""
    rate, spin = qvel[..., 3:6], qvel[..., 6:8]
    arm = np.einsum("...ij,...j->...i", seen["rotation"], seen["com"])
    speed = qvel[..., :3] + np.einsum("...ij,...j->...i", seen["rotation"], np.cross(rate, seen["com"]))
    mass = seen["mass"]
    spinning = model.wheels.armature * seen["wheels"] * (spin**2).sum(-1)
    kinetic = mass * (speed**2).sum(-1) + (seen["inertia"] * rate**2).sum(-1) + spinning
    potential = -mass * (seen["gravity"] * (qpos[..., :3] + arm)).sum(-1)
    return kinetic / 2 + potential + seen["elastic"].sum(-1)
