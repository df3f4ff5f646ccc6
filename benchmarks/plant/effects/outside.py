"""Effects of families that the vehicle model's catalogue does not have: the tool must say `none of these`."""

from __future__ import annotations

import math

from benchmarks.plant.base import TICK, Effect, Load, Moment


class WheelRipple(Effect):
    """Periodic: the left wheel is out of balance, torque s (sin a + 0.4 sin(2 a + 1)) of its angle a."""

    def start(self) -> None:
        self.phase = float(self.random.uniform(0, 2 * math.pi))

    def load(self, moment: Moment, load: Load) -> None:
        angle = moment.angle[0] + self.phase
        load.wheel[0] += self.size * (math.sin(angle) + 0.4 * math.sin(2 * angle + 1))


class SoftPatch(Effect):
    """Place: drag s on each drive wheel that is on the soft strip 0.5 m < x < 1.3 m of the room."""

    def load(self, moment: Moment, load: Load) -> None:
        for sign in (1, -1):
            y = sign * self.chair.nominal.track / 2
            x = moment.x - y * math.sin(moment.yaw)
            depth = 1 / (1 + math.exp(-(0.4 - abs(x - 0.9)) / 0.03))
            speed = moment.v - y * moment.omega
            load.push(-self.size * depth * math.tanh(speed / 0.03), 0.0, 0.0, y)


class WarmUp(Effect):
    """Time: bearings stiff with cold grease at the start of each trial, friction s exp(-t / 6 s) in each wheel."""

    def load(self, moment: Moment, load: Load) -> None:
        level = self.size * math.exp(-moment.t / 6)
        for side in (0, 1):
            load.wheel[side] -= level * math.tanh(moment.spin[side] / 0.2)


class RestFriction(Effect):
    """History: after a rest of T, friction s ln(1 + T / 0.5 s) in each wheel, gone after 0.15 m of travel."""

    def start(self) -> None:
        self.rest, self.path, self.level = [2.0, 2.0], [0.0, 0.0], [0.0, 0.0]

    def load(self, moment: Moment, load: Load) -> None:
        for side in (0, 1):
            spin = moment.spin[side]
            if abs(spin) < 0.08:
                self.rest[side] += TICK
                if self.rest[side] > 0.05:  # a rest, not a passage through zero
                    self.path[side], self.level[side] = 0.0, self.size * math.log(1 + self.rest[side] / 0.5)
            else:
                self.rest[side] = 0.0
                self.path[side] += abs(spin) * self.chair.radius[side] * TICK
            left = self.level[side] * math.exp(-self.path[side] / 0.15)
            load.wheel[side] -= left * math.tanh(spin / 0.15)


class CarpetNap(Effect):
    """Heading: drag between 0 with the nap (+y of the room) and s against it, and s / 4 sideways towards the nap."""

    def load(self, moment: Moment, load: Load) -> None:
        moving = math.tanh(moment.v / 0.05)
        against = math.sin(moment.yaw) * (1 if moment.v >= 0 else -1)  # 1 along the nap
        load.push(-self.size * (1 - against) / 2 * moving, self.size / 4 * math.cos(moment.yaw) * abs(moving))
