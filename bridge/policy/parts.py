"""Opens the parts of a policy, a folder or a zip of it, and reads those that `policy.json` lists, within stated sizes.

A stray file is never opened, a part is never larger than `LIMITS` says, and a zip is refused before it is unpacked
where it would grow beyond them. Hashes are computed piece by piece, so the archive of the weights costs no memory.
"""

import contextlib
import hashlib
import io
import json
import math
import os
import reprlib
import stat
import zipfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import IO, Any

import numpy as np

MIB = 1 << 20
TABLE = "policy.json"
LIMITS = {
    TABLE: MIB,  # a few kB of text; 1 MiB is parsed in milliseconds
    "policy.onnx": 256 * MIB,  # the network of the largest preset of the learner, size100m, has 240 MiB
    "weights.npz": 512 * MIB,  # the archive of the same preset has 360 MiB
    "policy.stablehlo": 256 * MIB,  # the same network for JAX
    "vehicle.toml": MIB,  # a few kB of text
}
"""Largest size of each part [bytes]."""
OTHER_LIMIT = MIB
"""Largest size of a listed file of another name [bytes]: notes and licences."""
MAX_FILES = 16
"""Most files that `policy.json` may list; an export writes at most four."""
MAX_EXPANSION = 100
"""Largest ratio by which a member of a zip may grow. Trained numbers grow by less than 3; a zip bomb by 1000."""
MAX_DIRECTORY = MIB
"""Largest directory of a zip [bytes]: room for 10,000 members, read before any of them."""
MAX_DEPTH = 16
"""Deepest nesting of `policy.json`; an export nests three deep."""
MAX_NUMBER = 1e15
"""Largest number in `policy.json`. All of them are sizes, rates, speeds and angles."""
CHUNK = MIB
"""Bytes that are hashed at a time."""
EXPORT_AGAIN = ("Export the policy again (dreamer.policy_files.export.export_policy; an agent: export_agent or "
                "dreamer.policy.save)")
COPY_AGAIN = "Copy the policy file again, or export the policy again"


class PolicyFileError(ValueError):
    """The policy file is missing, damaged, of another version or contradicts itself."""


def show(value: Any) -> str:
    """Return a value for a message, cut to a readable length."""
    short = reprlib.Repr()
    short.maxstring = short.maxother = 80
    return short.repr(value)


@contextlib.contextmanager
def refusals(name: str, remedy: str = COPY_AGAIN) -> Iterator[None]:
    """Turn every fault of the decoders inside into a `PolicyFileError` on the file `name`.

    The libraries that decode zip, deflate, npy, JSON and UTF-8 raise a dozen types of their own on damaged bytes, and
    more with each version. Each of them means the same here: these bytes are not what they must be.
    """
    try:
        yield
    except PolicyFileError:
        raise
    except RecursionError as error:
        raise PolicyFileError(f"{name}: is nested too deeply to be read. It must nest at most {MAX_DEPTH} deep. "
                              f"{EXPORT_AGAIN}.") from error
    except Exception as error:
        cause = str(error)[:300] or type(error).__name__
        raise PolicyFileError(f"{name}: cannot be read ({type(error).__name__}: {cause}). Every listed part must be "
                              f"whole and readable. {remedy}.") from error


class Parts:
    """The files of one policy, opened by name. Use it as a context: a zip stays open inside."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._stack = contextlib.ExitStack()
        self._archive: zipfile.ZipFile | None = None
        self._members: dict[str, list[zipfile.ZipInfo]] = {}

    def __enter__(self) -> "Parts":
        with refusals(str(self.path), "Give a folder, or a zip of it, with policy.json"), self._stack:
            if not self.path.is_dir():
                self._open_zip()
            self._stack = self._stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def name(self, part: str) -> str:
        """Return the name of a part for messages."""
        return f"{self.path}/{part}"

    def has(self, part: str) -> bool:
        """Return whether there is such a part."""
        if self._archive:
            return part in self._members
        with refusals(self.name(part)):
            return os.path.lexists(self.path / part)

    def table(self) -> dict[str, Any]:
        """Return `policy.json` as an object whose numbers are finite."""
        name = self.name(TABLE)
        if not self.has(TABLE):
            raise PolicyFileError(f"{name}: is missing. Every policy file has it. {EXPORT_AGAIN}.")
        _, data = self.take(TABLE, keep=True)
        return parse_table(name, data)

    def take(self, part: str, keep: bool) -> tuple[str, bytes]:
        """Return the SHA-256 of a part, and its bytes or, without `keep`, its first four."""
        limit, name, digest = LIMITS.get(part, OTHER_LIMIT), self.name(part), hashlib.sha256()
        kept = io.BytesIO()  # its value is handed out without a copy
        with refusals(name), self._open(part) as (stream, size):
            if size > limit:
                raise PolicyFileError(f"{name}: has {size} bytes; at most {limit} are read. {EXPORT_AGAIN} with a "
                                      "smaller network.")
            left = size
            while chunk := stream.read(min(CHUNK, left + 1)):
                left -= len(chunk)
                if left < 0:
                    raise PolicyFileError(f"{name}: is longer than the {size} bytes that its entry says. {COPY_AGAIN}.")
                digest.update(chunk)
                if keep or not kept.tell():
                    kept.write(chunk if keep else chunk[:4])
            if left:
                raise PolicyFileError(f"{name}: ends {left} bytes early. All of its {size} bytes must be there. "
                                      f"{COPY_AGAIN}.")
        return digest.hexdigest(), kept.getvalue()

    def checked(self, part: str, want: str, keep: bool = False) -> bytes:
        """Return what `take` does, after comparing the SHA-256 with that of `policy.json`."""
        if not self.has(part):
            raise PolicyFileError(f"{self.name(part)}: is missing, but policy.json lists it with SHA-256 {want}. All "
                                  f"listed files must be there. {COPY_AGAIN}.")
        got, data = self.take(part, keep)
        if got != want:
            raise PolicyFileError(f"{self.name(part)}: SHA-256 {got}, but policy.json says {want}. The file was "
                                  f"damaged or changed after the export. {COPY_AGAIN}.")
        return data

    @contextlib.contextmanager
    def _open(self, part: str) -> Iterator[tuple[IO[bytes], int]]:
        if self._archive is None:
            with _open_regular(self.path / part) as stream:
                yield stream, os.fstat(stream.fileno()).st_size
            return
        first, *others = self._members[part]
        if others:
            raise PolicyFileError(f"{self.path}: holds {part} twice; a policy zip holds one policy. Zip the one "
                                  "folder.")
        _check_member(self.name(part), first)
        with self._archive.open(first) as stream:
            yield stream, first.file_size

    def _open_zip(self) -> None:
        if not os.path.lexists(self.path):
            raise PolicyFileError(f"{self.path}: does not exist. A policy file is a folder, or a zip of it, with "
                                  "policy.json. Correct the path.")
        try:
            stream = self._stack.enter_context(_open_regular(self.path))
            self._archive = self._stack.enter_context(zipfile.ZipFile(_ShortReads(stream)))  # type: ignore[type-var]
        except PolicyFileError:
            raise
        except Exception as error:  # see `refusals`
            raise PolicyFileError(f"{self.path}: cannot be read as a zip ({type(error).__name__}: {error}). A policy "
                                  f"file is a folder or a zip of it. {COPY_AGAIN}.") from error
        for info in self._archive.infolist():
            place = PurePosixPath(info.filename)
            if not info.is_dir() and len(place.parts) <= 2:  # the folder itself, or what is in it
                self._members.setdefault(place.name, []).append(info)


def _check_member(name: str, info: zipfile.ZipInfo) -> None:
    """Raise where unpacking a member of a zip could take much more memory than its packed size."""
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise PolicyFileError(f"{name}: compression method {info.compress_type}; a zip must store or deflate its "
                              f"members. {EXPORT_AGAIN}, or zip the folder again.")
    if info.file_size > max(MIB, MAX_EXPANSION * info.compress_size):
        raise PolicyFileError(f"{name}: {info.compress_size} bytes would grow to {info.file_size}; a member may grow "
                              f"at most {MAX_EXPANSION} times. {EXPORT_AGAIN}, or zip the folder again.")


class _ShortReads(io.BufferedIOBase):
    """A file without large reads: `zipfile` reads a whole directory at once, whatever size it claims to have."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self.seek, self.tell, self.seekable = stream.seek, stream.tell, stream.seekable  # type: ignore[method-assign]

    def read(self, size: int | None = -1, /) -> bytes:
        data = self._stream.read(MAX_DIRECTORY + 1 if size is None or size < 0 else min(size, MAX_DIRECTORY + 1))
        if len(data) > MAX_DIRECTORY:
            raise PolicyFileError(f"its directory has more than {MAX_DIRECTORY} bytes")
        return data


@contextlib.contextmanager
def _open_regular(path: Path) -> Iterator[IO[bytes]]:
    """Open a regular file for reading; a pipe or a device would block or never end."""
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise PolicyFileError(f"{path}: is not a regular file. Parts of a policy are plain files. {COPY_AGAIN}.")
    with os.fdopen(descriptor, "rb") as stream:
        yield stream


def parse_table(name: str, data: bytes) -> dict[str, Any]:
    """Return a JSON object whose keys are unique, whose numbers are finite and whose text is Unicode."""
    try:
        table = json.loads(data.decode("utf-8"), object_pairs_hook=_unique)
    except RecursionError as error:
        raise PolicyFileError(f"{name}: is nested too deeply to be read. It must nest at most {MAX_DEPTH} deep. "
                              f"{EXPORT_AGAIN}.") from error
    except ValueError as error:
        raise PolicyFileError(f"{name}: is not JSON ({error}). It must be a UTF-8 JSON object. "
                              f"{EXPORT_AGAIN}.") from error
    if not isinstance(table, dict):
        raise PolicyFileError(f"{name}: holds a {type(table).__name__}; it must be a JSON object. {EXPORT_AGAIN}.")
    _check_values(name, table)
    return table


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise ValueError(f"the key {show(twice)} is given twice")
    return table


def _check_values(name: str, table: dict[str, Any]) -> None:
    """Raise at a number that is not finite or too large, at text that is not Unicode, and where it nests too deeply."""
    waiting: list[tuple[tuple, Any, int]] = [((), table, 0)]  # a place is (place above, key): no text is built in vain
    while waiting:
        place, value, depth = waiting.pop()
        problem = None
        if isinstance(value, dict | list):
            items = value.items() if isinstance(value, dict) else enumerate(value)
            waiting += [((place, key), item, depth + 1) for key, item in items]
            if depth >= MAX_DEPTH:
                problem = f"it must nest at most {MAX_DEPTH} deep"
            elif isinstance(value, dict) and any(_is_half_character(key) for key in value):
                problem = "its keys must be Unicode without lone surrogates"
        elif isinstance(value, str) and _is_half_character(value):
            problem = "text must be Unicode without lone surrogates"
        elif isinstance(value, float) and not math.isfinite(value):
            problem = "numbers must be finite"
        elif isinstance(value, int | float) and abs(value) > MAX_NUMBER:
            problem = f"numbers must be at most {MAX_NUMBER:g} in size"
        if problem:
            raise PolicyFileError(f"{name}: {_place_text(place)} = {show(value)}, but {problem}. {EXPORT_AGAIN}.")


def _place_text(place: tuple) -> str:
    keys: list[str] = []
    while place:
        place, key = place
        keys.append(str(key))
    return show(".".join(reversed(keys)))[1:-1]


def _is_half_character(text: str) -> bool:
    return any("\ud800" <= character <= "\udfff" for character in text)


def read_arrays(name: str, data: bytes) -> dict[str, np.ndarray]:
    """Return the arrays of an .npz by name, each of the shape (...) and type that it was stored with, such as
    float32 without a unit; `name` is the file.

    Raises:
        PolicyFileError: it is no archive of plain arrays, or an array's header says another size than its bytes have.
    """
    arrays: dict[str, np.ndarray] = {}
    with refusals(name), zipfile.ZipFile(_ShortReads(io.BytesIO(data))) as archive:  # type: ignore[type-var]
        infos = archive.infolist()
        total, limit = sum(info.file_size for info in infos), LIMITS["weights.npz"]
        if total > limit:
            raise PolicyFileError(f"{name}: its arrays have {total} bytes; at most {limit} are read. {EXPORT_AGAIN}.")
        for info in infos:
            _check_member(f"{name} {show(info.filename)}", info)
            content = io.BytesIO()
            with archive.open(info) as stream:
                while chunk := stream.read(CHUNK):
                    content.write(chunk)
            key = info.filename.removesuffix(".npy")
            arrays[key] = _read_array(f"{name} {show(info.filename)}", content.getvalue())
    return arrays


def _read_array(name: str, data: bytes) -> np.ndarray:
    """Return one .npy; numpy alone would allocate whatever size the header claims."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise PolicyFileError(f"{name}: npy version {version}; 1.0 and 2.0 are read. {EXPORT_AGAIN}.")
    shape, fortran, dtype = readers[version](stream)
    size, left = math.prod(shape) * dtype.itemsize, len(data) - stream.tell()
    if dtype.hasobject or dtype.kind not in "biuf" or size != left or min(shape, default=1) < 0:
        raise PolicyFileError(f"{name}: {dtype} {show(shape)} in {left} bytes; an array must be plain numbers of that "
                              f"size. {EXPORT_AGAIN}.")
    array = np.frombuffer(data, dtype, offset=stream.tell())
    return array.reshape(shape, order="F" if fortran else "C")
