"""The contracts of the two kinds of exported policies: what `policy.json` says, and the rule of each of its fields."""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from bridge.policy.fields import Fields, is_integer, is_number, is_within
from bridge.policy.parts import EXPORT_AGAIN, MAX_FILES, MIB, PolicyFileError, show
from bridge.policy.sensors import SensorInput, parse_camera, parse_sensors

SCHEMA = 1
KIND = "micromobility-policy"
"""A policy of a vehicle: an image to a command with units."""
AGENT_KIND = "dreamer-onnx-policy"
"""A policy of any observations and actions, without units and rates."""
DTYPES = {"tensor(float)": "float32", "tensor(double)": "float64", "tensor(float16)": "float16",
          "tensor(int32)": "int32", "tensor(int64)": "int64", "tensor(uint8)": "uint8", "tensor(uint32)": "uint32",
          "tensor(bool)": "bool"}
"""Names of onnxruntime's types in `policy.json`."""
MAX_SPEED = 100.0
"""Largest limit of a command [m/s, rad/s]: far above any vehicle, so that a slip of units is refused."""
MAX_PIXELS = 1 << 20
"""Most pixels of an image: a step on more takes longer than any control period."""
MAX_CARRY = 64
"""Most entries of the recurrent state; presets have three."""
MAX_STATE_BYTES = 16 * MIB
"""Largest recurrent state [bytes]: it is copied in every step. Presets have less than 100 kB."""
SURPRISE = "surprise"
"""Name of the carry that holds a running mean of how far the goal that the policy believes in jumps [m]."""


@dataclass(frozen=True)
class Tensor:
    """Name, shape and type of an input, an output or one entry of the recurrent state."""

    name: str
    """In the network and in `policy.json`."""
    shape: tuple[int, ...]
    dtype: str
    """One of `DTYPES`, such as float32."""


@dataclass(frozen=True)
class Contract:
    """What `policy.json` says about image, action, rate and state of a vehicle's policy."""

    height: int
    """Of the image [pixels]."""
    width: int
    """Of the image [pixels]."""
    low: tuple[float, float]
    """Command at action -1: v [m/s], omega [rad/s]."""
    high: tuple[float, float]
    """Command at action +1."""
    rate_hz: float
    """Control periods per second [Hz]."""
    action_repeat: int
    """Control periods that an action holds."""
    carry: tuple[Tensor, ...]
    """Entries of the recurrent state."""
    inputs: tuple[str, ...]
    """Names of the network's inputs, in order."""
    outputs: tuple[str, ...]
    """Names of the network's outputs, in order."""
    camera: Mapping[str, Any]
    """Pose and field of view of the training's camera; `frame` is always there."""
    task: str
    """That it was trained for."""
    vehicle_sha256: str
    """Of the vehicle file that it was trained with."""
    novelty: tuple[float, float] | None = None
    """Surprise [m] from which the vehicle slows down, and at which it stops; None where the file has no score."""

    @property
    def commands(self) -> "Commands":
        """What the actions mean."""
        return Commands(self.low, self.high, self.rate_hz, self.action_repeat)

    @property
    def sensors(self) -> dict[str, SensorInput]:
        """The one sensor that it reads, its camera."""
        return {"image": SensorInput("image", "camera", (self.height, self.width, 3), camera=self.camera)}

    def tensors(self) -> tuple[list[Tensor], list[Tensor]]:
        """Return the inputs and outputs that the network must have, in order."""
        image = Tensor("image", (self.height, self.width, 3), "uint8")
        action = Tensor("action", (2,), "float32")
        return _named(self.inputs, (image, *self.carry)), _named(self.outputs, (action, *self.carry))


@dataclass(frozen=True)
class Commands:
    """What the actions of an agent that drives a vehicle mean."""

    low: tuple[float, float]
    """Command at action -1: v [m/s], omega [rad/s]."""
    high: tuple[float, float]
    """Command at action +1."""
    rate_hz: float
    action_repeat: int


@dataclass(frozen=True)
class AgentContract:
    """What `policy.json` says about observations, action and state of an agent."""

    observation: tuple[int, ...] | dict[str, tuple[int, ...]]
    """Shape of the one observation, or shapes by name: (H, W, C) uint8 or (D,) float32."""
    discrete: bool
    """Whether the action is a class; if not, it is a vector in [-1, 1]."""
    size: int
    """Classes, or components of the vector."""
    carry: tuple[Tensor, ...]
    """Entries of the recurrent state."""
    inputs: tuple[str, ...]
    """Names of the network's inputs, in order."""
    outputs: tuple[str, ...]
    """Names of the network's outputs, in order."""
    task: str
    """That it was trained for."""
    commands: Commands | None = None
    """Of an agent that drives a vehicle by other sensors than its camera alone."""
    sensors: Mapping[str, SensorInput] = field(default_factory=dict)
    """Of the observations by name; empty where the file does not say what measures them."""
    novelty: tuple[float, float] | None = None
    """Surprise [m] from which the vehicle slows down, and at which it stops; None where the file has no score."""

    SINGLE = "observation"

    def tensors(self) -> tuple[list[Tensor], list[Tensor]]:
        """Return the inputs and outputs that the network must have, in order."""
        shapes = self.observation if isinstance(self.observation, dict) else {self.SINGLE: self.observation}
        known = {name: Tensor(name, shape, "uint8" if len(shape) == 3 else "float32") for name, shape in shapes.items()}
        known |= {f"carry_{entry.name}": entry for entry in self.carry}
        vector = Tensor("action", (self.size,), "float32")
        results = (Tensor("class", (), "int32"), vector) if self.discrete else (vector,)
        inputs = tuple(known[name] for name in self.inputs)
        return _named(self.inputs, inputs), _named(self.outputs, (*results, *self.carry))


def _named(names: tuple[str, ...], tensors: tuple[Tensor, ...]) -> list[Tensor]:
    return [Tensor(name, tensor.shape, tensor.dtype) for name, tensor in zip(names, tensors, strict=True)]


def check_kind(name: str, table: Mapping[str, Any], kinds: tuple[str, ...]) -> str:
    """Return the kind of a table, one of `kinds`.

    Raises:
        PolicyFileError: of another kind or schema.
    """
    schema, kind = table.get("schema"), table.get("kind")
    if schema == SCHEMA and kind == AGENT_KIND and AGENT_KIND not in kinds:
        seen = parse_observation(Fields(name, table))
        what = ", ".join(sorted(seen)) if isinstance(seen, dict) else f"one observation of shape {list(seen)}"
        raise PolicyFileError(f"{name}: the policy is an agent that reads {what}; here a policy of the camera image "
                              "alone is needed. Train with that observation, or run it with bridge.drive, "
                              "whill_mjx.evaluate or dreamer.policy.")
    if schema != SCHEMA or isinstance(schema, bool) or kind not in kinds:
        wanted = " or ".join(repr(known) for known in kinds)
        raise PolicyFileError(f"{name}: schema {show(schema)} of kind {show(kind)}; this bridge reads schema {SCHEMA} "
                              f"of kind {wanted}. {EXPORT_AGAIN} or use the matching bridge.")
    return str(kind)


def parse_hashes(name: str, table: Mapping[str, Any], needed: str = "policy.onnx") -> dict[str, str]:
    """Return the SHA-256 of each file that `policy.json` lists."""
    return Fields(name, table).rule(
        "files", lambda value: _is_hashes(value) and needed in value,
        f"must give the SHA-256 (64 hexadecimal digits) of at most {MAX_FILES} plain file names, {needed} among them")


def parse_contract(name: str, table: Mapping[str, Any]) -> Contract:
    """Return the contract of a vehicle's policy; `name` is the file, for messages."""
    fields = Fields(name, table)
    image, action = fields.child("image"), fields.child("action")
    image.rule("channels", lambda value: is_integer(value) and value == 3, "must be 3")
    image.rule("encoding", lambda value: value == "rgb8", "must be 'rgb8'")
    commands = _parse_commands(fields, action)
    height, width = (image.rule(key, _is_side, "must be an integer from 1 to 4096") for key in ("height", "width"))
    if height * width > MAX_PIXELS:
        raise PolicyFileError(f"{name} image: height x width = {height} x {width}, but it must have at most "
                              f"{MAX_PIXELS} pixels. {EXPORT_AGAIN}.")
    carry = _parse_carry(fields)
    inputs, outputs = _parse_tensors(fields, 1 + len(carry), 1 + len(carry))
    return Contract(
        height=height, width=width, low=commands.low, high=commands.high, rate_hz=commands.rate_hz,
        action_repeat=commands.action_repeat, carry=carry, inputs=inputs, outputs=outputs,
        camera=parse_camera(fields.child("camera")),
        task=fields.rule("task", lambda value: isinstance(value, str), "must be text"),
        vehicle_sha256=fields.rule("vehicle_sha256", lambda value: value == "" or _is_digest(value),
                                   "must be empty or a SHA-256 (64 hexadecimal digits)"),
        novelty=_parse_novelty(fields, carry),
    )


def _parse_commands(fields: Fields, action: Fields) -> Commands:
    """Return what actions mean, from the rates of a policy and its table of the action."""
    action.rule("names", lambda value: value == ["v", "omega"], "must be ['v', 'omega']")
    action.rule("units", lambda value: value == ["m/s", "rad/s"], "must be ['m/s', 'rad/s']")
    limits = f"must be two finite numbers from -{MAX_SPEED:g} to {MAX_SPEED:g}"
    low = action.rule("low", _is_pair, limits)
    high = action.rule("high", lambda value: _is_pair(value) and all(a < b for a, b in zip(low, value, strict=True)),
                       f"{limits}, above low = {low}")
    return Commands(
        (float(low[0]), float(low[1])), (float(high[0]), float(high[1])),
        float(fields.rule("rate_hz", lambda value: is_number(value) and 0.01 <= value <= 1000,
                          "must be from 0.01 to 1000 [1/s]")),
        fields.rule("action_repeat", lambda value: is_integer(value) and 1 <= value <= 100,
                    "must be an integer from 1 to 100"),
    )


def parse_agent(name: str, table: Mapping[str, Any]) -> AgentContract:
    """Return the contract of an agent; `name` is the file, for messages."""
    fields = Fields(name, table)
    action = fields.child("action")
    kind = action.rule("kind", lambda value: value in ("box", "discrete"), "must be 'box' or 'discrete'")
    size = action.rule("size", lambda value: is_integer(value) and 1 <= value <= 65536, "must be from 1 to 65536")
    observation = parse_observation(fields)
    carry = _parse_carry(fields)
    seen = sorted(observation) if isinstance(observation, dict) else [AgentContract.SINGLE]
    results = 2 if kind == "discrete" else 1
    inputs, outputs = _parse_tensors(fields, len(seen) + len(carry), results + len(carry))
    wanted = {*seen, *(f"carry_{entry.name}" for entry in carry)}
    fields.child("onnx").rule("inputs", lambda value: set(value) == wanted, f"must be {show(sorted(wanted))}")
    return AgentContract(
        observation=observation, discrete=kind == "discrete", size=size, carry=carry, inputs=inputs, outputs=outputs,
        task=fields.rule("task", lambda value: isinstance(value, str), "must be text") if "task" in table else "",
        commands=_parse_commands(fields, action) if "low" in action.table and size == 2 and kind == "box" else None,
        sensors=parse_sensors(fields, observation if isinstance(observation, dict) else {seen[0]: observation}),
        novelty=_parse_novelty(fields, carry),
    )


def parse_observation(fields: Fields) -> tuple[int, ...] | dict[str, tuple[int, ...]]:
    """Return the shape of the one observation, or the shapes by name."""
    value = fields.rule("observation", _is_observation, "must be a shape [H, W, C] or [D], or several by name, of at "
                        f"most {16 * MAX_PIXELS} numbers in all")
    return {key: tuple(shape) for key, shape in value.items()} if isinstance(value, dict) else tuple(value)


def _parse_carry(fields: Fields) -> tuple[Tensor, ...]:
    entries = fields.rule("carry", lambda value: isinstance(value, list) and len(value) <= MAX_CARRY,
                          f"must be a list of at most {MAX_CARRY} entries")
    carry = tuple(_parse_entry(Fields(f"{fields.name} carry[{i}]", entry)) for i, entry in enumerate(entries))
    if len({entry.name for entry in carry}) < len(carry):
        raise PolicyFileError(f"{fields.name}: carry = {show([entry.name for entry in carry])}, but its names must be "
                              f"different. {EXPORT_AGAIN}.")
    size = sum(math.prod(entry.shape) * 8 for entry in carry)
    if size > MAX_STATE_BYTES:
        raise PolicyFileError(f"{fields.name}: carry has {size} bytes at 8 a number, but it must have at most "
                              f"{MAX_STATE_BYTES}. {EXPORT_AGAIN}.")
    return carry


def _parse_entry(entry: Fields) -> Tensor:
    shape = entry.rule("shape", lambda value: isinstance(value, list) and len(value) <= 8
                       and all(is_integer(n) and 1 <= n <= MAX_STATE_BYTES for n in value),
                       "must be a list of at most 8 positive integers")
    return Tensor(
        name=entry.rule("name", _is_text, "must be text"), shape=tuple(shape),
        dtype=entry.rule("dtype", lambda value: isinstance(value, str) and value in DTYPES.values(),
                         f"must be one of {list(DTYPES.values())}"))


def _parse_novelty(fields: Fields, carry: tuple[Tensor, ...]) -> tuple[float, float] | None:
    """Return the limits of the policy's surprise, where the file has them."""
    if "novelty" not in fields.table:
        return None
    known = any(entry.name == SURPRISE for entry in carry)
    slow, stop = fields.rule(
        "novelty", lambda value: (known and isinstance(value, list) and len(value) == 2 and all(map(is_number, value))
                                  and 0 < value[0] < value[1]),
        f"must be two rising numbers above 0, beside a carry '{SURPRISE}'")
    return float(slow), float(stop)


def _parse_tensors(fields: Fields, inputs: int, outputs: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    onnx = fields.child("onnx")
    names = [onnx.rule(key, _is_names(count), f"must be {count} different names")
             for key, count in (("inputs", inputs), ("outputs", outputs))]
    return tuple(names[0]), tuple(names[1])


def _is_pair(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(is_within(MAX_SPEED), value))


def _is_side(value: Any) -> bool:
    return is_integer(value) and 1 <= value <= 4096


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and 0 < len(value) <= 200


def _is_names(count: int) -> Callable[[Any], bool]:
    return lambda value: (isinstance(value, list) and all(_is_text(x) for x in value)
                          and len(value) == len(set(value)) == count)


def _is_shape(value: Any) -> bool:
    return (isinstance(value, list) and len(value) in (1, 3)
            and all(is_integer(n) and 1 <= n <= MAX_PIXELS for n in value))


def _is_observation(value: Any) -> bool:
    shapes = list(value.values()) if isinstance(value, dict) else [value]
    return (0 < len(shapes) <= MAX_CARRY and all(_is_shape(shape) for shape in shapes)
            and sum(math.prod(shape) for shape in shapes) <= 16 * MAX_PIXELS
            and (not isinstance(value, dict) or all(_is_text(key) for key in value)))


def _is_digest(value: Any) -> bool:
    return isinstance(value, str) and re.fullmatch("[0-9a-f]{64}", value) is not None


def _is_hashes(value: Any) -> bool:
    return (isinstance(value, dict) and len(value) <= MAX_FILES and "policy.json" not in value
            and all(_is_digest(digest) and re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}", name)
                    for name, digest in value.items()))
