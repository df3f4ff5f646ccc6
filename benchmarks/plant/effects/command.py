"""Effects on the commands: between the sender and the wanted wheel speeds."""

from __future__ import annotations

import numpy as np

from benchmarks.plant.base import TICK, Effect


class CommandDelay(Effect):
    """Each message comes s later, give or take a fifth of s of its own; the line keeps their order."""

    def messages(self, messages: np.ndarray) -> np.ndarray:
        late = self.size * (1 + 0.2 * self.random.uniform(-1, 1, len(messages)))
        return np.column_stack([np.maximum.accumulate(messages[:, 0] + late), messages[:, 1:]])


class CommandDeadZone(Effect):
    """Each wheel for itself: its target is lost until it exceeds s, and again once it falls below s / 2."""

    def target(self, target: np.ndarray) -> np.ndarray:
        out = target.copy()
        for side in (0, 1):
            awake = False
            for k, speed in enumerate(np.abs(target[:, side]) * self.chair.nominal.radius):
                awake = speed > self.size / 2 if awake else speed > self.size
                if not awake:
                    out[k, side] = 0.0
        return out


class AccelerationLimit(Effect):
    """Each wheel's target changes by at most 1 / s when it speeds up, and 1.5 / s when it slows down."""

    def target(self, target: np.ndarray) -> np.ndarray:
        step = TICK / self.size / self.chair.nominal.radius
        out = np.empty_like(target)
        for side in (0, 1):
            value = 0.0
            for k, wanted in enumerate(target[:, side].tolist()):
                most = step if abs(wanted) > abs(value) and wanted * value >= 0 else 1.5 * step
                value += min(most, max(-most, wanted - value))
                out[k, side] = value
        return out


class JerkLimit(Effect):
    """Each wheel's target is averaged over the last s / 2, twice: a step becomes an S of duration s."""

    def target(self, target: np.ndarray) -> np.ndarray:
        width = max(1, round(self.size / 2 / TICK))
        for _ in range(2):
            total = np.cumsum(np.vstack([np.zeros((width, 2)), target]), axis=0)
            target = (total[width:] - total[:-width]) / width
        return target


class CommandScale(Effect):
    """The controllers take a unit of speed for 1 + s units."""

    def command(self, command: np.ndarray) -> np.ndarray:
        return command * (1 + self.size)


class CommandCoupling(Effect):
    """With both commands large, p = |v| |omega| / 0.36: v loses the share s p, omega gains s p / 2. Not catalogued."""

    def command(self, command: np.ndarray) -> np.ndarray:
        both = np.minimum(np.abs(command[:, 0] * command[:, 1]) / 0.36, 1.5)
        return command * np.column_stack([1 - self.size * both, 1 + self.size * both / 2])


class CommandDropouts(Effect):
    """The share s of messages is lost, in bursts of 0.4 s on average; the last one holds. Not catalogued."""

    def messages(self, messages: np.ndarray) -> np.ndarray:
        leave = 1 / 4
        enter = leave * self.size / max(1 - self.size, 0.05)  # stationary share of a two-state chain
        lost, keep = bool(self.random.random() < self.size), np.ones(len(messages), bool)
        for k, draw in enumerate(self.random.random(len(messages))):
            lost = draw >= leave if lost else draw < enter
            keep[k] = not lost
        return messages[keep]
