"""The closed loop against a vehicle file: what the file's fit knows stands in for reference drives."""


import numpy as np
import pytest

from benchmarks.planted_logs import Schedule, write_dataset
from sysid.errors.features import CHANNELS
from sysid.errors.noise import Whitener
from sysid.logs.log import load_log
from sysid.missing.catalogue import base_values
from sysid.missing.fit_statistics import FittedVehicle, Leftovers, drawn, leftovers_in_bins, load_fitted, statistics_of
from sysid.replay.rollout import make_batch, predictions, simulate, vehicle_plant
from sysid.verdict.pipeline import find_missing
from sysid.verdict.result import LoopConfig
from whill_mjx.effects import make_effect
from whill_mjx.logs.manoeuvres import Scenario
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.parameters import set_values
from whill_mjx.vehicle.presets import preset
from whill_mjx.vehicle.types import VehicleParams
from whill_mjx.vehicle.vehicle_file import save_vehicle

CONFIG = LoopConfig(quick=True, physics_dt=0.01, iterations=6, draws=200, poses=False)
NAMES = ("torque_drive.kp", "torque_drive.limit", "rolling_resistance.mu_r")
SLOPE = 0.03
SPEC, CHAIR = preset("whill_cr_physical")


def drive(folder, name, seed, gains, slope=0.0):
    values = {"torque_drive.kp": 9.0, "torque_drive.limit": 14.0, "rolling_resistance.mu_r": 0.012}
    params = set_values(CHAIR, list(NAMES), np.array([value * gains for value in values.values()]))
    effects = (make_effect("slope", along_x=slope),) if slope else ()
    write_dataset(folder / name, SPEC, VehicleParams(params.body, (*params.effects, *effects)),
                  Schedule(manoeuvres=("straight", "circle", "s_curve"), replicates=2,
                           scenario=Scenario(length=4.0), seed=seed),
                  plant=vehicle_plant(SPEC, VehicleConfig(physics_dt=0.01)))
    return load_log(folder / name), params


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    """A vehicle of one day in a file, with what a fit there would know; a day without, and one on a slope."""
    folder = tmp_path_factory.mktemp("vehicle")
    fitted, vehicle = drive(folder, "fitted", 0, 1.0)
    plain, _ = drive(folder, "plain", 1, 1.01)
    sloping, _ = drive(folder, "sloping", 2, 0.99, SLOPE)
    plant = vehicle_plant(SPEC, VehicleConfig(physics_dt=0.01))
    batch, _ = make_batch(fitted.training, 0.01)
    seen = predictions(fitted.training, simulate(plant, vehicle, batch))
    statistics = statistics_of(fitted.training, seen, SPEC.track, NAMES, np.array([0.1, 0.1, 2e-4]), 1e-4 * np.eye(3))
    file = save_vehicle(folder / "vehicle.toml", SPEC, vehicle, statistics=statistics.as_table())
    return file, statistics, plain, sloping


def test_what_a_fit_knows_survives_the_file(known):
    file, statistics, _, _ = known
    read = load_fitted(file)[1].statistics
    assert read.names == NAMES and read.leftovers.measured == CHANNELS
    np.testing.assert_allclose(read.leftovers.whitener.scale, statistics.leftovers.whitener.scale, rtol=1e-3)
    np.testing.assert_allclose(read.covariance(("other", NAMES[1]), np.array([1.0, 2.0])), [[0, 0], [0, 0.05**2]])
    text = file.read_text()
    for bad, said in ((("schema = 1\ndrives", "schema = 2\ndrives"), "statistics.schema"),
                      (("scale = [", "scale = [1.0, "), "statistics.scale has 6 numbers; 5 are needed"),
                      (("shared = ", "shared = 7"), "statistics.shared")):
        broken = file.with_name("broken.toml")
        broken.write_text(text.replace(*bad))
        with pytest.raises(ValueError, match=said):
            load_fitted(broken)


def test_the_vehicle_of_the_file_is_kept_and_its_drives_in_question_are_not_taken_for_known(known):
    file, _, plain, sloping = known
    _, vehicle = load_fitted(file)
    found = find_missing(sloping, config=CONFIG, vehicle=vehicle)
    kept, given = (base_values(one) for one in (found.reference.params, vehicle.params))
    assert kept == pytest.approx(given, rel=1e-5)  # not moved to the drives in question
    assert all(np.all(found.reference.expected(trial, 8) == 0) for trial in sloping.training)
    assert found.search.verdict == "named" and "slope" in found.search.classes[0]
    assert "standard errors of its fit" in found.reference.remark and "assumed" in found.reference.remark
    nothing = find_missing(plain, config=CONFIG, vehicle=vehicle)
    assert nothing.search.verdict == "none"


@pytest.mark.long
def test_of_an_older_file_the_noise_is_assumed(known):
    file, _, _, sloping = known
    older = find_missing(sloping, config=CONFIG, vehicle=FittedVehicle(load_fitted(file)[1].params))
    assert older.search.verdict == "named" and "slope" in older.search.classes[0]
    assert "noise is assumed" in older.reference.remark


@pytest.mark.long
def test_the_other_uses_name_the_same(known):
    """Against another day, starting at the preset or at the vehicle of the file, and alone."""
    file, _, plain, sloping = known
    start = FittedVehicle(load_fitted(file)[1].params, kept=False)
    for references, vehicle in (((plain,), None), ((plain,), start), ((), None)):
        found = find_missing(sloping, references, CONFIG, vehicle)
        assert found.search.verdict == "named" and "slope" in found.search.classes[0]


@pytest.mark.quick
def test_drawn_leftovers_have_the_statistics_they_are_drawn_from():
    channels = len(CHANNELS)
    rng = np.random.default_rng(1)
    memory = np.zeros((4, channels, channels))
    memory[0] = 0.6 * np.eye(channels)
    factor = np.linalg.cholesky(0.3 * np.eye(channels) + 0.1)
    left = Leftovers(9, 0.25, CHANNELS, Whitener(np.linspace(0.01, 0.05, channels), memory, np.linalg.inv(factor)),
                     np.ones((4, channels)), 0.5)
    mask = np.ones((400, 40, channels))
    courses = [i // 2 for i in range(400)]
    series = drawn(left, mask, courses, rng)
    white = left.whitener.apply(series, mask)
    assert white.std() == pytest.approx(1.0, abs=0.02)
    assert np.mean(white[::2] * white[1::2]) == pytest.approx(0.5, abs=0.02)
    again = leftovers_in_bins(replace_names(400), series, mask, 0.25, left.factors)
    np.testing.assert_allclose(again.whitener.coefficients[0], memory[0], atol=0.05)


def replace_names(count):
    """Trials of which none repeats another."""
    from types import SimpleNamespace

    from sysid.logs.records import Command

    t = np.array([0.0, 1.0])
    return tuple(SimpleNamespace(manoeuvre=str(i), command=Command(t, t, t), odometry=None, ground_truth=None)
                 for i in range(count))
