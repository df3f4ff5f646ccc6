"""Writes benchmarks/README.md and the headlines in README.md from the result files: `python -m benchmarks.tables`."""

from __future__ import annotations

import argparse
import json
import os
from collections import Counter
from pathlib import Path
from typing import Any

from benchmarks.harness import RESULTS

HEAD = """# Benchmarks

One script per claim. Each writes `results/<name>.json` (claim, command, versions, commit, every repeat); this page is
made from those files by `python -m benchmarks.tables`. Values are medians; machines are shared, so ratios say more than
single times.

| script | what it measures |
|---|---|
| `python -m benchmarks.physics` | physics steps/s, cost of each effect, error of the time step, peers |
| `python -m benchmarks.contact_drive` | the fitted vehicle against the contact plant on the five manoeuvres |
| `python -m benchmarks.camera` | 64x64 RGB frames/s of the camera, by the GPU kernel and in plain JAX |
| `python -m benchmarks.environment` | control steps/s of the obstacle course, image included |
| `python -m benchmarks.learner` | DreamerV3 updates/s |
| `python -m benchmarks.cartpole` | cart-pole of the Control Suite and a grid world, every seed's curve |
| `python -m benchmarks.scaling` | environment and learner on 1, 2 and 4 devices of one host |
| `python -m benchmarks.course` | trainings of both tasks, every seed; the ground-truth planner |
| `python -m benchmarks.fit` | fits against planted truth, contact-plant logs and measured robots |
| `python -m benchmarks.undeclared` | verdicts of the closed loop on logs with effects that nobody declared |
| `python -m benchmarks.bridge` | latencies, stops and losses of the ROS 2 bridge |

All run on a CPU as well, in smaller sizes. The logs of measured robots are other people's: the script reads them from
the folder that `--shared` names.
"""
TITLES = {
    "physics": "Physics",
    "camera": "Camera",
    "environment": "Environment",
    "learner": "Learner",
    "dreamer_control": "Learner on other tasks",
    "scaling": "Several devices",
    "course": "Obstacle course",
    "corridor": "Corridor",
    "fit": "Fit: planted truth and contact-plant logs",
    "measured": "Fit: measured robots",
    "undeclared": "Undeclared effects: logs of the contact plant",
    "bridge": "Bridge",
}
PICTURES = {"course": "course_*.png", "corridor": "corridor*.png"}
NOTES = RESULTS.parent / "notes"
"""Written by hand: what was predicted and why it came out so; NOTES/FILE.md goes below the table of FILE."""
HEADLINES = (  # file, figure, factor, what it says
    ("physics", "steps_per_s_32768", 1e-9, "G physics steps/s: physical model, five more effects, 32,768 chairs"),
    ("camera", "frames_per_s_32box_16384", 1e-6, "M camera frames/s, 64x64 RGB, 32 boxes, 16,384 worlds, GPU kernel"),
    ("camera", "jnp_frames_per_s", 1e-6, "M the same in plain JAX"),
    ("environment", "control_steps_per_s_course", 1e-6, "M control steps/s of the obstacle course, image included"),
    ("learner", "updates_per_s_12m", 1.0, "DreamerV3 updates/s, size12m, batch 16 x 64"),
    ("learner", "peer_updates_per_s_12m", 1.0, "the same of SheepRL, through torch.compile (another run)"),
    ("scaling", "env_efficiency_4", 100.0, "% of linear: environment on four GPUs, 2,048 chairs on each"),
    ("scaling", "learner_efficiency_4", 100.0, "% of linear: learner on four GPUs, 16 x 64 on each"),
    ("course", "success_at_22000", 100.0, "% success in new worlds after the paper's 22,000 steps (median of 5 seeds)"),
    ("course", "return_at_18000_median_fixed", 1.0,
     "of 225 that the planner gets: return on the fixed course from 18,000 steps on (median of 5 seeds)"),
    ("course", "time_to_99_s", 1.0,
     "s until PPO arrives in 99 % of 1,000 new worlds, compilation included (median of 3 seeds)"),
    ("corridor", "success", 100.0, "% success in new corridors after 200,000 steps (median of 3 seeds)"),
    ("dreamer_control", "balance_image_size12m_return", 1.0,
     "of 1,000: balancing a cart-pole from pixels, 100,000 steps (median of 3 seeds)"),
    ("course", "cpu_success", 100.0, "% success on the easier course of two CPU cores (median of 3 seeds)"),
    ("course", "cpu_minutes", 1.0, "minutes of training for that (the fit and the installation come on top)"),
    ("measured", "drive_gain_over_fitted_base", 100.0,
     "% less held-out position error than the fitted base, by what the loop added (skid-steered robot)"),
    ("measured", "drive_gain_over_ideal_asphalt", 100.0,
     "% less held-out position error after 6 s than ideal replay, asphalt"),
    ("measured", "drive_gain_over_ideal_sand", 100.0, "% the same on sand (Warthog robot both)"),
    ("measured", "gain_mrclam_physical", 100.0, "% the same for two Create robots that were not fitted"),
    ("undeclared", "class_accuracy_2x", 100.0, "% of undeclared effects named right, at twice a noticeable size"),
    ("undeclared", "wrong_name_2x", 100.0, "% of them named wrong; the others are said to be unexplained or not there"),
    ("undeclared", "pair_both", 100.0, "% of logs with two undeclared effects of which both are named right"),
    ("undeclared", "false_alarm_upper", 100.0,
     "% false alarms at most (95 % bound), logs with nothing in them"),
    ("undeclared", "cpu_seconds", 1 / 60,
     "minutes for the whole loop, 27 drives of 22 s, six reference days, 200 refitted nulls, two cores"),
    ("undeclared", "gpu_seconds", 1 / 60, "minutes for the same on an accelerator"),
    ("fit", "noise_floor_ratio", 1.0, "times the sensor noise: held-out error where the truth was planted"),
    ("fit", "plant_replicate_ratio", 1.0, "times the replicate spread: held-out pose error, contact-plant log"),
    ("fit", "contact_replicate_ratio", 1.0, "times the same on other days of that plant (median)"),
    ("fit", "cpu_seconds", 1.0, "s for one start of a fit of 18 drives of 22 s on two cores, compilation included"),
    ("fit", "cpu_seconds_compiled", 1.0, "s for the same where an earlier fit has compiled it"),
    ("fit", "cpu_seconds_whole", 1.0, "s for that fit as a whole, which also looks elsewhere"),
    ("fit", "gpu_seconds", 1.0, "s for 32 starts of such a fit at once, compiled before"),
    ("fit", "tpe500_gpu_seconds", 1.0, "s for TPE with the paper's 500 parameter sets on them"),
    ("fit", "peer_mujoco_sysid_ratio", 1.0,
     "times as long takes `mujoco.sysid` to the same error, five parameters, compilation apart"),
    ("fit", "coverage_90_min", 100.0, "% of 90 % intervals hold at least, of each parameter, 200 synthetic logs"),
    ("fit", "plant_coverage_90_min", 100.0, "% of them at least, logs of the contact plant that tell the parameter"),
)
MARKS = ("<!-- figures -->", "<!-- /figures -->")


def table(content: dict[str, Any]) -> str:
    """Markdown table of the figures of one result file."""
    rows = ["| figure | value | unit | repeats | device | commit |", "|---|---|---|---|---|---|"]
    for name, entry in sorted(content["figures"].items()):
        repeats = entry["repeats"]
        shown = ", ".join(number(value) for value in repeats) if 1 < len(repeats) <= 5 else str(len(repeats))
        commit = entry.get("commit", content["commit"])[:7]
        rows.append(f"| {name} | {number(entry['value'])} | {entry['unit']} | {shown} | {entry['device']} | {commit} |")
    return "\n".join(rows)


def confusion(cases: list[dict[str, Any]]) -> str:
    """Every log of the contact plant: what was in it and what was said."""
    rows = ["| driven by | in the log | size | verdict | named | cannot be told from | explained |",
            "|---|---|---|---|---|---|---|"]
    quiet = Counter(driver(case) for case in cases if not case["truth"] and case["verdict"] == "none")
    rows += [f"| {who} | nothing, {count} logs | | none | | | |" for who, count in quiet.items()]
    for case in cases:
        if not case["truth"] and case["verdict"] == "none":
            continue
        inside = ", ".join(case["truth"]) or "nothing"
        sizes = ", ".join(number(size) for size in case["truth"].values())
        others = ", ".join(name for each in case["classes"] for name in each[1:])
        rows.append(f"| {driver(case)} | {inside} | {sizes} | {case['verdict']} | {', '.join(case['named'])} | "
                    f"{others} | {case['explained']:.0%} |")
    return "\n".join(rows)


def driver(case: dict[str, Any]) -> str:
    """Vehicle and disturbances of a log; older rows are of the chair and the usual ones."""
    noise = case.get("noise", 1.0)
    return case.get("vehicle", "chair") + ("" if noise == 1.0 else f", noise x {number(noise)}")


def verdicts(content: dict[str, Any]) -> str:
    """The undeclared sets: verdict, effect, values, held-out error before and after."""
    rows = ["| set | verdict | effect | class | values | held-out trajectory before, after, replicates [m] |",
            "|---|---|---|---|---|---|"]
    for name, one in sorted(content["sets"].items()):
        channel = "ground_truth" if "ground_truth" in one["before"]["held_out"] else "odometry"
        before, after = (one[key]["held_out"].get(channel, {}) for key in ("before", "after"))
        floor = (before.get("noise_floor") or {}).get("trajectory")
        values = ", ".join(f"{key} = {number(p['value'])} {p['unit']}" for each in one["effects"]
                           for key, p in each["parameters"].items())
        rows.append(f"| {name} | {one['verdict']} | {', '.join(each['name'] for each in one['effects'])} | "
                    f"{', '.join(member for each in one['effects'] for member in each['class'])} | {values} | "
                    f"{number(before.get('trajectory'))}, {number(after.get('trajectory'))}, {number(floor)} |")
    made = f"Made by `{content['command']}` at {content['commit'][:7]}, {content['device']}."
    title = "## Undeclared effects: eight sets whose contents are not known here"
    return "\n".join([title, content["claim"] + ".", "", *rows, "", made, ""])


def number(value: float | None) -> str:
    """Four significant digits; thousands separated."""
    if value is None:
        return "-"
    if abs(value) >= 10_000:
        return f"{value:,.0f}"
    return f"{value:.4g}"


def page(results: Path) -> str:
    """The whole page."""
    parts = [HEAD]
    for stem, title in TITLES.items():
        path = results / f"{stem}.json"
        if path.exists():
            content = json.loads(path.read_text())
            commands = sorted({entry.get("command", content["command"]) for entry in content["figures"].values()})
            made = "Made by " + "; ".join(f"`{command}`" for command in commands) + "."
            parts.append(f"## {title}\n{content['claim']}.\n\n{table(content)}\n\n{made}\n")
            note = NOTES / f"{stem}.md"
            if note.exists():
                parts.append(note.read_text())
            pictures = sorted(results.glob(PICTURES[stem])) if stem in PICTURES else ()
            parts += [f"![{picture.stem}](results/{picture.name})\n" for picture in pictures]
            if "confusion" in content:
                parts.append(confusion(content["confusion"]) + "\n")
    shared = results / "undeclared_shared.json"
    if shared.exists():
        parts.append(verdicts(json.loads(shared.read_text())))
    return "\n".join(parts)


def headlines(results: Path) -> str:
    """Markdown table of HEADLINES."""
    rows = ["| | | device |", "|---:|---|---|"]
    for stem, name, factor, text in HEADLINES:
        path = results / f"{stem}.json"
        entry = json.loads(path.read_text())["figures"].get(name) if path.exists() else None
        if entry:
            rows.append(f"| {entry['value'] * factor:.3g} | {text} | {entry['device']} |")
    return "\n".join(rows)


def put_between_marks(text: str, block: str) -> str:
    """`text` with what stands between MARKS replaced; ValueError if they are missing."""
    before, opening, rest = text.partition(MARKS[0])
    _, closing, after = rest.partition(MARKS[1])
    if not opening or not closing:
        raise ValueError(f"README.md: no {MARKS[0]} ... {MARKS[1]}; put both lines where the figures belong.")
    return f"{before}{opening}\n{block}\n{closing}{after}"


def write(path: Path, text: str) -> None:
    """Write a file, whole or not at all."""
    temporary = path.with_suffix(".tmp")
    temporary.write_text(text)
    os.replace(temporary, path)
    print(path)


def main() -> None:
    """Write both pages."""
    write(RESULTS.parent / "README.md", page(RESULTS))
    readme = RESULTS.parent.parent / "README.md"
    write(readme, put_between_marks(readme.read_text(), headlines(RESULTS)))


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()  # --help and mistakes end here
    main()
