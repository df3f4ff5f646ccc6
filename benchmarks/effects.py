"""The page of the effects, docs/effects.md, and the figure of their signatures, docs/images/effects.png.

    python -m benchmarks.effects page     # from the docstrings and parameters; a test keeps it up to date
    python -m benchmarks.effects figure   # drives the chair once with each effect
"""

from __future__ import annotations

import argparse
import inspect
import os
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.effects import EFFECTS, make_effect
from whill_mjx.effects.base import PLACES, Effect, place_of
from whill_mjx.logs.dataset import write_text
from whill_mjx.vehicle.dynamics import place, substep
from whill_mjx.vehicle.kinematics import body_twist
from whill_mjx.vehicle.model import build_model
from whill_mjx.vehicle.presets import preset
from whill_mjx.vehicle.types import VehicleParams, parameters_of

DOCS = Path(__file__).parent.parent / "docs"
INTRODUCTION = """# Effects

This page is the reference of all physical effects. `python -m benchmarks.effects page` makes it from the docstrings in
`whill_mjx/effects/`, which say more. [How to find which effect a vehicle has](close_loop.md).

A vehicle is a spec, a mass distribution and a tuple of effects. Each effect acts at one place. At its neutral values it
vanishes to the last bit (the two drives, `pid_drive` and `torque_drive`, then give no force).

Each table lists the parameters with their unit, the usual values on a real vehicle, the range that a fit may search,
and the neutral value. A source "estimate" is an engineering range without a published number behind it.

    python -m whill_mjx.drive --manoeuvre figure_eight --effects yaw_scrub:torque=6 slope:along_x=0.02 --out DATASET

![What each effect changes in one drive of the chair](images/effects.png)

The first panel shows the drive of the chair's physical base model. Every other panel is the difference that one effect
makes, at the end of its usual values that is further from neutral. The difference is in the speed or yaw rate of the
body, or in what is reported for effects of sensing. Scales differ.
"""
HEADINGS = {
    "command": "Command: before the controller sees (v, omega)",
    "actuation": "Actuation: from wheel-speed targets to force or torque",
    "force": "Force: wrenches on the chassis and torques on the wheels",
    "world": "World: true geometry, ground, gravity, load",
    "sensing": "Sensing: what is reported",
    "outside": "Outside: how a pose is measured from outside",
}
CLOSING = """## Which look alike
Odometry and outside pose of ordinary drives cannot separate these effects, or only barely. A fit frees one of each row,
or needs what the last column says.

| alike | why | what separates them |
|---|---|---|
| `slope`, `incline` | the same motion in other coordinates | height and attitude |
| `slope`, `wind` | both a force fixed in the room | a known load on board: only the slope's pull grows |
| `track_width`, `turn_efficiency` | the same on a skid drive | nothing |
| `command_delay`, `sensor_delay`, `clock_offset`, `state_rate` | shifts in time | outside pose sees the first alone |
| `command_delay`, `pose_delay` | shifts in time | odometry sees the first alone |
| `odometry_scale`, `command_scale`, `wheel_radius_difference` (common) | scales of distance | outside pose |
| `air_drag`, `quadratic_drag` | one law | wind |
| `rolling_resistance_speed`, `rolling_resistance` | hidden behind the speed control | coasting |
| `yaw_scrub`, `omni_roller_friction` | dry resistance to turning | outside pose, turning about other centres |
| `supply_sag`, `payload_shift` | slower response | weighing |
| `torque_saturation`, `traction_limit` | a cap on each side's force | another floor |

## Left out
- What the chair does when a command lapses (brake, ramp) is not documented; `command_expiry` takes a command of zero.
- A wheel touches the ground at one point. Surfaces are smooth and longer than a wheel; no kerb or step can be climbed.
- The cap of `traction_limit` ignores cornering, and its wheels never break away. `slip_traction` of the physical base
  model has both.
- `payload_shift` leaves out products of inertia. A real load that is both ahead of and above the centre of mass couples
  roll and yaw.
- Fits read no gyro. `gyro_bias` and `gyro_range` show only in the simulated gyro, and in `imu.csv` of a drive.
"""
CHANNELS = {
    "body v": ("m/s", 0.01), "body omega": ("rad/s", 0.02), "odometry v": ("m/s", 0.01),
    "odometry omega": ("rad/s", 0.02), "gyro": ("rad/s", 0.02),
}  # fmt: skip
SHOWN = {
    "command_expiry": {"validity": 0.2, "resend": 0.3}, "ramp": {"rise": 0.1, "length": 1.0, "distance": 0.8},
    "bump": {"rise": 0.03, "width": 0.3, "x": 1.0, "y": 0.25},
}  # fmt: skip
"""Values for the figure where the ends of the usual ones do not show in this drive."""
COLOURS = {"command": "C0", "actuation": "C1", "force": "C2", "world": "C3", "sensing": "C4"}
DRIVE = (
    (0.5, 0.0, 0.0), (2.0, 0.6, 0.0), (1.0, 0.0, 0.0), (2.0, 0.0, 0.6), (0.5, 0.0, 0.0), (2.0, 0.5, -0.6),
    (2.0, -0.4, 0.0), (0.5, 0.0, 0.0), (1.0, 0.04, 0.08), (1.0, -0.04, -0.08), (0.5, 0.0, 0.0),
)  # fmt: skip
"""Seconds, v and omega: straight, turn, curve, reverse, and a slow part that a dead zone swallows."""
BASE = ("pid_drive", "forward_slip", "rolling_contact", "lateral_damping", "air_drag", "rolling_resistance",
        "torque_drive", "slip_traction", "odometry_lag")  # fmt: skip


def page() -> str:
    """docs/effects.md as text."""
    parts = [INTRODUCTION]
    for where in PLACES:
        names = sorted(name for name, kind in EFFECTS.items() if place_of(make_effect(name)) == where)
        rows = "\n".join(row(EFFECTS[name]) for name in names)
        parts.append(f"## {HEADINGS[where]}\n| effect | equation | parameters | source |\n|---|---|---|---|\n{rows}\n")
    return "\n".join([*parts, CLOSING])


def row(kind: type[Effect]) -> str:
    """One line of a table: name, first paragraph of the docstring, parameters and source."""
    equation = " ".join(inspect.getdoc(kind).split("\n\n")[0].split())  # type: ignore[union-attr]
    equation = equation.partition(" Source:")[0].partition(" Typical ")[0]
    texts = []
    for name, about in parameters_of(kind).items():
        low, high = kind.typical.get(name, (about.neutral, about.neutral))
        usual = f"{low:g}" if low == high else f"{low:g} to {high:g}"
        texts.append(
            f"`{name}` [{about.unit}] {about.description}: {usual}; search {about.low:g} to {about.high:g}; "
            f"neutral {about.neutral:g}"
        )
    cells = [f"`{kind.name}`", equation, "<br>".join(texts), kind.source]
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def shown_values(name: str) -> dict[str, float]:
    """The end of each parameter's usual values that is further from neutral, or what SHOWN says."""
    if name in SHOWN:
        return SHOWN[name]
    about, values = parameters_of(EFFECTS[name]), {}
    for field, (low, high) in EFFECTS[name].typical.items():
        neutral = about[field].neutral
        values[field] = high if np.isfinite(neutral) and abs(high - neutral) >= abs(low - neutral) else low
    return values


def signatures() -> tuple[np.ndarray, np.ndarray, list[str], np.ndarray]:
    """Drive the chair without and with each effect, all in one compiled call.

    Returns:
        Times (T,), commands (T, 2), names of the effects, and channels (1 + names, T, 5), the first without effect.
    """
    spec, params = preset("whill_cr_physical")
    model = build_model(spec)
    names = [name for where in COLOURS for name in EFFECTS if name not in BASE and place_of(make_effect(name)) == where]
    have = {effect.name for effect in params.effects}
    params = replace(params, effects=(*params.effects, *(make_effect(name) for name in names if name not in have)))

    def with_shown(name: str) -> VehicleParams:
        shown = make_effect(name, **shown_values(name))
        return replace(params, effects=tuple(shown if effect.name == name else effect for effect in params.effects))

    dt, stride = model.config.physics_dt, 4
    held = np.concatenate([np.tile([v, omega], (round(seconds / dt), 1)) for seconds, v, omega in DRIVE])
    commands = jnp.asarray(held.reshape(-1, stride, 2), jnp.float32)

    def one(params: VehicleParams) -> jax.Array:
        def record(state, given):
            state = jax.lax.scan(lambda s, c: (substep(model, params, s, c), None), state, given)[0]
            v, omega = body_twist(model, state.qpos, state.qvel)
            reported = state.odometry
            return state, jnp.stack([v, omega, reported.v, reported.omega, reported.gyro])

        return jax.lax.scan(record, place(model, params, 0.0, 0.0, 0.0), commands)[1]

    variants = [params, *(with_shown(name) for name in names)]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *variants)
    seen = np.asarray(jax.jit(jax.vmap(one))(batch))
    return (np.arange(len(commands)) + 1) * dt * stride, held[stride - 1 :: stride], names, seen


def draw(path: Path) -> None:
    """The figure of all signatures."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    t, commands, names, seen = signatures()
    difference = seen[1:] - seen[0]
    scales = np.array([scale for _, scale in CHANNELS.values()])
    columns = 5
    rows = -(-(len(names) + 1) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(15, 1.75 * rows), sharex=True, constrained_layout=True)
    panels = axes.ravel()
    panels[0].plot(t, commands[:, 0], "k", lw=1.2, label="v [m/s]")
    panels[0].plot(t, commands[:, 1], "k", lw=1.2, ls=":", label="omega [rad/s]")
    panels[0].set_title("the drive: commands", fontsize=9, loc="left")
    panels[0].legend(fontsize=7, loc="lower left", frameon=False)
    for panel, name, change in zip(panels[1:], names, difference, strict=False):
        where = place_of(make_effect(name))
        strength = np.abs(change).max(0) / scales
        # A body channel unless the effect is in the sensors alone.
        channel = int(strength.argmax()) if where == "sensing" else int(strength[:2].argmax())
        label, (unit, _) = list(CHANNELS)[channel], list(CHANNELS.values())[channel]
        panel.plot(t, change[:, channel], COLOURS[where], lw=1.0)
        panel.axhline(0.0, color="0.8", lw=0.6, zorder=0)
        panel.set_title(name, fontsize=9, loc="left", color=COLOURS[where])
        panel.set_ylabel(f"{label}\n[{unit}]", fontsize=7)
    for panel in panels:
        panel.tick_params(labelsize=7)
        panel.set_xlim(0, t[-1])
        panel.locator_params(axis="y", nbins=4)
        for edge in np.cumsum([part[0] for part in DRIVE])[:-1]:
            panel.axvline(edge, color="0.92", lw=0.6, zorder=0)
    for panel in panels[len(names) + 1 :]:
        panel.set_visible(False)
    for panel in panels[-columns:]:
        panel.set_xlabel("t [s]", fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}")
    figure.savefig(temporary, dpi=100, format="png")
    os.replace(temporary, path)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.effects", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("page", "figure"))
    if parser.parse_args().what == "page":
        write_text(DOCS / "effects.md", page())
    else:
        draw(DOCS / "images" / "effects.png")
