"""The claims that the recorded figures support: what each table says, and which figures are in it.

A cell is text with figures in braces: {name}, {name|form} or {file:name|form}; `tables.shown` lists the forms.
"""

from __future__ import annotations

from benchmarks.claims import effects, fits, learning, running, simulator
from benchmarks.claims.claim import Claim as Claim

HEADLINES = (  # file, what, value
    (
        "physics",
        "Physics steps per second: 32,768 chairs at once, each with five extra effects",
        "{steps_per_s_32768|1e-6} million",
    ),
    (
        "sight",
        "Success of a camera policy in a simulator it has never seen: furnished corridors (with unusual furniture)",
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
        "Error on unseen drives, divided by the difference of two repeats of one drive (best possible: about 1.0)",
        "{plant_replicate_ratio}",
    ),
    (
        "measured",
        "Position error of a real robot after 6 s on asphalt, compared with its commands replayed without a fit",
        "{drive_gain_over_ideal_asphalt|%} less",
    ),
    (
        "undeclared",
        "Hidden effects named right, at two to four times the size that could just be noticed (39 logs)",
        "{class_accuracy|%} (wrong: {wrong_name|%})",
    ),
    (
        "undeclared",
        "False alarms on drives with nothing missing (upper 95 % bound; none in 199 logs)",
        "{false_alarm_upper|%}",
    ),
)

CLAIMS = (*simulator.CLAIMS, *learning.CLAIMS, *fits.CLAIMS, *effects.CLAIMS, *running.CLAIMS)
