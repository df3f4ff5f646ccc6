"""Loading a dataset: what is read, and one error per kind of bad input, naming file, value, rule and remedy."""

from __future__ import annotations

import json

import numpy as np
import pytest

from sysid.logs.loaders import load_any
from sysid.logs.log import load_log, load_trial
from sysid.logs.planar import integrate_speeds
from sysid.logs.records import FAR, manoeuvre_of
from sysid.logs.stream_quality import trial_quality
from whill_mjx.logs.dataset import write_csv, write_text
from whill_mjx.vehicle.model import box_inertia
from whill_mjx.vehicle.specs import HUSKY, WHILL_CR

pytestmark = pytest.mark.quick
TOML = 'schema = 1\nvehicle = "a chair"\nwheel_radius = 0.13\ntrack = 0.5\nwheelbase = 0.5\nmass = 60.0\n'


@pytest.fixture
def dataset(tmp_path):
    """Two trials: one second of standstill in the corner of a room, then straight ahead along its y axis."""
    t = np.arange(0.0, 3.0, 0.1)
    v = np.where(t > 0.95, 0.5, 0.0)
    distance = np.maximum(t - 1.0, 0.0) * 0.5
    zero = np.zeros_like(t)
    for name in ("straight_1", "straight_2"):
        folder = tmp_path / "trials" / name
        write_csv(folder / "command.csv", "t,v,omega", np.column_stack([t, v, zero]))
        write_csv(folder / "odometry.csv", "t,x,y,yaw,v,omega", np.column_stack([t, distance, zero, zero, v, zero]))
        yaw = np.full_like(t, np.pi / 2)
        write_csv(folder / "ground_truth.csv", "t,x,y,yaw", np.column_stack([t, zero + 2.0, distance - 1.0, yaw]))
    write_text(tmp_path / "dataset.toml", TOML + 'held_out = ["straight_2"]\n')
    return tmp_path


def replace_in(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_a_dataset_is_read_with_spec_start_pose_and_held_out_trials(dataset):
    log = load_log(dataset)
    assert (log.spec.track, log.spec.mass, log.spec.drive) == (0.5, 60.0, "differential")
    assert [trial.name for trial in log.training] == ["straight_1"]
    assert [trial.name for trial in log.held_out] == ["straight_2"]
    start = log.trials[0].start
    np.testing.assert_allclose([start.x, start.y, start.yaw], [2.0, -1.0, np.pi / 2], atol=1e-5)


def test_rows_that_were_held_between_updates_are_scored_once(dataset):
    """Each row of both streams three times, 0.03 s apart, as a recorder repeats them that is quicker than they are."""
    folder = dataset / "trials" / "straight_1"
    plain = load_any(dataset).trials[0]
    for file in ("odometry.csv", "ground_truth.csv"):
        header, *rows = (folder / file).read_text().splitlines()
        table = np.array([row.split(",") for row in rows], float)
        more = np.repeat(table, 3, axis=0)
        more[:, 0] += np.tile([0.0, 0.03, 0.06], len(table))
        write_csv(folder / file, header, more)
    log, inspected = load_any(dataset), load_log(dataset)
    for name in ("odometry", "ground_truth"):
        found, whole, expected = (getattr(one, name) for one in (log.trials[0], inspected.trials[0], plain))
        driven, once = found.t > 1.05, expected.t > 1.05
        assert driven.sum() == 19
        np.testing.assert_allclose(found.t[driven], expected.t[once], atol=1e-6)
        np.testing.assert_allclose(found.x[driven], expected.x[once], atol=1e-5)
        # At rest a vehicle rightly repeats its row.
        assert (found.t < 0.95).sum() == (whole.t < 0.95).sum() == 29 and len(whole.t) == 90
        assert trial_quality(inspected.trials[0])[name].held > 0.5  # what inspect tells
    assert any("not scored again" in note for note in log.notes) and not inspected.notes


@pytest.mark.parametrize("slides", [1.0, 0.6])
def test_a_heading_keeps_its_full_turns_over_a_gap(dataset, slides):
    """Five seconds of a turn on the spot at 1.2 rad/s are lost, of both streams or of the outside pose."""
    folder = dataset / "trials" / "straight_1"
    t = np.arange(0.0, 20.0, 0.1)
    omega, zero = np.where(t > 1.0, 1.2, 0.0), np.zeros_like(t)
    yaw = np.append(0.0, np.cumsum(omega[:-1] * 0.1))
    kept = (t < 6.0) | (t > 11.0)
    write_csv(folder / "command.csv", "t,v,omega", np.column_stack([t, zero, omega]))
    body = slides * yaw
    wrapped = np.angle(np.exp(1j * body))
    write_csv(folder / "ground_truth.csv", "t,x,y,yaw", np.column_stack([t, zero, zero, wrapped])[kept])
    for rows in (slice(None), kept):
        table = np.column_stack([t, zero, zero, np.angle(np.exp(1j * yaw)), zero, omega])
        write_csv(folder / "odometry.csv", "t,x,y,yaw,v,omega", table[rows])
        trial = load_log(dataset).trials[0]
        assert trial.odometry.yaw[-1] == pytest.approx(yaw[-1], abs=1e-3)
        assert trial.ground_truth.yaw[-1] == pytest.approx(body[-1], abs=1e-3)
    (folder / "odometry.csv").unlink()
    assert load_log(dataset).trials[0].ground_truth.yaw[-1] == pytest.approx(body[-1], abs=1e-3)


def test_odometry_is_counted_from_the_start_of_the_drive(dataset):
    folder = dataset / "trials" / "straight_1"
    t = np.arange(0.0, 3.0, 0.1)
    distance = np.maximum(t - 1.0, 0.0) * 0.5
    table = np.column_stack([t, 0 * t + 7.0, distance - 3.0, 0 * t + np.pi / 2, 0 * t, 0 * t])
    write_csv(folder / "odometry.csv", "t,x,y,yaw,v,omega", table)
    odometry = load_log(dataset).trials[0].odometry
    np.testing.assert_allclose(odometry.x, distance, atol=1e-5)
    np.testing.assert_allclose(odometry.y, 0.0, atol=1e-5)


def test_the_start_pose_does_not_look_beyond_the_standstill(dataset):
    before = load_log(dataset).trials[0].start
    path = dataset / "trials" / "straight_1" / "ground_truth.csv"
    lines = path.read_text().splitlines()
    lines[20:] = [",".join([line.split(",")[0], "2.5", *line.split(",")[2:]]) for line in lines[20:]]
    path.write_text("\n".join(lines) + "\n")
    assert load_log(dataset).trials[0].start == before


@pytest.mark.parametrize("begin", [-4.0, 2.5, 36_000.0])
def test_a_trial_starts_with_its_first_row_whatever_its_time_counts_from(dataset, begin):
    """Times before a trigger, or of the day: a replay begins at 0, and a late one would be cut into empty windows."""
    plain = load_any(dataset).trials[0]
    for path in (dataset / "trials" / "straight_1").glob("*.csv"):
        header, *rows = path.read_text().splitlines()
        cells = [row.split(",") for row in rows]
        moved = [",".join([f"{float(t) + begin:.6f}", *more]) for t, *more in cells]
        path.write_text("\n".join([header, *moved]) + "\n")
    later = load_any(dataset).trials[0]
    assert later.name == plain.name and later.start == plain.start
    for name in ("command", "odometry", "ground_truth"):
        np.testing.assert_allclose(getattr(later, name).t, getattr(plain, name).t, atol=1e-6)


@pytest.mark.parametrize("before", [0.5, 0.0])
def test_a_vehicle_that_already_moves_before_its_first_command_starts_in_motion(dataset, before):
    folder = dataset / "trials" / "straight_1"
    t = np.arange(0.0, 3.0, 0.1)
    late = t[3:] - 0.05
    write_csv(folder / "command.csv", "t,v,omega", np.column_stack([late, 0 * late + 0.5, 0 * late]))
    v = np.where(t > late[0], 0.5, before)
    v[0] += 0.05  # noise
    write_csv(folder / "odometry.csv", "t,x,y,yaw,v,omega", np.column_stack([t, 0.5 * t, 0 * t, 0 * t, v, 0 * t]))
    assert load_log(dataset).trials[0].start.v == pytest.approx(before)


def test_a_room_of_a_national_grid_is_counted_from_near_the_drives(dataset):
    """Single precision has steps of 0.03 m at 400 km: a replay there would stand still."""
    plain = load_any(dataset)
    for path in dataset.glob("trials/*/ground_truth.csv"):
        header, *rows = path.read_text().splitlines()
        cells = [row.split(",") for row in rows]
        moved = [f"{t},{float(x) + 400_003.0:.6f},{float(y) + 5_420_017.0:.6f},{yaw}" for t, x, y, yaw in cells]
        path.write_text("\n".join([header, *moved]) + "\n")
    far = load_any(dataset)
    assert any("counted from x 4000" in note for note in far.notes) and not any("counted" in n for n in plain.notes)
    for mine, theirs in zip(far.trials, plain.trials, strict=True):
        assert max(abs(mine.start.x), abs(mine.start.y)) < FAR
        np.testing.assert_allclose(mine.ground_truth.x - mine.start.x, theirs.ground_truth.x - theirs.start.x,
                                   atol=1e-5)
        np.testing.assert_allclose(mine.start.x - far.trials[0].start.x, theirs.start.x - plain.trials[0].start.x,
                                   atol=1e-5)


def test_replicates_share_the_name_before_the_number():
    assert manoeuvre_of("figure_eight_12") == "figure_eight"
    assert manoeuvre_of("circle") == "circle"


def test_a_missing_mass_is_assumed_and_noted(dataset):
    replace_in(dataset / "dataset.toml", "mass = 60.0\n", "")
    log = load_log(dataset)
    assert any("mass" in note and "whill_cr" in note for note in log.notes)
    assert log.spec.mass == pytest.approx(WHILL_CR.mass * (log.spec.track / WHILL_CR.track) ** 3)


@pytest.mark.parametrize(("drive", "like"), [("differential", WHILL_CR), ("skid", HUSKY)])
def test_a_vehicle_that_is_not_built_in_has_the_proportions_of_one_that_is(dataset, drive, like):
    """Half as large in all directions, it has half the lengths and an eighth of the mass."""
    sizes = {"wheel_radius": like.wheel_radius / 2, "track": like.track / 2, "wheelbase": like.wheelbase / 2}
    fields = {"schema": 1, "vehicle": "a small one", "drive": drive, **sizes}
    (dataset / "dataset.toml").write_text("".join(f"{name} = {json.dumps(value)}\n" for name, value in fields.items()))
    spec = load_log(dataset).spec
    assert spec.drive == drive and spec.mass == pytest.approx(like.mass / 8)
    assert spec.wheel_inertia == pytest.approx(like.wheel_inertia / 32)
    for length in ("body_length", "body_width", "body_height", "rear_x", "front_x"):
        assert getattr(spec, length) == pytest.approx(getattr(like, length) / 2), length
    np.testing.assert_allclose(box_inertia(spec), np.array(box_inertia(like)) / 32)


BAD_TOML = {
    "no schema": ("schema = 1", "", "schema is None"),
    "newer schema": ("schema = 1", "schema = 2", "schema is 2"),
    "unknown field": ("mass = 60.0", "weight = 60.0", "unknown field 'weight'"),
    "unknown drive": ("mass = 60.0", 'drive = "ackermann"', "'ackermann'"),
    "unknown axle": ("mass = 60.0", 'driven_axle = "middle"', "'middle'"),
    "vehicle no text": ('vehicle = "a chair"', "vehicle = 3", "vehicle is 3"),
    "no track": ("track = 0.5", "", "no track"),
    "track in mm": ("track = 0.5", "track = 500.0", "track is 500"),
    "negative mass": ("mass = 60.0", "mass = -60.0", "mass is -60"),
    "unknown reference": ("mass = 60.0", 'reference_point = "camera"', "'camera'"),
    "bad limits": ("mass = 60.0", "command_limits = [1.0]", "command_limits"),
    "held out of nothing": ('"straight_2"', '"straight_9"', "straight_9"),
    "track no number": ("track = 0.5", "track = true", "track is True; it must be a number"),
    "track endless": ("track = 0.5", "track = inf", "track is inf; it must be positive, from 0.01 to 5 m"),
    "huge integer": ("mass = 60.0", "mass = 1" + "0" * 400, "mass is an integer of about 398 digits"),
    "longer integer": ("mass = 60.0", "mass = 1" + "0" * 5000, "not valid TOML"),
    "nested": ("mass = 60.0", "mass = " + "[" * 5000, "nested too deep"),
    "held out no list": ('["straight_2"]', "3", "held_out is 3; it must be a list of texts"),
    "held out numbers": ('["straight_2"]', "[1]", "held_out[0] is 1; it must be a text"),
    "negative limits": ("mass = 60.0", "command_limits = [1.0, -1.0]", "command_limits[1] is -1.0; it must be "),
    "schema true": ("schema = 1", "schema = true", "schema is True"),
    "long key": ("mass = 60.0", "a." * 200 + "b = 1", "a key of a hundred parts"),
    "NUL byte": ("a chair", "a\0chair", "NUL byte"),
    "not toml": ("schema = 1", "schema: 1", "not valid TOML"),
}


@pytest.mark.parametrize("case", BAD_TOML)
def test_a_bad_description_is_named_with_file_and_value(dataset, case):
    old, new, message = BAD_TOML[case]
    replace_in(dataset / "dataset.toml", old, new)
    with pytest.raises(ValueError, match="dataset.toml") as caught:
        load_log(dataset)
    assert message in str(caught.value)


BAD_CSV = {
    "missing column": ("ground_truth.csv", "t,x,y,yaw", "t,x,y,heading", "no column 'yaw'"),
    "nan": ("odometry.csv", "0.1,0,0,0,0,0", "0.1,nan,0,0,0,0", "line 3: x is nan"),
    "text with more in it": ("odometry.csv", "0.1,0,0,0,0,0", "0.1,0,0,0,1_0,0", "v is '1_0'"),
    "decimal commas": ("command.csv", "1,0.5,0", "1,0,5,0", "line 12: has 4 cells, the header 3"),
    "quoted decimal comma": ("command.csv", "1,0.5,0", '1,"0,5",0', "v is '0,5'"),
    "column twice": ("command.csv", "t,v,omega", "t,v,v", "more than one column 'v'"),
    "semicolons": ("command.csv", "t,v,omega", "t;v;omega", "separated by commas"),
    "open quote": ("command.csv", "1,0.5,0", '1,"0.5,0', "a quote is not closed"),
    "huge number": ("command.csv", "1,0.5,0", "1,1e400,0", "v is inf; it must be finite"),
    "NUL byte": ("command.csv", "0.2,0,0", "0.2,\0,0", "line 4: has a NUL byte"),
    "huge header": ("command.csv", "t,v,omega", "t,v,omega" + "x" * 200_000, "at most 100000 are read"),
    "text": ("odometry.csv", "0.1,0,0,0,0,0", "0.1,left,0,0,0,0", "x is 'left'"),
    "short row": ("odometry.csv", "0.1,0,0,0,0,0", "0.1,0", "y is ''"),
    "time backwards": ("command.csv", "0.2,0,0", "0.05,0,0", "it must increase"),
    "unix time": ("command.csv", "2.9,0.5,0", "1700000000,0.5,0", "seconds from the trial's start"),
    "speed in mm/s": ("command.csv", "2.9,0.5,0", "2.9,500,0", "v is 500"),
    "yaw rate in deg/s": ("odometry.csv", "0.1,0,0,0,0,0", "0.1,0,0,0,0,45", "omega is 45"),
    "yaw in degrees": ("ground_truth.csv", "2,-1,1.570796", "2,-1,91.3", "yaw spans"),
    "position in mm": ("ground_truth.csv", "2,-1,1.570796", "2000,-1,1.570796", "x spans"),
}


@pytest.mark.parametrize("case", BAD_CSV)
def test_a_bad_table_is_named_with_file_and_value(dataset, case):
    name, old, new, message = BAD_CSV[case]
    replace_in(dataset / "trials" / "straight_1" / name, old, new)
    with pytest.raises(ValueError, match=name) as caught:
        load_log(dataset)
    assert message in str(caught.value)


@pytest.mark.parametrize("name", ["dataset.toml", "trials/straight_1/command.csv"])
def test_files_with_a_byte_order_mark_or_other_line_ends_or_blank_lines_are_read(dataset, name):
    before = load_log(dataset)
    path = dataset / name
    text = path.read_text()
    for data in (b"\xef\xbb\xbf" + text.encode(), text.replace("\n", "\r\n").encode(), (text + "\n\n \n").encode(),
                 text.replace("\n", "\r").encode()):
        path.write_bytes(data)
        after = load_log(dataset)
        assert after.spec == before.spec
        np.testing.assert_array_equal(after.trials[0].command.v, before.trials[0].command.v)


@pytest.mark.parametrize("name", ["dataset.toml", "trials/straight_1/command.csv"])
@pytest.mark.parametrize("encoding", ["latin-1", "utf-16"])
def test_a_file_in_another_encoding_is_named(dataset, name, encoding):
    path = dataset / name
    path.write_bytes((path.read_text() + "# Stra\xdfe\n").encode(encoding))
    with pytest.raises(ValueError, match=f"{name}, line .*is not UTF-8. Save the file as UTF-8"):
        load_log(dataset)


def test_missing_parts_of_a_dataset_are_named(dataset):
    trial = dataset / "trials" / "straight_1"
    (trial / "odometry.csv").unlink()
    assert load_log(dataset).trials[0].odometry is None
    (trial / "ground_truth.csv").unlink()
    with pytest.raises(ValueError, match="neither odometry.csv nor ground_truth.csv"):
        load_log(dataset)
    (trial / "command.csv").write_text("t,v,omega\n")
    with pytest.raises(ValueError, match="0 rows of data"):
        load_log(dataset)
    (trial / "command.csv").unlink()
    with pytest.raises(FileNotFoundError, match="command.csv"):
        load_log(dataset)
    (dataset / "dataset.toml").unlink()
    with pytest.raises(FileNotFoundError, match="dataset.toml"):
        load_log(dataset)
    with pytest.raises(FileNotFoundError, match="no such folder"):
        load_log(dataset / "nowhere")


def test_a_dataset_without_trials_is_an_error(tmp_path):
    write_text(tmp_path / "dataset.toml", TOML)
    with pytest.raises(ValueError, match="no trial in it"):
        load_log(tmp_path)


def test_the_hash_tells_changed_data(dataset):
    before = load_log(dataset).sha256
    replace_in(dataset / "trials" / "straight_1" / "command.csv", "2.9,0.5,0", "2.9,0.4,0")
    assert load_log(dataset).sha256 != before


@pytest.mark.parametrize(("unit", "factor", "said"), [
    ("milliseconds", 1e3, "seems to be in milliseconds. Divide t by 1000"),
    ("microseconds", 1e6, "divide milli-, micro- or nanoseconds"),
    ("nanoseconds", 1e9, "seconds")])
def test_times_in_another_unit_than_seconds_are_named_at_once(dataset, unit, factor, said):
    for file in (dataset / "trials" / "straight_1").glob("*.csv"):
        header, *rows = file.read_text().splitlines()
        table = np.array([row.split(",") for row in rows], float)
        write_csv(file, header, np.column_stack([factor * table[:, 0], table[:, 1:]]))
    with pytest.raises(ValueError, match=f"straight_1.*{said}"):
        load_log(dataset)


@pytest.mark.parametrize("streams", [("odometry",), ("ground_truth",), ("odometry", "ground_truth")])
@pytest.mark.parametrize(("rate", "unit"), [(500, 1e3), (1000, 1e3), (20, 1.0), (1, 1.0)])
def test_milliseconds_of_a_quick_log_are_refused_by_the_way_that_was_driven(tmp_path, streams, rate, unit):
    t = np.arange(0.0, 20.0 if rate > 1 else 300.0, 1 / rate)
    v, omega = 0.4 + 0.1 * np.sin(t / 3), 0.2 * np.sin(t / 5)
    x, y, yaw = integrate_speeds(t, v, omega)
    x = x + np.random.default_rng(0).normal(0, 0.002, len(t))
    tables = {"command": ("t,v,omega", (v, omega)), "odometry": ("t,x,y,yaw,v,omega", (x, y, yaw, v, omega)),
              "ground_truth": ("t,x,y,yaw", (x, y, yaw))}
    folder = tmp_path / "circle_1"
    folder.mkdir()
    for name in ("command", *streams):
        head, columns = tables[name]
        np.savetxt(folder / f"{name}.csv", np.column_stack([unit * t, *columns]), "%.6f", ",", header=head, comments="")
    if unit == 1.0:
        assert load_trial(folder).duration == pytest.approx(t[-1])
        return
    with pytest.raises(ValueError, match=f"{streams[0]}.csv: the speeds give .*t seems to be in milliseconds. Divide"):
        load_trial(folder)
