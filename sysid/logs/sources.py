"""What a path holds, and which command takes it: for the messages of commands that were given something else."""

from __future__ import annotations

import re
from pathlib import Path

from sysid.logs.bags.recording import SUFFIXES, find_bags, is_bag
from whill_mjx.io.fields import in_shell
from whill_mjx.vehicle.vehicle_file import ROBOT_FILES

LEROBOT_INFO = "meta/info.json"
HEAD = 4000  # bytes of a text that are looked at
PACKED = (".zst", ".zstd", ".gz", ".zip", ".tar", ".tgz", ".bz2", ".xz")
TRIAL_FILES = ("command.csv", "odometry.csv", "ground_truth.csv")
TUM = 8  # numbers of a row: time, position, quaternion


def is_lerobot(path: Path) -> bool:
    """Whether a folder is a LeRobotDataset."""
    return path.is_dir() and (path / LEROBOT_INFO).is_file() and (path / "data").is_dir()


def about(path: Path) -> str:
    """One or two sentences on a path: what it is and what to do with it."""
    if not path.exists():
        return "no such folder or file. Correct the path."
    if path.is_dir():
        return _about_folder(path)
    return _about_file(path) if path.is_file() else "a pipe or a device, not a file. Give the name of a file or folder."


def refuse_recording(path: str | Path, needed: str) -> None:
    """Raise ValueError where a path is a recording or a dataset, with what is needed instead."""
    path = Path(path)
    if path.exists() and (is_bag(path) or find_bags(path) or is_lerobot(path)
                          or path.suffix in (".csv", ".txt", ".tum", *PACKED) or (path / "trials").is_dir()
                          or (path / "command.csv").exists()):
        raise ValueError(f"{path}: {about(path).removesuffix('.')}. Needed here: {needed}")


def _about_folder(path: Path) -> str:
    convert = f"Convert it first: python -m sysid.convert {in_shell(path)} --out DATASET"
    if is_bag(path):
        return f"a ROS bag. {convert}"
    if is_lerobot(path):
        return f"a LeRobotDataset. {convert}"
    if (path / "dataset.toml").exists() or (path / "trials").is_dir():
        return (f"a dataset. Look at it with python -m sysid.inspect {in_shell(path)}, fit it with python -m sysid.fit "
                f"{in_shell(path)}")
    trial = path.parent.name == "trials" or (path / TRIAL_FILES[0]).exists()
    if trial and any((path / name).exists() for name in TRIAL_FILES):
        return f"one trial, not a dataset. Give the folder that holds dataset.toml and trials/{path.name}."
    if (path / "report.json").exists() or (path / "vehicle.toml").exists():
        return "the folder of a fit. Give the folder of the dataset; python -m sysid.report shows a fit."
    if bags := find_bags(path):
        kind = "a ROS bag whose metadata.yaml is missing" if bags[0].is_file() else "a folder of ROS bags"
        return f"{kind} ({bags[0].name}). {convert}"
    entries = sorted(path.iterdir())
    if below := next((one for one in entries if one.is_dir() and find_bags(one)), None):
        return (f"has ROS bags further down ({below.name}). Convert them: python -m sysid.convert {in_shell(below)} "
                "--out DATASET")
    if below := next((one for one in entries if (one / "dataset.toml").exists()), None):
        return f"holds datasets ({below.name}). Give one of them: {below}"
    files = [one for one in entries if one.is_file() and not one.name.startswith(".")]
    if packed := next((one for one in files if one.suffix in PACKED and Path(one.stem).suffix in SUFFIXES), None):
        return ("a ROS bag whose metadata.yaml is missing, so that it is not unpacked. "
                f"{packed.name} is {_about_file(packed)}")
    if text := next((one for one in files if one.suffix in (".csv", ".txt", ".tum")), None):
        return f"a folder of text files ({text.name}), not a dataset. {convert}"
    if (path / "data").is_dir() and next((path / "data").rglob("*.parquet"), None):
        return f"a LeRobotDataset without {LEROBOT_INFO}. Copy its folder meta too."
    return ("no dataset.toml, no *.npz and no *Robot1_Odometry.dat in it. Name the folder that holds one of them; "
            "the formats are in docs/log_format.md.")


def _about_file(path: Path) -> str:
    convert = f"Convert it first: python -m sysid.convert {in_shell(path)} --out DATASET"
    if is_bag(path):
        return f"a ROS bag. {convert}"
    if path.suffix in PACKED:
        return f"a packed file. Unpack it{' (zstd -d)' if path.suffix in PACKED[:2] else ''}, then give what was in it."
    if path.name == "dataset.toml":
        return f"a file of a dataset. Give its folder: {path.parent}"
    if path.name in TRIAL_FILES and path.parent.parent.name == "trials":
        return f"one file of a trial. Give the folder of the dataset: {path.parent.parent.parent}"
    if path.suffix == ".npz" or path.name == "metadata.yaml":
        return f"one file of a recording. Give its folder: {path.parent}"
    rows = _first_rows(path)
    if rows and all(len(row) == TUM and _numbers(row) for row in rows):
        return ("a trajectory in TUM form (time, position, quaternion). Put it into one folder with a CSV of the "
                f"commands or wheel speeds, then: python -m sysid.convert {in_shell(path.parent)} --out DATASET")
    if path.suffix in (".csv", ".txt", ".tsv"):
        names = f" with the columns {', '.join(rows[0][:12])}" if rows and not _numbers(rows[0]) else ""
        return f"a text file{names}. {convert}"
    if path.suffix in ROBOT_FILES:
        return (f"a robot file. Look at it with python -m sysid.inspect {in_shell(path)}, fit it to a dataset with "
                f"python -m sysid.fit DATASET --model {in_shell(path)}")
    if path.suffix in (".sdf", ".world"):
        return "a model of Gazebo (SDF). Give the URDF or xacro file of the robot, or an MJCF file."
    return "a file of a kind that is not known. Give a dataset's folder, or a ROS bag to python -m sysid.convert."


def _first_rows(path: Path) -> list[list[str]]:
    """Fields of the first rows of a text that are neither empty nor a comment; none of a file that is no text."""
    try:
        with path.open("rb") as file:
            text = file.read(HEAD).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError):
        return []
    lines = [line.strip() for line in text.splitlines()[:20]]
    return [re.split(r"[,;\s]+", line) for line in lines if line and not line.startswith("#")][:5]


def _numbers(row: list[str]) -> bool:
    try:
        return all(float(field) is not None for field in row)
    except ValueError:
        return False
