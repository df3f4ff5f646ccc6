"""Claims about naming what a model lacks."""

from __future__ import annotations

from collections import Counter
from typing import Any

from benchmarks.claims.claim import Claim, Row

FIT = "Logs and robots of one's own"
MISSING = "The missing effect"


def _verdicts(content: dict[str, Any]) -> list[Row]:
    kinds = {(2.0, 1.0): {}, (4.0, 1.0): {}, (2.0, 2.0): {}, (4.0, 2.0): {}}  # type: dict[tuple[float, float], dict]
    for case in content.get("confusion", ()):
        kind = case["scale"], case.get("noise", 1.0)
        if case["stage"] == "scaled" and case.get("vehicle", "chair") == "chair" and kind in kinds:
            answer = " + ".join(f"`{name}`" for name in case["named"]) or case["verdict"]
            kinds[kind].setdefault(next(iter(case["truth"])), Counter())[answer] += 1
    rows: list[Row] = []
    for name in sorted({name for each in kinds.values() for name in each}):
        size = content["sizes"].get(name)
        cells = [
            ", ".join(
                f"{answer} x {count}" if count > 1 else answer for answer, count in sorted(each.get(name, {}).items())
            ).replace(f"`{name}`", "right")
            for each in kinds.values()
        ]
        rows.append(
            (f"`{name}`", f"{size['value']:.3g} {size['unit']}" if size else "-", *(cell or "-" for cell in cells))
        )
    return rows


def _shared(content: dict[str, Any]) -> list[Row]:
    rows: list[Row] = []
    for name, one in sorted(content.get("sets", {}).items()):
        channel = "ground_truth" if "ground_truth" in one["before"]["held_out"] else "odometry"
        before, after = (one[key]["held_out"].get(channel, {}).get("trajectory") for key in ("before", "after"))
        values = ", ".join(
            f"{key} = {p['value']:.3g} {p['unit']}" for each in one["effects"] for key, p in each["parameters"].items()
        )
        alike = ", ".join(f"`{member}`" for each in one["effects"] for member in each["class"][1:])
        verdict = " + ".join(f"`{each['name']}`" for each in one["effects"]) or one["verdict"]
        rows.append(
            (
                name,
                verdict,
                alike or "-",
                values or "-",
                *("-" if error is None else f"{error:.3g}" for error in (before, after)),
            )
        )
    return rows


LEVELS = ("_sensor_noise_0.5", "_sensor_noise_2", "_sensor_noise_4", "_noise")
"""Ends of the names of figures of logs with such noise, and of all of them."""

CLAIMS = (
    Claim(
        MISSING,
        "How often the verdict is right",
        "undeclared",
        "Logs of an independent contact plant. 26 effects of the catalogue, most with another law, and 8 beyond "
        "it. 1x is the "
        'size that 80 % of all logs would notice. "Right": the name or a member of its class. The columns "fresh" are '
        "of logs that nobody had seen (draws 233 to 235); six of them have backlash, which is never named. Since then "
        "a contradicted set of effects makes room for the next one; this is not yet in the figures. Columns 2x and 4x "
        "are of an earlier decision, on logs that its weights were chosen with; the others are older still.",
        ("figure", "2x, fresh", "4x, fresh", "2x", "4x", "2x, noise x2", "4x, noise x2", "4x, heavy scooter"),
        tuple(
            (
                label,
                *(
                    f"{{{name}{kind}|{form}}}" if form else f"{{{name}{kind}}}"
                    for kind in ("_2x_fresh", "_4x_fresh", "_2x", "_4x", "_2x_noise_2", "_4x_noise_2", "_4x_scooter")
                ),
            )
            for label, name, form in (
                ("named right", "class_accuracy", "%"),
                ("95 % interval: from", "class_accuracy", ".low %"),
                ("to", "class_accuracy", ".high %"),
                ("logs", "class_accuracy", ".n"),
                ("named wrong", "wrong_name", "%"),
                ("right names with a further effect", "further_name", "%"),
                ("noticed", "noticed", "%"),
                ("right names with a warning", "warned_right", "%"),
                ("members of a class", "mean_class_size", ""),
                ("beyond the catalogue: `unexplained`", "out_of_catalogue", "%"),
                ("logs", "out_of_catalogue", ".n"),
            )
        ),
    ),
    Claim(
        MISSING,
        "False alarms and other checks of the verdict",
        "undeclared",
        "The same logs. Fresh ones with nothing missing are judged by the decision before its [last "
        "change](notes/pairs.md), other fresh ones by the present decision. The weights were chosen with the others in "
        "view. An effect outside the class of the one that was taken out is named with a warning.",
        ("figure", "value"),
        (
            (
                "false alarms, {false_alarms} of {false_alarms|.n} logs with nothing missing, {false_alarms|.sets} "
                "sets of reference days; upper 95 % bound",
                "{false_alarm_upper|%}",
            ),
            (
                "false alarms, fresh logs, {false_alarms_fresh} of {false_alarms_fresh|.n} with nothing missing, "
                "{false_alarms_fresh|.sets} sets of reference days; upper 95 % bound",
                "{false_alarm_upper_fresh|%}",
            ),
            (
                "the same at 0.5 to 4 times the noise, {false_alarms_noise_fresh} of {false_alarms_noise_fresh|.n}",
                "{false_alarm_upper_noise_fresh|%}",
            ),
            ("false alarms on 200 refitted simulated days of one log", "{refitted_null_alarms}"),
            ("Kolmogorov-Smirnov p-value of calibrated p-values, fresh logs (uniform if large)", "{null_ks_p_fresh}"),
            ("two effects at once, {pair_both_fresh|.n} fresh logs: both named right", "{pair_both_fresh|%}"),
            ("the same: 95 % interval from", "{pair_both_fresh|.low %}"),
            ("to", "{pair_both_fresh|.high %}"),
            ("the same where both are at least at 2x, {pair_both_2x_fresh|.n} logs", "{pair_both_2x_fresh|%}"),
            ("two effects at once, fresh logs: a wrong name", "{pair_wrong_fresh|%}"),
            ("effect taken out of the catalogue, {left_out_unexplained_fresh|.n} fresh logs: `unexplained`",
             "{left_out_unexplained_fresh|%}"),
            ("the same: named outside its class", "{left_out_outside_class_fresh|%}"),
            ("the same: named wrong without a warning", "{left_out_wrong_fresh|%}"),
            ("95 % intervals that hold the planted size, of {interval_coverage_fresh|.n} in fresh logs",
             "{interval_coverage_fresh|%}"),
            ("width of these intervals over that at which 95 % hold it", "{interval_width_ratio_fresh}"),
            ("error of the size, fresh logs, median", "{parameter_error_fresh|%}"),
            ("held-out error after naming, over the replicates' difference", "{heldout_ratio}"),
            ("numbers that decide", "{decision_thresholds}"),
            ("lines of code between kept evidence and verdict", "{decision_lines_fresh}"),
            ("verdict from kept evidence, milliseconds", "{verdict_s_fresh|1000}"),
        ),
    ),
    Claim(
        MISSING,
        "Sensors and floor noisier or quieter than on the reference days",
        "undeclared",
        "Disturbances and sensor noise of the log times a factor; the reference days keep the usual ones. Logs "
        "with nothing missing, over the same sets of reference days.",
        ("figure", "0.5", "2", "4", "all"),
        (
            (
                "logs",
                *(f"{{false_alarms{level}|.n}}" for level in LEVELS),
            ),
            (
                "false alarms",
                *(f"{{false_alarms{level}}}" for level in LEVELS),
            ),
            (
                "upper 95 % bound of their rate",
                *(f"{{false_alarm_upper{level}|%}}" for level in LEVELS),
            ),
            (
                "noise factors inside their 95 % interval",
                *(f"{{noise_factor_coverage{level}|%}}" for level in LEVELS),
            ),
        ),
    ),
    Claim(
        MISSING,
        "How long the loop takes",
        "undeclared",
        "27 drives of 22 s and six reference days, compilation included.",
        ("what", "minutes"),
        (
            ("whole loop with 200 refitted simulated days, two CPU cores", "{cpu_seconds|0.0166667}"),
            ("whole loop with 200 refitted simulated days, GPU", "{gpu_seconds|0.0166667}"),
        ),
    ),
    Claim(
        MISSING,
        "Verdict by effect",
        "undeclared",
        'What was in the log, the size 1x, and the verdict on each log. "right": that effect was named. Another '
        'name for an '
        "effect of the catalogue is a member of its class, which these drives cannot separate.",
        ("effect", "1x", "2x", "4x", "2x, twice the noise", "4x, twice the noise"),
        _verdicts,
    ),
    Claim(
        MISSING,
        "Eight logs whose contents are not known here",
        "undeclared_shared",
        "Held-out position error [m] before and after, of the outside pose where there is one.",
        ("set", "verdict", "effects that look the same", "values", "before", "after"),
        _shared,
    ),
    Claim(
        FIT,
        "Whether faults of driving logs are named",
        "logs",
        'Logs of robots of many sizes with one fault of time or of frames each. "Rightly named" means that one '
        "sentence names the fault correctly and no other sentence claims something false. Faults too small to matter "
        "to a fit do not count.",
        ("figure", "value", "logs"),
        (
            ("faults at the two larger sizes, rightly named", "{time_faults_named|%}", "{time_faults_named|n}"),
            ("healthy logs of which something is said", "{time_faults_false|%}", "{time_faults_false|n}"),
        ),
    ),
    Claim(
        FIT,
        "Robots of one's own, and the usual first calibration",
        "logs",
        "A robot of 1.2 kg on the contact plant, whose wheels, track and markers are not where its owner believes: "
        "fitted by its URDF file, then asked which effect other days have. Markers far off are those of a "
        "chair, a scooter and a robot of 21 kg, the worst of three. Public robot files are listed in docs/models.md.",
        ("figure", "value"),
        (
            ("held-out position over what replicates differ by", "{small_robot_replicate_ratio}"),
            ("error of the wheel radius", "{small_robot_radius_error|%}"),
            ("error of the track", "{small_robot_track_error|%}"),
            ("error of the markers' place, 5 cm off [mm]", "{mount_offset_mm}"),
            ("error of the markers' heading, 8 degrees off [degrees]", "{mount_offset_deg}"),
            ("markers 20 cm off [mm]", "{far_mount_offset_mm}"),
            ("markers 15 degrees off [degrees]", "{far_mount_offset_deg}"),
            ("logs with one effect that were named in the right class", "{own_robot_loop_right}"),
            ("such logs", "{own_robot_loop_logs}"),
            ("robot files that load, settle and drive straight", "{robot_files_loaded}"),
            ("robot files tried", "{robot_files_tried}"),
            ("a bag of an hour to an inspected dataset [s]", "{bag_hour_s}"),
        ),
    ),
)
