"""The time-out of a base, from pauses of the commands: its size and interval, and replays that stop with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sysid.logs.command_timeout import command_timeout, with_own_timeout
from sysid.logs.loaders import load_any
from sysid.logs.log import load_log, make_trial
from sysid.logs.records import Command, OdometryStream, with_timeout
from whill_mjx.logs.dataset import COMMAND_HEADER, ODOMETRY_HEADER, write_csv, write_text

pytestmark = pytest.mark.quick
DT = 0.01  # s


def drive(timeout, seed, delay=0.12, lag=0.2, period=0.1, rate=20.0, noise=0.005, turning=False):
    """A drive with two pauses of the commands, by a vehicle that follows late and slowly."""
    random = np.random.default_rng(seed)
    begins = 6.0 + np.array([0.0, 8.0]) + random.uniform(0, period, 2)
    sent = np.arange(0.0, 22.0, period) + random.uniform(-0.01, 0.01, round(22.0 / period))
    for begin in begins:
        sent = sent[(sent <= begin) | (sent >= begin + 3)]
    speed = np.where((sent > 1.0) & (sent < 20.0), 0.5, 0.0)
    command = Command(sent, 0 * sent if turning else speed, speed if turning else 0 * sent)
    return followed(command, timeout, random, 22.0, delay, lag, rate, noise)


def presses(timeout, seed, lag=0.2, sizes=(0.5, -0.5), turning=False):
    """A drive by 18 commands some 3 s apart, as of a person that presses keys."""
    random = np.random.default_rng(seed)
    sent = 1.0 + 3.0 * np.arange(18) + random.uniform(-0.2, 0.2, 18)
    speed = random.choice(sizes, 18)
    command = Command(sent, 0 * sent if turning else speed, speed if turning else 0 * sent)
    return followed(command, timeout, random, sent[-1] + 3.0, 0.12, lag, 20.0, 0.005)


def followed(command, timeout, random, end, delay, lag, rate, noise):
    """The trial of a vehicle that follows commands for v or for omega late and slowly."""
    turning = bool(np.any(command.omega))
    held = with_timeout(command, timeout) if np.isfinite(timeout) else command
    t = np.arange(0.0, end, DT)
    rows = np.searchsorted(held.t, t - delay, side="right") - 1
    target = np.where(rows >= 0, (held.omega if turning else held.v)[np.maximum(rows, 0)], 0.0)
    speed = np.zeros_like(t)
    for k in range(len(t) - 1):
        speed[k + 1] = speed[k] + DT / lag * (target[k] - speed[k])
    way = np.cumsum(speed) * DT
    seen = np.arange(0.0, end - 0.1, 1 / rate)
    x, v = np.interp(seen, t, way), np.interp(seen, t, speed) + noise * random.standard_normal(len(seen))
    odometry = (OdometryStream(seen, 0 * x, 0 * x, x, 0 * v, v) if turning else
                OdometryStream(seen, x, 0 * x, 0 * x, v, 0 * v))
    return make_trial(f"drive_{random.integers(10**6)}", command, odometry, None)


@pytest.mark.parametrize("turning", [False, True])
@pytest.mark.parametrize("timeout", [0.25, 0.5, 1.0])
def test_the_time_out_is_found_with_an_interval_that_has_it(timeout, turning):
    found = command_timeout([drive(timeout, seed, turning=turning) for seed in range(3)])
    assert found.stops == 6 and found.trials == 3
    assert found.low <= timeout <= found.high
    assert found.value == pytest.approx(timeout, abs=0.03) and found.high - found.low < 0.12


def test_the_interval_holds_the_truth_about_as_often_as_it_says():
    hits = []
    for seed in range(40):
        found = command_timeout([drive(0.5, 100 + seed, rate=10.0)])
        hits.append(found.low <= 0.5 <= found.high)
    assert np.mean(hits) > 0.85


def test_a_base_that_drives_on_has_none():
    assert command_timeout([drive(np.inf, 1)]) is None


@pytest.mark.parametrize("turning", [False, True])
@pytest.mark.parametrize(("timeout", "lag"), [(0.3, 0.1), (0.6, 0.1), (0.6, 0.2), (1.0, 0.2), (1.5, 0.3)])
def test_the_time_out_of_a_base_driven_by_key_presses_is_found(timeout, lag, turning):
    found = command_timeout([presses(timeout, seed, lag, turning=turning) for seed in range(2)])
    assert found.stops >= 32 and found.low - 0.01 <= timeout <= found.high + 0.01
    assert found.value == pytest.approx(timeout, abs=0.02)


@pytest.mark.parametrize("sizes", [(0.5, -0.5), (0.5, 0.05), (0.5, 0.06, -0.3)])
def test_a_base_that_drives_on_between_rare_commands_has_none(sizes):
    assert command_timeout([presses(np.inf, seed, sizes=sizes) for seed in range(3)]) is None


def test_rare_commands_in_a_dead_zone_show_no_time_out():
    trials = []
    for seed in range(3):
        trial = presses(np.inf, seed, sizes=(0.5, 0.3, 0.06))
        dead = np.abs(trial.command.v) < 0.1
        command = trial.command
        stands = followed(Command(command.t, np.where(dead, 0.0, command.v), command.omega), np.inf,
                          np.random.default_rng(seed), float(command.t[-1]) + 3.0, 0.12, 0.2, 20.0, 0.005)
        trials.append(replace(stands, command=command))
    assert command_timeout(trials) is None


def test_a_vehicle_that_stops_before_it_reaches_its_commands_shows_no_size_of_its_time_out():
    assert command_timeout([presses(0.3, 1, lag=0.5)]) is None


def write(folder, trials, fields=""):
    write_text(folder / "dataset.toml", f'schema = 1\nvehicle = "a base"\nwheel_radius = 0.1\ntrack = 0.4\n{fields}')
    for trial in trials:
        write_csv(folder / f"trials/{trial.name}/command.csv", COMMAND_HEADER, trial.command.table)
        write_csv(folder / f"trials/{trial.name}/odometry.csv", ODOMETRY_HEADER,
                  np.column_stack([trial.odometry.t, trial.odometry.values]))
    return folder


def test_fits_take_it_from_the_log_unless_it_is_stated(tmp_path):
    trials = [drive(0.5, seed) for seed in range(2)]
    found = load_any(write(tmp_path / "found", trials))
    stated = load_any(write(tmp_path / "stated", trials, "command_timeout = 0.7\n"))
    value, low, high = found.fields["found_timeout"]
    assert low < value < high and any("stops by itself" in note for note in found.notes)
    for log, timeout in ((found, value), (stated, 0.7)):
        command = log.trials[0].command
        pause = np.flatnonzero((command.v[:-1] > 0) & (command.v[1:] == 0))[0]
        assert command.t[pause + 1] - command.t[pause] == pytest.approx(timeout, abs=1e-5)
    assert "found_timeout" not in stated.fields
    plain = load_log(tmp_path / "found")
    assert with_own_timeout(plain.select(lambda trial: False)).fields == plain.fields  # nothing shows it
