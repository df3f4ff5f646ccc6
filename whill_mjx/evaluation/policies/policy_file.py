"""A policy file (docs/policy_file.md) as a JAX function of one instance, and the camera that a policy file describes.

The file itself is read and checked by `bridge.policy`.
"""

from __future__ import annotations

import dataclasses
import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bridge.policy import (
    AGENT_KIND,
    EXPORT_AGAIN,
    KIND,
    AgentContract,
    CheckedPolicy,
    PolicyFileError,
    make_session,
    read_policy,
    show,
)
from whill_mjx.effects.base import apply_chain
from whill_mjx.evaluation.policies.onnx_network import Network
from whill_mjx.sensors.base import Sensor
from whill_mjx.sensors.camera import Camera
from whill_mjx.sensors.registry import known_sensors
from whill_mjx.vehicle.dynamics import nominal_world, place
from whill_mjx.vehicle.kinematics import camera_pose
from whill_mjx.vehicle.model import VehicleModel
from whill_mjx.vehicle.specs import CameraMount
from whill_mjx.vehicle.types import VehicleParams

RUNTIMES = ("jax", "onnxruntime")
OTHER_RUNTIME = "Evaluate with the runtime 'onnxruntime' instead."


@dataclass(frozen=True, eq=False)
class PolicyFile:
    """A policy and what it was trained for."""

    path: Path
    task: str
    low: tuple[float, float]
    """Command at action -1: v [m/s], omega [rad/s]."""
    high: tuple[float, float]
    height: int | None
    """Rows of the camera image; None where the policy observes sensors by name."""
    width: int | None
    """Columns of the camera image, or None."""
    rate_hz: float
    action_repeat: int
    sha256: str
    """Of the network."""
    vehicle: Path | None
    """Vehicle file it was trained with, if it is inside."""
    carry: dict[str, jax.ShapeDtypeStruct]
    step: Callable[[dict[str, jax.Array], Any], tuple[dict[str, jax.Array], jax.Array]]
    """(carry, image (H, W, 3) uint8 or observations by name) -> carry, action (2,); traceable, and so is its vmap."""
    observation: dict[str, tuple[int, ...]] | None = None
    """Shapes of the observations by name; None: the camera image alone."""
    unpacked: tempfile.TemporaryDirectory | None = None
    """Folder of the vehicle file of a zip; it lives as long as this record."""

    def start(self) -> dict[str, jax.Array]:
        """Recurrent state at the start of an episode: all zeros."""
        return {name: jnp.zeros(spec.shape, spec.dtype) for name, spec in self.carry.items()}


def load_policy(path: str | Path, runtime: str = "jax") -> PolicyFile:
    """Policy of a folder, or of a zip of it.

    Args:
        path: folder or zip that holds policy.json and policy.onnx.
        runtime: "jax" compiles the network with everything else; "onnxruntime" calls it on the host for one instance
            after the other: slow, but it is what runs on the vehicle.

    Raises:
        PolicyFileError: a part is missing, damaged or of another version; names file, field, value, rule and remedy.
        ValueError: unknown runtime.
    """
    path = Path(path)
    if runtime not in RUNTIMES:
        raise ValueError(f"unknown runtime {runtime!r}; use one of {RUNTIMES}.")
    checked = read_policy(path, (KIND, AGENT_KIND))
    contract = checked.contract
    agent = isinstance(contract, AgentContract)
    commands = contract.commands if isinstance(contract, AgentContract) else contract
    shapes = contract.observation if isinstance(contract, AgentContract) else None
    if commands is None or (agent and not isinstance(shapes, dict)):
        raise PolicyFileError(f"{path}/policy.json: the agent drives no vehicle: it has no limits of v and omega. "
                              f"{EXPORT_AGAIN}.")
    carry = {entry.name: jax.ShapeDtypeStruct(entry.shape, np.dtype(entry.dtype)) for entry in contract.carry}
    session = make_session(checked)
    run = _jax_network(checked) if runtime == "jax" else _host_network(session, contract, carry)

    def step(state: dict[str, jax.Array], obs: Any) -> tuple[dict[str, jax.Array], jax.Array]:
        if agent:
            given = {**obs, **{f"carry_{name}": state[name] for name in carry}}
            action, *values = run(*(given[name] for name in contract.inputs))
        else:
            action, *values = run(obs, *(state[name] for name in carry))
        after = {name: value.astype(carry[name].dtype) for name, value in zip(carry, values, strict=True)}
        return after, action

    vehicle, unpacked = vehicle_file(path, checked)
    return PolicyFile(
        path=path, task=contract.task, low=commands.low, high=commands.high,
        height=getattr(contract, "height", None), width=getattr(contract, "width", None), rate_hz=commands.rate_hz,
        action_repeat=commands.action_repeat, observation=shapes if isinstance(shapes, dict) else None,
        sha256=checked.files["policy.onnx"], vehicle=vehicle, carry=carry, step=step, unpacked=unpacked,
    )  # fmt: skip


def camera_contract(model: VehicleModel, params: VehicleParams) -> dict[str, Any]:
    """Camera of a policy file: its pose over level ground while the vehicle stands, and its field of view.

    The vehicle file gives the camera in the chassis frame, but the chassis sinks and tilts on its suspension. What
    somebody measures on the standing vehicle, and what the policy saw, is the pose in `base_footprint`: origin on the
    ground below the reference point (middle of the driven axle), x forward, y left, z up.
    """
    level = dataclasses.replace(params, effects=tuple(e for e in params.effects if not _is_ground(model, e)))
    position, rotation = camera_pose(model, place(model, level, 0.0, 0.0, 0.0).qpos)
    right, down, forward = np.asarray(rotation, np.float64).T
    angles = {"roll": np.arctan2(-right[2], -down[2]), "pitch": np.arcsin(np.clip(-forward[2], -1.0, 1.0)),
              "yaw": np.arctan2(forward[1], forward[0])}  # fmt: skip
    lengths = dict(zip("xyz", np.asarray(position, np.float64), strict=True))
    return {
        "frame": "base_footprint",
        **{name: round(float(value), 6) + 0.0 for name, value in {**lengths, **angles}.items()},
        "fov_y": model.spec.camera.fov_y,
    }


def sensor_contract(env: Any, params: VehicleParams) -> dict[str, dict[str, Any]]:
    """What measures each observation of an environment, as a policy file has it: kind, settings, pose of a camera."""
    found: dict[str, dict[str, Any]] = {}
    for name, sensor in env.sensors:
        kind = sensor.name or f"{type(sensor).__module__}:{type(sensor).__qualname__}"
        found[name] = {"kind": kind, "settings": _plain(dataclasses.asdict(sensor))}
        if isinstance(sensor, Camera):
            spec = env.model.spec
            mounted = dataclasses.replace(spec, camera=sensor.mount or spec.camera)
            found[name]["camera"] = camera_contract(dataclasses.replace(env.model, spec=mounted), params)
    return found


def sensors_of(contract: Any, task: Any) -> dict[str, Sensor]:
    """The sensors that a policy's contract describes; those that this package does not know are the task's own.

    Raises:
        ValueError: a sensor is known to neither, or its settings do not suit it.
    """
    known, own = known_sensors(), task.observations()
    found = {}
    for name, about in contract.sensors.items():
        kind = known.get(about.kind)
        if kind is None and name not in own:
            raise ValueError(f"observation {name!r} of the policy is measured by {about.kind!r}, which neither this "
                             f"package nor the task {contract.task!r} has. Give the task of its training.")
        settings: dict[str, Any] = dict(about.settings)
        if settings.get("rate_hz", 0) is None:  # JSON has no infinity
            settings["rate_hz"] = math.inf
        try:
            if settings.get("mount"):
                settings["mount"] = CameraMount(**settings["mount"])
            found[name] = own[name] if kind is None else kind(**settings)
        except TypeError as error:
            raise ValueError(f"observation {name!r} of the policy: settings {show(dict(about.settings))} do not suit a "
                             f"{about.kind}: {error}. Export the policy again.") from error
    return found


def _plain(settings: Any) -> Any:
    """Settings as JSON: a number that is not finite is null, and what JSON lacks is its text."""
    if isinstance(settings, dict):
        return {str(key): _plain(value) for key, value in settings.items()}
    if isinstance(settings, list | tuple):
        return [_plain(value) for value in settings]
    if isinstance(settings, float):
        return settings if math.isfinite(settings) else None
    return settings if settings is None or isinstance(settings, bool | int | str) else str(settings)


def _is_ground(model: VehicleModel, effect: Any) -> bool:
    """Whether an effect is a surface on the ground, such as a ramp."""
    _, world = apply_chain((effect,), (effect.init(),), "world", nominal_world(model))
    return bool(world.ground)


def vehicle_file(path: Path, checked: CheckedPolicy) -> tuple[Path | None, tempfile.TemporaryDirectory | None]:
    """The vehicle file beside the policy; that of a zip is unpacked."""
    if checked.vehicle is None:
        return None, None
    if path.is_dir():
        return path / "vehicle.toml", None
    unpacked = tempfile.TemporaryDirectory()
    file = Path(unpacked.name) / "vehicle.toml"
    file.write_bytes(checked.vehicle)
    return file, unpacked


def _jax_network(checked: CheckedPolicy) -> Callable:
    """The network as a JAX function, after a step on shapes alone."""
    file, contract = f"{checked.path}/policy.onnx", checked.contract
    names = list(contract.inputs), list(contract.outputs)
    inputs, outputs = contract.tensors()
    try:
        network = Network(checked.network, file)
        shapes = [jax.ShapeDtypeStruct(tensor.shape, np.dtype(tensor.dtype)) for tensor in inputs]
        results = jax.eval_shape(network, *shapes) if (network.inputs, network.outputs) == names else ()
    except Exception as error:  # an operator that is not known, or a model that only onnxruntime accepts
        cause = str(error)[:300].removeprefix(f"{file}: ").removesuffix(f" {OTHER_RUNTIME}")
        raise PolicyFileError(f"{file}: {cause} {OTHER_RUNTIME}") from error
    found, wanted = [result.shape for result in results], [tensor.shape for tensor in outputs]
    if found != wanted:
        raise PolicyFileError(f"{file}: tensors {network.inputs} -> {network.outputs} of shapes {found}, but "
                              f"policy.json says {names[0]} -> {names[1]} of {wanted}. Order and shapes must agree. "
                              f"{EXPORT_AGAIN}.")
    return network


def _host_network(session: Any, contract: Any, carry: dict[str, jax.ShapeDtypeStruct]) -> Callable:
    """The network in onnxruntime, called from JAX."""
    shapes = (jax.ShapeDtypeStruct((2,), jnp.float32), *carry.values())

    def on_host(*values: Any) -> tuple[np.ndarray, ...]:
        feed = {name: np.asarray(value) for name, value in zip(contract.inputs, values, strict=True)}
        return tuple(session.run(list(contract.outputs), feed))

    return lambda *values: jax.pure_callback(on_host, shapes, *values, vmap_method="sequential")
