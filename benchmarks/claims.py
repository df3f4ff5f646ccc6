"""The claims that the recorded figures support: what each table says, and which figures are in it.

A cell is text with figures in braces: {name}, {name|form} or {file:name|form}; `tables.shown` lists the forms.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Row = tuple[str, ...]


@dataclass(frozen=True)
class Claim:
    """One table of the page."""

    room: str
    """Heading above the claims of one subject."""
    title: str
    stem: str
    """Result file: benchmarks/results/STEM.json."""
    text: str
    """What was measured, and how to read it."""
    head: Row
    rows: tuple[Row, ...] | Callable[[dict[str, Any]], list[Row]]
    """Rows of cells, or a function of the file's content that makes them."""
    pictures: tuple[str, ...] = ()


HEADLINES = (  # file, what, value
    (
        "physics",
        "Physics steps per second: 32,768 chairs at once, each with five extra effects",
        "{steps_per_s_32768|1e-6} million",
    ),
    (
        "sight",
        "Arrivals in another simulator that no policy was trained in: furnished corridors (odd furniture and colours)",
        "{foreign_furnished|%} ({foreign_unseen|%})",
    ),
    (
        "learner",
        "DreamerV3 updates per second, 12 million parameters",
        "{updates_per_s_12m} (SheepRL: {peer_updates_per_s_12m})",
    ),
    (
        "course",
        "Success from pixels in obstacle courses never seen before, after the paper's 22,000 steps",
        "{success_at_22000|%}",
    ),
    ("course", "Time until PPO succeeds in 99 % of new obstacle courses, compilation included", "{time_to_99_s} s"),
    (
        "course",
        "Success on the easier course that `make train` learns without a GPU, and the training time",
        "{cpu_success|%} in {cpu_minutes} min",
    ),
    (
        "fit",
        "Error on unseen drives divided by the difference between two repeats of one drive (best possible: 1.0)",
        "{plant_replicate_ratio}",
    ),
    (
        "measured",
        "Position error of a real skid-steered robot after 6 s on asphalt, compared with ideal replay",
        "{drive_gain_over_ideal_asphalt|%} less",
    ),
    (
        "undeclared",
        "Hidden effects named right, at twice the size that can just be noticed",
        "{class_accuracy_2x|%} (wrong: {wrong_name_2x|%})",
    ),
    ("undeclared", "False alarms on drives with nothing missing (upper 95 % bound)", "{false_alarm_upper|%}"),
)

PHYSICS, CAMERA, LEARNER, TRAINING = "Physics", "Camera and environment", "Learner", "Training"
FIT, MEASURED, MISSING, BRIDGE = "Fits", "Measured robots", "The missing effect", "ROS 2 bridge"


def _effect_costs(content: dict[str, Any]) -> list[Row]:
    names = sorted(name for name in content["figures"] if name.startswith("added_us_") and name != "added_us_loaded")
    cells = [(f"`{name[len('added_us_') :]}`", f"{{{name}}}") for name in names]
    cells += [("", "")] * (-len(cells) % 3)
    third = len(cells) // 3
    return [(*cells[i], *cells[i + third], *cells[i + 2 * third]) for i in range(third)]


def _promises(content: dict[str, Any]) -> list[Row]:
    every = (
        ("damaged files: undocumented exceptions", "fuzz_undocumented", "{fuzz_undocumented|.readers} readers"),
        ("damaged files: hangs", "fuzz_hangs", "{fuzz_hangs|.readers} readers"),
        ("damaged files: more than 500 MB", "fuzz_memory", "{fuzz_memory|.readers} readers"),
        ("mistaken commands: tracebacks", "option_tracebacks", "{option_tracebacks|.command_lines} lines"),
        ("kills: work lost beyond a minute", "kills_lost", "{kills_lost|.kills} kills"),
        ("kills: other bits in the end", "kills_different", "{kills_different|.kills} kills"),
        ("kills: half-written files", "kills_half_written", "{kills_half_written|.kills} kills"),
        ("Ctrl-C: ends without exit code 130", "ctrl_c_wrong_ends", "{ctrl_c_wrong_ends|.interrupts} interrupts"),
        ("Ctrl-C to exit, 95 % [s]", "ctrl_c_p95_s", "{ctrl_c_wrong_ends|.interrupts} interrupts"),
    )
    return [(what, f"{{{name}}}", of) for what, name, of in every if name in content["figures"]]


def _ablations(kind: Callable[[str], bool]) -> Callable[[dict[str, Any]], list[Row]]:
    def rows(content: dict[str, Any]) -> list[Row]:
        found: list[Row] = []
        for name, entry in sorted(content["figures"].items()):
            if name.startswith("ablation_") and name.endswith("_return") and kind(name):
                steps = entry.get("steps") or [0]
                found.append((_words(name), f"{{{name}}}", f"{{{name}|range}}", f"{{{name}|n}}", f"{max(steps):,}"))
        return found

    return rows


WORDS = {
    "avg": "averaged parameters", "raw": "last parameters", "lambda98": "return_lambda 0.98, imag_horizon 25",
    "lambda99": "return_lambda 0.99, imag_horizon 40", "lambda1": "return_lambda 1", "entropy": "entropy x 3",
    "entropy3e4": "entropy_scale 3e-4", "ratio1024": "train_ratio 1024", "ratio128": "train_ratio 128",
    "ratio32": "train_ratio 32", "horizon": "horizon 100", "horizon33": "horizon 33", "horizon50": "horizon 50",
    "horizon100": "horizon 100", "pull": "mean_pull", "slow": "slow behaviour", "starts": "exploring starts",
    "greedy": "greedy_share 0.25", "repeat2": "a decision every 2 steps", "repeat5": "a decision every 5 steps",
    "cpu": "", "return": "", "ablation": "", "again": "second run", "fixed": "", "64": "16 x 64",
    "min": "min_std 0.3",
    "std03": "", "lr": "falling learning rate", "short": "32 x 32, ratio 384, horizon 50 (the preset)",
    "barlow": "representation barlow", "together": "three seeds in one program", "noise": "noise with memory",
    "no": "without", "replay": "replayed", "value": "critic loss", "stored": "stored", "present": "as the preset is",
    "plain": "as it was first", "decay": "falling", "corridor": "corridor",
}  # fmt: skip


def _words(name: str) -> str:
    words = [WORDS.get(word, word) for word in name.split("_")]
    text = ", ".join(word for word in words if word)
    for wrong, right in (
        ("falling learning rate, falling", "falling learning rate"),
        ("entropy x 3, falling", "entropy falling"),
        ("without, replayed, critic loss", "no critic loss on replayed steps"),
        ("without, stored, latents", "no stored latents"),
        ("mean, mean_pull", "mean_pull"),
    ):
        text = text.replace(wrong, right)
    return text or "as it was before the present preset"


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


def _ladder(terrain: str) -> Row:
    return (
        terrain,
        f"{{ladder_{terrain}_position_ideal}}",
        f"{{ladder_{terrain}_position_base}}",
        f"{{ladder_{terrain}_position_with_1_pose_delay}}",
        f"{{ladder_{terrain}_position_with_2_acceleration_limit_supply_sag_quadratic_drag}}",
        f"{{ladder_gain_{terrain}_position|%}}",
        f"{{ladder_gain_{terrain}_position_low|%}} to {{ladder_gain_{terrain}_position_high|%}}",
    )


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
    # Physics
    Claim(
        PHYSICS,
        "How many physics steps per second",
        "physics",
        'Million steps per second on one GPU. Every instance has parameters of its own. "Loaded" is the physical '
        'model '
        'with five more effects; "paper" is the reference paper\'s simpler model.',
        ("instances", "loaded", "physical", "paper"),
        tuple(
            (f"{count:,}", *(f"{{steps_per_s_{count}{kind}|1e-6}}" for kind in ("", "_physical", "_paper")))
            for count in (1024, 32768, 131072)
        )
        + (("two CPU cores", "{cpu_steps_per_s|1e-6}", "-", "-"),),
    ),
    Claim(
        PHYSICS,
        "Other simulators at equal error",
        "physics",
        "Simulated seconds per second. Each simulator takes the largest step that keeps a figure-eight within 2 "
        "mm and "
        '2 mrad of its own limit of small steps. "Ramped": speed commands are limited to 1.7 m/s^2, which needs '
        'no small '
        "steps of a contact solver.",
        ("simulator", "same commands", "ramped commands"),
        (
            ("ours, loaded, 32,768 instances", "{simulated_s_per_s_32768}", "the same"),
            (
                "MuJoCo Warp, 8,192 instances",
                "{peer_mujoco_warp_simulated_s_per_s}",
                "{peer_mujoco_warp_simulated_s_per_s_ramped}",
            ),
            ("C MuJoCo, 16 cores", "{peer_mujoco_c_simulated_s_per_s}", "{peer_mujoco_c_simulated_s_per_s_ramped}"),
            (
                "MJX, 8,192 instances",
                "{peer_mjx_contact_simulated_s_per_s}",
                "{peer_mjx_contact_simulated_s_per_s_ramped}",
            ),
        ),
    ),
    Claim(
        PHYSICS,
        "Error of the time step",
        "physics",
        "Distance from the same figure-eight (0.6 m/s, 0.6 rad/s) with eight times smaller steps, in double "
        "precision.",
        ("model", "step", "position [mm]", "heading [mrad]"),
        tuple(
            (model, f"{step} ms", f"{{{stem}_dt_{step}ms{end}}}", f"{{{stem}_dt_{step}ms{end}|.yaw_mrad}}")
            for model, stem, end, steps in (
                ("ours", "figure_eight_error", "", ("10", "5", "2.5", "1.25")),
                ("ours, floor of friction 0.1", "figure_eight_error_grip_0.1", "", ("10", "5", "2.5", "1.25")),
                ("contact chair", "peer_figure_eight_error", "", ("8", "4", "2", "1", "0.5")),
                ("contact chair, ramped", "peer_figure_eight_error", "_ramped", ("8", "4", "2", "1", "0.5")),
            )
            for step in steps
        ),
    ),
    Claim(
        PHYSICS,
        "Fitted model against the contact plant",
        "physics",
        "Largest difference at any time of the paper's five manoeuvres, driven open loop by the fitted model and "
        "by an "
        "independent contact simulation. Five days of the plant.",
        ("difference", "median", "range"),
        (
            ("position [m]", "{contact_five_manoeuvres_m}", "{contact_five_manoeuvres_m|range}"),
            ("heading [rad]", "{contact_five_manoeuvres_rad}", "{contact_five_manoeuvres_rad|range}"),
        ),
    ),
    Claim(
        PHYSICS,
        "What limits the speed",
        "physics",
        "One step of one loaded instance, before the compiler fuses anything, and the rates that an H200 would "
        "allow.",
        ("what", "number", "would allow [G steps/s]"),
        (
            ("operations", "{operations_per_step}", "{limit_arithmetic_steps_per_s|1e-9}"),
            (
                "transcendental functions",
                "{transcendentals_per_step}",
                "{limit_issue_steps_per_s|1e-9} (issue of instructions)",
            ),
            ("bytes moved", "{bytes_per_step}", "{limit_memory_steps_per_s|1e-9}"),
            ("share of the memory limit, 1,024 instances", "{share_of_limit_1024|%}", "-"),
            ("the same, 32,768 instances", "{share_of_limit_32768|%}", "-"),
            ("the same, 131,072 instances", "{share_of_limit_131072|%}", "-"),
            ("fixed time of a step [us]", "{step_us_fixed}", "-"),
            ("time per instance [ns]", "{step_ns_per_instance}", "-"),
        ),
    ),
    Claim(
        PHYSICS,
        "What one more effect costs",
        "physics",
        "Microseconds that an effect adds to one step of 32,768 instances. Negative: with it the compiler cuts "
        "the step "
        "into quicker kernels.",
        ("effect", "us", "effect", "us", "effect", "us"),
        _effect_costs,
    ),
    # Camera and environment
    Claim(
        CAMERA,
        "How many images per second",
        "camera",
        "Million images of 64x64 RGB per second.",
        ("scene", "GPU kernel", "plain JAX", "two CPU cores", "MuJoCo Warp"),
        (
            (
                "32 boxes, 16,384 scenes",
                "{frames_per_s_32box_16384|1e-6}",
                "{jnp_frames_per_s|1e-6}",
                "{cpu_frames_per_s|1e-6}",
                "{peer_mujoco_warp_frames_per_s|1e-6}",
            ),
            (
                "the same, four samples a pixel and shadows",
                "{frames_per_s_aa_shadow|1e-6}",
                "{jnp_frames_per_s_aa_shadow|1e-6}",
                "-",
                "-",
            ),
            ("corridor of 200 walls, 8 people", "{frames_per_s_map|1e-6}", "{jnp_frames_per_s_map|1e-6}", "-", "-"),
        ),
    ),
    Claim(
        CAMERA,
        "How many control steps per second",
        "environment",
        "Obstacle course with physics, camera image, reward and automatic reset.",
        ("device", "control steps per second"),
        (("one GPU", "{control_steps_per_s_course}"), ("two CPU cores", "{cpu_control_steps_per_s}")),
    ),
    # Learner
    Claim(
        LEARNER,
        "How many DreamerV3 updates per second",
        "learner",
        "One update of the size with 12 million parameters replays 16 sequences of 64 steps.",
        ("program", "updates/s", "replayed steps/s"),
        (
            ("as it is", "{updates_per_s_12m}", "{replayed_steps_per_s_12m}"),
            ("SheepRL, torch.compile", "{peer_updates_per_s_12m_compiled}", "-"),
            ("SheepRL, eager", "{peer_updates_per_s_12m_eager}", "-"),
            (
                "images of the replay in the host's memory",
                "{updates_per_s_12m_host_replay}",
                "{replayed_steps_per_s_12m_host_replay}",
            ),
            *(
                (
                    f"batch {count} x 64",
                    f"{{updates_per_s_12m_batch{count}}}",
                    f"{{replayed_steps_per_s_12m_batch{count}}}",
                )
                for count in (32, 64, 128, 256)
            ),
            *(
                (
                    f"{count} seeds in one program, all together",
                    f"{{updates_per_s_12m_seeds{count}}}",
                    f"{{replayed_steps_per_s_12m_seeds{count}}}",
                )
                for count in (2, 4, 8)
            ),
            ("preset `cpu`, two CPU cores", "-", "{cpu_replayed_steps_per_s}"),
            ("preset `size1m`, two CPU cores", "-", "{cpu_replayed_steps_per_s_1m}"),
        ),
    ),
    Claim(
        LEARNER,
        "Other ways to compile an update",
        "learner",
        "Updates per second of the same update, compiled otherwise.",
        ("change", "updates/s"),
        (
            ("none", "{updates_per_s_12m}"),
            ("recurrences not unrolled", "{updates_per_s_12m_unroll1}"),
            ("unrolled by 4 instead of 8", "{updates_per_s_12m_unroll4}"),
            ("weight gradients summed inside the scan", "{updates_per_s_12m_scan_gradients}"),
            ("nothing hoisted out of the scan", "{updates_per_s_12m_unhoisted}"),
            ("no CUDA graphs", "{updates_per_s_12m_no_command_buffers}"),
            ("CUDA graphs around whole loops", "{updates_per_s_12m_command_buffers_while}"),
            ("kernels not autotuned", "{updates_per_s_12m_no_autotune}"),
            ("deterministic kernels", "{updates_per_s_12m_deterministic}"),
        ),
    ),
    Claim(
        LEARNER,
        "Where the time of an update goes",
        "learner",
        "Milliseconds of the kernels of one update, from a trace.",
        ("part", "ms"),
        (
            ("observe: 64 steps and gradients", "{kernels_ms_observe_12m}"),
            ("imagine: 15 steps", "{kernels_ms_imagine_12m}"),
            ("encoder", "{kernels_ms_encoder_12m}"),
            ("decoder", "{kernels_ms_decoder_12m}"),
            ("heads", "{kernels_ms_heads_12m}"),
            ("optimiser", "{kernels_ms_optimiser_12m}"),
            ("replay", "{kernels_ms_replay_12m}"),
            ("other", "{kernels_ms_other_12m}"),
            ("all {kernels_per_update_12m} kernels", "{kernels_ms_per_update_12m}"),
        ),
    ),
    Claim(
        LEARNER,
        "One fused kernel for the posterior recurrence",
        "learner",
        "Milliseconds of the forward pass of 16 x 64. The fused kernel is no faster, so the scan stays.",
        ("program", "ms"),
        (
            ("the scan, as XLA compiles it", "{observe_forward_ms_12m}"),
            ("fused, 64 programs of 8 warps", "{observe_forward_ms_12m_fused_wide}"),
            ("fused, 128 programs of 8 warps", "{observe_forward_ms_12m_fused_8_warps}"),
            ("fused, 128 programs of 4 warps", "{observe_forward_ms_12m_fused}"),
            ("the same, weights loaded after the wait", "{observe_forward_ms_12m_fused_late}"),
            ("only the waits between programs", "{observe_forward_ms_12m_fused_waiting}"),
        ),
    ),
    Claim(
        LEARNER,
        "Tasks of others",
        "dreamer_control",
        "Return after training, of every seed. The cart-pole is the DeepMind Control Suite's, written anew in "
        "JAX (of 1,000); "
        "the grid world pays about 1.95 at best.",
        ("task", "median return", "range", "random actions", "minutes"),
        (
            (
                "cart-pole balance, pixels",
                "{balance_image_size12m_return}",
                "{balance_image_size12m_return|range}",
                "{balance_image_size12m_random_return}",
                "{balance_image_size12m_minutes}",
            ),
            (
                "cart-pole swing-up, pixels",
                "{swingup_image_size12m_return}",
                "{swingup_image_size12m_return|range}",
                "-",
                "{swingup_image_size12m_minutes}",
            ),
            (
                "cart-pole balance, joint angles, tiny network",
                "{balance_joints_tiny_return}",
                "{balance_joints_tiny_return|range}",
                "{balance_joints_tiny_random_return}",
                "{balance_joints_tiny_minutes}",
            ),
            (
                "grid world, tiny network",
                "{grid_tiny_return}",
                "{grid_tiny_return|range}",
                "{grid_tiny_random_return}",
                "{grid_tiny_minutes}",
            ),
        ),
    ),
    Claim(
        LEARNER,
        "Several GPUs",
        "scaling",
        "Work per GPU is fixed: 2,048 chairs, and 16 x 64 replayed steps. 100 % is as many times the rate of one "
        "GPU as "
        "there are GPUs.",
        ("GPUs", "environment steps/s", "of linear", "replayed steps/s", "of linear"),
        (
            ("1", "{env_steps_per_s_1}", "-", "{learner_replayed_steps_per_s_1}", "-"),
            *(
                (
                    str(count),
                    f"{{env_steps_per_s_{count}}}",
                    f"{{env_efficiency_{count}|%}}",
                    f"{{learner_replayed_steps_per_s_{count}}}",
                    f"{{learner_efficiency_{count}|%}}",
                )
                for count in (2, 4)
            ),
        ),
    ),
    # Training
    Claim(
        TRAINING,
        "Obstacle course with the paper's 22,000 steps",
        "course",
        "From 64x64 RGB. Return from 18,000 steps on. Success is over 200 episodes after the last step.",
        (
            "learner and layout",
            "median return",
            "range over seeds",
            "success",
            "range over seeds",
            "seconds to the goal",
        ),
        (
            (
                "DreamerV3, new layouts",
                "{return_at_18000_median}",
                "{return_at_18000_median|range}",
                "{success_at_22000|%}",
                "{success_at_22000|range %}",
                "{arrival_s_at_18000}",
            ),
            (
                "DreamerV3, one fixed layout",
                "{return_at_18000_median_fixed}",
                "{return_at_18000_median_fixed|range}",
                "{success_at_22000_fixed|%}",
                "{success_at_22000_fixed|range %}",
                "{arrival_s_at_18000_fixed}",
            ),
            (
                "PPO, new layouts",
                "{return_at_18000_median_ppo}",
                "{return_at_18000_median_ppo|range}",
                "{success_at_22000_ppo|%}",
                "{success_at_22000_ppo|range %}",
                "{arrival_s_at_18000_ppo}",
            ),
            (
                "PPO, one fixed layout",
                "{return_at_18000_median_fixed_ppo}",
                "{return_at_18000_median_fixed_ppo|range}",
                "{success_at_22000_fixed_ppo|%}",
                "{success_at_22000_fixed_ppo|range %}",
                "{arrival_s_at_18000_fixed_ppo}",
            ),
            (
                "planner that knows the scene",
                "{planner_return}",
                "-",
                "{planner_success|%}",
                "-",
                "{planner_arrival_s}",
            ),
        ),
        (
            "course_paper_randomised.png",
            "course_paper_fixed.png",
            "course_paper_randomised_ppo.png",
            "course_paper_fixed_ppo.png",
        ),
    ),
    Claim(
        TRAINING,
        "Obstacle course with as many steps as wanted",
        "course",
        "Preset `wallclock`. PPO stops after two evaluations above 99 %; success is then over 1,000 other worlds. "
        "DreamerV3 was stopped at 3 of 8 million steps.",
        ("learner", "seconds until 99 %", "range over seeds", "success", "return", "training [s]"),
        (
            (
                "PPO",
                "{time_to_99_s}",
                "{time_to_99_s|range}",
                "{wallclock_success_ppo|%}",
                "{wallclock_return_ppo}",
                "{wallclock_training_s_ppo}",
            ),
            (
                "DreamerV3, stopped",
                "-",
                "-",
                "{wallclock_success_stopped|%}",
                "{wallclock_return_stopped}",
                "{wallclock_training_s_stopped}",
            ),
        ),
        ("course_wallclock_randomised_ppo.png", "course_wallclock_randomised_stopped.png"),
    ),
    Claim(
        TRAINING,
        "Easier obstacle course without a GPU",
        "course",
        "What `make train` learns on a CPU: forward only, one gate, a decision every 0.5 s. 100 episodes.",
        ("figure", "median", "range over seeds"),
        (
            ("success", "{cpu_success|%}", "{cpu_success|range %}"),
            ("training [min]", "{cpu_minutes}", "{cpu_minutes|range}"),
            ("first sign of learning [min]", "{cpu_first_sign_minutes}", "{cpu_first_sign_minutes|range}"),
            ("success of random actions", "{cpu_random_success|%}", "{cpu_random_success|range %}"),
        ),
        ("course_cpu_randomised.png",),
    ),
    Claim(
        TRAINING,
        "Corridor after 200,000 steps",
        "corridor",
        "New corridors with random paint and light. DreamerV3: 1,000 episodes a seed; PPO: 200.",
        ("learner", "success", "range over seeds", "collisions", "training [s]"),
        (
            ("DreamerV3", "{success|%}", "{success|range %}", "{collisions|%}", "{wallclock_s}"),
            ("PPO", "{success_ppo|%}", "{success_ppo|range %}", "{collisions_ppo|%}", "-"),
        ),
        ("corridor.png", "corridor_ppo.png"),
    ),
    Claim(
        TRAINING,
        "Sight in another simulator",
        "sight",
        "A policy of the preset `transfer` drives in a foreign corridor: another simulator, renderer, textures and "
        "furniture (`benchmarks/foreign`). Medians and ranges over three seeds, each stopped after 120,000 of its "
        "200,000 steps, 60 drives a seed and variant. The policy of the preset `paper` drove 18 to 23 times. With the "
        "stop, a drive ends where the policy is surprised beyond its own limit.",
        ("what", "plain", "furnished", "never seen"),
        (
            ("arrived", "{foreign_plain|%}", "{foreign_furnished|%}", "{foreign_unseen|%}"),
            ("of each seed", *(f"{{foreign_{one}|range %}}" for one in ("plain", "furnished", "unseen"))),
            ("collided", *(f"{{foreign_{one}_collided|%}}" for one in ("plain", "furnished", "unseen"))),
            ("arrived, with the stop", *(f"{{foreign_with_stop_{one}|%}}" for one in ("plain", "furnished", "unseen"))),
            ("collided, with the stop",
             *(f"{{foreign_with_stop_{one}_collided|%}}" for one in ("plain", "furnished", "unseen"))),
            ("arrived, preset `paper`", *(f"{{foreign_paper0_{one}_arrived|%}}"
                                          for one in ("plain", "furnished", "unseen"))),
            ("arrived, straight ahead", *(f"{{foreign_straight_{one}_arrived|%}}"
                                          for one in ("plain", "furnished", "unseen"))),
            ("arrived, a planner that knows all", *(f"{{foreign_planner_{one}_arrived|%}}"
                                                    for one in ("plain", "furnished", "unseen"))),
        ),
    ),  # fmt: skip
    Claim(
        TRAINING,
        "Seconds until something happens",
        "speed",
        "Fresh processes: the first finds no compiled programs, the others what it left, with another seed. "
        "The host did other work beside them.",
        ("what", "cold [s]", "warm [s]"),
        (
            ("first step of a `WhillEnv`, one GPU", "{env_first_step_cold_s}", "{env_first_step_warm_s}"),
            ("PPO to 99 % of new obstacle courses, one GPU", "{ppo_99_cold_s}", "{ppo_99_warm_s}"),
        ),
    ),
    Claim(
        TRAINING,
        "Proofs of sight",
        "course",
        "Success of trained policies that cannot see. A policy that uses its camera fails in all three. In a "
        "fixed layout "
        "replayed actions succeed, as they must.",
        ("policy", "black images", "first image kept", "actions of another episode"),
        (
            (
                "obstacle course, fixed layout",
                "{blinded_blank_success_fixed|%}",
                "{blinded_freeze_success_fixed|%}",
                "{blinded_replay_success_fixed|%}",
            ),
            (
                "obstacle course, PPO `wallclock`",
                "{wallclock_blinded_blank_success_ppo|%}",
                "{wallclock_blinded_freeze_success_ppo|%}",
                "{wallclock_blinded_replay_success_ppo|%}",
            ),
            (
                "easier course of a CPU",
                "{cpu_blinded_blank_success|%}",
                "{cpu_blinded_freeze_success|%}",
                "{cpu_blinded_replay_success|%}",
            ),
            (
                "corridor",
                "{corridor:blinded_blank_success|%}",
                "{corridor:blinded_freeze_success|%}",
                "{corridor:blinded_replay_success|%}",
            ),
        ),
    ),
    Claim(
        TRAINING,
        "Settings tried on the paper's course, new layouts",
        "course",
        "Median return in the last quarter of each run (planner: 225). Each line names what differs from the "
        "preset of its "
        "time; the result file has all settings.",
        ("settings", "median", "range over seeds", "seeds", "steps"),
        _ablations(lambda name: "_cpu_" not in name and "fixed" not in name and "corridor" not in name),
    ),
    Claim(
        TRAINING,
        "Settings tried on the paper's course, fixed layout",
        "course",
        "As above.",
        ("settings", "median", "range over seeds", "seeds", "steps"),
        _ablations(lambda name: "fixed" in name),
    ),
    Claim(
        TRAINING,
        "Settings tried on the easier course of a CPU",
        "course",
        "As above.",
        ("settings", "median", "range over seeds", "seeds", "steps"),
        _ablations(lambda name: "_cpu_" in name),
    ),
    # Fits
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
            ("contact plant, six other days", "{contact_replicate_ratio} ({contact_replicate_ratio|range})", "-", "-"),
            (
                "the dataset that ships, `sysid/data/chair`",
                "{chair_replicate_ratio}",
                "{rmse_chair_fitted}",
                "{rmse_chair_ideal}",
            ),
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
            ("the same, compiled by an earlier fit", "{cpu_seconds_compiled}"),
            ("the whole fit, two CPU cores", "{cpu_seconds_whole}"),
            ("32 starts at once, GPU, compiled before", "{gpu_seconds}"),
            ("their compilation", "{gpu_seconds_compile}"),
            ("TPE, the paper's 500 parameter sets, one CPU core", "{tpe500_cpu_seconds}"),
            ("the same, GPU", "{tpe500_gpu_seconds}"),
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
                ("the same, our compilation included", "peer_mujoco_sysid_ratio_with_compilation"),
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
    # Measured robots
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
        "Held-out position error [m] after 6 s of ideal replay, of the fitted base, with the late pose "
        "(`pose_delay`), and with a ramp of the command, a sagging supply and drag beside it. The loop named these "
        "one after the other. The gain is over the fitted base, with its 95 % interval. A network that knows only "
        "the commands: {peer_network_position} m.",
        ("terrain", "ideal", "base", "with the late pose", "with all four", "gain", "interval"),
        tuple(_ladder(terrain) for terrain in ("all", "asphalt", "gravel", "sand")),
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
    # The missing effect
    Claim(
        MISSING,
        "How often the verdict is right",
        "undeclared",
        "Logs of an independent contact plant. 26 effects of the catalogue, most with another law, and 8 beyond "
        "it. 1x is the "
        'size that 80 % of all logs would notice. "Right": the name or a member of its class.',
        ("figure", "2x", "4x", "2x, twice the noise", "4x, twice the noise", "4x, heavy scooter"),
        tuple(
            (
                label,
                *(
                    f"{{{name}{kind}|{form}}}" if form else f"{{{name}{kind}}}"
                    for kind in ("_2x", "_4x", "_2x_noise_2", "_4x_noise_2", "_4x_scooter")
                ),
            )
            for label, name, form in (
                ("named right", "class_accuracy", "%"),
                ("named wrong", "wrong_name", "%"),
                ("noticed", "noticed", "%"),
                ("right names with a warning", "warned_right", "%"),
                ("members of a class", "mean_class_size", ""),
                ("beyond the catalogue: `unexplained`", "out_of_catalogue", "%"),
            )
        ),
    ),
    Claim(
        MISSING,
        "False alarms and other checks of the verdict",
        "undeclared",
        "The same logs.",
        ("figure", "value"),
        (
            (
                "false alarms, {false_alarms} of 228 logs with nothing missing; upper 95 % bound",
                "{false_alarm_upper|%}",
            ),
            ("false alarms on 200 refitted simulated days of one log", "{refitted_null_alarms}"),
            ("Kolmogorov-Smirnov p-value of the calibrated p-values (uniform if large)", "{null_ks_p}"),
            ("two effects at once: both named right, 90 logs", "{pair_both|%}"),
            ("the same where both are at least at 2x, 58 logs", "{pair_both_2x|%}"),
            ("two effects at once: a wrong name, 90 logs", "{pair_wrong|%}"),
            ("effect taken out of the catalogue, 26 logs: `unexplained`", "{left_out_unexplained|%}"),
            ("the same: named outside its class", "{left_out_outside_class|%}"),
            ("the same: named wrong without a warning", "{left_out_wrong|%}"),
            ("95 % intervals that hold the planted size, of 80", "{interval_coverage|%}"),
            ("error of the size, median", "{parameter_error|%}"),
            ("held-out error after naming, over the replicates' difference", "{heldout_ratio}"),
        ),
    ),
    Claim(
        MISSING,
        "Sensors and floor noisier or quieter than on the reference days",
        "undeclared",
        "Disturbances and sensor noise of the log times a factor; the reference days keep the usual ones. 40 logs with "
        "nothing missing for each factor.",
        ("figure", "0.5", "2", "4"),
        (
            (
                "false alarms",
                *(f"{{false_alarms_sensor_noise_{level}}}" for level in ("0.5", "2", "4")),
            ),
            (
                "upper 95 % bound of their rate",
                *(f"{{false_alarm_upper_sensor_noise_{level}|%}}" for level in ("0.5", "2", "4")),
            ),
            (
                "noise factors inside their 95 % interval, of 200",
                *(f"{{noise_factor_coverage_sensor_noise_{level}|%}}" for level in ("0.5", "2", "4")),
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
            ("the same, GPU", "{gpu_seconds|0.0166667}"),
            ("without refitted days, two CPU cores", "{cpu_quick_seconds|0.0166667}"),
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
        ("set", "verdict", "looks the same", "values", "before", "after"),
        _shared,
    ),
    Claim(
        FIT,
        "Whether faults of driving logs are named",
        "logs",
        "Logs of robots of many sizes with one fault of time or of frames each. Rightly named means that the sentence "
        "says what it is, and no other sentence says what is not so. Faults too small to matter to a fit do not count.",
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
    # The code
    Claim(
        "The code itself",
        "How easily the code is entered",
        "house",
        "Counted from the sources. A floor is a step of the longest chain of imports inside a package.",
        ("figure", "value"),
        (
            ("import circles", "{import_circles}"),
            ("floors of `sysid`", "{import_floors_sysid}"),
            ("files at the top of `sysid`", "{files_top_sysid}"),
            ("files at the top of `whill_mjx`", "{files_top_whill_mjx}"),
            ("files for a new effect that can be named", "{files_per_new_effect}"),
            ("functions over 60 lines", "{functions_over_60}"),
            ("functions with more than 6 arguments", "{functions_over_6_arguments}"),
            ("lines of `sysid`", "{lines_sysid}"),
            ("sentences over 35 words in README and docs", "{sentences_over_35_words}"),
        ),
    ),
    Claim(
        "The code itself",
        "Nothing lost, nothing silent",
        "reliability",
        "Damaged files, mistaken commands, kills and Ctrl-C at random moments; each count should be 0.",
        ("figure", "value", "of"),
        _promises,
    ),
    # Bridge
    Claim(
        BRIDGE,
        "Latency, delivery and stops",
        "bridge",
        'Measured between processes on two busy CPU cores. "Real time": `--realtime 20`.',
        ("figure", "usual", "real time"),
        (
            ("frame to command, median [ms]", "{frame_to_command_p50_ms}", "{frame_to_command_p50_realtime_ms}"),
            ("frame to command, 99 % [ms]", "{frame_to_command_p99_ms}", "{frame_to_command_p99_realtime_ms}"),
            ("frame to command, largest [ms]", "{frame_to_command_max_ms}", "{frame_to_command_max_realtime_ms}"),
            ("720p frame to command, 99 % [ms]", "{frame_720p_p99_ms}", "{frame_720p_p99_realtime_ms}"),
            ("720p frames delivered", "{frames_720p_delivered|%}", "{frames_720p_delivered_realtime|%}"),
            ("error of the pace, 99 % [ms]", "{tick_error_p99_ms}", "{tick_error_p99_realtime_ms}"),
            ("policy step, 99 % [ms]", "{policy_p99_ms}", "-"),
            ("cold start [s]", "{cold_start_s}", "-"),
            ("stop when images cease [ms]", "{stop_input_ms}", "-"),
            ("stop on a bad action [ms]", "{stop_action_ms}", "-"),
            ("stop when the policy node is killed [ms]", "{stop_killed_ms}", "-"),
            ("commands from before a reset, 19 resets", "{stale_after_reset}", "-"),
        ),
    ),
)
