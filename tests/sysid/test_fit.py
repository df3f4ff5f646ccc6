"""The whole fit with the simulator's vehicle: planted truth comes back, and the written files say so."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

import sysid.fit as fit_module
from benchmarks.planted_logs import Schedule, write_dataset
from sysid.logs.log import load_log
from sysid.pages.fit_report import fit_dataset
from sysid.pages.report import REPLAYS
from sysid.replay.rollout import vehicle_plant
from sysid.search import fitting
from sysid.search.fitting import fit_log, subject
from sysid.search.settings import FitConfig
from whill_mjx.logs.dataset import SensorNoise
from whill_mjx.logs.manoeuvres import Scenario
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.parameters import get_values, set_values
from whill_mjx.vehicle.presets import preset_params
from whill_mjx.vehicle.specs import WHILL_CR
from whill_mjx.vehicle.vehicle_file import load_vehicle

PLANTED = {"body.yaw_inertia": 4.0, "body.com_x": -0.1, "pid_drive.kp": 6.0, "pid_drive.ki": 2.0,
           "lateral_damping.c_front": 1.0, "rolling_resistance.mu_r": 0.02}


@pytest.fixture(scope="module")
def planted(tmp_path_factory):
    """Dataset, run folder and report of a fit of PLANTED, started at the paper's initial values."""
    folder = tmp_path_factory.mktemp("planted")
    initial = preset_params(WHILL_CR, "paper")
    truth = set_values(initial, tuple(PLANTED), np.array(list(PLANTED.values()), np.float32))
    plant = vehicle_plant(WHILL_CR, VehicleConfig(physics_dt=0.01))  # the step is part of the model
    write_dataset(folder / "log", WHILL_CR, truth,
                  Schedule(replicates=2, seed=5, scenario=Scenario(v=0.5, omega=1.6, length=4.0)),
                  noise=SensorNoise(), plant=plant)
    config = FitConfig(preset="paper", iterations=20, parameters=tuple(PLANTED), physics_dt=0.01)
    report = fit_dataset(folder / "log", folder / "run", config=config)
    return folder, report


def test_held_out_error_comes_down_to_the_noise_floor(planted):
    _, report = planted
    one = report["summary"]["held_out"]["ground_truth"]["trajectory"]
    assert one["fitted"] < 1.1 * one["noise_floor"]
    assert one["initial"] > 5 * one["fitted"] and one["ideal"] > 5 * one["fitted"]


def test_planted_parameters_lie_in_their_intervals(planted):
    _, report = planted
    found = {one["name"]: one for one in report["parameters"]}
    assert found.keys() == PLANTED.keys()
    inside = []
    for name, truth in PLANTED.items():
        one = found[name]
        assert one["identifiable"], name
        low, high = one["interval"]
        inside.append(low <= truth <= high)
        assert low - (high - low) / 2 <= truth <= high + (high - low) / 2, name
    assert np.mean(inside) >= 0.8  # of 90 % intervals


def test_the_vehicle_file_holds_the_fit_and_its_origin(planted):
    folder, report = planted
    spec, params, provenance = load_vehicle(folder / "run" / "vehicle.toml")
    names = [one["name"] for one in report["parameters"]]
    np.testing.assert_allclose(get_values(params, names), [one["value"] for one in report["parameters"]], rtol=1e-5)
    assert spec.track == WHILL_CR.track
    assert provenance["dataset_sha256"] == load_log(folder / "log").sha256
    assert provenance["scored_on"] == "held_out"


def test_the_report_has_its_schema_and_a_row_per_trial_and_channel(planted):
    folder, _ = planted
    report = json.loads((folder / "run" / "report.json").read_text())
    assert (report["schema"], report["kind"]) == (1, "sysid-report")
    assert set(report) >= {"dataset", "settings", "model", "noise", "noise_floor", "parameters", "fixed",
                           "spectrum", "weak_combinations", "search", "errors", "summary", "groups"}
    information = [one["information"] for one in report["spectrum"]]
    assert len(information) == len(report["parameters"]) and information == sorted(information)
    assert {one["combination"] for one in report["spectrum"]} >= set(report["weak_combinations"])
    assert len(report["errors"]) == 10 * 2
    assert {row["trial"] for row in report["errors"] if row["held_out"]} == {"figure_eight_1", "figure_eight_2"}
    for row in report["errors"]:
        for metric in row["metrics"].values():
            assert set(metric) == set(REPLAYS) and all(np.isfinite(list(metric.values())))
    for one in report["parameters"]:
        assert set(one) >= {"name", "unit", "initial", "value", "interval", "identifiable", "remark"}
    assert report["noise"]["source"] == "replicates"
    assert len(report["search"]["start_costs"]) == report["search"]["starts_agreeing"] == 1
    assert report["prior"] is None
    for name in ("trajectories.png", "yaw.png", "errors.png"):
        assert (folder / "run" / name).stat().st_size > 10_000


def test_held_out_trials_never_reach_the_fit(planted, monkeypatch):
    """What the search is given is the same whatever the held-out trials hold."""
    folder, _ = planted
    log = load_log(folder / "log")

    class Reached(Exception):
        pass

    def capture(plant, params, space, trials, noise):
        raise Reached(trials, noise)

    monkeypatch.setattr("sysid.search.fitting.make_objective", capture)
    seen = []
    for spoil in (False, True):
        trials = tuple(
            dataclasses.replace(trial, ground_truth=None,
                                odometry=dataclasses.replace(trial.odometry, v=trial.odometry.v + 9.0))
            if spoil and trial.held_out else trial for trial in log.trials)
        with pytest.raises(Reached) as reached:
            fit_log(dataclasses.replace(log, trials=trials), FitConfig(preset="paper"))
        seen.append(reached.value.args)
    (trials, noise), (spoiled_trials, spoiled_noise) = seen
    assert [trial.name for trial in trials] == [trial.name for trial in spoiled_trials]
    assert not any(trial.held_out for trial in trials)
    assert noise.as_dict() == spoiled_noise.as_dict()


def test_a_log_without_training_trials_is_an_error(planted):
    folder, _ = planted
    log = load_log(folder / "log").select(lambda trial: trial.held_out)
    with pytest.raises(ValueError, match="no training trial"):
        fit_log(log)


def test_a_fit_to_one_channel_takes_only_drives_that_have_it(planted):
    folder, _ = planted
    log = load_log(folder / "log")
    blind = dataclasses.replace(log.training[0], ground_truth=None)
    config = FitConfig(channels="ground_truth")
    mixed = dataclasses.replace(log, trials=(blind, *log.trials[1:]))
    assert blind.name in subject(mixed, config)[0].notes[-1]
    taken = fitting._training(mixed, config)
    assert blind.name not in [one.name for one in taken]
    assert all(one.odometry is None and one.ground_truth is not None for one in taken)
    with pytest.raises(ValueError, match="--channels ground_truth: no training trial"):
        fitting._training(dataclasses.replace(log, trials=(blind,)), config)


def test_an_unknown_parameter_is_an_error(planted):
    folder, _ = planted
    with pytest.raises(ValueError, match="no parameter 'pid_drive.gain'"):
        fit_log(load_log(folder / "log"), FitConfig(preset="paper", parameters=("pid_drive.gain",)))


@pytest.mark.quick
def test_the_command_line_ends_bad_input_with_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["fit", str(tmp_path / "nowhere"), "--out", str(tmp_path / "run")])
    with pytest.raises(SystemExit, match="error: .*nowhere: no such folder"):
        fit_module.cli()


@pytest.mark.quick
def test_the_shipped_log_loads_and_holds_the_figure_eight_out():
    from pathlib import Path

    import sysid

    folder = Path(sysid.__file__).parent / "data" / "chair"
    log = load_log(folder)
    assert {trial.manoeuvre for trial in log.held_out} == {"figure_eight"} and len(log.training) >= 6
    assert sum(path.stat().st_size for path in folder.rglob("*")) < 500_000
