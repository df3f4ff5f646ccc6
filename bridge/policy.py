"""Loads and runs the policy file: numpy and onnxruntime only, no ROS, no JAX and none of our own packages.

The file is described in docs/policy_file.md. Everything in it is checked before the first command is computed: a
policy that cannot be trusted is refused with a message that names the file, the value, the rule and the remedy.
"""

import hashlib
import io
import json
import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

SCHEMA = 1
KIND = "micromobility-policy"
MAX_FILE_BYTES = 1 << 30
"""Largest member that is read from a zip, so that a damaged directory cannot exhaust the memory."""
ONNX_DTYPES = {"tensor(float)": "float32", "tensor(double)": "float64", "tensor(float16)": "float16",
               "tensor(int32)": "int32", "tensor(int64)": "int64", "tensor(uint8)": "uint8", "tensor(uint32)": "uint32",
               "tensor(bool)": "bool"}
EXPORT_AGAIN = "Export the policy again (dreamer.export.export_policy)"


class PolicyFileError(ValueError):
    """The policy file is missing, damaged, of another version or contradicts itself."""


@dataclass(frozen=True)
class CarrySpec:
    """One entry of the recurrent state."""

    name: str
    shape: tuple[int, ...]
    dtype: str


@dataclass(frozen=True)
class Contract:
    """What `policy.json` says about image, action, rate and state."""

    height: int
    width: int
    low: tuple[float, float]
    """Command at action -1: v [m/s], omega [rad/s]."""
    high: tuple[float, float]
    """Command at action +1."""
    rate_hz: float
    action_repeat: int
    carry: tuple[CarrySpec, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    camera: Mapping[str, Any]
    task: str
    vehicle_sha256: str


class Policy:
    """A recurrent policy. `step` maps one image to one command and advances the state."""

    def __init__(self, contract: Contract, session: Any, name: str = "policy") -> None:
        self.contract = contract
        self.name = name
        self._session = session
        self._low = np.array(contract.low)
        self._span = np.array(contract.high) - self._low
        self.reset()

    @classmethod
    def load(cls, path: str | Path) -> "Policy":
        """Return the policy of a folder or zip, after checking hashes, version, shapes and one trial step.

        Raises:
            PolicyFileError: with the file, the value, the rule and the remedy.
        """
        import onnxruntime

        onnxruntime.set_default_logger_severity(3)
        path = Path(path)
        members = _read_members(path)
        contract, hashes = parse_contract(f"{path}/policy.json", members.pop("policy.json", None))
        _check_hashes(path, members, hashes, contract)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # one thread has the lower tail latency on a vehicle's shared cores
        options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            session = onnxruntime.InferenceSession(members["policy.onnx"], options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's own exception types all derive from Exception directly
            raise PolicyFileError(f"{path}/policy.onnx: onnxruntime {onnxruntime.__version__} refuses it: {error}. It "
                                  f"must hold standard operators this runtime knows. {EXPORT_AGAIN} or install a newer "
                                  "onnxruntime.") from error
        _check_session(path, contract, session)
        policy = cls(contract, session, str(path))
        trial = policy.step(np.zeros((contract.height, contract.width, 3), np.uint8))
        if not np.isfinite(trial).all():
            raise PolicyFileError(f"{path}/policy.onnx: a black image gives the command {trial}; commands must be "
                                  f"finite. {EXPORT_AGAIN} from a run whose parameters are finite.")
        policy.reset()
        return policy

    def reset(self) -> None:
        """Forget everything seen: the zero state is the start of an episode."""
        self._carry = [np.zeros(spec.shape, spec.dtype) for spec in self.contract.carry]

    def step(self, image: np.ndarray) -> np.ndarray:
        """Return the command (2,): v [m/s], omega [rad/s], for an image (H, W, 3) uint8 rgb8.

        The command is not limited here (bridge/safety.py does), and it is NaN where the action or the new state is
        not finite: a spoilt state must never hide behind a finite action.

        Raises:
            ValueError: the image has another shape or dtype than the policy was trained with.
        """
        want = (self.contract.height, self.contract.width, 3)
        if image.shape != want or image.dtype != np.uint8:
            raise ValueError(f"{self.name}: image {image.shape} {image.dtype}; the policy needs {want} uint8 rgb8. "
                             "Convert it with bridge.image.to_rgb8.")
        feed = dict(zip(self.contract.inputs, [image, *self._carry], strict=True))
        action, *self._carry = self._session.run(list(self.contract.outputs), feed)
        if not all(np.isfinite(value).all() for value in self._carry if value.dtype.kind == "f"):
            return np.full(2, np.nan)
        return self._low + self._span * (np.asarray(action, np.float64) + 1) / 2


def _read_members(path: Path) -> dict[str, bytes]:
    """Return the small files of the policy by name, from a folder or from a zip of that folder."""
    if path.is_dir():
        return {item.name: item.read_bytes() for item in path.iterdir() if item.is_file()}
    if not path.is_file():
        raise PolicyFileError(f"{path}: does not exist. A policy file is a folder, or a zip of it, with policy.json. "
                              "Correct the path.")
    try:
        with zipfile.ZipFile(path) as archive:
            members: dict[str, bytes] = {}
            for info in archive.infolist():
                name = PurePosixPath(info.filename)
                if info.is_dir() or len(name.parts) > 2:
                    continue
                if info.file_size > MAX_FILE_BYTES:
                    raise PolicyFileError(f"{path}: member {info.filename} is {info.file_size} bytes; at most "
                                          f"{MAX_FILE_BYTES} are read. {EXPORT_AGAIN}.")
                if name.name in members:
                    raise PolicyFileError(f"{path}: holds {name.name} twice; a policy zip holds one policy. "
                                          "Zip the one folder.")
                members[name.name] = archive.read(info)
            return members
    except (zipfile.BadZipFile, OSError, EOFError, NotImplementedError, RuntimeError) as error:
        raise PolicyFileError(f"{path}: cannot be read as a zip ({error}). A policy file is a folder or a zip of it. "
                              "Copy it again.") from error


def parse_contract(name: str, data: bytes | None) -> tuple[Contract, dict[str, str]]:
    """Return the contract and the SHA-256 of each file that `policy.json` lists.

    Args:
        name: the file, for messages.
        data: its content, None where it is missing.
    """
    if data is None:
        raise PolicyFileError(f"{name}: is missing. Every policy file has it. {EXPORT_AGAIN}.")
    try:
        table = json.loads(data.decode("utf-8"))
    except ValueError as error:
        raise PolicyFileError(f"{name}: is not JSON ({error}). It must be a UTF-8 JSON object. "
                              f"{EXPORT_AGAIN}.") from error
    if not isinstance(table, dict):
        raise PolicyFileError(f"{name}: holds a {type(table).__name__}; it must be a JSON object. {EXPORT_AGAIN}.")
    if table.get("schema") != SCHEMA or table.get("kind") != KIND:
        raise PolicyFileError(f"{name}: schema {table.get('schema')!r} of kind {table.get('kind')!r}; this bridge "
                              f"reads schema {SCHEMA} of kind {KIND!r}. {EXPORT_AGAIN} or use the matching bridge.")
    fields = _Fields(name, table)
    image = fields.child("image")
    action = fields.child("action")
    onnx = fields.child("onnx")
    image.rule("channels", lambda value: value == 3, "must be 3")
    image.rule("encoding", lambda value: value == "rgb8", "must be 'rgb8'")
    action.rule("names", lambda value: value == ["v", "omega"], "must be ['v', 'omega']")
    action.rule("units", lambda value: value == ["m/s", "rad/s"], "must be ['m/s', 'rad/s']")
    low = action.rule("low", _is_pair, "must be two finite numbers")
    high = action.rule("high", lambda value: _is_pair(value) and all(a < b for a, b in zip(low, value, strict=True)),
                       f"must be two finite numbers above low = {low}")
    entries = fields.rule("carry", lambda value: isinstance(value, list), "must be a list")
    carry = tuple(_parse_carry(_Fields(f"{name} carry[{i}]", entry)) for i, entry in enumerate(entries))
    tensors = [onnx.rule(key, _is_names(1 + len(carry)), f"must be {1 + len(carry)} different names")
               for key in ("inputs", "outputs")]
    hashes = fields.rule("files", _is_hashes, "must give the SHA-256 of plain file names, policy.onnx among them")
    contract = Contract(
        height=image.rule("height", _is_size, "must be an integer from 1 to 4096"),
        width=image.rule("width", _is_size, "must be an integer from 1 to 4096"),
        low=(float(low[0]), float(low[1])), high=(float(high[0]), float(high[1])),
        rate_hz=float(fields.rule("rate_hz", lambda value: _is_number(value) and 0 < value <= 1000,
                                  "must be above 0 and at most 1000")),
        action_repeat=fields.rule("action_repeat", lambda value: _is_integer(value) and 1 <= value <= 100,
                                  "must be an integer from 1 to 100"),
        carry=carry, inputs=tuple(tensors[0]), outputs=tuple(tensors[1]),
        camera=fields.rule("camera", lambda value: isinstance(value, dict), "must be an object"),
        task=fields.rule("task", lambda value: isinstance(value, str), "must be text"),
        vehicle_sha256=fields.rule("vehicle_sha256", lambda value: isinstance(value, str), "must be text"),
    )
    return contract, hashes


class _Fields:
    """A JSON object whose fields are read together with their rule."""

    def __init__(self, name: str, table: Any) -> None:
        self.name, self.table = name, table
        if not isinstance(table, dict):
            raise PolicyFileError(f"{name}: is {table!r}; it must be a JSON object. {EXPORT_AGAIN}.")

    def child(self, key: str) -> "_Fields":
        return _Fields(f"{self.name} {key}", self.table.get(key))

    def rule(self, key: str, holds: Any, text: str) -> Any:
        value = self.table.get(key)
        if not holds(value):
            raise PolicyFileError(f"{self.name}: {key} = {value!r}, but it {text}. {EXPORT_AGAIN}.")
        return value


def _parse_carry(entry: _Fields) -> CarrySpec:
    shape = entry.rule("shape", lambda value: isinstance(value, list) and len(value) <= 8
                       and all(_is_integer(n) and 1 <= n <= 1 << 24 for n in value) and math.prod(value) <= 1 << 26,
                       "must be a list of positive integers")
    return CarrySpec(
        name=entry.rule("name", lambda value: isinstance(value, str) and value, "must be text"),
        shape=tuple(shape),
        dtype=entry.rule("dtype", lambda value: value in ONNX_DTYPES.values(),
                         f"must be one of {list(ONNX_DTYPES.values())}"),
    )


def _is_integer(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _is_pair(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(_is_number(x) for x in value)


def _is_size(value: Any) -> bool:
    return _is_integer(value) and 1 <= value <= 4096


def _is_names(count: int) -> Any:
    return lambda value: (isinstance(value, list) and all(isinstance(x, str) and x for x in value)
                          and len(value) == len(set(value)) == count)


def _is_hashes(value: Any) -> bool:
    return (isinstance(value, dict) and "policy.onnx" in value
            and all(isinstance(digest, str) and "/" not in name and "\\" not in name and name not in ("", ".", "..")
                    for name, digest in value.items()))


def _check_hashes(path: Path, members: dict[str, bytes], hashes: dict[str, str], contract: Contract) -> None:
    """Raise where a file is missing, is not the one that was exported, or is not what its name says."""
    for name, want in hashes.items():
        if name not in members:
            raise PolicyFileError(f"{path}/{name}: is missing, but policy.json lists it with SHA-256 {want}. All "
                                  "listed files must be there. Copy the whole policy file again.")
        got = hashlib.sha256(members[name]).hexdigest()
        if got != want:
            raise PolicyFileError(f"{path}/{name}: SHA-256 {got}, but policy.json says {want}. The file was damaged or "
                                  "changed after the export. Copy the policy file again.")
    vehicle = hashes.get("vehicle.toml", contract.vehicle_sha256)
    if vehicle != contract.vehicle_sha256:
        raise PolicyFileError(f"{path}/vehicle.toml: SHA-256 {vehicle}, but the policy was trained with the vehicle of "
                              f"vehicle_sha256 {contract.vehicle_sha256!r}. Both must agree. {EXPORT_AGAIN}.")
    if "weights.npz" in hashes:
        try:
            with np.load(io.BytesIO(members["weights.npz"]), allow_pickle=False) as weights:
                weights.files  # noqa: B018  (opening reads the directory, which is the check)
        except (ValueError, OSError, zipfile.BadZipFile) as error:
            raise PolicyFileError(f"{path}/weights.npz: is not a numpy archive ({error}). {EXPORT_AGAIN}.") from error


def _check_session(path: Path, contract: Contract, session: Any) -> None:
    """Raise where the ONNX network has other inputs or outputs than the contract says."""
    image = CarrySpec("image", (contract.height, contract.width, 3), "uint8")
    action = CarrySpec("action", (2,), "float32")
    for kind, names, first, tensors in (("input", contract.inputs, image, session.get_inputs()),
                                        ("output", contract.outputs, action, session.get_outputs())):
        want = {name: (spec.shape, spec.dtype) for name, spec in zip(names, (first, *contract.carry), strict=True)}
        got = {tensor.name: (tuple(tensor.shape), ONNX_DTYPES.get(tensor.type, tensor.type)) for tensor in tensors}
        if got != want:
            raise PolicyFileError(f"{path}/policy.onnx: {kind}s {got}, but policy.json says {want}. Both must agree. "
                                  f"{EXPORT_AGAIN}.")
