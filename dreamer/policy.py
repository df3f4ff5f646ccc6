"""A trained agent to act with: `Policy.load(path).step(obs, carry)` is the whole interface.

    policy, carry = Policy.load("runs/mine/policy"), None
    action, carry = policy.step(obs, carry)      # carry None begins an episode

A folder holds `policy.json` (sizes, observations, actions) and `weights.npz` (plain arrays); nothing in it can execute
code. What `dreamer.export` wrote, agents and the policy files of vehicles (docs/policy_file.md), is read as well and
runs in onnxruntime.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dreamer import agent, export, sensors, spaces
from dreamer.config import DreamerConfig
from dreamer.spaces import ActionSpec, Box, Discrete, ObsShape
from dreamer.types import Params

KIND = "dreamer-policy"
SCHEMA = 1


@dataclasses.dataclass(frozen=True)
class Policy:
    """A recurrent policy of one instance."""

    obs_shape: ObsShape
    """Of one observation: (H, W, C) uint8, (D,) float32 or a dict of them."""
    zero_carry: dict[str, np.ndarray]
    """State at the start of an episode."""
    call: Callable[[dict[str, Any], Any], tuple[dict[str, Any], Any]]
    """(carry, obs) -> (carry, action)."""

    @classmethod
    def load(cls, path: str | Path) -> Policy:
        """The policy in a folder that `save`, `export_agent` or `export_policy` wrote.

        Raises:
            ValueError: no policy, or one of another version; names the file, the rule and the remedy.
        """
        path = Path(path)
        table = _read_table(path)
        if table["kind"] == export.KIND:
            return _load_exported(path, table)
        shape = table["observation"]
        obs_shape = {k: tuple(v) for k, v in shape.items()} if isinstance(shape, dict) else tuple(shape)
        if table["kind"] == export.AGENT_KIND:
            return _load_agent(path, table, obs_shape)
        numbers: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in table["config"].items()}
        config = DreamerConfig(**numbers)
        with np.load(path / "weights.npz", allow_pickle=False) as arrays:
            params = _nest({name: jnp.asarray(arrays[name]) for name in arrays.files})
        kinds: dict[str, type[Box] | type[Discrete]] = {"box": Box, "discrete": Discrete}
        action = kinds[table["action"]["kind"]](table["action"]["size"])
        return of_agent(config, params, obs_shape, action)

    def step(self, obs: Any, carry: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """The most probable action for an observation, and the state to hand in with the next one.

        Args:
            obs: arrays of one instance, as the environment shows them.
            carry: from the previous step; None begins an episode.

        Returns:
            Action: (A,) in [-1, 1], a class () int32, or of a vehicle's file the command in its units.

        Raises:
            ValueError: an observation of another shape or type than the policy was trained with.
        """
        wanted = jax.eval_shape(lambda: spaces.zeros(self.obs_shape))
        found = jax.tree.map(lambda x: jax.ShapeDtypeStruct(np.shape(x), np.asarray(x).dtype), obs)
        if found != wanted:
            raise ValueError(f"the observation is {found}; the policy was trained with {wanted}. Convert it.")
        carry, action = self.call(self.zero_carry if carry is None else carry, obs)
        return np.asarray(action), carry


def of_agent(config: DreamerConfig, params: Params, obs_shape: ObsShape, action_dim: ActionSpec) -> Policy:
    """The policy of a trained agent, in memory."""
    actions = spaces.actions(action_dim)
    params = jax.tree.map(jnp.asarray, params)

    @jax.jit
    def call(carry: dict[str, jax.Array], obs: Any) -> tuple[dict[str, jax.Array], jax.Array]:
        carry, action = agent.policy_step(config, params, carry, obs)
        return carry, actions.to_env(action)

    zero = {name: np.asarray(value) for name, value in agent.policy_carry(config, actions).items()}
    return Policy(sensors.visible(config, obs_shape), zero, call)


def save(
    path: str | Path, config: DreamerConfig, params: Params, obs_shape: ObsShape, action_dim: ActionSpec
) -> Path:
    """Write the folder that `Policy.load` reads, whole or not at all, and return it.

    Args:
        path: folder; one that holds such a policy is replaced.
        config: sizes of the agent.
        params: of the agent.
        obs_shape: as the environment declares it.
        action_dim: as the environment declares it.
    """
    path = Path(path)
    actions = spaces.actions(action_dim)
    shape = {name: list(one) for name, one in obs_shape.items()} if isinstance(obs_shape, dict) else list(obs_shape)
    table = {
        "schema": SCHEMA,
        "kind": KIND,
        "config": dataclasses.asdict(config),
        "observation": shape,
        "action": {"kind": type(actions).__name__.lower(), "size": actions.width},
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        (folder / "policy.json").write_text(json.dumps(table, indent=2) + "\n")
        export.save_arrays(folder / "weights.npz", export.flatten_weights(params))
        folder.chmod(0o755)
        export.replace_folder(folder, path)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return path


def _read_table(path: Path) -> dict[str, Any]:
    name = path / "policy.json"
    try:
        table = json.loads(name.read_text())
        known = ((KIND, SCHEMA), (export.KIND, export.SCHEMA), (export.AGENT_KIND, export.SCHEMA))
        if (table["kind"], table["schema"]) in known:
            return table
        problem = f"kind {table['kind']!r}, schema {table['schema']} is not known here"
    except (OSError, ValueError, KeyError, TypeError) as error:
        problem = f"not readable as a policy's description ({error!r})"
    raise ValueError(f"{name}: {problem}. Give the folder that dreamer.policy.save, export_agent or export_policy "
                     "wrote.")


def _nest(flat: dict[str, Any]) -> Params:
    """{"a/b": x} -> {"a": {"b": x}}."""
    tree: Params = {}
    for name, value in flat.items():
        *parents, last = name.split("/")
        branch = tree
        for parent in parents:
            branch = branch.setdefault(parent, {})
        branch[last] = value
    return tree


def _load_agent(path: Path, table: dict[str, Any], obs_shape: ObsShape) -> Policy:
    """What `export_agent` wrote, after a check of its files."""
    import onnxruntime

    for name, wanted in table["files"].items():
        if not (path / name).is_file() or export.sha256((path / name).read_bytes()) != wanted:
            raise ValueError(f"{path / name}: missing, or its SHA-256 is not the one in policy.json ({wanted}). Copy "
                             "or export the policy again.")
    session = onnxruntime.InferenceSession(str(path / "policy.onnx"), providers=["CPUExecutionProvider"])
    state = [entry["name"] for entry in table["carry"]]
    inputs, outputs = table["onnx"]["inputs"], table["onnx"]["outputs"]
    after = len(outputs) - len(state)

    def call(carry: dict[str, Any], obs: Any) -> tuple[dict[str, Any], Any]:
        named = obs if isinstance(obs, dict) else {export.SINGLE: obs}
        arrays = {**named, **{f"carry_{name}": carry[name] for name in state}}
        results = session.run(outputs, {name: np.asarray(arrays[name]) for name in inputs})
        return dict(zip(state, results[after:], strict=True)), results[0]

    return Policy(obs_shape, _zero_carry(table), call)


def _zero_carry(table: dict[str, Any]) -> dict[str, np.ndarray]:
    return {entry["name"]: np.zeros(entry["shape"], entry["dtype"]) for entry in table["carry"]}


def _load_exported(path: Path, table: dict[str, Any]) -> Policy:
    """A vehicle's policy file. Its hashes are checked by the bridge, not here."""
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path / "policy.onnx"), providers=["CPUExecutionProvider"])
    names = [entry["name"] for entry in table["carry"]]
    inputs, outputs = table["onnx"]["inputs"], table["onnx"]["outputs"]
    low, high = (np.asarray(table["action"][name]) for name in ("low", "high"))

    def call(carry: dict[str, Any], obs: Any) -> tuple[dict[str, Any], Any]:
        feed = dict(zip(inputs, [np.asarray(obs), *(np.asarray(carry[name]) for name in names)], strict=True))
        action, *values = session.run(outputs, feed)
        return dict(zip(names, values, strict=True)), low + (high - low) * (np.asarray(action, np.float64) + 1) / 2

    image = table["image"]
    return Policy((image["height"], image["width"], image["channels"]), _zero_carry(table), call)
