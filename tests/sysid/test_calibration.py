"""The usual first calibration: sizes of the wheels, the odometry's scales, and the tracked point."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from benchmarks.plant.first_day import SMALL, Day, Wrong, make_uncalibrated, tracked, write_mjcf, write_urdf
from benchmarks.planted_logs import Schedule, write_dataset
from sysid.errors.bin_objective import make_features_objective
from sysid.errors.prior import SPREAD, UNKNOWN, bounds_alone
from sysid.errors.space import make_space
from sysid.intervals.uncertainty import Estimate, estimate
from sysid.logs.log import load_log, make_trial
from sysid.logs.records import Log, OdometryStream, PoseStream
from sysid.missing.reference import assumed_spread
from sysid.pages.fit_report import UNKNOWN as NOT_TOLD
from sysid.pages.fit_report import calibration_notes
from sysid.replay.mjcf import mjcf_model
from sysid.replay.model_files import load_model
from sysid.replay.models import set_parameters, with_effects
from sysid.replay.on_host import HostReplay
from sysid.replay.one_drive import Commanded, path_of
from sysid.replay.robot_drive import RobotDrive, rolling_ratio
from sysid.replay.robot_loading import load_robot
from sysid.replay.robot_parameters import drive_entries
from sysid.replay.rollout import Replay, make_batch, vehicle_plant
from sysid.search import least_squares
from sysid.search.fitting import fit_log, make_problem
from sysid.search.settings import FitConfig
from sysid.search.stated import chosen_sizes
from whill_mjx.logs.manoeuvres import Scenario
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.parameters import get_values, set_values
from whill_mjx.vehicle.presets import preset_params
from whill_mjx.vehicle.specs import find_spec
from whill_mjx.vehicle.vehicle_file import load_vehicle, save_vehicle

WRONG = Wrong(radius=0.03, track=-0.05, odometry=-0.02, x=0.12, y=-0.05, yaw=0.14)
NAMES = ("torque_drive.kp", "torque_drive.ki", "torque_drive.limit", "slip_traction.mu", "body.com_x", "pose_mount.x",
         "wheel_radius_difference.common", "track_width.error", "command_delay.delay")
SIZES = {"wheel_radius_difference.common", "track_width.error", "odometry_scale.linear", "pose_mount.x",
         "pose_mount.yaw"}


def commands() -> dict[str, np.ndarray]:
    """A turn on the spot after a straight line, and an S: 6 s each."""
    t = np.arange(60) / 10
    moving = (t >= 1) & (t < 5.5)
    spot = np.stack([t, 0.6 * (moving & (t < 3)), 0.8 * (moving & (t >= 3))], axis=-1)
    bend = np.stack([t, 0.5 * moving, 0.8 * np.sin(2 * (t - 1)) * moving], axis=-1)
    return {"spot": spot, "bend": bend}


@pytest.fixture(scope="module")
def uncalibrated(tmp_path_factory) -> Log:
    """A robot of 21 kg on the contact plant."""
    folder = tmp_path_factory.mktemp("uncalibrated") / "log"
    return load_log(make_uncalibrated(folder, Day("robot", WRONG, seed=4), replicates=1, manoeuvres=commands()))


@pytest.mark.quick
def test_what_a_fit_frees_follows_from_the_sensors_of_the_log(uncalibrated):
    def searched(log, **fields):
        return set(make_problem(log, FitConfig(physics_dt=0.01, **fields)).space.names)

    blind = dataclasses.replace(uncalibrated, trials=tuple(
        dataclasses.replace(trial, ground_truth=None) for trial in uncalibrated.trials))
    alone = dataclasses.replace(uncalibrated, trials=tuple(
        dataclasses.replace(trial, odometry=None) for trial in uncalibrated.trials))
    assert SIZES <= searched(uncalibrated)
    assert not SIZES & searched(blind) and not SIZES & searched(uncalibrated, calibrate=False)
    assert SIZES - searched(alone) == {"odometry_scale.linear"}
    skid = dataclasses.replace(uncalibrated, spec=find_spec("husky"))
    assert SIZES - searched(skid) == {"track_width.error"}
    assert not SIZES & searched(uncalibrated, preset="paper")


@pytest.mark.quick
def test_sizes_are_known_as_well_as_data_sheets_before_a_drive(uncalibrated):
    space = make_problem(uncalibrated, FitConfig(physics_dt=0.01)).space
    prior = bounds_alone(space)
    sd = dict(zip(space.names, prior.sd * (space.high - space.low), strict=True))
    assert sd["wheel_radius_difference.common"] == pytest.approx(0.03)
    assert sd["track_width.error"] == pytest.approx(0.05)
    mean = dict(zip(space.names, space.to_values(prior.mean), strict=True))
    assert mean["odometry_scale.linear"] == pytest.approx(1.0) and mean["pose_mount.yaw"] == pytest.approx(0.0)
    others = [i for i, name in enumerate(space.names) if name.startswith("torque_drive")]
    np.testing.assert_allclose(prior.sd[others], UNKNOWN)


@pytest.fixture(scope="module")
def planted(tmp_path_factory) -> Log:
    """A log of the simulator's own vehicle with wrong sizes, its pose that of a tracked body."""
    spec = find_spec("create")
    params = with_effects(preset_params(spec, "physical"), ("wheel_radius_difference", "track_width", "odometry_scale"))
    wrong = {"wheel_radius_difference.common": 0.03, "track_width.error": -0.05, "odometry_scale.linear": 0.98,
             "odometry_scale.angular": 0.97}
    params = set_values(params, list(wrong), jnp.array(list(wrong.values())))
    folder = write_dataset(tmp_path_factory.mktemp("planted") / "log", spec, params,
                           Schedule(replicates=1, seed=2, scenario=Scenario(v=0.4, omega=1.2, length=3.0),
                                    manoeuvres=("turn", "s_curve")),
                           plant=vehicle_plant(spec, VehicleConfig(physics_dt=0.01)))
    log, trials = load_log(folder), []
    for trial in log.trials:
        pose = trial.ground_truth
        rows = tracked(np.column_stack([pose.t, pose.values]), WRONG)
        pose = PoseStream(*rows[:, :3].T, np.unwrap(rows[:, 3]))
        trials.append(make_trial(trial.name, trial.command, trial.odometry, pose))
    return dataclasses.replace(log, trials=tuple(trials))


def test_sizes_scales_and_the_tracked_point_come_out_of_two_drives(planted):
    names = ("wheel_radius_difference.common", "track_width.error", "odometry_scale.linear", "odometry_scale.angular",
             "pose_mount.x", "pose_mount.y", "pose_mount.yaw")
    config = FitConfig(method="lm", physics_dt=0.01, iterations=8, elsewhere=False, parameters=names)
    fit = fit_log(planted, config)
    found = {one.name: one for one in fit.uncertainty.estimates}
    wanted = {"wheel_radius_difference.common": (0.03, 0.003), "track_width.error": (-0.05, 0.005),
              "odometry_scale.linear": (0.98, 0.003), "odometry_scale.angular": (0.97, 0.005),
              "pose_mount.x": (0.12, 0.005), "pose_mount.y": (-0.05, 0.005), "pose_mount.yaw": (0.14, 0.005)}
    for name, (truth, error) in wanted.items():
        assert found[name].value == pytest.approx(truth, abs=error), name
        assert found[name].identifiable, name
    notes = " ".join(calibration_notes(fit.uncertainty.estimates, planted.spec, planted.training))
    assert "larger than the stated 0.033 m" in notes and "smaller than the stated 0.258 m" in notes
    assert "m ahead of" in notes and "m right of" in notes and "to the left of the vehicle's" in notes
    assert "times the distance of wheels of the stated sizes" in notes


def test_a_drive_without_a_turn_does_not_determine_track_and_arm(uncalibrated):
    """Straight on: the lever arm moves nothing, and the track does not act."""
    spec, t = uncalibrated.spec, np.arange(0, 4, 0.1)
    straight = dataclasses.replace(uncalibrated.trials[0], odometry=None)
    v = 0.5 * (t >= 1)
    straight = dataclasses.replace(
        straight, command=dataclasses.replace(straight.command, t=t, v=v, omega=0 * v),
        ground_truth=PoseStream(t, np.cumsum(v) * 0.1 + 1e-3 * np.sin(9 * t), 1e-3 * np.cos(7 * t),
                                1e-3 * np.sin(5 * t)))
    log = dataclasses.replace(uncalibrated, trials=(straight,))
    names = ("track_width.error", "pose_mount.x", "pose_mount.y", "pose_mount.yaw", "wheel_radius_difference.common")
    fit = fit_log(log, FitConfig(method="lm", physics_dt=0.01, iterations=3, elsewhere=False, parameters=names))
    known = {one.name: one.identifiable for one in fit.uncertainty.estimates}
    assert not known["track_width.error"] and not known["pose_mount.x"]
    notes = calibration_notes(fit.uncertainty.estimates, spec, log.training)
    assert "does not determine" in notes[-1] and "track" in notes[-1] and "the tracked point's x" in notes[-1]


@pytest.mark.quick
def test_without_an_outside_pose_the_report_says_that_sizes_are_taken_as_stated(uncalibrated):
    blind = tuple(dataclasses.replace(trial, ground_truth=None) for trial in uncalibrated.trials)
    assert calibration_notes((), uncalibrated.spec, blind) == [NOT_TOLD]
    as_stated = Estimate("wheels.radius", 0.098, 0.098, 0.0979, 0.0981, True, "")
    note = calibration_notes((as_stated,), uncalibrated.spec, uncalibrated.training)[0]
    assert note == "The wheel radius is as stated, 0.098 m (0.0979 to 0.0981 m)."
    at_it = [Estimate(f"pose_mount.{axis}", 0.0, 1e-4, -1e-3, 1e-3, True, "") for axis in ("x", "y", "yaw")]
    assert calibration_notes(at_it, uncalibrated.spec, uncalibrated.training) == [
        "The outside pose follows the reference point, within 1.0 mm and 0.06 degrees."]
    beside = [Estimate("pose_mount.x", 0.0, -0.05, -0.052, -0.048, True, ""),
              Estimate("pose_mount.y", 0.0, -0.03, -0.031, -0.028, True, ""),
              Estimate("pose_mount.yaw", 0.0, np.deg2rad(-2.0), np.deg2rad(-2.5), np.deg2rad(-1.9), True, "")]
    assert calibration_notes(beside, uncalibrated.spec, uncalibrated.training) == [
        "The tracked point lies 0.0500 m behind (0.0480 to 0.0520) and 0.0300 m right of (0.0280 to 0.0310) the "
        "reference point.",
        "Its heading is turned by 2.00 degrees to the right of the vehicle's (1.90 to 2.50 degrees)."]


@pytest.fixture(scope="module")
def small_robot(tmp_path_factory):
    """A log of a robot of a kilogram on the contact plant, and the file with the sizes that are believed."""
    folder = tmp_path_factory.mktemp("small")
    tables = {name: table * [1, 0.3, 2.0] for name, table in commands().items()}
    wrong = dataclasses.replace(WRONG, x=0.05, y=-0.02, odometry=0.0)
    log = make_uncalibrated(folder / "log", Day("small", wrong, seed=5), replicates=1, manoeuvres=tables)
    return load_log(log), write_urdf(folder / "robot.urdf")


def test_an_own_robot_gets_what_the_log_shows_by_default(small_robot):
    log, file = small_robot
    given = make_problem(log, FitConfig(model=str(file)))
    assert {"wheels.radius", "wheels.track", "command_delay.delay", "pose_mount.x", "odometry_scale.linear",
            "acceleration_limit.wheel", "geom.ball.friction"} <= set(given.space.names)
    assert not any(name.startswith("actuator") or name == "acceleration_limit.linear" for name in given.space.names)
    assert isinstance(given.objective.replay.replay._replay, HostReplay)
    blind = tuple(dataclasses.replace(trial, ground_truth=None) for trial in log.trials)
    alone = make_problem(dataclasses.replace(log, trials=blind), FitConfig(model=str(file))).space
    assert not {"wheels.radius", "pose_mount.x", "odometry_scale.linear"} & set(alone.names)
    assert ("wheels.radius", "no outside pose shows it") in alone.fixed
    assert ("geom.*_wheel.friction", "the log cannot show it: no outside pose") in alone.fixed


def test_sizes_of_an_own_robot_come_out(small_robot):
    """Planted in the model itself, with noise of a millimetre."""
    log, file = small_robot
    wanted = {"wheels.radius": 0.034, "wheels.track": 0.152, "odometry_scale.linear": 0.99, "pose_mount.x": 0.05,
              "pose_mount.yaw": 0.14}
    names = tuple(wanted)
    model = mjcf_model(file, names[:2], effects=("odometry_scale", "pose_mount"), wheel_radius=0.033, track=0.16)
    batch, _ = make_batch(log.trials, model.plant.dt)
    replay = HostReplay(model.plant, batch, lambda values: set_parameters(model.params, names, values))
    seen, random, trials = replay.simulate(np.array([list(wanted.values())])), np.random.default_rng(0), []
    for i, trial in enumerate(log.trials):
        pose = seen.pose[0, i, : len(trial.ground_truth.t)] + random.normal(0, 1e-3, (len(trial.ground_truth.t), 3))
        speeds = seen.odometry[0, i, : len(trial.odometry.t), 3:]
        odometry = OdometryStream(trial.odometry.t, None, None, None, *speeds.T)
        trials.append(make_trial(trial.name, trial.command, odometry, PoseStream(trial.ground_truth.t, *pose.T)))
    planted = dataclasses.replace(log, trials=tuple(trials))
    fit = fit_log(planted, FitConfig(method="lm", iterations=8, elsewhere=False, parameters=names), model=model)
    for one in fit.uncertainty.estimates:
        assert one.value == pytest.approx(wanted[one.name], rel=0.005, abs=2e-3), one.name
        assert one.identifiable, one.name


def test_the_first_calibration_of_an_own_robot_comes_out_of_two_drives_on_the_contact_plant(small_robot):
    """The plant drives with a PI controller, a limit of its torque and a delay, and shares no code with the model.

    A few steps on two drives of 6 s: sizes within 1.5 %, where a servo of another law left 8 and 9 %.
    """
    log, file = small_robot
    given = make_problem(log, FitConfig(model=str(file)))
    features = make_features_objective(given.objective, log.spec.track)
    start = given.space.to_unit(given.space.initial)
    found = least_squares.fit(features, starts=start[None], stop=least_squares.Stopping(3))
    values = dict(zip(given.space.names, given.space.to_values(found.u), strict=True))
    assert values["wheels.radius"] == pytest.approx(0.033 * 1.03, rel=0.015)
    assert values["wheels.track"] == pytest.approx(0.16 * 0.95, rel=0.015)
    assert values["pose_mount.x"] == pytest.approx(0.05, abs=3e-3)
    assert values["pose_mount.yaw"] == pytest.approx(0.14, abs=0.01)
    assert values["odometry_scale.linear"] == pytest.approx(1.0, abs=0.01)
    assert values["drive.kp"] == pytest.approx(SMALL.kp, rel=0.4)


@pytest.mark.long
def test_wrong_sizes_of_an_own_robot_stay_free_although_two_drives_cannot_foretell_each_other(small_robot):
    log, file = small_robot
    given = make_problem(log, FitConfig(model=str(file)))
    start = given.space.to_unit(given.space.initial)
    features = make_features_objective(given.objective, log.spec.track)
    found = least_squares.fit(features, starts=start[None], stop=least_squares.Stopping(4))
    binned = features.renewed(found.u)
    known = estimate(binned, found.u, robust=True)
    chosen = chosen_sizes(binned, given.objective.renewed(found.u), known, found.cost)
    assert chosen.names == ("scales of the odometry",)
    values = dict(zip(given.space.names, given.space.to_values(chosen.u), strict=True))
    assert values["wheels.radius"] == pytest.approx(0.033 * 1.03, rel=0.01)
    assert values["wheels.track"] == pytest.approx(0.16 * 0.95, rel=0.01)
    assert values["odometry_scale.angular"] == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("write", [write_urdf, write_mjcf])
@pytest.mark.quick
def test_a_robot_that_speeds_up_does_not_run_ahead_of_its_wheels(tmp_path, write):
    """MuJoCo solves contacts as if wheels turned freely: an implicit servo lets the vehicle run ahead by 90 ms."""
    robot = load_robot(write(tmp_path / ("robot.urdf" if write is write_urdf else "robot.xml")), regulated=True)
    steps = round(0.3 / robot.host.opt.timestep)
    turn = np.zeros((1, 1, steps, 2))
    turn[..., 1] = 2 * np.minimum(np.arange(steps) * robot.host.opt.timestep / 0.1, 1.0)
    states = SimpleNamespace(qpos=robot.rest[None, None], qvel=np.zeros((1, 1, robot.host.nv)))
    drive = RobotDrive(robot, {"drive.ki": drive_entries(robot)["drive.ki"][0]})
    values = {"drive.kp": np.array([robot.drive_gain[0]]), "drive.ki": np.array([100 * robot.load])}
    path = drive(values, states, turn, 0, np.zeros((1, 1, 3)))[0, 0]
    turned, by_wheels = path[-1, 2] - path[0, 2], path[1:, 4].sum() * robot.host.opt.timestep
    assert turned > 0.3
    assert turned == pytest.approx(by_wheels, rel=0.02)


@pytest.mark.quick
def test_wheels_roll_on_the_radius_that_is_given_although_they_sink(tmp_path):
    """MuJoCo's own contacts let a wheel of 33 mm sink by 0.4 mm."""
    path = write_mjcf(tmp_path / "robot.xml")
    robot = load_robot(path, regulated=True)
    assert rolling_ratio(robot) < 0.995
    model = mjcf_model(path, calibrate=True)
    steps = round(2.0 / model.plant.dt)
    commands = np.zeros((1, 1, steps, 2))
    commands[..., 0] = 0.15
    states = SimpleNamespace(qpos=robot.rest[None, None], qvel=np.zeros((1, 1, robot.host.nv)))
    for radius in (0.033, 0.035):
        values = {name: np.array([float(one)]) for name, one in model.params.values.items()}
        seen = model.plant.host.drive(values | {"wheels.radius": np.array([radius])}, states, commands, 0,
                                      np.zeros((1, 1, 3)))[0, 0, steps // 2 :]
        way, turned = seen[-1, 0] - seen[0, 0], seen[1:, 3].sum() * model.plant.dt / 0.033
        assert way / turned == pytest.approx(radius, rel=1e-3)


@pytest.mark.quick
def test_the_controller_that_a_fit_adds_is_written_and_read_again(small_robot, tmp_path):
    _, file = small_robot
    model = mjcf_model(file, calibrate=True)
    wanted = {"drive.kp": 0.02, "drive.ki": 0.1, "drive.limit": 0.06, "body.base_link.inertia": 0.004}
    written = model.write(tmp_path, set_parameters(model.params, list(wanted), jnp.array(list(wanted.values()))))
    robot = load_robot(written, regulated=True)
    host = robot.host
    assert host.nu == 4 and len(robot.integrals) == 2
    for actuators, gain, column in ((robot.actuators, 0.02, 2), (robot.integrals, 0.1, 1)):
        np.testing.assert_allclose(host.actuator_gainprm[list(actuators), 0], gain, rtol=1e-6)
        np.testing.assert_allclose(host.actuator_biasprm[list(actuators), column], -gain, rtol=1e-6)
    np.testing.assert_allclose(host.jnt_actfrcrange[list(robot.joints)], [[-0.06, 0.06]] * 2, rtol=1e-6)
    nominal = load_robot(file).host.body("base_link").inertia
    np.testing.assert_allclose(np.sort(host.body("base_link").inertia / nominal), 0.004 / nominal.max(), rtol=1e-4)


@pytest.mark.quick
def test_a_fitted_robot_becomes_a_vehicle_where_it_slides_on_a_ball(small_robot, tmp_path):
    log, file = small_robot
    model = mjcf_model(file, calibrate=True, wheel_radius=0.033, track=0.16, effects=("command_delay", "pose_mount"))
    wanted = {"drive.kp": 0.02, "drive.ki": 0.1, "drive.limit": 0.06, "wheels.radius": 0.034, "wheels.track": 0.152,
              "geom.*_wheel.friction": 0.7, "geom.ball.friction": 0.04, "command_delay.delay": 0.03,
              "pose_mount.x": 0.05}
    params = set_parameters(model.params, list(wanted), jnp.array(list(wanted.values())))
    twin = model.vehicle(params, log.spec)
    spec, vehicle = twin.spec, twin.params
    save_vehicle(tmp_path / "vehicle.toml", spec, vehicle)
    spec, vehicle, _ = load_vehicle(tmp_path / "vehicle.toml")
    assert spec.driven_axle == "front" and spec.wheelbase == pytest.approx(0.06)  # the ball is 6 cm behind
    assert (spec.body_length, spec.reference_x) == pytest.approx((0.144, 0.01))  # its box reaches 62 mm ahead
    assert spec.mass == pytest.approx(SMALL.mass, abs=0.002) and spec.wheel_radius == 0.033
    found = dict(zip(NAMES, map(float, get_values(vehicle, NAMES)), strict=True))
    assert found == pytest.approx({
        "torque_drive.kp": 0.02, "torque_drive.ki": 0.1, "torque_drive.limit": 0.06, "slip_traction.mu": 0.7,
        "wheel_radius_difference.common": 1 / 33, "track_width.error": -0.05, "command_delay.delay": 0.03,
        "pose_mount.x": 0.05, "body.com_x": 0.01 + SMALL.com[0] * 1.12 / 1.2}, rel=1e-2)


@pytest.mark.quick
def test_sizes_and_scales_are_not_taken_to_wander_by_a_share_of_their_value(small_robot):
    """Else an odometry that reads 2 % too far on one day would be a usual day."""
    spec = find_spec("create")
    params = with_effects(preset_params(spec, "physical"), ("odometry_scale", "wheel_radius_difference"))
    space = make_space(params, spec, ("odometry_scale.linear", "wheel_radius_difference.common", "torque_drive.kp"))
    u = space.to_unit(space.initial)
    linear, common, kp = assumed_spread(space, u) * space.slope(u)
    assert linear < 0.002 and common < 0.002
    assert kp == pytest.approx(SPREAD * space.initial[2])


@pytest.mark.quick
def test_a_robot_of_another_kind_becomes_no_vehicle_and_the_reason_is_said(small_robot, tmp_path):
    log, file = small_robot
    assert mjcf_model(file).vehicle(mjcf_model(file).params, log.spec) == "sizes and controller were not fitted"
    from test_robots import robot_file, wheel

    wheels = (wheel(f"{end}_{side}_wheel", x, y) for end, x in (("front", 0.25), ("rear", -0.25))
              for side, y in (("left", 0.25), ("right", -0.25)))
    model = mjcf_model(robot_file(tmp_path, *wheels), calibrate=True)
    assert "skid-steered" in model.vehicle(model.params, log.spec)


@pytest.mark.quick
def test_sizes_of_the_wheels_change_the_model_and_the_file_that_is_written(small_robot, tmp_path):
    _, file = small_robot
    model = mjcf_model(file, ["wheels.radius", "wheels.track", "wheels.difference"])
    wanted = {"wheels.radius": 0.036, "wheels.track": 0.15, "wheels.difference": 0.02}
    params = set_parameters(model.params, list(wanted), jnp.array(list(wanted.values())))
    written = load_robot(model.write(tmp_path, params))
    assert written.distance == pytest.approx(0.15, abs=1e-5)
    left, right = (written.host.geom(f"{side}_wheel").size[0] for side in ("left", "right"))
    assert (left + right) / 2 == pytest.approx(0.036, rel=1e-6)
    assert (left - right) / 0.036 == pytest.approx(0.02, rel=1e-5)
    before = load_robot(file)
    floor = [robot.host.geom("floor").pos[2] for robot in (before, written)]
    assert floor[0] == pytest.approx(floor[1], abs=1e-4)  # what grows rises


@pytest.mark.long
def test_a_drive_by_the_host_is_that_of_mjx(tmp_path, small_robot):
    """Spheres, which MJX compiles soon; half a second."""
    from test_models import ROBOT

    log, path = small_robot[0], tmp_path / "robot.xml"
    path.write_text(ROBOT)
    model = mjcf_model(path, ["actuator.*_motor.gain", "wheels.radius"], effects=("command_delay", "pose_mount"))
    trial = log.trials[0]
    keep = trial.ground_truth.t < 1.5
    pose = PoseStream(*(getattr(trial.ground_truth, name)[keep] for name in ("t", "x", "y", "yaw")))
    trial = dataclasses.replace(trial, odometry=None, ground_truth=pose)
    batch, _ = make_batch((trial,), model.plant.dt)
    names = ("actuator.*_motor.gain", "command_delay.delay", "pose_mount.x", "wheels.radius")

    def put(values):
        return set_parameters(model.params, names, values)

    sets = np.array([[1.0, 0.02, 0.0, 0.1], [0.4, 0.1, 0.2, 0.105], [0.4, 0.1, 0.1, 0.105]])
    ours, theirs = (kind(model.plant, batch, put).simulate(sets) for kind in (HostReplay, Replay))
    np.testing.assert_allclose(ours.pose, theirs.pose, atol=2e-3)  # MJX has single precision
    assert np.abs(ours.pose[0, 0, -1] - ours.pose[1, 0, -1]).max() > 5e-3
    assert not ours.diverged.any()


@pytest.mark.quick
def test_sets_that_differ_in_readings_alone_share_a_drive(small_robot, monkeypatch):
    log, file = small_robot
    model = load_model(str(file), log.spec).with_effects(("odometry_scale", "pose_mount"))
    batch, _ = make_batch(log.trials, model.plant.dt)
    names = ("wheels.radius", "pose_mount.x", "odometry_scale.linear")
    replay = HostReplay(model.plant, batch, lambda values: set_parameters(model.params, names, values))
    driven = []
    drive = replay._host.drive
    monkeypatch.setattr(replay, "_host", dataclasses.replace(
        replay._host, drive=lambda values, *rest: driven.append(len(values["wheels.radius"])) or drive(values, *rest)))
    found = replay.simulate(np.array([[0.033, 0.0, 1.0], [0.033, 0.1, 1.0], [0.033, 0.0, 1.1], [0.034, 0.0, 1.0]]))
    assert driven == [2]
    assert np.abs(found.pose[1] - found.pose[0]).max() > 0.01
    np.testing.assert_allclose(found.odometry[2, ..., 3], 1.1 * found.odometry[0, ..., 3], atol=1e-6)


@pytest.mark.quick
def test_a_start_is_that_of_the_tracked_point_also_where_the_room_matters(small_robot):
    """Under a slope the vehicle's own heading counts, not that of the markers."""
    spec = find_spec("create")
    plant = vehicle_plant(spec, VehicleConfig(physics_dt=0.01))
    params = with_effects(preset_params(spec, "physical"), ("pose_mount",))
    turned = set_values(params, ["pose_mount.x", "pose_mount.yaw"], jnp.array([0.1, 0.5]))
    start = jnp.array([1.0, 2.0, 0.3, 0.0, 0.0])
    command = jnp.zeros((30, 2, 2)).at[..., 0].set(0.2)
    path = jax.jit(lambda command: path_of(plant, turned, Commanded(command, start)))(command)
    np.testing.assert_allclose(path[0, :3], start[:3], atol=1e-4)
    moved = np.asarray(path[-1, :2] - path[0, :2])
    np.testing.assert_allclose(np.arctan2(moved[1], moved[0]), 0.3 - 0.5, atol=1e-3)


@pytest.mark.quick
def test_the_small_robot_of_the_plant_stands_on_two_wheels_and_a_ball(small_robot):
    _, file = small_robot
    robot = load_robot(file)
    assert robot.wheel_radius == pytest.approx(SMALL.nominal.radius) and len(robot.sliding) == 1
    assert robot.host.geom("ball").friction[0] == pytest.approx(0.05)
    assert mujoco.mj_id2name(robot.host, mujoco.mjtObj.mjOBJ_GEOM, robot.sliding[0]) == "ball"


