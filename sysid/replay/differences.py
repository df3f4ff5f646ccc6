"""Derivatives of a replay by differences over a share of each parameter's range.

Skidding wheels, torque limits and sampled delays make a motion rough: the mean slope shows where it goes, the
derivative at one point need not. Forward mode through a contact solver, which switches between sticking and sliding,
means nothing. Searches by differences end at about the same costs in a fraction of the time: replays of many sets fill
vectors, tangents do not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import numpy as np

from sysid.errors.pose_objective import Replays
from sysid.errors.space import STEP, Space
from sysid.logs.records import Trial
from sysid.replay.courses import CourseReplay, make_courses
from sysid.replay.models import Parameters, set_parameters
from sysid.replay.quotients import Quotients
from sysid.replay.records import Measured, Plant, Simulated


@dataclass(frozen=True)
class DifferenceReplay:
    """A replay whose Jacobian is that of central differences, one-sided at a bound: 2 P + 1 drives of each course."""

    replay: CourseReplay
    space: Space

    @cached_property
    def compiled(self) -> dict[Any, Any]:
        """What `sysid.errors.normal_equations` compiled of it."""
        return {}

    @property
    def drives(self) -> int:
        """Of one set, side by side."""
        return self.replay.drives

    @property
    def states(self) -> int:
        """That are recorded of one set."""
        return self.replay.states

    @cached_property
    def in_pieces(self) -> DifferenceReplay:
        """The same with long drives in pieces side by side (`sysid.replay.pieces`) where it is traced."""
        pieces = self.replay.in_pieces
        return self if pieces is self.replay else replace(self, replay=pieces)

    def simulate(self, values: np.ndarray) -> Simulated:
        """As that of the replay."""
        return self.replay.simulate(values)

    def traced(self, values: jax.Array) -> Simulated:
        """As `simulate`, within a compiled function."""
        return self.replay.traced(values)

    def jacobian(self, values: np.ndarray) -> tuple[Simulated, Simulated]:
        """Replay and derivatives (a last axis P) for each of values (N, P)."""
        pairs = Quotients.central(self.space.to_unit(values), STEP).mapped(self.space.to_values)
        return pairs.along(values, self.replay.simulate)


def make_replay(
    plant: Plant, params: Any, space: Space, trials: tuple[Trial, ...], like: Replays | None = None
) -> tuple[Replays, Measured]:
    """Replay of trials with the space's parameters, the others as in `params`, and what was measured.

    `like`: another replay of this plant, space and vehicle, whose compiled programs serve here too.
    """
    paths = like.replay.paths if isinstance(like, DifferenceReplay) else None

    def put(values: jax.Array) -> Any:
        return set_parameters(params, space.names, values)

    if not isinstance(params, Parameters):
        courses, measured = make_courses(plant, trials, put, params, paths)
    else:
        courses = CourseReplay(plant, trials, put, anywhere=not params.room_fixed, paths=paths)
        measured = courses.measured
    return DifferenceReplay(courses, space), measured
