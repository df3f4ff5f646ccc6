"""Damaged files, and the promise of every reader: whatever bytes a file has, a value or a documented error.

More examples on request: DAMAGED_FILES=2000 python -m pytest -k damaged
"""

from __future__ import annotations

import gzip
import re

import numpy as np
from damage import Costs, few
from hypothesis import given
from hypothesis import strategies as st

TOKENS = [
    b"", b"\0", b"\xff\xfe", b"\xef\xbb\xbf", b"\xe9", b"\n", b"\n\n", b"\r", b",", b",,", b";", b"=", b"#", b'"', b"'",
    b"nan", b"-inf", b"inf", b"1e400", b"-1e9", b"0", b"-1", b"1" + b"0" * 400, b"9" * 5000, b"1_0", b"0x10", b"1,5",
    b"true", b"null", b'"text"', b"[]", b"{}", b"[" * 3000, b"{a=" * 3000, b"a." * 3000, b"x" * 200_000, b"..", b"/",
    b"2024-99-99", b"\xf0\x9f\x9a\x97", b"\xd9\xa1", b"&amp;", b"</", b"<!--", b"100000000 100000000",
]
BETTER = re.compile(rb"-?\d+\.?\d*|\btrue\b|\bfalse\b|\"[^\"\n]*\"|\[[^\[\]\n]*\]")
"""What stands for a value in a text file."""


@st.composite
def damaged(draw, good: bytes):
    """Bytes at random, or the good file with a few values, pieces or single bytes changed."""
    if draw(st.integers(0, 9)) == 0:
        return draw(st.binary(max_size=300))
    data = good
    for _ in range(draw(st.integers(1, 4))):
        kind = draw(st.sampled_from(["value", "value", "insert", "cut", "end", "flip", "double", "swap"]))
        start = draw(st.integers(0, max(len(data) - 1, 0)))
        end = min(len(data), start + draw(st.integers(0, 60)))
        values = list(BETTER.finditer(data[:20_000])) if kind == "value" else []
        if values:
            start, end = draw(st.sampled_from(values)).span()
            data = data[:start] + draw(st.sampled_from(TOKENS)) + data[end:]
        elif kind == "cut":
            data = data[:start] + data[end:]
        elif kind == "end":
            data = data[:start]
        elif kind == "flip" and data:
            data = data[:start] + bytes([draw(st.integers(0, 255))]) + data[start + 1 :]
        elif kind == "double":
            data = data[:end] + data[start:end] + data[end:]
        elif kind == "swap":
            data = data[:start] + data[end:] + data[start:end]
        else:
            data = data[:start] + draw(st.sampled_from(TOKENS)) + data[start:]
    return data


def check(path, good, read, examples=40, folder=None):
    """Write damaged files at `path` and read each: a value, or an error with the name of the file or its folder.

    `folder` is that of a dataset whose other files an error may name.
    """
    @few(examples)
    @given(damaged(good))
    def one(data):
        path.write_bytes(data)
        try:
            with Costs():
                read()
        except (ValueError, FileNotFoundError) as error:
            assert str(folder or path.parent) in str(error) and len(str(error)) < 2000 + 3 * len(str(path))
            assert type(error) in (ValueError, FileNotFoundError)

    path.write_bytes(good)
    read()  # the good file is read
    with np.errstate(all="ignore"):
        one()
    path.write_bytes(good)


def check_packed(path, text, packed, read):
    """Damage a .gz file, or the text in it."""
    if packed:
        check(path, gzip.compress(text), read)
        return
    source = path.with_name("text")

    def pack_and_read():
        path.write_bytes(gzip.compress(source.read_bytes()))
        read()

    check(source, text, pack_and_read)
