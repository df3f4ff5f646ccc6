"""How the benchmark of undeclared effects finds the size of an effect that is noticed with 80 % power."""

from __future__ import annotations

import json
import math
from functools import partial
from typing import get_args, get_type_hints

import pytest

pytest.importorskip("mujoco")

from benchmarks import undeclared_figures  # noqa: E402
from benchmarks import undeclared_plant as contact  # noqa: E402
from benchmarks.harness import record  # noqa: E402
from benchmarks.plant.chair import VEHICLES  # noqa: E402
from benchmarks.undeclared import Benchmark  # noqa: E402
from benchmarks.undeclared_reference import Driven  # noqa: E402
from sysid.verdict.posterior import Findings, Left, TriedSet, as_json  # noqa: E402

LIMIT = 4.0
NOTHING = {"stage": "null", "scale": 0.0, "verdict": "none", "share": 0.0, "p_value": 0.4, "effects": [],
           "seconds": 1.0}
"""Verdict on a log with nothing in it."""


def write(work, name, number, size, found):
    """A verdict at one size, where the effect stands out `found` times as far as 80 % power needs."""
    worth = LIMIT * found * (1 + contact.POWER / LIMIT**0.5) ** 2
    one = {"stage": "base", "worth": worth, "worth_limit": LIMIT, "excess": [-1.0, 0.0], "excess_limit": 0.1}
    for folder, content in (("verdicts", one), ("truth", {name: size})):
        (work / folder).mkdir(exist_ok=True)
        (work / folder / f"{name}_probe_{number}.json").write_text(json.dumps(content))


def search(work, name, base, strength):
    """Sizes tried until the search ends; `strength` is how far an effect of a size stands out."""
    tried = []
    while (size := contact.next_size(base, contact.seen_at(work, name))) is not None:
        write(work, name, len(tried), size, strength(size))
        tried.append(size)
    return tried


@pytest.mark.quick
@pytest.mark.parametrize("factor", [0.05, 0.3, 1.0, 30.0])
def test_the_size_of_an_effect_that_grows_linearly_is_found_from_any_base(tmp_path, factor):
    name, right = "slope", 0.5
    tried = search(tmp_path, name, right * factor, lambda size: (size / right) ** 2)
    assert len(tried) <= contact.PROBES
    assert contact.power_sizes(tmp_path)[name] == pytest.approx(right, rel=0.05)


@pytest.mark.quick
def test_the_size_of_an_effect_with_a_threshold_is_bracketed(tmp_path):
    name = "command_dead_zone"
    search(tmp_path, name, 0.1, lambda size: 0.02 + 4e3 * max(size - 0.02, 0.0) ** 2)  # 1 at 0.0357
    assert 0.028 < contact.power_sizes(tmp_path)[name] < 0.045


@pytest.mark.quick
def test_an_effect_that_is_never_noticed_has_no_size(tmp_path):
    assert 1 < len(search(tmp_path, "backlash", 0.1, lambda size: 0.02)) <= contact.PROBES
    assert "backlash" not in contact.power_sizes(tmp_path)


@pytest.mark.quick
def test_every_log_belongs_to_one_process():
    both = [[job.label for job in contact.null_jobs(7, part)] for part in ("1/2", "2/2")]
    assert sorted(both[0] + both[1]) == [job.label for job in contact.null_jobs(7, "1/1")]
    assert not set(both[0]) & set(both[1])


@pytest.fixture
def results(tmp_path, monkeypatch):
    """A copy of the recorded figures, into which the benchmark writes."""
    path = tmp_path / "undeclared.json"
    path.write_text(contact.RECORDED.read_text())
    for module in (contact, undeclared_figures):
        monkeypatch.setattr(module, "RECORDED", path)
    monkeypatch.setattr(undeclared_figures, "record", partial(undeclared_figures.record, folder=tmp_path))
    return path


def judged(work, label, verdict, truth):
    """Leave one verdict, and what was in its log."""
    for folder, content in (("verdicts", verdict), ("truth", truth)):
        (work / folder).mkdir(exist_ok=True)
        (work / folder / f"{label}.json").write_text(json.dumps(content))


@pytest.mark.quick
def test_what_was_judged_in_another_folder_stays_recorded(tmp_path, results):
    recorded = json.loads(results.read_text())
    judged(tmp_path, "null_000", NOTHING, {})
    undeclared_figures.figures(tmp_path)
    after = json.loads(results.read_text())
    others = [row for row in recorded["confusion"] if row["stage"] != "null"]
    assert [row for row in after["confusion"] if row["stage"] != "null"] == others
    assert after["sizes"] == recorded["sizes"]
    assert after["figures"]["class_accuracy_4x"] == recorded["figures"]["class_accuracy_4x"]
    assert after["figures"]["false_alarms"]["unit"] == "of 1 logs with nothing in them"


@pytest.mark.quick
def test_logs_of_later_draws_have_figures_of_their_own_beside_those_of_the_first(tmp_path, results):
    recorded = json.loads(results.read_text())
    judged(tmp_path, "null_000", NOTHING, {})  # of draw 0, in the same folder
    for draw in (1, 2):
        judged(tmp_path, f"null_000_draw_{draw}", {**NOTHING, "draw": draw}, {})
    undeclared_figures.figures(tmp_path, Driven(draw=1))
    after = json.loads(results.read_text())
    before = [row["draw"] for row in recorded["confusion"] if row["stage"] == "null" and row.get("draw", 0)]
    count = len(before) + 2  # fresh draws count together
    assert after["figures"]["false_alarms_fresh"]["unit"] == f"of {count} logs with nothing in them"
    assert after["figures"]["false_alarms"] == recorded["figures"]["false_alarms"]
    assert after["sizes"] == recorded["sizes"]
    nulls = [row["draw"] for row in after["confusion"] if row["stage"] == "null" and row.get("draw", 0)]
    assert nulls == [*before, 1, 2]
    first = [row for row in recorded["confusion"] if not row.get("draw", 0)]
    assert [row for row in after["confusion"] if not row.get("draw", 0)] == first


@pytest.mark.quick
def test_fresh_draws_count_together_as_long_as_the_same_decision_judged_them(tmp_path, results):
    size = {"slope.along_x": {"value": 0.1, "interval": [0.09, 0.11]}}
    effect = {"name": "slope", "class": ["slope"], "parameters": size}
    wrong = {**NOTHING, "stage": "scaled", "scale": 4.0, "verdict": "unexplained", "excess": [0.5, 0.1],
             "excess_limit": 0.2}
    right = {**wrong, "verdict": "named", "effects": [effect]}

    def collected(draw, said):
        work = tmp_path / str(draw)
        work.mkdir()
        judged(work, f"slope_draw_{draw}", {**said, "draw": draw}, {"slope": 0.1})
        undeclared_figures.figures(work, Driven(draw=draw))
        return json.loads(results.read_text())["figures"]

    content = json.loads(results.read_text())
    content["confusion"] = [row for row in content["confusion"] if not row.get("draw", 0)]
    results.write_text(json.dumps(content))
    assert collected(1, right)["class_accuracy_4x_fresh"]["n"] == 1
    found = collected(2, wrong)
    assert (found["class_accuracy_4x_fresh"]["value"], found["class_accuracy_4x_fresh"]["n"]) == (0.5, 2)
    assert found["interval_coverage_fresh"]["n"] == found["warned_right_4x_fresh"]["n"] == 1  # of the first draw
    content = json.loads(results.read_text())
    assert {row["draw"] for row in content["confusion"] if row.get("draw")} == {1, 2}
    for row in content["confusion"]:
        row |= {"decision": "another"} if row.get("draw") == 1 else {}
    results.write_text(json.dumps(content))
    assert collected(3, right)["class_accuracy_4x_fresh"]["n"] == 2  # draws 2 and 3


@pytest.mark.quick
def test_another_noise_level_has_figures_and_verdicts_of_its_own(tmp_path, results):
    recorded = json.loads(results.read_text())
    verdict = {"stage": "scaled", "scale": 4.0, "verdict": "named", "share": 0.9, "p_value": 0.01, "seconds": 1.0,
               "excess": [1.0, 0.0], "excess_limit": 0.1,
               "effects": [{"name": "slope", "class": ["slope", "wind"], "parameters": {}}]}
    judged(tmp_path, "wind_x4_0", verdict, {"wind": 0.1})
    undeclared_figures.figures(tmp_path, Driven(noise=2.0))
    after = json.loads(results.read_text())
    assert after["figures"]["class_accuracy_4x_noise_2"]["value"] == 1.0
    assert after["figures"]["class_accuracy_4x"] == recorded["figures"]["class_accuracy_4x"]
    usual, other = ([row for row in content["confusion"] if (row.get("noise", 1.0) == 1.0) == is_usual]
                    for content, is_usual in ((recorded, True), (after, False)))  # fmt: skip
    assert [row for row in after["confusion"] if row.get("noise", 1.0) == 1.0] == usual
    assert [row["truth"] for row in other] == [{"wind": 0.1}]
    assert contact.power_sizes(tmp_path / "empty", Driven(noise=2.0))["wind"] == 2 * recorded["sizes"]["wind"]["value"]


@pytest.mark.quick
def test_logs_noisier_than_their_reference_days_have_figures_of_their_own(tmp_path, results):
    recorded = json.loads(results.read_text())
    levels = {"odometry.v": {"factor": 3.9, "interval": [3.5, 4.3], "changed": True},
              "pose.yaw": {"factor": 4.5, "interval": [4.1, 4.9], "changed": True}}
    judged(tmp_path, "noise_4_000", {**NOTHING, "stage": "noisy", "noise": 4.0, "noise_levels": levels}, {})
    judged(tmp_path, "pair_00_noise_4", {**NOTHING, "stage": "noisy", "noise": 4.0, "noise_levels": levels},
           {"slope": 0.1, "command_delay": 0.1})
    undeclared_figures.figures(tmp_path)
    after = json.loads(results.read_text())
    assert after["figures"]["false_alarms_sensor_noise_4"]["unit"].startswith("of 1 logs with nothing in them at 4 ")
    assert after["figures"]["noise_factor_coverage_sensor_noise_4"]["value"] == 0.5
    assert after["figures"]["pair_both_sensor_noise_4"]["value"] == 0.0
    assert after["figures"]["false_alarms"] == recorded["figures"]["false_alarms"]
    assert [row for row in after["confusion"] if row["stage"] != "noisy"] == [
        row for row in recorded["confusion"] if row["stage"] != "noisy"]


@pytest.mark.quick
def test_noisier_logs_of_all_kinds_are_mixed_and_dealt_to_processes(tmp_path):
    usual = contact.scaled_jobs(tmp_path, (4.0,), 1, "1/1") + contact.pair_jobs(tmp_path, 20, "1/1")
    jobs = contact.noisy_jobs(usual, (0.5, 2.0), 40, "1/1")
    assert len(jobs) == 2 * (40 + len(usual)) == len({job.label for job in jobs})
    assert {job.noise for job in jobs} == {0.5, 2.0}
    assert 0.4 < sum(bool(job.effects) for job in jobs[:50]) / 50 < 0.7
    assert {len(job.effects) for job in jobs} == {0, 1, 2}
    parts = [contact.noisy_jobs(usual, (0.5, 2.0), 40, part) for part in ("1/2", "2/2")]
    assert sorted(job.label for part in parts for job in part) == sorted(job.label for job in jobs)


@pytest.mark.quick
def test_another_vehicle_has_figures_of_its_own_and_sizes_in_proportion(tmp_path, results):
    recorded = json.loads(results.read_text())
    judged(tmp_path, "null_000", NOTHING, {})
    robot = Driven(vehicle="robot")
    undeclared_figures.figures(tmp_path, robot)
    after = json.loads(results.read_text())
    assert after["figures"]["false_alarms_robot"]["unit"] == "of 1 logs with nothing in them"
    assert after["figures"]["false_alarms"] == recorded["figures"]["false_alarms"]
    others, same = ([row for row in content["confusion"] if row.get("vehicle") != "robot"]
                    for content in (recorded, after))  # fmt: skip
    assert same == others
    sizes = contact.power_sizes(tmp_path / "empty", robot)
    assert sizes["wind"] == pytest.approx(recorded["sizes"]["wind"]["value"] * 21 / 54)
    assert sizes["command_delay"] == recorded["sizes"]["command_delay"]["value"]


@pytest.mark.quick
def test_every_vehicle_of_the_plant_can_be_asked_for():
    assert set(get_args(get_type_hints(Benchmark)["vehicle"])) == set(VEHICLES)


@pytest.mark.quick
def test_where_no_size_was_searched_for_the_recorded_ones_are_driven(tmp_path):
    recorded = json.loads(contact.RECORDED.read_text())["sizes"]
    assert contact.power_sizes(tmp_path) == {name: one["value"] for name, one in recorded.items()}


@pytest.mark.quick
def test_a_left_out_effect_is_judged_on_the_log_that_has_it(tmp_path):
    jobs = contact.left_out_jobs(tmp_path, "1/1")
    driven = {job.label: job for job in contact.scaled_jobs(tmp_path, (4.0,), 1, "1/1")}
    assert len(jobs) == sum(contact.EFFECTS[name].known for name in contact.power_sizes(tmp_path))
    for job in jobs:
        assert job.without == tuple(job.effects) and job.stage == "left_out"
        assert (driven[job.log].effects, driven[job.log].seed) == (job.effects, job.seed)
        assert job.label not in driven


@pytest.mark.quick
def test_a_name_outside_the_class_of_a_left_out_effect_is_wrong_unless_it_is_warned_of():
    def verdict(*members, left=0.0):
        return {"verdict": "named" if members else "unexplained", "excess": [9.0, left], "excess_limit": 0.1,
                "effects": [{"class": list(members)}] if members else []}

    found = undeclared_figures.of_left_out([("slope", verdict("wind", left=0.5)), ("slope", verdict()),
                                 ("slope", verdict("dry_friction")), ("slope", verdict("yaw_scrub", left=0.5)),
                                 ("wind", verdict("slope", "x")), ("backlash", verdict("jerk_limit"))],
                                {"backlash": {"backlash", "jerk_limit"}})
    assert found["left_out_wrong"]["value"] == pytest.approx(1 / 6)  # dry friction for a slope
    assert found["left_out_outside_class"]["value"] == pytest.approx(2 / 6)
    assert found["left_out_unexplained"]["value"] == pytest.approx(1 / 6)
    said = {**verdict("dry_friction"), "warnings": ["it may be another effect"]}
    assert undeclared_figures.of_left_out([("slope", said)], {})["left_out_wrong"]["value"] == 0


@pytest.mark.quick
def test_the_class_of_a_log_is_that_of_its_verdict_at_four_times_the_size(tmp_path):
    own = undeclared_figures.own_classes(tmp_path)  # from the recorded verdicts
    assert own["clock_offset"] == {"clock_offset", "sensor_delay"} and "backlash" in own


@pytest.mark.quick
def test_committed_classes_are_small_and_of_the_catalogue():
    sensors = json.loads(undeclared_figures.CLASSES.read_text())["sensors"]
    sizes = [one["mean_size"] for one in sensors.values()]
    assert sizes == sorted(sizes, reverse=True)  # more sensors tell more apart
    for one in sensors.values():
        for name, members in one["classes"].items():
            assert members[0] == name and len(members) <= 4 and set(members) <= set(one["classes"])


@pytest.mark.quick
def test_one_lucky_log_does_not_set_the_size_of_an_effect_that_strikes_at_random(tmp_path):
    """Lost messages: a few of them may hit the start of a drive, and many may hit nothing."""
    name, right, base = "command_dropouts", 0.05, 0.08
    lucky = iter([3.0, 0.8, 2.0, 0.5, 1.2, 0.9])
    write(tmp_path, name, 7, 0.0024, 1.1)  # in another search's path a lucky log came first
    write(tmp_path, name, 8, 0.0097, 0.02)
    tried = []
    while (size := contact.next_size(base, contact.seen_at(tmp_path, name))) is not None:
        write(tmp_path, name, len(tried), size, (size / right) ** 2 * next(lucky))
        tried.append(size)
    assert len(tried) + 2 <= contact.PROBES
    assert 0.02 < contact.power_sizes(tmp_path)[name] < 0.12


@pytest.mark.quick
def test_a_size_is_believed_only_after_a_second_log(tmp_path):
    name = "command_dropouts"
    write(tmp_path, name, 0, 0.08, 1.0)
    again = contact.next_size(0.08, contact.seen_at(tmp_path, name))
    assert again == pytest.approx(0.08)
    assert contact.size_between(0.08, contact.seen_at(tmp_path, name)) is None
    write(tmp_path, name, 1, again * 1.0001, 0.05)  # it was luck
    assert contact.next_size(0.08, contact.seen_at(tmp_path, name)) > 0.1


@pytest.mark.quick
def test_the_size_of_one_effect_alone_is_looked_for_and_the_others_stay(tmp_path, results):
    recorded = json.loads(results.read_text())
    assert [job.effects for job in contact.probe_jobs(tmp_path, "1/1", ["slope"])] == [
        {"slope": contact.EFFECTS["slope"].base}]
    for number in (0, 1):
        write(tmp_path, "slope", number, 0.03 + 1e-6 * number, 1.0)
    for one in (tmp_path / "verdicts").iterdir():
        one.write_text(json.dumps({**json.loads(one.read_text()), "scale": 0.0, "verdict": "named", "share": 0.9,
                                   "effects": [], "p_value": 0.001}))
    undeclared_figures.figures(tmp_path)
    after = json.loads(results.read_text())
    assert after["sizes"].pop("slope")["value"] == pytest.approx(0.03, rel=1e-3)
    recorded["sizes"].pop("slope")
    assert after["sizes"] == recorded["sizes"]

    def others(content):
        return [row for row in content["confusion"] if not (row["stage"] == "base" and "slope" in row["truth"])]

    assert others(after) == others(recorded)


@pytest.mark.quick
def test_an_effect_that_the_catalogue_has_by_another_name_is_right_by_that_name():
    def verdict(*names):
        return {"verdict": "named" if names else "unexplained", "effects": [{"class": list(names)}]} | (
            {} if names else {"effects": []})

    assert undeclared_figures.said("gain_fade", verdict("supply_sag"))
    assert not undeclared_figures.said("gain_fade", verdict("traction_limit"))
    assert not undeclared_figures.said("supply_sag", verdict("gain_fade"))
    warned = {"excess": [1.0, 0.0], "excess_limit": 0.1}
    found = undeclared_figures.of_singles([("gain_fade", verdict("supply_sag") | warned), ("warm_up", verdict())], "")
    assert found["class_accuracy"]["value"] == 1.0 and found["class_accuracy"]["unit"] == "share of 1 logs"
    assert found["out_of_catalogue"]["unit"].startswith("share of 1 logs")


def test_intervals_are_as_wide_as_needed_where_the_worst_of_twenty_just_holds_its_size():
    def log(driven, low, value, high):
        seen = {"value": value, "interval": [low, high]}
        return {"slope": driven}, {"effects": [{"name": "slope", "parameters": {"slope.along_x": seen}}]}

    held = [log(0.10, 0.09, 0.10, 0.11) for _ in range(38)]
    found = undeclared_figures.of_parameters([*held, log(0.10, 0.08, 0.09, 0.10), log(0.10, 0.08, 0.09, 0.10)])
    assert found["interval_width_ratio"]["value"] == pytest.approx(math.inf)  # 38 of 40 would be held by a point
    found = undeclared_figures.of_parameters([*held[:18], *[log(0.10, 0.05, 0.08, 0.14)] * 2])
    assert found["interval_width_ratio"]["value"] == pytest.approx(3.0)  # a third of the way to the upper end
    assert found["interval_coverage"]["value"] == 1.0
    found = undeclared_figures.of_parameters([log(0.10, 0.05, 0.08, 0.09)] * 20)
    assert found["interval_width_ratio"]["value"] == pytest.approx(0.5)
    assert found["interval_coverage"]["value"] == 0.0
    assert not undeclared_figures.of_parameters([({"wind": 1.0}, held[0][1])])


@pytest.mark.quick
@pytest.mark.parametrize(("device", "name"), [("cpu, 2 cores, X", "cpu_seconds"), ("NVIDIA H200", "gpu_seconds")])
def test_how_long_a_loop_takes_is_told_of_the_device_that_it_ran_on(tmp_path, device, name):
    nulls = {"count": 200, "false_alarms": 3}
    (tmp_path / "speed_200.json").write_text(json.dumps({"seconds": 12.0, "nulls": nulls, "device": device}))
    (tmp_path / "speed_0.json").write_text(json.dumps({"seconds": 5.0, "nulls": None, "device": device}))
    (tmp_path / "speed_200").mkdir(exist_ok=True)
    code = {"sysid sources SHA-256": "1a2b", "jax": "9.9.9"}
    (tmp_path / "speed_200/report.json").write_text(json.dumps({"code": code}))
    found = undeclared_figures.of_speed(tmp_path)
    assert {key: one["value"] for key, one in found.items()} == {
        name: 12.0, name.replace("_", "_quick_"): 5.0, "refitted_null_alarms": 3.0}
    assert found[name]["device"] == found["refitted_null_alarms"]["device"] == device
    written = json.loads(record("fixture", "how it is written", found, tmp_path).read_text())["figures"]
    assert written[name]["versions"] == {"jax": "9.9.9"}
    assert "numpy" in written[name.replace("_", "_quick_")]["versions"]


@pytest.mark.quick
def test_evidence_that_was_kept_is_judged_again(tmp_path):
    left = Left(0.0, 0.0, 0.0)
    one = TriedSet(("slope",), ("slope",), (1.0,), 900.0, (1e-9,), left, (900.0,), ((900.0,),), left, (("slope",),))
    kept = as_json(Findings(1.0, 1e-9, 1.0, 900.0, 9, 0.05, 8.0, 0.0, (one,)))
    verdict = {"verdict": "unexplained", "share": 0.1, "effects": [], "excess": [1.0, 1.0], "findings": kept}
    judged(tmp_path, "slope_x4_0", verdict, {"slope": 0.1})
    contact.replay(tmp_path)
    after = json.loads((tmp_path / "verdicts/slope_x4_0.json").read_text())
    assert after["verdict"] == "named" and after["excess"] == [1.0, 0.0]
    assert [effect["class"] for effect in after["effects"]] == [["slope"]]
