"""A gyro as a channel: of features, of whole poses, of a fit, and of what other sensors contradict."""

import shutil
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.plant.make import Experiment, make_log
from benchmarks.plant.sensors import Gyro
from benchmarks.planted_logs import Schedule, write_dataset
from sysid.errors.features import CHANNELS, GYRO, channel_names, make_features
from sysid.errors.pose_objective import estimate_noise
from sysid.logs.gyro import with_sign
from sysid.logs.log import load_log
from sysid.logs.records import GyroStream, Log
from sysid.replay.differences import CourseReplay
from sysid.replay.models import function_model, set_parameters
from sysid.replay.rollout import make_batch, predictions
from sysid.search.fitting import fit_log, make_problem
from sysid.search.settings import FitConfig
from whill_mjx.logs.dataset import Noise, write_imu
from whill_mjx.logs.manoeuvres import Scenario
from whill_mjx.logs.simulated_sensors import SensorNoise
from whill_mjx.vehicle.specs import WHILL_CR

DT = 0.02
TURNING = ("track_width.error", "yaw_scrub.torque", "body.yaw_inertia")
"""What a fit of the chair frees of turning."""
LAG, TURN = 0.3, 0.85
BIAS, SCALE, NOISE = 0.03, 1.06, 0.01


def slipping(values, state, command):
    """A body that turns `turn` times as far as its wheels."""
    x, y, yaw, v, omega = state
    v = v + DT * (command[0] - v) / values["lag"]
    omega = omega + DT * (command[1] - omega) / values["lag"]
    turned = yaw + DT * values["turn"] * omega
    return jnp.stack([x + DT * v * jnp.cos(yaw), y + DT * v * jnp.sin(yaw), turned, v, omega])


@pytest.fixture(scope="module")
def model():
    return function_model(slipping, {"lag": (0.1, 0.02, 1.0, "s"), "turn": (1.0, 0.5, 1.5)}, dt=DT)


@pytest.fixture(scope="module")
def truth(model):
    return set_parameters(model.params, ["lag", "turn"], jnp.array([LAG, TURN]))


@pytest.fixture(scope="module")
def folder(model, truth, tmp_path_factory):
    """Drives of the model, seen from outside by a noisy pose."""
    path = tmp_path_factory.mktemp("gyro") / "log"
    return write_dataset(path, WHILL_CR, truth,
                         Schedule(replicates=1, scenario=Scenario(v=0.5, omega=0.8, length=3.0), seed=3,
                                  manoeuvres=("straight", "s_curve", "figure_eight")),
                         plant=model.plant, noise=SensorNoise(position=0.05, yaw=0.1))


@pytest.fixture(scope="module")
def plain(folder):
    return load_log(folder)


def measured(log: Log, model, truth, bias=0.0, scale=1.0) -> Log:
    """The log with a gyro of that bias and scale on its vehicle."""
    random = np.random.default_rng(0)
    t = [np.arange(0.0, trial.duration, 0.05) for trial in log.trials]
    blank = tuple(replace(trial, gyro=GyroStream(one, 0 * one)) for trial, one in zip(log.trials, t, strict=True))
    replay = CourseReplay(model.plant, blank, lambda values: set_parameters(truth, ["lag", "turn"], values))
    seen = replay.simulate(np.array([[LAG, TURN]])).gyro[0, ..., 0]
    trials = []
    for trial, one, turn in zip(log.trials, t, seen, strict=True):
        rate = scale * np.gradient(turn[: len(one)], one) + bias + NOISE * random.standard_normal(len(one))
        trials.append(replace(trial, gyro=GyroStream.of_rates(one, rate)))
    return replace(log, trials=tuple(trials))


@pytest.fixture(scope="module")
def with_gyro(plain, model, truth):
    return measured(plain, model, truth)


def fitted(log, model):
    """Values and half widths of intervals by name, as found near the truth."""
    fit = fit_log(log, FitConfig(starts=1, iterations=8, method="lm", calibrate=False), model=model)
    return {one.name: (one.value, (one.high - one.low) / 2) for one in fit.uncertainty.estimates}


@pytest.fixture(scope="module")
def without(plain, model):
    return fitted(plain, model)


def test_a_gyro_narrows_the_interval_of_what_turns(without, with_gyro, model):
    found = fitted(with_gyro, model)
    assert found["turn"][1] < 0.5 * without["turn"][1]
    assert found["turn"][0] == pytest.approx(TURN, abs=2 * found["turn"][1])


@pytest.mark.parametrize(("bias", "scale"), [(BIAS, SCALE), (BIAS, -SCALE)])
def test_a_gyro_with_bias_scale_and_sign_does_no_harm(plain, without, model, truth, bias, scale):
    log = measured(plain, model, truth, bias, scale)
    trials, notes = with_sign(log.trials)
    assert bool(notes) == (scale < 0)
    found = fitted(replace(log, trials=trials), model)
    assert found["gyro_bias.bias"][0] == pytest.approx(BIAS * np.sign(scale), abs=0.01)
    assert found["turn"][0] == pytest.approx(TURN, abs=2 * without["turn"][1])
    assert found["lag"][0] == pytest.approx(LAG, rel=0.05)


@pytest.mark.quick
def test_a_gyro_is_a_sixth_channel_of_motion_in_bins(with_gyro, plain):
    trials = with_gyro.training
    features, without = make_features(trials), make_features(plain.training)
    target = features.of(make_batch(trials, DT)[1])
    assert channel_names(target.shape[-1]) == (*CHANNELS, GYRO)
    assert without.of(make_batch(plain.training, DT)[1]).shape[-1] == len(CHANNELS)
    known = (features.mask[..., 5] > 0) & (features.mask[..., 4] > 0)
    apart = (target[..., 5] - target[..., 4])[known]
    assert known.sum() > 30 and abs(apart.mean()) < 0.05  # the outside pose turns as far


@pytest.mark.quick
def test_a_log_without_a_gyro_is_replayed_as_before(plain, with_gyro, model, truth):
    def replay(trials):
        courses = CourseReplay(model.plant, trials, lambda values: set_parameters(truth, ["lag", "turn"], values))
        return courses.simulate(np.array([[LAG, TURN]]))

    old, new = replay(plain.training), replay(with_gyro.training)
    assert old.gyro is None and new.gyro is not None
    assert np.array_equal(old.pose, new.pose) and np.array_equal(old.odometry, new.odometry)
    seen = predictions(with_gyro.training, type(new)(new.pose[0], new.odometry[0], new.diverged[0], new.gyro[0]))
    assert all(one.gyro is not None for one in seen)


@pytest.mark.quick
def test_whole_poses_count_a_gyro_by_its_own_noise(with_gyro, plain, model):
    problem = make_problem(with_gyro, FitConfig(calibrate=False), model=model)
    objective, u = problem.objective, problem.space.to_unit(problem.space.initial)
    more = sum(len(trial.gyro.t) - 1 for trial in with_gyro.training)
    assert objective.counted == make_problem(plain, FitConfig(calibrate=False), model=model).objective.counted + more
    assert "gyro.omega" in objective.noise.as_dict() and estimate_noise(plain.training).gyro is None
    at = problem.space.to_unit(np.array([dict(lag=LAG, turn=TURN).get(name, value) for name, value in zip(
        problem.space.names, problem.space.initial, strict=True)]))
    assert objective.renewed(at).noise.gyro == pytest.approx(NOISE / np.sqrt(2), rel=0.3)  # of a mean of two samples
    residual, slope = objective.jacobian(at[None])
    assert residual.shape[2] == slope.shape[2] and np.isfinite(slope).all()
    assert len(objective.pieces(3)) == objective.own_frame(residual[0]).shape[1]
    assert not np.allclose(objective.residuals(u[None]), objective.residuals(at[None]))


@pytest.mark.quick
@pytest.mark.parametrize(("factor", "kept"), [(1.0, True), (-1.0, True), (57.3, False), (0.0, False)])
def test_a_gyro_that_does_not_follow_the_turns_is_left_out(with_gyro, factor, kept):
    random = np.random.default_rng(1)
    trials = tuple(replace(trial, gyro=replace(trial.gyro, turn=factor * trial.gyro.turn + (factor == 0) * np.cumsum(
        random.standard_normal(len(trial.gyro.t))))) for trial in with_gyro.trials)
    found, notes = with_sign(trials)
    assert all((trial.gyro is not None) == kept for trial in found)
    assert bool(notes) == (factor != 1.0)
    if kept:
        assert np.allclose(found[0].gyro.turn, with_gyro.trials[0].gyro.turn)


@pytest.mark.quick
def test_imu_csv_of_a_dataset_is_read(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "log")
    for trial in (tmp_path / "log" / "trials").iterdir():
        t = np.arange(0.0, 6.0, 0.01)
        write_imu(trial, t, np.full((len(t), 1), 0.1), Noise())
    trials = load_log(tmp_path / "log").trials
    assert all(trial.gyro is None for trial in trials)  # it turns as the vehicle never did
    (trial / "imu.csv").write_text("t,gyro\n0,0\n0,1\n")
    with pytest.raises(ValueError, match=r"imu.csv, line 3: t goes from 0 to 0"):
        load_log(tmp_path / "log")


@pytest.mark.quick
def test_a_gyro_of_another_clock_is_left_out_with_a_note(folder, tmp_path):
    copied = shutil.copytree(folder, tmp_path / "log")
    name = load_log(copied).trials[0].name
    rows = "".join(f"{9000 + 0.01 * k:.2f},0.1\n" for k in range(500))
    (copied / "trials" / name / "imu.csv").write_text(f"t,gyro\n{rows}")
    log = load_log(copied)
    assert log.trials[0].gyro is None
    assert any("imu.csv: hardly any of its rows lies within the trial" in note for note in log.notes)


@pytest.mark.quick
def test_a_gyro_may_be_a_channel_that_was_not_measured_or_be_left_out(with_gyro, plain):
    features = make_features(plain.training, gyro=True)
    assert features.of(make_batch(plain.training, DT)[1])[..., 5].max() == 0.0  # a channel that was not measured
    assert make_features(with_gyro.training, gyro=False).gyro is None


@pytest.mark.long
def test_a_gyro_narrows_what_turns_the_contact_plant_and_a_wrong_one_does_no_harm(tmp_path):
    """The independent plant, whose effects follow other laws: a chair on one day, with and without a gyro."""
    values = {}
    for name, gyro in {"none": None, "good": Gyro(), "wrong": Gyro(bias=0.02, scale=-1.04)}.items():
        make_log(tmp_path / name, Experiment(seed=3, manoeuvres=["s_curve", "turn", "circle"], replicates=1, gyro=gyro))
        fit = fit_log(load_log(tmp_path / name), FitConfig(starts=1, iterations=6, quick=True, physics_dt=0.01))
        error = fit.uncertainty.deviation * fit.space.slope(fit.u)
        values[name] = dict(zip(fit.space.names, zip(fit.space.to_values(fit.u), error, strict=True), strict=True))
    for name in TURNING:
        (without, error), (found, smaller), (wrong, same) = (values[one][name] for one in ("none", "good", "wrong"))
        assert smaller < error, name
        assert abs(wrong - found) < 2 * np.hypot(same, smaller), name
        assert abs(wrong - without) < 3 * np.hypot(same, error), name
    assert values["wrong"]["gyro_bias.scale"][0] == pytest.approx(1.04, abs=0.02)
