"""Clocks of a bag: times of its messages by the recorder's clock or by that of their headers, and what is odd in them.

A clock may be set in the middle of a recording, and messages may come in bursts. Messages are read in the order of
their times, so a clock that was set back shows only against the header stamps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sysid.logs.bags.recording import Bag, BagStream

MAX_SET_BACK = 0.5  # s that a stamp may run back by before the clock counts as set
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


def stream_times(bag: Bag, stamp: str) -> dict[str, np.ndarray]:
    """Times [s] of each stream's messages; ValueError where a stream has no stamps, or they run back.

    `stamp`: "receive" (all on the recorder's clock) or "header" (when measured; commands, which have no header, keep
    the time of receipt, so both clocks must agree).
    """
    times = {}
    for name, stream in bag.streams.items():
        has_header = bool(np.isfinite(stream.stamped).all())
        if stamp == "header" and has_header and (stream.stamped <= 0).all():
            raise ValueError(f"{bag.path}: topic {stream.topic}: all header stamps are zero. Use --stamp receive.")
        if stamp == "header" and not has_header and name != "command":
            raise ValueError(f"{bag.path}: topic {stream.topic} is {stream.kind}, without a header. Use --stamp "
                             "receive.")
        t = stream.stamped if stamp == "header" and has_header else stream.received
        if len(t) > 2 and np.ptp(t) == 0:
            whose, other = ("of receipt", "header") if t is stream.received else ("in the header", "receive")
            raise ValueError(f"{bag.path}: topic {stream.topic}: all {len(t)} messages have one time {whose}: the "
                             "clock stood still, such as a simulation's that nobody published. "
                             + (f"Use --stamp {other}." if has_header else "They have no other: record them again."))
        back = np.diff(t)
        if (back < -MAX_SET_BACK).any():
            k = int(np.argmin(back))
            raise ValueError(f"{bag.path}: topic {stream.topic}: its time goes back by {-back[k]:.3g} s after message "
                             f"{k + 1}; it must increase. Split the bag there, or use the other --stamp.")
        times[name] = t
    if stamp == "header" and times:
        late = {name: float(np.median(bag.streams[name].received - t)) for name, t in times.items()}
        own = float(np.median(list(late.values()))) if all(map(_has_stamps, bag.streams.values())) else 0.0
        for name, seconds in late.items():
            if abs(seconds - own) > 5.0:  # from that of receipt, which commands without a header keep
                raise ValueError(f"{bag.path}: topic {bag.streams[name].topic}: header stamps are {seconds:.3g} s from "
                                 "the time of receipt: another clock. Use --stamp receive.")
    return times


def in_order(bag: Bag, stamp: str) -> Bag:
    """The bag with its messages in the order in which they were sent, where the recorder's clock was set meanwhile."""
    streams = dict(bag.streams)
    for name, stream in streams.items():
        step = find_step(stream.received, stream.stamped) if stamp == "header" and _has_stamps(stream) else None
        if step is not None and step.clock == "receive":
            order = np.argsort(stream.stamped, kind="stable")
            streams[name] = replace(stream, received=stream.received[order], stamped=stream.stamped[order],
                                    values=stream.values[order])
    return replace(bag, streams=streams)


def clock_notes(bag: Bag, stamp: str) -> list[str]:
    """Notes on clocks that disagree without harm to the times that are used; ValueError where one that is used was set
    in the middle of the recording."""
    notes = []
    all_stamped = all(_has_stamps(stream) for stream in bag.streams.values())
    for name, stream in bag.streams.items():
        if not _has_stamps(stream):
            continue
        if step := find_step(stream.received, stream.stamped):
            way = f"{'back' if step.seconds < 0 else 'forward'} by {abs(step.seconds):.3g} s"
            whose = "the recorder's clock" if step.clock == "receive" else f"the header's clock of {stream.topic}"
            other = f"the header stamps of {stream.topic}" if step.clock == "receive" else "the times of receipt"
            said = f"{whose} was set {way}, {step.after:.1f} s into the recording, as {other} show"
            if step.clock == stamp or step.clock == "receive" and not all_stamped:
                better = "receive" if step.clock == "header" else "header" if all_stamped else None
                mixed = "commands and measurements of two moments are mixed" if step.seconds < 0 else (
                    "the drive seems to pause there")
                raise ValueError(f"{bag.path}: {said}: {mixed}. " + (
                    f"Use --stamp {better}." if better else "Cut the bag there, or record again without setting it."))
            notes.append(f"{said}; --stamp {stamp} does not depend on it")
        elif stamp == "receive" and (spread := find_bursts(stream.received, stream.stamped)):
            notes.append(f"{name}: messages of {stream.topic} came in bursts: their times of receipt vary by "
                         f"{spread:.2g} s, while their header stamps are regular. Convert again with --stamp header")
    return notes


def _has_stamps(stream: BagStream) -> bool:
    return bool(np.isfinite(stream.stamped).all() and (stream.stamped > 0).all())


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
