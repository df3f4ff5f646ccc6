"""Times of receipt against header stamps: clocks that were set in the middle of a bag, and receipt in bursts.

Messages are read in the order of their times, so a clock that was set back shows only against the header stamps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

STEP = 0.3  # s of lateness that a set clock changes by, at least
AROUND = 8  # messages before and after
SPREADS = 4.0  # of the lateness around it, that such a change is beyond
LASTING = 0.3  # share of the change that the rest of the recording may differ from it by
UNEVEN = 0.1  # s of lateness that comes and goes, below which receipt is steady
PERIODS = 1.5  # the same, in periods of the header's stamps
REGULAR = 0.3  # share of the period that most of the header's stamps vary by at most, for receipt to be what is uneven


@dataclass(frozen=True)
class Step:
    """A clock that was set while a bag was recorded."""

    clock: str  # "receive" or "header"
    seconds: float  # by how much it was set forward; negative where it was set back [s]
    after: float  # since the first header stamp [s]


def find_step(received: np.ndarray, stamped: np.ndarray) -> Step | None:
    """The largest step of one clock against the other, from times (T,) [s] of each message; None where there is none.

    A clock that was set back mixes messages of two moments in its own order; one that was set forward shows in both
    orders.
    """
    by_stamp, at = _largest_change(received, stamped, np.argsort(stamped, kind="stable"))
    by_receipt, also_at = _largest_change(received, stamped, np.argsort(received, kind="stable"))
    if by_stamp < 0 and not by_receipt or by_stamp > 0 and by_receipt > 0:
        return Step("receive", by_stamp, at)
    if by_receipt > 0 and not by_stamp or by_stamp < 0 and by_receipt < 0:
        return Step("header", -by_receipt, also_at)
    if by_stamp < 0 < by_receipt:  # set back beyond the beginning: that clock has a gap
        gaps = [float(np.diff(np.sort(one)).max()) for one in (received, stamped)]
        return Step("receive", by_stamp, at) if gaps[0] > gaps[1] else Step("header", -by_receipt, also_at)
    return None


def find_bursts(received: np.ndarray, stamped: np.ndarray) -> float:
    """By how much times of receipt (T,) vary against regular header stamps (T,) [s]; 0 where they are as regular."""
    if len(received) < 3 * AROUND:
        return 0.0
    steps = np.diff(stamped)
    period = float(np.median(steps))
    if period <= 0 or np.percentile(np.abs(steps - period), 70) > REGULAR * period:
        return 0.0
    late, since = received - stamped, stamped - stamped[0]
    low, high = np.percentile(late - np.polyval(np.polyfit(since, late, 1), since), [5, 95])
    spread = float(high - low)
    return spread if spread > max(UNEVEN, PERIODS * period) else 0.0


def _largest_change(received: np.ndarray, stamped: np.ndarray, order: np.ndarray) -> tuple[float, float]:
    """The largest lasting change of the lateness in an order (T,) of the messages [s], and when [s]; 0 for none."""
    late, since = (received - stamped)[order], (stamped - stamped.min())[order]
    if len(late) < 3 * AROUND:
        return 0.0, 0.0
    windows = np.lib.stride_tricks.sliding_window_view(late, AROUND)
    before, after = windows[:-AROUND], windows[AROUND:]
    change = np.median(after, axis=1) - np.median(before, axis=1)
    spread = np.maximum(np.ptp(before, axis=1), np.ptp(after, axis=1))
    k = int(np.argmax(np.where(np.abs(change) > np.maximum(STEP, SPREADS * spread), np.abs(change), 0.0)))
    edge, found = k + AROUND, float(change[k])
    lasting = float(np.median(late[edge:]) - np.median(late[:edge]))
    if abs(found) <= max(STEP, SPREADS * float(spread[k])) or abs(lasting - found) > LASTING * abs(found):
        return 0.0, 0.0
    return found, float(since[edge])
