"""Claims about the learner and its trainings."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from benchmarks.claims.claim import Claim, Row

LEARNER = "Learner"
TRAINING = "Training"


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


def _ablations(kind: Callable[[str], bool]) -> Callable[[dict[str, Any]], list[Row]]:
    def rows(content: dict[str, Any]) -> list[Row]:
        found: list[Row] = []
        for name, entry in sorted(content["figures"].items()):
            if name.startswith("ablation_") and name.endswith("_return") and kind(name):
                steps = entry.get("steps") or [0]
                found.append((_words(name), f"{{{name}}}", f"{{{name}|range}}", f"{{{name}|n}}", f"{max(steps):,}"))
        return found

    return rows


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


CLAIMS = (
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
            ("fused, 128 programs of 4 warps, weights loaded after the wait", "{observe_forward_ms_12m_fused_late}"),
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
        "Work per GPU is fixed: 2,048 chairs, and 16 x 64 replayed steps. 100 % means that N GPUs reach N "
        "times the rate of one.",
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
        "New corridors with random paint and light. DreamerV3: 1,000 episodes a seed; PPO: 200. Three seeds each.",
        ("learner", "success", "range over seeds", "collisions", "training [s]"),
        (
            ("DreamerV3", "{success|%}", "{success|range %}", "{collisions|%}", "{wallclock_s}"),
            (
                "DreamerV3, another vehicle in each training episode (10 % spread)",
                "{success_dynamics|%}", "{success_dynamics|range %}", "{collisions_dynamics|%}", "-",
            ),
            ("PPO", "{success_ppo|%}", "{success_ppo|range %}", "{collisions_ppo|%}", "-"),
        ),
        ("corridor.png", "corridor_dynamics.png", "corridor_ppo.png"),
    ),
    Claim(
        TRAINING,
        "Sight in another simulator",
        "sight",
        "A policy of the preset `transfer` drives in a foreign corridor: another simulator, renderer, textures and "
        "furniture (`benchmarks/foreign`). Medians and ranges over three seeds of the whole budget, 200 drives a seed "
        "and variant. The policy of the preset `paper` drove 18 to 23 times. With the stop, a drive ends where the "
        "policy is surprised beyond its own limit. In rooms never seen three later trainings drove 71 to 75 times "
        "each, without the stop and with weights rounded to half precision. In the trainings before, the GPU drew "
        "neighbouring cells of a material in one tone, which is mended. The rank correlation is that of success here "
        "and there, over 12 policies of the trainings before. All of these trainings kept eight paints of each drive. "
        "The preset now draws images anew; a note has [one training with it](notes/unseen_rooms.md).",
        ("what", "plain", "furnished", "never seen"),
        (
            ("arrived", "{foreign_plain|%}", "{foreign_furnished|%}", "{foreign_unseen|%}"),
            ("arrived, of each seed", *(f"{{foreign_{one}|range %}}" for one in ("plain", "furnished", "unseen"))),
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
            *((f"obstacle course: arrived, {said}",
               *(f"{{foreign_obstacle_course_{who}_{one}_arrived|%}}" for one in ("plain", "furnished", "unseen")))
              for who, said in (("planner", "a planner that knows all"), ("straight", "straight ahead"))),
            ("rank correlation", "{srcc_plain}", "{srcc_furnished}", "{srcc_unseen}"),
        ),
    ),  # fmt: skip
    Claim(
        TRAINING,
        "Point goals among people, in buildings that no training saw",
        "environment",
        "Eight people within 10 m, half of whom ignore the vehicle. PPO trains for some minutes on an H200, on two "
        "recordings of an office and eight made floor plans, and drives in two other buildings. Three seeds with the "
        "laser scan and a collision monitor on it that left 20 cm, trained side by side on one H200 for 5 minutes. One "
        "seed with the other senses, without a monitor, trained for 3.3 minutes by an earlier reward. "
        "A collision is the vehicle's own fault; people who walk into the vehicle are counted apart. Blinded is the "
        "better of black or empty readings and the first ones kept.",
        ("what", "laser scan", "range over seeds", "scan and camera", "camera"),
        tuple((what, f"{{among_lidar_{name}|%}}", f"{{among_lidar_{name}|range %}}", f"{{among_both_{name}|%}}",
               f"{{among_camera_{name}|%}}")
              for what, name in (
                  ("arrived", "arrived"), ("collided", "collided"), ("out of time", "timeout"),
                  ("somebody walked into the vehicle", "bumped"), ("arrived, blinded", "blinded"),
                  ("arrived, with the goal alone", "goal_alone"))),
    ),  # fmt: skip
    Claim(
        TRAINING,
        "Seconds until something happens",
        "speed",
        "Fresh processes: the first finds no compiled programs, the others what it left, with another seed. "
        "The host did other work beside them. A note shows [where compilation spends its time](notes/compilation.md).",
        ("what", "cold [s]", "warm [s]"),
        (
            ("first step of a training (obstacle course), one GPU", "{first_step_cold_s}", "{first_step_warm_s}"),
            ("first step of a `WhillEnv`, one GPU", "{env_first_step_cold_s}", "{env_first_step_warm_s}"),
            ("PPO to 99 % of new obstacle courses, one GPU", "{ppo_99_cold_s}", "{ppo_99_warm_s}"),
            ("DreamerV3, the obstacle course's whole training, one GPU", "{course_cold_s}", "{course_warm_s}"),
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
        "Median return in the last quarter of each run. Each line names what differs from the preset of its time.",
        ("settings", "median", "range over seeds", "seeds", "steps"),
        _ablations(lambda name: "fixed" in name),
    ),
    Claim(
        TRAINING,
        "Settings tried on the easier course of a CPU",
        "course",
        "Median return in the last quarter of each run. Each line names what differs from the preset of its time.",
        ("settings", "median", "range over seeds", "seeds", "steps"),
        _ablations(lambda name: "_cpu_" in name),
    ),
)
