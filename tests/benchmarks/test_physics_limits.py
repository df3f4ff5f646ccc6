"""The peers' time step, what a step computes and moves, and the figures made of them."""

from __future__ import annotations

import argparse
import json
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import contact_drive, physics, physics_peers_step, physics_profile
from benchmarks.plant.chair import TIMESTEP

PROGRAM = """HloModule roll
%body (arg: (f32[8], f32[8,2])) -> (f32[8], f32[8,2]) {
  %arg = (f32[8]{0}, f32[8,2]{1,0}) parameter(0)
  %a = f32[8]{0} get-tuple-element(%arg), index=0
  %b = f32[8,2]{1,0} get-tuple-element(%arg), index=1
  %table = f32[20,8]{1,0} constant({...})
  %one = f32[8]{0} fusion(%a, %b), kind=kLoop, calls=%first
  %two = (f32[8]{0}, pred[8]{0}) fusion(%one, %table), kind=kLoop, calls=%second
}
ENTRY %main (p: f32[8]) -> f32[8] {
  %p = f32[8]{0} parameter(0)
  %c = f32[8]{0} copy(%p)
}
"""


def test_the_ramped_figure_eight_has_the_same_commands_behind_the_ramp():
    plain, ramped = physics_peers_step.commands(False), physics_peers_step.commands(True)
    np.testing.assert_array_equal(plain[:, 0], ramped[:, 0])
    changes = np.abs(np.diff(ramped[:, 1:], axis=0))
    assert (changes <= 0.1 * np.array(physics_peers_step.RAMP) + 1e-9).all()
    assert np.abs(np.diff(plain[:, 1:], axis=0)).max() > changes.max()
    assert (plain[:, 1:] == ramped[:, 1:]).all(1).mean() > 0.9  # it catches up


def test_the_peers_chair_drives_the_eight_and_a_coarse_step_errs_more():
    errors = physics_peers_step.step_errors((0.008, 0.004), ramped=True)
    assert 2.0 < errors[0.004][0] < errors[0.008][0] < 50.0  # mm
    assert errors[0.004][1] < errors[0.008][1]
    driven = physics_peers_step.drive(0.004, physics_peers_step.commands(True))
    assert driven[:, 1].max() - driven[:, 1].min() == pytest.approx(4.0, abs=0.3)  # two circles of 1 m radius


@pytest.mark.quick
def test_steps_of_equal_error_come_from_the_record_or_are_the_chairs_own(tmp_path, monkeypatch):
    monkeypatch.setattr(physics_peers_step, "RESULTS", tmp_path)
    assert physics_peers_step.equal_error_steps() == {"": TIMESTEP, "_ramped": TIMESTEP}
    known = {"figures": {"peer_largest_dt_within_2mm_2mrad": {"value": 0.0005}}}
    (tmp_path / "physics.json").write_text(json.dumps(known))
    assert physics_peers_step.equal_error_steps() == {"": 0.0005, "_ramped": TIMESTEP}


@pytest.mark.quick
def test_traffic_counts_operands_and_results_of_the_loops_kernels():
    first = 4 + 8 + 4  # a, both numbers of b, the result
    second = 4 + 4 + 4 + 1  # one, the table as one number, both results
    assert physics_profile.traffic(PROGRAM, 8) == first + second


@pytest.mark.quick
def test_the_line_through_times_per_step_finds_what_was_put_in():
    rates = {count: count / (20e-6 + 0.4e-9 * count) for count in (1024, 131072)}
    fixed, each = physics_profile.split_time(rates)
    assert fixed == pytest.approx(20e-6) and each == pytest.approx(0.4e-9)


@pytest.mark.quick
def test_only_rates_of_the_device_that_the_limits_are_of_are_compared(tmp_path, monkeypatch):
    monkeypatch.setattr(physics_profile, "RESULTS", tmp_path)
    assert physics_profile.recorded_rates() == {}
    rates = {"steps_per_s_1024": ("NVIDIA H200", 5.0), "steps_per_s_2048": ("NVIDIA T4", 3.0),
             "steps_per_s_1024_physical": ("NVIDIA H200", 4.0), "cpu_steps_per_s": ("cpu", 1.0)}
    figures = {name: {"value": value, "device": device} for name, (device, value) in rates.items()}
    (tmp_path / "physics.json").write_text(json.dumps({"figures": figures}))
    assert physics_profile.recorded_rates() == {1024: 5.0}
    assert physics_profile.recorded_rates("_physical") == {1024: 4.0}


def test_a_step_of_the_loaded_vehicle_is_some_thousand_operations_on_some_hundred_bytes():
    work = physics_profile.work_of("loaded", 4)
    more = physics_profile.work_of("+jerk_limit", 4)
    base = physics_profile.work_of("whill_cr_physical", 4)
    assert 1000 < base.operations < work.operations < 4000
    assert more.operations > base.operations and more.moved > base.moved  # another memory
    assert 0 < work.divisions < work.operations and 10 < work.transcendentals < 100
    assert work.moved == pytest.approx(136 + 2 * 365 + 8)
    assert work.limits["memory"] == pytest.approx(4.8e12 / work.moved)
    assert work.limits["issue"] < work.limits["arithmetic"]


@pytest.mark.quick
def test_every_seed_of_the_contact_drive_is_in_its_figures():
    one = {name: (0.01 * i, 0.001 * i) for i, name in enumerate(contact_drive.FIVE)}
    other = {name: (0.02, 0.01) for name in contact_drive.FIVE}
    figures = contact_drive.figures_of({7: one, 8: other})
    position = figures["contact_five_manoeuvres_m"]
    assert position["repeats"] == [0.04, 0.02] and position["largest"] == 0.04 and position["seeds"] == [7, 8]
    assert position["manoeuvres"]["turn"] == [0.01, 0.02]
    assert figures["contact_five_manoeuvres_rad"]["repeats"] == [0.004, 0.01]


@pytest.mark.quick
def test_an_effect_that_fails_is_named_and_the_others_are_recorded(monkeypatch, capsys):
    def rolled(vehicle, count, periods, dynamics):
        if vehicle == "+wind":
            raise RuntimeError("out of memory\nand more")
        return SimpleNamespace(config=SimpleNamespace(substeps=20)), lambda *_: np.zeros(1), (0, 0, np.zeros((1, 2)))

    recorded = []
    monkeypatch.setattr(physics, "compiled_roll", rolled)
    monkeypatch.setattr(physics, "record", lambda stem, claim, figures: recorded.append(set(figures)))
    options = argparse.Namespace(
        effects=["slope", "wind", "bump"], instances=[8], periods=4, repeats=2, dynamics="fused"
    )
    physics.record_effects(options, on_cpu=True)
    assert recorded == [{"step_us_base", f"added_us_{name}"} for name in ("slope", "bump", "loaded")]
    assert "wind" in capsys.readouterr().out.split("left out, RuntimeError: ['out of memory']")[0].splitlines()[-1]
