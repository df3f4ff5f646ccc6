"""Reads an exported policy file (docs/policy_file.md) as a JAX function of one instance, for evaluation in batches."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

SCHEMA, KIND = 1, "micromobility-policy"
RUNTIMES = ("jax", "onnxruntime")
RUN_FILE = "run.json"
"""In the folder of a training, beside the policies that it exports: its command and its preset, task included."""
EXPORT_AGAIN = "Export the policy again"


@dataclass(frozen=True, eq=False)
class PolicyFile:
    """A policy and what it was trained for."""

    path: Path
    task: str
    low: tuple[float, float]
    """Command at action -1: v [m/s], omega [rad/s]."""
    high: tuple[float, float]
    height: int
    width: int
    rate_hz: float
    action_repeat: int
    sha256: str
    """Of the network."""
    vehicle: Path | None
    """Vehicle file it was trained with, if it is inside."""
    carry: dict[str, jax.ShapeDtypeStruct]
    step: Callable[[dict[str, jax.Array], jax.Array], tuple[dict[str, jax.Array], jax.Array]]
    """(carry, image (H, W, 3) uint8) -> carry, action (2,); traceable, and so is its vmap."""

    def start(self) -> dict[str, jax.Array]:
        """Recurrent state at the start of an episode: all zeros."""
        return {name: jnp.zeros(spec.shape, spec.dtype) for name, spec in self.carry.items()}


def load_policy(path: str | Path, runtime: str = "jax") -> PolicyFile:
    """Policy of a folder.

    Args:
        path: folder that holds policy.json and policy.onnx.
        runtime: "jax" compiles the network with everything else; "onnxruntime" calls it on the host for one instance
            after the other: slow, but it is what runs on the vehicle.

    Raises:
        ValueError: a part is missing, damaged or of another version; names file, value, rule and remedy.
    """
    path = Path(path)
    if runtime not in RUNTIMES:
        raise ValueError(f"unknown runtime {runtime!r}; use one of {RUNTIMES}.")
    table = _read_table(path)
    names = [entry["name"] for entry in table["carry"]]
    carry = {
        entry["name"]: jax.ShapeDtypeStruct(tuple(entry["shape"]), np.dtype(entry["dtype"])) for entry in table["carry"]
    }
    data = (path / "policy.onnx").read_bytes()
    make = _jax_network if runtime == "jax" else _host_network
    run = make(data, table["onnx"], carry, str(path / "policy.onnx"))

    def step(state: dict[str, jax.Array], image: jax.Array) -> tuple[dict[str, jax.Array], jax.Array]:
        action, *values = run(image, *(state[name] for name in names))
        after = {name: value.astype(carry[name].dtype) for name, value in zip(names, values, strict=True)}
        return after, action

    image, action = table["image"], table["action"]
    vehicle = path / "vehicle.toml"
    return PolicyFile(
        path=path, task=table["task"], low=tuple(action["low"]), high=tuple(action["high"]), height=image["height"],
        width=image["width"], rate_hz=float(table["rate_hz"]), action_repeat=int(table["action_repeat"]),
        sha256=table["files"]["policy.onnx"], vehicle=vehicle if vehicle.is_file() else None, carry=carry, step=step,
    )  # fmt: skip


def _read_table(path: Path) -> dict[str, Any]:
    """policy.json, checked against the files beside it."""
    file = path / "policy.json"
    if not file.is_file():
        raise ValueError(f"{file}: does not exist. A policy is a folder that holds policy.json; unpack a zip first.")
    try:
        table = json.loads(file.read_text())
        version = (table.get("schema"), table.get("kind"))
    except (ValueError, AttributeError) as error:
        raise ValueError(f"{file}: is not a JSON table ({error}). {EXPORT_AGAIN}.") from error
    if version != (SCHEMA, KIND):
        raise ValueError(f"{file}: schema and kind are {version}; this version reads {(SCHEMA, KIND)}. {EXPORT_AGAIN}.")
    missing = {"image", "action", "rate_hz", "action_repeat", "carry", "onnx", "task", "files"} - set(table)
    if missing:
        raise ValueError(f"{file}: no field {sorted(missing)[0]!r}; the contract needs it. {EXPORT_AGAIN}.")
    for name, wanted in table["files"].items():
        if Path(name).name != name or not (path / name).is_file():
            raise ValueError(f"{path / name}: is missing, but policy.json lists it. Copy the whole folder again.")
        found = hashlib.sha256((path / name).read_bytes()).hexdigest()
        if found != wanted:
            raise ValueError(f"{path / name}: SHA-256 is {found}, but policy.json says {wanted}: the file was damaged "
                             "or changed. Copy the whole folder again.")
    return table


def _jax_network(data: bytes, names: dict[str, Any], carry: dict[str, Any], file: str) -> Callable:
    from whill_mjx.evaluation.onnx_network import Network

    network = Network(data, file)
    if (network.inputs, network.outputs) != (list(names["inputs"]), list(names["outputs"])):
        raise ValueError(f"{file}: tensors {network.inputs} -> {network.outputs}, but policy.json says {names}. "
                         f"{EXPORT_AGAIN}.")
    return network


def _host_network(data: bytes, names: dict[str, Any], carry: dict[str, Any], file: str) -> Callable:
    import onnxruntime

    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    shapes = (jax.ShapeDtypeStruct((2,), jnp.float32), *carry.values())

    def on_host(*values: Any) -> tuple[np.ndarray, ...]:
        feed = {name: np.asarray(value) for name, value in zip(names["inputs"], values, strict=True)}
        return tuple(session.run(list(names["outputs"]), feed))

    return lambda *values: jax.pure_callback(on_host, shapes, *values, vmap_method="sequential")
