"""The file formats of the project, their numbers, and how files of an earlier number are read.

A format's number, `schema`, rises when a reader of the number before would misread a file, and only then. New fields
that a reader may leave out do not raise it. Whoever raises it adds a step to `MIGRATIONS`, so that files of the number
before are still read; a file of a later number is refused with the remedy. docs/formats.md lists all formats.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Content = dict[str, Any]
MAX_STEPS = 100


@dataclass(frozen=True)
class Format:
    """A kind of file."""

    kind: str
    """What a file says of itself as `kind`; of a dataset.toml, which says none, its name here."""
    file: str
    """Its usual name."""
    schema: int
    """The number that is written."""
    about: str
    """What it holds, and the page with its fields."""


FORMATS = {one.kind: one for one in (
    Format("driving-log-dataset", "dataset.toml", 1, "a driving log ([fields](log_format.md))"),
    Format("micromobility-vehicle", "vehicle.toml", 1, "a vehicle ([short form](howto/vehicle.md#a-short-toml-file))"),
    Format("micromobility-model", "model.toml", 1, "a fitted model of another kind ([models](models.md))"),
    Format("micromobility-policy", "policy.json", 1, "a policy of a vehicle ([fields](policy_file.md))"),
    Format("dreamer-onnx-policy", "policy.json", 1, "an agent of any observations ([fields](policy_file.md))"),
    Format("sysid-report", "report.json", 1, "a fit ([entries](#what-the-two-reportjson-hold))"),
    Format("sysid-close-loop", "report.json", 1, "a closed loop ([entries](#what-the-two-reportjson-hold))"),
    Format("sysid-evidence", "evidence.json", 2, "evidence of a verdict (fields: `sysid.verdict.posterior.Findings`)"),
    Format("sysid-paper", "paper.json", 1, "the paper's experiment"),
    Format("sysid-searches", "searches.json", 1, "a comparison of searches"),
    Format("sysid-inspection", "inspect.json", 1, "an inspected log (fields: `sysid.logs.inspection.inspect`)"),
    Format("whill-mjx-evaluation", "evaluation.json", 1, "an evaluation ([figures](evaluate.md))"),
    Format("dreamer-checkpoint", "checkpoints/*/meta.json", 1, "a state of a training, to go on from"),
)}  # fmt: skip
"""All formats with a number, by kind."""


def _by_manoeuvre(content: Content) -> Content:
    """Evidence of number 2, which has what every manoeuvre foretells, of number 1, which has the sum's lower end."""
    sets = content.get("sets")
    if not isinstance(sets, list):
        return content
    return {**content, "sets": [
        {**one, "foretold": [[gain] for gain in one["foretold"]]}
        if isinstance(one, dict) and isinstance(one.get("foretold"), list) else one for one in sets
    ]}


MIGRATIONS: dict[str, dict[int, Callable[[Content], Content]]] = {"sysid-evidence": {1: _by_manoeuvre}}
"""Kind -> number -> function that makes the content of the next number of it."""


def upgraded(kind: str, content: Content) -> Content:
    """Content of a file in the present form of its kind; unchanged where no step begins at its number."""
    for _ in range(MAX_STEPS):
        schema = content.get("schema")
        if not isinstance(schema, int) or isinstance(schema, bool):
            break
        step = MIGRATIONS.get(kind, {}).get(schema)
        if step is None:
            break
        content = {**step(content), "schema": schema + 1}
    return content


def stamp(kind: str) -> Content:
    """The head of a file of this kind."""
    return {"schema": FORMATS[kind].schema, "kind": kind}
