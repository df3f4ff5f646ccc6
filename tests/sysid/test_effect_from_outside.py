"""An effect in one file outside the package is simulated, randomised, fitted, saved, loaded and named like its own."""

from __future__ import annotations

import dataclasses
import os
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import outside_effect
import pytest
from outside_effect import HeadingDrift

from benchmarks.planted_logs import Schedule, write_dataset
from sysid.follow_up.next_manoeuvre import sensor_for
from sysid.logs.log import load_log
from sysid.missing.catalogue import falsifiers, hypotheses
from sysid.pages.loop_report import make_report, write_run
from sysid.replay.models import with_effects
from sysid.replay.rollout import vehicle_plant
from sysid.search.fitting import fit_log
from sysid.search.settings import FitConfig
from sysid.verdict.pipeline import find_missing
from sysid.verdict.result import LoopConfig
from whill_mjx.batch import make_batch
from whill_mjx.effects import EFFECTS, Effect, make_effect, register, texts, unregister
from whill_mjx.effects.card import Axis, Card, Falsifier, Variant
from whill_mjx.effects.registry import all_effects
from whill_mjx.env import make_env
from whill_mjx.logs.manoeuvres import Scenario
from whill_mjx.tasks.tasks import ObstacleCourse
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.parameters import get_values, set_values
from whill_mjx.vehicle.presets import preset
from whill_mjx.vehicle.vehicle_file import load_vehicle, save_vehicle

FILE = Path(outside_effect.__file__)
RATE = "heading_drift.rate"
PLANTED = 0.03  # rad/s
RIVALS = ("command_scale", "wheel_radius_difference", "drive_gain_difference", "track_width", "side_force", "slope",
          "odometry_scale", "clock_offset", "heading_drift")
"""Effects of the loop's catalogue that change the odometry or the yaw rate; with the others it takes twice as long."""
quick = pytest.mark.quick


@pytest.fixture(scope="module")
def registered():
    register(HeadingDrift)
    yield
    unregister("heading_drift")


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """A folder with the file and the metadata of a package that offers it."""
    shutil.copy(FILE, tmp_path / "drifting.py")
    metadata = tmp_path / "drifting-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: drifting\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text("[whill_mjx.effects]\nheading_drift = drifting:HeadingDrift\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    sys.modules.pop("drifting", None)


@pytest.fixture(scope="module")
def logs(registered, tmp_path_factory):
    """Two days of the paper's chair, and one on which its heading drifts."""
    folder, found = tmp_path_factory.mktemp("drives"), []
    for number, rate in enumerate((0.0, 0.0, PLANTED)):
        spec, params = preset("whill_cr")
        names = ["pid_drive.kp", "lateral_damping.c_rear", "rolling_resistance.mu_r"]
        usual = np.asarray(get_values(params, names))
        day = set_values(params, names, usual * (1 + 0.02 * np.random.default_rng(number).standard_normal(3)))
        truth = dataclasses.replace(day, effects=(*day.effects, make_effect("heading_drift", rate=rate)))
        write_dataset(folder / str(number), spec, truth,
                      Schedule(manoeuvres=("straight", "circle", "s_curve", "figure_eight"), replicates=3,
                               scenario=Scenario(length=4.0), seed=number),
                      plant=vehicle_plant(spec, VehicleConfig(physics_dt=0.01)))
        found.append(load_log(folder / str(number)))
    return found


@quick
def test_the_whole_effect_is_one_short_file():
    assert len(FILE.read_text().splitlines()) <= 60


@quick
def test_a_registered_effect_stands_behind_those_of_the_package(registered):
    spec, params = preset("whill_cr_physical")
    assert list(EFFECTS)[-1] == "heading_drift"
    assert hypotheses(spec, params)[-1].axes[0].parameter == RATE
    assert list(falsifiers())[-1] == "heading_drift"
    assert sensor_for("dry_friction", "heading_drift") == "the gyro at standstill"


@quick
def test_an_installed_package_offers_its_effects_by_entry_points(installed):
    known = all_effects()
    assert list(known)[-1] == "heading_drift"
    assert known["heading_drift"].__module__ == "drifting"


@quick
def test_every_program_knows_the_effects_of_installed_packages(installed):
    code = ("from drifting import HeadingDrift\nfrom whill_mjx.effects import EFFECTS, make_effect\n"
            "assert EFFECTS['heading_drift'] is HeadingDrift and make_effect('heading_drift', rate=0.1).rate > 0")
    path = os.pathsep.join([str(installed), os.environ["PYTHONPATH"]])
    subprocess.run([sys.executable, "-c", code], check=True, env={**os.environ, "PYTHONPATH": path})


@quick
def test_an_installed_package_that_cannot_be_loaded_is_named(installed):
    (installed / "drifting.py").write_text("import no_such_module")
    with pytest.raises(ImportError, match="installed package 'drifting'.*no_such_module.*uninstall"):
        list(all_effects())


@quick
def test_an_effect_without_usual_values_needs_some_to_be_added(registered, monkeypatch):
    spec, params = preset("whill_cr")
    added = texts.with_effects(params, ["heading_drift"]).effects[-1]
    assert float(added.rate) == pytest.approx(HeadingDrift.typical["rate"][1])
    monkeypatch.setattr(HeadingDrift, "typical", {})
    with pytest.raises(ValueError, match="heading_drift has no usual values.*heading_drift:rate=VALUE"):
        texts.with_effects(params, ["heading_drift"])
    assert float(texts.with_effects(params, ["heading_drift:rate=0.01"]).effects[-1].rate) == pytest.approx(0.01)


@quick
def test_a_class_that_is_no_complete_effect_is_refused(registered):
    with pytest.raises(TypeError, match="not an effect"):
        register(Axis)
    twin = type("Twin", (HeadingDrift,), {})
    with pytest.raises(ValueError, match="'heading_drift'.*has one of this name"):
        register(twin)
    card = dataclasses.replace(HeadingDrift.card, variants=(Variant((Axis("speed", 1.0),)),))
    with pytest.raises(ValueError, match="no parameter 'speed' .known: rate"):
        register(type("Faulty", (HeadingDrift,), {"card": card, "name": "faulty"}))
    with pytest.raises(ValueError, match="identifier"):
        register(type("Unnamed", (HeadingDrift,), {"name": "two words"}))
    for usual in (0.02, "small", (0.02, -0.02), (0.0, float("nan"))):
        with pytest.raises(ValueError, match="'faulty': the usual values of rate must be two finite numbers"):
            register(type("Faulty", (HeadingDrift,), {"typical": {"rate": usual}, "name": "faulty"}))
    with pytest.raises(ValueError, match="nothing is known as 'weather' .known: speed"):
        Falsifier("does not depend on the weather", "weather")
    assert "faulty" not in EFFECTS and Effect.card == Card()


def test_it_is_randomised_in_a_batch_of_environments(registered):
    env, params = make_env(ObstacleCourse(max_steps=3), height=16, width=16)
    params = set_values(with_effects(params, ["heading_drift"]), [RATE], np.array([PLANTED]))
    batch = make_batch(env, params, 4, spread=0.2)
    state, _ = jax.jit(batch.reset)(jax.random.key(0))
    rates = np.asarray(state.params.effects[-1].rate)
    assert len(set(rates.tolist())) == 4 and (rates > 0).all()
    assert np.isfinite(np.asarray(state.env.vehicle.odometry.omega)).all()


def test_it_is_fitted_saved_and_loaded(logs, tmp_path):
    log = logs[-1]
    config = FitConfig(preset="paper", effects=("heading_drift",), parameters=(RATE,), physics_dt=0.01, quick=True,
                       elsewhere=False)
    fit = fit_log(log, config)
    [found] = get_values(fit.params, [RATE])
    assert found == pytest.approx(PLANTED, rel=0.1)
    _, params, _ = load_vehicle(save_vehicle(tmp_path / "vehicle.toml", log.spec, fit.params))
    assert isinstance(params.effects[-1], HeadingDrift)
    assert float(get_values(params, [RATE])[0]) == pytest.approx(float(found))


def test_the_closed_loop_names_it_and_writes_it_into_the_vehicle_file(logs, tmp_path, monkeypatch):
    monkeypatch.setattr("sysid.missing.catalogue.in_order", lambda: [EFFECTS[name] for name in RIVALS])
    config = LoopConfig(preset="paper", quick=True, physics_dt=0.01, iterations=6, draws=200, poses=False)
    result = find_missing(logs[-1], tuple(logs[:-1]), config)
    assert [one.hypothesis.effect for one in result.search.accepted] == ["heading_drift"]
    report = make_report(result)
    assert report["verdict"] == "named"
    low, high = report["effects"][0]["parameters"][RATE]["interval"]
    assert low < PLANTED < high
    write_run(tmp_path, result, report)
    _, params, _ = load_vehicle(tmp_path / "vehicle.toml")
    assert float(get_values(params, [RATE])[0]) == pytest.approx(PLANTED, rel=0.1)
