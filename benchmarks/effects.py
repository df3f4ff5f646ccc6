"""The page of the effects, docs/effects.md, and the figure of their signatures, docs/images/effects.png.

    python -m benchmarks.effects page     # from docstrings, parameters and cards; a test keeps it up to date
    python -m benchmarks.effects figure   # drives the chair once with each effect
"""

from __future__ import annotations

import argparse
import math
import os
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from bridge.nodes.options import Parser
from whill_mjx import share_results
from whill_mjx.effects import EFFECTS, equation, make_effect
from whill_mjx.effects.base import PLACES, Effect, place_of
from whill_mjx.effects.card import Alike, Axis, Scale
from whill_mjx.io.command_line import guarded
from whill_mjx.logs.dataset import write_text
from whill_mjx.vehicle.dynamics import place, substep
from whill_mjx.vehicle.kinematics import body_twist
from whill_mjx.vehicle.model import build_model
from whill_mjx.vehicle.parameters import describe
from whill_mjx.vehicle.presets import preset
from whill_mjx.vehicle.types import VehicleParams, parameters_of

DOCS = Path(__file__).parent.parent / "docs"
INTRODUCTION = """# Effects

This page is the reference of all physical effects. `python -m benchmarks.effects page` makes it from the classes in
`whill_mjx/effects/`, whose docstrings say more. [How to find which effect a vehicle has](close_loop.md).

A vehicle is a spec, a mass distribution and a tuple of effects. Each effect acts at one place. At its neutral values it
vanishes to the last bit (the two drives, `pid_drive` and `torque_drive`, then give no force).

Each table lists the parameters with their unit, the usual values on a real vehicle, the range that a fit may search,
and the neutral value. The range is the chair's: on another vehicle masses, forces and torques go with its mass and
wheel radius. A source "estimate" is an engineering range without a published number behind it.

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
CARDS = """## What the closed loop looks for
`sysid.close_loop` looks for these effects in a log, in this order. Each line of the second column is one way in which
the effect may be missing: the parameters that it frees, at a size that is small but noticeable. Forces and masses grow
with the vehicle; the table is for the chair (`turn_efficiency`: for the Husky). "either way" marks sizes of both signs,
"form" a parameter that only changes what the others do. The loop does not name an effect if the drives contradict one
of its predictions. The next column says what measures the effect by itself, where no drive separates it from another.
The last one says whether an outside pose shows it without odometry.

| effect | frees, at size 1 | its law predicts that the effect | measured by | pose alone |
|---|---|---|---|---|
"""
ALIKE = """## Which look alike
Odometry and outside pose of ordinary drives cannot separate these effects, or only barely. Free one of each row in a
fit, or add what the last column says.

| alike | why | what separates them |
|---|---|---|
"""
LEFT_OUT = """## Left out
- A wheel touches the ground at one point. Surfaces are smooth and longer than a wheel; no kerb or step can be climbed.
"""
ADDING = """## Add an effect
Write one file with a class like those in `whill_mjx/effects/`: parameters with their ranges, one method named after its
place, and a `card` (`whill_mjx/effects/card.py`) that says what the loop may free, how large, and what the law forbids.

- A file in this package is found by itself. Give the card an `order` after all others, and write this page again.
- In another package, declare the class as an entry point of the group `whill_mjx.effects`. Every command then knows it.
- In a program or notebook, call `whill_mjx.effects.register(MyEffect)`. Only this process then knows it.

Simulator, vehicle files, fits and the closed loop know the effect by its name from then on.
`tests/sysid/outside_effect.py` is a complete example.
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
"""Effects without which the base models do not drive; the figure leaves them out."""


def page() -> str:
    """docs/effects.md as text."""
    parts = [INTRODUCTION]
    for where in PLACES:
        rows = "\n".join(row(kind) for kind in own_effects() if place_of(kind) == where)
        parts.append(f"## {HEADINGS[where]}\n| effect | equation | parameters | source |\n|---|---|---|---|\n{rows}\n")
    looked_for = sorted((kind for kind in own_effects() if kind.card.variants), key=lambda kind: kind.card.order)
    parts.append(CARDS + "".join(card_row(kind) for kind in looked_for))
    parts.append(ALIKE + "".join(alike_row(kind.name, one) for kind in own_effects() for one in kind.card.alike))
    limits = [f"- `{kind.name}`: {kind.card.limits}\n" for kind in own_effects() if kind.card.limits]
    parts.append(LEFT_OUT + "".join(limits))
    return "\n".join([*parts, ADDING])


def own_effects() -> list[type[Effect]]:
    """The effects of this package by name, without those of other installed packages."""
    return [kind for kind in EFFECTS.values() if kind.__module__.startswith("whill_mjx.")]


def card_row(kind: type[Effect]) -> str:
    """One line of the table of what the closed loop looks for."""
    scales = [Scale(spec, frozenset(describe(params))) for spec, params in map(preset, ("whill_cr_physical", "husky"))]
    variants = next(found for scale in scales if (found := kind.card.variants_of(scale)))
    frees = "<br>".join(", ".join(axis_in_words(kind.name, axis) for axis in one.axes) for one in variants)
    laws = "; ".join(dict.fromkeys(one.says for one in kind.card.forbids))
    sensor, alone = kind.card.sensor or "motor currents", "yes" if kind.card.shown_by_pose else "no"
    return f"| `{kind.name}` | {frees} | {laws} | {sensor} | {alone} |\n"


def axis_in_words(effect: str, axis: Axis) -> str:
    """What an axis of a hypothesis does to its parameter at size 1."""
    holder, _, field = axis.parameter.rpartition(".")
    unit = parameters_of(EFFECTS[holder or effect])[field].unit.replace("-", "")
    change = {"add": f"{axis.unit:+.3g} {unit}", "inverse": f"{axis.unit:.3g} {unit}",
              "factor": f"times {math.exp(axis.unit):.3g}", "moment": f"{axis.unit:.3g} kg m over the mass",
              "along": f"{axis.unit:+.3g} {unit}".strip() + " per size of the first"}[axis.form].strip()
    notes = [text for text, holds in (("either way", axis.signed), ("form", axis.dependent)) if holds]
    return f"`{axis.parameter}` {change}" + (f" ({', '.join(notes)})" if notes else "")


def alike_row(name: str, one: Alike) -> str:
    """One line of the table of effects that look alike."""
    return f"| {', '.join(f'`{each}`' for each in (name, *one.names))} | {one.why} | {one.separated_by} |\n"


def row(kind: type[Effect]) -> str:
    """One line of a table: name, first paragraph of the docstring, parameters and source."""
    texts = []
    for name, about in parameters_of(kind).items():
        low, high = kind.typical.get(name, (about.neutral, about.neutral))
        usual = f"{low:g}" if low == high else f"{low:g} to {high:g}"
        texts.append(
            f"`{name}` [{about.unit}] {about.description}: {usual}; search {about.low:g} to {about.high:g}; "
            f"neutral {about.neutral:g}"
        )
    cells = [f"`{kind.name}`", equation(kind), "<br>".join(texts), kind.source]
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def shown_values(name: str) -> dict[str, float]:
    """The values of `SHOWN`, or the end of each parameter's usual values that is further from neutral."""
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
    shown = [kind for kind in own_effects() if kind.name not in BASE]
    names = [kind.name for where in COLOURS for kind in shown if place_of(kind) == where]
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
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

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
        where = place_of(EFFECTS[name])
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
    colours = {f"place: {where}": plt.Line2D([], [], color=colour) for where, colour in COLOURS.items()}
    figure.suptitle("What each effect changes: the drive with it, less the drive without it", fontsize=11)
    figure.legend(colours.values(), colours.keys(), loc="outside lower right", ncols=len(COLOURS), frameon=False)
    figure.savefig(temporary, dpi=100, format="png")
    about = PngInfo()
    about.add_text("Description", " ".join(sorted(names)))  # a test reads which effects the picture shows
    with Image.open(temporary) as picture:
        small = picture.convert("RGB").quantize(64, dither=Image.Dither.NONE)
    small.save(temporary, format="PNG", optimize=True, pnginfo=about)
    os.replace(temporary, path)


if __name__ == "__main__":
    with guarded():
        share_results()
        parser = Parser(
            prog="python -m benchmarks.effects", description=__doc__,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        parser.add_argument("what", choices=("page", "figure"))
        if parser.parse_args().what == "page":
            write_text(DOCS / "effects.md", page())
        else:
            draw(DOCS / "images" / "effects.png")
