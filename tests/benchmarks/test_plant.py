"""The contact plant drives like a chair, its logs are blind and repeatable."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import plant
from benchmarks.plant.__main__ import main
from benchmarks.plant.chair import COULOMB, SLOW, VEHICLES, Chair
from benchmarks.plant.commands import nine
from benchmarks.plant.compare import channels, read
from benchmarks.plant.effects import EFFECTS, in_proportion
from benchmarks.plant.make import HELD_OUT, Experiment, make_log, plan
from benchmarks.plant.sensors import outside_pose
from benchmarks.plant.trial import Noise, Plant

SHORT = {"dash_1m": np.array([[0.0, 0, 0], [0.5, 0.5, 0.3], [2.0, 0, 0], [3.0, 0, 0]])}
STILL = np.array([[0.0, 0.0, 0.0], [6.0, 0.0, 0.0]])


def drive(messages, noise=0.0, effects=(), chair=None, start=(0.0, 0.0, 0.5), seed=0):
    return Plant(chair or Chair()).drive(
        messages, start, list(effects), Noise().scaled(noise), np.random.default_rng(seed)
    )


def contents(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_skidding_tyre_gives_its_friction_times_its_load():
    """Brakes that lock the rear wheels: m a = mu N, N = m (g x_front - a h) / wheelbase."""
    grip, stop = Chair(friction=0.6), np.array([[0.0, 0, 0], [0.1, 0.9, 0], [2.5, 0, 0], [3.5, 0, 0]])
    h, front = 0.151 + 0.1325, 0.45 - 0.145  # of the centre of mass above the floor, behind the front wheels [m]
    expected = 0.6 * 9.81 * front / (0.45 + 0.6 * h)
    braking = {}
    for contact in (COULOMB, SLOW):
        log = Plant(grip, contact).drive(stop, (0.0, 0.0, 0.0), [], Noise().scaled(0.0), np.random.default_rng(0))
        wheel = np.gradient(log.encoder.mean(1), 0.004) * 0.1325
        skids = (log.t > 2.55) & (log.speed[:, 0] > 0.15) & (log.speed[:, 0] - wheel > 0.08)
        assert skids.sum() > 20
        braking[contact] = -np.polyfit(log.t[skids], log.speed[skids, 0], 1)[0]
    assert braking[COULOMB] == pytest.approx(expected, rel=0.04)
    assert braking[SLOW] < braking[COULOMB]


def test_constant_speed_is_free_of_chatter():
    log = drive(nine(0)["straight"])
    steady = log.speed[(log.t > 10) & (log.t < 18)]
    acceleration = np.gradient(steady[:, 0], 0.004)
    assert np.std(acceleration) < 0.05  # m/s^2
    assert abs(steady[:, 1]).max() < 0.002 and abs(steady[:, 2]).max() < 0.002
    assert np.mean(steady[:, 0]) == pytest.approx(nine(0)["straight"][50, 1], rel=0.005)


def test_circle_turns_as_commanded_without_ripple():
    messages = nine(0)["circle"]
    log = drive(messages)
    steady = log.speed[(log.t > 10) & (log.t < 19)]
    assert np.std(steady[:, 2]) < 0.002
    assert np.mean(steady[:, 2]) == pytest.approx(messages[50, 2], rel=0.01)


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_standstill_stays_still(noise):
    log = drive(STILL, noise)
    assert np.abs(log.pose[:, :2]).max() < 0.0005 and np.ptp(log.pose[:, 2]) < 0.0005
    assert np.abs(log.encoder).max() < 0.004


def test_outside_pose_has_the_declared_noise():
    seen = outside_pose(drive(STILL), Noise(), np.random.default_rng(3))
    assert np.std(seen[:, 1]) == pytest.approx(0.003, rel=0.2) and np.std(seen[:, 3]) == pytest.approx(0.003, rel=0.2)


def test_replicates_differ_at_the_declared_level_and_not_without_noise(tmp_path):
    spreads = []
    for noise in (1.0, 0.0):
        make_log(tmp_path / f"n{noise}", Experiment(seed=5, noise=noise, manoeuvres=["circle"]))
        rows = np.stack([channels(trial) for trial in read(tmp_path / f"n{noise}").values()])
        spreads.append(np.sqrt(rows.var(axis=0, ddof=1).mean(axis=0)))
    v, omega, yaw = spreads[0][:3]
    assert 0.003 < v < 0.006 and 0.0045 < omega < 0.0095 and 0.001 < yaw < 0.008
    assert spreads[1][0] < 0.002 and spreads[1][1] < 0.004 and spreads[1][6] < 0.005


@pytest.mark.quick
def test_days_differ_by_a_few_percent_and_the_nominal_chair_does_not():
    days = [plan(Experiment({}, seed, 1.0, True))[0].chair for seed in range(20)]
    gains, masses = np.array([day.kp for day in days]), np.array([day.mass for day in days])
    assert len(set(gains)) == 20 and 0.01 < np.std(gains) / 9.0 < 0.06 and np.abs(masses / 54.0 - 1).max() < 0.1
    assert plan(Experiment({}, 1, 1.0, False))[0].chair == plan(Experiment({}, 2, 1.0, False))[0].chair == Chair()


def test_the_same_arguments_give_the_same_files_in_any_number_of_processes(tmp_path):
    first, second, third = (
        make_log(tmp_path / name, Experiment({"wind": 8.0}, seed=4, manoeuvres=SHORT, replicates=2),
                 processes=processes)
        for name, processes in (("a", 1), ("b", 1), ("c", 2))
    )
    other = make_log(tmp_path / "d", Experiment({"wind": 8.0}, seed=6, manoeuvres=SHORT, replicates=2))
    assert contents(first) == contents(second) == contents(third)
    assert contents(first) != contents(other)


def test_size_zero_is_the_plain_chair(tmp_path):
    plain = make_log(tmp_path / "plain", Experiment(seed=4, manoeuvres=SHORT, replicates=1))
    zero = make_log(tmp_path / "zero", Experiment(dict.fromkeys(EFFECTS, 0.0), seed=4, manoeuvres=SHORT, replicates=1))
    assert contents(plain) == contents(zero)


def test_the_dataset_is_blind_and_the_answers_lie_outside(tmp_path):
    effects = {name: entry.base / 10 for name, entry in EFFECTS.items()}
    out = make_log(tmp_path / "set", Experiment(effects, seed=4, manoeuvres=SHORT, replicates=1),
                   answers=tmp_path / "truth.json")
    text = " ".join([*contents(out), *(data.decode() for data in contents(out).values())])
    assert not [name for name in EFFECTS if name in text]
    assert not any(word in text for word in ("seed", "effect", "kp"))
    assert json.loads((tmp_path / "truth.json").read_text())["effects"] == pytest.approx(effects)
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def test_all_nine_manoeuvres_have_the_form_of_the_dataset(tmp_path):
    out = make_log(tmp_path / "set", Experiment(seed=1, replicates=1), ground_truth=False)
    trials = read(out)
    assert sorted(trials) == sorted(f"{name}_1" for name in nine(1)) and len(trials) == 9
    for streams in trials.values():
        assert sorted(streams) == ["command", "odometry"]
        command, odometry = streams["command"], streams["odometry"]
        assert 12 <= command[-1, 0] <= 31 and np.abs(command[:, 1:]).max() <= 1.0
        assert odometry.shape[1] == 6 and (np.diff(odometry[:, 0]) > 0).all() and np.abs(odometry[0, 1:4]).max() < 1e-3
    fields = (out / "dataset.toml").read_text()
    assert "held_out" in fields and "ground_truth" not in fields and "figure_eight_1" in fields
    assert set(HELD_OUT[1:]).isdisjoint(word.strip('",[] ') for word in fields.split())


@pytest.mark.parametrize("name", VEHICLES)
def test_every_vehicle_follows_its_commands_and_leaves_room_to_its_drives(name):
    chair, messages = VEHICLES[name], nine(0)["circle"]
    log = drive(messages, chair=chair)
    steady = (log.t > 10) & (log.t < 19)
    assert np.mean(log.speed[steady, 0]) == pytest.approx(messages[50, 1], rel=0.02)
    assert np.mean(log.speed[steady, 2]) == pytest.approx(messages[50, 2], rel=0.02)
    assert np.std(log.speed[steady, 2]) < 0.004
    assert np.abs(log.torque[steady]).max() < 0.5 * chair.torque_limit


def test_a_dataset_of_another_vehicle_has_its_nominal_values_and_its_own_odometry(tmp_path):
    out = make_log(tmp_path / "set", Experiment(seed=1, noise=0.0, manoeuvres=["straight"], replicates=1,
                   vehicle="robot"))
    fields = (out / "dataset.toml").read_text()
    nominal = VEHICLES["robot"].nominal
    for name, value in (("wheel_radius", nominal.radius), ("track", nominal.track), ("wheelbase", nominal.wheelbase),
                        ("mass", nominal.mass)):
        assert f"{name} = {value}  " in fields
    [trial] = read(out).values()
    assert trial["odometry"][-1, 1] == pytest.approx(np.hypot(*np.ptp(trial["ground_truth"][:, 1:3], axis=0)), rel=0.01)


@pytest.mark.quick
def test_sizes_of_forces_grow_with_the_vehicle_and_shares_do_not():
    heavy = VEHICLES["scooter"]
    assert in_proportion("wind", 8.0, heavy) == pytest.approx(8.0 * 128 / 54)
    assert in_proportion("dry_friction", 1.0, heavy) == pytest.approx(42 / 14)
    assert in_proportion("command_delay", 0.06, heavy) == 0.06
    assert all(in_proportion(name, entry.base, Chair()) == entry.base for name, entry in EFFECTS.items())


def test_a_failed_write_leaves_nothing(tmp_path, monkeypatch):
    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr("benchmarks.plant.make.write_text", fail)
    with pytest.raises(OSError, match="disk full"):
        make_log(tmp_path / "set", Experiment(manoeuvres=SHORT, replicates=1))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.quick
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"effects": {"ghost": 1.0}}, "unknown effect 'ghost'"),
        ({"vehicle": "tank"}, "unknown vehicle 'tank'"),
        ({"effects": {"yaw_scrub": -0.01}}, "yaw_scrub=-0.01: must not be negative"),
        ({"effects": {"slope": float("nan")}}, "slope=nan: must be finite"),
        ({"manoeuvres": ["waltz"]}, "unknown manoeuvre 'waltz'"),
        ({"manoeuvres": {"line": np.zeros((4, 2))}}, r"'line': shape \(4, 2\)"),
        ({"answers": "IN/truth.json"}, "lies inside the dataset"),
    ],
)
def test_bad_arguments_are_named(tmp_path, arguments, message):
    answers = tmp_path / "set" / "truth.json" if arguments.pop("answers", None) else None
    with pytest.raises(ValueError, match=message):
        make_log(tmp_path / "set", Experiment(**arguments), answers=answers)
    assert list(tmp_path.iterdir()) == []


def test_the_command_line_writes_a_dataset_and_never_replaces_one(tmp_path):
    arguments = ["--out", str(tmp_path / "set"), "--effects", '{"slope": 0.02}', "--manoeuvres", "turn"]
    assert main([*arguments, "--replicates", "1", "--seed", "3"]) == tmp_path / "set"
    with pytest.raises(FileExistsError, match="exists"):
        main(arguments)
    with pytest.raises(ValueError, match="not JSON"):
        main(["--out", str(tmp_path / "other"), "--effects", "slope=0.02"])


@pytest.mark.quick
def test_the_plant_shares_no_vehicle_code():
    allowed = {"whill_mjx.logs.dataset", "whill_mjx.logs.manoeuvres", "whill_mjx.io.command_line",
               "whill_mjx.io.heartbeat"}  # files, options and signs of life
    for path in Path(plant.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom):
                names = {node.module or ""}
            elif isinstance(node, ast.Import):
                names = {alias.name for alias in node.names}
            else:
                continue
            assert not {name for name in names if name.split(".")[0] in ("whill_mjx", "sysid", "jax")} - allowed, path
