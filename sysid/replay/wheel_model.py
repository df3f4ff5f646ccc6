"""The model of a log without commands: a body on wheels whose speeds were measured.

Such a log determines the wheels' radius, their distance, and where the tracked point is; slip along and scrub act as a
smaller radius and a larger track. Nothing of the drive, its delays or the commands' scale shows.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp

from sysid.replay.models import Model, function_model, with_effects
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import Body, VehicleParams

DT = 0.005  # s; halves of the usual intervals between samples are multiples of it
NOTE = ("the log has no commands: measured wheel speeds are the input. Radius and track are effective ones, slip and "
        "scrub included; drive, delays of commands and their scale are left out. The outside pose's delay is how much "
        "older it is than the wheel speeds, which a filter may have made old themselves")


def wheel_model(spec: VehicleSpec) -> Model:
    """The model of a vehicle with measured wheel speeds as its command: v and omega at the nominal radius and track.

    Parameters: mean `radius` of the wheels [m], `radius_difference` (right less left, over the mean), effective `track`
    [m], the tracked point `ahead` and `left` of the point that does not slide sideways [m], and how much older the
    outside pose is than the wheel speeds [s], which drivers filter: a pose of 100 ms beside speeds of 30 ms shows as 70
    ms.
    """
    nominal_radius, nominal_track = spec.wheel_radius, spec.track
    reach = max(2 * nominal_track, 0.5)

    def step(p: dict[str, jax.Array], state: jax.Array, command: jax.Array) -> jax.Array:
        x, y, yaw = state[0], state[1], state[2]
        half = command[1] * nominal_track / 2
        scale = p["radius"] / nominal_radius
        left = scale * (1 - p["radius_difference"] / 2) * (command[0] - half)
        right = scale * (1 + p["radius_difference"] / 2) * (command[0] + half)
        v, omega = (left + right) / 2, (right - left) / p["track"]
        along, across = v - p["left"] * omega, p["ahead"] * omega
        middle = yaw + omega * DT / 2
        cos, sin = jnp.cos(middle), jnp.sin(middle)
        return jnp.stack([x + DT * (cos * along - sin * across), y + DT * (sin * along + cos * across),
                          yaw + DT * omega, command[0], command[1]])

    model = function_model(step, {
        "radius": (nominal_radius, 0.5 * nominal_radius, 2 * nominal_radius, "m"),
        "radius_difference": (0.0, -0.2, 0.2),
        "track": (nominal_track, 0.5 * nominal_track, 5 * nominal_track, "m"), "ahead": (0.0, -reach, reach, "m"),
        "left": (0.0, -reach, reach, "m")}, dt=DT, name=f"{spec.name} on measured wheels")
    late = with_effects(VehicleParams(Body(), ()), ("pose_delay",)).effects
    return replace(model, params=replace(model.params, effects=late), notes=(NOTE,))
