"""Converts recordings to a driving-log dataset: `python -m sysid.convert SOURCE --out DATASET`.

SOURCE is a ROS bag (rosbag2 folder, .db3, .mcap, ROS 1 .bag), a folder of bags, or one of the published measured sets.
Bags become one trial each, or one per drive between standstills; a bag named circle_1 becomes the trial circle_1. The
dataset is docs/log_format.md's; an existing one gets the new trials added.
"""

from __future__ import annotations

from sysid import command_line
from sysid.logs.conversion import ConvertConfig, convert
from sysid.logs.log import Log


def main(config: ConvertConfig) -> Log:
    """Convert and say what was made."""
    log, notes = convert(config)
    for note in notes:
        print(note)
    print(f"{config.out}: {len(log.trials)} trials, {sum(trial.duration for trial in log.trials):.0f} s; look at it "
          f"with python -m sysid.inspect {config.out}")
    return log


def cli() -> None:
    """Command line."""
    command_line.run(ConvertConfig, main, __doc__)


if __name__ == "__main__":
    cli()
