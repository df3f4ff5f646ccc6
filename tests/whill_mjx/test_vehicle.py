"""Motion of one vehicle: known answers, invariants, and C MuJoCo as an independent reference."""

from __future__ import annotations

import dataclasses
from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from sysid.replay.models import with_effects
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.dynamics import drive, forces, measure, nominal_world, place, substep
from whill_mjx.vehicle.kinematics import body_twist, reference_pose, rotation_from_quaternion
from whill_mjx.vehicle.model import box_inertia, build_model, mujoco_model
from whill_mjx.vehicle.parameters import describe, get_values, set_values
from whill_mjx.vehicle.presets import preset, preset_params
from whill_mjx.vehicle.specs import SPECS, WARTHOG, WHILL_CR, VehicleSpec, find_spec

VEHICLES = ["whill_cr_ramp", "whill_cr_physical"]
CHAIRS = ["whill_cr_paper", "whill_cr_ramp", "whill_cr_physical", "whill_cr_documented", "whill_cr_castored"]


@lru_cache
def compiled_period(name):
    """Static model, parameters and one compiled control period of a preset; compiled once for all tests."""
    spec, params = preset_params_of(name)
    model = build_model(spec)
    return model, params, jax.jit(lambda params, state, command: drive(model, params, state, command))


def preset_params_of(name):
    if name == "warthog_physical":
        return WARTHOG, preset_params(WARTHOG, "physical")
    return preset(name)


def drive_periods(name, command, periods=20, start=(0.0, 0.0, 0.0)):
    """State after `periods` control periods of one command (v, omega)."""
    model, params, period = compiled_period(name)
    state = place(model, params, *start)
    for _ in range(periods):
        state = period(params, state, jnp.asarray(command))
    return model, state


@pytest.mark.quick
def test_a_vehicle_at_rest_stays_where_it_is_placed():
    model, state = drive_periods("whill_cr_physical", (0.0, 0.0), start=(1.0, -2.0, 0.7))
    np.testing.assert_allclose(reference_pose(model, state.qpos), (1.0, -2.0, 0.7), atol=1e-3)
    np.testing.assert_allclose(state.qvel, 0.0, atol=1e-3)
    assert not state.diverged


@pytest.mark.parametrize("name", VEHICLES)
def test_straight_command_drives_straight_and_odometry_agrees(name):
    model, state = drive_periods(name, (0.5, 0.0), 40)
    x, y, yaw = reference_pose(model, state.qpos)
    v, omega = body_twist(model, state.qpos, state.qvel)
    assert abs(v - 0.5) < 0.02 and abs(omega) < 0.02
    assert 1.7 < x < 2.0 and abs(y) < 0.05
    np.testing.assert_allclose(state.odometry.x, x, atol=0.03)


@pytest.mark.parametrize("name", VEHICLES)
def test_turn_on_the_spot_keeps_the_driven_axle_in_place(name):
    model, state = drive_periods(name, (0.0, 0.8))
    x, y, yaw = reference_pose(model, state.qpos)
    assert np.hypot(x, y) < 0.05
    assert 0.9 < yaw < 1.7


@pytest.mark.parametrize("name", ["whill_cr_physical", "warthog_physical"])
def test_left_and_right_turns_are_mirror_images(name):
    model, left = drive_periods(name, (0.4, 0.6))
    _, right = drive_periods(name, (0.4, -0.6))
    np.testing.assert_allclose(
        np.array(reference_pose(model, left.qpos)) * [1, -1, -1], reference_pose(model, right.qpos), atol=2e-4
    )


def test_motion_does_not_depend_on_the_place_and_heading_in_the_world():
    model, here = drive_periods("whill_cr_physical", (0.5, 0.4))
    _, there = drive_periods("whill_cr_physical", (0.5, 0.4), start=(3.0, 1.0, 1.0))
    x, y, yaw = (float(value) for value in reference_pose(model, here.qpos))
    expected = (3 + x * np.cos(1) - y * np.sin(1), 1 + x * np.sin(1) + y * np.cos(1), 1 + yaw)
    np.testing.assert_allclose(reference_pose(model, there.qpos), expected, atol=1e-3)


@pytest.mark.quick
def test_as_many_values_as_names_are_set():
    _, params = preset("whill_cr")
    with pytest.raises(ValueError, match="1 names of parameters and 2 values"):
        set_values(params, ["body.mass"], jnp.array([1.0, 2.0]))



def test_slip_separates_odometry_from_the_body():
    """A skid-steered vehicle on soft ground turns less than its wheels say."""
    model, params, period = compiled_period("warthog_physical")
    soft = set_values(params, ["slip_traction.slip_speed"], jnp.array([0.05]))
    state = place(model, soft, 0.0, 0.0, 0.0)
    for _ in range(20):
        state = period(soft, state, jnp.array([0.5, 1.0]))
    _, _, yaw = reference_pose(model, state.qpos)
    assert 0 < yaw < 0.8 * state.odometry.yaw


@pytest.mark.parametrize("kind", ["paper", "physical"])
@pytest.mark.parametrize("name", [*SPECS, *CHAIRS])
def test_static_axle_loads_stay_positive_up_to_the_documented_acceleration(name, kind):
    """Load transfer at 1.7 m/s^2 forward and backward leaves load on both axles, for every preset and base model."""
    spec, params = preset(name)
    if name in SPECS:
        params = preset_params(spec, kind)
    height = spec.wheel_radius + float(params.body.com_z)
    rear_arm = float(params.body.com_x) - spec.rear_x
    front_arm = spec.front_x - float(params.body.com_x)
    transfer = 1.7 * height / 9.81  # shift of the load's point of action [m]
    assert rear_arm - transfer > 0 and front_arm - transfer > 0


def test_a_centre_of_mass_behind_the_driven_axle_would_tip_the_chair():
    """So the paper's com_x of -0.265 m is from mid-length and not from the rear axle, which lies at -0.36 m."""
    spec, params = preset("whill_cr_paper")
    assert spec.rear_x < -0.2654 < 0 and spec.rear_x == spec.reference_x
    behind = params.replace(body=params.body.replace(com_x=params.body.com_x + spec.rear_x))
    model, _, period = compiled_period("whill_cr_paper")
    pitches = []
    for vehicle in (params, behind):
        state = place(model, vehicle, 0.0, 0.0, 0.0)
        for _ in range(6):
            state = period(vehicle, state, jnp.zeros(2))
        pitches.append(float(rotation_from_quaternion(state.qpos[3:7])[2, 0]))  # sine of the nose-up angle
    assert abs(pitches[0]) < 0.02 and pitches[1] > 0.3


def test_suspension_carries_the_weight_and_shifts_it_towards_the_centre_of_mass():
    spec, params = preset("whill_cr_paper")
    model = build_model(spec)
    state = jax.jit(lambda: place(model, params, 0.0, 0.0, 0.0))()
    motion = measure(model, params, nominal_world(model), state)
    load = np.asarray(motion.normal_force)
    np.testing.assert_allclose(load.sum(), float(params.body.mass) * 9.81, rtol=0.02)
    share_rear = (spec.front_x - float(params.body.com_x)) / spec.wheelbase
    np.testing.assert_allclose(load[:2].sum() / load.sum(), share_rear, atol=0.02)
    assert load[0] > load[1]  # centre of mass to the left


@pytest.mark.long
def test_physics_steps_of_any_length_carry_springs_of_any_stiffness():
    """Springs of 0.3 mm swing at 181 1/s, those of 20 um at 700: with loads of the start of the step, steps of 20 ms
    would let wheels hop, and the chair slide past its stop."""
    spec, params = preset("whill_cr_physical")
    params = with_effects(params, ("suspension",))

    def driven(dt, sag):
        model = build_model(spec, VehicleConfig(physics_dt=dt, control_dt=0.2))
        period = jax.jit(lambda vehicle, state, command: drive(model, vehicle, state, command))
        vehicle = set_values(params, ["suspension.sag"], jnp.array([sag]))
        state = place(model, vehicle, 0.0, 0.0, 0.0)
        for command in ((0.9, 0.0), (0.9, 0.8), (0.0, 0.0)):
            for _ in range(5):
                state = period(vehicle, state, jnp.array(command))
        return np.asarray(reference_pose(model, state.qpos))

    for sag in (0.0003, 0.00002):
        fine = driven(0.0025, sag)
        for dt, atol in ((0.005, 1e-3), (0.01, 2e-3), (0.02, 5e-3), (0.04, 0.03)):
            np.testing.assert_allclose(driven(dt, sag), fine, atol=atol)
    assert np.abs(driven(0.02, 0.0003) - driven(0.02, 0.0032)).max() > 1e-4  # they are not the same


def test_stiff_springs_shift_the_load_at_once_by_what_the_pull_asks_for():
    """m a h / L of the load, with h of the centre of mass above the ground, in the first step of a full pull."""
    spec, params = preset("whill_cr_physical")
    params = with_effects(params, ("suspension",))
    params = set_values(params, ["suspension.sag", "body.com_z", "command_delay.delay"], jnp.array([2e-5, 0.1, 0.0]))
    model = build_model(spec)
    state = place(model, params, 0.0, 0.0, 0.0)
    pull = jax.jit(lambda command: forces(model, params, state, command))
    (_, _, rest), (_, force, pulled) = pull(jnp.zeros(2)), pull(jnp.array([1.0, 0.0]))
    height, mass = spec.wheel_radius + 0.1, float(params.body.mass)
    expected = float(force[0]) * height / spec.wheelbase
    shifted = float((pulled.normal_force - rest.normal_force)[:2].sum())
    assert 100.0 < float(force[0]) < 0.8 * mass * 9.81
    np.testing.assert_allclose(shifted, expected, rtol=0.15)
    np.testing.assert_allclose(float(pulled.normal_force.sum()), mass * 9.81, rtol=0.03)


def test_bearings_stop_a_wheel_that_nothing_else_holds():
    """J s' = -d s on a floor without friction: exp(-d t / J)."""
    spec, params = preset("whill_cr_physical")
    params = with_effects(params, ("wheel_damping", "suspension"))
    names = ["slip_traction.mu", "torque_drive.kp", "torque_drive.ki", "wheel_damping.damping"]
    params = set_values(params, names, jnp.array([0.0, 0.0, 0.0, 0.05]))
    model = build_model(spec)
    state = place(model, params, 0.0, 0.0, 0.0)
    state = state.replace(qvel=state.qvel.at[6:8].set(4.0))
    period = jax.jit(lambda state: drive(model, params, state, jnp.zeros(2)))
    for _ in range(20):
        state = period(state)
    decay = np.exp(-0.05 / spec.wheel_inertia * 20 * model.config.control_dt)
    np.testing.assert_allclose(state.qvel[6:8], 4.0 * decay, atol=0.02)


@pytest.mark.parametrize("dynamics", ["fused", "mjx"])
def test_a_heavy_wheel_takes_longer_to_spin_up_where_nothing_grips(dynamics):
    """T / J: on a floor without friction the chassis' mass does not count."""
    spec, params = preset("whill_cr_physical")
    params = with_effects(params, ("wheel_inertia",))
    names = ["slip_traction.mu", "torque_drive.kp", "torque_drive.ki", "torque_drive.limit", "command_delay.delay"]
    params = set_values(params, names, jnp.array([1e-6, 200.0, 0.0, 1.5, 0.0]))
    model = build_model(spec, VehicleConfig(physics_dt=0.005, control_dt=0.05, dynamics=dynamics))
    period = jax.jit(lambda vehicle: drive(model, vehicle, place(model, vehicle, 0.0, 0.0, 0.0), jnp.array([0.9, 0.0])))
    for ratio in (1.0, 2.5):
        spin = period(set_values(params, ["wheel_inertia.ratio"], jnp.array([ratio]))).qvel[6:8]
        np.testing.assert_allclose(spin, 0.05 * 1.5 / (ratio * spec.wheel_inertia), rtol=0.01)


@lru_cache
def in_the_air(dynamics):
    """A chair with wheels of twice their inertia 5 m above the floor, its drive, and one compiled control period."""
    spec, params = preset("whill_cr_physical")
    params = with_effects(params, ("suspension", "wheel_inertia"))
    params = set_values(params, ["wheel_inertia.ratio"], jnp.array([2.0]))
    model = build_model(spec, VehicleConfig(dynamics=dynamics))
    state = place(model, params, 0.0, 0.0, 0.0)
    state = dataclasses.replace(state, qpos=state.qpos.at[2].add(5.0))
    return spec, params, jax.jit(lambda vehicle: drive(model, vehicle, state, jnp.array([1.0, 0.0])))


@pytest.mark.parametrize("dynamics", ["fused", "mjx"])
@pytest.mark.parametrize("reaction", [0.0, 0.4, 1.0])
def test_a_chair_in_the_air_turns_against_what_its_wheels_are_spun_up_by(reaction, dynamics):
    """Its angular momentum stays 0: what the wheels themselves carry of it the chassis has with the opposite sign."""
    spec, params, period = in_the_air(dynamics)
    state = period(set_values(params, ["wheel_inertia.reaction"], jnp.array([reaction])))
    wheels = reaction * 2.0 * spec.wheel_inertia * float(state.qvel[6:8].sum())
    assert float(state.qvel[6]) > 5.0
    np.testing.assert_allclose(float(state.qvel[4]) * box_inertia(spec)[1], -wheels, atol=1e-4)


def test_a_damped_chair_stops_nodding_sooner():
    spec, params = preset("whill_cr_physical")
    params = with_effects(params, ("suspension",))
    model = build_model(spec, VehicleConfig(physics_dt=0.0025, control_dt=0.02))
    period = jax.jit(lambda vehicle, state: drive(model, vehicle, state, jnp.zeros(2)))

    def swings(damping):
        vehicle = set_values(params, ["suspension.sag", "suspension.damping"], jnp.array([0.01, damping]))
        rest = place(model, vehicle, 0.0, 0.0, 0.0)
        state, heights = dataclasses.replace(rest, qpos=rest.qpos.at[2].add(0.005)), []  # let go 5 mm above its rest
        for _ in range(20):
            state = period(vehicle, state)
            heights.append(float(state.qpos[2] - rest.qpos[2]))
        return -min(heights)  # how far it swings through

    assert swings(0.1) > 0.0025 > swings(0.4) > 2e-4 > swings(0.95)


def test_vmapped_instances_equal_a_loop_with_different_parameters():
    model, params, alone = compiled_period("whill_cr_physical")
    scales = jnp.array([0.8, 1.0, 1.2])
    batch = jax.tree.map(lambda leaf: leaf * scales, params)
    command = jnp.array([0.6, -0.5])
    placed = jax.vmap(lambda params: place(model, params, 0.0, 0.0, 0.0))(batch)
    together = jax.jit(jax.vmap(lambda params, state: drive(model, params, state, command)))(batch, placed)
    for index, scale in enumerate(scales):
        one = jax.tree.map(lambda leaf, scale=scale: leaf * scale, params)
        expected = alone(one, place(model, one, 0.0, 0.0, 0.0), command)
        np.testing.assert_allclose(together.qpos[index], expected.qpos, atol=1e-5)


def test_mjx_follows_c_mujoco_under_the_same_forces_for_ten_seconds():
    """The same force law, fed from C MuJoCo's own state: positions agree within 1e-4 m.

    Its speeds are those of mj_step, its positions those of mj_integratePos with the mean speed of a step.

    Recorded forces cannot be replayed blindly: without the suspension's feedback a tilted chassis falls over.
    """
    spec, params = preset("whill_cr_physical")
    params = params.replace(body=params.body.replace(com_x=jnp.array(-0.1), com_z=jnp.array(0.1)))
    model = build_model(spec)
    times = np.arange(2000) * model.config.physics_dt
    commands = np.stack([0.6 * np.sin(0.7 * times) + 0.3, 0.8 * np.sin(1.1 * times)], axis=1).astype(np.float32)

    @jax.jit
    def roll(commands):
        def one(state, command):
            state = substep(model, params, state, command)
            return state, state.qpos

        return jax.lax.scan(one, place(model, params, 0.0, 0.0, 0.0), commands)[1]

    @jax.jit
    def force_at(state, qpos, qvel, command):
        state = state.replace(qpos=qpos, qvel=qvel)
        memory, force, _ = forces(model, params, state, command)
        return state.replace(memory=memory), force

    expected = np.asarray(roll(jnp.asarray(commands)))
    reference = mujoco_model(spec, body=params.body)
    data = mujoco.MjData(reference)
    state = place(model, params, 0.0, 0.0, 0.0)
    data.qpos[:] = np.asarray(state.qpos)
    distance = []
    for command, qpos in zip(commands, expected, strict=True):
        state, force = force_at(state, data.qpos.astype(np.float32), data.qvel.astype(np.float32), command)
        data.qfrc_applied[:] = np.asarray(force)
        before, speed = data.qpos.copy(), data.qvel.copy()
        mujoco.mj_step(reference, data)
        mujoco.mj_integratePos(reference, before, (speed + data.qvel) / 2, model.config.physics_dt)
        data.qpos[:] = before  # moved with the mean speed
        distance.append(np.abs(data.qpos[:3] - qpos[:3]).max())
    assert np.abs(expected[-1, :2]).max() > 1.0  # it went somewhere
    assert max(distance) < 1e-4


@pytest.mark.parametrize("name", ["whill_cr_ramp", "whill_cr_physical"])
def test_forward_mode_derivatives_agree_with_central_differences(name):
    """d(pose after 2 s)/d(parameter) within 1 % for each parameter, in float64."""
    with jax.enable_x64(True):
        spec, params = preset(name)
        build_model.cache_clear()
        model = build_model(spec)
        names = list(describe(params))
        values = np.array(get_values(params, names), dtype=np.float64)
        if "command_delay.delay" in names:  # a delay of whole steps is a kink: differentiate beside it
            values[names.index("command_delay.delay")] += 0.4 * model.config.physics_dt
        commands = jnp.asarray(np.repeat([[0.8, 0.5], [0.5, -0.7], [-0.3, 0.2]], 7, axis=0), jnp.float64)

        def outcome(values):
            changed = set_values(params, names, values)
            state = place(model, changed, 0.0, 0.0, 0.0)
            state = jax.lax.scan(lambda s, c: (drive(model, changed, s, c), None), state, commands)[0]
            odometry = state.odometry
            pose = reference_pose(model, state.qpos)
            return jnp.stack([*pose, odometry.x, odometry.y, odometry.yaw, odometry.v, odometry.omega])

        forward = np.asarray(jax.jit(jax.jacfwd(outcome))(jnp.asarray(values)))
        steps = 1e-6 * np.maximum(np.abs(values), 1e-2)
        points = np.concatenate([values + np.diag(steps), values - np.diag(steps)])
        results = np.asarray(jax.jit(jax.vmap(outcome))(jnp.asarray(points)))
        central = (results[: len(values)] - results[len(values) :]) / (2 * steps[:, None])
        build_model.cache_clear()
    for index, parameter in enumerate(names):
        scale = np.abs(central[index]).max()
        error = np.abs(forward[:, index] - central[index]).max()
        assert error <= 0.01 * scale + 1e-7, f"{parameter}: {forward[:, index]} against {central[index]}"


def test_a_state_that_is_not_finite_is_flagged_and_contained():
    model, params, period = compiled_period("whill_cr_physical")
    state = place(model, params, 0.0, 0.0, 0.0)
    broken = period(params, state, jnp.array([jnp.nan, 0.0]))
    assert broken.diverged
    assert np.isfinite(np.asarray(broken.qpos)).all()
    assert not period(params, state, jnp.array([0.1, 0.0])).diverged


@lru_cache
def slow_period():
    """A chair whose limits are lower than the makers', at rest, and one compiled control period of it."""
    spec, params = preset("whill_cr_physical")
    model = build_model(dataclasses.replace(spec, v_min=-0.2, v_max=0.4, omega_max=0.6))
    return place(model, params, 0.0, 0.0, 0.0), jax.jit(lambda state, command: drive(model, params, state, command))


@pytest.mark.parametrize("command", [(3.0, 0.0), (-3.0, 0.0), (0.0, 4.0), (0.0, -4.0)])
def test_a_vehicle_cuts_commands_to_its_limits(command):
    rest, period = slow_period()
    cut = np.clip(command, (-0.2, -0.6), (0.4, 0.6))
    asked = limited = rest
    for _ in range(3):
        asked, limited = period(asked, jnp.asarray(command)), period(limited, jnp.asarray(cut))
    np.testing.assert_array_equal(asked.qpos, limited.qpos)
    assert not asked.diverged


def test_commands_within_the_limits_and_their_derivatives_are_left_as_they_are():
    model, params, _ = compiled_period("whill_cr_paper")  # no delay
    state = place(model, params, 0.0, 0.0, 0.0)

    def speed(model, command):
        return substep(model, params, state, command).qvel[:6].sum()

    free = build_model(model.spec, VehicleConfig(limited=False))
    for command in ((1.0, -1.0), (-1.0, 1.0), (0.3, 0.2)):  # the first two at the limits themselves
        kept, plain = (jax.jacfwd(partial(speed, one))(jnp.asarray(command)) for one in (model, free))
        np.testing.assert_array_equal(kept, plain)
        assert np.abs(plain).max() > 0


@pytest.mark.quick
def test_the_documented_chair_has_the_makers_limits_and_others_those_of_the_papers_course():
    documented, paper = (preset(name)[0] for name in ("whill_cr_documented", "whill_cr_ramp"))
    assert (documented.v_min, documented.v_max, documented.omega_max) == (-0.556, 1.667, 1.68)
    assert (paper.v_min, paper.v_max, paper.omega_max) == (-1.0, 1.0, 1.0)


@pytest.mark.quick
def test_unknown_vehicle_names_the_known_ones():
    with pytest.raises(ValueError, match="unknown vehicle 'tricycle'.*whill_cr"):
        find_spec("tricycle")


@pytest.mark.quick
@pytest.mark.parametrize(("field", "value"), [
    ("mass", -1.0), ("track", 0.0), ("wheel_radius", float("nan")), ("track", True), ("v_max", float("inf")),
    ("body_length", "x"), ("omega_max", -1.0)])
def test_a_spec_refuses_what_is_not_physical(field, value):
    with pytest.raises(ValueError, match=f"{field} is .*must be positive"):
        dataclasses.replace(WHILL_CR, **{field: value})


@pytest.mark.quick
@pytest.mark.parametrize(("field", "value"), [("physics_dt", float("nan")), ("physics_dt", 0.0), ("control_dt", -0.1)])
def test_time_steps_are_positive_numbers(field, value):
    with pytest.raises(ValueError, match=f"{field} is .*must be positive"):
        VehicleConfig(**{field: value})


@pytest.mark.quick
def test_a_spec_refuses_an_unknown_drive():
    with pytest.raises(ValueError, match="use 'differential' or 'skid'"):
        VehicleSpec(name="x", wheel_radius=0.1, track=0.5, wheelbase=0.5, mass=10.0, drive="omni")
