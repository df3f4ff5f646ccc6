"""RUN/index.html: all pictures, videos and reports of a training on one page, and the list of them for the terminal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from whill_mjx.evaluation.episodes import other_endings
from whill_mjx.io import html
from whill_mjx.io.fields import in_shell, percent
from whill_mjx.io.folders import write_whole

INDEX = "index.html"
PICTURES = {
    "reward_curve.png": "Return (the sum of rewards of an episode) and shares of endings, over the training",
    "drives.png": "Drives of the policy in the final evaluation, from above; all start at the left",
    "failures.png": "Drives of the final evaluation that failed, from above",
    "camera.mp4": "The first drives of the final evaluation: what the camera saw, and the view from above",
    "failures.mp4": "Drives of the final evaluation that failed, as they were recorded",
    "prediction.gif": "What the camera saw (top), what the world model predicts (middle; green edge: it still sees the "
                      "camera), and their difference (bottom)",
    "fit/trajectories.png": "The fitted vehicle beside the driving log",
    "fit/errors.png": "Errors of the fitted vehicle in each trial",
}  # fmt: skip
FILES = {
    "fit/report.html": "report of the fit: parameters, intervals, errors",
    "vehicle.toml": "the vehicle of this training",
    "policy/policy.json": "the policy file, for the vehicle and for whill_mjx.evaluate",
    "evaluation.json": "all figures of the final evaluation",
    "metrics.jsonl": "the training, line by line",
    "drives.npz": "the recorded drives of the final evaluation",
    "run.json": "the command and its settings",
}
DRIVERS = {"policy": "the policy", "planner": "planner that knows the scene", "random": "random actions"}


def write_index(out: Path, evaluation: dict[str, Any], task: str) -> Path:
    """Write the page of a training; it links the files beside it by relative paths."""
    there = {name: text for name, text in PICTURES.items() if (out / name).is_file()}
    training = [name for name in there if not name.startswith("fit/")]
    sections = [html.Section("Result", _result(out, evaluation)), html.Section("Training", _shown(training))]
    fit = [name for name in there if name.startswith("fit/")]
    if fit:
        lead = '<p>See the <a href="fit/report.html">report of the fit</a> for parameters and their intervals.</p>'
        sections.append(html.Section("Vehicle", lead + _shown(fit)))
    files = [(name, text) for name, text in FILES.items() if (out / name).is_file()]
    sections.append(html.Section("Files", html.links(files)))
    title = f"Training in the task {task.replace('_', ' ')}"
    subtitle = f"This is the policy after {evaluation['env_steps']} environment steps, the best of the evaluations."
    policy = evaluation["policy"]
    lead = f"The policy succeeds in {percent(policy['success'])} of {policy['episodes']} unseen episodes."
    write_whole(out / INDEX, html.html_page(title, sections, subtitle, kind="Training", lead=lead))
    return out / INDEX


def list_results(out: Path) -> list[str]:
    """Lines that name the page, the reports and the pictures of a training."""
    names = [name for name in (*FILES, *PICTURES) if (out / name).is_file()]
    reports = [name for name in names if name.endswith(".html")]
    pictures = [name for name in names if name in PICTURES and not name.startswith("fit/")]
    lines = [f"open {out / INDEX} in a browser: it shows everything on one page"]
    if reports:
        lines.append(f"reports: {', '.join(str(out / name) for name in reports)}")
    if pictures:
        lines.append(f"pictures and videos in {out}: {', '.join(pictures)}")
    if (out / "policy").is_dir():
        lines.append(f"next: python -m whill_mjx.evaluate {in_shell(out / 'policy')} --html")
    return lines


def _result(out: Path, evaluation: dict[str, Any]) -> str:
    rows: list[list[Any]] = []
    for name in (name for name in DRIVERS if name in evaluation):
        one = evaluation[name]
        low, high = one["success_interval_95"]
        seconds = one["time_to_goal_s"]
        others = ", ".join(f"{ending} {percent(share)}" for ending, share in other_endings(one).items())
        rows.append([DRIVERS[name], percent(one["success"]), f"{percent(low)} to {percent(high)}",
                     percent(one["collision"]), percent(one["timeout"]), others or "–",
                     "–" if seconds is None else f"{seconds:.1f} s", one["return"]])
    header = ["driver", "success", "95% interval", "collision", "time-out", "other endings", "time to the goal",
              "return"]
    command = f"python -m whill_mjx.evaluate {in_shell(out / 'policy')} --html"
    return html.table(header, rows) + html.paragraph(f"More episodes, proofs of sight and sweeps: {command}", "dim")


def _shown(names: list[str]) -> str:
    """Pictures and videos with their captions."""
    return "".join((html.video if name.endswith(".mp4") else html.image)(name, PICTURES[name]) for name in names)
