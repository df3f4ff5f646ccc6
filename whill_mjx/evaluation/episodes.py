"""Episodes of one driver, their figures, and the figures' confidence intervals."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.env import Env, reset_state
from whill_mjx.env.view_from_above import top_view
from whill_mjx.evaluation.conditions import Condition
from whill_mjx.evaluation.drivers import Driver, replay_driver
from whill_mjx.evaluation.intervals import bootstrap_interval, wilson_interval
from whill_mjx.evaluation.rollouts import CHANNELS, Rollout, View, rollout
from whill_mjx.vehicle.dynamics import place
from whill_mjx.vehicle.ground import on_ground
from whill_mjx.vehicle.types import VehicleParams
from whill_mjx.world.randomize import randomize_params

_REPLAY = replay_driver()

NEAR_M = 0.10
"""A vehicle that comes closer than this to anything has a near miss [m]."""
BLINDS = ("blank", "freeze", "replay")
SHARES = ("success", "collision", "timeout", "diverged")
MEANS = {
    "return": "sum of the rewards",
    "min_clearance_m": "smallest distance to a box or wall, of the episodes that came near one",
    "path_length_m": "way of the driven-axle centre",
    "mean_speed_m_s": "path length by time",
    "command_change_rad_s2": "mean absolute change of the commanded yaw rate per time",
    "acceleration_rms_m_s2": "root mean square of the forward acceleration",
    "yaw_acceleration_rms_rad_s2": "root mean square of the yaw acceleration",
    "near_misses": "separate times below the near-miss distance that did not end in a collision",
    "near_s": "time below the near-miss distance",
}
OF_SUCCESSES = {"time_to_goal_s": "time of the episodes that arrived"}


@dataclass(frozen=True)
class Episodes:
    """Recorded episodes of one driver; arrays are numpy's."""

    trace: np.ndarray  # (N, T + 1, len(CHANNELS))
    ends: dict[str, np.ndarray]  # (N,)
    scene: Any  # leaves (N, ...)
    keys: jax.Array  # (N,) that repeat the episodes
    control_dt: float  # s

    @property
    def count(self) -> int:
        return len(self.ends["success"])

    @property
    def length(self) -> np.ndarray:
        """(N,) control periods."""
        return np.round(self.ends["time_s"] / self.control_dt).astype(int)

    def channel(self, name: str) -> np.ndarray:
        """(N, T + 1) one channel of the trace."""
        return self.trace[..., CHANNELS.index(name)]

    def some(self, index: np.ndarray) -> Episodes:
        """The episodes of these numbers."""
        scene = jax.tree.map(lambda leaf: leaf[index], self.scene)
        ends = {name: value[index] for name, value in self.ends.items()}
        return dataclasses.replace(self, trace=self.trace[index], ends=ends, scene=scene, keys=self.keys[index])


def _actions(episodes: Episodes) -> np.ndarray:
    """(N, T, 2) actions of each control period."""
    return np.stack([episodes.channel("action_v"), episodes.channel("action_omega")], -1)[:, 1:]


def episode_keys(seed: int, count: int) -> jax.Array:
    """(N,) keys of evaluation episodes; the first n are the same for every count."""
    return jax.vmap(lambda index: jax.random.fold_in(jax.random.key(seed), index))(jnp.arange(count))


class Course:
    """An environment that drivers are evaluated in; keeps what it has compiled."""

    def __init__(self, env: Env, params: VehicleParams, spread: float = 0.0, batch: int = 1000):
        """Take an environment, its nominal vehicle, a relative spread of its parameters, and episodes at a time."""
        self.env, self.params, self.spread, self.batch = env, params, spread, batch
        self._compiled: dict[Any, Callable[..., Any]] = {}

    def vehicles(self, keys: jax.Array) -> VehicleParams:
        """Vehicle of each episode, leaves (N, ...)."""
        nominal = jax.tree.map(jnp.asarray, self.params)
        if not self.spread:
            return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(keys), *leaf.shape)), nominal)
        return jax.vmap(lambda key: randomize_params(jax.random.fold_in(key, 2), nominal, self.spread))(keys)

    def drive(
        self,
        driver: Driver,
        keys: jax.Array,
        condition: Condition | None = None,
        params: VehicleParams | None = None,
        memory: Any = None,
        sight: str = "open",
    ) -> Episodes:
        """One episode per key; see `rollout` for the arguments."""
        params = self.vehicles(keys) if params is None else params
        late = 0 if condition is None else int(np.round(np.max(np.asarray(condition.latency))))
        run = self._rollout(driver, View(sight, late))
        size = -(-len(keys) // -(-len(keys) // self.batch))  # parts of one size, so that one program serves all
        parts = []
        for begin in range(0, len(keys), size):
            index = (begin + np.arange(size)) % len(keys)
            given = jax.tree.map(lambda leaf, index=index: leaf[index], (params, keys, condition, memory))
            parts.append(jax.device_get(run(driver.weights, *given)))
        whole = jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(keys)], *parts)
        return Episodes(whole.trace, whole.ends, whole.scene, keys, self.env.model.config.control_dt)

    def film(self, episodes: Episodes, batch: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Images of the camera (N, T + 1, H, W, 3) during recorded episodes, and views from above twice as high.

        The recorded actions are replayed, not decided again: a policy rounds otherwise in a batch of another size, and
        may then arrive where it collided. The views from above show the recorded places. One program of `batch`
        episodes films any number of them; None takes all at a time.
        """
        count = episodes.count
        size = batch or count
        parts = [self._film(episodes.some((begin + np.arange(size)) % count)) for begin in range(0, count, size)]
        frames, views = (np.concatenate(each)[:count] for each in zip(*parts, strict=True))
        return frames, views

    def _film(self, episodes: Episodes) -> tuple[np.ndarray, np.ndarray]:
        keys, actions = episodes.keys, _actions(episodes)
        params, memory = self.vehicles(keys), (jnp.asarray(actions), jnp.zeros(len(keys), jnp.int32))
        run = self._rollout(_REPLAY, View(frames=True))
        frames = jax.device_get(run(None, params, keys, None, memory).frames)

        def view(params: VehicleParams, key: jax.Array, scene: Any, row: jax.Array) -> jax.Array:
            state = reset_state(self.env, params, key)
            vehicle = place(self.env.model, on_ground(params, state.scene.ground), row[0], row[1], row[2])
            return top_view(self.env, dataclasses.replace(state, scene=scene, vehicle=vehicle))

        if "views" not in self._compiled:
            self._compiled["views"] = jax.jit(jax.vmap(jax.vmap(view, in_axes=(None, None, None, 0))))
        return frames, jax.device_get(self._compiled["views"](params, keys, episodes.scene, episodes.trace))

    def blinded(self, driver: Driver, keys: jax.Array, blind: str, sighted: Episodes) -> Episodes:
        """The same episodes without sight.

        Args:
            driver: who drove them.
            keys: of the episodes.
            blind: "blank" shows black images, "freeze" the first image, "replay" drives the actions that the sighted
                driver chose in ANOTHER of the episodes, open loop. In its own they would lead to the same end.
            sighted: the episodes driven with sight.
        """
        if blind not in BLINDS:
            raise ValueError(f"unknown blinding {blind!r}; use one of {BLINDS}.")
        if blind != "replay":
            return self.drive(driver, keys, sight=blind)
        if len(keys) < 2:
            raise ValueError("one episode has no other one to take the actions from; evaluate at least two.")
        memory = (jnp.asarray(np.roll(_actions(sighted), 1, axis=0)), jnp.zeros(len(keys), jnp.int32))
        return self.drive(_REPLAY, keys, memory=memory)

    def _rollout(self, driver: Driver, view: View) -> Callable[..., Rollout]:
        name = (driver, view)
        if name not in self._compiled:

            def run(weights: Any, params: Any, keys: Any, condition: Any, memory: Any) -> Rollout:
                given = dataclasses.replace(driver, weights=weights, memory=memory)
                return rollout(self.env, params, keys, given, condition, view=view)

            self._compiled[name] = jax.jit(run)
        return self._compiled[name]


def shares_of(episodes: Episodes) -> tuple[str, ...]:
    """Names of all endings: SHARES, and those that the task adds."""
    return (*SHARES, *sorted(set(episodes.ends) - {*SHARES, "time_s", "episode_return"}))


def other_endings(summary: Mapping[str, Any]) -> dict[str, float]:
    """Shares above 0 of the endings of a summary that are no success, collision or time-out, by name."""
    figures = {*SHARES[:3], *MEANS, *OF_SUCCESSES}
    names = [name for name in summary if name not in figures and f"{name}_interval_95" in summary]
    return {name: summary[name] for name in names if summary[name]}


def episode_figures(episodes: Episodes, near_m: float = NEAR_M) -> dict[str, np.ndarray]:
    """Figures (N,) of each episode, named as in SHARES, MEANS and OF_SUCCESSES; NaN where one does not apply."""
    dt, rows = episodes.control_dt, np.arange(episodes.trace.shape[1])[None]
    length = np.maximum(episodes.length, 1)
    driven = rows <= episodes.length[:, None]  # row 0 is the start
    moved = driven[:, 1:]
    steps = np.hypot(np.diff(episodes.channel("x")), np.diff(episodes.channel("y"))) * moved
    seconds = length * dt
    near = (episodes.channel("clearance") < near_m) & driven
    last_is_crash = (rows == episodes.length[:, None]) & (episodes.ends["collision"] > 0.5)[:, None]
    begins = near & ~np.pad(near, ((0, 0), (1, 0)))[:, :-1]
    crash_runs = np.any(near & last_is_crash, axis=1)  # the last stretch is the collision itself

    def rms(channel: str) -> np.ndarray:
        change = np.diff(episodes.channel(channel)) / dt
        return np.sqrt(np.sum(change**2 * moved, axis=1) / length)

    success = episodes.ends["success"] > 0.5
    return {
        **{name: episodes.ends[name].astype(float) for name in shares_of(episodes)},
        "return": episodes.ends["episode_return"].astype(float),
        "time_to_goal_s": np.where(success, episodes.ends["time_s"], np.nan),
        "min_clearance_m": np.where(driven, episodes.channel("clearance"), np.inf).min(1),
        "path_length_m": steps.sum(1),
        "mean_speed_m_s": steps.sum(1) / seconds,
        "command_change_rad_s2": np.sum(np.abs(np.diff(episodes.channel("omega_command"))) * moved, axis=1) / seconds,
        "acceleration_rms_m_s2": rms("v"),
        "yaw_acceleration_rms_rad_s2": rms("omega"),
        "near_misses": (begins.sum(1) - crash_runs).astype(float),
        "near_s": near.sum(1) * dt,
    }


def summarise(episodes: Episodes, near_m: float = NEAR_M) -> dict[str, Any]:
    """Figures of a set of episodes, each with its 95 % interval: Wilson's for shares, the bootstrap for means.

    A mean of one value has none: how far others would lie from it is not known.
    """
    figures = episode_figures(episodes, near_m)
    summary: dict[str, Any] = {"episodes": episodes.count, "near_m": near_m}
    for name in shares_of(episodes):
        happened = int((figures[name] > 0.5).sum())
        low, high = wilson_interval(happened, episodes.count)
        summary[name] = happened / episodes.count
        summary[f"{name}_interval_95"] = [max(0.0, low), min(1.0, high)]
    for name in (*MEANS, *OF_SUCCESSES):
        values = figures[name][np.isfinite(figures[name])]
        summary[name] = _mean(values)
        summary[f"{name}_interval_95"] = list(bootstrap_interval(values)) if len(values) > 1 else None
    summary["return_sd"] = float(figures["return"].std())
    summary["episodes_with_near_miss"] = float((figures["near_misses"] > 0).mean())
    nearest = np.sort(figures["min_clearance_m"])
    summary["min_clearance_m_quantiles"] = {name: _quantile(nearest, float(name)) for name in ("0.01", "0.05", "0.5")}
    return summary


def headline(name: str, summary: dict[str, Any]) -> str:
    """One line of the figures that matter most."""
    low, high = summary["success_interval_95"]
    seconds = summary["time_to_goal_s"]
    others = "".join(f"{ending} {share:.1%}  " for ending, share in other_endings(summary).items())
    return (
        f"{name:18s} success {summary['success']:6.1%} [{low:.1%}, {high:.1%}]  collision {summary['collision']:5.1%}  "
        f"time-out {summary['timeout']:5.1%}  {others}return {summary['return']:.1f}  "
        f"to the goal {'-' if seconds is None else f'{seconds:.2f} s'}  near misses {summary['near_misses']:.2f}"
    )


def _quantile(ordered: np.ndarray, share: float) -> float | None:
    """Quantile of values (N,) in rising order, between two of them; None where one is infinite, as far from all."""
    place = share * (len(ordered) - 1)
    two = ordered[int(place) : math.ceil(place) + 1]
    return float(two[0] + place % 1.0 * (two[-1] - two[0])) if np.isfinite(two).all() else None


def _mean(values: np.ndarray) -> float | None:
    return float(values.mean()) if len(values) else None
