"""Damages files in the ways of disks, networks and people: strategies of hypothesis for the readers of policy files."""

import copy
import functools
import hashlib
import json
import os
import resource
import subprocess
import sys
import time

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from bridge.policy.trial import START_SECONDS

EXAMPLES = int(os.environ.get("DAMAGED_FILES", 0))
"""Damaged files of each kind; 0 takes the few that a test asks for, always the same."""
SECONDS, BYTES = 2.0, 500e6
"""Promised for each file on a desktop: processor time and memory."""


@functools.cache
def allowed_seconds():
    """What is promised on this computer: more where a trial process takes longer to start, as a trial has it."""
    before = _processor_time()
    subprocess.run([sys.executable, "-c", "import numpy, onnxruntime"], check=True)
    return SECONDS * max(1.0, (_processor_time() - before) / START_SECONDS)


def few(count):
    """Settings of a property that is tried `count` times, or DAMAGED_FILES times."""
    return settings(max_examples=EXAMPLES or count, derandomize=not EXAMPLES, database=None, deadline=None,
                    suppress_health_check=list(HealthCheck))


class Costs:
    """What reading one file costs in this process and those that it starts; use it as a context."""

    def __enter__(self):
        self._seconds, self._peak = _processor_time(), _peak()
        return self

    def __exit__(self, kind, error, trace):
        if kind is None:
            assert _processor_time() - self._seconds < allowed_seconds()
            assert _peak() - self._peak < BYTES


def _processor_time():
    return time.process_time() + sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2])


def _peak():
    return 1024 * max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


@st.composite
def damaged(draw, data):
    """Bytes that differ from `data`: cut, flipped, inserted, repeated, overwritten or other bytes altogether."""
    place = draw(st.integers(0, max(len(data) - 1, 0)))
    other = draw(st.binary(min_size=1, max_size=64))
    kind = draw(st.sampled_from(["flip", "cut", "insert", "overwrite", "repeat", "drop", "other", "empty"]))
    if kind == "flip":
        return data[:place] + bytes([data[place] ^ draw(st.integers(1, 255))]) + data[place + 1 :]
    if kind == "cut":
        return data[:place]
    if kind == "insert":
        return data[:place] + other + data[place:]
    if kind == "overwrite":
        return data[:place] + other + data[place + len(other) :]
    if kind == "repeat":
        return data[:place] + data[place:] * draw(st.integers(2, 20))
    if kind == "drop":
        return data[:place] + data[place + len(other) :]
    return other if kind == "other" else b""


NUMBERS = st.sampled_from([0, -1, 1, 3, 2**31, 2**63, 10**20, 10**400, -(10**400), 1e308, 1e-308, -0.0, 0.5,
                           float("nan"), float("inf"), -float("inf"), True])
TEXTS = st.one_of(st.text(max_size=8), st.sampled_from(["\ud800", "../policy.onnx", "/dev/zero", "a\0b", "x" * 300,
                                                        "0" * 64, "float32", "policy.json", "NaN"]))
VALUES = st.recursive(st.one_of(st.none(), NUMBERS, st.integers(), st.floats(), TEXTS), lambda inner: st.one_of(
    st.lists(inner, max_size=4), st.dictionaries(TEXTS, inner, max_size=4)), max_leaves=8)


@st.composite
def damaged_table(draw, table):
    """The text of a JSON table with one or two of its values replaced, removed or added."""
    table = copy.deepcopy(table)
    for _ in range(draw(st.integers(1, 2))):
        owner, key = draw(st.sampled_from(list(_places(table))))
        kind = draw(st.sampled_from(["replace", "replace", "remove", "add", "nest"]))
        if kind == "replace":
            owner[key] = draw(VALUES)
        elif kind == "remove":
            del owner[key]
        elif kind == "nest":
            for _ in range(draw(st.sampled_from([1, 20, 400]))):
                owner[key] = [owner[key]]
        elif isinstance(owner, dict):
            owner[draw(TEXTS)] = draw(VALUES)
        else:
            owner.append(draw(VALUES))
        if not table:
            break
    return json.dumps(table).encode()


def _places(value):
    """(owner, key) of every value in a table."""
    waiting = [value]
    while waiting:
        owner = waiting.pop()
        for key, item in owner.items() if isinstance(owner, dict) else enumerate(owner):
            yield owner, key
            if isinstance(item, dict | list):
                waiting.append(item)


def with_hashes(files):
    """The files, with the hashes in policy.json made right, so that damage is not found by them alone."""
    table = json.loads(files["policy.json"])
    table["files"] = {name: hashlib.sha256(files[name]).hexdigest() for name in table["files"] if name in files}
    if "vehicle.toml" in table["files"]:
        table["vehicle_sha256"] = table["files"]["vehicle.toml"]
    return {**files, "policy.json": json.dumps(table).encode()}


def write(folder, files):
    """Write the files into a folder that holds nothing else, and return it."""
    folder.mkdir(exist_ok=True)
    for item in folder.iterdir():
        item.unlink()
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return folder
