"""Reads a checked policy file and runs it on a vehicle, one image after the other."""

import ctypes
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bridge.policy.contract import (
    AGENT_KIND,
    KIND,
    SURPRISE,
    AgentContract,
    Contract,
    check_kind,
    parse_agent,
    parse_contract,
    parse_hashes,
)
from bridge.policy.network import Arrays, Network, build
from bridge.policy.parts import COPY_AGAIN, EXPORT_AGAIN, TABLE, Parts, PolicyFileError
from bridge.policy.sensors import SHAPES, SensorInput, pacer_of
from bridge.policy.trial import Trial

ZIP_STARTS = (b"PK\x03\x04", b"PK\x05\x06")
"""First bytes of a zip, with members and without, by which numpy recognises an archive."""
OPTIONAL = ("weights.npz",)
"""Listed files that may be missing: no vehicle needs the archive of the weights, the largest part."""


@dataclass(frozen=True)
class CheckedPolicy:
    """An exported policy of which every part was checked."""

    path: str
    """Folder or zip that it was read from."""
    contract: Contract | AgentContract
    """What `policy.json` says."""
    files: Mapping[str, str]
    """SHA-256 of each listed file."""
    network: bytes
    """Serialised ONNX model."""
    vehicle: bytes | None
    """Vehicle file it was trained with, if it is inside."""


def read_policy(path: str | Path, kinds: tuple[str, ...] = (KIND,)) -> CheckedPolicy:
    """Read a policy of a folder or zip, after checking contract, hashes, network and one trial step.

    Args:
        path: folder or zip.
        kinds: kinds that are accepted, of `KIND` and `AGENT_KIND`.

    Raises:
        PolicyFileError: with the file, the field, the value, the rule and the remedy.
    """
    with Parts(path) as parts:
        name = parts.name(TABLE)
        table = parts.table()
        kind = check_kind(name, table, kinds)
        contract = parse_agent(name, table) if kind == AGENT_KIND else parse_contract(name, table)
        hashes = parse_hashes(name, table)
        if isinstance(contract, Contract):
            _check_vehicle(parts, hashes, contract)
        kept = {part: parts.checked(part, want, keep=part in ("policy.onnx", "vehicle.toml"))
                for part, want in hashes.items() if part not in OPTIONAL}
        with Trial() as trial:  # its process starts while the large archive is read
            _check_archive(parts, hashes)
            import onnxruntime  # noqa: F401  (meanwhile: `build` needs it)

            trial.run(parts.name("policy.onnx"), kept["policy.onnx"], *contract.tensors())
    return CheckedPolicy(str(path), contract, hashes, kept["policy.onnx"], kept.get("vehicle.toml"))


def make_session(policy: CheckedPolicy) -> Any:
    """Build the onnxruntime session of a checked policy, whole; the trial has already built it once."""
    return build(policy.network)


class Policy:
    """A recurrent policy of a vehicle. `step` maps what its sensors show to one command and advances the state."""

    def __init__(self, contract: Contract | AgentContract, network: bytes, name: str = "policy",
                 threads: int = 1) -> None:
        """Build a policy from its ONNX model; its contract says what its actions and observations are."""
        commands, pacer = contract.commands, pacer_of(contract.sensors)
        assert commands is not None and pacer is not None
        self.contract, self.commands, self.sensors, self.name = contract, commands, contract.sensors, name
        self.pacer: SensorInput = pacer
        """The sensor whose messages make a step."""
        self._low = np.array(commands.low)
        self._span = np.array(commands.high) - self._low
        inputs, _ = contract.tensors()
        agent = isinstance(contract, AgentContract)
        self._state_names = [f"carry_{one.name}" for one in contract.carry] if agent else list(contract.inputs[1:])
        self._inputs = {one.name: one for one in inputs if one.name not in self._state_names}
        self._alone = next(iter(self._inputs)) if len(self._inputs) == 1 else ""
        self._network = Network(network, self._inputs, threads)
        self._begin: Arrays | None = None  # of the zero state
        self.reset()
        self.prepare()
        self._begin = self._early

    @classmethod
    def load(cls, path: str | Path, threads: int = 1) -> "Policy":
        """Return the policy of a folder or zip, after checking hashes, version, shapes and one trial step.

        Args:
            path: folder or zip.
            threads: on which a step is computed. Two take less time where no other process wants the cores; where
                one does, the step waits for the slower of both.

        Raises:
            PolicyFileError: with the file, the field, the value, the rule and the remedy.
        """
        checked = read_policy(path, (KIND, AGENT_KIND))
        contract = checked.contract
        _check_drives(f"{path}/{TABLE}", contract)
        policy = cls(contract, checked.network, str(path), threads)
        del checked
        _give_back_memory()
        policy.step(policy.zeros())  # the first step takes longest
        policy.reset()
        return policy

    def reset(self) -> None:
        """Forget everything seen: the zero state is the start of an episode."""
        self._carry = [np.zeros(spec.shape, spec.dtype) for spec in self.contract.carry]
        self._early = self._begin

    def prepare(self) -> None:
        """Compute what of the next step no observation changes; to be called when there is time, after a step."""
        if self._early is None:
            self._early = self._network.early(self._state())

    def _state(self) -> dict[str, np.ndarray]:
        return dict(zip(self._state_names, self._carry, strict=True))

    def zeros(self) -> dict[str, np.ndarray]:
        """Return zeros [-] of the shape (...) of each observation, by the names of the network's inputs."""
        return {name: np.zeros(one.shape, one.dtype) for name, one in self._inputs.items()}

    def step(self, seen: np.ndarray | Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the command (2,): v [m/s], omega [rad/s], for an image (H, W, 3) uint8 rgb8, or observations by name.

        The command is not limited here (`bridge/safeguards/safety.py` does), and it is NaN where the action or the new
        state is not finite: a spoilt state must never hide behind a finite action.

        Raises:
            ValueError: an observation is missing or has another shape or dtype than the policy was trained with.
        """
        given: dict[str, Any] = {self._alone: seen} if isinstance(seen, np.ndarray) else dict(seen)
        for name, want in self._inputs.items():
            value = given.get(name)
            if value is None or value.shape != want.shape or value.dtype != want.dtype:
                found = "none" if value is None else f"{value.shape} {value.dtype}"
                raise ValueError(f"{self.name}: {name} is {found}; the policy needs {want.shape} {want.dtype}. Convert "
                                 "it (an image: bridge.sensing.image.to_rgb8).")
        self.prepare()
        assert self._early is not None
        results = self._network.late({name: given[name] for name in self._inputs}, self._state(), self._early)
        action, *self._carry = (results[name] for name in self.contract.outputs)
        self._early = None
        if not all(np.isfinite(value).all() for value in self._carry if value.dtype.kind == "f"):
            return np.full(2, np.nan)
        return self._low + self._span * (np.asarray(action, np.float64) + 1) / 2

    @property
    def novelty(self) -> float:
        """How far what the policy lately believed contradicts itself [m]; NaN where its file has no score.

        It is the carry "surprise": a running mean of how far the goal that it believes in jumps. In older files it is
        a divergence [nat].
        """
        for spec, value in zip(self.contract.carry, self._carry, strict=True):
            if spec.name == SURPRISE:
                return float(np.mean(value))
        return float("nan")


def _give_back_memory() -> None:
    """Return to the system what reading the files took: glibc keeps freed memory, more than the policy needs."""
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)


def _check_drives(name: str, contract: Contract | AgentContract) -> None:
    """Raise where a policy drives no vehicle, or by what no vehicle of the bridge measures."""
    if contract.commands is None:
        raise PolicyFileError(f"{name}: the agent drives no vehicle: its action has no low and high of v and omega. "
                              "Run it with dreamer.policy.")
    if not contract.sensors:
        names = contract.inputs[: len(contract.inputs) - len(contract.carry)]
        raise PolicyFileError(f"{name}: has no field sensors, which says what measures {', '.join(sorted(names))}. "
                              f"{EXPORT_AGAIN}.")
    for one in contract.sensors.values():
        if one.kind not in SHAPES:
            raise PolicyFileError(f"{name}: sensors {one.name}: kind = {one.kind!r}, which no vehicle of this bridge "
                                  f"measures (it reads {', '.join(SHAPES)}). Train with those.")
    if pacer_of(contract.sensors) is None:
        raise PolicyFileError(f"{name}: sensors = {sorted(contract.sensors)}: none of them gives a policy its pace. "
                              "Train with a camera, a lidar or odometry too.")


def _check_archive(parts: Parts, hashes: Mapping[str, str]) -> None:
    """Raise where the archive of the weights is there, and is another than the exported one or no archive at all."""
    for part in OPTIONAL:
        if part in hashes and parts.has(part):
            start = parts.checked(part, hashes[part])
            if start not in ZIP_STARTS:
                raise PolicyFileError(f"{parts.name(part)}: is not a numpy archive (begins with {start!r}). It must "
                                      f"hold plain arrays. {EXPORT_AGAIN}.")


def _check_vehicle(parts: Parts, hashes: Mapping[str, str], contract: Contract) -> None:
    """Raise where the vehicle file beside the policy is not that of its training."""
    digest = hashes.get("vehicle.toml", contract.vehicle_sha256)
    if digest != contract.vehicle_sha256:
        raise PolicyFileError(f"{parts.name('vehicle.toml')}: SHA-256 {digest}, but the policy was trained with the "
                              f"vehicle of vehicle_sha256 {contract.vehicle_sha256!r}. Both must agree. "
                              f"{COPY_AGAIN}.")
