"""Claims about fits, of planted vehicles and of measured robots."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.claims.claim import Claim, Row

FIT = "Fits"
MEASURED = "Measured robots"


SOURCES = ("", "plant_", "scooter_", "robot_")


def _coverage(content: dict[str, Any]) -> list[Row]:
    figures = content["figures"]
    names = sorted(
        {
            name[len(source) + len("coverage_90_") :]
            for source in SOURCES
            for name in figures
            if name.startswith(f"{source}coverage_90_") and "." in name
        }
    )
    return [
        (
            f"`{name}`",
            *(f"{{{source}coverage_90_{name}|%}}" for source in SOURCES),
            *(f"{{{source}half_width_90_{name}}}" for source in SOURCES[:2]),
        )
        for name in names
    ]


EFFECTS = Path(__file__).parents[2] / "whill_mjx" / "effects"
PEERS = (
    ("ideal replay", "peer_ideal"),
    ("scales, lag, delay (4 numbers)", "peer_4_numbers"),
    ("and a limit of the wheels' speed (5)", "peer_5_numbers"),
    ("and a late pose, sideways slip (7)", "peer_7_numbers"),
    ("and a lag of turning (8)", "peer_8_numbers"),
    ("the publishers' powertrain and slip model", "peer_published"),
    ("a network beside the 8 numbers", "peer_network"),
)


def _ladder(content: dict[str, Any]) -> list[Row]:
    """One row for each rung, whatever the loop named."""
    first = "ladder_all_position_"
    rungs = [name.removeprefix(first) for name in content["figures"] if name.startswith(first)]
    rows: list[Row] = []
    for rung in rungs:
        alone = f"ladder_alone_all_position_{rung}"
        known = alone in content["figures"]
        rows.append((_of_rung(rung), *(f"{{ladder_{where}_{rung}}}" for where in (
            "all_position", "all_yaw", "asphalt_position", "gravel_position", "sand_position")),
            f"{{{alone}|%}} ({{{alone}_low|%}} to {{{alone}_high|%}})" if known else "-"))
    gains = [f"ladder_gain_{where}" for where in (
        "all_position", "all_yaw", "asphalt_position", "gravel_position", "sand_position")]
    return [*rows, ("less than the base", *(f"{{{gain}|%}} ({{{gain}_low|%}} to {{{gain}_high|%}})" for gain in gains),
                    "-")]


def _of_rung(rung: str) -> str:
    """The effects in the name of a rung, with_NUMBER_EFFECT_EFFECT, in words."""
    if not rung.startswith("with_"):
        return {"ideal": "ideal replay", "base": "fitted base"}.get(rung, rung)
    rest, found = rung.split("_", 2)[2], []
    known = sorted((path.stem for path in EFFECTS.glob("*.py")), key=len, reverse=True)
    while rest:
        name = next((one for one in known if rest == one or rest.startswith(f"{one}_")), rest)
        found.append(f"`{name}`")
        rest = rest.removeprefix(name).removeprefix("_")
    return f"with {', '.join(found)}"


def _changed(run: str) -> Row:
    gains = (f"changed_{run}_{what}_gain" for what in ("position", "yaw"))
    return (run, f"{{changed_{run}_position_before}}", f"{{changed_{run}_position_after}}",
            *(f"{{{gain}|%}} ({{{gain}_low|%}} to {{{gain}_high|%}})" for gain in gains))


def _drive(terrain: str, model: str) -> Row:
    name = f"drive_{terrain}_{model}"
    return (
        terrain,
        model,
        f"{{rmse_{name}_chained_6s_ideal}}",
        f"{{rmse_{name}_chained_6s_fitted}}",
        f"{{gain_{name}_chained_6s|%}}",
        f"{{gain_{name}_chained_6s_yaw|%}}",
        f"{{gain_{name}|%}}",
    )


CLAIMS = (
    Claim(
        FIT,
        "Error on unseen drives",
        "fit",
        "Mean position error of held-out drives, over the difference between two repeats of one drive. 1.0 is "
        "the best "
        "possible: what no model can predict.",
        ("log", "ratio", "error [m]", "error of ideal replay [m]"),
        (
            ("planted truth (ratio to the sensor noise)", "{noise_floor_ratio}", "-", "-"),
            (
                "contact plant, physical model",
                "{plant_replicate_ratio_physical}",
                "{rmse_plant_physical_fitted}",
                "{rmse_plant_physical_ideal}",
            ),
            (
                "contact plant, the paper's model",
                "{plant_replicate_ratio_paper}",
                "{rmse_plant_paper_fitted}",
                "{rmse_plant_paper_ideal}",
            ),
            (
                "contact plant, six other days, over the difference of two drives each",
                "{contact_replicate_ratio} ({contact_replicate_ratio|range})",
                "-",
                "-",
            ),
            (
                "the dataset that ships, `sysid/data/chair`",
                "{chair_replicate_ratio}",
                "{rmse_chair_fitted}",
                "{rmse_chair_ideal}",
            ),
            ("the dataset that ships, all sizes kept as stated", "{chair_replicate_ratio_as_stated}", "-", "-"),
            ("the dataset that ships, all sizes free", "{chair_replicate_ratio_all_free}", "-", "-"),
            ("contact plant, all sizes as stated", "{plant_replicate_ratio_physical_as_stated}", "-", "-"),
        ),
    ),
    Claim(
        FIT,
        "How long a fit takes",
        "fit",
        "18 drives of 22 s, compilation included unless said.",
        ("what", "seconds"),
        (
            ("one start, two CPU cores", "{cpu_seconds}"),
            ("one start, two CPU cores, compiled by an earlier fit", "{cpu_seconds_compiled}"),
            ("the whole fit, two CPU cores", "{cpu_seconds_whole}"),
            ("32 starts at once, GPU, compiled before", "{gpu_seconds}"),
            ("their compilation", "{gpu_seconds_compile}"),
            ("TPE, the paper's 500 parameter sets, one CPU core", "{tpe500_cpu_seconds}"),
            ("TPE, the paper's 500 parameter sets, GPU", "{tpe500_gpu_seconds}"),
        ),
    ),
    Claim(
        FIT,
        "Which search arrives",
        "fit",
        'Ten runs of each search on the same 18 drives, one core, compilation apart. "Arrived": within 5 % of '
        'the best '
        "cost that any run found. TPE and CMA-ES had 500 parameter sets.",
        ("search", "arrived", "cost", "held-out error [m]", "seconds to arrive"),
        tuple(
            (
                label,
                f"{{search_{name}_arrived|%}}",
                f"{{search_{name}_cost}}",
                f"{{search_{name}_held_out}}",
                f"{{search_{name}_seconds}}",
            )
            for label, name in (
                ("`features` (default), 4 starts", "features"),
                ("`both`, a short TPE first", "both"),
                ("`tpe`", "tpe"),
                ("`cmaes`", "cmaes"),
            )
        ),
    ),
    Claim(
        FIT,
        "Do starts agree",
        "fit",
        "Starts whose end costs within 0.3 % of the best, of 32; 31 of them begin at random points over the full "
        "bounds.",
        ("log", "agree", "within 10 %"),
        (
            ("contact plant", "{starts_agreeing_of_32}", "{starts_within_10_percent_of_32}"),
            ("planted truth", "{planted_starts_agreeing_of_32}", "{planted_starts_within_10_percent_of_32}"),
        ),
    ),
    Claim(
        FIT,
        "Against `mujoco.sysid`",
        "fit",
        'Five parameters of a contact-plant log, all else known, Levenberg-Marquardt in both. "Known": our other '
        'parameters '
        'come from a fit to another day. "Preset": nobody has fitted them.',
        ("figure", "known", "preset"),
        tuple(
            (label, f"{{{name}}}", f"{{{name}_preset}}")
            for label, name in (
                ("our seconds to the peer's error", "peer_ours_seconds"),
                ("the peer's seconds", "peer_mujoco_sysid_seconds"),
                ("the peer takes times as long", "peer_mujoco_sysid_ratio"),
                ("the peer takes times as long, our compilation included", "peer_mujoco_sysid_ratio_with_compilation"),
                ("our best error [m]", "peer_ours_error"),
                ("the peer's best error [m]", "peer_mujoco_sysid_error"),
            )
        ),
    ),
    Claim(
        FIT,
        "How often 90 % intervals hold",
        "fit",
        "Share of logs whose interval contains the true value, of those that can identify the parameter. By "
        "chance alone "
        "200 logs give 86 to 94 %, 96 logs 84 to 95 %. Half-widths are medians, in the parameter's unit.",
        (
            "parameter",
            "synthetic, {coverage_logs} logs",
            "contact plant, {plant_coverage_logs}",
            "heavy scooter, {scooter_coverage_logs}",
            "small robot, {robot_coverage_logs}",
            "half-width, synthetic",
            "half-width, plant",
        ),
        _coverage,
    ),
    Claim(
        MEASURED,
        "DRIVE: a Warthog on asphalt and sand",
        "measured",
        "Held-out position error after 6 s, physical and paper's model, fitted to 6 s steps. Gains are less "
        "error than ideal "
        "replay, which follows each command at once.",
        ("terrain", "model", "ideal [m]", "fitted [m]", "gain, position", "gain, yaw", "gain after 2 s, position"),
        tuple(_drive(terrain, model) for terrain in ("asphalt", "sand", "pooled") for model in ("physical", "paper")),
    ),
    Claim(
        MEASURED,
        "DRIVE: what the missing effects gain",
        "measured",
        "Held-out error over 6 s of ideal replay, of the fitted base, and with the effects that the loop named one "
        "after the other. Each row has those of the rows before it. In the last column nothing moved but what was "
        "named; the rest is gained by base parameters that were fitted beside it. Intervals are of 95 %.",
        ("vehicle", "position [m]", "yaw [rad]", "asphalt [m]", "gravel [m]", "sand [m]", "gained by the named alone"),
        _ladder,
    ),
    Claim(
        MEASURED,
        "DRIVE: what models of the commands alone predict",
        "measured",
        "The same steps, predicted by models that know nothing of the vehicle. All are written anew from "
        "their descriptions.",
        ("model", "position [m]", "yaw [rad]"),
        tuple((label, f"{{{stem}_position}}", f"{{{stem}_yaw}}") for label, stem in PEERS),
    ),
    Claim(
        MEASURED,
        "DRIVE: another floor than asphalt",
        "measured",
        "Each third of a run is predicted by the vehicle of the asphalt run, and by that vehicle with what "
        "changed fitted to the other two thirds: position error [m] after 6 s, and gains with their 95 % intervals. "
        "Gyro and wheels named the change in all three runs.",
        ("run", "as on asphalt", "on its floor", "gain, position", "gain, yaw"),
        tuple(_changed(run) for run in ("gravel", "sand_1", "sand_2")),
    ),
    Claim(
        MEASURED,
        "DRIVE: halves of one run",
        "measured",
        "Halves of the asphalt run against one another, of which nothing differs: how often something is named all the "
        "same. Each cut begins at another tenth of the run.",
        ("asked", "false names", "cuts"),
        (
            ("gyro and wheels, whether the floor is another one", "{floor_false_asphalt}", "10"),
            ("the whole loop, what is missing", "{half_false}", "{half_cuts}"),
        ),
    ),
    Claim(
        MEASURED,
        "MRCLAM: five Create robots",
        "measured",
        "Robots 4 and 5, fitted to robots 1 to 3: held-out error over windows of 15 s, and names given to each "
        "robot alone.",
        ("figure", "physical", "paper"),
        (
            ("position error [m]", "{rmse_mrclam_physical_fitted}", "{rmse_mrclam_paper_fitted}"),
            ("ideal replay [m]", "{rmse_mrclam_physical_ideal}", "{rmse_mrclam_paper_ideal}"),
            ("gain, position", "{gain_mrclam_physical|%}", "{gain_mrclam_paper|%}"),
            ("false names, of 5 robots", "{mrclam_false}", "-"),
            ("delay found, of 5 robots", "{mrclam_delay_found}", "-"),
        ),
    ),
)
