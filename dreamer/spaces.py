"""Shapes of observations, and kinds of actions.

An observation is one array or a dict of arrays, and its rank says what it is: (H, W, C) is an image of bytes, (D,) a
vector of floats. A depth image or a LiDAR scan is either. An action is a point in [-1, 1]^A or one of n classes; the
learner carries the latter as a one-hot vector, the environment receives the class.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import jax
import jax.numpy as jnp

from dreamer.config import DreamerConfig
from dreamer.layers import distributions as dist
from dreamer.refusals import is_whole

Shape = tuple[int, ...]
ObsShape = Shape | Mapping[str, Shape]
"""Shape of one array, or of several by name."""


def shapes(obs_shape: ObsShape) -> list[Shape]:
    """All shapes, ordered by name as JAX orders the leaves of a dict."""
    if isinstance(obs_shape, Mapping):
        return [tuple(obs_shape[name]) for name in sorted(obs_shape)]
    return [tuple(obs_shape)]


def image_shape(obs_shape: ObsShape) -> tuple[int, int, int] | None:
    """(H, W, C) of all images joined along their channels; None where there is none.

    Raises:
        ValueError: images of different sizes, an observation that is neither image nor vector, or none at all.
    """
    named = obs_shape if isinstance(obs_shape, Mapping) else {"": obs_shape}
    if not named or not all(isinstance(name, str) and _is_shape(shape) for name, shape in named.items()):
        raise ValueError(
            f"obs_shape = {obs_shape}: there must be observations, each an image (H, W, C) or a vector (D,). Reshape "
            "the others."
        )
    images = [shape for shape in shapes(obs_shape) if len(shape) == 3]
    if len({shape[:2] for shape in images}) > 1:
        raise ValueError(
            f"obs_shape = {obs_shape}: all images must have one height and width, since they are joined along their "
            "channels. Resize them, or give the smaller ones as vectors."
        )
    return (images[0][0], images[0][1], sum(shape[2] for shape in images)) if images else None


def _is_shape(shape: Any) -> bool:
    """Whether this is (H, W, C) or (D,)."""
    return isinstance(shape, tuple | list) and len(shape) in (1, 3) and all(is_whole(n) and n >= 1 for n in shape)


def vector_size(obs_shape: ObsShape) -> int:
    """Width of all vectors joined; 0 where there is none."""
    return sum(shape[0] for shape in shapes(obs_shape) if len(shape) == 1)


def image_of(obs: Any) -> jax.Array | None:
    """All images (..., H, W, C) uint8 of an observation, joined along their channels."""
    images = [leaf for leaf in jax.tree.leaves(obs) if leaf.dtype == jnp.uint8]
    return (images[0] if len(images) == 1 else jnp.concatenate(images, -1)) if images else None


def vector_of(obs: Any) -> jax.Array | None:
    """All vectors (..., D) float32 of an observation, joined."""
    vectors = [leaf for leaf in jax.tree.leaves(obs) if leaf.dtype != jnp.uint8]
    return (vectors[0] if len(vectors) == 1 else jnp.concatenate(vectors, -1)) if vectors else None


def place_of(obs_shape: Mapping[str, Shape], name: str) -> slice:
    """Where the vector of a name lies among all vectors joined."""
    first = sum(shape[0] for other, shape in obs_shape.items() if len(shape) == 1 and other < name)
    return slice(first, first + obs_shape[name][0])


def zeros(obs_shape: ObsShape, batch: Shape = ()) -> Any:
    """A black and silent observation with leading axes `batch`."""

    def one(shape: Shape) -> jax.Array:
        return jnp.zeros((*batch, *shape), jnp.uint8 if len(shape) == 3 else jnp.float32)

    if isinstance(obs_shape, Mapping):
        return {name: one(tuple(shape)) for name, shape in obs_shape.items()}
    return one(tuple(obs_shape))


def check(obs_shape: ObsShape, obs: Any, instances: int) -> None:
    """Raise where an environment's observation is not what it declares.

    Args:
        obs_shape: declared.
        obs: observation of `instances` instances, or its shapes.
        instances: N.

    Raises:
        ValueError: names both and the rule.
    """
    image_shape(obs_shape)
    wanted = jax.eval_shape(lambda: zeros(obs_shape, (instances,)))
    found = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), obs)
    if wanted != found:
        raise ValueError(
            f"the environment shows {found}, but its obs_shape = {obs_shape} asks for {wanted}. Images are uint8, "
            "vectors float32, each with the instances' axis in front. Correct one of them."
        )


class Actions(Protocol):
    """A kind of action. `raw` are the policy head's outputs (..., outputs) in float32, without a unit."""

    @property
    def width(self) -> int:
        """Numbers by which the learner carries an action."""

    @property
    def outputs(self) -> int:
        """Outputs of the policy head."""

    def noise(self, key: jax.Array, batch: Shape) -> jax.Array:
        """Random numbers (*batch, ...) without a unit that `sample` turns into actions."""

    def sample(self, config: DreamerConfig, raw: jax.Array, noise: jax.Array) -> jax.Array:
        """Drawn actions (..., width), normalised."""

    def mode(self, config: DreamerConfig, raw: jax.Array) -> jax.Array:
        """Best actions (..., width), normalised."""

    def random(self, key: jax.Array, batch: Shape) -> jax.Array:
        """Actions (*batch, width), normalised and uniform over all possible ones."""

    def score(self, config: DreamerConfig, raw: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Log-probability (...) of actions (..., width), and entropy (...) [nat]."""

    def saturation(self, raw: jax.Array) -> jax.Array:
        """How far (...), without a unit, the best action lies beyond where gradients reach it; 0 where it cannot."""

    def watch(self, config: DreamerConfig, raw: jax.Array) -> dict[str, jax.Array]:
        """Scalars () worth logging by name, without a unit."""

    def to_env(self, action: jax.Array) -> jax.Array:
        """Normalised actions (..., width) as the environment receives them: (..., width), or classes (...) int32."""


@dataclass(frozen=True)
class Box(Actions):
    """Actions in [-1, 1]^size: a normal with bounded mean and deviation, whose samples are clipped for the outside."""

    size: int

    @property
    def width(self) -> int:
        return self.size

    @property
    def outputs(self) -> int:
        return 2 * self.size

    def normal(self, config: DreamerConfig, raw: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Mean and standard deviation (..., A) of normalised actions."""
        mean, std = jnp.split(raw, 2, -1)
        return dist.bounded_normal(mean, std, config.min_std, config.max_std)

    def noise(self, key: jax.Array, batch: Shape) -> jax.Array:
        return jax.random.normal(key, (*batch, self.size))

    def sample(self, config: DreamerConfig, raw: jax.Array, noise: jax.Array) -> jax.Array:
        mean, std = self.normal(config, raw)
        return mean + std * noise

    def mode(self, config: DreamerConfig, raw: jax.Array) -> jax.Array:
        return self.normal(config, raw)[0]

    def random(self, key: jax.Array, batch: Shape) -> jax.Array:
        return jax.random.uniform(key, (*batch, self.size), minval=-1.0, maxval=1.0)

    def score(self, config: DreamerConfig, raw: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        mean, std = self.normal(config, raw)
        return dist.normal_log_prob(mean, std, action), dist.normal_entropy(std)

    def saturation(self, raw: jax.Array) -> jax.Array:
        return jnp.sum(jnp.square(jnp.split(raw, 2, -1)[0]), -1)

    def watch(self, config: DreamerConfig, raw: jax.Array) -> dict[str, jax.Array]:
        return {"policy_std": jnp.mean(self.normal(config, raw)[1])}

    def to_env(self, action: jax.Array) -> jax.Array:
        return jnp.clip(action, -1.0, 1.0)


@dataclass(frozen=True)
class Discrete(Actions):
    """One of n classes, drawn from a categorical with a uniform share. The environment receives (...) int32."""

    classes: int

    @property
    def width(self) -> int:
        return self.classes

    @property
    def outputs(self) -> int:
        return self.classes

    def probs(self, config: DreamerConfig, raw: jax.Array) -> jax.Array:
        """Probabilities (..., n), without a unit."""
        return dist.unimix_probs(raw, config.unimix)

    def noise(self, key: jax.Array, batch: Shape) -> jax.Array:
        return jax.random.uniform(key, batch)

    def sample(self, config: DreamerConfig, raw: jax.Array, noise: jax.Array) -> jax.Array:
        return dist.one_hot(dist.sample_index(self.probs(config, raw), noise), self.classes)

    def mode(self, config: DreamerConfig, raw: jax.Array) -> jax.Array:
        return dist.one_hot(jnp.argmax(raw, -1), self.classes)

    def random(self, key: jax.Array, batch: Shape) -> jax.Array:
        return dist.one_hot(jax.random.randint(key, batch, 0, self.classes), self.classes)

    def score(self, config: DreamerConfig, raw: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        probs = self.probs(config, raw)
        return jnp.sum(action * jnp.log(probs), -1), -jnp.sum(probs * jnp.log(probs), -1)

    def saturation(self, raw: jax.Array) -> jax.Array:
        return jnp.zeros(raw.shape[:-1])

    def watch(self, config: DreamerConfig, raw: jax.Array) -> dict[str, jax.Array]:
        return {"policy_certainty": jnp.mean(jnp.max(self.probs(config, raw), -1))}

    def to_env(self, action: jax.Array) -> jax.Array:
        return jnp.argmax(action, -1).astype(jnp.int32)


ActionSpec = int | Box | Discrete
"""A box of this size, or the kind of action itself."""


def actions(spec: ActionSpec) -> Box | Discrete:
    """The kind of action that an environment declares; a number stands for a box of that size.

    Raises:
        ValueError: no action at all, or a single class.
    """
    kind: Any = Box(spec) if is_whole(spec) else spec  # type: ignore[arg-type]
    known = isinstance(kind, Box | Discrete) and is_whole(kind.width)
    if not known or kind.width < 1 or kind.outputs < 2:
        raise ValueError(f"action_dim = {spec!r}: it must be a whole number, dreamer.Box or dreamer.Discrete; a box "
                         "needs a size of at least 1, a choice at least 2 classes. Correct it.")
    return kind


def actions_of(params: dict[str, Any]) -> Box | Discrete:
    """The kind of action that an agent's parameters were made for, by the width of its policy's output."""
    width, outputs = params["dyn"]["in_action"]["w"].shape[0], params["policy"]["out"]["b"].shape[0]
    return Discrete(width) if outputs == width else Box(width)


