"""Effects that push or brake chassis and wheels."""

from __future__ import annotations

import math
from dataclasses import replace

from benchmarks.plant.base import TICK, Effect, Load, Moment
from benchmarks.plant.chair import FRONT_Y, GRAVITY, Chair

FRONT_SPACING = 12  # rollers on a front wheel


class DryFriction(Effect):
    """LuGre bristles in each wheel's bearing: s in sliding, 1.5 s at rest, fading over 0.5 rad/s."""

    def start(self) -> None:
        self.bristle = [0.0, 0.0]
        self.damping = 0.3 * self.chair.torque_limit / Chair().torque_limit
        """Of the bristles [N m s/rad], in proportion to the drives: the chair's would shake a wheel of 60 g cm^2."""

    def load(self, moment: Moment, load: Load) -> None:
        stiffness = self.size / 0.015  # N m/rad: full friction after 0.015 rad
        for side in (0, 1):
            spin = moment.spin[side]
            level = self.size * (1 + 0.5 * math.exp(-((spin / 0.5) ** 2)))
            settled, rate = math.copysign(level / stiffness, spin), stiffness * abs(spin) / level
            before = self.bristle[side]
            self.bristle[side] = settled + (before - settled) * math.exp(-rate * TICK)
            creep = (self.bristle[side] - before) / TICK
            load.wheel[side] -= stiffness * self.bristle[side] + self.damping * creep


class YawScrub(Effect):
    """Torsional friction in the tyres' contacts: up to s times the load of each drive wheel."""

    @staticmethod
    def change(chair: Chair, size: float) -> Chair:
        return replace(chair, patch=chair.patch + size)


class OmniRollerFriction(Effect):
    """Sideways at each front wheel: -s N v_y / sqrt(v_y^2 + v_0^2), half as much more or less as rollers pass."""

    def start(self) -> None:
        self.path = self.random.uniform(0.0, 1.0, 2)
        self.weight = self.chair.mass * GRAVITY * self.chair.com[0] / self.chair.nominal.wheelbase / 2

    def load(self, moment: Moment, load: Load) -> None:
        wheelbase = self.chair.nominal.wheelbase
        sliding = moment.side + wheelbase * moment.omega
        for side, y in enumerate((FRONT_Y, -FRONT_Y)):
            self.path[side] += (moment.v - y * moment.omega) * TICK
            ripple = 1 + 0.5 * math.cos(FRONT_SPACING * self.path[side] / 0.1)
            force = -self.size * self.weight * ripple * sliding / math.hypot(sliding, 0.01)
            load.push(0.0, force, wheelbase, y)


class CasterKick(Effect):
    """Two trailing casters in front: each scrubs with -s u / (|u| + 0.03 m/s) across its own wheel plane.

    Its swivel angle follows the pivot's motion over a trail of 0.08 m, so it swings round after each reversal.
    """

    trail = 0.08

    def start(self) -> None:
        self.angle = list(self.random.uniform(-0.3, 0.3, 2))

    def load(self, moment: Moment, load: Load) -> None:
        wheelbase = self.chair.nominal.wheelbase
        for side, y in enumerate((FRONT_Y, -FRONT_Y)):
            along, across = moment.v - y * moment.omega, moment.side + wheelbase * moment.omega
            sin, cos = math.sin(self.angle[side]), math.cos(self.angle[side])
            slide = across * cos - along * sin
            force = -self.size * slide / (abs(slide) + 0.03)
            load.push(-sin * force, cos * force, wheelbase, y)
            self.angle[side] += (slide / self.trail - moment.omega) * TICK


class RollingResistanceSpeed(Effect):
    """Torque on each drive wheel that rises with speed to the power 1.5: s N r |v|^1.5."""

    def load(self, moment: Moment, load: Load) -> None:
        weight = self.chair.mass * GRAVITY / 2
        for side in (0, 1):
            speed = moment.spin[side] * self.chair.radius[side]
            load.wheel[side] -= self.size * weight * self.chair.radius[side] * math.copysign(abs(speed) ** 1.5, speed)


class QuadraticDrag(Effect):
    """-s |u| u against the velocity u of a point 0.1 m ahead of the axle and 0.5 m above it, both components."""

    def load(self, moment: Moment, load: Load) -> None:
        across = moment.side + 0.1 * moment.omega
        speed = math.hypot(moment.v, across)
        load.push(-self.size * speed * moment.v, -self.size * speed * across, 0.1, 0.0, 0.5)


class SideForce(Effect):
    """Constant pull s to the left, 0.25 m ahead of the drive axle."""

    def load(self, moment: Moment, load: Load) -> None:
        load.push(0.0, self.size, 0.25)


class Wind(Effect):
    """Towards +x of the room, s on average; gusts of 40 % and of 0.3 rad in direction, correlated over 1.5 s."""

    def start(self) -> None:
        self.gust = list(self.random.standard_normal(2))

    def load(self, moment: Moment, load: Load) -> None:
        keep = math.exp(-TICK / 1.5)
        for axis, draw in enumerate(self.random.standard_normal(2).tolist()):
            self.gust[axis] = keep * self.gust[axis] + math.sqrt(1 - keep**2) * draw
        force, angle = self.size * (1 + 0.4 * self.gust[0]), 0.3 * self.gust[1] - moment.yaw
        load.push(force * math.cos(angle), force * math.sin(angle), 0.1, 0.0, 0.4)
