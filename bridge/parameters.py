"""ROS parameters as options of the command line: `-p name:=value` and `--params-file FILE` after `--ros-args`.

They are read before the node exists, so a bad one ends the program before it joins the graph. Options given on the
command line itself win.
"""

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

LARGEST = 100_000
"""Bytes of a parameter file; those of the bridge have 2 kB."""
OF_ROS = ("use_sim_time", "start_type_description_service")
"""Parameters that every ROS node has; the node itself reads them."""


def with_options(ros_arguments: list[str], node: str, positional: str, own: list[str]) -> list[str]:
    """Return the words of the command line, and before them the ROS parameters that they do not give themselves.

    Args and Raises: as of `as_options`; `own` are the words.
    """
    given = {word.partition("=")[0] for word in own if word.startswith("--")}
    return as_options(ros_arguments, node, positional, given) + own


def as_options(ros_arguments: list[str], node: str, positional: str = "", given: Collection[str] = ()) -> list[str]:
    """Return the ROS parameters of a node as words of the command line.

    Args:
        ros_arguments: what follows and includes `--ros-args`.
        node: name of the node, to find its section of a parameter file.
        positional: the parameter that is no option but stands alone.
        given: options that are left out.

    Raises:
        ValueError: a parameter file cannot be read.
    """
    values: dict[str, Any] = {}
    for flag, argument in zip(ros_arguments, ros_arguments[1:], strict=False):
        if flag == "--params-file":
            values.update(read_file(Path(argument), node))
        elif flag in ("-p", "--param") and ":=" in argument:
            name, _, text = argument.partition(":=")
            values[name.rpartition(":")[2]] = _yaml(text)
    words: list[str] = []
    for name, value in values.items():
        if name in OF_ROS or str(name).startswith("qos_overrides."):
            continue
        if name == positional:
            words.insert(0, str(value))
        elif f"--{str(name).replace('_', '-')}" not in given:
            words.extend(_option(name, value))
    return words


def read_file(path: Path, node: str) -> dict[str, Any]:
    """Return the parameters that a YAML file has for a node, or for all of them.

    Raises:
        ValueError: the file is missing or is no parameter file.
    """
    sections = load_yaml(path, LARGEST, "Give an existing parameter file.")
    if not isinstance(sections, dict):
        raise ValueError(f"{path}: holds {type(sections).__name__}; a parameter file maps node names to "
                         "`ros__parameters`. Correct it.")
    values: dict[str, Any] = {}
    for name, section in sections.items():
        if str(name).rpartition("/")[2] in ("**", "*", node) and isinstance(section, dict):
            table = section.get("ros__parameters") or {}
            if not isinstance(table, dict) or not all(map(_is_plain, table.values())):
                raise ValueError(f"{path}: {str(name)[:60]!r} has ros__parameters that are no numbers, texts or lists "
                                 "of them by name. Correct it.")
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
    """Yield the words of one option; false and empty values leave the default."""
    if value is False or value is None or value == "":
        return
    yield "--" + str(name).replace("_", "-")
    if value is not True:
        yield from (str(item) for item in (value if isinstance(value, list) else [value]))


def _yaml(text: str) -> Any:
    import yaml  # rclpy depends on it

    try:
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # also a date that is none
        raise ValueError(f"ROS parameters: {' '.join(str(error).split())[:300]}. Correct the YAML.") from None
