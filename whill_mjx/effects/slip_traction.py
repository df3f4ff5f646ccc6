"""Friction-limited slip between wheels and ground."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect, contact_wrench, per_axle, per_side, to_axles, to_contacts
from whill_mjx.effects.planar import at_contacts, at_wheels, held, loads_of_wheels, look_ahead
from whill_mjx.vehicle.types import Motion, Wrench, parameter

ROUNDS = 2  # of the implicit step
NEWTON = 2  # steps for the sliding speed beyond the creep
TINY = 1e-6  # [N], [m/s] or [-], keeps ratios defined without grip and slopes defined without sliding


@struct.dataclass
class SlipTraction(Effect):
    """Slip force of driven wheels in a friction circle: mu N q / sqrt(1 + q^2), q^2 = (s_x / s0)^2 + (s_y / s0_y)^2.

    s = (r spin - v_x, -v_y) is the sliding velocity at each driven contact. At the sliding speeds s0 (along the wheel)
    and s0_y (across it) the force has 1/sqrt(2) of its limit.

    A tyre creeps as its force bends it, by s0_i F_i / (mu N) in each direction i. Beyond that it slides against its
    force, by p F / (mu N). So F_i = mu N s_i / (s0_i + p), with the p that gives F its size. For a wheel that slides,
    this is Coulomb friction mu N against the sliding velocity, for any s0. A wheel that creeps across, as all do in a
    bend, grips along as it does on a straight. With sqrt(s0_i^2 + |s|^2) instead of s0_i + p it would not: 6 mm/s
    across would make a wheel of s0 = 1 mm/s six times softer along.

    The wheel gets the reaction -r F_x. Both are advanced implicitly: F is that at the speeds of wheels and chassis
    after the step, so any s0 and s0_y are stable at any step. Passive wheels roll; they carry at most `mu_free` N,
    sideways.
    """

    name = "slip_traction"
    reacts = True
    typical = {"mu": (0.2, 0.9), "slip_speed": (0.005, 0.1), "side_slip_speed": (0.02, 0.1), "mu_free": (0.0, 0.1)}
    source = "estimate: 0.6 to 0.9 dry, 0.2 to 0.4 wet"
    mu: jax.Array = parameter("-", 0.05, 1.5, 0.0, "friction coefficient of driven wheels")
    slip_speed: jax.Array = parameter("m/s", 0.0005, 2.0, 0.05, "sliding speed along the wheel at 71 % grip, s0")
    side_slip_speed: jax.Array = parameter("m/s", 0.001, 2.0, 0.05, "sliding speed across it at 71 % grip, s0_y")
    mu_free: jax.Array = parameter("-", 0.0, 1.0, 0.0, "sideways friction coefficient of passive wheels")

    def force(self, memory: tuple[()], motion: Motion) -> tuple[tuple[()], Wrench]:
        """Wrench of the slip forces, and their reaction on the driven wheels."""
        geometry = motion.world.geometry
        radius = geometry.wheel_radius  # (2,)
        loads, driven = loads_of_wheels(motion), at_wheels(motion, geometry.driven)
        axles = len(loads) // 2
        slide_x = to_contacts(radius * motion.spin, axles) - at_wheels(motion, motion.contact_vx)
        slide_y = -at_wheels(motion, motion.contact_vy)
        grip = self.mu * loads * driven
        carried = self.mu_free * loads * (1 - driven)
        relaxation, yielding = motion.dt / motion.wheel_inertia, motion.yielding
        slope = yielding.factor * yielding.slope
        unlimited = yielding.factor * (yielding.slack + yielding.slope * yielding.foreseen)  # [N m] at spin 0
        free_spin = motion.spin + relaxation * (motion.drive_torque + motion.others.spin_torque)
        ahead = look_ahead(motion)
        forward = ahead.forward
        for _ in range(ROUNDS):
            # Forces of the form stiffness * sliding, the stiffness taken at the sliding of the previous round.
            beyond = self._beyond_creep(slide_x, slide_y)
            stiffness = grip / (self.slip_speed + beyond)  # [N s/m]
            across = grip / (self.side_slip_speed + beyond)
            sideways = across + carried / jnp.sqrt(slide_y**2 + self.side_slip_speed**2)
            # Implicit step of the spin, I (w' - w) / dt = T - r C (r w' - v'), put into the force C (r w' - v'). The
            # torque is T + unlimited - slope w', or at a limit.
            total = per_side(stiffness)
            line = (free_spin + relaxation * (unlimited + radius * total * forward)) / (
                1 + relaxation * (slope + radius**2 * total))
            change, inside = yielding.change(line)
            change = jnp.where(inside, unlimited, yielding.factor * change)
            stays = 1 + relaxation * jnp.where(inside, slope, 0.0)
            wanted = (free_spin + relaxation * change) / stays
            pulled = 1 + relaxation / stays * radius**2 * total
            forward, left = held(motion, ahead, total / pulled, radius * wanted, per_axle(sideways))
            spin = (wanted + relaxation / stays * radius * total * forward) / pulled
            slide_x, slide_y = to_contacts(radius * spin - forward, axles), -to_axles(left)
        forward, left = stiffness * slide_x, across * slide_y
        # A wheel that a large torque spins up within the step would leave the friction circle.
        excess = jnp.maximum(1.0, jnp.sqrt(forward**2 + left**2 + TINY) / (grip + TINY))
        forward, left = forward / excess, left / excess
        left = left + (sideways - across) * slide_y
        wrench = contact_wrench(motion, at_contacts(forward), at_contacts(left))
        reaction = -radius * per_side(forward)
        change, _ = yielding.change((free_spin + relaxation * (unlimited + reaction)) / (1 + relaxation * slope))
        return memory, replace(wrench, spin_torque=reaction + yielding.factor * change)

    def _beyond_creep(self, along: jax.Array, across: jax.Array) -> jax.Array:
        """p (2 A,) [m/s] for sliding velocities (2 A,) along and across, by Newton's method on |F|.

        It starts from the solution for sliding along one axis only.
        """
        share = (along / self.slip_speed) ** 2 + (across / self.side_slip_speed) ** 2 + TINY  # q^2
        speed = jnp.sqrt(along**2 + across**2 + TINY**2)
        beyond = speed * jnp.sqrt(share) / (1.0 + jnp.sqrt(1.0 + share))
        wanted = (1.0 + share) / share
        for _ in range(NEWTON):
            loose = 1.0 / (self.slip_speed + beyond), 1.0 / (self.side_slip_speed + beyond)
            force = (along * loose[0]) ** 2, (across * loose[1]) ** 2
            square = force[0] + force[1] + TINY
            width = square / (force[0] * loose[0] + force[1] * loose[1] + TINY * loose[0])
            beyond = jnp.maximum(beyond + width * (jnp.sqrt(square * wanted) - 1.0), 0.0)
        return beyond
