"""What others predict of the measured skid-steered robot from its commands: models of a few numbers, and a network.

Written anew from their descriptions, fitted to the training steps and scored on the held-out ones of
`benchmarks.measured_loop`. All see the commands and the speeds at the start, and nothing else.

`published`: the powertrain and slip model of the data's publishers (Baril et al., "DRIVE", ICRA 2024). Each side
follows its command by a delay, a lag and bounds, fitted to the wheels' speeds of the first 2 s. What a body lacks of an
ideal drive is linear in v ahead, in v omega sideways, and in v omega, v and omega in yaw: by a Bayesian regression with
a flat prior on the rest of each step. `kinematic`: scales of v and omega, one lag, one delay (4 numbers); a limit of
the wheels' speed (5); a late pose and sideways slip v_y = -k v omega (7); a lag of turning of its own (8). `network`: a
small network adds to the rates of change of that model's speeds and to the motion of its body.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sysid.logs.records import PoseStream, Prediction, Trial, command_in_force
from sysid.logs.stream_quality import added_up

DT = 0.05  # s
BACK = 24  # steps of driving on as in the first instant, before the start: as late as a pose may be
YAW_WEIGHT = 1.0  # m per rad: what counts beside the position
HIDDEN, RATE, EPOCHS, DECAY = 32, 3e-3, 300, 1e-4
SCALES = np.array([4.0, 3.0])  # m/s and rad/s that inputs are divided by

START = {"linear": 0.9, "angular": 0.6, "lag": 0.4, "delay": 0.1, "limit": 6.0, "late": 0.0, "slip": 0.0,
         "turn_lag": 0.4}  # fmt: skip
BOUNDS = {"linear": (0.3, 1.5), "angular": (0.2, 1.5), "lag": (0.02, 2.0), "delay": (0.0, 0.8), "limit": (0.5, 8.0),
          "late": (0.0, 1.1), "slip": (-0.3, 0.5), "turn_lag": (0.02, 3.0)}  # fmt: skip
KINEMATIC = {4: ("linear", "angular", "lag", "delay"), 5: ("limit",), 7: ("late", "slip"), 8: ("turn_lag",)}
"""Numbers of each model beyond those of the one before it."""

TRANSITORY = 2.0  # s of a step after which the publishers take it as steady


@dataclass(frozen=True)
class Steps:
    """Trials on a common grid of `DT`."""

    command: np.ndarray  # (B, T, 2)
    start: np.ndarray  # (B, 2) m/s, rad/s of the wheels
    index: np.ndarray  # (B, M) int, grid step of each pose
    pose: np.ndarray  # (B, M, 3) from the start
    mask: np.ndarray  # (B, M)
    half_track: float


def steps_of(trials: tuple[Trial, ...], track: float) -> Steps:
    """Trials whose pose counts from their start."""
    length = max(round(trial.duration / DT) for trial in trials) + 1
    most = max(len(trial.ground_truth.t) for trial in trials if trial.ground_truth is not None)
    command, start = np.zeros((len(trials), length, 2)), np.zeros((len(trials), 2))
    index, mask = np.zeros((len(trials), most), int), np.zeros((len(trials), most))
    pose = np.zeros((len(trials), most, 3))
    for i, trial in enumerate(trials):
        assert trial.ground_truth is not None
        held = np.maximum(command_in_force(trial.command, np.arange(length) * DT), 0)
        command[i] = trial.command.table[held, 1:]
        start[i] = trial.start.v, trial.start.omega
        count = len(trial.ground_truth.t)
        index[i, :count] = np.round(trial.ground_truth.t / DT)
        pose[i, :count] = trial.ground_truth.values
        mask[i, :count] = 1.0
    return Steps(command, start, index, pose, mask, track / 2)


def motion(values: dict[str, Any], command: jax.Array, start: jax.Array, half: float,
           added: Callable[..., jax.Array] | None = None) -> jax.Array:
    """Late poses (T, 3) of one step from its start, every `DT`.

    Args:
        added: (speeds (2,), command (2,)) -> what a network adds to their rates and to the body's motion, (5,).
    """
    late, delay = values["late"], values["delay"] / DT
    place = jnp.maximum(jnp.arange(len(command)) - delay, -1.0)
    before = jnp.floor(place).astype(int)
    share = (place - before)[:, None]
    extended = jnp.concatenate([start[None], command])  # before the start: as it was
    first = extended[jnp.clip(before + 1, 0, len(command))]
    second = extended[jnp.clip(before + 2, 0, len(command))]
    wanted = first + share * (second - first)
    wheels = jnp.stack([wanted[:, 0] - half * wanted[:, 1], wanted[:, 0] + half * wanted[:, 1]], axis=-1)
    wheels = jnp.clip(wheels, -values["limit"], values["limit"])
    wanted = jnp.stack([wheels.mean(-1), (wheels[:, 1] - wheels[:, 0]) / (2 * half)], axis=-1)
    kept = jnp.exp(-DT / jnp.stack([values["lag"], values["turn_lag"]]))

    def step(speeds: jax.Array, target: jax.Array) -> tuple[jax.Array, jax.Array]:
        after = target + kept * (speeds - target)
        more = jnp.zeros(5) if added is None else added(speeds, target)
        after = after + DT * more[:2]
        v, omega = (speeds + after) / 2
        body = jnp.stack([values["linear"] * v, -values["slip"] * v * values["angular"] * omega,
                          values["angular"] * omega]) + more[2:]
        return after, body

    twists = jax.lax.scan(step, start, wanted)[1]
    twists = jnp.concatenate([jnp.broadcast_to(twists[:1], (BACK, 3)), twists])
    yaw = jnp.concatenate([jnp.zeros(1), jnp.cumsum(twists[:, 2]) * DT])
    middle = (yaw[1:] + yaw[:-1]) / 2
    cos, sin = jnp.cos(middle), jnp.sin(middle)
    x = jnp.concatenate([jnp.zeros(1), jnp.cumsum(cos * twists[:, 0] - sin * twists[:, 1]) * DT])
    y = jnp.concatenate([jnp.zeros(1), jnp.cumsum(sin * twists[:, 0] + cos * twists[:, 1]) * DT])
    path = jnp.stack([x, y, yaw], axis=-1)
    at = BACK + jnp.arange(len(command)) - late / DT
    low = jnp.floor(at).astype(int)
    seen = path[low] + (at - low)[:, None] * (path[low + 1] - path[low])
    cos, sin = jnp.cos(seen[0, 2]), jnp.sin(seen[0, 2])
    dx, dy = seen[:, 0] - seen[0, 0], seen[:, 1] - seen[0, 1]
    return jnp.stack([cos * dx + sin * dy, cos * dy - sin * dx, seen[:, 2] - seen[0, 2]], axis=-1)


def loss(paths: jax.Array, data: Steps) -> jax.Array:
    """Mean over steps of the RMSE of position [m], and of yaw by `YAW_WEIGHT`: what is scored."""
    seen = jnp.take_along_axis(paths, jnp.asarray(data.index)[..., None], axis=1)
    square = jnp.square(seen - data.pose) * data.mask[..., None]
    count = data.mask.sum(-1)
    position = jnp.sqrt(square[..., :2].sum((-1, -2)) / count + 1e-6)
    yaw = jnp.sqrt(square[..., 2].sum(-1) / count + 1e-6)
    return (position + YAW_WEIGHT * yaw).mean()


def all_values(names: tuple[str, ...], free: Any) -> dict[str, Any]:
    """Every number of the kinematic model, the others without effect."""
    values = {"linear": 1.0, "angular": 1.0, "lag": 1e-3, "delay": 0.0, "limit": 1e3, "late": 0.0, "slip": 0.0}
    values |= dict(zip(names, free, strict=True))
    return {"turn_lag": values["lag"], **values}


def fit_kinematic(data: Steps, count: int) -> tuple[dict[str, float], Callable[[Steps], np.ndarray]]:
    """The numbers of the model with `count` of them, and its predictions (B, T, 3)."""
    from scipy import optimize

    names = tuple(name for size, more in KINEMATIC.items() if size <= count for name in more)

    def paths(free: Any, data: Steps) -> jax.Array:
        one = partial(motion, all_values(names, free), half=data.half_track)
        return jax.vmap(one)(jnp.asarray(data.command), jnp.asarray(data.start))

    function = jax.jit(jax.value_and_grad(lambda free: loss(paths(free, data), data)))

    def cost(free: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = function(jnp.asarray(free))
        return float(value), np.asarray(slope, float)

    best = min((optimize.minimize(cost, np.array([at[name] for name in names]), jac=True, method="L-BFGS-B",
                                  bounds=[BOUNDS[name] for name in names])
                for at in (START, {**START, "limit": 4.0, "late": 0.4, "slip": 0.1, "turn_lag": 1.0})),
               key=lambda found: found.fun)
    return dict(zip(names, best.x.tolist(), strict=True)), lambda other: np.asarray(paths(jnp.asarray(best.x), other))


def sides(twist: np.ndarray, half: float) -> np.ndarray:
    """Speeds of the left and the right wheels (..., 2) [m/s] of an ideal drive with twists (..., 2)."""
    return twist[..., :1] + half * twist[..., 1:] * np.array([-1.0, 1.0])


def follow(command: np.ndarray, start: np.ndarray, lag: float, delay: float, bounds: tuple[float, float]) -> np.ndarray:
    """Speeds (B, T) of one side of the wheels that follow commands (B, T) from their start (B,)."""
    speed, out = start, []
    for k in range(command.shape[1]):
        out.append(speed)
        target = speed if k * DT <= delay else command[:, k]
        speed = np.clip(speed + DT / lag * (target - speed), *bounds)
    return np.stack(out, axis=1)


def regressors(v: np.ndarray, omega: np.ndarray) -> tuple[np.ndarray, ...]:
    """What the slip of a body is linear in, ahead, sideways and in yaw, each (..., 1 or 3)."""
    return v[..., None], (v * omega)[..., None], np.stack([v * omega, v, omega], axis=-1)


def fit_published(trials: tuple[Trial, ...], data: Steps) -> Callable[[Steps], np.ndarray]:
    """Predictions (B, T, 3) of the publishers' model, fitted to trials with wheel speeds and outside poses."""
    from scipy import optimize

    streams = [trial.odometry for trial in trials if trial.odometry is not None]
    count = round(TRANSITORY / DT)
    grid = np.arange(count) * DT
    wheels = np.stack([sides(np.stack([np.interp(grid, one.t, one.v), np.interp(grid, one.t, one.omega)], axis=-1),
                             data.half_track) for one in streams])  # (B, count, 2)
    asked = sides(data.command[:, :count], data.half_track)
    powertrain = []
    for side in range(2):
        seen, bounds = wheels[..., side], (float(wheels[:, -1, side].min()), float(wheels[:, -1, side].max()))

        def missed(free: np.ndarray, side: int = side, seen: np.ndarray = seen, bounds: Any = bounds) -> float:
            return float(np.abs(follow(asked[..., side], seen[:, 0], free[0], free[1], bounds) - seen).mean())

        best = min((optimize.minimize(missed, at, method="Nelder-Mead", bounds=[(DT, 3.0), (0.0, 1.0)])
                    for at in ([0.3, 0.1], [0.8, 0.3])), key=lambda found: found.fun)
        powertrain.append((*best.x.tolist(), bounds))
    slips = fit_slip(trials)

    def paths(other: Steps) -> np.ndarray:
        asked, start = (sides(one, other.half_track) for one in (other.command, other.start))
        left, right = (follow(asked[..., side], start[:, side], *powertrain[side]) for side in range(2))
        v, omega = (left + right) / 2, (right - left) / (2 * other.half_track)
        ahead, across, turn = (rows @ weights for rows, weights in zip(regressors(v, omega), slips, strict=True))
        return integrated(v - ahead, -across, omega - turn)

    return paths


def fit_slip(trials: tuple[Trial, ...]) -> list[np.ndarray]:
    """Weights of the slip ahead, sideways and in yaw: by how much bodies fell short of ideal drives with their wheel
    speeds, between consecutive poses of the steady part of each step."""
    inputs: list[np.ndarray] = []
    short: list[np.ndarray] = []
    for trial in trials:
        pose, wheels = trial.ground_truth, trial.odometry
        if pose is None or wheels is None:
            continue
        t, values = pose.t[pose.t >= TRANSITORY], pose.values[pose.t >= TRANSITORY]
        dt, moved = np.diff(t), np.diff(values, axis=0)
        middle = (values[1:, 2] + values[:-1, 2]) / 2
        cos, sin = np.cos(middle), np.sin(middle)
        body = np.stack([cos * moved[:, 0] + sin * moved[:, 1], cos * moved[:, 1] - sin * moved[:, 0], moved[:, 2]], -1)
        ideal = np.stack([np.diff(added_up(wheels.t, rate, t)) for rate in (wheels.v, wheels.omega)], -1)
        inputs.append(ideal / dt[:, None])
        short.append((ideal[:, [0, 0, 1]] * [1.0, 0.0, 1.0] - body) / dt[:, None])
    twist, slip = np.concatenate(inputs), np.concatenate(short)
    return [np.linalg.lstsq(rows, slip[:, i])[0] for i, rows in enumerate(regressors(*twist.T))]


def integrated(vx: np.ndarray, vy: np.ndarray, omega: np.ndarray) -> np.ndarray:
    """Poses (B, T, 3) from the start of bodies with speeds (B, T) ahead, to the left and in yaw."""
    yaw = np.cumsum(omega, axis=1) * DT
    middle = yaw - omega * DT / 2
    cos, sin = np.cos(middle), np.sin(middle)
    path = np.stack([np.cumsum(cos * vx - sin * vy, axis=1) * DT, np.cumsum(sin * vx + cos * vy, axis=1) * DT, yaw], -1)
    return np.concatenate([np.zeros((len(path), 1, 3)), path[:, :-1]], axis=1)


def fit_network(data: Steps, base: dict[str, float], seeds: tuple[int, ...] = (0, 1, 2)
                ) -> Callable[[Steps], np.ndarray]:
    """Mean predictions (B, T, 3) of networks from several seeds, each on top of a kinematic model."""
    import optax

    values = all_values(tuple(base), tuple(base.values()))

    def added(weights: Any, speeds: jax.Array, command: jax.Array) -> jax.Array:
        hidden = jnp.concatenate([speeds / SCALES, command / SCALES])
        for matrix, bias in weights[:-1]:
            hidden = jnp.tanh(hidden @ matrix + bias)
        return hidden @ weights[-1][0] + weights[-1][1]

    def paths(weights: Any, data: Steps) -> jax.Array:
        one = partial(motion, values, half=data.half_track, added=partial(added, weights))
        return jax.vmap(one)(jnp.asarray(data.command), jnp.asarray(data.start))

    optimiser = optax.adamw(optax.cosine_decay_schedule(RATE, EPOCHS), weight_decay=DECAY)

    @jax.jit
    def train(key: jax.Array) -> Any:
        sizes = [(4, HIDDEN), (HIDDEN, HIDDEN), (HIDDEN, 5)]
        weights = [(jax.random.normal(each, (n, m)) / np.sqrt(n) * (0.1 if m == 5 else 1.0), jnp.zeros(m))
                   for each, (n, m) in zip(jax.random.split(key, 3), sizes, strict=True)]

        def epoch(carry: Any, _: None) -> tuple[Any, jax.Array]:
            weights, state = carry
            value, slope = jax.value_and_grad(lambda weights: loss(paths(weights, data), data))(weights)
            change, state = optimiser.update(slope, state, weights)
            return (optax.apply_updates(weights, change), state), value

        return jax.lax.scan(epoch, (weights, optimiser.init(weights)), None, length=EPOCHS)[0][0]

    found = [train(jax.random.key(seed)) for seed in seeds]
    return lambda other: np.mean([np.asarray(paths(weights, other)) for weights in found], axis=0)


def as_predictions(trials: tuple[Trial, ...], data: Steps, paths: np.ndarray) -> list[Prediction]:
    """Paths (B, T, 3) at the times of the trials' poses."""
    found = []
    for i, trial in enumerate(trials):
        assert trial.ground_truth is not None
        at = paths[i, data.index[i, : len(trial.ground_truth.t)]]
        found.append(Prediction(PoseStream(trial.ground_truth.t, *at.T.astype(float)), None))
    return found
