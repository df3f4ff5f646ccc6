"""A damaged log, recording, report or model gives a value or an error that names the file."""

from __future__ import annotations

import gzip
import io
import json
import shutil
import zipfile

import numpy as np
import pytest
from damage import Costs, damaged_table, few
from damaged_bytes import check, check_packed
from hypothesis import given
from hypothesis import strategies as st
from test_convert import StoragePlugin, write_bag
from test_models import ROBOT

from sysid.design import load_subject
from sysid.errors.features import CHANNELS
from sysid.errors.noise import ROUGH, Whitener
from sysid.logs import lerobot
from sysid.logs.bags.reader import read_bag
from sysid.logs.conversion import ConvertConfig, convert
from sysid.logs.log import load_log, read_csv
from sysid.logs.published.drive_norlab import load_drive
from sysid.logs.published.mrclam import load_mrclam
from sysid.missing.fit_statistics import FitStatistics, Leftovers, load_fitted
from sysid.pages.report import read_report, write_html, write_report
from sysid.pages.series import Channel, TrialSeries, load, save
from sysid.replay.robot_loading import load_robot
from sysid.verdict.posterior import Thresholds, posterior
from sysid.verdict.posterior import read as read_evidence
from whill_mjx.logs.dataset import write_fields, write_trial
from whill_mjx.vehicle.presets import preset
from whill_mjx.vehicle.vehicle_file import save_vehicle

pytestmark = pytest.mark.quick


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """A drive of two seconds, with both measurements."""
    folder = tmp_path_factory.mktemp("data")
    t = np.arange(0.0, 2.0, 0.1)
    v = np.where(t > 1.0, 0.5, 0.0)
    x, zero = np.maximum(t - 1.0, 0.0) * 0.5, np.zeros_like(t)
    command, pose = np.column_stack([t, v, zero]), np.column_stack([x, zero, zero])
    write_trial(folder / "trials" / "ahead_1", t, command, pose, np.column_stack([pose, v, zero]))
    write_fields(folder, preset("whill_cr")[0], ["ahead_1"])
    return folder


@pytest.mark.parametrize("name", ["dataset.toml", *(f"trials/ahead_1/{one}.csv" for one in (
    "command", "odometry", "ground_truth"))])
def test_a_damaged_driving_log(dataset, tmp_path, name):
    folder = tmp_path / "data"
    shutil.copytree(dataset, folder)

    def read():
        log = load_log(folder)
        assert log.spec.track > 0 and log.spec.mass > 0
        for trial in log.trials:
            assert np.isfinite(trial.command.v).all() and np.abs(trial.command.omega).max() <= 20
            assert (np.diff(trial.command.t) > 0).all()

    path = folder / name
    # An error of a trial may name the trial's folder, one of the description the dataset's.
    check(path, path.read_bytes(), read)


def test_a_damaged_command_file(tmp_path):
    path = tmp_path / "command.csv"
    check(path, b"t,v,omega\n0,0,0\n0.5,0.2,-0.1\n1,0.25,0\n", lambda: read_csv(path, ("t", "v", "omega")), 100)


def zipped(**arrays):
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def test_damaged_windows_of_a_measured_run(tmp_path):
    path = tmp_path / "warthog_sand_1.npz"
    names = ("cmd_left", "cmd_right", "left_wheel_vel", "right_wheel_vel", "icp_x", "icp_y", "icp_yaw", "imu_yaw")
    columns = [f"{name}_{i}" for name in names for i in range(40)]
    data = np.random.default_rng(0).uniform(0.0, 1.0, (3, len(columns)))
    stored = io.BytesIO()
    np.savez(stored, data=data, columns=np.array(columns))
    check(path, zipped(data=data, columns=np.array(columns)), lambda: load_drive(tmp_path, ("warthog_sand_1",)))
    check(path, stored.getvalue(), lambda: load_drive(tmp_path, ("warthog_sand_1",), chained=True))


@pytest.mark.parametrize("packed", [True, False], ids=["packed", "text"])
def test_a_damaged_continuous_run(tmp_path, packed):
    path = tmp_path / "husky_steps_000_133.csv.gz"
    names = ["icp_quat_x", "icp_quat_y", "icp_quat_z", "icp_quat_w", "icp_pos_x", "icp_pos_y", "meas_left_vel",
             "meas_right_vel", "cmd_vel_x", "cmd_vel_omega"]
    rows = [["0"] * 10 + ["calib", str(50_000_000 * k)] for k in range(60)]
    for k, row in enumerate(rows):
        row[4] = str(0.05 * k)
    text = "\n".join(",".join(row) for row in [[*names, "calib_state", "ros_time"], *rows]).encode()
    check_packed(path, text, packed, lambda: load_drive(tmp_path, ("husky_steps_000_133",)))


@pytest.mark.parametrize("packed", [True, False], ids=["packed", "text"])
def test_damaged_motion_capture(tmp_path, packed):
    stem, odometry, truth = "MRCLAM_Dataset6_Robot1_", [], []
    for k in range(400):
        odometry.append(f"{1248297582 + 0.1 * k:.3f} 0.1 0.2")
        truth.append(f"{1248297582 + 0.1 * k:.3f} {0.01 * k:.3f} 0.0 0.5")
    for kind, lines in (("Odometry", odometry), ("Groundtruth", truth)):
        (tmp_path / f"{stem}{kind}.dat.gz").write_bytes(gzip.compress("\n".join(lines).encode()))
    check_packed(tmp_path / f"{stem}Odometry.dat.gz", "\n".join(odometry).encode(), packed,
                 lambda: load_mrclam(tmp_path, (1,)))


def number_series(held_out=False):
    t = np.arange(0.0, 1.0, 0.1)
    names = ("measured", "ideal", "initial", "fitted")
    values = {name: np.random.default_rng(1).normal(size=(10, 3)) for name in names}
    return TrialSeries("ahead_1", held_out, (0.0, 0.0, 0.0), {"ground_truth": Channel(t, values)})


@pytest.fixture
def run(tmp_path):
    """Folder of a fit: report, series and vehicle."""
    scale = {f"ground_truth.{key}": 0.01 for key in ("x", "y", "yaw")}
    scale |= {f"odometry.{key}": 0.01 for key in ("x", "y", "yaw", "v", "omega")}
    means = {"ideal": 0.3, "initial": 0.2, "fitted": 0.1}
    summary = {"ground_truth": {"trials": 1, "position": {**means, "unit": "m", "noise_floor": None}}}
    write_report(tmp_path / "report.json", {
        "schema": 1, "kind": "sysid-report", "code": {"jax": "1"},
        "dataset": {"name": "toy", "path": "nowhere", "sha256": "0" * 64, "vehicle": "toy", "notes": ["a note"],
                    "training": ["ahead_1"], "held_out": []},
        "settings": {"seed": 0}, "model": {"preset": "toy", "effects": ["lag"]},
        "noise": {"source": "replicates", "scale": scale},
        "parameters": [{"name": "body.mass", "unit": "kg", "initial": 50.0, "value": 55.0, "interval": [52.0, 58.0],
                        "confidence": 0.9, "bounds": [10.0, 100.0], "identifiable": True, "remark": ""}],
        "fixed": [], "weak_combinations": [], "spectrum": [{"information": 4.0, "combination": "+1.00 body.mass"}],
        "search": {"evaluations": 10, "seconds": 1.0, "cost_initial": 9.0, "cost": 1.0, "start_costs": [1.0, 1.01],
                   "starts_agreeing": 2, "delay_profiles": []},
        "noise_floor": {"training": None, "held_out": None}, "groups": {},
        "summary": {"training": summary, "held_out": {}},
        "errors": [{"trial": "ahead_1", "manoeuvre": "ahead", "group": "", "held_out": False,
                    "channel": "ground_truth", "metrics": {"position": means}}]})
    save(tmp_path, [number_series()])
    save_vehicle(tmp_path / "vehicle.toml", *preset("whill_cr_physical"))
    return tmp_path


def test_the_damaged_motion_beside_a_fit(run):
    path = run / "series.npz"
    check(path, path.read_bytes(), lambda: load(run))
    with zipfile.ZipFile(path) as archive:
        about = archive.read("about.npy")
        arrays = {name.removesuffix(".npy"): archive.read(name) for name in archive.namelist()}
    source = run / "about.npy"

    def pack_and_read():
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in {**arrays, "about": source.read_bytes()}.items():
                archive.writestr(f"{name}.npy", content)
        load(run)

    check(source, about, pack_and_read)


SOME = {"excess": 0.4, "common": 0.3, "smooth": 90.0}
EVIDENCE = {"schema": 2, "kind": "sysid-evidence", "excess": 0.9, "p_scan": 1e-6, "p_pairs": 0.2, "p_refit": 1e-5,
            "count": 4000.0, "trials": 12, "day": 0.05, "freedom": 12.0, "usual": 3.0, "noise": ["gyro"],
            "against": {"slope+wind": ["it is not foretold"]}, "sets": [
                {"effects": ["slope", "wind"], "variants": ["slope", "wind"], "coordinates": [0.1, 0.2], "gain": 900.0,
                 "p": [1e-6, 1e-4], "p_value": 1e-6, "left": SOME, "own": [700.0, 100.0],
                 "foretold": [[300.0], [25.0, -5.0]], "surely": [4.0, 1.5], "bent": SOME,
                 "classes": [["slope"], ["wind", "slope"]]}]}  # fmt: skip


def test_damaged_evidence_of_a_verdict(tmp_path):
    path = tmp_path / "evidence.json"

    @few(60)
    @given(damaged_table(EVIDENCE))
    def judged(content):
        path.write_bytes(content)
        with Costs():
            try:
                posterior(read_evidence(path), Thresholds())
            except ValueError as error:
                assert str(error).startswith(str(path)) and "\n" not in str(error)

    path.write_text(json.dumps(EVIDENCE))
    assert posterior(read_evidence(path), Thresholds()).verdict
    judged()


def test_the_damaged_report_of_a_fit(run):
    path = run / "report.json"
    series = [number_series()]

    def read():
        read_report(run)
        load_subject(str(run))
        write_html(run, series)

    check(path, path.read_bytes(), read)


@pytest.mark.parametrize("suffix", ["db3", "mcap"])
def test_a_damaged_recording(tmp_path, suffix):
    plugin = StoragePlugin.MCAP if suffix == "mcap" else StoragePlugin.SQLITE3
    (source,) = write_bag(tmp_path / "bag", plugin, end=1.0).glob(f"*.{suffix}")
    path = tmp_path / f"one.{suffix}"
    check(path, source.read_bytes(), lambda: read_bag(path), 15)


def test_a_damaged_model_of_a_robot(tmp_path):
    path = tmp_path / "cart.xml"
    check(path, ROBOT.encode(), lambda: load_robot(path), 25)


DRIVE = [(1.7e9 + 0.1 * k, 0.5 * (5 <= k < 25), 0.1 * (5 <= k < 25), 0.05 * min(max(k - 5, 0), 20)) for k in range(30)]
TABLES = {
    "cmd_vel.csv": "time,cmd_v,cmd_w\n" + "".join(f"{t:.1f},{v},{w}\n" for t, v, w, _ in DRIVE),
    "odom.csv": "time,odom_x,odom_y,odom_yaw,odom_v,odom_w\n"
                + "".join(f"{t:.1f},{x:.3f},0,0,{v},{w}\n" for t, v, w, x in DRIVE),
    "mocap.tum": "".join(f"{t:.1f} {x:.3f} 0 0 0 0 0 1\n" for t, _, _, x in DRIVE),
}  # fmt: skip


WHOLE = {"time": [t for t, *_ in DRIVE], "cmd_v": [v for _, v, _, _ in DRIVE], "cmd_w": [w for _, _, w, _ in DRIVE],
         **{f"{stream}_{one}": [x * (one == "x") for *_, x in DRIVE] for stream in ("odom", "gt")
            for one in ("x", "y", "yaw")}, "odom_v": [v for _, v, _, _ in DRIVE], "odom_w": [w for _, _, w, _ in DRIVE],
         "wheel_left": [3 * v for _, v, _, _ in DRIVE], "wheel_right": [3 * v for _, v, _, _ in DRIVE]}  # fmt: skip


@pytest.mark.parametrize("name", TABLES)
def test_a_damaged_table_of_a_stranger(tmp_path, name):
    folder = tmp_path / "drive"
    folder.mkdir()
    for one, text in TABLES.items():
        (folder / one).write_text(text)

    def read():
        shutil.rmtree(tmp_path / "log", ignore_errors=True)
        log, _ = convert(ConvertConfig(folder, tmp_path / "log"))
        for trial in log.trials:
            assert np.isfinite(trial.command.v).all() and (np.diff(trial.command.t) > 0).all()

    path = folder / name
    check(path, path.read_bytes(), read, 15)


@few(40)
@given(st.sets(st.sampled_from(sorted(WHOLE))), st.booleans())
def test_a_table_that_lacks_some_columns(tmp_path_factory, names, wheels):
    folder = tmp_path_factory.mktemp("table")
    path = folder / "drive.csv"
    rows = zip(*(WHOLE[name] for name in sorted(names)), strict=True)
    path.write_text("\n".join([",".join(sorted(names)), *(",".join(f"{one:.4f}" for one in row) for row in rows)]))
    config = ConvertConfig(path, folder / "log", input="wheels" if wheels else "auto")
    try:
        assert convert(config)[0].trials
    except ValueError as error:
        assert str(path) in str(error)


@pytest.mark.parametrize("name", ["meta/info.json", "meta/tasks.parquet", "data/chunk-000/file-000.parquet"])
def test_a_damaged_dataset_of_lerobot(dataset, tmp_path, name):
    pytest.importorskip("pyarrow")
    lerobot.write(tmp_path, load_log(dataset))

    def read():
        for _, table in lerobot.read(tmp_path).drives:
            assert len({len(values) for values in table.columns.values()}) == 1

    path = tmp_path / name
    check(path, path.read_bytes(), read, folder=tmp_path)


def test_a_damaged_gyro_of_a_driving_log(dataset, tmp_path):
    folder = tmp_path / "data"
    shutil.copytree(dataset, folder)
    path = folder / "trials" / "ahead_1" / "imu.csv"
    check(path, b"t,gyro\n" + b"".join(b"%.2f,0.1\n" % (0.05 * k) for k in range(30)), lambda: load_log(folder), 30)


@pytest.mark.parametrize("name", ["cart.urdf", "cart.xacro"])
def test_a_damaged_description_of_a_robot(tmp_path, name):
    path = tmp_path / name
    inertial = '<inertial><mass value="9"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    wheels = "".join(
        f'<link name="{side}">{inertial}<collision><origin rpy="1.5708 0 0"/><geometry><cylinder radius="0.1" '
        f'length="0.05"/></geometry></collision></link><joint name="{side}_wheel_joint" type="continuous"><parent '
        f'link="base"/><child link="{side}"/><origin xyz="0 {y} 0"/><axis xyz="0 1 0"/></joint>'
        for side, y in (("left", 0.25), ("right", -0.25)))
    base = (f'<link name="base">{inertial}<collision><geometry><box size="0.6 0.3 0.1"/></geometry></collision>'
            '<collision><origin xyz="0.3 0 -0.05"/><geometry><sphere radius="0.05"/></geometry></collision></link>')
    macro = '<xacro:property name="r" value="${0.05 * 2}"/>' if name.endswith("xacro") else ""
    top = ' xmlns:xacro="http://www.ros.org/wiki/xacro"' if macro else ""
    check(path, f'<robot name="cart"{top}>{macro}{base}{wheels}</robot>'.encode(), lambda: load_robot(path), 6)


def test_damaged_statistics_of_a_vehicle_file(tmp_path):
    names, channels = ("body.mass", "body.iz"), len(CHANNELS)
    whitener = Whitener(np.full(channels, 0.1), np.zeros((2, channels, channels)), np.eye(channels))
    left = Leftovers(3, 0.5, CHANNELS, whitener, np.ones((len(ROUGH) + 1, channels)), 0.2)
    table = FitStatistics(names, np.array([1.0, 2.0]), np.eye(2), left).as_table()
    path = save_vehicle(tmp_path / "vehicle.toml", *preset("whill_cr_physical"), statistics=table)
    text = path.read_text()
    start = text.index("[statistics]")

    def read():
        path.write_bytes(text[:start].encode() + source.read_bytes())
        vehicle = load_fitted(path)[1]
        if vehicle.statistics is not None:
            found = vehicle.statistics.covariance(names, np.ones(2))
            assert np.isfinite(found).all()

    source = tmp_path / "statistics"
    check(source, text[start:].encode(), read)
