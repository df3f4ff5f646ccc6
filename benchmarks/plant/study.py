"""How strongly each effect shows: RMS change of every channel in units of replicate spread.

    python -m benchmarks.plant.study [--reference DATASET] [--effects NAME ...] [--factor 1.0]

Each effect is driven with the disturbances of the plain chair, so that what differs is the effect alone.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from benchmarks.plant.commands import nine
from benchmarks.plant.compare import CHANNELS, drive_like, groups, read, spread
from benchmarks.plant.effects import EFFECTS
from benchmarks.plant.make import Experiment, drive_all, plan
from bridge.nodes.options import Parser, in_range
from whill_mjx.io.command_line import guarded


def table_of(
    effects: Mapping[str, float], seed: int = 0, replicates: int = 1, noise: float = 1.0,
    manoeuvres: Mapping[str, np.ndarray] | None = None,
) -> dict[str, np.ndarray]:  # fmt: skip
    """Channels (R, M, 8) of every manoeuvre, driven by the nominal chair with these effects; nothing is written."""
    setting, jobs = plan(Experiment(effects, seed, noise, False, manoeuvres or nine(seed), replicates))
    trials = {}
    for name, odometry, pose, _ in drive_all(setting, jobs):
        t = pose[:, 0]
        at = np.column_stack([t, *(np.interp(t, odometry[:, 0], column) for column in odometry.T[1:])])
        trials[name] = {"odometry": at, "ground_truth": pose}
    return groups(trials)


def change(plain: dict[str, np.ndarray], other: dict[str, np.ndarray], unit: dict[str, np.ndarray]) -> np.ndarray:
    """(manoeuvres, 8) RMS over time of what the effect changes, over the replicate spread of manoeuvre and channel."""
    return np.array([np.sqrt(((other[n] - plain[n]) ** 2).mean(axis=(0, 1))) / unit[n] for n in plain])


def main(arguments: list[str] | None = None) -> None:
    """Print the tables of the README."""
    parser = Parser(prog="python -m benchmarks.plant.study", description=__doc__)
    parser.add_argument("--reference", type=Path, help="dataset of the chair that the plain plant imitates")
    parser.add_argument("--effects", nargs="*", default=list(EFFECTS))
    parser.add_argument("--factor", type=in_range(0), default=1.0, help="of the base sizes")
    given = parser.parse_args(arguments)
    unit = spread(table_of({}, replicates=6))
    if given.reference:
        with tempfile.TemporaryDirectory() as folder:
            theirs = spread(groups(read(given.reference)))
            ours = spread(groups(read(drive_like(given.reference, Path(folder) / "plain", replicates=6))))
        print("| replicate spread |", " | ".join(CHANNELS), "|\n|---|" + "---|" * len(CHANNELS))
        for label, rows in (("this plant", ours), ("reference", theirs)):
            for kind, pool in (("RMS", lambda x: np.sqrt((x**2).mean(axis=0))), ("median", lambda x: np.median(x, 0))):
                values = pool(np.array(list(rows.values())))
                print(f"| {label}, {kind} of manoeuvres |", " | ".join(f"{value:.4f}" for value in values), "|")
        print()
    plain = table_of({})
    names = list(plain)
    print("| effect | base size | form |", " | ".join(CHANNELS), "| strongest in |\n|---|---|---|" + "---|" * 9)
    for name in given.effects:
        entry = EFFECTS[name]
        ratio = change(plain, table_of({name: given.factor * entry.base}), unit)
        worst = np.unravel_index(ratio.argmax(), ratio.shape)
        cells = " | ".join(f"{value:.1f}" for value in np.sqrt((ratio**2).mean(axis=0)))
        strongest = f"{CHANNELS[worst[1]]} of {names[worst[0]]}: {ratio.max():.0f}"
        size = f"{given.factor * entry.base:g} {entry.unit}"
        print(f"| {name} | {size} | {entry.form.replace('|', chr(92) + '|')} | {cells} | {strongest} |", flush=True)


if __name__ == "__main__":
    with guarded():
        main()
