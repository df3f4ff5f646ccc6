"""The claims that the recorded figures support: what each table says, and which figures are in it.

A cell is text with figures in braces: {name}, {name|form} or {file:name|form}; `tables.shown` lists the forms.
"""

from __future__ import annotations

from benchmarks.claims import effects, fits, learning, running, simulator
from benchmarks.claims.claim import Claim as Claim

HEADLINES = (  # file, what, value
    (
        "physics",
        "Physics steps per second on one GPU: 32,768 chairs at once, each with other parameters",
        "{steps_per_s_32768|1e-6} million",
    ),
    (
        "sight",
        "Success of a camera policy in another simulator: furnished corridors",
        "{foreign_furnished|%}",
    ),
    (
        "learner",
        "DreamerV3 updates per second: 12 million parameters, 16 sequences of 64 steps",
        "{updates_per_s_12m}",
    ),
    (
        "course",
        "Success from pixels in new obstacle courses, after the reference paper's 22,000 steps",
        "{success_at_22000|%}",
    ),
    ("speed", "Time until PPO succeeds in 99 % of new obstacle courses, compilation included", "{ppo_99_cold_s} s"),
    (
        "course",
        "Success on the easier course that `make train` learns without a GPU, and the training time",
        "{cpu_success|%} in {cpu_minutes} min",
    ),
    (
        "fit",
        "Position error on drives never fitted, over the difference of two repeats of one drive (best: about 1.0)",
        "{plant_replicate_ratio}",
    ),
    (
        "measured",
        "Position of a real robot, predicted 6 s ahead: error, compared with a vehicle that obeys its commands at once",
        "{drive_gain_over_ideal_asphalt|%} less",
    ),
    (
        "undeclared",
        "Logs with one hidden effect that is named right, at two to four times the size that could just be noticed; "
        "with two at once, both",
        "{class_accuracy_fresh|%} of {class_accuracy_fresh|.n} (wrong: {wrong_name_fresh|%}); "
        "{pair_both_fresh|%} of {pair_both_fresh|.n} (wrong: {pair_wrong_fresh|%})",
    ),
    (
        "undeclared",
        "False alarms on fresh drives with nothing missing, and the upper 95 % bound",
        "{false_alarms_fresh} of {false_alarms_fresh|.n}, {false_alarm_upper_fresh|%}",
    ),
)

CLAIMS = (*simulator.CLAIMS, *learning.CLAIMS, *fits.CLAIMS, *effects.CLAIMS, *running.CLAIMS)
