"""The environment of one instance: `reset` and `step`, pure functions without a batch axis."""

from whill_mjx.env.episode import repainted, reset, reset_state, sense, step, step_state, time_step, unpainted
from whill_mjx.env.images import RICH, observe
from whill_mjx.env.make import LOOKS, as_vehicle, make_env
from whill_mjx.env.moments import end_names, endings_of, first_outcome, moment_of, view_of
from whill_mjx.env.records import EVENT_METRICS, POSE_METRICS, Env, Outcome, State

__all__ = [
    "EVENT_METRICS", "LOOKS", "POSE_METRICS", "RICH", "Env", "Outcome", "State", "as_vehicle", "end_names",
    "endings_of", "first_outcome", "make_env", "moment_of", "observe", "repainted", "reset", "reset_state", "sense",
    "step", "step_state", "time_step", "unpainted", "view_of",
]  # fmt: skip
