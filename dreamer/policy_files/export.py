"""Writes the policy file: one folder that holds everything a vehicle needs to run a trained policy.

The folder is described in docs/policy_file.md. The vehicle reads `policy.onnx`, the archive is `weights.npz`; both are
plain data, nothing in the file can execute code. The writer checks its own work: it replays the ONNX network beside
the JAX one, records the largest difference of their actions in `policy.json`, and has the finished folder read by
`bridge.policy`, the reader of the vehicle. `export_agent` writes agents that see
and do something else than a vehicle in the same way.
"""

import dataclasses
import datetime
import hashlib
import json
import math
import os
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bridge.policy import AGENT_KIND, KIND, SCHEMA, AgentContract, PolicyFileError, read_policy
from dreamer import spaces
from dreamer.config import DreamerConfig
from dreamer.layers import sensors
from dreamer.model import agent, world_model
from dreamer.policy_files.network import OPSET, Carry, Network, Shapes, parity, to_onnx
from dreamer.spaces import ActionSpec, Discrete, ObsShape
from dreamer.types import Params

SINGLE = AgentContract.SINGLE
"""Name of an observation that the environment does not name."""
CHECK_STEPS = 200
"""Recurrent steps on random observations over which ONNX and JAX are compared."""

Step = Callable[[Carry, jax.Array], tuple[Carry, jax.Array]]


@dataclasses.dataclass(frozen=True)
class Converted:
    """A network, the same as ONNX, and how far their actions differ."""

    network: Network
    model: bytes
    differences: dict[str, Any]

    @classmethod
    def of(cls, network: Network, check_steps: int) -> "Converted":
        """Convert a network and compare both over this many recurrent steps on random observations."""
        model = to_onnx(network)
        return cls(network, model, parity(model, network, check_steps))


@dataclasses.dataclass(frozen=True)
class PolicyContract:
    """What the vehicle must know to feed the policy and to read its output."""

    action_low: tuple[float, float]
    """Command at action -1: v [m/s], omega [rad/s]."""
    action_high: tuple[float, float]
    """Command at action +1: v [m/s], omega [rad/s]."""
    task: str = ""
    """Name of the task the policy was trained for."""
    vehicle_sha256: str = ""
    """SHA-256 of the vehicle file it was trained with; filled in when the file itself is given."""
    height: int = 64
    """Image height [pixels]."""
    width: int = 64
    """Image width [pixels]."""
    rate_hz: float = 10.0
    """Control rate [1/s]."""
    action_repeat: int = 1
    """The policy is evaluated on every k-th tick; its command is held in between."""
    novelty: tuple[float, float] | None = None
    """Surprise [m] from which the vehicle slows down, and at which it stops; needs a carry "surprise"."""
    camera: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Camera of the training, as plain JSON: pose and field of view, and the frame in which the pose is given."""

    def __post_init__(self) -> None:
        for name in ("action_low", "action_high"):
            limits = getattr(self, name)
            if len(limits) != 2 or not all(math.isfinite(x) for x in limits):
                raise ValueError(f"PolicyContract.{name} = {limits}: it must be two finite numbers. "
                                 "Give (v [m/s], omega [rad/s]).")
        if not all(low < high for low, high in zip(self.action_low, self.action_high, strict=True)):
            raise ValueError(f"PolicyContract: action_low = {self.action_low} must be below action_high = "
                             f"{self.action_high} in each component. Swap them.")
        if not (self.rate_hz > 0 and 1 <= self.action_repeat <= 100 and self.height >= 1 and self.width >= 1):
            raise ValueError(f"PolicyContract: rate_hz = {self.rate_hz}, action_repeat = {self.action_repeat}, image "
                             f"{self.height} x {self.width} must all be positive, and action_repeat at most 100. "
                             "Correct the contract.")


def export_policy(
    path: str | Path,
    step: Step,
    carry: Mapping[str, jax.Array | np.ndarray],
    weights: Any,
    contract: PolicyContract,
    *,
    vehicle_file: str | Path | None = None,
    stablehlo: bool = False,
    check_steps: int = CHECK_STEPS,
) -> Path:
    """Write a policy file and return its folder.

    Args:
        path: folder to write; an existing policy file there is replaced as a whole.
        step: pure function of one instance, (carry, image (H, W, 3) uint8) -> (carry, action (2,) in [-1, 1]).
            It must be deterministic (argmax latent, mode action). Its parameters are closed over.
        carry: recurrent state by name; only shapes and dtypes are used. All zeros mean "start of an episode".
        weights: pytree of the parameters, stored as plain arrays in `weights.npz`.
        contract: image, action, rate and origin.
        vehicle_file: TOML vehicle file to put beside the policy.
        stablehlo: also write `policy.stablehlo` for JAX users; readable for about six months only.
        check_steps: recurrent steps on random images over which ONNX and JAX are compared.

    Raises:
        ValueError: the ONNX network needs operators outside the standard set or acts differently, or a reader would
            refuse the file; nothing is written.
    """
    path = Path(path)
    shapes = {name: jax.ShapeDtypeStruct(np.shape(value), value.dtype) for name, value in carry.items()}
    _check_signature(step, shapes, contract)

    def named_step(carry: Carry, obs: dict[str, jax.Array]) -> tuple[Carry, tuple[jax.Array, ...]]:
        carry, action = step(carry, obs["image"])
        return carry, (action.astype(jnp.float32),)

    converted = Converted.of(Network(named_step, shapes, {"image": _image_shape(contract)}), check_steps)
    path.parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        (folder / "policy.onnx").write_bytes(converted.model)
        save_arrays(folder / "weights.npz", flatten_weights(weights))
        if stablehlo:
            (folder / "policy.stablehlo").write_bytes(_to_stablehlo(step, shapes, contract))
        vehicle_sha256 = contract.vehicle_sha256
        if vehicle_file is not None:
            vehicle_sha256 = _copy_vehicle(Path(vehicle_file), folder / "vehicle.toml", vehicle_sha256)
        _finish(folder, path, _describe(contract, vehicle_sha256), converted)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return path


def export_agent(
    path: str | Path,
    config: DreamerConfig,
    params: Params,
    obs_shape: ObsShape,
    action_dim: ActionSpec,
    *,
    task: str = "",
) -> Path:
    """Write the policy of an agent as ONNX, whatever it sees and does, and return its folder.

    Each observation is an input by its name (`observation`, where it has none), those that only the decoder sees are
    not. The action is what the environment receives; of classes there is a second output, their probabilities.
    `dreamer.policy.Policy.load` reads it. A vehicle needs a contract of units and rates: `export_policy`.

    Args:
        path: folder to write; an existing policy file there is replaced as a whole.
        config: sizes of the agent.
        params: of one agent.
        obs_shape: as the environment declares it.
        action_dim: as the environment declares it.
        task: name of the task, for the reader.

    Raises:
        ValueError: parameters, observations and actions do not fit, two tensors have one name, or the ONNX network acts
            differently; nothing is written.
    """
    path, actions = Path(path), spaces.actions(action_dim)
    bias = params["policy"]["out"]["b"]
    if bias.shape != (actions.outputs,):
        raise ValueError(f"params: the policy's last bias has the shape {bias.shape}, but {actions} needs "
                         f"({actions.outputs},). Give the action_dim of the training, and of several seeds one agent "
                         "(dreamer.training.seeds.pick).")
    converted = Converted.of(_network_of(config, params, obs_shape, actions), CHECK_STEPS)
    described = {name: list(one) for name, one in obs_shape.items()} if isinstance(obs_shape, Mapping) else obs_shape
    table = {
        "schema": SCHEMA,
        "kind": AGENT_KIND,
        "observation": sensors.visible(config, described),
        "action": {"kind": type(actions).__name__.lower(), "size": actions.width},
        "task": task,
    }
    return _write_agent(path, converted, params, table)


@dataclasses.dataclass(frozen=True)
class SensingPolicy:
    """A policy of one instance that observes other sensors than a camera alone."""

    step: Callable[[Carry, dict[str, jax.Array]], tuple[Carry, jax.Array]]
    """Pure function, (carry, observations by name) -> (carry, action (2,) in [-1, 1])."""
    carry: Mapping[str, jax.Array | np.ndarray]
    """Recurrent state by name; may be empty."""
    obs_shape: Mapping[str, tuple[int, ...]]
    """Shapes by name, (H, W, C) of uint8 or (D,) of float32."""
    weights: Any
    """Pytree of the parameters."""
    sensors: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    """What measures each observation, as plain JSON: `kind`, `settings`, of a camera `camera` (docs/policy_file.md)."""


def export_sensing(
    path: str | Path, policy: SensingPolicy, contract: PolicyContract, vehicle_file: str | Path | None = None
) -> Path:
    """Write the policy of a vehicle that observes other sensors than its camera alone, and return its folder.

    It is an agent (`export_agent`) whose actions are commands: the contract's limits, rate, action repeat and novelty
    are in the file too, and so are its sensors, which the bridge must know to drive by it.

    Args:
        path: folder to write; an existing policy file there is replaced as a whole.
        policy: what is exported.
        contract: action, rate and task; its image and camera are not written.
        vehicle_file: TOML vehicle file to put beside the policy.

    Raises:
        ValueError: the ONNX network needs operators outside the standard set or acts differently; nothing is written.
    """
    path, carry, obs_shape = Path(path), policy.carry, policy.obs_shape
    shapes = {name: jax.ShapeDtypeStruct(np.shape(value), value.dtype) for name, value in carry.items()}
    inputs = jax.eval_shape(lambda: spaces.zeros({name: tuple(obs_shape[name]) for name in sorted(obs_shape)}))

    def named_step(carry: Carry, obs: dict[str, jax.Array]) -> tuple[Carry, tuple[jax.Array, ...]]:
        carry, action = policy.step(carry, obs)
        return carry, (action.astype(jnp.float32),)

    converted = Converted.of(Network(named_step, shapes, dict(inputs)), CHECK_STEPS)
    vehicle = _describe(contract, "")
    table = {
        "schema": SCHEMA,
        "kind": AGENT_KIND,
        "observation": {name: list(shape) for name, shape in sorted(obs_shape.items())},
        "action": {"kind": "box", "size": 2, **vehicle["action"]},
        **{name: vehicle[name] for name in ("rate_hz", "action_repeat", "task")},
        **({"sensors": {name: dict(one) for name, one in sorted(policy.sensors.items())}} if policy.sensors else {}),
        **({"novelty": vehicle["novelty"]} if "novelty" in vehicle else {}),
    }
    return _write_agent(path, converted, policy.weights, table, vehicle_file)


def _write_agent(
    path: Path, converted: Converted, weights: Any, table: dict[str, Any], vehicle_file: str | Path | None = None
) -> Path:
    """Write the folder of an agent, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        (folder / "policy.onnx").write_bytes(converted.model)
        save_arrays(folder / "weights.npz", flatten_weights(weights))
        if vehicle_file is not None:
            _copy_vehicle(Path(vehicle_file), folder / "vehicle.toml", "")
        _finish(folder, path, table, converted)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return path


def _network_of(
    config: DreamerConfig, params: Params, obs_shape: ObsShape, actions: spaces.Box | spaces.Discrete
) -> Network:
    """The policy of an agent as a function of named arrays."""
    seen = sensors.visible(config, obs_shape)
    several = isinstance(seen, Mapping)

    def step(carry: Carry, obs: dict[str, jax.Array]) -> tuple[Carry, tuple[jax.Array, ...]]:
        carry, action = agent.policy_step(config, params, carry, obs if several else obs[SINGLE])
        if not isinstance(actions, Discrete):
            return carry, (actions.to_env(action),)
        raw = world_model.head(params["policy"], jnp.concatenate([carry["deter"], carry["stoch"]]))
        return carry, (actions.to_env(action), actions.probs(config, raw))

    inputs = jax.eval_shape(lambda: spaces.zeros({name: seen[name] for name in sorted(seen)} if several else seen))
    carry = {name: jax.ShapeDtypeStruct(x.shape, x.dtype) for name, x in agent.policy_carry(config, actions).items()}
    outputs = ("action", "probabilities") if isinstance(actions, Discrete) else ("action",)
    return Network(step, carry, dict(inputs) if several else {SINGLE: inputs}, outputs)


def _finish(folder: Path, path: Path, table: dict[str, Any], converted: Converted) -> None:
    """Describe the network and the files in `folder` in its policy.json, and put the folder at `path`."""
    network = converted.network
    inputs, outputs = network.tensors
    described = {
        **table,
        "carry": [{"name": name, "shape": list(shape.shape), "dtype": np.dtype(shape.dtype).name}
                  for name, shape in network.carry.items()],
        "onnx": {"opset": OPSET, "inputs": inputs, "outputs": outputs},
        "files": {item.name: sha256(item.read_bytes()) for item in sorted(folder.iterdir())},
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "parity": converted.differences,
    }
    (folder / "policy.json").write_text(json.dumps(described, indent=2, allow_nan=False) + "\n")
    folder.chmod(0o755)
    try:
        read_policy(folder, (table["kind"],))
    except PolicyFileError as error:
        raise PolicyFileError(str(error).replace(str(folder), str(path))) from error
    replace_folder(folder, path)


def flatten_weights(weights: Any) -> dict[str, np.ndarray]:
    """Return a pytree's leaves as arrays named by their path, for example `actor/layers/0/kernel`."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(weights)
    return {"/".join(_key(part) for part in path) or "value": _plain(leaf) for path, leaf in leaves}


def save_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write a .npz by hand: np.savez takes names as keyword arguments, where "file" and others are taken."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.ascontiguousarray(array), allow_pickle=False)


def _plain(leaf: Any) -> np.ndarray:
    """Return an array numpy can store on its own: bfloat16 and other extension types become float32, without loss."""
    array = np.asarray(leaf)
    return array if array.dtype.isbuiltin == 1 else array.astype(np.float32)


def _key(part: Any) -> str:
    for attribute in ("key", "name", "idx"):
        if hasattr(part, attribute):
            return str(getattr(part, attribute))
    return str(part)


def _image_shape(contract: PolicyContract) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct((contract.height, contract.width, 3), jnp.uint8)


def _check_signature(step: Step, shapes: Shapes, contract: PolicyContract) -> None:
    """Raise where `step` does not return its own carry and one action."""
    new_carry, action = jax.eval_shape(step, shapes, _image_shape(contract))
    if action.shape != (2,):
        raise ValueError(f"step returns an action of shape {action.shape}; the contract needs (2,): v, omega. "
                         "Export one instance, without a batch axis.")
    got = {name: (value.shape, value.dtype) for name, value in new_carry.items()}
    want = {name: (value.shape, value.dtype) for name, value in shapes.items()}
    if got != want:
        raise ValueError(f"step changes its carry from {want} to {got}; names, shapes and dtypes must stay the same. "
                         "Cast the state back inside step.")


def _to_stablehlo(step: Step, shapes: Shapes, contract: PolicyContract) -> bytes:
    from jax import export

    try:
        exported = export.export(jax.jit(step), platforms=("cpu", "cuda"))(shapes, _image_shape(contract))
        return bytes(exported.serialize())
    except ImportError as error:
        raise ValueError(f"policy.stablehlo: {error}. jax.export serialises with flatbuffers, which jax does not "
                         "install. Run `pip install flatbuffers` or export with stablehlo=False.") from error


def _describe(contract: PolicyContract, vehicle_sha256: str) -> dict[str, Any]:
    """Return what policy.json says about the vehicle."""
    return {
        "schema": SCHEMA,
        "kind": KIND,
        "image": {"height": contract.height, "width": contract.width, "channels": 3, "encoding": "rgb8"},
        "action": {"names": ["v", "omega"], "units": ["m/s", "rad/s"],
                   "low": [float(x) for x in contract.action_low], "high": [float(x) for x in contract.action_high]},
        "rate_hz": float(contract.rate_hz),
        "action_repeat": int(contract.action_repeat),
        "camera": dict(contract.camera),
        "task": contract.task,
        "vehicle_sha256": vehicle_sha256,
        **({"novelty": list(contract.novelty)} if contract.novelty else {}),
    }


def _copy_vehicle(source: Path, target: Path, expected: str) -> str:
    """Copy the vehicle file and return its SHA-256."""
    data = source.read_bytes()
    digest = sha256(data)
    if expected and expected != digest:
        raise ValueError(f"{source}: SHA-256 {digest} is not the contract's vehicle_sha256 {expected}. "
                         "Give the vehicle file that the policy was trained with.")
    target.write_bytes(data)
    return digest


def sha256(data: bytes) -> str:
    """Return the checksum by which policy.json names a file."""
    return hashlib.sha256(data).hexdigest()


def replace_folder(new: Path, path: Path) -> None:
    """Put `new` at `path`: a reader finds the old file, for an instant none, then the new one, never a mixture."""
    if not path.exists():
        os.replace(new, path)
        return
    if not (path / "policy.json").is_file():
        raise ValueError(f"{path}: exists and is not a policy file, so it is not replaced. Choose another path.")
    old = Path(tempfile.mkdtemp(prefix=f".{path.name}.old.", dir=path.parent))
    os.replace(path, old)
    os.replace(new, path)
    shutil.rmtree(old)
