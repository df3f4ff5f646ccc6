"""Manoeuvres, and the command that drives them into a dataset."""

from __future__ import annotations

import re
import tomllib

import numpy as np
import pytest

from whill_mjx.drive import DriveOptions, main
from whill_mjx.effects.texts import parse_effect, with_effects
from whill_mjx.io import command_line
from whill_mjx.logs.manoeuvres import MANOEUVRES, Scenario, command_table
from whill_mjx.logs.simulated_sensors import Sensors
from whill_mjx.vehicle.vehicle_file import load_vehicle

SHORT = Scenario(v=0.5, omega=0.6, length=2.0)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Two replicates of a circle with a late, slow vehicle, without noise."""
    out = tmp_path_factory.mktemp("drive") / "late"
    effects = ("command_delay:delay=0.2", "odometry_scale:linear=1.1")
    return main(DriveOptions(out, ("circle",), effects=effects, replicates=2, held_out=("circle",), scenario=SHORT))


def table(path):
    return np.loadtxt(path, delimiter=",", skiprows=1)


@pytest.mark.quick
@pytest.mark.parametrize("name", MANOEUVRES)
def test_every_manoeuvre_starts_and_ends_at_rest_within_its_limits(name):
    t, v, omega = command_table(name, SHORT).T
    np.testing.assert_allclose(np.diff(t), 0.1)
    rest = t < 0.95
    assert not v[rest].any() and not omega[rest].any() and v[-1] == omega[-1] == 0.0
    assert np.abs(v).max() <= 0.5 and np.abs(omega).max() <= 0.6
    assert (name == "standstill") == (not v.any() and not omega.any())


@pytest.mark.quick
def test_help_names_every_manoeuvre(capsys):
    with pytest.raises(SystemExit) as ended:
        command_line.run(DriveOptions, main, None, positional=False, args=["--help"])
    assert not ended.value.code
    assert set(MANOEUVRES) <= set(re.findall(r"\w+", capsys.readouterr().out))


@pytest.mark.quick
def test_a_drive_says_what_takes_long_after_its_options_are_checked(tmp_path, monkeypatch):
    said = []
    with pytest.raises(command_line.OptionError):
        main(DriveOptions(tmp_path), said.append)  # it exists
    assert not said
    monkeypatch.setattr("whill_mjx.drive.record_motion", lambda *given: (_ for _ in ()).throw(KeyError("driving")))
    with pytest.raises(KeyError, match="driving"):
        main(DriveOptions(tmp_path / "new"), said.append)
    assert len(said) == 1


@pytest.mark.quick
def test_random_steps_are_the_same_every_time():
    np.testing.assert_array_equal(command_table("random_steps", SHORT), command_table("random_steps", SHORT))


def test_a_drive_writes_the_streams_of_every_trial(dataset):
    assert sorted(path.name for path in (dataset / "trials").iterdir()) == ["circle_1", "circle_2"]
    for trial in ("circle_1", "circle_2"):
        folder = dataset / "trials" / trial
        np.testing.assert_allclose(table(folder / "command.csv"), command_table("circle", SHORT), atol=1e-6)
        odometry, truth = table(folder / "odometry.csv"), table(folder / "ground_truth.csv")
        np.testing.assert_allclose(odometry[:, 0], np.arange(len(odometry)) * 0.05, atol=1e-6)
        np.testing.assert_allclose(odometry[0], 0.0, atol=1e-3)
        assert np.abs(truth[:, 3]).max() <= np.pi + 1e-6
    fields = tomllib.loads((dataset / "dataset.toml").read_text())
    assert fields["held_out"] == ["circle_1", "circle_2"] and fields["track"] == 0.496
    assert not list(dataset.parent.glob(".*"))  # nothing half-written


def test_the_effects_of_the_command_line_show_in_the_log(dataset):
    odometry = table(dataset / "trials/circle_1/odometry.csv")
    truth = table(dataset / "trials/circle_1/ground_truth.csv")
    moving = truth[np.hypot(*(truth[:, 1:3] - truth[0, 1:3]).T) > 2e-3, 0][0]
    assert 1.2 <= moving <= 1.4  # commanded at 1.0
    driven = np.hypot(*np.diff(truth[:, 1:3], axis=0).T).sum()
    reported = np.hypot(*np.diff(odometry[:, 1:3], axis=0).T).sum()
    assert 1.05 < reported / driven < 1.15


def test_replicates_start_elsewhere_and_drive_the_same(dataset):
    first, second = (table(dataset / "trials" / name / "ground_truth.csv") for name in ("circle_1", "circle_2"))
    assert np.hypot(*(first[0, 1:3] - second[0, 1:3])) > 0.05
    turned = [np.unwrap(one[:, 3])[-1] - one[0, 3] for one in (first, second)]
    assert turned[0] == pytest.approx(turned[1], abs=5e-3)


def test_the_vehicle_that_was_driven_is_kept_and_can_be_driven_again(dataset):
    _, params, provenance = load_vehicle(dataset / "vehicle.toml")
    values = {effect.name: effect for effect in params.effects}
    assert float(values["command_delay"].delay) == pytest.approx(0.2)
    assert provenance["effects"] == "command_delay:delay=0.2 odometry_scale:linear=1.1"
    _, again, _ = load_vehicle(str(dataset / "vehicle.toml"))
    assert [effect.name for effect in again.effects] == [effect.name for effect in params.effects]


def test_the_dataset_is_read_by_the_fit(dataset):
    from sysid.logs.log import load_log

    log = load_log(dataset)
    assert [trial.name for trial in log.held_out] == ["circle_1", "circle_2"]
    assert log.spec.name == "whill_cr"


def test_sensors_report_at_their_rates_with_their_latencies(tmp_path):
    """The form of the chair's own log: 50 Hz states with a counter, a gyro at 104 Hz, poses that come late.

    A fit reads it, and leaves the streams aside that it does not know.
    """
    from sysid.logs.log import load_log

    sensors = Sensors(
        odometry_rate=50.0, ground_truth_latency=0.1, imu_rate=104.0, encoder_rate=50.0, encoder_latency=0.01
    )
    turned = ("gyro_bias:bias=0.1",)
    options = DriveOptions(tmp_path / "chair", ("turn",), effects=turned, scenario=SHORT, sensors=sensors)
    folder = main(options) / "trials" / "turn_1"
    odometry, truth, imu, encoder = (
        table(folder / f"{name}.csv") for name in ("odometry", "ground_truth", "imu", "encoder")
    )
    for stream, rate in ((odometry, 50.0), (truth, 20.0), (imu, 104.0), (encoder, 50.0)):
        np.testing.assert_allclose(np.diff(stream[:, 0]), 1 / rate, atol=2e-6)
    steady = (odometry[:, 0] > 1.5) & (odometry[:, 0] < 1.9)
    rate = np.interp(odometry[:, 0], imu[:, 0], imu[:, 1])
    np.testing.assert_allclose(rate[steady], odometry[steady, 5] + 0.1, atol=0.03)
    late = np.interp(truth[:, 0] - 0.1, odometry[:, 0], odometry[:, 3])
    assert np.abs(np.unwrap(truth[:, 3]) - truth[0, 3] - late).max() < 0.02  # turning on the spot hardly slips
    np.testing.assert_allclose(np.diff(encoder[:, 3]) % 201, 20.0, atol=1e-6)
    np.testing.assert_allclose(encoder[:, 1:3], np.round(encoder[:, 1:3], 3), atol=1e-9)
    turned_by = np.diff(np.unwrap(encoder[:, 1:3], axis=0)[[0, -1]], axis=0)[0] * 0.1325
    np.testing.assert_allclose((turned_by[1] - turned_by[0]) / 0.496, odometry[-1, 3], atol=0.01)
    assert [trial.name for trial in load_log(options.out).trials] == ["turn_1"]


@pytest.mark.quick
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"imu_rate": -1.0}, "imu_rate is -1.0 Hz; it must lie within 0"),
        ({"odometry_latency": 20.0}, "odometry_latency is 20.0 s.*Check the unit"),
        ({"odometry_rate": 0.0, "ground_truth_rate": 0.0}, "both 0; a log needs one of them"),
    ],
)
def test_sensors_that_cannot_be_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Sensors(**change)


@pytest.mark.quick
def test_an_effect_changes_in_place_or_is_appended():
    _, params, _ = load_vehicle("whill_cr_physical")
    changed = with_effects(params, ["yaw_scrub:torque=6", "slope:along_x=0.02", "traction_limit"])
    names = [effect.name for effect in changed.effects]
    assert names == [*(effect.name for effect in params.effects), "slope", "traction_limit"]
    by_name = {effect.name: effect for effect in changed.effects}
    assert float(by_name["yaw_scrub"].torque) == 6.0
    assert float(by_name["slope"].along_y) == 0.0
    assert float(by_name["traction_limit"].mu) == pytest.approx(0.9)  # no value: the upper usual one


@pytest.mark.quick
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("gravity", "unknown effect 'gravity'.*known: "),
        ("yaw_scrub:force=3", "no parameter 'force'.*torque"),
        ("yaw_scrub:torque", "'torque' is not PARAMETER=NUMBER.*no =.*Write it like"),
        ("yaw_scrub:torque=big", "'torque=big' is not PARAMETER=NUMBER.*Write it like"),
        ("command_delay:delay=200", "delay is 200 s; it must lie within 0 to 0.5.*Check the unit"),
        ("command_delay:delay=nan", "delay is nan s; it must lie within"),
    ],
)
def test_a_bad_effect_is_refused(text, message):
    with pytest.raises(ValueError, match=message):
        parse_effect(text)


@pytest.mark.quick
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"manoeuvre": ("spiral",)}, "unknown manoeuvre 'spiral'.*figure_eight"),
        ({"manoeuvre": ("turn", "turn")}, "given twice.*--replicates"),
        ({"replicates": 0}, "--replicates 0: must be at least 1"),
        ({"held_out": ("turn",)}, "--held-out turn: not among the manoeuvres driven"),
        ({"vehicle": "tricycle"}, "unknown vehicle 'tricycle'"),
    ],
)
def test_bad_options_are_refused_before_anything_is_written(tmp_path, change, message):
    out = tmp_path / "new"
    with pytest.raises(ValueError, match=message):
        main(DriveOptions(**{"out": out, **change}))
    assert not list(tmp_path.iterdir())


@pytest.mark.quick
def test_a_drive_never_replaces_another(tmp_path):
    with pytest.raises(ValueError, match="exists already; a drive never replaces another"):
        main(DriveOptions(tmp_path))
