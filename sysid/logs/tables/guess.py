"""What the columns of somebody else's files hold, by their names and by their numbers.

A role is STREAM.QUANTITY, such as command.v or ground_truth.yaw; "time" is that of all streams of a file. A unit comes
from the name where it is there, else from the numbers.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sysid.logs.tables.columns import STREAMS, Column, Table
from sysid.logs.tables.names import STREAM_WORDS, by_name, may_be_heading, says_any_stream, says_stream, words_of
from sysid.logs.tables.sizes import with_time_unit, with_units

NEAR = 0.02  # of any unit from 0, at which an odometry begins


def guess(
    tables: Sequence[Table], said: Sequence[Column] = (), units: Mapping[tuple[str, str], str] | None = None
) -> list[Column]:
    """What the columns of the files of one drive hold, as far as names and numbers show it; what is `said` is kept.

    `units`: units that other drives of the source show, by role and name of the column.
    """
    found = list(said)
    taken = {(one.file, one.name) for one in said}
    forms = [{f"command.{one}" for one in form} for form in (("v", "omega"), ("left", "right"))]
    settled = {role for form, other in zip(forms, reversed(forms), strict=True)  # the other form of a whole command
               if form <= {one.role for one in said} for role in other}
    for table in tables:
        roles = {one.role for one in found if one.role != "time"}
        candidates = [column for name in table.columns if (table.stem, name) not in taken
                      and (column := by_name(table, name)) is not None and column.role not in settled]
        candidates = _with_headings(candidates, roles)
        long_unit = {"min", "h", "d"}  # a column of hours may stand beside the time itself
        for column in sorted(candidates, key=lambda one: (
                not one.sure, one.role == "time" and one.unit in long_unit,
                one.role != "time" and not says_any_stream(one.name))):
            rival = column.role == "time" and any(one.role == "time" and one.file == table.stem for one in found)
            if not rival and column.role not in roles:
                found.append(column)
                roles.add(column.role if column.role != "time" else "")
    arrays = {(table.stem, name): values for table in tables for name, values in table.columns.items()}
    found = _origin_counts(found, arrays)
    found = [one if one.why == "" else with_time_unit(one, arrays[one.file, one.name]) if one.role == "time" else one
             for one in found]
    decided = with_units(found, arrays)
    if not units:
        return decided
    open_ones = {(one.role, one.name) for one in decided if one.assumed and (one.role, one.name) in units}
    return with_units([replace(one, unit=units[one.role, one.name], why=f"{one.why}; as most drives show")
                       if (one.role, one.name) in open_ones else one for one in found], arrays)


def _with_headings(candidates: Sequence[Column], roles: set[str]) -> list[Column]:
    """Turns that may be headings are those of streams with a place and no other heading."""
    known = roles | {one.role for one in candidates}
    lacking = {stream for stream in STREAMS if f"{stream}.x" in known and not {f"{stream}.yaw", f"{stream}.qw"} & known}
    return [replace(one, role=f"{stream}.yaw") if quantity == "omega" and stream in lacking
            and may_be_heading(one.name, one.unit) else one
            for one in candidates for stream, _, quantity in [one.role.partition(".")]]


def shown_units(drives: Sequence[Sequence[Column]]) -> dict[tuple[str, str], str]:
    """Unit of each column, by role and name, that most moving drives show; sure ones count a little more."""
    votes: dict[tuple[str, str], Counter[str]] = {}
    for columns in drives:
        for one in columns:
            if one.sure and (one.moves or not one.assumed) and one.role != "time":
                votes.setdefault((one.role, one.name), Counter())[one.unit] += 100 if one.assumed else 101
    return {key: vote.most_common(1)[0][0] for key, vote in votes.items()}


def _origin_counts(found: list[Column], arrays: Mapping[tuple[str, str], np.ndarray]) -> list[Column]:
    """Poses whose names do not say so are odometry's if they begin at the origin; elsewhere nobody can know."""
    roles = {one.role for one in found}
    words = set(STREAM_WORDS["odometry"])
    nameless = [one for one in found if one.role in ("odometry.x", "odometry.y", "odometry.yaw")
                and one.guessed and not says_stream(one.name, "odometry") and not set(words_of(one.file)) & words]
    if not nameless or {"odometry.v", "odometry.omega"} & roles:
        return found
    starts = [arrays[one.file, one.name] for one in nameless]
    away = any(abs(known[0]) > NEAR for values in starts if len(known := values[np.isfinite(values)]))
    return [replace(one, sure=not away) if one in nameless else one for one in found]
