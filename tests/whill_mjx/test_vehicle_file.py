"""The vehicle file: what is saved is loaded, and what is wrong is named."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sysid.replay.models import with_effects
from whill_mjx.effects import EFFECTS, make_effect
from whill_mjx.vehicle.dynamics import place, substep
from whill_mjx.vehicle.kinematics import camera_pose
from whill_mjx.vehicle.model import build_model
from whill_mjx.vehicle.parameters import set_values
from whill_mjx.vehicle.presets import preset, preset_params
from whill_mjx.vehicle.specs import HUSKY, SPECS, CameraMount
from whill_mjx.vehicle.types import VehicleParams, parameters_of
from whill_mjx.vehicle.vehicle_file import load_intervals, load_vehicle, save_vehicle

pytestmark = pytest.mark.quick


@pytest.fixture
def saved(tmp_path):
    spec, params = preset("whill_cr_ramp")
    return save_vehicle(tmp_path / "vehicle.toml", spec, params, {"body.mass": (50.0, 55.0)}, {"fit": "none"})


@pytest.mark.parametrize("name", ["whill_cr", "whill_cr_physical", "warthog"])
def test_a_saved_vehicle_loads_to_the_last_bit(tmp_path, name):
    spec, params = preset(name)
    path = save_vehicle(tmp_path / "vehicle.toml", spec, params)
    loaded_spec, loaded, _ = load_vehicle(path)
    assert loaded_spec == spec
    assert [effect.name for effect in loaded.effects] == [effect.name for effect in params.effects]
    assert jax.tree.all(jax.tree.map(lambda a, b: a == b, params, loaded))


def test_intervals_and_provenance_are_kept(saved):
    assert load_intervals(saved) == {"body.mass": (50.0, 55.0)}
    assert load_vehicle(saved)[2] == {"fit": "none"}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("schema = 1", "schema = 7", "schema is 7; this version reads schema 1. A newer version wrote the file"),
        ("schema = 1\n", "", "has no schema, .*Add schema = 1"),
        ('kind = "micromobility-vehicle"', 'kind = "car"', "kind is 'car'.*Give a vehicle file"),
        ('name = "pid_drive"', 'name = "warp_drive"', "unknown effect 'warp_drive' .*known: .*pid_drive"),
        ('unit = "kg"', 'unit = "lb"', "body.mass is in 'lb'; it must be in 'kg'"),
        ("value = 52.0", "value = nan", "body.mass is nan; it must be a number"),
        ("value = 52.0", "value = -52.0", "must be positive"),
        ("wheel_radius = 0.1325", "wheel_radius = -1.0", "wheel_radius is -1.0; it must be positive"),
        ("wheel_radius = 0.1325", "wheel_size = 0.1325", "Remove the entry"),
        ("schema = 1", "schema 1", "not a TOML file: .*at line 1, .*Correct the line"),
        ("schema = 1", "schema = true", "schema is True"),
        ("track = 0.496", "track = true", "spec.track is True; it must be a number"),
        ("body_length = 0.985", 'body_length = "x"', "spec.body_length is 'x'; it must be a number"),
        ("v_max = 1.0", "v_max = nan", "spec.v_max is nan; it must be a number"),
        ("omega_max = 1.0", "omega_max = -1.0", "spec.omega_max is -1.0; it must be positive"),
        ("fov_y = 1.2", "fov_y = 3.2", "spec.camera.fov_y is 3.2; it must be positive, from 0.01 to 3.1 rad"),
        ("pitch = 0.15", "tilt = 0.15", "spec.camera has unknown field 'tilt'.*Remove the entry"),
        ("track = 0.496\n", "", r"spec has no field 'track' \[m\]. Add it"),
        ("value = 52.0", "value = inf", "body.mass is inf; it must be positive, from 0.01 to 10000 kg"),
        ("value = 52.0", "value = 1" + "0" * 400, "body.mass is an integer of about 398 digits"),
        ("value = 27.7", "value = -1e9 # ", "pid_drive.kp is -1000000000.0; it must be positive|must lie within 0"),
        ('name = "forward_slip"', 'name = "pid_drive"', "pid_drive"),
        ("interval = [50.0, 55.0]", "interval = [55.0, 50.0]", "the lower end comes first"),
        ("interval = [50.0, 55.0]", "interval = [nan, 50.0]", r"body.mass.interval\[0\] is nan; it must be a number"),
    ],
)
def test_a_bad_file_is_refused_with_its_name_and_the_rule(saved, old, new, message):
    text = saved.read_text()
    assert old in text
    saved.write_text(text.replace(old, new, 1))
    with pytest.raises(ValueError, match=message) as caught:
        load_vehicle(saved)
        load_intervals(saved)
    assert str(caught.value).startswith(f"{saved}: ")


def test_an_effect_that_is_there_twice_is_refused(saved):
    text = saved.read_text()
    first, end = text.index('[[effects]]\nname = "forward_slip"'), text.index('[[effects]]\nname = "rolling_contact"')
    saved.write_text(text[:end] + text[first:end] + text[end:])
    with pytest.raises(ValueError, match="effect 'forward_slip' is there twice.*Remove one of them"):
        load_vehicle(saved)


@pytest.mark.parametrize("name", ["whill_cr", "whill_cr_ramp", "whill_cr_paper", "whill_cr_physical",
                                  "whill_cr_documented", "whill_cr_castored", "husky", "warthog", "create"])
def test_every_effect_at_its_neutral_and_usual_values_may_be_in_a_file(tmp_path, name):
    spec, params = preset(name)
    have = {effect.name for effect in params.effects}
    for choose in (lambda about, usual: about.neutral, lambda about, usual: usual[0], lambda about, usual: usual[1],
                   lambda about, usual: about.low, lambda about, usual: about.high):
        more = []
        for other in EFFECTS.values():
            if other.name not in have:
                values = {key: choose(about, other.typical.get(key, (about.neutral, about.neutral)))
                          for key, about in parameters_of(other).items()}
                more.append(make_effect(other.name, **values))
        path = save_vehicle(tmp_path / "vehicle.toml", spec, VehicleParams(params.body, (*params.effects, *more)))
        assert len(load_vehicle(path)[1].effects) == len(EFFECTS)


def test_a_file_from_before_a_parameter_was_added_has_it_neutral(tmp_path):
    spec, params = preset("whill_cr_physical")
    more = ("suspension", "sensor_delay", "rolling_resistance_speed")
    path = save_vehicle(tmp_path / "vehicle.toml", spec, with_effects(params, more))
    text = path.read_text()
    for name in ("damping", "speed", "growth"):
        first = text.index(f"[effects.parameters.{name}]")
        text = text[:first] + text[first:].partition("\n\n")[2]
    assert "parameters.damping" not in text and "parameters.sag" in text and "parameters.delay" in text
    path.write_text(text)
    effects = {effect.name: effect for effect in load_vehicle(path)[1].effects}
    assert float(effects["suspension"].damping) == 0.5 and float(effects["sensor_delay"].speed) == 0.0
    assert float(effects["rolling_resistance_speed"].growth) == 0.0
    path.write_text(text.replace("[effects.parameters.sag]", "[effects.parameters.damping]"))
    with pytest.raises(ValueError, match="suspension"):
        load_vehicle(path)


def test_a_built_in_vehicle_is_loaded_by_its_name_and_named_as_its_origin():
    spec, params, provenance = load_vehicle("whill_cr_ramp")
    assert (spec, provenance) == (preset("whill_cr_ramp")[0], {"preset": "whill_cr_ramp"})
    assert [effect.name for effect in params.effects] == [effect.name for effect in preset("whill_cr_ramp")[1].effects]


def test_a_file_of_any_ending_is_read_as_a_vehicle_file(saved):
    assert load_vehicle(saved.rename(saved.with_suffix("")))[2] == {"fit": "none"}


def test_a_name_that_is_neither_lists_all_that_are_known():
    with pytest.raises(ValueError, match="unknown vehicle 'whill'.*create, .*whill_cr, .*whill_cr_ramp.*vehicle file"):
        load_vehicle("whill")


def test_a_missing_file_tells_how_to_make_one(tmp_path):
    with pytest.raises(FileNotFoundError, match="sysid.fit"):
        load_vehicle(tmp_path / "none.toml")


def test_an_unfinished_write_leaves_the_old_file(saved, monkeypatch):
    before = saved.read_text()
    spec, params = preset("whill_cr")
    monkeypatch.setattr("os.replace", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        save_vehicle(saved, spec, params)
    assert saved.read_text() == before


def test_the_file_says_what_its_intervals_are(tmp_path):
    spec, params = preset("whill_cr_ramp")
    origin = {"interval_confidence": 0.9}
    path = save_vehicle(tmp_path / "vehicle.toml", spec, params, {"body.mass": (50.0, 55.0)}, origin)
    assert path.read_text().startswith("# Each interval [low, high] is the 90% confidence interval")
    assert load_vehicle(path)[2] == origin


SHORT = """
schema = 1
kind = "micromobility-vehicle"
[spec]
name = "burger"
wheel_radius = 0.033
track = 0.16
wheelbase = 0.1
mass = 1.0
body_length = 0.138
body_width = 0.178
body_height = 0.192
[spec.camera]
x = 0.03
y = 0.01
z = 0.1
pitch = 0.2
yaw = 0.5
"""


def test_a_file_without_a_model_drives_by_the_base_model_for_its_size(tmp_path):
    path = tmp_path / "burger.toml"
    path.write_text(SHORT)
    spec, params, _ = load_vehicle(path)
    assert spec.camera.yaw == 0.5 and spec.camera.y == 0.01
    usual = preset_params(spec, "physical")
    kept = VehicleParams(params.body, tuple(one for one in params.effects if one.name != "suspension"))
    jax.tree.map(np.testing.assert_array_equal, kept, usual)
    path.write_text(SHORT.replace("[spec]", 'base = "paper"\n[spec]'))
    assert load_vehicle(path)[1].effects[0].name == "pid_drive"
    assert load_intervals(path) == {}


def test_what_a_short_file_leaves_out_is_in_proportion_to_its_size(tmp_path):
    path = tmp_path / "burger.toml"
    path.write_text("".join(line + "\n" for line in SHORT.partition("[spec.camera]")[0].splitlines()
                            if not line.startswith("body_")))
    spec = load_vehicle(path)[0]
    assert spec.body_length < 0.2 and spec.body_width < 0.2 and spec.camera.z < 0.2 and abs(spec.camera.x) < 0.1
    assert spec.wheel_inertia < spec.mass * spec.wheel_radius**2


def after(spec, params, command, seconds):
    """Pitch [rad] and yaw rate [rad/s] when a vehicle has driven by one command from rest."""
    model = build_model(spec)
    commands = jnp.broadcast_to(jnp.asarray(command), (round(seconds / model.config.physics_dt), 2))
    state = jax.jit(lambda start: jax.lax.scan(lambda at, given: (substep(model, params, at, given), None), start,
                                               commands)[0])(place(model, params, 0.0, 0.0, 0.0))
    w, x, y, z = np.asarray(state.qpos[3:7])
    return float(np.arcsin(2 * (w * y - z * x))), float(state.odometry.omega)


def test_a_small_robot_of_a_short_file_stands_upright(tmp_path):
    path = tmp_path / "burger.toml"
    path.write_text(SHORT)
    spec, params, _ = load_vehicle(path)
    assert abs(after(spec, params, (0.0, 0.0), 1.0)[0]) < np.radians(1.0)


def test_the_wheels_of_a_skid_drive_of_a_short_file_turn_as_commanded(tmp_path):
    path = tmp_path / "rover.toml"
    sizes = {"wheel_radius": 0.1651, "track": 0.5708, "wheelbase": 0.512, "mass": 50.0, "omega_max": 2.0}
    path.write_text('schema = 1\nkind = "micromobility-vehicle"\n[spec]\nname = "rover"\ndrive = "skid"\n'
                    + "".join(f"{name} = {value}\n" for name, value in sizes.items()))
    spec, params, _ = load_vehicle(path)
    assert after(spec, params, (0.5, 0.6), 8.0)[1] == pytest.approx(0.6, rel=0.05)


@pytest.mark.parametrize(("text", "said"), [
    (SHORT + "[body.mass]\nvalue = 1.0\nunit = 'kg'\n", "has body; it must have both body and effects"),
    (SHORT.replace("[spec]", 'base = "wooden"\n[spec]'), "base is 'wooden'; it must be one of 'paper', 'physical'"),
    (SHORT.replace("yaw = 0.5", "yaw = 50"), r"spec.camera.yaw is 50"),
    (SHORT.replace("[spec.camera]", "rear_axle_x = 5.0\n[spec.camera]"), "axle 5.* m from the middle of the body"),
    (SHORT.replace("track = 0.16", "track = 0.5"), "spec.track is 0.5 m and spec.body_width"),
    (SHORT.replace("radius = 0.033", "radius = 0.33"), "wheel_radius is 0.33 m and spec.body_height 0.192 m"),
])  # fmt: skip
def test_a_short_file_with_a_mistake_is_one_line(text, said, tmp_path):
    path = tmp_path / "burger.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=said):
        load_vehicle(path)


@pytest.mark.parametrize("spec", SPECS.values(), ids=lambda spec: spec.name)
def test_every_built_in_vehicle_fulfils_the_rules_of_a_short_file(spec, tmp_path):
    path = save_vehicle(tmp_path / "short.toml", spec, preset_params(spec))
    path.write_text(path.read_text().partition("[body.")[0])
    assert load_vehicle(path)[0] == spec


def test_a_turned_mount_looks_where_it_says():
    spec = dataclasses.replace(HUSKY, camera=CameraMount(x=0.4, y=0.1, z=0.3, pitch=0.2, yaw=0.5, roll=0.3))
    model = build_model(spec)
    qpos = jnp.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    position, rotation = camera_pose(model, qpos)
    right, down, forward = np.asarray(rotation).T
    np.testing.assert_allclose(position, [0.4, 0.1, 0.3], atol=1e-6)
    np.testing.assert_allclose(np.arcsin(-forward[2]), 0.2, atol=1e-5)
    np.testing.assert_allclose(np.arctan2(forward[1], forward[0]), 0.5, atol=1e-5)
    np.testing.assert_allclose(np.arcsin(-right[2] / np.cos(0.2)), 0.3, atol=1e-5)  # the right side is lower
    np.testing.assert_allclose(np.cross(right, down), forward, atol=1e-5)


@pytest.mark.parametrize("spec", SPECS.values(), ids=lambda spec: spec.name)
def test_every_camera_sits_on_its_vehicle(spec):
    assert abs(spec.camera.x) <= spec.body_length / 2 + 0.05
    assert spec.camera.z + spec.wheel_radius <= spec.body_height + 0.2


@pytest.mark.parametrize(("name", "value"), [
    ("torque_drive.limit", 1e6), ("torque_drive.kp", 1e6), ("body.yaw_inertia", 1e6), ("body.mass", 40_000.0),
])  # fmt: skip
def test_what_a_lorry_may_have_is_refused_of_a_chair(tmp_path, name, value):
    spec, params = preset("whill_cr_physical")
    path = save_vehicle(tmp_path / "vehicle.toml", spec, set_values(params, [name], jnp.asarray([value])))
    with pytest.raises(ValueError, match=f"{name} is {value:.10g}.*it must be positive"):
        load_vehicle(path)
