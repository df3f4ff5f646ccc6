"""Friction-limited slip between wheels and ground."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect, contact_wrench, per_side, to_contacts
from whill_mjx.types import Motion, Wrench, parameter

ROUNDS = 2  # of the implicit step
TINY = 1e-6  # [N], keeps the ratio defined where nothing grips


@struct.dataclass
class SlipTraction(Effect):
    """Slip force of driven wheels, on a friction circle: F = mu N s / sqrt(|s|^2 + s0^2), s the sliding velocity.

    s = (r spin - v_x, -v_y) at each driven contact; s0 is the sliding speed at which the force has 1/sqrt(2) of its
    limit. The wheel gets the reaction -r F_x. The stiff wheel speed is advanced implicitly: F is taken at the speed the
    wheel will have after the step, so that any s0 is stable at any step. Passive wheels roll: they carry `mu_free` N
    sideways only.
    """

    name = "slip_traction"
    mu: jax.Array = parameter("-", 0.05, 1.5, 0.0, "friction coefficient of driven wheels")
    slip_speed: jax.Array = parameter("m/s", 0.01, 0.5, 0.05, "sliding speed of half grip, s0")
    mu_free: jax.Array = parameter("-", 0.0, 1.0, 0.0, "sideways friction coefficient of passive wheels")

    def force(self, memory: tuple[()], motion: Motion) -> tuple[tuple[()], Wrench]:
        """Wrench of the slip forces, and their reaction on the driven wheels."""
        geometry = motion.world.geometry
        radius = geometry.wheel_radius  # (2,)
        slide_x = to_contacts(radius * motion.spin) - motion.contact_vx
        slide_y = -motion.contact_vy
        grip = self.mu * motion.normal_force * geometry.driven
        relaxation = motion.dt / motion.wheel_inertia
        for _ in range(ROUNDS):
            # Implicit step of the spin, I (w' - w) / dt = T - r C (r w' - v_x), with C = mu N / sqrt(|s|^2 + s0^2)
            # taken at the sliding of the previous round.
            stiffness = grip / jnp.sqrt(slide_x**2 + slide_y**2 + self.slip_speed**2)  # [N s/m]
            total, carried = per_side(stiffness), per_side(stiffness * motion.contact_vx)
            torque = motion.drive_torque + radius * carried
            spin = (motion.spin + relaxation * torque) / (1 + relaxation * radius**2 * total)
            slide_x = to_contacts(radius * spin) - motion.contact_vx
        forward, left = stiffness * slide_x, stiffness * slide_y
        # A wheel that a large torque spins up within the step would leave the friction circle.
        excess = jnp.maximum(1.0, jnp.sqrt(forward**2 + left**2 + TINY) / (grip + TINY))
        forward, left = forward / excess, left / excess
        free = self.mu_free * motion.normal_force * (1 - geometry.driven)
        left = left + free * slide_y / jnp.sqrt(slide_y**2 + self.slip_speed**2)
        wrench = contact_wrench(motion, forward, left)
        return memory, replace(wrench, spin_torque=-radius * per_side(forward))
