"""LeRobotDataset in and out: a round trip, somebody else's features, and what cannot be read."""

from __future__ import annotations

import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

import sysid
from sysid.convert import main
from sysid.logs.conversion import ConvertConfig, convert
from sysid.logs.lerobot import DATA
from sysid.logs.log import load_log
from sysid.logs.sources import LEROBOT_INFO as INFO
from sysid.logs.sources import about
from whill_mjx.io.command_line import OptionError

pytestmark = pytest.mark.quick
CHAIR = Path(sysid.__file__).parent / "data" / "chair"
DRIVES = ("figure_eight_1", "straight_1", "turn_1")


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """Some of the chair's drives."""
    folder = tmp_path_factory.mktemp("source") / "chair"
    for name in DRIVES:
        shutil.copytree(CHAIR / "trials" / name, folder / "trials" / name)
    text = (CHAIR / "dataset.toml").read_text()
    (folder / "dataset.toml").write_text(re.sub(r"held_out = .*", 'held_out = ["figure_eight_1"]', text))
    return folder


@pytest.fixture(scope="module")
def written(source, tmp_path_factory):
    """The same as a LeRobotDataset."""
    pytest.importorskip("pyarrow")
    out = tmp_path_factory.mktemp("lerobot") / "chair"
    main(ConvertConfig(source, out, to="lerobot", fps=50))
    return out


def test_drives_come_back_with_names_geometry_and_held_out_trials(source, written, tmp_path):
    log, _ = convert(ConvertConfig(written, tmp_path / "log"))
    chair = load_log(source)
    assert [trial.name for trial in log.trials] == [trial.name for trial in chair.trials]
    assert [trial.name for trial in log.held_out] == [trial.name for trial in chair.held_out]
    assert (log.spec.wheel_radius, log.spec.track, log.spec.mass) == (
        chair.spec.wheel_radius, chair.spec.track, chair.spec.mass)
    for one, other in zip(log.trials, chair.trials, strict=True):
        for stream in ("odometry", "ground_truth"):
            mine, theirs = getattr(one, stream), getattr(other, stream)
            begin = max(other.odometry.t[0], other.ground_truth.t[0])
            for column in ("x", "y", "yaw"):
                expected = np.interp(mine.t + begin, theirs.t, getattr(theirs, column))
                np.testing.assert_allclose(getattr(mine, column), expected, atol=2e-3)
    changes = [trial.command.t[1:][np.diff(trial.command.v) != 0] for trial in (log.trials[0], chair.trials[0])]
    np.testing.assert_allclose(*changes, atol=0.011)  # half a frame


def test_the_dataset_is_exported_whole_and_its_notes_are_printed(source, tmp_path, capsys):
    folder = shutil.copytree(source, tmp_path / "long")
    for file in (folder / "trials" / "turn_1").glob("*.csv"):  # the same drive 20 times as slow
        names, *rows = file.read_text().splitlines()
        cells = [row.split(",") for row in rows]
        slow = [",".join([f"{20 * float(one[0]):.6f}", *one[1:]]) for one in cells]
        file.write_text("\n".join([names, *slow]) + "\n")
    standing = folder / "trials" / "straight_1" / "odometry.csv"
    t, *_ = np.loadtxt(standing, delimiter=",", skiprows=1).T
    np.savetxt(standing, np.column_stack([t] + 5 * [0 * t]), delimiter=",", header="t,x,y,yaw,v,omega", comments="")
    truth = standing.with_name("ground_truth.csv")
    t, *_ = np.loadtxt(truth, delimiter=",", skiprows=1).T
    np.savetxt(truth, np.column_stack([t] + 3 * [0 * t]), delimiter=",", header="t,x,y,yaw", comments="")
    (folder / "dataset.toml").write_text('input = "wheels"\n' + (folder / "dataset.toml").read_text())
    main(ConvertConfig(folder, tmp_path / "out", to="lerobot", fps=10))
    assert "measured wheel speeds, not commands" in capsys.readouterr().out
    log, _ = convert(ConvertConfig(tmp_path / "out", tmp_path / "back"))
    durations = {trial.name: trial.duration for trial in log.trials}
    assert sorted(durations) == sorted(DRIVES) and durations["turn_1"] > 150


def test_the_layout_is_that_of_version_3(written):
    import pyarrow.parquet as pq

    info = json.loads((written / INFO).read_text())
    rows = pq.read_table(written / DATA.format(chunk_index=0, file_index=0))
    episodes = pq.read_table(written / "meta/episodes/chunk-000/file-000.parquet").to_pydict()
    tasks = pq.read_table(written / "meta/tasks.parquet")
    assert info["codebase_version"] == "v3.0" and info["data_path"] == DATA
    assert set(rows.column_names) == set(info["features"]) == set(json.loads((written / "meta/stats.json").read_text()))
    assert rows.num_rows == info["total_frames"] == episodes["dataset_to_index"][-1] == sum(episodes["length"])
    assert rows.column("index").to_pylist() == list(range(rows.num_rows))
    assert str(rows.schema.field("action").type).startswith("fixed_size_list")
    assert len(episodes["tasks"]) == info["total_episodes"] and tasks.num_rows == info["total_tasks"]
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]


def foreign(folder, names, unit=1.0, version="v3.0"):
    """Somebody's dataset: a mobile base with an arm and a camera; theta.vel in 1 / `unit` rad/s."""
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    tables = []
    for number, trial in enumerate(load_log(CHAIR).trials[:2]):
        o = trial.odometry
        held = np.searchsorted(trial.command.t, o.t + 1e-9, side="right") - 1
        v, omega = trial.command.v[held], trial.command.omega[held] / unit
        none = 0 * v
        state = np.column_stack([none, o.v, none, o.omega / unit, o.x, o.y, o.yaw])
        tables.append(pa.table({"action": np.column_stack([none, v, none, omega]).tolist(),
                                "observation.state": state.tolist(), "timestamp": o.t - o.t[0],
                                "frame_index": np.arange(len(v)), "episode_index": np.full(len(v), number),
                                "task_index": np.zeros(len(v), int)}))
    whole = {"action": (4, names[:4]), "observation.state": (7, names), "timestamp": (1, None)}
    features = {name: {"dtype": "float32", "shape": [size], "names": part} for name, (size, part) in whole.items()}
    features["observation.images.front"] = {"dtype": "video", "shape": [480, 640, 3], "names": None}
    (folder / "meta").mkdir(parents=True)
    (folder / INFO).write_text(json.dumps({"codebase_version": version, "fps": 20, "features": features,
                                           "splits": {"train": "0:2"}}))
    (folder / "data/chunk-000").mkdir(parents=True)
    for number, table in enumerate(tables):
        pq.write_table(table, folder / f"data/chunk-000/file-{number:03d}.parquet")
    pq.write_table(pa.table({"task_index": [0], "__index_level_0__": ["Drive to the door"]}),
                   folder / "meta/tasks.parquet")
    return folder


NAMES = ["arm_gripper.pos", "x.vel", "y.vel", "theta.vel", "x.pos", "y.pos", "theta.pos"]


@pytest.mark.parametrize("unit", [1.0, np.pi / 180])
def test_features_of_a_mobile_base_are_found_by_their_names_and_units_by_their_numbers(tmp_path, unit):
    log, notes = convert(ConvertConfig(foreign(tmp_path / "base", NAMES, unit), tmp_path / "log"))
    assert [trial.name for trial in log.trials] == ["Drive_to_the_door_1", "Drive_to_the_door_2"]
    for one, other in zip(log.trials, load_log(CHAIR).trials, strict=False):
        np.testing.assert_allclose(one.odometry.omega, other.odometry.omega, atol=1e-4)
        np.testing.assert_allclose(one.odometry.x, other.odometry.x, atol=2e-3)
        assert np.abs(one.command.omega).max() == pytest.approx(np.abs(other.command.omega).max(), abs=1e-4)
    assert any("observation.images.front" in note for note in notes)


def test_features_without_names_ask_for_columns_and_take_them(tmp_path):
    folder = foreign(tmp_path / "base", None or [f"motor_{k}" for k in range(7)])
    with pytest.raises(ValueError, match="Its columns are .*frames/action/motor_1.*Give --columns"):
        convert(ConvertConfig(folder, tmp_path / "log"))
    said = ("command.v=action/motor_1:m/s", "command.omega=action/motor_3:rad/s",
            "odometry.v=observation.state/motor_1:m/s", "odometry.omega=observation.state/motor_3:rad/s")
    log, _ = convert(ConvertConfig(folder, tmp_path / "log", columns=said))
    np.testing.assert_allclose(log.trials[0].odometry.v, load_log(CHAIR).trials[0].odometry.v, atol=1e-4)


def test_what_cannot_be_read_is_said_in_one_line_and_nothing_is_written(tmp_path, monkeypatch):
    folder = foreign(tmp_path / "base", NAMES)
    assert "LeRobotDataset" in about(folder) and "sysid.convert" in about(folder)
    (folder / "meta/info.json").rename(folder / "info.json")
    assert about(folder) == "a LeRobotDataset without meta/info.json. Copy its folder meta too."
    (folder / "info.json").rename(folder / "meta/info.json")
    (folder / "data/chunk-000/file-000.parquet").write_bytes(b"PAR1 no more")
    with pytest.raises(ValueError, match="file-000.parquet: is no whole parquet file"):
        convert(ConvertConfig(folder, tmp_path / "log"))
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ValueError, match="needs the package pyarrow, .* Install it: pip install"):
        convert(ConvertConfig(folder, tmp_path / "log"))
    with pytest.raises(OptionError, match="^writing a LeRobotDataset needs the package pyarrow"):
        main(ConvertConfig(CHAIR, tmp_path / "out", to="lerobot"))
    assert not (tmp_path / "log").exists() and not (tmp_path / "out").exists()
    assert not list(tmp_path.glob(".*"))
