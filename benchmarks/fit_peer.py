"""The fit against MuJoCo's own `mujoco.sysid` on the same log, the same parameters and the same machine.

    python -m benchmarks.fit_peer --trials 6
    python -m benchmarks.fit_peer --preset         # ours does not know what is not fitted, as the peer does

needs the packages of `pip install mujoco[sysid]`. The log is driven by the contact plant on one of its days.
`mujoco.sysid` is given the plant's own model in MJCF, with a native PI speed controller (a velocity servo and an
integrating one, limited at the joint), the plant's nominal values of all else, and its own threads; ours the physical
vehicle with all else from a fit to another day, as a vehicle file has it, or, with `--preset`, as nobody has fitted
it yet. Both fit the controller's gains and limit, the yaw inertia and where the centre of mass is, to poses and
speeds, from the preset's values of these, by Levenberg and Marquardt, and know the delay of a command. The clock of
each stops when its error, the mean position RMSE over the fitted trials, is as low as both get in the end; for the
one whose model is nearer to the truth that is long before its own end, which is reported too. Beside it stands the
search of `sysid.fit` without options, which looks for other valleys too (`default_search`).
"""

from __future__ import annotations

import importlib
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import mujoco
import numpy as np

from benchmarks.fit_scores import CLAIM
from benchmarks.harness import figure, record
from benchmarks.plant.chair import Chair, build
from benchmarks.plant.make import Experiment, make_log
from sysid.errors.bin_objective import make_features_objective
from sysid.errors.pose_objective import estimate_noise
from sysid.logs.log import load_log
from sysid.logs.records import Log, Trial, command_in_force
from sysid.search import least_squares, starts
from sysid.search.comparison import Judge, Recorder
from sysid.search.fitting import fit_log, make_problem
from sysid.search.settings import FEATURE_ITERATIONS, FitConfig
from sysid.search.valleys import gradient_search
from whill_mjx.io.command_line import COUNT, NOT_NEGATIVE, SEED, run
from whill_mjx.vehicle.parameters import get_values, set_values
from whill_mjx.vehicle.presets import preset_params

NAMES = ("torque_drive.kp", "torque_drive.ki", "torque_drive.limit", "body.yaw_inertia", "body.com_x")
MANOEUVRES = ("straight", "turn", "circle", "s_curve", "stop_and_go", "random")
EQUAL = 1.02
"""Errors are equal where they are within this factor."""
SIDES = ("left", "right")


@dataclass(frozen=True)
class Peer:
    """What is compared."""

    trials: Annotated[int, COUNT] = 18
    """Fitted trials: the first of three replicates of six manoeuvres of 22 s."""
    seed: Annotated[int, SEED] = 3
    """Day of the contact plant."""
    preset: bool = False
    """Ours has the preset's values of what is not fitted, not those of another day; the peer those of the plant."""
    other_day: Annotated[int, COUNT] = 4
    """The day that it knows them from."""
    iterations: Annotated[int, COUNT] = 40
    """Of both searches, at most."""
    eps: Annotated[float, NOT_NEGATIVE] = 1e-4
    """Step of its finite differences; its own default, 1.5e-8, is lost in the rounding of contacts."""


Curve = list[tuple[float, float]]
"""Seconds since the start and error [m] of one search, in the order of time."""


def chair_spec(start: dict[str, float]) -> mujoco.MjSpec:
    """The plant's nominal chair with a PI speed controller on each wheel; `start` by the names of `parameters`."""
    model = build(Chair())
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "chair.xml"
        mujoco.mj_saveLastXML(str(path), model)
        spec = mujoco.MjSpec.from_file(str(path))
    for side in SIDES:
        for kind in ("kp", "ki"):
            actuator = spec.add_actuator(name=f"{kind}_{side}", target=f"wheel_{side}",
                                         trntype=mujoco.mjtTrn.mjTRN_JOINT)
            actuator.gaintype, actuator.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
            if kind == "ki":
                actuator.dyntype = mujoco.mjtDyn.mjDYN_INTEGRATOR
        spec.joint(f"wheel_{side}").actfrclimited = True
    for name, (_, _, put) in parameters().items():
        put(spec, start[name])
    return spec


def parameters() -> dict[str, tuple[float, float, Callable[[Any, float], None]]]:
    """Least and greatest value of each fitted parameter, and how it is put into the model."""
    def gain(kind: str, column: int) -> Callable[[Any, float], None]:
        def put(spec: Any, value: float) -> None:
            for side in SIDES:
                actuator = spec.actuator(f"{kind}_{side}")
                gains, bias = np.array(actuator.gainprm), np.array(actuator.biasprm)
                gains[0], bias[column] = value, -value
                actuator.gainprm, actuator.biasprm = gains, bias
        return put

    def limit(spec: Any, value: float) -> None:
        for side in SIDES:
            spec.joint(f"wheel_{side}").actfrcrange = [-value, value]

    def inertia(spec: Any, value: float) -> None:
        body = spec.body("chassis")
        body.inertia = [*np.array(body.inertia)[:2], value]

    def com(spec: Any, value: float) -> None:
        body = spec.body("chassis")
        body.ipos = [value, *np.array(body.ipos)[1:]]

    return {"kp": (0.3, 200.0, gain("kp", 2)), "ki": (0.0, 190.0, gain("ki", 1)), "limit": (1.5, 400.0, limit),
            "inertia": (0.8, 20.0, inertia), "com": (-0.1, 0.35, com)}


def fit_peer(log: Log, settings: Peer) -> tuple[Curve, dict[str, float]]:
    """Fit with `mujoco.sysid`; its error at every point that it accepts or tries, and the fitted values."""
    sysid: Any = importlib.import_module("mujoco.sysid")

    start = {"kp": 7.15, "ki": 9.53, "limit": 14.38, "inertia": 4.0, "com": 0.1}
    spec = chair_spec(start)
    model = spec.compile()
    noise = estimate_noise(log.training)
    scale = np.concatenate([noise.pose, noise.odometry[3:]])
    trials = {trial.name: trial for trial in log.training}
    chosen, wheels = list(trials), [model.joint(f"wheel_{side}").dofadr[0] for side in SIDES]
    rest = settled(model)
    sequences = []
    for trial in trials.values():
        times = np.arange(round(trial.duration / model.opt.timestep) + 1) * model.opt.timestep
        control = sysid.TimeSeries(times, np.repeat(targets(log, trial, times), 2, axis=1),
                                   sysid.TimeSeries.compute_all_control_mapping(model))
        measured = sysid.TimeSeries.create(np.array([0.0, 1.0]), np.zeros((2, 1)),
                                           {"all": (sysid.SignalType.CustomObs, [0])})
        sequences.append(sysid.ModelSequences(trial.name, spec, trial.name, initial_state(model, rest, trial), control,
                                              measured, allow_missing_sensors=True))
    current = [""]  # the trial whose residual is being computed
    seen: list[np.ndarray] = []

    def modify(params: Any, predicted: Any, measured: Any, model: Any, everything: bool, **more: Any
               ) -> tuple[np.ndarray, Any, Any]:
        trial = trials[current[0]]
        residual = compare(model, wheels, log, trial, np.asarray(more["state"])) / scale
        seen.append(residual[:, :2] * scale[:2])
        return residual, measured, measured

    residuals = [sysid.build_residual_fn(models_sequences=[one], modify_residual=modify,
                                         n_threads=len(os.sched_getaffinity(0))) for one in sequences]
    curve: Curve = []
    began = time.perf_counter()

    def residual(x: np.ndarray, params: Any, **more: Any) -> tuple[list[np.ndarray], list[Any], list[Any]]:
        found, errors = [], []
        for name, function in zip(chosen, residuals, strict=True):
            current[0] = name
            seen.clear()
            found += function(x, params, **more)[0]
            errors.append(float(np.sqrt(np.square(seen[0]).sum(1).mean())))
        curve.append((time.perf_counter() - began, float(np.mean(errors))))
        return found, [], []

    table = sysid.ParameterDict()
    for name, (low, high, put) in parameters().items():
        table.add(sysid.Parameter(name, start[name], low, high,
                                  modifier=lambda one, parameter, put=put: put(one, float(parameter.value[0]))))
    fitted, _ = sysid.optimize(initial_params=table, residual_fn=residual, optimizer="mujoco", verbose=False,
                               max_iters=settings.iterations, eps=settings.eps, x_scale="jac")
    return curve, {name: float(fitted[name].value[0]) for name in start}


def settled(model: mujoco.MjModel) -> np.ndarray:
    """Positions (nq,) of the chair at rest on its wheels."""
    data = mujoco.MjData(model)
    for _ in range(round(1.0 / model.opt.timestep)):
        mujoco.mj_step(model, data)
    rest = data.qpos.copy()
    rest[7:] = 0.0
    return rest


def initial_state(model: mujoco.MjModel, rest: np.ndarray, trial: Trial) -> np.ndarray:
    """Full state at the start of a trial."""
    sysid: Any = importlib.import_module("mujoco.sysid")

    qpos = rest.copy()
    qpos[:2], qpos[3:7] = (trial.start.x, trial.start.y), (np.cos(trial.start.yaw / 2), 0, 0,
                                                           np.sin(trial.start.yaw / 2))
    return sysid.create_initial_state(model, qpos)


def targets(log: Log, trial: Trial, times: np.ndarray) -> np.ndarray:
    """Wanted wheel speeds (T, 2) [rad/s], the known delay after the commands."""
    held = command_in_force(trial.command, times - Chair().delay)
    v, omega = (np.where(held >= 0, column[np.maximum(held, 0)], 0.0)
                for column in (trial.command.v, trial.command.omega))
    half = log.spec.track / 2
    return np.column_stack([v - half * omega, v + half * omega]) / log.spec.wheel_radius


def compare(model: mujoco.MjModel, wheels: Sequence[int], log: Log, trial: Trial, state: np.ndarray) -> np.ndarray:
    """Errors (M, 5) of x, y, yaw, v and omega at the measured times, of states (T, 1 + nq + nv + na)."""
    t, qpos, qvel = state[:, 0], state[:, 1 : 1 + model.nq], state[:, 1 + model.nq : 1 + model.nq + model.nv]
    w, x, y, z = qpos[:, 3:7].T
    yaw = np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2)))
    yaw += 2 * np.pi * np.round((trial.start.yaw - yaw[0]) / (2 * np.pi))
    left, right = (qvel[:, one] * log.spec.wheel_radius for one in wheels)
    pose, odometry = trial.ground_truth, trial.odometry
    assert pose is not None and odometry is not None
    columns: list[tuple[Any, str, np.ndarray]] = [
        (pose, "x", qpos[:, 0]), (pose, "y", qpos[:, 1]), (pose, "yaw", yaw),
        (odometry, "v", (left + right) / 2), (odometry, "omega", (right - left) / log.spec.track)]
    count = min(len(pose.t), len(odometry.t))
    return np.column_stack([(np.interp(stream.t, t, values) - getattr(stream, name))[:count]
                            for stream, name, values in columns])


def fit_ours(log: Log, settings: Peer) -> tuple[Curve, Curve, dict[str, float], float]:
    """Fits, compiled before; their errors at every better point (of the search by Levenberg and Marquardt, and of the
    one without options), values of the former, seconds of compiling for it."""
    problem = make_problem(log, FitConfig(parameters=NAMES), None if settings.preset else known_vehicle(log, settings))
    objective, space = problem.objective, problem.space
    judge = Judge(problem, replace(log, trials=tuple(replace(trial, held_out=True) for trial in log.training)))

    def on_poses(objective: Any) -> np.ndarray:
        return least_squares.fit(objective, stop=least_squares.Stopping(settings.iterations), robust=True).u

    def by_default(objective: Any) -> np.ndarray:
        points = starts.draw(objective, [0], log.spec.track, 0)
        coarse = starts.fit(objective, points, log.spec.track, FEATURE_ITERATIONS)
        binned = make_features_objective(objective, log.spec.track).renewed(coarse.u)
        return gradient_search(binned, coarse.u[None], settings.iterations, FitConfig(), None)[0].u

    def timed(search: Callable[[Any], np.ndarray]) -> tuple[Curve, np.ndarray, float]:
        began = time.perf_counter()
        search(objective)  # compiles all that the search calls
        first = time.perf_counter() - began
        recorder = Recorder(objective.replay, objective)
        u = search(replace(objective, replay=recorder))
        errors = judge.error(np.stack([one[3] for one in recorder.best]))
        curve = [*zip([one[1] for one in recorder.best], errors.tolist(), strict=True),
                 (recorder.seconds, float(judge.error(u[None])[0]))]
        return curve, u, first - recorder.seconds

    curve, u, compiling = timed(on_poses)
    default, _, _ = timed(by_default)
    return curve, default, dict(zip(space.names, space.to_values(u).tolist(), strict=True)), compiling


def known_vehicle(log: Log, settings: Peer) -> Any:
    """The vehicle fitted to another day, but for the parameters that are searched: those are the preset's."""
    other = fit_log(drive(settings.other_day), FitConfig(iterations=settings.iterations))
    start = get_values(preset_params(log.spec, "physical"), NAMES)
    return set_values(other.params, NAMES, start)


def drive(seed: int) -> Log:
    """A day of the contact plant, all of it to be fitted."""
    with tempfile.TemporaryDirectory() as folder:
        make_log(Path(folder) / "log", Experiment(seed=seed, manoeuvres=MANOEUVRES))
        log = load_log(Path(folder) / "log")
    return replace(log, trials=tuple(replace(trial, held_out=False) for trial in log.trials))


def arrival(curve: Curve, goal: float) -> float:
    """Seconds until the error is at most `goal` [m]."""
    return next(seconds for seconds, error in curve if error <= goal)


def own_arrival(curve: Curve) -> float:
    """Seconds until the error is as low as this search gets, whatever the other one's."""
    return arrival(curve, EQUAL * min(error for _, error in curve))


def main(settings: Peer) -> None:
    """Drive the log, fit it with both, record the ratio of their times."""
    log = drive(settings.seed)
    names = [trial.name for trial in log.trials][: settings.trials]
    log = log.select(lambda trial: trial.name in names)
    ours, default, values, compiling = fit_ours(log, settings)
    theirs, their_values = fit_peer(log, settings)
    goal = EQUAL * max(min(error for _, error in curve) for curve in (ours, theirs))
    mine, peer = arrival(ours, goal), arrival(theirs, goal)
    figures = {
        "peer_mujoco_sysid_ratio": figure([peer / mine], "times as long"),
        "peer_mujoco_sysid_ratio_with_compilation": figure([peer / (mine + compiling)], "times as long"),
        "peer_mujoco_sysid_seconds": figure([peer], "s"), "peer_ours_seconds": figure([mine], "s"),
        "peer_ours_compile_seconds": figure([compiling], "s"), "peer_equal_error": figure([goal], "m"),
        "peer_mujoco_sysid_error": figure([min(error for _, error in theirs)], "m"),
        "peer_ours_error": figure([min(error for _, error in ours)], "m"),
        "peer_mujoco_sysid_seconds_to_own_best": figure([own_arrival(theirs)], "s"),
        "peer_ours_seconds_to_own_best": figure([own_arrival(ours)], "s"),
        "peer_ours_error_default_search": figure([min(error for _, error in default)], "m"),
        "peer_ours_seconds_to_own_best_default_search": figure([own_arrival(default)], "s"),
        "peer_trials": figure([float(len(log.trials))], "count"),
    }
    figures = {name + ("_preset" if settings.preset else ""): one for name, one in figures.items()}
    record("fit", CLAIM, figures, replacing=None if settings.preset else "peer_")  # those of `--preset` come after
    for name, one in figures.items():
        print(f"{name:44} {one['value']:10.4f} {one['unit']}")
    print(values, their_values, sep="\n")


if __name__ == "__main__":
    run(Peer, main, __doc__, positional=False)
