"""Read a driving-log dataset in Python, and print how fast each trial drove and where the outside pose ended."""

import sys
from pathlib import Path

import numpy as np

from sysid import load_log

SHIPPED = Path(__file__).parent.parent / "sysid" / "data" / "chair"


def main() -> None:
    log = load_log(Path(sys.argv[1]) if len(sys.argv) > 1 else SHIPPED)
    for trial in log.trials:
        pose = trial.ground_truth
        end = (
            f"ended {np.hypot(pose.x[-1] - pose.x[0], pose.y[-1] - pose.y[0]):.2f} m from its start"
            if pose
            else "no outside pose"
        )
        fastest = np.abs(trial.command.v).max()
        print(f"{trial.name:<16} {trial.command.t[-1]:5.1f} s, commanded {fastest:.2f} m/s at most, {end}")


if __name__ == "__main__":
    main()
