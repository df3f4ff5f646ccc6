"""What every sensor shares: a measurement, and the way it takes to whoever reads it.

A sensor is a frozen record with one function, `measure`, of one instance. Rate, latency, jitter, dropout and noise are
the same for all and work inside the compiled step. A sensor of your own is one file in any package; pass it to
`make_env(observations={"name": sensor})`, or return it from the `observations` of a task.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from whill_mjx.io.fields import Field, check_fields
from whill_mjx.io.own_class import check_fixed, check_own_class
from whill_mjx.tasks.terms import Moment

FIELDS = (
    Field("rate_hz", "1/s", 1e-3, 1e6, exceptions=(math.inf,)),
    Field("latency_s", "s", 0.0, 100.0),
    Field("jitter_s", "s", 0.0, 100.0),
    Field("dropout", "-", 0.0, 1.0),
    Field("noise", "-", 0.0, 1e6),
)
IMAGE = tuple(Field(name, "pixels", 1, 4096, kind="whole", needed=False) for name in ("height", "width"))
"""Sizes of an image; None takes those of the environment."""
ALONG = 1e-3
"""A sensor that is off the vehicle's middle by less than so much [m, rad] is on it."""
SCAN = (
    Field("rays", kind="whole", low=1, high=10**5),
    Field("fov", "rad", 1e-3, 6.2832),
    Field("reach", "m", 0.01, 1e4),
    *(Field(name, "m", -100.0, 100.0) for name in ("x", "y", "z")),
    Field("nearest", "m", 0.0, 1e4),
    Field("dropouts", "-", 0.0, 1.0),
    Field("period", "s", 0.0, 10.0),
)
"""What laser scanners share."""
LARGEST = 10**8
"""Numbers that one measurement may have."""
SLACK = 1e-4
"""Rounding of times in float32 [s]."""


@dataclass(frozen=True)
class Reading:
    """Shape, type and bounds of what a sensor gives."""

    shape: tuple[int, ...]
    low: float = -math.inf
    high: float = math.inf
    dtype: Any = np.float32


@dataclass(frozen=True)
class View:
    """What a sensor may look at: one instance at one time. Made while tracing; its arrays have no instance axis."""

    env: Any
    """The `Env`: vehicle model, task, image size."""
    params: Any
    """`VehicleParams` of this instance."""
    state: Any
    """The `State` of this instance."""
    moment: Moment
    """Pose, speeds, footprint, goal and scene."""


@dataclass(frozen=True)
class Sensor:
    """A sensor without delay or noise. Hashable: a static part of the environment."""

    name: ClassVar[str] = ""
    """By which `make_env(observations=...)` finds a sensor of this package."""
    visual: ClassVar[bool] = False
    """Whether it looks through the vehicle's camera, which evaluations move."""
    ranges: ClassVar[tuple[Field, ...]] = ()
    """Range of each field of its own."""
    noisy: ClassVar[bool] = False
    """Whether `measure` has put the noise into its value itself."""
    mirrored: ClassVar[Callable[..., jax.Array] | None] = None
    """(value (..., *shape)) -> value in the world mirrored left to right; None: learners do not mirror."""

    _: KW_ONLY
    rate_hz: float = math.inf
    """Measurements per second; between two the last one is shown. inf measures at every step."""
    latency_s: float = 0.0
    """Age at which a measurement arrives [s]."""
    jitter_s: float = 0.0
    """Largest deviation of the latency, uniform [s]. What arrives after a newer one is discarded."""
    dropout: float = 0.0
    """Share of the measurements that never arrive."""
    noise: float = 0.0
    """Standard deviation of normal noise, in units of the measurement."""

    def __post_init__(self) -> None:
        check_fields(f"sensor {type(self).__name__}", (*FIELDS, *self.ranges), self)

    def reading(self, env: Any) -> Reading:
        """Shape, type and bounds in an environment."""
        raise NotImplementedError(f"{type(self).__name__}.reading is missing; return a Reading.")

    def begin(self, view: View) -> Any:
        """The sensor's own memory at the start of an episode; none by default."""
        return ()

    def measure(self, memory: Any, view: View, key: jax.Array) -> tuple[Any, jax.Array]:
        """Memory, and what is measured now; without noise, unless the sensor is `noisy`."""
        raise NotImplementedError(f"{type(self).__name__}.measure is missing; return (memory, value).")

    @property
    def direct(self) -> bool:
        """Whether everything measured is shown at once."""
        return math.isinf(self.rate_hz) and not (self.latency_s or self.jitter_s or self.dropout)


@struct.dataclass
class Line:
    """Measurements on their way."""

    past: jax.Array  # (L, ...) the last measurements
    taken: jax.Array  # (L,) s since the start; -inf where there is none yet
    arrives: jax.Array  # (L,) s; inf where it is lost
    count: jax.Array  # () int32 measurements so far
    shown: jax.Array  # (...) what the reader has
    shown_at: jax.Array  # () s, when that was measured


Sensors = tuple[tuple[str, Sensor], ...]


def begin_sensors(sensors: Sensors, view: View) -> tuple:
    """Memory of all sensors at the start of an episode."""
    return tuple((sensor.begin(view), None if sensor.direct else _first_line(sensor, view)) for _, sensor in sensors)


def read_sensors(
    sensors: Sensors, memory: tuple, view: View, seen: View, key: jax.Array
) -> tuple[tuple, dict[str, jax.Array]]:
    """Memory, and what each sensor shows now, by name; `seen` is what the visual ones look at."""
    after, obs = [], {}
    for index, (name, sensor) in enumerate(sensors):
        own, line = memory[index]
        measure_key, noise_key, way_key = jax.random.split(jax.random.fold_in(key, index), 3)
        own, value = sensor.measure(own, seen if sensor.visual else view, measure_key)
        value = _finished(sensor, sensor.reading(view.env), value, noise_key)
        if line is not None:
            line, value = _deliver(sensor, line, view.moment.time_s, value, way_key)
        after.append((own, line))
        obs[name] = value
    return tuple(after), obs


def check_sensor(name: str, sensor: Sensor, view: Callable[[Any], View], state: Any) -> None:
    """Trace what a sensor does; ValueError, in one line, where it fails or gives something else than it says.

    Args:
        name: of the observation.
        sensor: of a user's own.
        view: (state) -> what the sensor may look at.
        state: shapes of a state.
    """
    check_own_class(f"sensor {name!r}", type(sensor), Sensor)
    try:
        jax.eval_shape(lambda state, seed: _tried(sensor, view(state), jax.random.key(seed)), state, 0)
    except (Exception, SystemExit) as error:
        said = str(error).strip().split("\n")[0].rstrip(".")
        raise ValueError(f"sensor {name!r}, {type(sensor).__name__}: {type(error).__name__}: {said}. Correct the "
                         "sensor.") from error


def _tried(sensor: Sensor, view: View, key: jax.Array) -> jax.Array:
    """A first measurement; raises TypeError or ValueError where something does not fit."""
    reading = sensor.reading(view.env)
    if not isinstance(reading, Reading):
        raise TypeError(f"reading returns {type(reading).__name__}; it must be a Reading")
    sizes = isinstance(reading.shape, tuple) and all(isinstance(one, int) and one >= 0 for one in reading.shape)
    if not sizes or math.prod(reading.shape) > LARGEST:
        raise ValueError(f"its reading has shape {reading.shape!r}; at most {LARGEST} numbers are taken")
    if np.dtype(reading.dtype).kind not in "biuf" or not np.all(np.asarray(reading.low) <= np.asarray(reading.high)):
        raise ValueError(f"its reading has type {reading.dtype!r} and bounds {reading.low!r} to {reading.high!r}; it "
                         "needs numbers, the lower bound first")
    before = sensor.begin(view)
    found = sensor.measure(before, view, key)
    if not isinstance(found, tuple) or len(found) != 2:
        raise TypeError(f"measure returns {type(found).__name__}; it must be the pair (memory, value)")
    first, then = (jax.tree.map(lambda leaf: jax.typeof(jnp.asarray(leaf)), memory) for memory in (before, found[0]))
    if first != then:
        raise TypeError(f"measure returns the memory {then}, begin {first}; both must be alike")
    return _finished(sensor, reading, found[1], key)


def _finished(sensor: Sensor, reading: Reading, value: jax.Array, key: jax.Array) -> jax.Array:
    """A measurement with its noise, in the type and within the bounds of the reading."""
    value = jnp.asarray(value)
    if value.shape != reading.shape:
        raise ValueError(f"{type(sensor).__name__}: measured {value.shape}, but its reading says {reading.shape}. "
                         "Both must agree.")
    if not sensor.noise or sensor.noisy:
        return _bounded(value, reading) if _of_a_user(sensor) else value.astype(reading.dtype)
    value = value.astype(jnp.float32) + sensor.noise * jax.random.normal(key, value.shape)
    if np.dtype(reading.dtype).kind in "biu":
        value = jnp.round(value)
    return _bounded(value, reading)


def _bounded(value: jax.Array, reading: Reading) -> jax.Array:
    """A value within the bounds of its reading, in its type: a number beyond those of a type would begin anew."""
    low, high = reading.low, reading.high
    if np.issubdtype(reading.dtype, np.integer):
        least = np.iinfo(reading.dtype)
        low, high = np.maximum(low, least.min), np.minimum(high, least.max)
    if value.dtype == reading.dtype and not np.isfinite([low, high]).any():
        return value
    return jnp.clip(value, low, high).astype(reading.dtype)


def without_nan(sensors: Sensors, obs: dict[str, jax.Array]) -> tuple[dict[str, jax.Array], jax.Array]:
    """Observations with 0 for what sensors of a user's own give as no finite number, and whether there was any ().

    It would stay in a learner for good. The sensors of this package give none.
    """
    found, odd = dict(obs), jnp.zeros((), bool)
    for name, sensor in sensors:
        if _of_a_user(sensor) and jnp.issubdtype(obs[name].dtype, jnp.floating):
            finite = jnp.isfinite(obs[name])
            found[name], odd = jnp.where(finite, obs[name], 0.0), odd | ~finite.all()
    return found, odd


def _of_a_user(sensor: Sensor) -> bool:
    return not type(sensor).__module__.startswith("whill_mjx.")


def _first_line(sensor: Sensor, view: View) -> Line:
    reading = sensor.reading(view.env)
    period = max(view.env.model.config.control_dt, 1.0 / sensor.rate_hz)
    length = math.ceil((sensor.latency_s + sensor.jitter_s) / period) + 1
    zero = jnp.zeros(reading.shape, reading.dtype)
    never = jnp.full(length, -jnp.inf)
    return Line(
        jnp.zeros((length, *reading.shape), reading.dtype), never, -never, jnp.zeros((), jnp.int32), zero,
        jnp.array(-jnp.inf),
    )  # fmt: skip


def _deliver(sensor: Sensor, line: Line, now: jax.Array, value: jax.Array, key: jax.Array) -> tuple[Line, jax.Array]:
    """What has arrived by `now` (), the newest of it; the first measurement of an episode is there at once."""
    first = line.count == 0
    lost_key, late_key = jax.random.split(key)
    late = sensor.latency_s + sensor.jitter_s * jax.random.uniform(late_key, minval=-1.0)
    lost = jax.random.uniform(lost_key) < sensor.dropout
    last = jnp.max(line.taken)
    due = first | (math.isinf(sensor.rate_hz) or _ticks(sensor, now) > _ticks(sensor, last))
    slots = jnp.arange(line.taken.shape[0])
    here = due & (slots == line.count % slots.size)

    def put(row: jax.Array, new: jax.Array) -> jax.Array:  # no scatter, which runs instance by instance on a processor
        return jnp.where(here.reshape(-1, *[1] * (row.ndim - 1)), new, row)

    past, taken = put(line.past, value), put(line.taken, now)
    arrives = put(line.arrives, jnp.where(lost, jnp.inf, now + jnp.maximum(late, 0.0)))
    ready = (arrives <= now + SLACK) & (taken > line.shown_at)
    newest = jnp.argmax(jnp.where(ready, taken, -jnp.inf))
    arrived = jnp.any(ready)
    shown = jnp.where(first, value, jnp.where(arrived, past[newest], line.shown))
    shown_at = jnp.where(first, now, jnp.where(arrived, taken[newest], line.shown_at))
    return Line(past, taken, arrives, line.count + due, shown, shown_at), shown


def _ticks(sensor: Sensor, time: jax.Array) -> jax.Array:
    return jnp.floor((time + SLACK) * sensor.rate_hz)


def as_sensors(observations: Any, known: Mapping[str, type[Sensor]]) -> Sensors:
    """Sensors by name from a mapping of names to sensors, or from names of this package's sensors.

    Raises:
        ValueError: an unknown name, no sensor, a sensor with a list or an array in it, or a name twice.
    """
    if isinstance(observations, str):
        observations = (observations,)
    pairs = list(observations.items()) if isinstance(observations, Mapping) else [(name, None) for name in observations]
    found = []
    for name, sensor in pairs:
        if sensor is None:
            if name not in known:
                raise ValueError(f"unknown sensor {name!r} (known: {', '.join(sorted(known))}). Correct the name, or "
                                 "give one of your own as {name: sensor}.")
            sensor = known[name]()
        if isinstance(sensor, type) or not dataclasses.is_dataclass(sensor) or not isinstance(sensor, Sensor):
            raise ValueError(f"observation {name!r} is {sensor!r}, no sensor. Give an instance of a frozen dataclass "
                             "that derives from whill_mjx.sensors.base.Sensor.")
        check_fixed(f"observation {name!r}, {type(sensor).__name__}", sensor)
        if not str(name):
            raise ValueError(f"observation {name!r}, {type(sensor).__name__}: has an empty name. Give it one.")
        found.append((str(name), sensor))
    if len({name for name, _ in found}) < len(found):
        raise ValueError(f"observations {[name for name, _ in found]}: a name is there twice. Rename one.")
    return tuple(sorted(found, key=lambda pair: pair[0]))
