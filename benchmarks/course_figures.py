"""What `benchmarks.course` records of finished trainings: its figures, every seed of them, and their curves."""

from __future__ import annotations

import json
import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

from benchmarks.harness import figure
from whill_mjx.io.reading import read_lines

LEARNERS = {"dreamer": "", "ppo": "_ppo"}
"""What the names of each learner's figures end in."""
QUICKEST = LEARNERS["ppo"]
BLIND: tuple[Literal["blank", "freeze", "replay"], ...] = ("blank", "freeze", "replay")
"""The proofs of sight."""


def load_run(path: Path, device: str | None = None) -> dict[str, Any]:
    """Result of one run with its metrics.

    Of a training without a note it is what the main command left, on `device`, beside others. Of one without its final
    evaluation it is the last evaluation inside the run; it counts as `stopped` where steps were left.

    Raises:
        ValueError: there is no note and no device is given; or there was no evaluation.
    """
    metrics = [line for _, line in read_lines(path / "metrics.jsonl")]
    if (path / "course.json").exists():
        noted = json.loads((path / "run.json").read_text())["preset"] if (path / "run.json").exists() else {}
        starts = {"exploring_starts": noted["exploring_starts"]} if "exploring_starts" in noted else {}
        return {**starts, **json.loads((path / "course.json").read_text()), "metrics": metrics}
    if device is None:
        raise ValueError(f"{path}: has no course.json. Name the device on which it was made (--device).")
    begun = json.loads((path / "run.json").read_text())
    noted = {name: begun["command"][name] for name in ("preset", "layout", "seed", "learner")}
    noted["exploring_starts"] = begun["preset"]["exploring_starts"]
    content: dict[str, Any] = {"device": device, "together": 2, "metrics": metrics, **noted}
    if begun["command"].get("spread"):
        content["spread"] = begun["command"]["spread"]
    if (path / "evaluation.json").exists():
        return {**content, **json.loads((path / "evaluation.json").read_text())}
    last = last_evaluation(path, begun["preset"], metrics)
    left = begun["preset"].get("total_steps", float("inf")) - last["env_steps"]
    return {**content, **({"stopped": True} if left > 0 else {}), **last}


def last_evaluation(path: Path, preset: dict[str, Any], metrics: list[dict[str, Any]]) -> dict[str, Any]:
    """A training's result by its last evaluation inside the run, in place of the final one; ValueError: there is none.

    Args:
        path: folder, for the error.
        preset: as `run.json` has it.
        metrics: lines of the log.
    """
    evaluated = [line for line in metrics if "eval/success" in line]
    if not evaluated:
        raise ValueError(f"{path}: was stopped before its first evaluation. Give its command again, or leave it out.")
    last = evaluated[-1]
    policy = {name: last[f"eval/{name}"] for name in ("success", "collision", "return")}
    return {"task": preset["task"], "env_steps": last["env_steps"], "updates": last["updates"],
            "policy": {**policy, "episodes": preset["eval_episodes"]}}


def groups(runs: list[dict[str, Any]]) -> Iterator[tuple[str, list[dict[str, Any]], dict[str, Any]]]:
    """Trainings of one preset, layout and learner: a name for them, these, and their figures.

    Figures of other presets, layouts and learners than the usual have other names; those of trainings with other
    vehicles in each episode end in _dynamics, those of stopped runs in _stopped.

    Raises:
        ValueError: a run of the course that has to be whole was stopped, or its preset has no figures.
    """
    kinds: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for one in runs:
        corridor = "corridor" if is_corridor(one) else "course"
        ending = LEARNERS[one.get("learner", "dreamer")] + ("_dynamics" if one.get("spread") else "")
        ending += "_stopped" if one.get("stopped") else ""
        kinds.setdefault((corridor, one["preset"], one["layout"], ending), []).append(one)
    for (world, preset, layout, ending), mine in kinds.items():
        if world == "corridor":
            found = corridor_figures(mine)
            ending = ending if preset == "paper" else f"_{preset}{ending}"
        elif mine[0].get("stopped") and preset != "wallclock":
            raise ValueError(
                f"seed {mine[0]['seed']} of the preset {preset} was stopped: its figures are those of whole runs. Give "
                "its command again, or record it by `ablation`."
            )
        elif preset == "paper":
            found = paper_figures(mine, layout)
        elif preset in ("cpu", "wallclock"):
            found = cpu_figures(mine) if preset == "cpu" else wallclock_figures(mine)
        else:
            raise ValueError(f"seed {mine[0]['seed']}: trainings of the preset {preset} have no figures. Leave it out.")
        group = f"corridor{ending}" if world == "corridor" else f"course_{preset}_{layout}{ending}"
        figures = {f"{name}{ending}": entry for name, entry in found.items()}
        if f"time_to_99_s{QUICKEST}" in figures:  # the fixed name is of whatever learns in the shortest time
            figures["time_to_99_s"] = figures[f"time_to_99_s{QUICKEST}"]
        yield group, mine, figures


def cpu_figures(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Success of each seed over 100 episodes, against a random policy and without sight in the same worlds."""
    device = runs[0]["device"]
    success = [one["policy"]["success"] for one in runs]
    gain = [one["policy"]["success_interval_95"][0] - one["random"]["success"] for one in runs]
    first = [first_sign(one) for one in runs]
    return {
        "cpu_success": {**figure(success, "share", device), "episodes": runs[0]["policy"]["episodes"]},
        "cpu_random_success": figure([one["random"]["success"] for one in runs], "share", device),
        "cpu_lower_bound_above_random": figure(gain, "share", device),
        "cpu_minutes": figure([training_s(one) / 60 for one in runs], "min", device),
        "cpu_first_sign_minutes": figure(first, "min", device),
        **{f"cpu_{name}": found for name, found in sight_figures(runs).items()},
    }


def wallclock_figures(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Time until 99 % of the episodes of an evaluation inside the run succeeded, per seed that came so far; its success
    over the worlds of the final evaluation and what the run took.
    """
    device = runs[0]["device"]
    times = [next((m["wall_s"] for m in one["metrics"] if m.get("eval/success", 0.0) >= 0.99), None) for one in runs]
    reached = [time for time in times if time is not None]
    success = {**figure([one["policy"]["success"] for one in runs], "share", device),
               "episodes": runs[0]["policy"]["episodes"], "env_steps": [one["env_steps"] for one in runs],
               "seeds": [one["seed"] for one in runs],
               "exploring_starts": [one.get("exploring_starts") for one in runs],
               "evaluations": [evaluations(one) for one in runs]}  # fmt: skip
    return {
        **({f"time_to_99_s{'' if runs[0].get('learner') == 'ppo' else '_dreamer'}": figure(reached, "s", device)}
           if reached else {}),
        "wallclock_success": success,
        "wallclock_return": figure([one["policy"]["return"] for one in runs], "-", device),
        "wallclock_training_s": figure([training_s(one) for one in runs], "s", device),
        **{f"wallclock_{name}": entry for name, entry in sight_figures(runs).items()},
    }


def is_corridor(run: dict[str, Any]) -> bool:
    """Whether a run was in the corridor."""
    return "box_x" in run["task"]


def corridor_figures(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Success and collisions of each seed over unseen randomised episodes, its proofs of sight and wall-clock."""
    device = runs[0]["device"]
    alone = [training_s(one) for one in runs if "together" not in one]
    episodes = {"episodes": runs[0]["policy"]["episodes"], "env_steps": [one["env_steps"] for one in runs],
                "updates": [one["updates"] for one in runs], "seeds": [one["seed"] for one in runs],
                "evaluations": [evaluations(one) for one in runs]}  # fmt: skip
    return {
        "success": {**figure([one["policy"]["success"] for one in runs], "share", device), **episodes},
        "collisions": {**figure([one["policy"]["collision"] for one in runs], "share", device), **episodes},
        **varied_figures(runs),
        **sight_figures(runs),
        **({"wallclock_s": figure(alone, "s", device)} if alone else {}),
    }


def varied_figures(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Success and collisions of each seed where every episode has a vehicle of its own, if they were driven so."""
    if not all("varied" in one for one in runs):
        return {}
    device, spread = runs[0]["device"], [one["spread"] for one in runs]
    return {f"{name}_varied": {**figure([one["varied"][key] for one in runs], "share", device), "spread": spread}
            for name, key in (("success", "success"), ("collisions", "collision"))}


def sight_figures(runs: list[dict[str, Any]], suffix: str = "") -> dict[str, Any]:
    """Success of each seed without sight: the best of the three kinds, and each kind."""
    seeing = [one for one in runs if "sight" in one]
    if not seeing:
        return {}
    device = seeing[0]["device"]
    kinds = {f"blinded_{kind}_success{suffix}": figure([one["sight"][kind] for one in seeing], "share", device)
             for kind in BLIND}
    best = [max(one["sight"].values()) for one in seeing]
    return {f"blinded_success{suffix}": figure(best, "share", device), **kinds}


def evaluations(run: dict[str, Any]) -> list[dict[str, float]]:
    """The evaluations inside a run: steps, seconds since its start, success and, where any arrived, when."""
    names = {"env_steps": "env_steps", "wall_s": "wall_s", "eval/success": "success", "eval/arrival_s": "arrival_s"}
    return [{short: line[name] for name, short in names.items() if name in line}
            for line in run["metrics"] if "eval/success" in line]  # fmt: skip


def training_s(run: dict[str, Any]) -> float:
    """Seconds of training, compilation and evaluations inside the run included."""
    return run["metrics"][-1]["wall_s"]


def first_sign(run: dict[str, Any]) -> float:
    """Minutes until an evaluation inside the run first succeeded in 30 % more episodes than a random policy."""
    threshold = run["random"]["success"] + 0.3
    times = (m["wall_s"] / 60 for m in run["metrics"] if m.get("eval/success", 0) > threshold)
    return next(times, training_s(run) / 60)  # never: the whole run


def paper_figures(runs: list[dict[str, Any]], layout: str) -> dict[str, Any]:
    """Evaluation return from 18,000 control steps on, arrival time and wall-clock, per seed."""
    device = runs[0]["device"]
    late = [[m for m in one["metrics"] if m["env_steps"] >= 17_900 and "eval/return" in m] for one in runs]
    returns = [statistics.median(m["eval/return"] for m in ms) for ms in late]
    arrivals = [m["eval/arrival_s"] for ms in late for m in ms if "eval/arrival_s" in m]
    suffix = "" if layout == "randomised" else "_fixed"
    arrival = {f"arrival_s_at_18000{suffix}": figure(arrivals, "s", device)} if arrivals else {}  # none: never arrived
    alone = [training_s(one) for one in runs if "together" not in one]
    return {
        **arrival,
        f"return_at_18000_median{suffix}": figure(returns, "-", device),
        f"return_at_18000_worst{suffix}": {**figure(returns, "-", device), "value": min(returns)},
        f"success_at_22000{suffix}": figure([one["policy"]["success"] for one in runs], "share", device),
        **sight_figures(runs, suffix),
        **({f"wallclock_s{suffix}": figure(alone, "s", device)} if alone else {}),
    }


def draw(runs: list[dict[str, Any]], path: Path) -> None:
    """Evaluation return and success of every seed."""
    try:
        import matplotlib
    except ImportError:
        return
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure_, axes = plt.subplots(2, 1, sharex=True, figsize=(7, 6), layout="constrained")
    for one in runs:
        repeat = one["task"]["action_repeat"]
        points = [(m["env_steps"] * repeat, m["eval/return"], m["eval/success"]) for m in one["metrics"]
                  if "eval/return" in m]
        steps, returns, success = zip(*points, strict=True)
        starts = one.get("exploring_starts")
        label = f"seed {one['seed']}" + ("" if starts is None else f", exploring starts {starts:g}")
        axes[0].plot(steps, returns, "o-", markersize=3, label=label)
        axes[1].plot(steps, success, "o-", markersize=3)
    axes[0].set_ylabel("evaluation return")
    axes[1].set_ylabel("evaluation success")
    axes[1].set_xlabel("control steps (0.1 s), summed over instances")
    axes[0].legend(fontsize=8)
    for one_axes in axes:
        one_axes.grid(alpha=0.3)
    figure_.savefig(path, dpi=130)
    plt.close(figure_)
