"""What an effect is, and how a tuple of effects acts together.

An effect is a frozen pytree whose leaves are its own parameters. It acts at one place, by one method named after the
place:

    command(memory, command (2,), motion)   -> memory, command     delay, dead zone, limiter
    actuation(memory, Drive, motion)        -> memory, Drive       controller, lag, saturation
    force(memory, motion)                   -> memory, Wrench      friction, slip, drag; those that react come last
    world(memory, World)                    -> memory, World       slope, ground, true geometry
    sensing(memory, Odometry, motion)       -> memory, Odometry    odometry scale, low-pass, latency
    outside(memory, path (R, 3), dt)        -> memory, path        latency and mount of an outside pose; replays only

Effects of one place act in the order of the tuple; forces add up. At its neutral values an effect vanishes exactly.
`init()` gives the memory it starts with.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from whill_mjx.effects.card import Card
from whill_mjx.io.registry import failed
from whill_mjx.vehicle.types import Motion, World, Wrench

TINY = 1e-12  # keeps divisions defined at a step or a width of 0
PLACES = ("command", "actuation", "force", "world", "sensing", "outside")


class Effect:
    """Base of all effects. An effect has no memory unless it defines `init`."""

    name: ClassVar[str] = ""
    typical: ClassVar[dict[str, tuple[float, float]]] = {}
    """Usual values on a real vehicle by parameter, lowest and highest."""
    source: ClassVar[str] = ""
    """Where equation and usual values come from; "estimate" where no source is known."""
    reacts: ClassVar[bool] = False
    """Whether an effect of place `force` depends on the drive and all other forces (`motion.others`): it acts last."""
    room_fixed: ClassVar[bool] = False
    """Whether the motion depends on where in the room the vehicle starts and which way it faces."""
    card: ClassVar[Card] = Card()
    """What the closed loop needs to look for the effect in a log."""

    def init(self) -> Any:
        """Memory at the start of a drive."""
        return ()


class Surface(Effect):
    """Base of effects that shape the ground. They define `height(x, y)`; see `whill_mjx.vehicle.ground`."""

    room_fixed = True

    def world(self, memory: tuple[()], world: World) -> tuple[tuple[()], World]:
        """World with this surface on its ground."""
        return memory, replace(world, ground=(*world.ground, self))


def place_of(effect: Effect | type[Effect]) -> str:
    """The one place where an effect or its class acts; TypeError if it has none or several."""
    places = [place for place in PLACES if hasattr(effect, place)]
    if len(places) != 1:
        name = effect.__name__ if isinstance(effect, type) else type(effect).__name__
        raise TypeError(f"effect {name} acts at {places}; an effect has exactly one of {PLACES}.")
    return places[0]


def act(effect: Any, place: str, memory: Any, *inputs: Any) -> tuple[Any, Any]:
    """Memory, and what an effect makes of its inputs.

    ValueError, in one line, where an effect of a user's own fails, or gives something else than its place asks for.
    That is seen while it is traced, so it costs nothing once compiled.
    """
    method = getattr(effect, place)
    if type(effect).__module__.startswith("whill_mjx."):
        return method(memory, *inputs)
    what = f"effect {effect.name!r}"
    try:
        found = method(memory, *inputs)
    except (Exception, SystemExit) as error:
        raise failed(what, type(effect), place, error) from error
    if not isinstance(found, tuple) or len(found) != 2:
        raise ValueError(f"{what}: {place} returns {type(found).__name__}; it must be the pair (memory, {place}). "
                         "Correct the method.")
    wanted = Wrench.zero() if place == "force" else inputs[0]
    other = _difference("memory", found[0], memory) or (  # surfaces add to the ground of a world
        "" if place == "world" else _difference(place, found[1], wanted))
    if other:
        raise ValueError(f"{what}: of the pair (memory, {place}) that {place} returns, {other}. Correct the method, or "
                         "the memory of init.")
    return found


def _difference(name: str, given: Any, wanted: Any) -> str:
    """How a value differs from another in type, in shape or in kind of number; empty where it does not."""
    if str(jax.tree.structure(given)) != str(jax.tree.structure(wanted)):
        return f"{name} is {type(given).__name__}; it must be {type(wanted).__name__}, with the same parts"
    for (way, one), other in zip(jax.tree_util.tree_leaves_with_path(given), jax.tree.leaves(wanted), strict=True):
        found, needed = ((jnp.result_type(leaf), jnp.shape(leaf)) for leaf in (one, other))
        if found[1] != needed[1] or found[0].kind != needed[0].kind:
            return (f"{name}{jax.tree_util.keystr(way)} is {found[0]} of shape {found[1]}; it must be {needed[0]} of "
                    f"shape {needed[1]}")
    return ""


def apply_chain(effects: tuple, memory: tuple, place: str, value: Any, *context: Any) -> tuple[tuple, Any]:
    """Pass `value` through every effect of `place` in order; returns the new memory and value."""
    memory_list = list(memory)
    for index, effect in enumerate(effects):
        if place_of(effect) == place:
            memory_list[index], value = act(effect, place, memory_list[index], value, *context)
    return tuple(memory_list), value


def sum_forces(effects: tuple, memory: tuple, motion: Motion, reacts: bool) -> tuple[tuple, Wrench]:
    """New memory, and the summed wrench of the effects of place `force` that react, or of those that do not."""
    memory_list = list(memory)
    total = Wrench.zero()
    for index, effect in enumerate(effects):
        if place_of(effect) == "force" and effect.reacts == reacts:
            memory_list[index], wrench = act(effect, "force", memory_list[index], motion)
            total = total + wrench
    return tuple(memory_list), total


def contact_wrench(motion: Motion, forward: jax.Array, left: jax.Array, normal: jax.Array | float = 0.0) -> Wrench:
    """Wrench of forces (4,) [N] at the contact patches, along the ground axes forward, left and normal."""
    axes = motion.contact_axes
    normal = jnp.broadcast_to(normal, (4,))
    fx, fy, fz = (forward * axes[0, i] + left * axes[1, i] + normal * axes[2, i] for i in range(3))  # each (4,)
    x, y, z = motion.contact_points
    return Wrench(
        fx.sum(), fy.sum(), fz.sum(),
        (y * fz - z * fy).sum(), (z * fx - x * fz).sum(), (x * fy - y * fx).sum(),
        jnp.zeros(2),
    )  # fmt: skip


def yaw_rate(motion: Motion) -> jax.Array:
    """Yaw rate of the chassis about the ground's normal [rad/s]."""
    return (motion.ground_axes[2] * motion.angular_velocity).sum()


def per_side(values: jax.Array) -> jax.Array:
    """Sums (2,) over the left and the right wheels of values (2 A,) of A axles, left and right of each."""
    return jnp.stack([sum((values[k] for k in range(side + 2, len(values), 2)), values[side]) for side in (0, 1)])


def to_contacts(values: jax.Array, axles: int = 2) -> jax.Array:
    """Values (2,) of the left and right side at each of the contacts (2 A,) of A axles."""
    return jnp.stack([values[0], values[1]] * axles)


def per_axle(values: jax.Array) -> jax.Array:
    """Sums (A,) over the contacts of each axle, from rear to front, of values (2 A,)."""
    return jnp.stack([values[k] + values[k + 1] for k in range(0, len(values), 2)])


def to_axles(values: jax.Array) -> jax.Array:
    """Values (A,) of axles, from rear to front, at each of their contacts (2 A,)."""
    return jnp.stack([values[k // 2] for k in range(2 * len(values))])


def driven_mean(motion: Motion, values: jax.Array) -> jax.Array:
    """Mean (2,) over the driven contacts of each side of values (4,)."""
    driven = motion.world.geometry.driven
    return per_side(values * driven) / per_side(driven)


def side_forces(motion: Motion, force: jax.Array) -> jax.Array:
    """Forces (4,) at the contacts for the drive force (2,) of each side, shared by the driven contacts."""
    driven = motion.world.geometry.driven
    return to_contacts(force) * driven / (driven.sum() / 2)


def resting_mass(motion: Motion) -> jax.Array:
    """Mass (4,) [kg] that the contacts carry at rest on level ground, the same on both sides."""
    x = motion.world.geometry.contact_x
    front = jnp.clip((motion.com[0] - x[0]) / (x[2] - x[0]), 0.01, 0.99)
    return motion.total_mass / 2 * jnp.stack([1 - front, 1 - front, front, front])


def in_steps(value: jax.Array, step: jax.Array) -> jax.Array:
    """Values of any shape rounded to multiples of `step`; unchanged where the step is 0."""
    return jnp.where(step > 0, step * jnp.round(value / jnp.maximum(step, TINY)), value)
