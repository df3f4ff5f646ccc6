"""`close_loop --decision posterior`: make the evidence of a log, weigh it, and write what is missing.

    schema, kind    1, "sysid-posterior"
    verdict         "none", "named" or "unexplained"
    sentences       the verdict in words
    p_value, score  rank of the score among days with nothing missing, and the score [nats over nothing]
    effects         name, class, parameters {name: value, interval, unit}; an open end of an interval is null
    weights         posterior weights of none, the sets of effects and "unknown", tempered as `Rules.trust` says
    noise           channel -> factor on the noise of the reference days, and its 95 % interval
    lives_in        what the best smooth unknown is a function of
    null_scores     how many days with nothing missing the score is ranked among, and where they come from

The folder also holds evidence.npz.xz, from which the same verdict can be had again without a simulator.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sysid.weighing.posterior import Posterior, posterior
from sysid.weighing.saved_evidence import Evidence, save
from sysid.weighing.verdict import Named, Verdict, calibration_scores, decide

SCHEMA, KIND = 1, "sysid-posterior"
LOUD = 1.15
"""Least factor on the noise that is worth a sentence."""
NAMES = {"odometry.v": "reported speed", "odometry.omega": "reported yaw rate", "pose.forward": "outside pose, forward",
         "pose.left": "outside pose, sideways", "pose.yaw": "outside pose, yaw"}


def run(log: Any, references: Sequence[Any], out: Path, config: Any, vehicle: Any = None) -> dict[str, Any]:
    """Weigh the training trials of a log, write the folder `out` and print the verdict."""
    from sysid import command_line
    from sysid.pages.report import write_report
    from sysid.verdict.preparation import expected_steps, prepare, reference_for
    from sysid.weighing.make_evidence import Maker

    progress, close = command_line.progress_bar(
        expected_steps(config, len(references), vehicle is not None), "close the loop", "step")
    try:
        ready = prepare(reference_for(log, references, config, vehicle, progress), log.spec, config, progress)
        maker = Maker(ready.without(config.without), log.training, log.spec, log.name, progress)
        maker.refine_all()
    finally:
        close()
    found = posterior(maker.evidence)
    said = decide(found, maker.evidence.channels, calibration_scores())
    report = as_report(maker.evidence, found, said, maker.values)
    out.mkdir(parents=True, exist_ok=True)
    save(out / "evidence.npz.xz", maker.evidence)
    write_report(out / "posterior.json", report)
    print("\n".join(report["sentences"]))
    print(f"wrote posterior.json and evidence.npz.xz into {out}")
    return report


def as_report(evidence: Evidence, found: Posterior, said: Verdict, values: Any) -> dict[str, Any]:
    """The content of posterior.json.

    Args:
        values: from a key and coordinates q to parameter values by name, and their units.
    """
    effects = [{"name": one.name, "class": list(one.members), "parameters": parameters(evidence, one, values)}
               for one in said.effects]
    return {"schema": SCHEMA, "kind": KIND, "verdict": said.verdict, "sentences": sentences(said, effects),
            "p_value": said.p_value, "score": said.score, "effects": effects, "weights": dict(said.weights),
            "noise": {channel: {"factor": factor, "interval": [low, high]}
                      for channel, (factor, low, high) in said.noise.items()},
            "lives_in": said.lives_in if said.verdict == "unexplained" else None,
            "families": {name: value - found.none for name, value in found.families.items()},
            "null_scores": {"count": len(calibration_scores()), "of": "logs of a contact plant with nothing missing"}}


def parameters(evidence: Evidence, one: Named, values: Any) -> dict[str, dict[str, Any]]:
    """Each parameter of a named effect with its 95 % interval, within its physical range."""
    axes = evidence.effect(one.key).axes
    least = np.array([-axis.limit if axis.signed else 0.0 for axis in axes])
    most = np.array([axis.limit for axis in axes])
    middle = np.clip(one.q, least, most)
    out = {}
    for i, axis in enumerate(axes):
        ends = []
        for sign in (0, -1, 1):
            q = middle.copy()
            q[i] = np.clip(one.q[i] + 1.96 * sign * one.deviation[i], least[i], most[i])
            ends.append(float(values(one.key, q)[axis.parameter]))
        low, high = sorted(ends[1:])
        out[axis.parameter] = {"value": ends[0] if np.isfinite(ends[0]) else None,
                               "interval": [low if np.isfinite(low) else None, high if np.isfinite(high) else None]}
    return out


def sentences(said: Verdict, effects: Sequence[dict[str, Any]]) -> list[str]:
    """The verdict in words."""
    out = []
    if said.verdict == "none":
        out.append(f"Nothing is missing: days with nothing missing score as high with probability {said.p_value:.2g}.")
    elif said.verdict == "unexplained":
        out.append(f"Something is missing that the catalogue does not have. It is best predicted by: {said.lives_in}.")
    for one in effects:
        name, value = next(iter(one["parameters"].items()))
        size = "at its neutral value" if value["value"] is None else f"{value['value']:.3g}"
        ends = ["open" if end is None else f"{end:.3g}" for end in value["interval"]]
        others = f" These drives cannot distinguish it from {', '.join(one['class'][1:])}." if one["class"][1:] else ""
        out.append(f"Missing: {one['name']}, {name} {size} ({ends[0]} to {ends[1]}).{others}")
    out += noise_sentences(said)
    return out


def noise_sentences(said: Verdict) -> list[str]:
    """Of each channel whose noise is surely another than on the reference days."""
    out = []
    for channel, (factor, low, high) in said.noise.items():
        if low > 1.0 and factor > LOUD:
            out.append(f"The {NAMES.get(channel, channel)} is {factor:.2g} times as noisy as on the reference days "
                       f"({low:.2g} to {high:.2g}).")
        elif high < 1.0 and factor < 1 / LOUD:
            out.append(f"The {NAMES.get(channel, channel)} is quieter than on the reference days: {factor:.2g} times "
                       f"the noise ({low:.2g} to {high:.2g}).")
    if out and said.verdict == "none":
        out.append("Nothing else has changed.")
    return out
