"""ROS parameters as options of the command line: `-p name:=value` and `--params-file FILE` after `--ros-args`.

They are read before the node exists, so a bad one ends the program before it joins the graph. Options given on the
command line itself win.
"""

import re
import sys
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from bridge.nodes import ros
from bridge.nodes.exits import Exit
from bridge.nodes.options import LeftOut

LARGEST = 100_000
"""Bytes of a parameter file; those of the bridge have 2 kB."""
MOST_TABLES = 1000
"""Of a parameter file; aliases can make endlessly many of a few bytes."""
OF_ROS = ("use_sim_time", "start_type_description_service")
"""Parameters that every ROS node has; the node itself reads them."""


def command_line(arguments: list[str] | None, program: str, positional: str = "") -> tuple[list[str], list[str]]:
    """Return the words of a command line, ROS parameters of its node among them, and what follows `--ros-args`.

    Args:
        arguments: of `main`; None: those of the process.
        program: such as bridge.guard, whose node is bridge_guard.
        positional: as of `as_options`.

    Raises:
        SystemExit: a parameter file cannot be read, or has nothing for this node.
    """
    own, ros_arguments = ros.split_ros_arguments(sys.argv[1:] if arguments is None else arguments)
    try:
        return with_options(ros_arguments, program.replace(".", "_"), positional, own), ros_arguments
    except ValueError as error:
        print(f"{program}: {error}", file=sys.stderr)
        raise SystemExit(int(Exit.FAULT)) from None


def with_options(ros_arguments: list[str], node: str, positional: str, own: list[str]) -> list[str]:
    """Return the words of the command line, and with them the ROS parameters that they do not give themselves.

    An option of several values takes all words up to the next option, so own words never follow a parameter's.

    Args and Raises: as of `as_options`; `own` are the words.
    """
    given = {word.partition("=")[0] for word in own if word.startswith("--")}
    words = as_options(ros_arguments, node, positional, given)
    first = [word for word in words[:1] if not word.startswith("--")]  # the positional one
    options = words[len(first):]
    if own and not own[0].startswith("-"):
        first = []  # the command line has its own
    end = own.index("--") if "--" in own else len(own)
    return first + own[:end] + options + own[end:]


def as_options(ros_arguments: list[str], node: str, positional: str = "", given: Collection[str] = ()) -> list[str]:
    """Return the ROS parameters of a node as words of the command line.

    Args:
        ros_arguments: what follows and includes `--ros-args`.
        node: name of the node unless a remapping gives it another one, to find its section of a parameter file.
        positional: the parameter that is no option but stands alone.
        given: options that are left out.

    Raises:
        ValueError: a parameter file cannot be read, or has nothing for this node.
    """
    values: dict[str, Any] = {}
    full = _full_name(ros_arguments, node)
    for flag, argument in zip(ros_arguments, ros_arguments[1:], strict=False):
        if flag == "--params-file":
            values.update(read_file(Path(argument), full))
        elif flag in ("-p", "--param") and ":=" in argument:
            left, _, text = argument.partition(":=")
            target, _, name = left.rpartition(":")
            if name not in OF_ROS and (not target or _is_for(target, full)):
                values[name] = _yaml(text)
    words: list[str] = []
    for name, value in values.items():
        if name in OF_ROS or str(name).startswith("qos_overrides."):
            continue
        if name == positional:
            words.insert(0, str(value))
        elif f"--{str(name).replace('_', '-')}" not in given:
            words.extend(_option(name, value))
    return words


def _full_name(ros_arguments: list[str], node: str) -> str:
    """Return the name that a node gets from ROS, with its namespace, such as /left/bridge_drive."""
    namespace = ""
    for flag, argument in zip(ros_arguments, ros_arguments[1:], strict=False):
        if flag in ("-r", "--remap"):
            left, _, value = argument.partition(":=")
            rule = left.rpartition(":")[2]
            if rule == "__ns":
                namespace = value
            elif rule in ("__node", "__name"):
                node = value
    return f"/{namespace.strip('/')}/{node}".replace("//", "/")


def _is_for(section: str, full: str) -> bool:
    """Return whether the name of a section means the node of a full name: `*` is one part of it, `**` any number.

    A single name without a slash means the node in any namespace.
    """
    if "/" not in section:
        return section in ("*", "**", full.rpartition("/")[2])
    parts = {"**": "(/[^/]+)*", "*": "/[^/]+"}
    pattern = "".join(parts.get(part, "/" + re.escape(part)) for part in section.strip("/").split("/"))
    return re.fullmatch(pattern, full) is not None


def _sections(table: dict[Any, Any]) -> Iterator[tuple[str, Any]]:
    """Yield name and parameters of each section, in the order of the file; a namespace may stand above its nodes.

    Raises:
        ValueError: there are too many tables, as where one contains itself.
    """
    waiting, looked = [("", table)], 0
    while waiting:
        above, one = waiting.pop()
        looked += 1
        if looked > MOST_TABLES:
            raise ValueError(f"holds more than {MOST_TABLES} tables; a parameter file has one for each node. Correct "
                             "it.")
        if "ros__parameters" in one:
            yield above, one["ros__parameters"] or {}
        names = [(f"{above.rstrip('/')}/{str(name).strip('/')}" if above else str(name), inner)
                 for name, inner in one.items() if name != "ros__parameters"]
        waiting += [(name, inner) for name, inner in reversed(names) if isinstance(inner, dict)]


def read_file(path: Path, full: str) -> dict[str, Any]:
    """Return the parameters that a YAML file has for the node of a full name.

    Raises:
        ValueError: the file is missing, is no parameter file, or has no section that means this node.
    """
    sections = load_yaml(path, LARGEST, "Give an existing parameter file.")
    if not isinstance(sections, dict):
        raise ValueError(f"{path}: holds {type(sections).__name__}; a parameter file maps node names to "
                         "`ros__parameters`. Correct it.")
    values: dict[str, Any] = {}
    try:
        found = list(_sections(sections))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    ours = [(name, table) for name, table in found if _is_for(name, full)]
    if not ours:
        names = ", ".join(name for name, _ in found)[:200] or "none"
        raise ValueError(f"{path}: has no section for the node {full} (it has: {names}). Name one so, or /**.")
    for name, table in ours:
        if not isinstance(table, dict) or not all(map(_is_plain, table.values())):
            raise ValueError(f"{path}: {name[:60]!r} has ros__parameters that are no numbers, texts or lists of them "
                             "by name. Correct it.")
        values.update(table)
    return values


def load_yaml(path: Path, largest: int, remedy: str) -> Any:
    """Return the content of a YAML file of at most `largest` bytes.

    Raises:
        ValueError: naming the file and what is wrong with it; `remedy` follows where it cannot be read.
    """
    try:
        if not path.is_file():
            raise ValueError(f"{path}: no such file. {remedy}")
        with path.open("rb") as file:
            content = file.read(largest + 1)
        text = content.decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: {error}. {remedy}") from None
    if len(content) > largest:
        raise ValueError(f"{path}: is larger than {largest / 1000:g} kB. {remedy}")
    try:
        return _yaml(text)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _is_plain(value: Any) -> bool:
    """Whether a value is a number, a text, or a list of such."""
    items = value if isinstance(value, list) else [value]
    return all(item is None or isinstance(item, bool | int | float | str) for item in items)


def _option(name: str, value: Any) -> Iterator[str]:
    """Yield the words of one option; false and empty values leave the default, of an option that there is."""
    option = "--" + str(name).replace("_", "-")
    if value is False or value is None or value == "":
        yield LeftOut(option)
        return
    yield option
    if value is not True:
        yield from (str(item) for item in (value if isinstance(value, list) else [value]))


def _yaml(text: str) -> Any:
    import yaml  # rclpy depends on it

    try:
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # also a date that is none
        raise ValueError(f"ROS parameters: {' '.join(str(error).split())[:300]}. Correct the YAML.") from None
