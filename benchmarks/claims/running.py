"""Claims about the code, what it promises, and the bridge."""

from __future__ import annotations

from typing import Any

from benchmarks.claims.claim import Claim, Row

BRIDGE = "ROS 2 bridge"


def _promises(content: dict[str, Any]) -> list[Row]:
    every = (
        ("damaged files: undocumented exceptions", "fuzz_undocumented", "{fuzz_undocumented|.readers} readers"),
        ("damaged files: hangs", "fuzz_hangs", "{fuzz_hangs|.readers} readers"),
        ("damaged files: more than 500 MB", "fuzz_memory", "{fuzz_memory|.readers} readers"),
        ("mistaken commands: tracebacks", "option_tracebacks", "{option_tracebacks|.command_lines} lines"),
        ("kills: work lost beyond a minute", "kills_lost", "{kills_lost|.kills} kills"),
        ("kills: other bits in the end", "kills_different", "{kills_different|.ended} ended runs"),
        ("kills: half-written files", "kills_half_written", "{kills_half_written|.kills} kills"),
        ("kills: tracebacks or wrong exit codes", "kills_wrong_ends", "{kills_wrong_ends|.kills} kills"),
        ("Ctrl-C: ends without exit code 130", "ctrl_c_wrong_ends", "{ctrl_c_wrong_ends|.interrupts} interrupts"),
        ("Ctrl-C to exit, 95 % [s]", "ctrl_c_p95_s", "{ctrl_c_wrong_ends|.interrupts} interrupts"),
    )
    return [(what, f"{{{name}}}", of) for what, name, of in every if name in content["figures"]]


def _newcomer(content: dict[str, Any]) -> list[Row]:
    """Rows of the figures of people.json that were recorded."""
    every = (
        ("seconds until the first picture", "clone_to_picture_s", ""),
        ("seconds until a vehicle is fitted to a log", "clone_to_vehicle_s", ""),
        ("seconds until a missing effect is named", "clone_to_effect_s", ""),
        *((f"seconds of the code of tutorial {number}", f"tutorial_{number}_s", "") for number in range(1, 7)),
        ("pages of docs with a picture", "pages_with_picture", "|%"),
    )
    return [(what, f"{{{name}{form}}}") for what, name, form in every if name in content.get("figures", ())]


def _faults(content: dict[str, Any]) -> list[Row]:
    """A row for each documented fault whose reaction was measured."""
    from benchmarks.bridge_faults import fault_rows

    rows: list[Row] = []
    for fault, checks in fault_rows():
        times = [name for name in checks if name.endswith("_ms") and name in content["figures"]]
        if times:
            rows.append((fault, ", ".join(f"{{{name}}}" for name in times),
                         ", ".join(f"{{{name}|range}}" for name in times)))  # fmt: skip
    return rows


CLAIMS = (
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
        "How soon a newcomer has a result",
        "people",
        "README's commands and the tutorials in a new folder, with no compiled programs kept; the installation is not "
        "counted.",
        ("figure", "value"),
        _newcomer,
    ),
    Claim(
        "The code itself",
        "Nothing lost, nothing silent",
        "reliability",
        "Damaged files, mistaken commands, kills and Ctrl-C at random moments; each count should be 0.",
        ("figure", "value", "of"),
        _promises,
    ),
    Claim(
        BRIDGE,
        "Latency, delivery and stops",
        "bridge",
        'Measured between processes, each drive on two cores. "Real time": `--realtime 20`.',
        ("figure", "usual", "real time"),
        (
            ("frame to command, median [ms]", "{frame_to_command_p50_ms}", "{frame_to_command_p50_realtime_ms}"),
            ("frame to command, 99 % [ms]", "{frame_to_command_p99_ms}", "{frame_to_command_p99_realtime_ms}"),
            ("frame to command, largest [ms]", "{frame_to_command_max_ms}", "{frame_to_command_max_realtime_ms}"),
            ("720p frame to command, 99 % [ms]", "{frame_720p_p99_ms}", "{frame_720p_p99_realtime_ms}"),
            ("720p frames delivered", "{frames_720p_delivered|%}", "{frames_720p_delivered_realtime|%}"),
            ("error of the pace, 99 % [ms]", "{tick_error_p99_ms}", "{tick_error_p99_realtime_ms}"),
            ("error of the pace beside two busy processes [ms]", "{interval_p99_ms}", "{interval_p99_realtime_ms}"),
            ("spurious stops of healthy drives", "{healthy_stops}", "-"),
            ("growth of memory in a drive [MB]", "{memory_growth_mb|range}", "-"),
            ("policy step, 99 % [ms]", "{policy_p99_ms}", "-"),
            ("cold start [s]", "{cold_start_s}", "-"),
            ("processes that wanted a core meanwhile", "{load_average}", "-"),
        ),
    ),
    Claim(
        BRIDGE,
        "Every fault, and the first zero after it",
        "bridge",
        "Time from the fault to the first zero that the base hears. After a foreign command: to the last own command.",
        ("fault", "reaction [ms]; {faults_load_average} processes wanted a core", "range"),
        _faults,
    ),
    Claim(
        BRIDGE,
        "The simulator as a robot, and the loop over topics",
        "bridge",
        "Resets: with images that come late and out of order. Loop: contact plant behind topics, one hidden effect. "
        "Six of ten draws were finished by the present code. The other four were named by earlier code; in one of them "
        "the held-out error rose by 94 %.",
        ("figure", "value"),
        (
            ("rows recorded at 100 Hz beside two busy processes", "{record_rows_kept|range %}"),
            ("images of an older episode, 10,000 resets", "{ros_env_stale_images}"),
            ("steps per second in lock-step, 64x64, of a point", "{ros_env_steps_per_s}"),
            ("reset over TCP with its image, 99 % [ms]", "{tcp_p99_ms}"),
            ("calls not served between 100,000 damaged messages", "{tcp_fuzz_failures}"),
            ("loop: hidden effect named", "{loop_named} of {loop_named|.count}"),
            ("loop: held-out error removed", "{loop_heldout_removed|%} ({loop_heldout_removed|range %})"),
        ),
    ),
)
