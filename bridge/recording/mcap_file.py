"""Writes ROS messages as they come into an MCAP file, which Foxglove, `ros2 bag` and sysid.convert read.

Only the records that a reader needs are written, one after the other and without chunks: https://mcap.dev/spec. So a
file that was cut off anywhere is whole again once its torn record is dropped and its end is written (`mend`).
"""

import importlib
import os
import re
import struct
import time
from pathlib import Path
from typing import Any

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, DATA_END = 1, 2, 3, 4, 5, 15
HEAD = struct.Struct("<BQ")
"""Of a record: its kind and the length of its content."""
PLAIN = {"boolean": "bool", "octet": "byte", "float": "float32", "double": "float64"}
"""Types whose name in a class differs from that in a definition."""
RULE = "=" * 80


class McapWriter:
    """An MCAP file of the profile ros2."""

    def __init__(self, path: Path) -> None:
        """Begin the file, which must not exist."""
        self._file = open(path, "xb")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._counts: dict[int, int] = {}
        self._file.write(MAGIC)
        self._record(HEADER, _text("ros2") + _text("whill-bridge"))

    def write(self, topic: str, kind: Any, data: bytes, received: int = 0) -> None:
        """Add a message.

        Args:
            topic: its name.
            kind: its class.
            data: as it was serialised (CDR).
            received: Unix time [ns]; 0: now. Beside it stands the header's stamp, where the message has one.
        """
        received = received or time.time_ns()
        if topic not in self._channels:
            self._open(topic, kind)
        channel = self._channels[topic]
        count = self._counts.get(channel, 0)
        self._counts[channel] = count + 1
        stamp = stamp_of(kind, data) or received
        self._record(MESSAGE, struct.pack("<HIQQ", channel, count & 0xFFFFFFFF, received, stamp) + data)

    def flush(self) -> None:
        """Hand what was written so far to the operating system."""
        self._file.flush()

    def close(self) -> None:
        """End the file."""
        self._file.write(_end())
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()

    def _open(self, topic: str, kind: Any) -> None:
        name = name_of(kind)
        if name not in self._schemas:
            self._schemas[name] = number = len(self._schemas) + 1
            text = definition_of(kind).encode()
            self._record(SCHEMA, struct.pack("<H", number) + _text(name) + _text("ros2msg")
                         + struct.pack("<I", len(text)) + text)
        self._channels[topic] = number = len(self._channels) + 1
        self._record(CHANNEL, struct.pack("<HH", number, self._schemas[name]) + _text(topic) + _text("cdr")
                     + struct.pack("<I", 0))

    def _record(self, kind: int, content: bytes) -> None:
        self._file.write(HEAD.pack(kind, len(content)) + content)


def _text(text: str) -> bytes:
    content = text.encode()
    return struct.pack("<I", len(content)) + content


def _end() -> bytes:
    return HEAD.pack(DATA_END, 4) + bytes(4) + HEAD.pack(FOOTER, 20) + bytes(20) + MAGIC


def mend(path: Path) -> None:
    """Make a file whole whose recorder was killed: drop the record that was only begun, and write the end.

    A file that is whole stays as it is.
    """
    size = path.stat().st_size
    with open(path, "r+b") as file:
        if size < len(MAGIC) or file.read(len(MAGIC)) != MAGIC:
            return  # nothing was written, or it is no such file
        at = len(MAGIC)
        while size - at >= HEAD.size:
            kind, length = HEAD.unpack(file.read(HEAD.size))
            if kind == DATA_END or at + HEAD.size + length > size:
                break
            at = file.seek(at + HEAD.size + length)
        file.truncate(at)
        file.seek(at)
        file.write(_end())


def name_of(kind: Any) -> str:
    """Return the name of a message class, such as nav_msgs/msg/Odometry."""
    return f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"


def stamp_of(kind: Any, data: bytes) -> int:
    """Return the stamp [ns] of a serialised message, 0 where it has no header or no stamp."""
    if next(iter(kind.get_fields_and_field_types().values()), "") != "std_msgs/Header" or len(data) < 12:
        return 0
    seconds, nanoseconds = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return seconds * 1_000_000_000 + nanoseconds if seconds >= 0 else 0


def definition_of(kind: Any) -> str:
    """Return the definition of a message class with those of all messages in it, as a .msg file would have it."""
    parts, seen, waiting = [], {name_of(kind)}, [kind]
    while waiting:
        one = waiting.pop(0)
        lines = []
        for field, text in one.get_fields_and_field_types().items():
            element, suffix = _element(text)
            if "/" in element:
                package, _, name = element.partition("/")
                inner = getattr(importlib.import_module(f"{package}.msg"), name)
                if name_of(inner) not in seen:
                    seen.add(name_of(inner))
                    waiting.append(inner)
            lines.append(f"{PLAIN.get(element, element)}{suffix} {field}")
        title = "" if one is kind else f"{RULE}\nMSG: {one.__module__.split('.')[0]}/{one.__name__}\n"
        parts.append(title + "".join(f"{line}\n" for line in lines))
    return "".join(parts)


def _element(text: str) -> tuple[str, str]:
    """Split a type such as sequence<double, 3> into its element and what a definition writes behind it."""
    if match := re.fullmatch(r"sequence<(.+?)(?:, (\d+))?>", text):
        element, bound = match[1], match[2]
        return _bounded(element), f"[<={bound}]" if bound else "[]"
    if match := re.fullmatch(r"(.+)\[(\d+)\]", text):
        return _bounded(match[1]), f"[{match[2]}]"
    return _bounded(text), ""


def _bounded(text: str) -> str:
    """Return a bounded string as a definition writes it."""
    return re.sub(r"^(w?string)<(\d+)>$", r"\1<=\2", text)
