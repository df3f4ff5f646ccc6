"""A trained agent to act with: `Policy.load(path).step(obs, carry)` is the whole interface.

    policy, carry = Policy.load("runs/mine/policy"), None
    action, carry = policy.step(obs, carry)      # carry None begins an episode

A folder, or a zip of it, holds `policy.json` (sizes, observations, actions) and `weights.npz` (plain arrays); nothing
in it can execute code. What `dreamer.policy_files.export` wrote, agents and the policy files of vehicles
(docs/policy_file.md), is read as well and runs in onnxruntime. All kinds are read and checked by `bridge.policy`.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np

from bridge.policy import (
    EXPORT_AGAIN,
    SCHEMA,
    AgentContract,
    CheckedPolicy,
    Contract,
    Fields,
    Parts,
    PolicyFileError,
    check_kind,
    make_session,
    parse_hashes,
    parse_observation,
    read_arrays,
    read_policy,
)
from dreamer import spaces
from dreamer.config import DreamerConfig
from dreamer.layers import sensors
from dreamer.model import agent
from dreamer.policy_files import export
from dreamer.spaces import ActionSpec, Box, Discrete, ObsShape
from dreamer.types import Params

KIND = "dreamer-policy"
"""A policy as its parameters, which JAX runs."""
WIDTHS = ("deter", "hidden", "units", "stoch", "classes", "blocks", "depth", "kernel", "patch", "patch_units", "bins")
"""Settings that are sizes of arrays, so at least 1."""


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
        """The policy in a folder, or a zip of it, that `save`, `export_agent` or `export_policy` wrote.

        Raises:
            PolicyFileError: no policy, a damaged one or one of another version; names the file, the field, the value,
                the rule and the remedy.
        """
        with Parts(path) as parts:
            name = parts.name("policy.json")
            table = parts.table()
            if check_kind(name, table, (KIND, export.KIND, export.AGENT_KIND)) == KIND:
                return _load_parameters(parts, name, table)
        checked = read_policy(path, (export.KIND, export.AGENT_KIND))
        return _of_agent_file(checked) if isinstance(checked.contract, AgentContract) else _of_vehicle_file(checked)

    def step(self, obs: Any, carry: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """The most probable action for an observation, and the state to hand in with the next one.

        Args:
            obs: arrays of one instance, as the environment shows them.
            carry: from the previous step; None begins an episode.

        Returns:
            Action: (A,) in [-1, 1], a class () int32, or of a vehicle's file the command in its units.

        Raises:
            ValueError: an observation of another shape or type than the policy was trained with, or one that is not
                finite.
        """
        wanted = jax.eval_shape(lambda: spaces.zeros(self.obs_shape))
        found = jax.tree.map(lambda x: jax.ShapeDtypeStruct(np.shape(x), np.asarray(x).dtype), obs)
        if found != wanted:
            raise ValueError(f"the observation is {found}; the policy was trained with {wanted}. Convert it.")
        for path, value in jax.tree_util.tree_flatten_with_path(obs)[0]:
            if not np.isfinite(value).all():
                raise ValueError(f"the observation{jax.tree_util.keystr(path)} is not finite ({value}). Give numbers, "
                                 "or stop the vehicle where a sensor has none.")
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
        export.save_arrays(folder / "weights.npz", export.flatten_weights(params))
        table["files"] = {"weights.npz": export.sha256((folder / "weights.npz").read_bytes())}
        (folder / "policy.json").write_text(json.dumps(table, indent=2) + "\n")
        folder.chmod(0o755)
        export.replace_folder(folder, path)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return path


def _load_parameters(parts: Parts, name: str, table: dict[str, Any]) -> Policy:
    """A policy that `save` wrote. Files of earlier versions list no hash."""
    fields = Fields(name, table)
    config, obs_shape = _parse_config(fields.child("config")), parse_observation(fields)
    action = fields.child("action")
    kind = action.rule("kind", lambda value: value in ("box", "discrete"), "must be 'box' or 'discrete'")
    size = action.rule("size", lambda value: _is_whole(value) and 1 <= value <= 65536, "must be from 1 to 65536")
    spec = Discrete(size) if kind == "discrete" else Box(size)
    weights = parts.name("weights.npz")
    if "files" in table:
        data = parts.checked("weights.npz", parse_hashes(name, table, "weights.npz")["weights.npz"], keep=True)
    else:
        _, data = parts.take("weights.npz", keep=True)
    params = _nest(read_arrays(weights, data), weights)
    try:  # a step on shapes alone: nothing of a size that the weights do not have is ever allocated
        shapes = jax.tree.map(lambda array: jax.ShapeDtypeStruct(array.shape, jnp.float32), params)
        actions = spaces.actions(spec)
        obs = jax.eval_shape(lambda: sensors.visible(config, spaces.zeros(obs_shape)))
        carry = jax.eval_shape(lambda: agent.policy_carry(config, actions))
        after, _ = jax.eval_shape(lambda *values: agent.policy_step(config, *values), shapes, carry, obs)
        fits = jax.tree.map(lambda x: x.shape, after) == jax.tree.map(lambda x: x.shape, carry)
        problem = "" if fits else "its state changes its shape"
    except Exception as error:  # whatever JAX says of arrays that do not fit, or a parameter that is missing
        problem = f"{type(error).__name__}: {str(error)[:200]}"
    if problem:
        raise PolicyFileError(f"{weights}: its arrays are not those of the config in policy.json ({problem}). Both "
                              f"must agree. {EXPORT_AGAIN}.")
    return of_agent(config, params, obs_shape, spec)


def _parse_config(fields: Fields) -> DreamerConfig:
    """Settings of an agent; those that a file of an earlier version lacks have their defaults."""
    known = {field.name: field.default for field in dataclasses.fields(DreamerConfig)}
    types = get_type_hints(DreamerConfig)
    numbers: dict[str, Any] = {}
    for key in fields.table:
        if key not in known:
            raise PolicyFileError(f"{fields.name}: {key!r} is no setting of this version. The settings are those of "
                                  "dreamer.config.DreamerConfig. Use a newer version of this program, or remove it.")
        default, choices = known[key], get_args(types[key]) if get_origin(types[key]) is Literal else ()
        value = fields.rule(key, functools.partial(_is_like, default), f"must be of the kind of {default!r}")
        if choices and value not in choices:
            fields.rule(key, lambda value: False, f"must be one of {list(choices)}")
        if key in WIDTHS or key == "mults":
            fields.rule(key, lambda value: min(np.ravel(value), default=0) >= 1, "must be at least 1")
        numbers[key] = tuple(value) if isinstance(value, list) else value
    try:
        return DreamerConfig(**numbers)
    except ValueError as error:
        raise PolicyFileError(f"{fields.name}: {error} {EXPORT_AGAIN}.") from error


def _is_like(default: Any, value: Any) -> bool:
    """Whether a value of JSON may take the place of a setting's default."""
    if isinstance(default, tuple):
        like = default[0] if default else ""
        return isinstance(value, list) and len(value) <= 64 and all(_is_like(like, item) for item in value)
    if isinstance(default, int) and not isinstance(default, bool):
        return _is_whole(value) and 0 <= value <= 1e12
    if isinstance(default, float):
        return isinstance(value, int | float) and not isinstance(value, bool)
    return isinstance(value, type(default))


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _nest(flat: dict[str, np.ndarray], name: str) -> Params:
    """{"a/b": x} -> {"a": {"b": x}}."""
    tree: Params = {}
    for key, value in flat.items():
        *parents, last = key.split("/")
        branch = tree
        for parent in parents:
            branch = branch.setdefault(parent, {})
            if not isinstance(branch, dict):
                raise PolicyFileError(f"{name}: {key!r} lies in {parent!r}, which is an array itself. {EXPORT_AGAIN}.")
        branch[last] = value
    return tree


def _of_agent_file(checked: CheckedPolicy) -> Policy:
    """What `export_agent` wrote."""
    contract, session = checked.contract, make_session(checked)
    assert isinstance(contract, AgentContract)
    state = [entry.name for entry in contract.carry]
    after = len(contract.outputs) - len(state)

    def call(carry: dict[str, Any], obs: Any) -> tuple[dict[str, Any], Any]:
        named = obs if isinstance(obs, dict) else {export.SINGLE: obs}
        arrays = {**named, **{f"carry_{name}": carry[name] for name in state}}
        results = session.run(list(contract.outputs), {name: np.asarray(arrays[name]) for name in contract.inputs})
        return dict(zip(state, results[after:], strict=True)), results[0]

    return Policy(contract.observation, _zero_carry(contract), call)


def _of_vehicle_file(checked: CheckedPolicy) -> Policy:
    """A vehicle's policy file."""
    contract, session = checked.contract, make_session(checked)
    assert isinstance(contract, Contract)
    names = [entry.name for entry in contract.carry]
    low, high = np.asarray(contract.low), np.asarray(contract.high)

    def call(carry: dict[str, Any], obs: Any) -> tuple[dict[str, Any], Any]:
        feed = dict(zip(contract.inputs, [np.asarray(obs), *(np.asarray(carry[name]) for name in names)], strict=True))
        action, *values = session.run(list(contract.outputs), feed)
        return dict(zip(names, values, strict=True)), low + (high - low) * (np.asarray(action, np.float64) + 1) / 2

    return Policy((contract.height, contract.width, 3), _zero_carry(contract), call)


def _zero_carry(contract: Contract | AgentContract) -> dict[str, np.ndarray]:
    return {entry.name: np.zeros(entry.shape, entry.dtype) for entry in contract.carry}
