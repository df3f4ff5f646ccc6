"""Designs with known answers: what is uncertain decides the manoeuvre, and rooms and speeds are kept."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import UNICYCLE_SPACE, unicycle_plant

import sysid.design as design_command
from sysid.design import DesignConfig, check_limits, main
from sysid.errors.space import Space
from sysid.intervals.design import (
    Subject,
    candidate_objective,
    identifiable_subspace,
    information,
    prior_information,
    propose,
    rank,
)
from sysid.intervals.uncertainty import PRIOR_SD
from sysid.logs.log import read_csv
from sysid.logs.manoeuvre_library import Candidate, Limits, as_trial, library, make_command, placement
from sysid.logs.metrics import ideal_replay
from sysid.replay.models import with_effects
from sysid.replay.records import Plant
from sysid.search.thin import drives_from
from whill_mjx.io.command_line import OptionError
from whill_mjx.vehicle.parameters import get_values, set_values
from whill_mjx.vehicle.presets import preset_params
from whill_mjx.vehicle.specs import WHILL_CR, in_proportion

quick = pytest.mark.quick
SMALL = Limits(v_min=-0.5, v_max=0.6, omega_max=0.8, room=(4.0, 3.0), margin=0.5, seconds=12.0)


def candidates(*names, seconds=6.0):
    return [Candidate(name, make_command(name, 0.5, 0.8, seconds)) for name in names]


@quick
@pytest.mark.parametrize("limits", [SMALL, Limits(v_min=0.0, v_max=0.8, omega_max=0.5, room=(12.0, 2.0))])
def test_candidates_keep_speed_and_room(limits):
    found = library(limits)
    assert len({one.name for one in found}) == len(found) > 6
    for one in found:
        assert one.command.v.min() >= limits.v_min - 1e-9 and one.command.v.max() <= limits.v_max + 1e-9
        assert np.abs(one.command.omega).max() <= limits.omega_max + 1e-9
        assert one.command.v[0] == one.command.v[-1] == 0.0
        assert (one.command.v[one.command.t < 0.95] == 0).all() and one.command.t[-1] <= limits.seconds + 2
        pose = ideal_replay(as_trial(one)).ground_truth
        x0, y0, yaw = placement(np.column_stack([pose.x, pose.y]), limits)
        x = x0 + np.cos(yaw) * pose.x - np.sin(yaw) * pose.y
        y = y0 + np.sin(yaw) * pose.x + np.cos(yaw) * pose.y
        for values, side in ((x, limits.room[0]), (y, limits.room[1])):
            assert values.min() >= limits.margin - 1e-9 and values.max() <= side - limits.margin + 1e-9


@quick
def test_a_vehicle_that_must_not_reverse_gets_no_reversing_manoeuvre():
    assert not any((one.command.v < 0).any() for one in library(Limits(v_min=0.0)))


@quick
def test_a_slow_small_robot_gets_the_manoeuvres_that_turn_while_they_reverse():
    spec = in_proportion(WHILL_CR, "small", wheel_radius=0.012, track=0.045)
    limits = Limits(v_min=-0.04, v_max=0.04, room=(1.0, 1.0), margin=0.05, least=drives_from(spec))
    assert {"arcs", "prbs", "chirp"} <= {one.name for one in library(limits)}
    assert not {"arcs", "prbs", "chirp"} & {one.name for one in library(replace(limits, least=0.05))}


@quick
def test_the_command_designs_for_a_small_robot_by_its_size(tmp_path, monkeypatch):
    seen = []

    def propose(subject, limits, **options):
        seen.append(limits.least)
        raise ValueError("seen")

    monkeypatch.setattr(design_command, "propose", propose)
    for vehicle in ("whill_cr", "create"):
        with pytest.raises(OptionError, match="seen"):
            main(DesignConfig(vehicle, out=tmp_path / "command.csv"))
    assert seen[0] == 0.05 and seen[1] == pytest.approx(0.05 * 0.033 / 0.1325)


@quick
def test_the_square_visits_four_headings():
    command = make_command("square", 0.5, 0.8, 30.0)
    yaw = ideal_replay(as_trial(Candidate("square", command))).ground_truth.yaw
    straight = np.abs(np.interp(np.arange(len(yaw)) * 0.05, command.t, command.omega)) < 1e-9
    assert {int(round(one / (np.pi / 2))) % 4 for one in yaw[straight]} == {0, 1, 2, 3}


@quick
@pytest.mark.parametrize(("change", "rule"), [({"room": (1.0, 5.0)}, "leaves nothing within a margin"),
                                              ({"v_max": 0.0}, "must be positive"), ({"v_min": 0.2}, "v_min not")])
def test_impossible_limits_are_refused(change, rule):
    with pytest.raises(ValueError, match=rule):
        Limits(**change)


@quick
def test_a_long_path_is_placed_along_the_diagonal_and_a_longer_one_nowhere():
    limits = Limits(room=(4.0, 4.0), margin=0.5)
    line = np.column_stack([np.linspace(0, 4.0, 50), np.zeros(50)])
    x, y, yaw = placement(line, limits)
    assert np.deg2rad(30) < yaw < np.deg2rad(60) and x < 1.0 and y < 1.0
    assert placement(1.2 * line, limits) is None


def by_hand(prior, *found, criterion="a"):
    blank = [np.zeros((2, 2))] * len(found)
    return rank(candidates("straight", "turn")[: len(found)], np.array(found), np.array(prior), blank,
                [(0.0, 0.0, 0.0)] * len(found), criterion)


@quick
def test_a_optimality_goes_for_the_largest_uncertainty_and_d_for_the_volume():
    known, unknown = np.diag([1e4, 20.0]), np.diag([20.0, 20.0])
    first, second = np.diag([1e5, 0.0]), np.diag([0.0, 100.0])
    assert by_hand(known, first, second)[0].candidate.name == "turn"
    plans = by_hand(unknown, first, second)
    assert plans[0].candidate.name == "straight"
    assert plans[0].trace == pytest.approx((1 / 100020 + 1 / 20) / (2 / 20), rel=1e-6)
    assert plans[0].volume == pytest.approx(-np.log(100020 / 20) / 2)
    # much of the known against a little of the unknown: the volume prefers the first, the largest variance the second
    assert by_hand(known, first, np.diag([0.0, 40.0]), criterion="d")[0].candidate.name == "straight"
    assert by_hand(known, first, np.diag([0.0, 40.0]), criterion="a")[0].candidate.name == "turn"


@quick
def test_a_direction_that_nothing_tells_does_not_count():
    bounds = np.eye(2) * PRIOR_SD**-2
    subspace = identifiable_subspace(bounds + np.diag([1e4, 0.0]))
    np.testing.assert_allclose(np.abs(subspace), [[1.0], [0.0]])
    plans = by_hand(bounds, np.diag([1e4, 0.0]), np.diag([1e3, 0.0]))
    assert plans[0].trace < 0.01 and plans[0].deviation[1] == pytest.approx(PRIOR_SD)


@quick
def test_intervals_become_information_in_unit_coordinates():
    space = Space(("a", "b"), np.array([0.0, 1.0]), np.array([10.0, 1000.0]), np.array([5.0, 10.0]),
                  np.array([False, True]))
    prior = prior_information(space, {"a": (4.0, 6.0), "c": (0.0, 1.0)})
    assert np.sqrt(1 / (prior[0, 0] - PRIOR_SD**-2)) == pytest.approx(0.1 / 1.645)
    assert prior[1, 1] == pytest.approx(PRIOR_SD**-2)


@pytest.fixture(scope="module")
def unicycle_information():
    names = ("straight", "turn", "circle")
    objective = candidate_objective(unicycle_plant(), lambda values: values, UNICYCLE_SPACE, candidates(*names))
    return dict(zip(names, information(objective, UNICYCLE_SPACE.initial), strict=True))


@quick
def test_information_lies_where_the_manoeuvre_moves(unicycle_information):
    straight, turn, circle = (unicycle_information[name] for name in ("straight", "turn", "circle"))
    assert straight[1, 1] == pytest.approx(0.0, abs=1e-3) and straight[0, 0] > 1  # tau_omega from a straight drive
    assert turn[0, 0] == pytest.approx(0.0, abs=1e-3) and turn[1, 1] > 1
    assert turn[2, 2] > 100 and circle[2, 2] > 100  # turn: what the body turns beside what the odometry sees


@quick
def test_what_only_an_outside_pose_tells_is_blind_to_odometry():
    objective = candidate_objective(unicycle_plant(), lambda values: values, UNICYCLE_SPACE,
                                    candidates("circle", seconds=3.0), channels="odometry")
    (found,) = information(objective, UNICYCLE_SPACE.initial)
    assert found[2, 2] == pytest.approx(0.0, abs=1e-3) and found[0, 0] > 1


def stand_in(spec, config):
    """The kinematic vehicle behind the parameters of the WHILL: kp is its bandwidth, eta its gain in turning."""
    base = unicycle_plant()

    def substep(params, state, command):
        kp, eta = get_values(params, ("pid_drive.kp", "forward_slip.eta"))
        return base.substep(jnp.stack([1 / kp, 1 / kp, eta]), state, command)

    return Plant(base.place, substep, base.observe, base.dt, base.move)


@pytest.fixture(scope="module")
def whill(tmp_path_factory):
    """The command for the WHILL's parameters, on the kinematic vehicle."""
    folder = tmp_path_factory.mktemp("design")
    config = DesignConfig("whill_cr", folder / "next.csv", space=(5.0, 5.0), v_max=0.6, omega_max=0.8, seconds=3.0,
                          parameters=("pid_drive.kp", "forward_slip.eta"), count=2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sysid.intervals.design.vehicle_plant", stand_in)
        return folder, config, main(config)



@quick
def test_the_command_file_is_a_log_and_stays_in_the_room(whill):
    folder, config, paths = whill
    assert [path.name for path in paths] == ["next.csv", "next_2.csv", "next.html"]
    for path in paths[:2]:
        columns = read_csv(path, ("t", "v", "omega"))
        assert np.allclose(np.diff(columns["t"]), 0.1) and np.abs(columns["v"]).max() <= 0.6
        assert np.abs(columns["omega"]).max() <= 0.8 and columns["v"][:10].max() == 0.0
    page = (folder / "next.html").read_text()
    assert "next: the uncertainty of" in page.partition("</header>")[0]
    assert "forward_slip.eta" in page and "path in the room" in page and 'href="http' not in page


def test_the_same_command_replaces_what_an_interrupted_one_wrote(tmp_path, monkeypatch):
    monkeypatch.setattr("sysid.intervals.design.vehicle_plant", stand_in)
    config = DesignConfig("whill_cr", tmp_path / "next.csv", space=(5.0, 5.0), v_max=0.6, omega_max=0.8, seconds=3.0,
                          parameters=("pid_drive.kp",))

    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("sysid.pages.design_page.write_page", interrupted)
        main(config)
    assert (tmp_path / "next.csv").exists() and not (tmp_path / "next.html").exists()
    design_command.check_out(config)


@quick
def test_an_unknown_vehicle_ends_with_one_line(monkeypatch):
    monkeypatch.setattr("sys.argv", ["design", "tricycle"])
    with pytest.raises(SystemExit, match="error: .*tricycle"):
        design_command.cli()


@quick
@pytest.mark.parametrize("option", ["v_max", "omega_max", "v_min"])
def test_speeds_that_the_vehicle_does_not_drive_are_refused(option, tmp_path):
    wanted = -9.0 if option == "v_min" else 9.0
    with pytest.raises(ValueError, match=f"--{option.replace('_', '-')} {wanted:g}: whill_cr drives"):
        check_limits(DesignConfig("whill_cr", tmp_path / "a.csv", **{option: wanted}), WHILL_CR)


def test_the_start_and_the_path_are_those_of_the_axle_wherever_the_tracked_point_is(monkeypatch):
    """Of a tracked body that is turned by 90 degrees the path would be too, and leave the room at its side."""
    class Planned(Exception):
        pass

    def plan(plant, apply, space, *_):
        raise Planned(get_values(apply(space.initial), ("pose_mount.x", "pose_mount.yaw", "slip_traction.mu")))

    monkeypatch.setattr("sysid.intervals.design.candidate_objective", plan)
    params = with_effects(preset_params(WHILL_CR, "physical"), ("pose_mount",))
    params = set_values(params, ("pose_mount.x", "pose_mount.yaw", "slip_traction.mu"), jnp.array([0.3, 1.5, 0.77]))
    with pytest.raises(Planned) as planned:
        propose(Subject(WHILL_CR, params), Limits(seconds=5.0))
    np.testing.assert_allclose(planned.value.args[0], [0.0, 0.0, 0.77], atol=1e-6)


def test_a_room_that_every_drive_leaves_is_refused(monkeypatch):
    monkeypatch.setattr("sysid.intervals.design.driven_paths", lambda objective: [np.array([[0, 0], [99, 99.0]])] * 2)
    monkeypatch.setattr("sysid.intervals.design.library", lambda limits: candidates("straight", "turn", seconds=2.0))
    monkeypatch.setattr("sysid.intervals.design.vehicle_plant", lambda *a: unicycle_plant())
    monkeypatch.setattr("sysid.intervals.design.make_space", lambda *a: UNICYCLE_SPACE)
    monkeypatch.setattr("sysid.intervals.design.set_values", lambda params, names, values: values)
    with pytest.raises(ValueError, match="leaves 8 x 8 m in every manoeuvre"):
        propose(Subject(WHILL_CR, None))
