"""What each law of skid-steered robots gains on the measured robot, asked of nothing but its prediction.

The loop names a law where simulated nulls and blocks of drives speak for it. This asks for less: the base model is
fitted to the training steps, one law is added, and the held-out steps are predicted, once with the law's own parameters
fitted (`alone`) and once with all of them. A law that gains nothing here is not in the drives; one that gains and is
never named is lost in the search.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sysid.errors.space import FIXED, make_space
from sysid.logs.records import Log, Prediction, Trial
from sysid.missing.catalogue import base_values
from sysid.missing.drives import Drives, make_drives
from sysid.missing.pose_fit import fit_poses
from sysid.missing.reference import make_reference
from sysid.replay.models import gyro_effects, with_effects
from sysid.replay.records import FreeVehicle
from sysid.replay.rollout import predictions, vehicle_plant
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.parameters import describe, set_values
from whill_mjx.vehicle.presets import preset_params

STARTS = {
    "pose_delay": {"delay": 0.3}, "motor_line": {"no_load_speed": 5.0, "droop": 0.002},
    "turn_lag": {"time_constant": 0.3}, "turn_efficiency_speed": {"per_speed": 0.01},
    "turning_slip": {"per_yaw_rate": 0.02}, "side_slip": {"per_yaw_rate": 0.05},
    "acceleration_limit": {"linear": 3.0, "angular": 3.0},
}  # fmt: skip
"""Where the fit of each law starts, off the end of its range."""
ITERATIONS = 12
Errors = dict[str, list[float]]


@dataclass(frozen=True)
class Bench:
    """Training and held-out steps through one compiled replay of a vehicle with all laws, which do nothing yet."""

    log: Log
    params: Any
    base: tuple[str, ...]
    """Parameters of the base model."""
    training: Drives
    held_out: Drives

    def fitted(self, params: Any, names: tuple[str, ...]) -> Any:
        """The vehicle with some of its parameters fitted to whole poses, speeds and the gyro."""
        space = make_space(params, self.log.spec, names)
        held = np.array([base_values(params)[name] for name in self.training.names])
        spread = np.zeros((space.size, space.size))
        u = fit_poses(self.training, space, held, spread, ITERATIONS)
        return params if u is None else set_values(params, names, jnp.asarray(space.to_values(u)))

    def predicted(self, params: Any) -> list[Prediction]:
        """The held-out steps as a vehicle drives them."""
        values = np.array([base_values(params)[name] for name in self.held_out.names])
        simulated = self.held_out.replay(values[None])
        return predictions(self.log.held_out, jax.tree.map(lambda leaf: leaf[0], simulated))


def make_bench(log: Log, physics_dt: float, iterations: int) -> Bench:
    """The base model, with a turn efficiency and the gyro's errors, fitted to the motion of the training steps."""
    plant = vehicle_plant(log.spec, VehicleConfig(physics_dt=physics_dt))
    start = with_effects(preset_params(log.spec, "physical"), ("turn_efficiency", *gyro_effects(log.training)))
    base = tuple(name for name in describe(start) if name not in FIXED)
    full = with_effects(start, tuple(STARTS))
    reference = make_reference(FreeVehicle(plant, full, base), (log,), False, iterations,
                               lambda _, text: print(f"  {text}", flush=True))
    names = tuple(base_values(full))
    training = make_drives(FreeVehicle(plant, full, names), log.training, reference.width)
    held_out = training.of(log.held_out)
    return Bench(log, reference.params, base, training, held_out)


def ablate(bench: Bench, errors: Callable[[tuple[Trial, ...], list[Prediction]], Errors],
           found: Callable[[str, Callable[[], Errors]], Errors]) -> dict[str, Errors]:
    """Held-out errors of the base model ("base") and with each law, alone ("LAW alone") and with all refitted ("LAW").

    Args:
        errors: of predictions of trials.
        found: (name, compute) -> errors, computed or as an earlier run left them.
    """
    def judged(vehicle: Any) -> Errors:
        return errors(bench.log.held_out, bench.predicted(vehicle))

    base = bench.fitted(bench.params, bench.base)
    rows = {"base": found("base", lambda: judged(base))}
    for law, start in STARTS.items():
        own = tuple(f"{law}.{field}" for field in start)
        begun = set_values(base, own, jnp.asarray(list(start.values())))

        def alone(begun: Any = begun, own: tuple[str, ...] = own) -> Errors:
            vehicle = bench.fitted(begun, own)
            print(", ".join(f"{name} {base_values(vehicle)[name]:.3g}" for name in own), flush=True)
            return judged(vehicle)

        def together(begun: Any = begun, own: tuple[str, ...] = own) -> Errors:
            vehicle = bench.fitted(begun, (*bench.base, *own))
            print(", ".join(f"{name} {base_values(vehicle)[name]:.3g}" for name in own), "with all", flush=True)
            return judged(vehicle)

        rows[f"{law} alone"] = found(f"{law}_alone", alone)
        rows[law] = found(law, together)
    return rows
