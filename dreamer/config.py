"""Hyperparameters of DreamerV3 and the presets by size."""

from __future__ import annotations

import dataclasses
import numbers
from dataclasses import dataclass
from typing import Any, Literal

import jax.numpy as jnp
from jax.typing import DTypeLike

from dreamer.refusals import INT32

LEAST_TRAIN_RATIO = 0.001
"""Replayed steps are credited in fractions whose denominator is at most its inverse."""
RANGES: dict[str, tuple[float, float]] = {
    **dict.fromkeys(("deter", "hidden", "units", "stoch", "blocks", "depth", "patch", "patch_units", "bins",
                     "batch_size", "imag_horizon", "steps_per_iter"), (1, 1e6)),
    "scan_unroll": (1, 1000),
    "classes": (2, 256),  # indices are stored as bytes
    "batch_length": (2, 1e6),
    **dict.fromkeys(("vector_layers", "reward_layers", "continue_layers", "policy_layers", "value_layers"), (0, 100)),
    **dict.fromkeys(("greedy_share", "unimix", "return_lambda", "slow_rate", "return_norm_rate", "average_rate",
                     "beta1", "beta2", "lr"), (0, 1)),
    **dict.fromkeys(("min_std", "max_std"), (0, 100)),
    **dict.fromkeys(("noise_steps", "horizon", "imag_last"), (0, 1e6)),
    "train_ratio": (LEAST_TRAIN_RATIO, 1e6),
    **dict.fromkeys(("mean_pull", "policy_outscale", "entropy_scale", "slow_reg", "replay_value_scale", "barlow_scale",
                     "barlow_redundancy", "dyn_scale", "rep_scale", "recon_scale", "vector_scale", "reward_scale",
                     "continue_scale", "free_nats", "behavior_lr", "agc", "agc_min_norm", "eps"), (0, 1e12)),
    **dict.fromkeys(("learning_starts", "pretrain_steps", "pretrain_updates", "warmup", "lr_decay"), (0, INT32)),
    "replay_capacity": (1, 1e12),
    "mirror": (0, 1000),
}  # fmt: skip
"""Widest sensible range of each number."""


@dataclass(frozen=True)
class DreamerConfig:
    """All numbers of the learner; the defaults are size12m. Source: danijar/dreamerv3 configs.yaml, May 2026."""

    deter: int = 2048
    """Width D of the deterministic state."""
    hidden: int = 256
    """Width of the layers around the recurrent core."""
    units: int = 256
    """Width of the heads' layers."""
    stoch: int = 32
    """Number S of categorical latents."""
    classes: int = 16
    """Classes C of each latent; at most 256."""
    blocks: int = 8
    """Blocks G of the block-diagonal recurrent weights."""
    encoder: Literal["conv", "patch"] = "conv"
    """Image layers: four 5x5 convolution stages, or one linear layer on square patches (cheap on a CPU)."""
    depth: int = 16
    """Channel multiplier of the convolutions."""
    mults: tuple[int, ...] = (2, 3, 4, 4)
    """Channels of each stage in units of depth."""
    kernel: int = 5
    """Convolution kernel size."""
    patch: int = 8
    """Patch side [pixel]."""
    patch_units: int = 32
    """Features of one patch."""
    vector_layers: int = 3
    """Layers of the encoder and of the decoder of vector observations."""
    reward_layers: int = 1
    """Layers of the reward head."""
    continue_layers: int = 1
    """Layers of the continue head."""
    policy_layers: int = 3
    """Layers of the actor."""
    value_layers: int = 3
    """Layers of the critic."""
    bins: int = 255
    """Two-hot bins of reward and value; odd, so that one bin is exactly zero."""
    unimix: float = 0.01
    """Uniform share mixed into every categorical."""
    min_std: float = 0.1
    """Smallest standard deviation of the policy."""
    max_std: float = 1.0
    """Largest standard deviation of the policy."""
    noise_steps: float = 0.0
    """Longest time constant [steps] of the noise with which training acts, at least 1
    (`dreamer.experience.exploration`); 0: the noise of every step is independent. Continuous actions only."""
    greedy_share: float = 0.0
    """Share of the instances that act in training as evaluations do, by the most probable action, rounded up: the model
    then sees where that leads. Without, it may believe in a place where only the best actions would stay."""
    mean_pull: float = 0.0
    """Weight of the square of the policy's mean before its tanh. Where the return hardly depends on the action, noise
    drives the mean into saturation, whence no gradient leads back; 0.01 keeps it within reach. Not for classes."""
    policy_outscale: float = 0.01
    """Scale of the actor's output weights at the start."""

    batch_size: int = 16
    """Sequences B in a batch."""
    batch_length: int = 64
    """Trained steps T of a sequence; one more is sampled for its stored latent."""
    train_ratio: float = 512.0
    """Replayed steps per control step, control steps summed over instances."""
    learning_starts: int = 1024
    """Control steps with random actions before the first update (and at least batch_length + 1 per instance); those of
    `pretrain_steps` count too."""
    replay_capacity: int = 1_000_000
    """Control steps kept, summed over instances."""
    replay_memory: Literal["auto", "device", "host"] = "auto"
    """Where their observations lie. auto: on the device, unless they would take more than half of its memory and
    `train` runs one seed on one device."""
    stored_latents: bool = True
    """Begin a sequence in the state that is stored at the step before it; False: in the state of an episode's start."""
    online: bool = True
    """Train on each fresh sequence once before sampling uniformly."""
    steps_per_iter: int = 1
    """Steps of each instance in one dispatch."""

    pretrain_steps: int = 0
    """Uncounted control steps with random actions, summed over instances, before the counted ones; 0: none."""
    pretrain_updates: int = 0
    """Updates of the world model alone on these steps, before the first counted one."""

    mirror: int = 0
    """How many times more to remember every step, as the environment's mirror shows it in this many other worlds. Steps
    and ratio count the real ones."""

    redraw: bool = False
    """Hold in the replay what observations are drawn from, and draw them anew for each update (`dreamer.types.Redraw`):
    no picture is learned twice."""

    horizon: float = 333.0
    """Effective horizon [steps]; discount 1 - 1/horizon, contained in the continue head."""
    imag_horizon: int = 15
    """Imagined steps."""
    imag_last: int = 0
    """Imagine from the last N states of each sequence, and train the critic's replay loss there; 0 means all."""
    return_lambda: float = 0.95
    """Lambda of the returns."""
    entropy_scale: float = 3e-4
    """Weight of the actor's entropy."""
    slow_rate: float = 0.02
    """Rate at which the slow critic follows."""
    slow_reg: float = 1.0
    """Weight of the pull towards the slow critic."""
    replay_value_scale: float = 0.3
    """Weight of the critic's loss on replayed sequences."""
    return_norm_rate: float = 0.01
    """Rate of the running return percentiles."""
    return_percentiles: tuple[float, float] = (0.05, 0.95)
    """Percentiles whose distance scales the advantage."""
    representation: Literal["reconstruct", "barlow"] = "reconstruct"
    """What shapes the latents besides reward and continue: decoding the observation, or, without a decoder, agreement
    with the encoder's tokens, dimension by dimension (R2-Dreamer, arXiv 2603.18202)."""
    barlow_scale: float = 0.05
    """Weight of that agreement."""
    barlow_redundancy: float = 5e-4
    """Weight within it of the correlations between different dimensions."""
    decode_only: tuple[str, ...] = ()
    """Names of observations that are targets of the decoder and never seen by the encoder, such as a simulator's depth
    or the bearing of the goal; acting does not need them."""
    dyn_scale: float = 1.0
    """Weight of the dynamics loss."""
    rep_scale: float = 0.1
    """Weight of the representation loss."""
    recon_scale: float = 1.0
    """Weight of the loss of each reconstruction, images and vectors."""
    vector_scale: float = 1.0
    """Further weight of that of the vectors: a few numbers that decide weigh little beside thousands of pixels."""
    reward_scale: float = 1.0
    """Weight of the reward loss."""
    continue_scale: float = 1.0
    """Weight of the continue loss."""
    free_nats: float = 1.0
    """Floor of each KL term [nat], after summing over latents."""

    lr: float = 4e-5
    """Learning rate. Small networks on small budgets like more, such as 3e-4."""
    behavior_lr: float = 1.0
    """Learning rate of policy and critic in units of the world model's. Below 1 they follow a model of little data more
    slowly than it is corrected by what they do (DreamerV3 of 2023: 0.3)."""
    warmup: int = 1000
    """Updates over which the learning rate rises linearly."""
    lr_decay: int = 0
    """Updates by which it has fallen linearly to a twentieth, for runs of known length; 0 keeps it."""
    average_rate: float = 0.0
    """Rate at which an average of the parameters follows them, for evaluations and exports; 0 keeps none."""
    agc: float = 0.3
    """Adaptive clipping: largest update norm relative to the parameter norm, per tensor."""
    agc_min_norm: float = 1e-3
    """Smallest parameter norm used by the clipping."""
    beta1: float = 0.9
    """Momentum after the scaling."""
    beta2: float = 0.999
    """Decay of the squared gradients."""
    eps: float = 1e-20
    """Added to the root of the squared gradients."""

    compute_dtype: Literal["bfloat16", "float32"] = "bfloat16"
    """Type of matrix products and recurrent states; parameters, norms, losses and returns are float32."""
    scan_unroll: int = 8
    """Steps of the recurrences unrolled into one loop body: more is faster on a GPU, 1 is best on a CPU."""

    def __post_init__(self) -> None:
        if isinstance(self.mirror, bool):  # in older files
            object.__setattr__(self, "mirror", int(self.mirror))
        for name, (low, high) in RANGES.items():
            value, whole = getattr(self, name), isinstance(getattr(type(self), name), int)
            ok = isinstance(value, numbers.Integral if whole else numbers.Real) and not isinstance(value, bool)
            kind = "must be a whole number" if whole else "must be a number"
            self._require(ok and low <= value <= high, name, f"{kind} in {low:g}..{high:g}")
        for name in ("lr", "behavior_lr", "horizon", "min_std", "max_std"):
            self._require(getattr(self, name) > 0, name, "must be positive")
        rules = (
            (self.deter % self.blocks == 0, "deter", f"must be divisible by blocks ({self.blocks})"),
            (self.bins % 2 == 1, "bins", "must be odd: the middle bin is zero"),
            (self.patch_units % self.blocks == 0, "patch_units", f"must be divisible by blocks ({self.blocks})"),
            (self.depth * self.mults[-1] % self.blocks == 0, "depth", "must give a last stage divisible by blocks"),
            (self.encoder in ("conv", "patch"), "encoder", "must be 'conv' or 'patch'"),
            (self.representation in ("reconstruct", "barlow"), "representation", "must be 'reconstruct' or 'barlow'"),
            (self.representation != "barlow" or not self.decode_only, "decode_only", "must be () without a decoder"),
            (self.replay_memory in ("auto", "device", "host"), "replay_memory", "must be 'auto', 'device' or 'host'"),
            (self.noise_steps == 0 or self.noise_steps >= 1, "noise_steps", "must be 0 or at least 1"),
            (self.lr_decay == 0 or self.lr_decay > self.warmup, "lr_decay", f"must exceed warmup ({self.warmup})"),
            (self.average_rate < 1, "average_rate", "must be below 1: an average remembers"),
            (self.greedy_share < 1, "greedy_share", "must be below 1: somebody explores"),
            (self.min_std <= self.max_std, "min_std", f"must be at most max_std ({self.max_std:g})"),
            (self.imag_last == 0 or self.imag_last >= 2, "imag_last", "must be 0 (all) or at least 2"),
            (
                (self.pretrain_steps > 0) == (self.pretrain_updates > 0),
                "pretrain_steps",
                f"must be positive together with pretrain_updates ({self.pretrain_updates}), or both 0",
            ),
            (
                self.pretrain_steps <= self.replay_capacity,
                "pretrain_steps",
                f"must fit replay_capacity ({self.replay_capacity}): what is overwritten is not learned from",
            ),
            (self.kernel == 5, "kernel", "must be 5: the 2x2-block form of the convolutions is written for it"),
        )
        for ok, field, rule in rules:
            self._require(ok, field, rule)

    def _require(self, ok: bool, field: str, rule: str) -> None:
        if not ok:
            raise ValueError(f"DreamerConfig.{field} = {getattr(self, field)!r}: it {rule}. Change {field}.")

    @property
    def dtype(self) -> DTypeLike:
        """compute_dtype as a dtype."""
        return jnp.dtype(self.compute_dtype)

    @property
    def stoch_size(self) -> int:
        """Width S * C of the flattened latent."""
        return self.stoch * self.classes

    @property
    def discount(self) -> float:
        """Discount per step."""
        return 1.0 - 1.0 / self.horizon

    @property
    def start_steps(self) -> int:
        """States of each sequence from which imagination starts."""
        return min(self.imag_last or self.batch_length, self.batch_length)

    @property
    def replayed_per_update(self) -> int:
        """Steps replayed by one update."""
        return self.batch_size * self.batch_length


PRESETS: dict[str, dict[str, Any]] = {
    "size1m": dict(deter=512, hidden=64, units=64, classes=4, depth=4),
    "size12m": dict(),
    "size25m": dict(deter=3072, hidden=384, units=384, classes=24, depth=24),
    "size50m": dict(deter=4096, hidden=512, units=512, classes=32, depth=32),
    "size100m": dict(deter=6144, hidden=768, units=768, classes=48, depth=48),
    "cpu": dict(
        deter=256,
        hidden=128,
        units=128,
        classes=8,
        encoder="patch",
        batch_size=8,
        batch_length=32,
        train_ratio=64.0,
        replay_capacity=60_000,
        lr=3e-4,
        warmup=200,
        value_layers=2,
        policy_layers=2,
        imag_last=16,
        compute_dtype="float32",
        scan_unroll=1,
    ),
}


def preset(name: str, **overrides: Any) -> DreamerConfig:
    """Configuration of a named size.

    Args:
        name: size1m, size12m, size25m, size50m, size100m or cpu.
        overrides: fields to replace, such as lr=3e-4.

    Raises:
        ValueError: unknown name.
    """
    if name not in PRESETS:
        raise ValueError(f"preset {name!r} does not exist. Choose one of {', '.join(PRESETS)}.")
    return dataclasses.replace(DreamerConfig(**PRESETS[name]), **overrides)
