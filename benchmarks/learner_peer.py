"""The learner of SheepRL (`dreamer_v3_5`, PyTorch) on a batch of noise, for comparison with `benchmarks.learner`.

    python -m benchmarks.learner_peer --compile     # pip install sheeprl; prints one line of JSON

It is timed as it is used: mixed bf16, cuDNN's own choice of algorithms, TF32 elsewhere, and with `--compile` its losses
through `torch.compile` with CUDA graphs, which takes minutes. The batch is on the device already; its replay, which
lives on the host, is not timed. A process of its own, so that PyTorch and JAX do not share a device's memory.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

from bridge.nodes.options import Parser, whole
from whill_mjx.io.command_line import guarded

LENGTH = 64
ACTION_DIM = 2
SHAPE = (3, 64, 64)


def configuration(size: str, batch: int, precision: str, compiled: bool) -> Any:
    """SheepRL's own configuration of a size ("12M"), for continuous actions from one image."""
    import hydra
    from omegaconf import OmegaConf
    from sheeprl.utils.utils import dotdict

    with hydra.initialize_config_module("sheeprl.configs", version_base=None):
        found = hydra.compose("config", [
            "exp=dreamer_v3_5", f"algo=dreamer_v3_5_{size}", "env=dummy", "algo.cnn_keys.encoder=[rgb]",
            "algo.mlp_keys.encoder=[]", f"algo.per_rank_batch_size={batch}", f"fabric.precision={precision}",
            f"algo.compile.enabled={compiled}", "run_name=peer", "metric.log_level=0"], return_hydra_config=False)
    return dotdict(OmegaConf.to_container(OmegaConf.masked_copy(found, [k for k in found if k != "hydra"]),
                                          resolve=True, throw_on_missing=False))


def noise(cfg: Any, batch: int, device: Any) -> dict[str, Any]:
    """A batch as the replay gives it: (1 + 64, B, ...), the first step being the context."""
    import torch

    steps = (LENGTH + cfg.algo.replay_context, batch)
    recurrent = cfg.algo.world_model.recurrent_model.recurrent_state_size
    flag = torch.zeros(*steps, 1, device=device)
    first = flag.clone()
    first[::40] = 1.0
    world = cfg.algo.world_model
    return {
        "rgb": torch.randint(0, 256, (*steps, *SHAPE), dtype=torch.uint8, device=device),
        "actions": torch.rand(*steps, ACTION_DIM, device=device) * 2 - 1,
        "rewards": torch.randn(*steps, 1, device=device),
        "terminated": flag, "truncated": flag.clone(), "is_first": first,
        "deter": torch.randn(*steps, recurrent, device=device).to(torch.float16),
        "stoch": torch.randint(0, world.discrete_size, (*steps, world.stochastic_size), dtype=torch.uint8,
                               device=device)}


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """Updates/s of each block after the first, the seconds of that one (compilation), and how many parameters."""
    import gymnasium as gym
    import hydra
    import numpy as np
    import torch
    from lightning.fabric import Fabric
    from sheeprl.algos.dreamer_v3_5.agent import build_agent
    from sheeprl.algos.dreamer_v3_5.dreamer_v3_5 import train
    from sheeprl.algos.dreamer_v3_5.utils import Moments
    from sheeprl.utils.metric import MetricAggregator

    MetricAggregator.disabled = True
    on_gpu = torch.cuda.is_available()
    torch.set_float32_matmul_precision("high")
    torch.backends.cudnn.benchmark = True
    cfg = configuration(args.size, args.batch_size, "bf16-mixed" if on_gpu else "32-true", args.compile)
    fabric = Fabric(accelerator="cuda" if on_gpu else "cpu", devices=1, precision=cfg.fabric.precision)
    space = gym.spaces.Dict({"rgb": gym.spaces.Box(0, 255, SHAPE, np.uint8)})
    world, actor, critic, slow, _ = build_agent(fabric, (ACTION_DIM,), True, cfg, space)
    modules = [world, actor, critic]
    parameters = [one for module in modules for one in module.parameters()]
    optimizer = fabric.setup_optimizers(hydra.utils.instantiate(cfg.algo.optimizer, params=parameters, _convert_="all"))
    scale = cfg.algo.actor.moments
    moments = Moments(scale.decay, scale.max, scale.percentile.low, scale.percentile.high)
    data = noise(cfg, args.batch_size, fabric.device)
    blocks = []
    for _ in range(args.blocks + 1):
        began = time.perf_counter()
        for _ in range(args.per_block):
            train(fabric, cfg, world, actor, critic, slow, optimizer, moments, dict(data), None, (ACTION_DIM,))
        if on_gpu:
            torch.cuda.synchronize()
        blocks.append(time.perf_counter() - began)
    return {"updates_per_s": [args.per_block / one for one in blocks[1:]], "first_s": blocks[0],
            "parameters": sum(one.numel() for one in parameters), "torch": torch.__version__,
            "device": torch.cuda.get_device_name() if on_gpu else "cpu"}


def main() -> None:
    """Measure and print."""
    parser = Parser(
        prog="python -m benchmarks.learner_peer", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--size", default="12M", help="1M, 12M, 25M, 50M, 100M, 200M or 400M")
    parser.add_argument("--batch-size", type=whole(), default=16)
    parser.add_argument("--compile", action="store_true", help="torch.compile with CUDA graphs")
    parser.add_argument("--blocks", type=whole(), default=5)
    parser.add_argument("--per-block", type=whole(), default=10)
    print(json.dumps(measure(parser.parse_args())))


if __name__ == "__main__":
    with guarded():
        main()
