"""The page of all commands, docs/reference/commands.md: `python -m benchmarks.command_page` writes it."""

from __future__ import annotations

import importlib
from pathlib import Path

from bridge.nodes.options import Parser
from whill_mjx.io.command_line import guarded
from whill_mjx.io.folders import write_whole

PAGE = Path(__file__).parent.parent / "docs" / "reference" / "commands.md"
PACKAGES = {"whill_mjx": "Simulator and training", "sysid": "Identification", "bridge": "ROS 2"}
MORE = {
    "whill_mjx.train": "training.md", "whill_mjx.evaluate": "evaluate.md", "whill_mjx.maps": "maps.md",
    "whill_mjx.look": "tutorials/1_look_and_drive.md", "whill_mjx.drive": "tutorials/1_look_and_drive.md",
    "whill_mjx.export_mjcf": "howto/export.md", "whill_mjx.export_python": "howto/export.md",
    "whill_mjx.view": "view.md", "sysid.fit": "fit.md", "sysid.close_loop": "close_loop.md",
    "sysid.inspect": "sysid_tools.md#inspect", "sysid.convert": "sysid_tools.md#convert",
    "sysid.design": "sysid_tools.md#design", "sysid.verdict": "close_loop.md", "sysid.report": "sysid_tools.md#report",
    "sysid.paper": "sysid_tools.md#the-papers-experiment", "sysid.searches": "sysid_tools.md#which-search",
}  # fmt: skip
"""Pages of the commands; those of the bridge share one."""
HEAD = """# Commands

<!-- Written by python -m benchmarks.command_page. -->

Each command is a Python module, and each takes `--help`. Installed, most are also programs: `whill-train` is
`python -m whill_mjx.train`, and `sysid-close-loop` is `python -m sysid.close_loop`.

```mermaid
flowchart LR
  drive["whill_mjx.drive"] --> data[(dataset)]
  convert["sysid.convert"] --> data
  record["bridge.record"] --> data
  data --> fit["sysid.fit"] --> vehicle[(vehicle.toml)]
  data --> loop["sysid.close_loop"] --> vehicle
  vehicle --> train["whill_mjx.train"] --> policy[(policy)]
  policy --> evaluate["whill_mjx.evaluate"]
  policy --> bridge["bridge.drive"]
```

| what all share | |
|---|---|
| exit code | 0 done, 1 a file or the machine is at fault, 2 the command ([all](../reliability.md#exit-codes)) |
| a mistake in an option | is named before anything is computed |
| the same command again | long work goes on where it stopped ([what is promised](../reliability.md)) |
| `make train`, `make test`, `make docs` | run training, tests and site build in a virtual environment that they make |
"""


def page() -> str:
    """Markdown of the page."""
    lines = [HEAD]
    for package, title in PACKAGES.items():
        lines += [f"## {title}", "", "| command | what it does |", "|---|---|"]
        face = importlib.import_module(f"{package}.__main__")
        for name in face.COMMANDS:
            module = f"{package}.{name}"
            more = "../" + MORE.get(
                module, {"bridge": "bridge.md", "sysid": "sysid_tools.md"}.get(package, "training.md")
            )
            lines.append(f"| [`python -m {module}`]({more}) | {face.first_line(name)} |")
        lines.append("")
    return "\n".join(lines)


def main() -> None:
    """Write the page."""
    Parser(prog="python -m benchmarks.command_page", description=__doc__).parse_args()
    write_whole(PAGE, page())
    print(PAGE)


if __name__ == "__main__":
    with guarded():
        main()
