"""Claims about the speed and the error of physics, camera and environment."""

from __future__ import annotations

from typing import Any

from benchmarks.claims.claim import Claim, Row

PHYSICS = "Physics"
CAMERA = "Camera and environment"


def _effect_costs(content: dict[str, Any]) -> list[Row]:
    names = sorted(name for name in content["figures"] if name.startswith("added_us_") and name != "added_us_loaded")
    cells = [(f"`{name[len('added_us_') :]}`", f"{{{name}}}") for name in names]
    cells += [("", "")] * (-len(cells) % 3)
    third = len(cells) // 3
    return [(*cells[i], *cells[i + third], *cells[i + 2 * third]) for i in range(third)]


CLAIMS = (
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
        "One kernel against a loop",
        "physics",
        "Million steps per second on one GPU: all steps of a control period in one kernel, and a compiled loop over "
        "the steps, in turns.",
        ("instances", "vehicle", "loop", "kernel", "times as fast"),
        tuple(
            (f"{count:,}", kind, *(f"{{{way}_steps_per_s_{count}{end}|1e-6}}" for way in ("scan", "kernel")),
             f"{{kernel_over_scan_{count}{end}}}")
            for count in (1024, 32768, 131072)
            for kind, end in (("loaded", ""), ("physical", "_physical"), ("paper", "_paper"))
        ),
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
            ("ours, loaded, 32,768 instances", "{simulated_s_per_s_32768}", "{simulated_s_per_s_32768}"),
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
            ("share of the memory limit, 32,768 instances", "{share_of_limit_32768|%}", "-"),
            ("share of the memory limit, 131,072 instances", "{share_of_limit_131072|%}", "-"),
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
                "32 boxes, 16,384 scenes, four samples a pixel and shadows",
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
        "What rich looks cost",
        "sight",
        "Per second, corridor, 16,384 worlds, images of 64x64 RGB. Rich looks have materials with grain and wear, "
        "lamps with soft shadows, things along the walls and a film model. Images and control steps of the kernel were "
        "timed in the commit in which it came. Another order of its arithmetic, on another day, gave 7 % fewer images "
        "and as many steps; it is not in use.",
        ("looks", "images", "images, plain JAX", "control steps with image"),
        (
            ("rich", "{rich_frames_per_s}", "{rich_jnp_frames_per_s}", "{rich_control_steps_per_s}"),
            ("paper", "-", "-", "{paper_control_steps_per_s}"),
        ),
    ),
    Claim(
        CAMERA,
        "How many control steps per second",
        "environment",
        "Control steps per second with physics, sensors, reward and automatic reset.",
        ("environment", "one GPU", "two CPU cores"),
        (
            ("obstacle course, camera image", "{control_steps_per_s_course}", "{cpu_control_steps_per_s}"),
            ("obstacle course, camera image, depth, 360 laser rays and odometry", "{control_steps_per_s_sensors}",
             "{cpu_control_steps_per_s_sensors}"),
            ("a real map with 8 people, camera image", "{control_steps_per_s_map}", "-"),
        ),
    ),
)
