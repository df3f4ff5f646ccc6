"""Minutes in which PPO of other packages learns point goals: `python -m benchmarks.state_ppo`.

Learners are Stable-Baselines3 (`sb3`) and a loop in PyTorch (`loop`). Neither is installed with this package: run it
in an environment of its own that has both (CONTRIBUTING.md). It ends when two evaluations in a row, each of `goals` new
worlds, reach the asked share.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from benchmarks.harness import device_name, figure, record
from whill_mjx.gym.vector import WhillVectorEnv
from whill_mjx.io.command_line import OptionError, run
from whill_mjx.tasks.point_goal import PointGoal

CLAIM = "Obstacle course with physics, camera image, reward and auto-reset"
REWARD_SCALE = 0.02
"""Returns are then of the order of one."""
RATE, PASSES, PART, DISCOUNT, LAMBDA = 7e-4, 8, 512, 0.98, 0.95
"""PPO of both learners: step size, passes over a rollout, samples of a minibatch, discount, and that of advantages."""
Policy = Callable[[Any], np.ndarray]


@dataclass(frozen=True)
class Options:
    """Options of the benchmark."""

    learner: str = "sb3"
    """sb3 or loop."""
    instances: int = 64
    """Vehicles side by side."""
    minutes: float = 15.0
    """Give up after this time."""
    goals: int = 200
    """New point goals of an evaluation."""
    share: float = 0.95
    """Share of them that must be reached."""
    every: int = 10
    """Updates between two evaluations."""
    rollout: int = 64
    """Steps of each vehicle between two updates."""
    seed: int = 0
    """Of networks and worlds."""
    record: bool = True
    """Write the figure into the results."""


def make_task() -> PointGoal:
    """The task, which acts five times a second."""
    return PointGoal(action_repeat=2)


class Examiner:
    """Evaluations in worlds that no earlier one had."""

    def __init__(self, goals: int) -> None:
        self.env = WhillVectorEnv(goals, make_task())
        self.seed = 1_000_000

    def share(self, policy: Policy) -> float:
        """Share of new point goals that a policy reaches."""
        self.seed += self.env.num_envs
        obs, _ = self.env.reset(seed=self.seed)
        ended = np.zeros(self.env.num_envs, bool)
        reached = np.zeros(self.env.num_envs, bool)
        while not ended.all():
            obs, _, terminated, truncated, info = self.env.step(policy(obs))
            reached |= info["success"] & ~ended
            ended |= terminated | truncated
        return float(reached.mean())


def sb3(options: Options) -> Iterator[Policy]:
    """The policy of Stable-Baselines3's PPO after each `every` updates."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecNormalize

    from whill_mjx.gym.sb3 import as_sb3

    env = as_sb3(WhillVectorEnv(options.instances, make_task(), autoreset_mode=AutoresetMode.SAME_STEP))
    env = VecNormalize(env, norm_obs=False, norm_reward=True, gamma=DISCOUNT)
    networks = {"net_arch": [128, 128], "log_std_init": -0.5}
    model = PPO(
        "MultiInputPolicy", env, n_steps=options.rollout, batch_size=PART, n_epochs=PASSES, learning_rate=RATE,
        gamma=DISCOUNT, gae_lambda=LAMBDA, seed=options.seed, device="cpu", policy_kwargs=networks,
    )  # fmt: skip
    while True:
        model.learn(options.every * options.rollout * options.instances, reset_num_timesteps=False)
        yield lambda obs: model.predict(obs, deterministic=True)[0]


class Networks:
    """Actor, critic and optimiser of the loop, in PyTorch."""

    def __init__(self, size: int, seed: int) -> None:
        import torch
        from torch import nn

        torch.manual_seed(seed)

        def network(out: int) -> Any:
            return nn.Sequential(nn.Linear(size, 128), nn.Tanh(), nn.Linear(128, 128), nn.Tanh(), nn.Linear(128, out))

        self.actor, self.critic = network(2), network(1)
        self.log_std = nn.Parameter(torch.full((2,), -0.5))
        self.weights = [*self.actor.parameters(), *self.critic.parameters(), self.log_std]
        self.optimiser = torch.optim.Adam(self.weights, lr=RATE, eps=1e-5)
        with torch.no_grad():
            self.actor[-1].weight *= 0.01

    def normal(self, seen: Any) -> Any:
        """Distribution of actions."""
        import torch

        return torch.distributions.Normal(self.actor(seen), self.log_std.exp())

    def policy(self, obs: Any) -> np.ndarray:
        """The mean action."""
        import torch

        with torch.no_grad():
            return self.actor(as_vector(obs)).clamp(-1, 1).numpy()

    def update(self, seen: Any, action: Any, advantage: Any, target: Any) -> None:
        """PPO's clipped objective over a few passes."""
        import torch

        with torch.no_grad():
            old = self.normal(seen).log_prob(action).sum(-1)
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        for _ in range(PASSES):
            for part in torch.randperm(len(old)).split(PART):
                ratio = (self.normal(seen[part]).log_prob(action[part]).sum(-1) - old[part]).exp()
                gain = torch.min(ratio * advantage[part], ratio.clamp(0.8, 1.2) * advantage[part]).mean()
                loss = 0.5 * ((self.critic(seen[part]).squeeze(-1) - target[part]) ** 2).mean() - gain
                self.optimiser.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(self.weights, 0.5)
                self.optimiser.step()


def as_vector(obs: dict[str, np.ndarray]) -> Any:
    """Observations (N, D) as the networks read them."""
    import torch

    return torch.as_tensor(np.concatenate([obs[name] for name in sorted(obs)], 1) / 2.0, dtype=torch.float32)


def loop(options: Options) -> Iterator[Policy]:
    """The policy of a PPO written out, in the way of CleanRL, after each `every` updates."""
    import torch

    env = WhillVectorEnv(options.instances, make_task())
    obs, _ = env.reset(seed=options.seed)
    nets = Networks(as_vector(obs).shape[1], options.seed)
    fresh = torch.zeros(options.instances, dtype=torch.bool)  # the next step begins an episode and ignores the action
    while True:
        for _ in range(options.every):
            rows = []
            for _ in range(options.rollout):
                seen = as_vector(obs)
                with torch.no_grad():
                    action = nets.normal(seen).sample()
                obs, reward, terminated, truncated, _ = env.step(action.clamp(-1, 1).numpy())
                ended = torch.as_tensor(terminated | truncated)
                reward = torch.as_tensor(REWARD_SCALE * reward, dtype=torch.float32)
                rows.append((seen, action, reward, torch.as_tensor(terminated), ended, ~fresh))
                fresh = ended
            seen, action, reward, terminated, ended, counts = (torch.stack(leaf) for leaf in zip(*rows, strict=True))
            with torch.no_grad():
                value = nets.critic(torch.cat([seen, as_vector(obs)[None]])).squeeze(-1)
                advantage, later = torch.zeros_like(reward), torch.zeros(options.instances)
                for t in reversed(range(options.rollout)):
                    error = reward[t] + DISCOUNT * value[t + 1] * ~terminated[t] - value[t]
                    later = error + DISCOUNT * LAMBDA * later * ~ended[t]
                    advantage[t] = later
            nets.update(*(leaf[counts] for leaf in (seen, action, advantage, advantage + value[:-1])))
        yield nets.policy


LEARNERS = {"sb3": sb3, "loop": loop}


def main(options: Options) -> None:
    """Train until the share is reached twice, and record the minutes; exit code 1 if time runs out."""
    if options.learner not in LEARNERS:
        raise OptionError(f"--learner {options.learner}: unknown (known: {', '.join(LEARNERS)}). Correct it.")
    start, examiner, passed, steps = time.monotonic(), Examiner(options.goals), 0, 0
    for policy in LEARNERS[options.learner](options):
        steps += options.every * options.rollout * options.instances
        share = examiner.share(policy)
        minutes = (time.monotonic() - start) / 60
        passed = passed + 1 if share >= options.share else 0
        print(f"{minutes:5.1f} min, {steps:,} steps: {share:.1%} of {options.goals} new goals reached", flush=True)
        if passed == 2:
            name = f"{options.learner}_point_goal_minutes"
            print(f"{name}: {minutes:.1f} on {device_name()}")
            if options.record:
                record("environment", CLAIM, {name: figure([minutes], "min")})
            return
        if minutes > options.minutes:
            raise SystemExit(1)


if __name__ == "__main__":
    run(Options, main, __doc__, positional=False)
