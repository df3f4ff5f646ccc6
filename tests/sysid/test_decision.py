"""`close_loop --decision posterior`: from a driving log to a verdict that its saved evidence gives again."""

from __future__ import annotations

import json

import numpy as np
import pytest

from sysid.logs.log import load_log
from sysid.logs.synthetic import write_dataset
from sysid.replay.rollout import vehicle_plant
from sysid.verdict.result import LoopConfig
from sysid.weighing.decision import noise_sentences, run, sentences
from sysid.weighing.posterior import posterior
from sysid.weighing.saved_evidence import load
from sysid.weighing.verdict import Rules, Verdict, calibration_scores, decide
from whill_mjx.effects import make_effect
from whill_mjx.logs.manoeuvres import Scenario
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.presets import preset
from whill_mjx.vehicle.types import VehicleParams

CHANNELS = ("odometry.v", "odometry.omega")


def verdict(kind="none", noise=((1.0, 0.9, 1.1), (1.0, 0.9, 1.1))):
    return Verdict(kind, (), 0.4, 3.0, {"none": 1.0}, dict(zip(CHANNELS, noise, strict=True)), "speed")


def test_a_louder_channel_gets_a_sentence_with_its_factor_and_nothing_else_has_changed():
    said = noise_sentences(verdict(noise=((1.0, 0.9, 1.1), (2.6, 2.2, 3.0))))
    assert said == ["The reported yaw rate is 2.6 times as noisy as on the reference days (2.2 to 3).",
                    "Nothing else has changed."]


def test_a_quieter_channel_is_said_to_be_quieter_and_usual_noise_needs_no_sentence():
    assert "quieter" in noise_sentences(verdict(noise=((0.5, 0.4, 0.6), (1.0, 0.9, 1.1))))[0]
    assert noise_sentences(verdict()) == []


def test_what_is_unexplained_is_said_with_what_predicts_it():
    assert "speed" in sentences(verdict("unexplained"), [])[0]


def test_open_ends_of_an_interval_are_said_to_be_open():
    effect = {"name": "jerk_limit", "class": ["jerk_limit"],
              "parameters": {"jerk_limit.linear": {"value": 20.0, "interval": [12.0, None]}}}
    assert "12 to open" in sentences(verdict("named"), [effect])[0]


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """A sloping floor against two reference days, all of them short."""
    folder, spec_logs = tmp_path_factory.mktemp("drives"), []
    for seed, along in ((0, 0.0), (1, 0.0), (2, 0.03)):
        spec, params = preset("whill_cr_physical")
        if along:
            params = VehicleParams(params.body, (*params.effects, make_effect("slope", along_x=along)))
        write_dataset(folder / str(seed), spec, params, manoeuvres=("straight", "circle", "s_curve"), replicates=2,
                      scenario=Scenario(length=4.0), seed=seed,
                      plant=vehicle_plant(spec, VehicleConfig(physics_dt=0.01)))
        spec_logs.append(load_log(folder / str(seed)))
    config = LoopConfig(quick=True, physics_dt=0.01, iterations=6,
                        without=("command_dead_zone", "acceleration_limit", "jerk_limit", "backlash", "supply_sag"))
    return run(spec_logs[2], spec_logs[:2], folder / "out", config), folder / "out"


def test_a_slope_is_named_with_its_size_and_the_file_holds_the_report(report):
    found, out = report
    assert found["verdict"] == "named" and "slope" in found["effects"][0]["class"]
    assert json.loads((out / "posterior.json").read_text()) == found
    if found["effects"][0]["name"] == "slope":
        low, high = found["effects"][0]["parameters"]["slope.along_x"]["interval"]
        assert low < 0.03 < high


def test_the_saved_evidence_gives_the_same_verdict_without_a_simulator(report):
    found, out = report
    evidence = load(out / "evidence.npz.xz")
    again = decide(posterior(evidence), evidence.channels, calibration_scores(), Rules())
    assert again.verdict == found["verdict"]
    assert again.score == pytest.approx(found["score"], rel=0.05)
    assert np.isfinite(evidence.columns).all()
