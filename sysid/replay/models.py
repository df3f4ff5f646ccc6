"""Models of other people in place of the simulator's vehicle: what the fit needs of them, and a plain JAX function.

The fit sees a model only through a `Plant` of one instance and its parameters, numbers by name. `function_model` makes
one of a function that steps a state, `sysid.replay.mjcf.mjcf_model` of an MJCF or URDF file. Effects of the catalogue
that act on commands or on what the odometry reports may be put around either.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from sysid.errors.space import LOG_SPAN, Space
from sysid.logs.records import Trial
from sysid.replay.records import Host, Plant
from whill_mjx.effects import EFFECTS, make_effects
from whill_mjx.effects.base import apply_chain
from whill_mjx.logs.dataset import write_text
from whill_mjx.vehicle.parameters import describe, get_values, set_values
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import Body, Odometry, Parameter, VehicleParams, parameters_of

AROUND = ("command", "sensing", "outside")  # places of effects that need to know nothing of what is inside a model
Bounds = tuple[float, float, float] | tuple[float, float, float, str]
"""Initial value, lowest, highest, and, where it has one, the unit."""


@struct.dataclass
class Parameters:
    """Parameters of a model that is not a vehicle file: what `VehicleParams` is to the simulator's vehicle."""

    values: dict[str, jax.Array]  # () each, by name
    effects: tuple = ()  # effects around the model, of the places `AROUND`
    about: tuple[tuple[str, Parameter], ...] = struct.field(pytree_node=False, default=())
    """Unit, bounds and initial value (as `neutral`) of each of `values`."""
    room_fixed: bool = struct.field(pytree_node=False, default=False)
    """Whether the motion depends on where in the room it starts."""


@dataclass(frozen=True)
class Twin:
    """The vehicle of the simulator that drives as a model does."""

    spec: VehicleSpec
    params: VehicleParams
    shared: Mapping[str, tuple[str, float, float]]
    """Parameter of the model -> that of the vehicle, and the factor and offset that its value takes there."""


@dataclass(frozen=True)
class Model:
    """A model that is fitted in place of the simulator's vehicle."""

    name: str
    plant: Plant  # its functions take `Parameters`
    params: Parameters  # where the search starts
    write: Callable[[Path, Parameters], Path] | None = None
    """Writes the fitted model into a folder in its own format; returns the file."""
    notes: tuple[str, ...] = ()  # what of its file was left out or replaced
    around: tuple[str, ...] = ()  # effects that it may have around it: a fit adds those that a log shows
    vehicle: Callable[[Parameters, VehicleSpec], Twin | str] | None = None
    """The vehicle of the simulator that drives alike, or why there is none."""
    instead: Callable[[VehicleSpec], Twin] | None = None
    """The vehicle of the simulator that a fit takes in its place, of a log's spec; none where it fits the model."""
    files: tuple[Path, ...] = ()  # what it was made of: a robot's file, and modules beside a Python file

    def with_effects(self, names: Sequence[str]) -> Model:
        """The same model with effects of the catalogue around it; ValueError for those that act inside one."""
        for name in names:
            if name in EFFECTS and not acts_around(name):
                known = [one for one in EFFECTS if acts_around(one)]
                raise ValueError(f"effect {name!r} acts inside a vehicle and cannot be put around the model "
                                 f"{self.name!r}. Use one of {', '.join(known)}, or put it into the model.")
        outside = with_effects(VehicleParams(Body(), self.params.effects), names)
        return replace(self, params=replace(self.params, effects=outside.effects))


def acts_around(name: str) -> bool:
    """Whether an effect of the catalogue may be put around a model: it sees commands or readings alone."""
    return any(hasattr(EFFECTS[name], place) for place in AROUND)


def measured_effects(params: Any, spec: VehicleSpec, trials: tuple[Trial, ...], losses: bool = True,
                     receipt: bool = False) -> tuple[str, ...]:
    """Effects that a vehicle with slip has in a fit besides those of its preset; they start where they do nothing.

    On a differential drive passive wheels resist sideways, and their axle may pivot: then the driven wheels alone carry
    what a turn shifts. Bearings and motors resist with speed (`losses`). A wheel that skids is thrown by its own
    inertia, mostly its motor's. Soft springs let a vehicle nod. Readings of the odometry have an age, which shows
    against an outside pose, and so has a pose stamped at `receipt`.
    """
    if not any(effect.name == "slip_traction" for effect in params.effects):
        return ()
    rolling: tuple[str, ...] = ("suspension",)
    if spec.drive != "skid":
        loss = ("wheel_damping",) if losses else ()
        rolling = ("axle_pivot", "lateral_damping", *loss, "suspension", "wheel_inertia")
    both = any(trial.odometry is not None and trial.ground_truth is not None for trial in trials)
    if not both:
        return rolling
    return (*rolling, "sensor_delay", "pose_delay") if receipt else (*rolling, "sensor_delay")


def gyro_effects(trials: Sequence[Trial]) -> tuple[str, ...]:
    """Errors of a gyro, where trials have one: its bias, and its scale, which an outside pose shows."""
    return ("gyro_bias",) if any(trial.gyro is not None for trial in trials) else ()


def calibration_effects(params: Any, spec: VehicleSpec, trials: tuple[Trial, ...]) -> tuple[str, ...]:
    """What a usual first calibration finds, where it is known to show: sizes of the wheels, and of what measures them.

    Commands and an outside pose together show radii and track, the odometry beside them the sizes that it takes for
    them, and the pose which point it follows. Without an outside pose nothing separates them. On a skid drive wheels
    slip in every turn, and the track has no part of its own in that.
    """
    if not any(effect.name == "slip_traction" for effect in params.effects):
        return ()
    if not any(trial.ground_truth is not None for trial in trials):
        return ()
    both = any(trial.odometry is not None and trial.ground_truth is not None for trial in trials)
    sizes = ("wheel_radius_difference",) if spec.drive == "skid" else ("wheel_radius_difference", "track_width")
    return (*sizes, *(("odometry_scale",) if both else ()), "pose_mount")


UNLIMITED = {"acceleration_limit.wheel": 50.0}
"""Upper bounds where a limit no longer acts [m/s^2]: at the effect's usual bound of 5 a small robot takes 50 ms."""
ODOMETRY_ALONE, POSE_ALONE, BOTH = ("odometry_lag",), ("pose_mount",), ("sensor_delay", "odometry_scale")
"""Effects around a model that show in one stream, or against the other."""


def effects_around(model: Model, trials: tuple[Trial, ...]) -> tuple[str, ...]:
    """Those of the effects that a model may have around it that a log shows."""
    reports = any(trial.odometry is not None for trial in trials)
    seen = any(trial.ground_truth is not None for trial in trials)
    both = any(trial.odometry is not None and trial.ground_truth is not None for trial in trials)
    hidden = ((ODOMETRY_ALONE, reports), (POSE_ALONE, seen), (BOTH, both))
    left_out = {name for names, shown in hidden if not shown for name in names}
    return tuple(name for name in model.around if name not in left_out)


def calibrated(model: Model, trials: tuple[Trial, ...]) -> tuple[Model, tuple[str, ...]]:
    """A model with `effects_around` it, and names of their parameters that a fit leaves alone."""
    names = effects_around(model, trials)
    limit = make_effects(("acceleration_limit",))[0]
    if limit.name not in names or limit.name in {effect.name for effect in model.params.effects}:
        return model.with_effects(names), ()
    found = model.with_effects(names)
    others = tuple(f"{limit.name}.{field}" for field in parameters_of(limit) if field != "wheel")
    neutral = [getattr(limit, name.partition(".")[2]) for name in others]
    names, values = (*others, *UNLIMITED), jnp.asarray([*neutral, *UNLIMITED.values()])
    return replace(found, params=set_parameters(found.params, names, values)), others


def with_effects(params: Any, names: Sequence[str]) -> Any:
    """The vehicle with more effects of the catalogue, where they do nothing or next to nothing."""
    have = {effect.name for effect in params.effects}
    for name in names:
        if name not in EFFECTS:
            raise ValueError(f"no effect {name!r} (known: {', '.join(EFFECTS)}). Correct --effects.")
    params = VehicleParams(params.body, (*params.effects, *make_effects(name for name in names if name not in have)))
    about = {name: one for name, one in describe(params).items() if name.partition(".")[0] not in have | {"body"}}
    endless = [name for name, one in about.items() if not np.isfinite(one.neutral)]
    if not endless:
        return params
    return set_values(params, endless, jnp.asarray([about[name].high for name in endless], jnp.result_type(float)))


def describe_parameters(params: Any) -> dict[str, Parameter]:
    """Every parameter of a vehicle or a model by name."""
    if not isinstance(params, Parameters):
        return describe(params)
    return dict(params.about) | {name: about for name, about in describe(_outside(params)).items()
                                 if not name.startswith("body.")}


def get_parameters(params: Any, names: Sequence[str]) -> jax.Array:
    """Values (P,) of the named parameters of a vehicle or a model."""
    if not isinstance(params, Parameters):
        return get_values(params, names)
    return jnp.stack([jnp.asarray(params.values[name] if name in params.values
                                  else get_values(_outside(params), [name])[0]) for name in names])


def set_parameters(params: Any, names: Sequence[str], values: jax.Array) -> Any:
    """The same vehicle or model with the named parameters at `values` (P,)."""
    if not isinstance(params, Parameters):
        return set_values(params, names, values)
    inside = {name: values[i] for i, name in enumerate(names) if name in params.values}
    rest = [i for i, name in enumerate(names) if name not in params.values]
    outside = set_values(_outside(params), [names[i] for i in rest], [values[i] for i in rest])  # type: ignore[arg-type]
    return replace(params, values={**params.values, **inside}, effects=outside.effects)


def model_space(params: Parameters, names: Sequence[str] | None = None) -> Space:
    """Space of a model's parameters, by default all of them; logarithmic where the bounds span more than a decade."""
    about = describe_parameters(params)
    names = tuple(about) if names is None else tuple(names)
    unknown = sorted(set(names) - set(about))
    if unknown:
        raise ValueError(f"the model has no parameter {unknown[0]!r} (known: {', '.join(about)}).")
    low, high = (np.array([getattr(about[name], end) for name in names], float) for end in ("low", "high"))
    high = np.maximum(high, [UNLIMITED.get(name, -np.inf) for name in names])
    initial = np.clip(np.asarray(get_parameters(params, names), float), low, high)
    log = (low > 0) & (high > LOG_SPAN * np.maximum(low, 1e-30))
    return Space(names, low, high, initial, log, tuple((name, "not selected") for name in about if name not in names))


def make_parameters(bounds: Mapping[str, Bounds], **fields: bool) -> Parameters:
    """`Parameters` from name -> (initial, lowest, highest[, unit])."""
    about = []
    for name, (initial, low, high, *unit) in bounds.items():
        if not low <= initial <= high or not low < high:
            raise ValueError(f"parameter {name!r}: initial value {initial:g}, bounds {low:g} to {high:g}; the value "
                             "must lie within them. Give (initial, lowest, highest).")
        about.append((name, Parameter(str(unit[0]) if unit else "-", float(low), float(high), float(initial))))
    values = {name: jnp.asarray(one.neutral, jnp.result_type(float)) for name, one in about}
    return Parameters(values, (), tuple(about), **fields)


def function_model(
    step: Callable[[dict[str, jax.Array], jax.Array, jax.Array], jax.Array], parameters: Mapping[str, Bounds], *,
    dt: float, size: int = 5, name: str = "function", effects: Sequence[str] = (), room_fixed: bool = False,
) -> Model:
    """A model from a JAX function of one instance.

    The state is a vector that begins with x, y [m] and yaw [rad] of the reference point in the room, and v [m/s] and
    omega [rad/s] as wheel odometry reports them; more may follow, and is 0 at the start of a drive.

    Args:
        step: (parameters by name, state (S,), command (2,) v, omega) -> state after `dt`, made of jax.numpy.
        parameters: name -> (initial, lowest, highest) or (initial, lowest, highest, unit).
        dt: time of one step [s].
        size: S, at least 5.
        effects: of the catalogue, around it; for example command_delay.
        room_fixed: it depends on where in the room it starts, and not only on its own motion.

    Raises:
        ValueError: the step does not return a state of that size.
    """
    if size < 5:
        raise ValueError(f"model {name!r}: size is {size}; a state has at least x, y, yaw, v, omega. Give 5 or more.")
    params = make_parameters(parameters, room_fixed=room_fixed)
    float_type = jnp.result_type(float)
    given = jax.ShapeDtypeStruct((size,), float_type)
    after = jax.eval_shape(step, params.values, given, jax.ShapeDtypeStruct((2,), float_type))
    if getattr(after, "shape", None) != (size,):
        raise ValueError(f"model {name!r}: step returns {getattr(after, 'shape', type(after).__name__)} for a state of "
                         f"({size},); it must return the state after one step. Correct it, or size.")

    def place(params: Parameters, start: jax.Array) -> jax.Array:
        return jnp.zeros(size, float_type).at[:5].set(start)

    def substep(params: Parameters, state: jax.Array, command: jax.Array) -> jax.Array:
        return step(params.values, state, command).astype(float_type)

    def move(state: jax.Array, start: jax.Array) -> jax.Array:
        return state.at[:3].set(start[:3])

    plant = with_surroundings(Plant(place, substep, lambda state: state[:5], dt, move))
    return Model(name, plant, params).with_effects(effects)


@struct.dataclass
class Surrounded:
    """State of a model with what is around it."""

    inner: Any
    memory: tuple  # of the effects
    encoder: Odometry
    reading: Odometry  # the same after the effects of place `sensing`
    diverged: jax.Array  # () bool


@dataclass(frozen=True)
class _Surroundings:
    """Effects around a bare model, the pose of its odometry, and a guard against what is not finite."""

    bare: Plant
    wheel_radius: float
    track: float

    @property
    def dt(self) -> float:
        """Physics step [s]."""
        return self.bare.dt

    def place(self, params: Parameters, start: jax.Array) -> Surrounded:
        """The state at a start (5,)."""
        return self._at_rest(params, start, self.bare.place(params, start))

    def _at_rest(self, params: Parameters, start: jax.Array, inner: Any) -> Surrounded:
        zero = jnp.zeros_like(start[0])
        odometry = Odometry(zero, zero, zero, start[3], start[4], start[4])
        memory = tuple(effect.init() for effect in params.effects)
        return Surrounded(inner, memory, odometry, odometry, jnp.zeros((), bool))

    def substep(self, params: Parameters, state: Surrounded, command: jax.Array) -> Surrounded:
        """The state after one physics step."""
        memory, command = apply_chain(params.effects, state.memory, "command", command, self)
        inner = self.bare.substep(params, state.inner, command)
        return self._read(params, replace(state, memory=memory), inner, self.bare.observe(inner))

    def _read(self, params: Parameters, state: Surrounded, inner: Any, seen: jax.Array) -> Surrounded:
        healthy = jnp.isfinite(seen).all()
        inner = jax.tree.map(lambda new, old: jnp.where(healthy, new, old), inner, state.inner)
        v, omega = (jnp.where(healthy, seen[i], 0.0) for i in (3, 4))
        encoder = _integrate(state.encoder, v, omega, self.dt)
        memory, reading = apply_chain(params.effects, state.memory, "sensing", encoder, self)
        return Surrounded(inner, memory, encoder, reading, state.diverged | ~healthy)

    def observe(self, state: Surrounded) -> jax.Array:
        """(9,) as of `Plant`."""
        return _reported(state, self.bare.observe(state.inner))

    def move(self, state: Surrounded, start: jax.Array) -> Surrounded:
        """The same motion at the pose of a start (5,), with the odometry at its origin."""
        zero = jnp.zeros_like(start[0])
        encoder, reading = (one.replace(x=zero, y=zero, yaw=zero) for one in (state.encoder, state.reading))  # type: ignore[attr-defined]
        return replace(state, inner=self.bare.move(state.inner, start), encoder=encoder, reading=reading)

    def commands(self, params: Parameters, command: jax.Array) -> jax.Array:
        """Commands (S, 2) after the effects on them."""
        def after(memory: Any, one: jax.Array) -> tuple[Any, jax.Array]:
            return apply_chain(params.effects, memory, "command", one, self)

        if not any(hasattr(effect, "command") for effect in params.effects):
            return command
        return jax.lax.scan(after, tuple(effect.init() for effect in params.effects), command)[1]

    def recorded(self) -> Plant:
        """Plant of what the host has stepped: a state is what it saw last, a command (6,) what it sees next."""
        def place(params: Parameters, start: jax.Array) -> Surrounded:
            return self._at_rest(params, start, start)

        def take(params: Parameters, state: Surrounded, seen: jax.Array) -> Surrounded:
            after = self._read(params, state, seen[:5], seen[:5])
            return replace(after, diverged=after.diverged | (seen[5] > 0.5))

        return Plant(place, take, lambda state: _reported(state, state.inner), self.dt, self.move)


def with_surroundings(
    bare: Plant, wheel_radius: float = 0.1, track: float = 0.5, drive: Callable[..., np.ndarray] | None = None
) -> Plant:
    """Plant of a bare model: adds the odometry's pose, the effects around it and a guard against what is not finite.

    Args:
        bare: observes (5,) x, y, yaw of the body, v and omega of the odometry.
        wheel_radius, track: nominal [m]; for effects that count in steps of wheels.
        drive: as in `Host`, where the host steps it more quickly.
    """
    around = _Surroundings(bare, wheel_radius, track)
    host = None if drive is None else Host(bare.place, around.commands, drive, around.recorded())
    return Plant(around.place, around.substep, around.observe, bare.dt, around.move, host=host)


def save_model(
    folder: Path, model: Model, params: Parameters, intervals: Mapping[str, tuple[float, float]],
    provenance: Mapping[str, Any],
) -> Path:
    """Write model.toml (value, unit and, where known, interval of each parameter), and the model in its own format."""
    import tomlkit

    names = list(describe_parameters(params))
    values = np.asarray(get_parameters(params, names), float)
    table = {name: {"value": float(value), "unit": about.unit,
                    **({"interval": [float(end) for end in intervals[name]]} if name in intervals else {})}
             for (name, about), value in zip(describe_parameters(params).items(), values, strict=True)}
    path = Path(folder) / "model.toml"
    write_text(path, tomlkit.dumps({"schema": 1, "kind": "micromobility-model", "model": model.name,
                                    "parameters": table, "provenance": dict(provenance)}))
    if model.write is not None:
        model.write(Path(folder), params)
    return path


def _reported(state: Surrounded, seen: jax.Array) -> jax.Array:
    """(9,) as of `Plant`, of a state and what its bare model observes."""
    reading, pose = state.reading, seen[:3]
    reported = jnp.stack([reading.x, reading.y, reading.yaw, reading.v, reading.omega])
    return jnp.concatenate([pose, reported, state.diverged.astype(pose.dtype)[None]])


def _outside(params: Parameters) -> VehicleParams:
    return VehicleParams(Body(), params.effects)


def _integrate(before: Odometry, v: jax.Array, omega: jax.Array, dt: float) -> Odometry:
    """Odometry one step on, with the mean of old and new speeds."""
    speed, turn = (before.v + v) / 2, (before.omega + omega) / 2 * dt
    middle = before.yaw + turn / 2
    return Odometry(before.x + speed * jnp.cos(middle) * dt, before.y + speed * jnp.sin(middle) * dt,
                    before.yaw + turn, v, omega, omega)
