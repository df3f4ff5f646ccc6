"""Writes the policy file: one folder that holds everything a vehicle needs to run a trained policy.

The folder is described in docs/policy_file.md. The vehicle reads `policy.onnx`, the archive is `weights.npz`; both are
plain data, nothing in the file can execute code. The writer checks its own work: it replays the ONNX network beside
the JAX one and records the largest difference of their actions in `policy.json`.
"""

import contextlib
import dataclasses
import datetime
import hashlib
import json
import logging
import math
import os
import shutil
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

SCHEMA = 1
KIND = "micromobility-policy"
OPSET = 18
"""ONNX operator set of the file. 18 is readable by onnxruntime 1.14 and newer, so also by a vehicle's older system."""
IR_VERSION = 8
"""ONNX file version that belongs to opset 18."""
ACTION_TOLERANCE = 1e-5
"""Largest difference of two actions in [-1, 1] that still counts as float32 rounding of one step."""
FLIP_SHARE = 0.02
"""Share of steps in which an argmax may fall to the other side of a tie. A wrong export differs at every step."""

Carry = dict[str, jax.Array]
Step = Callable[[Carry, jax.Array], tuple[Carry, jax.Array]]


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
    camera: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Camera of the training, as plain JSON: pose, field of view, latency."""

    def __post_init__(self) -> None:
        for name in ("action_low", "action_high"):
            limits = getattr(self, name)
            if len(limits) != 2 or not all(math.isfinite(x) for x in limits):
                raise ValueError(f"PolicyContract.{name} = {limits}: it must be two finite numbers. "
                                 "Give (v [m/s], omega [rad/s]).")
        if not all(low < high for low, high in zip(self.action_low, self.action_high, strict=True)):
            raise ValueError(f"PolicyContract: action_low = {self.action_low} must be below action_high = "
                             f"{self.action_high} in each component. Swap them.")
        if not (self.rate_hz > 0 and self.action_repeat >= 1 and self.height >= 1 and self.width >= 1):
            raise ValueError(f"PolicyContract: rate_hz = {self.rate_hz}, action_repeat = {self.action_repeat}, image "
                             f"{self.height} x {self.width} must all be positive. Correct the contract.")


def export_policy(
    path: str | Path,
    step: Step,
    carry: Mapping[str, jax.Array | np.ndarray],
    weights: Any,
    contract: PolicyContract,
    *,
    vehicle_file: str | Path | None = None,
    stablehlo: bool = False,
    check_steps: int = 200,
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
        ValueError: the ONNX network needs operators outside the standard set or acts differently; nothing is written.
    """
    path = Path(path)
    shapes = {name: jax.ShapeDtypeStruct(np.shape(value), value.dtype) for name, value in carry.items()}
    _check_signature(step, shapes, contract)
    model = _to_onnx(step, shapes, contract)
    parity = _parity(model, step, shapes, contract, check_steps)

    path.parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        (folder / "policy.onnx").write_bytes(model)
        save_arrays(folder / "weights.npz", flatten_weights(weights))
        if stablehlo:
            (folder / "policy.stablehlo").write_bytes(_to_stablehlo(step, shapes, contract))
        vehicle_sha256 = contract.vehicle_sha256
        if vehicle_file is not None:
            vehicle_sha256 = _copy_vehicle(Path(vehicle_file), folder / "vehicle.toml", vehicle_sha256)
        files = {item.name: _sha256(item.read_bytes()) for item in sorted(folder.iterdir())}
        description = _describe(contract, shapes, files, vehicle_sha256, parity)
        (folder / "policy.json").write_text(json.dumps(description, indent=2, allow_nan=False) + "\n")
        folder.chmod(0o755)
        replace_folder(folder, path)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return path


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


def _check_signature(step: Step, shapes: dict[str, jax.ShapeDtypeStruct], contract: PolicyContract) -> None:
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


def tensor_names(names: list[str]) -> tuple[list[str], list[str]]:
    """Return the ONNX input and output names; ONNX wants each name once, so a state differs on its way in and out."""
    return ["image", *(f"carry_{name}" for name in names)], ["action", *(f"next_{name}" for name in names)]


def _to_onnx(step: Step, shapes: dict[str, jax.ShapeDtypeStruct], contract: PolicyContract) -> bytes:
    """Return the network as a serialised ONNX model of standard operators."""
    import jax2onnx
    import onnx
    import onnx.inliner

    names = list(shapes)
    inputs, outputs = tensor_names(names)

    def flat_step(image: jax.Array, *values: jax.Array) -> tuple[jax.Array, ...]:
        carry, action = step(dict(zip(names, values, strict=True)), image)
        return action.astype(jnp.float32), *(carry[name] for name in names)

    quiet = logging.getLogger("onnx_ir")
    level = quiet.level
    quiet.setLevel(logging.ERROR)  # it warns about shapes it leaves out, which no runtime needs
    try:
        with _jax_restored():
            model = jax2onnx.to_onnx(flat_step, [_image_shape(contract), *shapes.values()], model_name="policy",
                                     opset=OPSET, input_names=inputs)
    finally:
        quiet.setLevel(level)
    model = onnx.inliner.inline_local_functions(model)
    _name_outputs(model, outputs)
    model.ir_version = IR_VERSION
    nodes = model.graph.node
    foreign = sorted({f"{node.domain}::{node.op_type}" for node in nodes if node.domain not in ("", "ai.onnx")})
    if foreign:
        raise ValueError(f"policy.onnx: operators {foreign} are not in the ONNX standard set, so a plain onnxruntime "
                         "cannot run them. Rewrite those operations in the policy step.")
    onnx.checker.check_model(model, full_check=False)
    return model.SerializeToString()


@contextlib.contextmanager
def _jax_restored() -> Iterator[None]:
    """Put back every attribute of JAX's modules that is exchanged inside.

    jax2onnx replaces functions of jax.numpy while it traces and leaves some in place; its cumsum refuses arguments that
    JAX's own takes, so that a program would fail at its next trace.
    """
    modules = [module for name, module in sys.modules.items() if name.partition(".")[0] in ("jax", "flax") and module]
    before = [(module, dict(vars(module))) for module in modules]
    try:
        yield
    finally:
        for module, attributes in before:
            for name, value in attributes.items():
                if vars(module).get(name) is not value:
                    setattr(module, name, value)


def _name_outputs(model: Any, names: list[str]) -> None:
    """Give the graph's outputs their names; one value may be two outputs (the action is often part of the carry)."""
    import onnx

    for output, name in zip(model.graph.output, names, strict=True):
        model.graph.node.append(onnx.helper.make_node("Identity", [output.name], [name], name=f"output_{name}"))
        output.name = name


def _to_stablehlo(step: Step, shapes: dict[str, jax.ShapeDtypeStruct], contract: PolicyContract) -> bytes:
    from jax import export

    try:
        exported = export.export(jax.jit(step), platforms=("cpu", "cuda"))(shapes, _image_shape(contract))
        return bytes(exported.serialize())
    except ImportError as error:
        raise ValueError(f"policy.stablehlo: {error}. jax.export serialises with flatbuffers, which jax does not "
                         "install. Run `pip install flatbuffers` or export with stablehlo=False.") from error


def _parity(model: bytes, step: Step, shapes: dict[str, jax.ShapeDtypeStruct], contract: PolicyContract,
            steps: int) -> dict[str, Any]:
    """Return the largest action differences of ONNX and JAX over random images.

    The difference of one step, both from JAX's state, tells whether the export is right, and is what is judged. The
    difference after many steps, each from its own state, is noted as well: a recurrent network can amplify rounding,
    most of all on noise, which it was never trained on. Where an argmax latent falls on a tie, rounding decides and
    both continue on different states: such a step is counted as a flip and the states are made equal again.
    """
    import onnxruntime

    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    names = list(shapes)
    inputs, _ = tensor_names(names)

    def onnx_step(carry: list[np.ndarray], image: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
        action, *carry = session.run(None, dict(zip(inputs, [image, *carry], strict=True)))
        return action, carry

    jax_step = jax.jit(step)
    carry: Any = {name: np.zeros(shape.shape, shape.dtype) for name, shape in shapes.items()}
    own_carry = list(carry.values())
    rng = np.random.default_rng(0)
    worst, drift, flips = 0.0, 0.0, 0
    for _ in range(steps):
        image = rng.integers(0, 256, (contract.height, contract.width, 3), np.uint8)
        one_action, one_carry = onnx_step([np.asarray(carry[name]) for name in names], image)
        own_action, own_carry = onnx_step(own_carry, image)
        carry, action = jax_step(carry, image)
        jax_carry = [np.asarray(carry[name]) for name in names]
        if _distance(jax_carry, own_carry) > 0.5:
            own_carry = jax_carry
        else:
            drift = float(np.maximum(drift, _distance([action], [own_action])))
        if _distance(jax_carry, one_carry) > 0.5:
            flips += 1
        else:
            worst = float(np.maximum(worst, _distance([action], [one_action])))
    if not worst <= ACTION_TOLERANCE or flips > FLIP_SHARE * steps:  # a NaN fails too
        raise ValueError(f"policy.onnx: a step of it differs from JAX by up to {worst:.2g} with {flips} latent flips "
                         f"in {steps} steps; at most {ACTION_TOLERANCE} and {FLIP_SHARE:.0%} flips are rounding. "
                         "Export in float32 with a deterministic step and jax_default_matmul_precision='highest'.")
    return {"steps": steps, "max_abs_action_difference": worst, "max_abs_action_drift": drift, "latent_flips": flips}


def _distance(a: list[Any], b: list[Any]) -> float:
    """Return the largest difference of two lists of arrays; NaN where one has it."""
    differences = [np.abs(np.asarray(x, np.float64) - y).max(initial=0) for x, y in zip(a, b, strict=True)]
    return float(np.max(differences, initial=0.0))


def _describe(contract: PolicyContract, shapes: dict[str, jax.ShapeDtypeStruct], files: dict[str, str],
              vehicle_sha256: str, parity: dict[str, Any]) -> dict[str, Any]:
    """Return policy.json as a dict."""
    inputs, outputs = tensor_names(list(shapes))
    return {
        "schema": SCHEMA,
        "kind": KIND,
        "image": {"height": contract.height, "width": contract.width, "channels": 3, "encoding": "rgb8"},
        "action": {"names": ["v", "omega"], "units": ["m/s", "rad/s"],
                   "low": [float(x) for x in contract.action_low], "high": [float(x) for x in contract.action_high]},
        "rate_hz": float(contract.rate_hz),
        "action_repeat": int(contract.action_repeat),
        "carry": [{"name": name, "shape": list(shape.shape), "dtype": np.dtype(shape.dtype).name}
                  for name, shape in shapes.items()],
        "onnx": {"opset": OPSET, "inputs": inputs, "outputs": outputs},
        "camera": dict(contract.camera),
        "task": contract.task,
        "vehicle_sha256": vehicle_sha256,
        "files": files,
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "parity": parity,
    }


def _copy_vehicle(source: Path, target: Path, expected: str) -> str:
    """Copy the vehicle file and return its SHA-256."""
    data = source.read_bytes()
    digest = _sha256(data)
    if expected and expected != digest:
        raise ValueError(f"{source}: SHA-256 {digest} is not the contract's vehicle_sha256 {expected}. "
                         "Give the vehicle file that the policy was trained with.")
    target.write_bytes(data)
    return digest


def _sha256(data: bytes) -> str:
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
