"""Reads files that may be damaged or somebody else's: text, TOML, JSON, CSV, .npz and .gz, each up to a stated size.

Whatever bytes a file has, a function returns a value or raises FileNotFoundError or ValueError with the file's name,
the rule and the remedy. What the values mean is checked by `whill_mjx.io.fields`.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
import tomllib
import zipfile
import zlib
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from whill_mjx.io.fields import Field, check, counted, shown

MB = 1_000_000
TOML_BYTES = MB // 2  # a vehicle file has 5 kB
JSON_BYTES = 20 * MB  # a report of a long log has 1 MB
LOG_BYTES = 60 * MB  # metrics of a long training have 1 MB
CSV_BYTES = 60 * MB  # a day at 10 Hz, three hours at 100 Hz
ARRAY_BYTES = 100 * MB  # of a .npz or .gz when unpacked
MEMBERS = 20_000  # arrays of a .npz
NPY_HEADER = 10_000  # bytes
LONGEST_LINE = 100_000  # characters of a CSV
LONG_KEY = re.compile(r"""(?<![\w\-"' \t.])(?:[\w\-"' \t]*+\.){100}""")
"""A key of a hundred parts, for which the parser takes the square of their number."""
LONGEST_REASON = 160  # characters of what a library says

BROKEN_ARCHIVE: tuple[type[Exception], ...] = (
    ValueError, OSError, EOFError, KeyError, NotImplementedError, RuntimeError, zipfile.BadZipFile, zlib.error)
"""What `zipfile` lets out about a damaged archive."""
try:
    import lzma
except ImportError:  # a Python that was built without it
    pass
else:
    BROKEN_ARCHIVE += (lzma.LZMAError,)
BINARY = {b"\x1f\x8b": "a gzip archive", b"PK\x03\x04": "a zip archive", b"BZh": "a bzip2 archive",
          b"\xfd7zXZ": "an xz archive", b"PAR1": "a Parquet file", b"\x89MCAP": "an MCAP recording",
          b"#ROSBAG": "a ROS 1 bag", b"SQLite format 3": "an SQLite database", b"\x89PNG": "a PNG image",
          b"\x89HDF": "an HDF5 file", b"\xd0\xcf\x11\xe0": "an old Office document", b"%PDF": "a PDF document"}
"""How files begin that are no text, and what they are."""


def read_bytes(path: str | Path, limit: int, missing: str) -> bytes:
    """Content of a file of at most `limit` bytes.

    Args:
        missing: what to say after the name of a file that is not there.
    """
    path = Path(path)
    try:
        if not path.is_file():
            what = "is a folder, not a file: " if path.is_dir() else ""
            raise FileNotFoundError(f"{path}: {what}{missing}")
        with path.open("rb") as file:
            data = file.read(limit + 1)
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: {missing}") from None
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror}). Check its name and rights.") from None
    if len(data) > limit:
        raise ValueError(f"{path}: is larger than {limit / MB:g} MB, the most that is read. Give the right file, or "
                         "split it.")
    return data


def read_text(path: str | Path, limit: int, missing: str) -> str:
    """Text of a UTF-8 file, with or without a byte-order mark; every line ends with a line feed."""
    return decoded(path, read_bytes(path, limit, missing))


def decoded(path: str | Path, data: bytes) -> str:
    """The text of UTF-8 bytes; ValueError names the first line that is not text."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        _refuse_binary(path, data)
        line = data.count(b"\n", 0, error.start) + 1
        raise ValueError(f"{path}, line {line}: byte 0x{data[error.start]:02x} is not UTF-8. Save the file as UTF-8."
                         ) from None
    if "\0" in text:
        _refuse_binary(path, data)
        line = text.count("\n", 0, text.index("\0")) + 1
        raise ValueError(f"{path}, line {line}: has a NUL byte, which is no text. Save it as UTF-8, or copy it again.")
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text


def _refuse_binary(path: str | Path, data: bytes) -> None:
    kind = next((kind for begin, kind in BINARY.items() if data.startswith(begin)), None)
    if kind is not None:
        raise ValueError(f"{path}: is {kind}, whatever its name says, and no text. Give a text file; unpack an archive "
                         "first.") from None


def read_toml(path: str | Path, missing: str, hint: str) -> dict[str, Any]:
    """Content of a TOML file; `hint` ends the error about one that is none."""
    text = read_text(path, TOML_BYTES, missing)
    if long := LONG_KEY.search(text):
        line = text.count("\n", 0, long.start()) + 1
        raise ValueError(f"{path}, line {line}: not a TOML file: a key of a hundred parts. {hint}")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError(f"{path}: not a TOML file: it is not valid TOML (nested too deep). {hint}") from None
    except ValueError as error:  # also an integer of too many digits, or a date that is none
        raise ValueError(f"{path}: not a TOML file: it is not valid TOML ({_first_line(error)}). {hint}") from None


def read_json(path: str | Path, missing: str, hint: str) -> dict[str, Any]:
    """The object of a JSON file; `hint` ends the error about one that is none."""
    text = read_text(path, JSON_BYTES, missing)
    try:
        content = json.loads(text)
    except RecursionError:
        raise ValueError(f"{path}: not valid JSON (nested too deep). {hint}") from None
    except ValueError as error:
        raise ValueError(f"{path}: not valid JSON ({_first_line(error)}). {hint}") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path}: is {shown(content)}; it must be a JSON object. {hint}")
    return content


def read_lines(path: str | Path) -> list[tuple[str, dict[str, float]]]:
    """Text and content of each line of a training's metrics.jsonl; empty where there is no such file.

    A line that a kill has cut off, or that is no object of numbers with `env_steps`, is left out.
    """
    found = []
    data = read_bytes(path, LOG_BYTES, "missing") if Path(path).is_file() else b""
    for text in data.decode("utf-8", errors="replace").splitlines():
        try:
            line = json.loads(text)
        except (ValueError, RecursionError):
            continue
        whole = isinstance(line, dict) and math.isfinite(_plain_number(line.get("env_steps")))
        if whole and all(isinstance(value, int | float) for value in line.values()):
            found.append((text, line))
    return found


def _plain_number(value: Any) -> float:
    """A number as a float; nan for what is none, or too large to be one."""
    try:
        return float(value) if isinstance(value, int | float) else math.nan
    except OverflowError:
        return math.nan


def read_csv(path: str | Path, fields: Sequence[Field], missing: str, see: str = "") -> dict[str, np.ndarray]:
    """Columns (T,) of a CSV file by name, and "line" (T,), the line of each row in the file; blank lines do not count.

    Args:
        fields: of the columns that are needed; others are not looked at.
        missing: as of `read_bytes`.
        see: ends the error about a missing column.
    """
    text = read_text(path, CSV_BYTES, missing)
    plain = text.isascii() and "_" not in text  # what Python takes for part of a number, and no other program does
    rows = csv_rows(path, text)
    try:
        _, header = next(rows)
    except StopIteration:
        header = []
    header = [name.strip() for name in header]
    columns = _find_columns(path, header, fields, see)
    values, lines = array("d"), array("q")
    for line, row in rows:
        if len(row) != len(header):
            raise ValueError(_wrong_length(path, line, row, header, fields))
        cells = [row[column] for column in columns]
        try:
            values.extend([float(cell) for cell in cells] if plain else _numbers(path, line, cells, fields))
        except ValueError:
            _numbers(path, line, cells, fields)  # says what is wrong
            raise
        lines.append(line)
    if len(lines) < 2:
        rows_there = counted(len(lines), "row")
        raise ValueError(f"{path}: {rows_there} of data; at least 2 are needed. Delete the empty file or record it "
                         "again.")
    table = np.frombuffer(values).reshape(len(lines), len(fields))
    found = {field.name: table[:, column].copy() for column, field in enumerate(fields)}
    for field in fields:
        outside = ~((found[field.name] >= field.low) & (found[field.name] <= field.high))
        if outside.any():
            row_number = int(np.flatnonzero(outside)[0])
            value, where = float(found[field.name][row_number]), f"{path}, line {lines[row_number]}"
            if not math.isfinite(value):
                raise ValueError(f"{where}: {field.name} is {value}; it must be finite. Leave a missing sample's row "
                                 "out.")
            check(where, field, value)
    return {**found, "line": np.array(lines)}


def csv_rows(path: str | Path, text: str) -> Iterator[tuple[int, list[str]]]:
    """Line number and cells of the rows of a CSV text; blank lines are left out, and no row spans lines."""
    reader = csv.reader(_lines(path, text))
    try:
        for row in reader:
            if row and (len(row) > 1 or row[0].strip()):
                yield reader.line_num, row
    except csv.Error as error:
        raise ValueError(f"{path}, line {reader.line_num}: is no CSV ({error}). Save the table again.") from None


def _lines(path: str | Path, text: str) -> Iterator[str]:
    start, number = 0, 1
    while start < len(text):
        end = text.find("\n", start) + 1 or len(text)
        line = text[start:end]
        if len(line) > LONGEST_LINE:
            raise ValueError(f"{path}, line {number}: has {len(line)} characters; at most {LONGEST_LINE} are read. "
                             "Save the table again.")
        if '"' in line and line.count('"') % 2:
            raise ValueError(f"{path}, line {number}: a quote is not closed. Save the table again, without quotes.")
        yield line
        start, number = end, number + 1


def _find_columns(path: str | Path, header: list[str], fields: Sequence[Field], see: str) -> list[int]:
    for field in fields:
        if header.count(field.name) != 1:
            count = "no column" if field.name not in header else "more than one column"
            names = ", ".join(one.name for one in fields)
            raise ValueError(f"{path}: {count} {field.name!r} (found {shown(header)}). It needs {names} in SI units, "
                             f"separated by commas. {see}".rstrip())
    return [header.index(field.name) for field in fields]


def _wrong_length(path: str | Path, line: int, row: list[str], header: list[str], fields: Sequence[Field]) -> str:
    absent = [field.name for field in fields if header.index(field.name) >= len(row)]
    value = f"; {absent[0]} is ''" if absent else ""
    return (f"{path}, line {line}: has {len(row)} cells, the header {len(header)}{value}. Write decimals with a point, "
            "and leave a missing sample's row out.")


def _numbers(path: str | Path, line: int, cells: list[str], fields: Sequence[Field]) -> list[float]:
    found = []
    for cell, field in zip(cells, fields, strict=True):
        try:
            value = float(cell)
        except ValueError:
            value = math.nan
        if not math.isfinite(value) or "_" in cell or not cell.isascii():
            finite = cell.strip().lower().lstrip("+-") in ("nan", "inf", "infinity") or math.isinf(value)
            rule = "it must be finite" if finite else "it must be a number"
            text = cell if finite and len(cell) < 20 else shown(cell)
            raise ValueError(f"{path}, line {line}: {field.name} is {text}; {rule}. Write decimals with a point, and "
                             "leave a missing sample's row out.")
        found.append(value)
    return found


def read_arrays(path: str | Path, missing: str, hint: str) -> dict[str, np.ndarray]:
    """Arrays of a .npz file by name. No pickle is read, and an array's size is that of its bytes in the file.

    Args:
        missing: as of `read_bytes`.
        hint: ends every error.
    """
    data = read_bytes(path, ARRAY_BYTES, missing)
    if data[:6] == b"\x93NUMPY":
        raise ValueError(f"{path}: is one array (.npy) and no .npz archive. {hint}")
    found = {}
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            if len(members) > MEMBERS or sum(one.file_size for one in members) > ARRAY_BYTES:
                raise ValueError(f"{len(members)} arrays, unpacked larger than {ARRAY_BYTES / MB:g} MB or too many")
            for one in members:
                with archive.open(one) as member:
                    content = member.read(one.file_size)
                found[one.filename.removesuffix(".npy")] = _array(one.filename, content)
    except MemoryError:
        raise ValueError(f"{path}: cannot be read as .npz (more memory than there is). {hint}") from None
    except BROKEN_ARCHIVE as error:
        raise ValueError(f"{path}: cannot be read as .npz ({_first_line(error)}). {hint}") from None
    return found


def _array(name: str, content: bytes) -> np.ndarray:
    """The array of a .npy member."""
    file = io.BytesIO(content)
    major, minor = np.lib.format.read_magic(file)
    read_header = {1: np.lib.format.read_array_header_1_0, 2: np.lib.format.read_array_header_2_0}.get(major)
    if read_header is None or minor != 0:
        raise ValueError(f"array {shown(name)} has .npy version {major}.{minor}")
    try:
        shape, fortran, dtype = read_header(file, max_header_size=NPY_HEADER)
    except Exception as error:  # numpy parses the header as Python text, and lets much of its parser's errors out
        raise ValueError(f"array {shown(name)} has a damaged header ({_first_line(error)})") from None
    size = math.prod(shape)
    rest = memoryview(content)[file.tell() :]
    if dtype.hasobject or dtype.kind not in "biufU" or not dtype.itemsize or min(shape, default=0) < 0:
        raise ValueError(f"array {shown(name)} holds {shown(str(dtype))}, which is neither numbers nor text")
    if size * dtype.itemsize != len(rest):
        raise ValueError(f"array {shown(name)} of shape {shown(shape)} has {len(rest)} bytes")
    return np.frombuffer(rest, dtype).reshape(shape, order="F" if fortran else "C").copy()


def read_gzip(path: str | Path, missing: str, hint: str) -> str:
    """Text of a .gz file of at most ARRAY_BYTES unpacked; `hint` ends every error."""
    import gzip

    data = read_bytes(path, ARRAY_BYTES, missing)
    try:
        with gzip.open(io.BytesIO(data)) as file:
            content = file.read(ARRAY_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise ValueError(f"{path}: cannot be read as .gz ({_first_line(error)}). {hint}") from None
    if len(content) > ARRAY_BYTES:
        raise ValueError(f"{path}: unpacked it is larger than {ARRAY_BYTES / MB:g} MB, the most that is read. {hint}")
    return decoded(path, content)


def _first_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return ascii(lines[0][:LONGEST_REASON])[1:-1] if lines else type(error).__name__
