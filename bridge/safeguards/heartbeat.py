"""Heartbeats between the policy node and its guard: how often they come, and how one is read."""

import json
from typing import Any

BEAT_PERIOD = 0.05
SIMULATED = 10.0
"""How many times as long the two may not hear each other in simulated time: processes of a busy computer wait for each
other, and nobody sits on the vehicle."""


def read_beat(text: str, **fields: type) -> dict[str, Any]:
    """Return the JSON object of a heartbeat, empty where a field is missing or of another type."""
    try:
        beat = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    whole = isinstance(beat, dict) and all(isinstance(beat.get(name), kind) for name, kind in fields.items())
    return beat if whole else {}
