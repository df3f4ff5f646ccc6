"""Compares the plain plant with a reference dataset: same commands, replicate spread per channel, curves overlaid.

    python -m benchmarks.plant.compare --reference DATASET --out PICTURE.png
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from benchmarks.plant.make import Experiment, make_log
from bridge.nodes.options import Parser, whole
from whill_mjx.io.command_line import guarded

CHANNELS = ("v", "omega", "yaw", "x", "y", "pose_yaw", "pose_x", "pose_y")


def read(dataset: Path) -> dict[str, dict[str, np.ndarray]]:
    """Streams of every trial, by trial and stream."""
    return {
        trial.name: {file.stem: np.loadtxt(file, delimiter=",", skiprows=1, ndmin=2) for file in trial.glob("*.csv")}
        for trial in sorted((dataset / "trials").iterdir())
    }


def channels(trial: dict[str, np.ndarray]) -> np.ndarray:
    """(M, 8) CHANNELS of one trial: odometry, and outside pose seen from the pose of the first 0.7 s."""
    odometry, pose = trial["odometry"], trial["ground_truth"]
    yaw = np.unwrap(pose[:, 3])
    origin, heading = pose[:15, 1:3].mean(axis=0), float(yaw[:15].mean())
    cos, sin = np.cos(heading), np.sin(heading)
    moved = pose[:, 1:3] - origin
    local = [yaw - heading, cos * moved[:, 0] + sin * moved[:, 1], cos * moved[:, 1] - sin * moved[:, 0]]
    count = min(len(odometry), len(pose))
    return np.column_stack([odometry[:count, [4, 5, 3, 1, 2]], *(column[:count] for column in local)])


def groups(trials: dict[str, dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """(R, M, 8) channels of all replicates, by manoeuvre."""
    names: dict[str, list[np.ndarray]] = {}
    for name, trial in trials.items():
        names.setdefault(name.rsplit("_", 1)[0], []).append(channels(trial))
    return {name: np.stack(rows) for name, rows in names.items()}


def spread(groups_of: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """(8,) RMS over time of the replicates' standard deviation, by manoeuvre."""
    return {name: np.sqrt(rows.var(axis=0, ddof=1).mean(axis=0)) for name, rows in groups_of.items()}


def drive_like(reference: Path, out: Path, seed: int = 1, replicates: int = 3) -> Path:
    """Drive the commands of a reference dataset with the nominal chair."""
    tables = {
        folder.name[:-2]: np.loadtxt(folder / "command.csv", delimiter=",", skiprows=1)
        for folder in sorted((reference / "trials").glob("*_1"))
    }
    return make_log(out, Experiment(seed=seed, day=False, manoeuvres=tables, replicates=replicates))


def plot(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray], out: Path) -> None:
    """Speed, yaw rate, differences of the replicate means, and path, one row per manoeuvre."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(len(ours), 4, figsize=(22, 3.2 * len(ours)))
    for row, name in zip(axes, ours, strict=True):
        for rows, color, label in ((theirs[name], "C1", "reference"), (ours[name], "C0", "this plant")):
            t = 0.05 * np.arange(rows.shape[1])
            for replicate in rows:
                row[0].plot(t, replicate[:, 0], color, lw=0.6)
                row[1].plot(t, replicate[:, 1], color, lw=0.6)
                row[3].plot(replicate[:, 6], replicate[:, 7], color, lw=0.8, label=label)
        difference = ours[name].mean(axis=0) - theirs[name].mean(axis=0)
        row[2].plot(t, difference[:, 0], label="v [m/s]")
        row[2].plot(t, difference[:, 1], label="omega [rad/s]")
        row[2].plot(t, difference[:, 5], label="yaw [rad]")
        row[2].legend(loc="upper right")
        row[0].set_ylabel(f"{name}: v [m/s]")
        row[1].set_ylabel("omega [rad/s]")
        row[2].set_ylabel("this plant less reference")
        row[3].set_ylabel("y [m]")
    handles, labels = axes[0, 3].get_legend_handles_labels()
    axes[0, 3].legend([handles[0], handles[-1]], [labels[0], labels[-1]])
    figure.tight_layout()
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=50)


def main(arguments: list[str] | None = None) -> None:
    """Print both spreads per channel and write the picture."""
    parser = Parser(prog="python -m benchmarks.plant.compare", description=__doc__)
    parser.add_argument("--reference", type=Path, required=True)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--seed", type=whole(0), default=1)
    given = parser.parse_args(arguments)
    theirs = groups(read(given.reference))
    with tempfile.TemporaryDirectory() as folder:
        ours = groups(read(drive_like(given.reference, Path(folder) / "plain", given.seed)))
    ours = {name: ours[name] for name in theirs}
    print("replicate spread, this plant / reference:", *CHANNELS)
    for name, reference in spread(theirs).items():
        own = spread(ours)[name]
        pairs = "  ".join(f"{a:.4f}/{b:.4f}" for a, b in zip(own, reference, strict=True))
        error = np.sqrt(((ours[name].mean(axis=0) - theirs[name].mean(axis=0)) ** 2).mean(axis=0))
        print(f"{name:13}", pairs, "  mean differs by", " ".join(f"{value:.4f}" for value in error))
    total = [np.sqrt(np.mean([values**2 for values in spread(rows).values()], axis=0)) for rows in (ours, theirs)]
    print(f"{'all':13}", "  ".join(f"{a:.4f}/{b:.4f}" for a, b in zip(*total, strict=True)))
    if given.out:
        plot(ours, theirs, given.out)


if __name__ == "__main__":
    with guarded():
        main()
