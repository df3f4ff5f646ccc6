"""The searched parameters: their coordinates, the valley that steps follow, what is searched, and its bounds."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.planted_logs import Schedule, fitted_plant, write_dataset
from sysid.errors.space import RATIO, Space, make_space, searched
from sysid.logs.log import load_log
from sysid.missing.catalogue import base_values, hypotheses, with_catalogue
from sysid.replay.differences import make_replay
from sysid.replay.models import measured_effects, with_effects
from whill_mjx.effects import EFFECTS
from whill_mjx.vehicle.parameters import describe, get_values, set_values
from whill_mjx.vehicle.presets import in_short, preset, preset_params
from whill_mjx.vehicle.specs import WARTHOG, WHILL_CR, find_spec, in_proportion
from whill_mjx.vehicle.vehicle_file import load_vehicle, save_vehicle


@pytest.mark.quick
def test_unit_coordinates_and_values_are_inverse():
    space = Space(("a", "b"), np.array([0.1, -2.0]), np.array([10.0, 2.0]), np.array([1.0, 0.0]),
                  np.array([True, False]))
    u = np.array([[0.0, 0.0], [0.3, 0.7], [1.0, 1.0]])
    np.testing.assert_allclose(space.to_unit(space.to_values(u)), u, atol=1e-12)
    inside = u[1]
    slope = (space.to_values(inside + 1e-6) - space.to_values(inside - 1e-6)) / 2e-6
    np.testing.assert_allclose(space.slope(inside), slope, rtol=1e-6)
    with pytest.raises(ValueError, match="outside"):
        dataclasses.replace(space, initial=np.array([20.0, 0.0]))
    with pytest.raises(ValueError, match="low must be below high"):
        dataclasses.replace(space, low=np.array([10.0, -2.0]))


def light_space():
    """Of a small robot, whose wheels are a large part of what its motors turn."""
    spec = in_proportion(WHILL_CR, "robot", 0.1, 0.4, 0.3, 20.0)
    params = preset_params(spec, "physical")
    params = with_effects(params, measured_effects(params, spec, ()))
    usual = {"wheel_inertia.ratio": 4.0, "torque_drive.kff": 0.02, "wheel_damping.damping": 0.05}
    params = set_values(params, tuple(usual), jnp.array(list(usual.values())))
    return spec, params, make_space(params, spec, searched(params))


def along_the_valley(space, u, step):
    """The step (1, P) with which, to first order, all that is told per inertia goes along with heavier wheels."""
    turned, values, slope = space.turned, space.to_values(u), space.slope(u)
    ratio = space.names.index(RATIO)
    wheel, heavier = (turned.wheel * one[ratio] for one in (values, slope * step))
    moves = np.zeros(space.size)
    moves[ratio] = step
    for name, (constant, share) in turned.besides.items():
        i = space.names.index(name)
        told = (values[i] + constant + share * wheel) / (turned.mass + wheel)
        moves[i] = (told - share) * heavier / slope[i]
    return moves[None]


@pytest.mark.quick
def test_a_step_along_the_valley_of_what_is_told_per_inertia_stays_on_its_floor():
    _, _, space = light_space()
    u = space.to_unit(space.initial)
    step = along_the_valley(space, u, 0.2)
    ends = space.to_values(u), space.to_values(space.moved(u[None], step)[0])
    before, after = (dict(zip(space.names, one, strict=True)) for one in ends)
    turned = space.turned
    inertia, later = (turned.mass + turned.wheel * one[RATIO] for one in (before, after))
    assert after[RATIO] > 2 * before[RATIO]
    for name, (constant, share) in turned.besides.items():
        told = [(one[name] + constant + share * turned.wheel * one[RATIO]) / size
                for one, size in ((before, inertia), (after, later))]
        assert told[1] == pytest.approx(told[0]), name
    other = np.array([name not in turned.besides for name in space.names])
    np.testing.assert_array_equal(space.moved(u[None], step)[0, other], (u + step[0])[other])
    # To first order a step is as it is, and where wheels keep their inertia altogether.
    random = np.random.default_rng(0).standard_normal((5, space.size))
    small = (space.moved(np.tile(u, (5, 1)), 1e-5 * random) - u) / 1e-5
    np.testing.assert_allclose(small, random, atol=1e-3)
    fixed = space.without(RATIO, "known")
    at = fixed.to_unit(fixed.initial)[None]
    np.testing.assert_array_equal(fixed.moved(at, np.full_like(at, 0.01)), at + 0.01)


@pytest.mark.long
def test_along_that_valley_a_vehicle_drives_nearly_alike(tmp_path):
    """The list of what is told per inertia is what the vehicle's equations say; a straight step leaves the valley."""
    spec, params, space = light_space()
    plant = fitted_plant(spec)
    log = load_log(write_dataset(tmp_path / "log", spec, params,
                                 Schedule(manoeuvres=("s_curve",), held_out=(), replicates=1), plant=plant))
    replay, _ = make_replay(plant, params, space, log.training)
    u = space.to_unit(space.initial)
    step = along_the_valley(space, u, 0.15)
    ends = np.clip(np.concatenate([u[None], space.moved(u[None], step), u + step]), 0.0, 1.0)
    drives = np.asarray(replay.simulate(space.to_values(ends)).odometry)[:, 0, :, 3:]  # v, omega
    bent, straight = (np.sqrt(np.square(drives[k] - drives[0]).mean()) for k in (1, 2))
    assert bent < 0.4 * straight


@pytest.mark.quick
def test_how_high_the_mass_lies_is_searched_where_wheels_skid_by_their_load():
    physical = with_effects(preset_params(WHILL_CR, "physical"), ("lateral_damping",))
    assert {"body.com_z", "lateral_damping.c_front"} <= set(searched(physical))
    assert "lateral_damping.c_rear" not in searched(physical)
    assert "lateral_damping.c_rear" in searched(physical, ("lateral_damping",))
    paper = searched(preset_params(WHILL_CR, "paper"))
    assert "body.com_z" not in paper and "lateral_damping.c_rear" in paper


@pytest.mark.quick
@pytest.mark.parametrize("name", ["whill_cr", "husky", "warthog", "create"])
def test_the_mass_lies_above_the_floor_and_below_where_the_vehicle_would_tip(name):
    """Bounds in metres for all vehicles would let that of a small robot lie under the floor."""
    spec = find_spec(name)
    space = make_space(preset_params(spec, "physical"), spec, ["body.com_z"])
    assert spec.wheel_radius + space.low[0] == pytest.approx(0.0)
    tips_at = 9.81 * spec.track / 2 / (spec.wheel_radius + space.high[0])  # m/s2, sideways
    assert tips_at == pytest.approx(9.81 / 3)


@pytest.mark.quick
def test_a_fit_gives_a_differential_drive_with_slip_losses_that_rise_with_speed():
    physical = preset_params(WHILL_CR, "physical")
    added = measured_effects(physical, WHILL_CR, ())
    assert {"suspension", "wheel_damping", "wheel_inertia"} <= set(added)
    assert set(added) - set(measured_effects(physical, WHILL_CR, (), losses=False)) == {"wheel_damping"}
    assert measured_effects(preset_params(WARTHOG, "physical"), WARTHOG, ()) == ("suspension",)
    assert measured_effects(preset_params(WHILL_CR, "paper"), WHILL_CR, ()) == ()


@pytest.mark.quick
@pytest.mark.parametrize("like", ["whill_cr", "husky", "warthog", "create"])
@pytest.mark.parametrize("kind", ["paper", "physical"])
@pytest.mark.parametrize(("mass", "radius", "track", "wheelbase"), [
    (0.1, 0.01, 0.05, 0.04), (0.15, 0.02, 0.08, 0.06), (3.0, 0.03, 0.2, 0.2), (52.0, 0.1325, 0.496, 0.6),
    (900.0, 0.3, 1.2, 1.5), (3000.0, 0.6, 2.0, 2.5), (5000.0, 1.0, 3.0, 6.0)])  # fmt: skip
def test_what_a_fit_may_find_of_a_vehicle_can_be_read_again(tmp_path, like, kind, mass, radius, track, wheelbase):
    spec = in_proportion(find_spec(like), "vehicle", radius, track, wheelbase, mass)
    params = in_short(spec, kind)
    have = {effect.name for effect in params.effects}
    params = with_effects(params, [name for name in EFFECTS if name not in have])
    names = list(describe(params))
    names = [name for name, value in zip(names, get_values(params, names), strict=True) if np.isfinite(value)]
    space = make_space(params, spec, names)
    for name, values in (("start", space.initial), ("low", space.low), ("high", space.high)):
        written = set_values(params, space.names, jnp.asarray(values))
        read = load_vehicle(save_vehicle(tmp_path / f"{name}.toml", spec, written))[1]
        np.testing.assert_array_equal(get_values(read, space.names), get_values(written, space.names))


@pytest.mark.quick
def test_forces_and_sizes_that_are_looked_for_follow_the_vehicle():
    """A vehicle of an eighth of the chair's lengths: 1/512 of its mass."""
    small = in_proportion(WHILL_CR, "small", 0.1325 / 8, 0.496 / 8, 0.6 / 8, 52.0 / 512)
    names = ["torque_saturation.limit", "side_force.sideways", "supply_sag.per_watt", "rolling_resistance.mu_r"]
    found, hypothesis = {}, {}
    for spec in (WHILL_CR, small):
        params = preset_params(spec, "physical")
        hypothesis[spec.name] = {one.key: one for one in hypotheses(spec, params)}
        params = with_effects(params, ["torque_saturation", "side_force", "supply_sag"])
        params = set_values(params, ["torque_saturation.limit"], jnp.asarray([spec.mass]))
        space = make_space(params, spec, names)
        found[spec.name] = np.stack([space.low, space.high])
    np.testing.assert_array_equal(found["whill_cr"], [[5.0, -300.0, 0.0, 0.0], [3000.0, 300.0, 0.02, 0.08]])
    np.testing.assert_allclose(found["small"], found["whill_cr"] * [1 / 512, 1 / 512, 512, 1], rtol=1e-9)
    chair, other = hypothesis.values()
    assert chair["supply_sag/power"].axes[0].unit == 0.0006
    assert dict(chair["payload_shift"].constants) == {"payload_shift.z": 0.3}
    assert other["supply_sag/power"].axes[0].unit == pytest.approx(0.0006 * 512)
    assert dict(other["payload_shift"].constants)["payload_shift.z"] == pytest.approx(0.3 / 8)


@pytest.mark.quick
@pytest.mark.parametrize("size", [1 / 8, 1.0, 4.0])
def test_lengths_on_the_vehicle_follow_its_size(size):
    """Trail of a caster and places of a load, in a fit and in the closed loop."""
    spec = in_proportion(WHILL_CR, "like_the_chair", 0.1325 * size, 0.496 * size, 0.6 * size, 52.0 * size**3)
    params = preset_params(spec, "physical")
    found = hypotheses(spec, params)
    full = with_catalogue(params, found)
    assert get_values(full, ["caster_kick.trail"])[0] == pytest.approx(0.15 * size)
    load = next(one for one in found if one.key == "payload_shift")
    farthest = load.values(np.array([0.01, 12.0, -12.0]), base_values(full))
    assert farthest["payload_shift.x"] == pytest.approx(0.6 * size)
    assert farthest["payload_shift.y"] == pytest.approx(-0.6 * size)
    names = ["caster_kick.trail", "payload_shift.x", "payload_shift.y", "payload_shift.z"]
    space = make_space(full, spec, names)
    np.testing.assert_allclose(space.low, np.array([0.03, -0.6, -0.4, -0.2]) * size, rtol=1e-5)
    np.testing.assert_allclose(space.high, np.array([0.5, 0.6, 0.4, 1.0]) * size, rtol=1e-5)


@pytest.mark.quick
def test_a_base_model_with_a_caster_keeps_its_trail():
    spec, params = preset("whill_cr_castored")
    params = set_values(params, ["caster_kick.trail"], jnp.array([0.4]))
    assert get_values(with_catalogue(params, hypotheses(spec, params)), ["caster_kick.trail"])[0] == pytest.approx(0.4)


@pytest.mark.quick
@pytest.mark.parametrize(("name", "value"), [
    ("torque_drive.kp", -1e9), ("torque_drive.kp", 1e9), ("torque_drive.kp", float("inf")),
    ("torque_drive.kp", -1.0), ("torque_drive.ki", -1e-3), ("torque_drive.ki", float("nan")),
    ("torque_drive.limit", -1.0), ("torque_drive.limit", 1e12), ("yaw_scrub.torque", 1e9),
    ("body.yaw_inertia", 0.0), ("body.yaw_inertia", 1e9), ("body.com_x", -265.0)])  # fmt: skip
def test_a_value_that_no_vehicle_has_is_refused(tmp_path, name, value):
    spec = find_spec("whill_cr")
    written = set_values(preset_params(spec, "physical"), [name], jnp.asarray([value]))
    with pytest.raises(ValueError, match=f"{name} is .*it must"):
        load_vehicle(save_vehicle(tmp_path / "vehicle.toml", spec, written))
