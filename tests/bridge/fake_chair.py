"""A WHILL Model CR2 behind its maker's driver, as far as public sources describe it; pure, with injected time.

The driver sends one serial packet per message and limits nothing. The firmware takes words of 16 bits, holds a velocity
for 200 ms, ignores the rider's joystick meanwhile, and changes its speed by about 1.7 m/s2.
"""

import math

from bridge.driving.bases import WHILL
from bridge.driving.whill import KMH, TREAD, WHEEL_RADIUS, ChairState, command_of_words, command_words

RAMP = 1.7
"""[m/s2]"""
FILTER = 0.1
"""Time constant [s] of the reported speeds; the maker gives none."""


def wrap_16_bits(word):
    return (word + 0x8000) % 0x10000 - 0x8000


class FakeChair:
    """Call `advance` often; between the calls speeds are constant."""

    def __init__(self):
        self.now = 0.0
        self.power, self.error, self.battery = 1, 0, 80
        self.joystick = (0, 0)  # of its rider, forward and right [%]
        self.x = self.y = self.yaw = self.v = self.omega = 0.0
        self._wheel = [0.0, 0.0]  # left, right [rad], forward positive
        self._shown = [0.0, 0.0]  # filtered wheel speeds [m/s]
        self._target, self._until = (0.0, 0.0), -math.inf

    @property
    def joystick_works(self):
        """True while no velocity packet locks the rider out."""
        return self.now >= self._until

    def command(self, v, omega):
        """What the driver does with a message on its command topic."""
        forward, turn = (wrap_16_bits(word) for word in command_words(v, omega))
        if -500 <= forward <= 1500 and -750 <= turn <= 750:
            self._target = command_of_words(forward, turn)
        self._until = self.now + WHILL.expiry

    def advance(self, dt):
        """Move on by a time [s]."""
        self.now += dt
        target = self._target
        if self.joystick_works:
            target = (self.joystick[0] / 100 * 0.5, -self.joystick[1] / 100 * 0.8)
        if not self.power or self.error:
            target = (0.0, 0.0)
        self.v += max(-RAMP * dt, min(RAMP * dt, target[0] - self.v))
        self.omega += max(-RAMP / TREAD * 2 * dt, min(RAMP / TREAD * 2 * dt, target[1] - self.omega))
        self.yaw += self.omega * dt / 2
        self.x += self.v * dt * math.cos(self.yaw)
        self.y += self.v * dt * math.sin(self.yaw)
        self.yaw += self.omega * dt / 2
        for i, speed in enumerate((self.v - self.omega * TREAD / 2, self.v + self.omega * TREAD / 2)):
            self._wheel[i] += speed * dt / WHEEL_RADIUS
            self._shown[i] += (speed - self._shown[i]) * min(1.0, dt / FILTER)

    def state(self):
        """The driver's message: angles in steps of 0.001 rad within +-pi, speeds in steps of 0.004 km/h."""
        left, right = (round(math.remainder(angle, 2 * math.pi), 3) for angle in self._wheel)
        left_speed, right_speed = (round(speed / KMH / 0.004) * 0.004 for speed in self._shown)
        return ChairState(right_motor_angle=-right, left_motor_angle=left, right_motor_speed=-right_speed,
                          left_motor_speed=left_speed, power_on=self.power, error=self.error,
                          battery_power=self.battery, joy_front=self.joystick[0], joy_side=self.joystick[1])
