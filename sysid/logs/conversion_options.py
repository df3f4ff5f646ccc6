"""Options of a conversion."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from whill_mjx.io.command_line import Range, With


@dataclass(frozen=True)
class ConvertConfig:
    """Options of the command."""

    source: Path
    """ROS bag, CSV or TUM file, folder of one of them, LeRobotDataset, or a measured set."""
    out: Path = Path("runs/dataset")
    """Dataset folder; made where it does not exist, else the trials are added."""
    to: Literal["dataset", "lerobot"] = "dataset"
    """What is written: a driving-log dataset, or a LeRobotDataset v3 of a driving-log dataset."""
    fps: Annotated[int | None, Range(1, 1000), With("to", ("lerobot",))] = None
    """Frames per second of a LeRobotDataset that is written; by default the rate of the measurements."""
    vehicle: str = "whill_cr"
    """Built-in vehicle whose nominal geometry is noted, or any name with --wheel-radius and --track; measured sets know
    their own."""
    wheel_radius: Annotated[float | None, Range(0.001, 2)] = None
    """Nominal wheel radius [m], where it is not the vehicle's."""
    track: Annotated[float | None, Range(0.01, 5)] = None
    """Nominal track [m], where it is not the vehicle's."""
    mass: Annotated[float | None, Range(0.01, 1e4)] = None
    """Mass [kg], where it is not the vehicle's."""
    command_topic: str | None = None
    """Twist or TwistStamped sent to the vehicle."""
    odometry_topic: str | None = None
    """The vehicle's own Odometry; '' goes without."""
    truth_topic: str | None = None
    """Outside measurement of the drive-axle centre: Odometry, PoseStamped, TransformStamped; '' goes without."""
    imu_topic: str | None = None
    """Imu with the yaw rate of the body about its z axis; '' goes without."""
    truth_ahead: Annotated[float, Range(-10, 10)] = 0.0
    """How far the tracked point lies ahead of the drive-axle centre [m]."""
    truth_left: Annotated[float, Range(-10, 10)] = 0.0
    """How far it lies to the left of it [m]."""
    truth_turned: Annotated[float, Range(-360, 360)] = 0.0
    """How far the tracked body's x axis is turned to the left of the vehicle's [deg]."""
    input: Literal["auto", "commands", "wheels"] = "auto"
    """What drives the model: commands, or measured wheel speeds (of joint states or odometry); auto takes the latter
    where no recording has commands."""
    stamp: Literal["receive", "header"] = "receive"
    """Time of receipt (one clock for all), or the header's (when measured)."""
    split: Literal["bag", "standstill"] = "bag"
    """One trial per bag, or one per drive between standstills."""
    pause: Annotated[float, Range(0, 3600), With("split", ("standstill",))] = 2.0
    """Least standstill between two drives [s]."""
    held_out: tuple[str, ...] = ()
    """Trials that are never to be fitted."""
    select: tuple[str, ...] = ()
    """Part of a measured set: RUN, GROUP or robotN."""
    columns: tuple[str, ...] = ()
    """What columns of CSV files hold, each as ROLE=[FILE/]COLUMN[:UNIT], e.g. command.v=speed_set:km/h; the rest is
    guessed."""
    command_timeout: Annotated[float | None, Range(0.01, 60)] = None
    """How long the base drives on where no command comes [s]; by default a command holds until the next."""
