r"""Drive manoeuvres with a simulated vehicle and write them as a driving-log dataset.

    python -m whill_mjx.drive --manoeuvre figure_eight --vehicle whill_cr_physical \
        --effects command_delay:delay=0.2 yaw_scrub:torque=6 --replicates 3 --noise --out DATASET

An effect is NAME, or NAME:PARAMETER=VALUE,...: a vehicle that has the effect gets the values given; any other gets the
effect added, with those values and the rest neutral, or, where no value is given, the upper usual value of each.
docs/effects.md lists them. The measurements have rates, latencies and noise; --sensors.imu-rate 104 and
--sensors.encoder-rate 50 add the chair's gyro and wheel encoders. DATASET/vehicle.toml is the vehicle that was driven:
the planted truth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from whill_mjx.io.command_line import SEED, OptionError, Range, With, check_once, listen, refusing, run, starts
from whill_mjx.io.heartbeat import Heartbeat, say_loading

if starts(__name__):
    listen()
    say_loading()

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.effects import EFFECTS, make_effect
from whill_mjx.io.fields import counted, in_shell
from whill_mjx.io.folders import check_place, new_folder
from whill_mjx.logs.dataset import (
    COMMAND_HEADER,
    Noise,
    write_csv,
    write_encoder,
    write_fields,
    write_ground_truth,
    write_imu,
    write_odometry,
)
from whill_mjx.logs.manoeuvres import MANOEUVRES, Scenario, command_table
from whill_mjx.logs.simulated_sensors import SensorNoise, Sensors, seen, times
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.dynamics import place, substep
from whill_mjx.vehicle.kinematics import reference_pose
from whill_mjx.vehicle.model import build_model
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import VehicleParams, VehicleState, parameters_of
from whill_mjx.vehicle.vehicle_file import load_vehicle, save_vehicle

MEASUREMENT_DT = 0.05  # s


@dataclass(frozen=True)
class DriveOptions:
    """Options of the command."""

    out: Path
    """Dataset folder to write; it must not exist."""
    manoeuvre: tuple[str, ...] = ("figure_eight",)
    """Of straight, turn, circle, s_curve, figure_eight, reversal, slow_sine, random_steps and standstill; or `all`."""
    vehicle: str = "whill_cr_physical"
    """Built-in vehicle (docs/howto/vehicle.md lists them), or a vehicle file."""
    effects: tuple[str, ...] = ()
    """Effects to add to the vehicle, or to change: NAME or NAME:PARAMETER=VALUE,..."""
    replicates: Annotated[int, Range(1, 10_000)] = 1
    """Drives of each manoeuvre: the same commands from another pose, with other noise."""
    noise: bool = False
    """Add white noise to the measurements."""
    noise_levels: Annotated[SensorNoise, With("noise")] = field(default_factory=SensorNoise)
    """How much, with --noise."""
    sensors: Sensors = field(default_factory=Sensors)
    """Rates and latencies of the measurements."""
    held_out: tuple[str, ...] = ()
    """Manoeuvres that the dataset declares as never to be fitted."""
    seed: Annotated[int, SEED] = 0
    """Random seed of start poses and noise."""
    scenario: Scenario = field(default_factory=Scenario)
    """How hard the manoeuvres are driven."""


def main(options: DriveOptions, stage: Callable[[str], None] = lambda text: None) -> Path:
    """Drive and write the dataset; returns its folder.

    Args:
        stage: gets a line when the driving begins.

    Raises:
        ValueError, FileNotFoundError: naming the option, its value, the rule and the remedy.
    """
    names = tuple(MANOEUVRES) if options.manoeuvre == ("all",) else options.manoeuvre
    with refusing():
        commands = [command_table(name, options.scenario) for name in names]
        _check(options, names)
        spec, params, _ = load_vehicle(options.vehicle)
        params = with_effects(params, options.effects)
    stage("compiling the vehicle, and driving")
    random = np.random.default_rng(options.seed)
    trials = [
        (f"{name}_{replicate}", command, (*random.uniform(-1.0, 1.0, 2), random.uniform(-np.pi, np.pi)))
        for name, command in zip(names, commands, strict=True)
        for replicate in range(1, options.replicates + 1)
    ]
    motions, diverged = record_motion(spec, params, [trial[1] for trial in trials], [trial[2] for trial in trials])
    if diverged.any():
        lost = ", ".join(name for (name, _, _), bad in zip(trials, diverged, strict=True) if bad)
        raise ValueError(
            f"vehicle {options.vehicle!r} with effects {' '.join(options.effects) or 'none'}: the motion became "
            f"non-finite in {lost}. Bring the effects' values closer to those in docs/effects.md."
        )
    with new_folder(options.out) as partial:
        noise = Noise(options.noise_levels if options.noise else None, random)
        for index, (name, command, _) in enumerate(trials):
            motion = {sensor: motions[sensor][index] for sensor in motions}
            write_streams(partial / "trials" / name, command, motion, options.sensors, noise)
        write_fields(partial, spec, [name for name, _, _ in trials if name.rsplit("_", 1)[0] in options.held_out])
        truth = {"vehicle": options.vehicle, "effects": " ".join(options.effects), "seed": options.seed}
        save_vehicle(partial / "vehicle.toml", spec, params, provenance=truth)
    return options.out


def with_effects(params: VehicleParams, texts: Sequence[str]) -> VehicleParams:
    """The vehicle with effects given as NAME or NAME:PARAMETER=VALUE,...

    An effect that the vehicle has keeps its place and the values that are not given; others are appended, so that
    those of place `actuation` act behind the drive.
    """
    effects = list(params.effects)
    for text in texts:
        name, values = parse_effect(text)
        new = make_effect(name, **(values or {key: high for key, (_, high) in EFFECTS[name].typical.items()}))
        index = next((i for i, effect in enumerate(effects) if effect.name == name), None)
        if index is None:
            effects.append(new)
        else:
            effects[index] = replace(effects[index], **{key: getattr(new, key) for key in values})
    return replace(params, effects=tuple(effects))


def parse_effect(text: str) -> tuple[str, dict[str, float]]:
    """Name and values of "NAME:PARAMETER=VALUE,..."; ValueError names what is wrong and what is known."""
    name, colon, rest = text.partition(":")
    if colon and not rest:
        raise ValueError(f"effect {text!r}: no parameter follows the colon. Write it like command_delay:delay=0.2.")
    values: dict[str, float] = {}
    for pair in filter(None, rest.split(",")):
        key, equals, number = pair.partition("=")
        if key in values:
            raise ValueError(f"effect {text!r}: {key} is given twice. Leave one out.")
        try:
            values[key] = float(number)
        except ValueError:
            raise ValueError(
                f"effect {text!r}: {pair!r} is not PARAMETER=NUMBER{'' if equals else ' (no =)'}. "
                "Write it like command_delay:delay=0.2."
            ) from None
    make_effect(name, **dict.fromkeys(values, 0.0))  # unknown names
    for key, value in values.items():
        about = parameters_of(EFFECTS[name])[key]
        if not (about.low <= value <= about.high or value == about.neutral):
            raise ValueError(
                f"effect {text!r}: {key} is {value:g} {about.unit}; it must lie within {about.low:g} to "
                f"{about.high:g}, or be {about.neutral:g} for no effect. Check the unit."
            )
    return name, values


def write_streams(
    folder: Path, command: np.ndarray, motion: dict[str, np.ndarray], sensors: Sensors, noise: Noise
) -> None:
    """Write the streams of one trial: its commands, and what each sensor reports of the motion (T, C) it sees."""
    write_csv(folder / "command.csv", COMMAND_HEADER, command)
    duration, dt = float(command[-1, 0]), VehicleConfig().physics_dt

    def sampled(sensor: str) -> tuple[np.ndarray, np.ndarray]:
        t = times(duration, getattr(sensors, f"{sensor}_rate"))
        return t, seen(t, getattr(sensors, f"{sensor}_latency"), dt, motion[sensor])

    if sensors.ground_truth_rate:
        write_ground_truth(folder, *sampled("ground_truth"), noise)
    if sensors.odometry_rate:
        write_odometry(folder, *sampled("odometry"), noise)
    if sensors.imu_rate:
        write_imu(folder, *sampled("imu"), noise)
    if sensors.encoder_rate:
        t, angles = sampled("encoder")
        write_encoder(folder, t, sensors.encoder_latency, angles, noise)


def record(
    spec: VehicleSpec, params: VehicleParams, commands: Sequence[np.ndarray], starts: Sequence[Sequence[float]]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Drive B command tables (T, 3) from B starts (x [m], y [m], yaw [rad]) at rest, all in one compiled call.

    Returns:
        Every MEASUREMENT_DT from t = 0 on, to the end of the longest: poses (B, M, 3) of the reference point, odometry
        (B, M, 5); and (B,) bool where the motion became non-finite.
    """
    motion, diverged = record_motion(spec, params, commands, starts)
    stride = round(MEASUREMENT_DT / VehicleConfig().physics_dt)
    return motion["ground_truth"][:, ::stride], motion["odometry"][:, ::stride], diverged


def record_motion(
    spec: VehicleSpec, params: VehicleParams, commands: Sequence[np.ndarray], starts: Sequence[Sequence[float]]
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Drive B command tables (T, 3) from B starts (x [m], y [m], yaw [rad]) at rest, all in one compiled call.

    Returns:
        What each sensor sees at every physics step from t = 0 to the end of the longest: "ground_truth" (B, T, 3)
        pose of the reference point, yaw unwrapped; "odometry" (B, T, 5); "imu" (B, T, 1) gyro [rad/s]; "encoder"
        (B, T, 2) angles of the driven wheels [rad]; and (B,) bool where the motion became non-finite.
    """
    config = VehicleConfig()
    model = build_model(spec, config)
    stride = round(MEASUREMENT_DT / config.physics_dt)
    duration = max(float(command[-1, 0]) for command in commands)
    t = (np.arange(math.ceil(duration / MEASUREMENT_DT) * stride) + 0.5) * config.physics_dt
    held = [command[np.searchsorted(command[:, 0], t, side="right") - 1, 1:] for command in commands]

    def observe(state: VehicleState) -> dict[str, jax.Array]:
        odometry = state.odometry
        reported = (odometry.x, odometry.y, odometry.yaw, odometry.v, odometry.omega)
        return {
            "ground_truth": jnp.stack(reference_pose(model, state.qpos)),
            "odometry": jnp.stack(reported),
            "imu": jnp.stack([jnp.asarray(odometry.gyro)]),
            "encoder": state.qpos[7:9],
        }

    def one(command: jax.Array, start: jax.Array) -> tuple[dict[str, jax.Array], jax.Array]:
        def physics(state: VehicleState, command: jax.Array) -> tuple[VehicleState, dict[str, jax.Array]]:
            state = substep(model, params, state, command)
            return state, observe(state)

        first = place(model, params, *start)
        last, rest = jax.lax.scan(physics, first, command)
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), observe(first), rest), last.diverged

    dtype = jnp.result_type(float)
    driven, begun = jnp.asarray(np.stack(held), dtype), jnp.asarray(np.asarray(starts), dtype)
    motion, diverged = jax.jit(jax.vmap(one))(driven, begun)
    motion = {sensor: np.array(table, float) for sensor, table in motion.items()}
    motion["ground_truth"][:, :, 2] = np.unwrap(motion["ground_truth"][:, :, 2], axis=1)
    return motion, np.asarray(diverged)


def _check(options: DriveOptions, names: tuple[str, ...]) -> None:
    if not names:
        raise OptionError("--manoeuvre: none is given. Name one, or leave the option out for figure_eight.")
    if len(set(names)) != len(names):
        raise ValueError(f"--manoeuvre {' '.join(names)}: one is given twice. Repeat a drive with --replicates.")
    check_once("--effects", [text.partition(":")[0] for text in options.effects])
    if options.replicates < 1:
        raise ValueError(f"--replicates {options.replicates}: must be at least 1. Leave it out for a single drive.")
    absent = sorted(set(options.held_out) - set(names))
    if absent:
        raise ValueError(f"--held-out {absent[0]}: not among the manoeuvres driven ({', '.join(names)}). Add it there.")
    if options.out.exists():
        raise OptionError(f"--out {options.out}: exists already; a drive never replaces another. Choose a new folder.")
    check_place("--out", options.out)


def drive_and_say(options: DriveOptions) -> None:
    """Drive, and say what to do with the dataset."""
    with Heartbeat() as heartbeat:
        folder = main(options, heartbeat.stage)
    count = len(list((folder / "trials").iterdir()))
    print(f"{folder}: {counted(count, 'trial')}; fit it with python -m sysid.fit {in_shell(folder)} --out RUN")


def cli() -> None:
    """Command line."""
    run(DriveOptions, drive_and_say, __doc__, positional=False)


if __name__ == "__main__":
    cli()
