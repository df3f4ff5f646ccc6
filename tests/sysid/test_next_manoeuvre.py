"""The next drive on rivals with a known answer: alike on what was driven, apart on another heading or never."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sysid.errors.features import BIN
from sysid.errors.noise import Whitener
from sysid.errors.space import make_space
from sysid.follow_up.next_manoeuvre import (
    FILE,
    LEAST,
    absorbed,
    drive_library,
    next_manoeuvre,
    plan_drives,
    write_next_command,
)
from sysid.logs.log import read_csv
from sysid.logs.records import Command, OdometryStream, PoseStream, Start, Trial
from sysid.missing.catalogue import base_values, hypotheses, with_catalogue
from sysid.missing.drives import make_drives
from sysid.missing.joint_fit import Refit
from sysid.pages.loop_page import command_of, sentence
from sysid.replay.records import FreeVehicle
from sysid.replay.rollout import vehicle_plant
from sysid.verdict.result import Prepared
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.presets import preset

quick = pytest.mark.quick
EFFECTS = ("slope", "side_force", "command_scale", "odometry_scale")
SPEED, TIME = 0.5, 8.0


def straight_trial(pose=True):
    """A straight drive at heading 0, with the samples of its sensors still to come."""
    t = np.arange(0.0, TIME, 0.1)
    moving = (t >= 1.0) & (t < TIME - 1.0)
    s = np.arange(0.0, TIME + 1e-9, 0.05)
    truth = PoseStream(s, SPEED * np.clip(s - 1.0, 0.0, TIME - 2.0), 0.8 * np.sin(s), 0 * s)
    return Trial("straight_1", "straight", Command(t, SPEED * moving, 0.4 * (t > 99)),
                 OdometryStream(s, None, None, None, 0 * s, 0 * s), truth if pose else None, Start())


def cut_to(trial, seconds):
    """The first seconds of a trial."""
    c, o, g = trial.command, trial.odometry, trial.ground_truth
    few, some, part = (one.t <= seconds for one in (c, o, g))
    return replace(trial, command=Command(c.t[few], c.v[few], c.omega[few]),
                   odometry=OdometryStream(o.t[some], None, None, None, o.v[some], o.omega[some]),
                   ground_truth=PoseStream(*(one[part] for one in (g.t, g.x, g.y, g.yaw))))


@pytest.fixture(scope="module")
def subject():
    """A vehicle with four effects, its reference, and its replay."""
    spec, params = preset("whill_cr_physical")
    found = tuple(one for one in hypotheses(spec, params) if one.effect in EFFECTS)
    full = with_catalogue(params, found)
    names = tuple(base_values(full))
    space = make_space(params, spec, ["torque_drive.kp", "rolling_resistance.mu_r"])
    whitener = Whitener(np.array([0.005, 0.01, 0.01, 0.01, 0.01]), np.zeros((1, 5, 5)), np.eye(5))
    reference = SimpleNamespace(params=params, space=space, u=space.to_unit(space.initial), spread=1e-4 * np.eye(2),
                                whitener=whitener, factors=np.ones((4, 5)), target_of=lambda drives: drives.target,
                                width=BIN, gyro=False)
    plant = vehicle_plant(spec, VehicleConfig(physics_dt=0.01))
    log = SimpleNamespace(spec=spec, training=(straight_trial(),), name="drives")
    drives = make_drives(FreeVehicle(plant, full, names), log.training)
    wander = SimpleNamespace(at=lambda columns, hypothesis, q: np.zeros((len(q), len(q))))
    return SimpleNamespace(log=log, reference=reference, hypotheses=found, full=full, names=names, plant=plant,
                           drives=drives, prepared=Prepared(reference, plant, found, full, names, drives.paths, wander))


def fitted(subject, effect, **changes):
    """A candidate of this effect at these values; its coordinates are known from nowhere else."""
    one = next(each for each in subject.hypotheses if each.effect == effect)
    names = subject.names
    values = np.array([base_values(subject.full)[name] for name in names])
    for field, value in changes.items():
        values[names.index(f"{effect}.{field}")] = value
    base = base_values(subject.full)
    q = np.array([(values[names.index(axis.parameter)] - base[axis.parameter]) / axis.unit for axis in one.axes])
    bins = subject.drives.target.shape[1]
    jacobian = np.zeros((1, 5 * bins, 2 + len(q)))
    fit = Refit((one,), subject.reference.u, q, 0.0, np.zeros((1, 5 * bins)), jacobian, values)
    return SimpleNamespace(hypothesis=one, gain=100.0, refit=fit)


def with_rivals(subject, best, other, verdict="named"):
    """The result of a loop that accepted the first and took the second for alike."""
    search = SimpleNamespace(verdict=verdict, accepted=[best], rounds=[[best, other]], excess=(1.0, 0.0),
                             classes=[[best.hypothesis.effect, other.hypothesis.effect]])
    return SimpleNamespace(**{**vars(subject), "search": search, "evidence": SimpleNamespace(
        precision=np.linalg.inv(subject.reference.spread), columns=())})


@pytest.fixture(scope="module")
def sloping(subject):
    """A cross slope, and the side force that does the same at heading 0."""
    pull = 0.02 * 9.81 * float(subject.full.body.mass)
    return with_rivals(subject, fitted(subject, "slope", along_y=0.02), fitted(subject, "side_force", sideways=-pull))


def test_a_cross_slope_is_told_from_a_side_force_by_another_heading(sloping, tmp_path):
    proposal = next_manoeuvre(sloping)
    assert proposal["splits"] == ["slope", "side_force"] and not proposal["not_split"]
    assert proposal["expected_separation"] > LEAST and proposal["replicates"] >= 1
    command = command_of(proposal)
    heading = proposal["start"]["heading"] + np.cumsum(command.omega) * 0.1
    assert np.ptp(heading) > 0.5 or abs(proposal["start"]["heading"]) > 0.5
    path = write_next_command(tmp_path, proposal)
    columns = read_csv(path, ("t", "v", "omega"))
    assert path.name == FILE
    np.testing.assert_allclose(columns["v"], command.v, atol=1e-6)
    assert columns["v"].max() <= SPEED + 1e-6 and columns["t"][-1] <= TIME
    assert "slope" in sentence(proposal)


def test_the_drive_already_made_would_not_tell_them(sloping):
    rivals = [one.refit.values for one in sloping.search.rounds[0]]
    again = [one for one in drive_library(sloping, (0.0, 90.0)) if one.manoeuvre == "straight" and one.v == SPEED]
    seen = plan_drives(sloping, sloping.drives, again).simulate(np.stack(rivals))  # (2, D, K, 5)
    apart = np.linalg.norm(((seen[0] - seen[1]) / sloping.reference.whitener.scale).reshape(2, -1), axis=-1)
    ahead, across = (apart[[one.start[2] < 0.1 for one in again].index(which)] for which in (True, False))
    assert ahead < 0.6 * across  # the centre of mass is not the point that a side force acts at


def test_scales_that_odometry_alone_shows_need_another_sensor(subject):
    blind = replace(straight_trial(), ground_truth=None)
    log = SimpleNamespace(**{**vars(subject.log), "training": (blind,)})
    result = with_rivals(SimpleNamespace(**{**vars(subject), "log": log}),
                         fitted(subject, "command_scale", linear=1.02, angular=1.02),
                         fitted(subject, "odometry_scale", linear=1.02, angular=1.02))
    proposal = next_manoeuvre(result)
    assert proposal["name"] is None and proposal["file"] is None
    assert proposal["not_split"][0]["effects"] == ["command_scale", "odometry_scale"]
    assert "commands" in proposal["not_split"][0]["sensor"] and "no drive" in sentence(proposal)


def test_a_rival_that_was_not_refitted_is_refitted(sloping):
    search = SimpleNamespace(**vars(sloping.search))
    best = search.accepted[0]
    search.rounds, search.base = [[best]], SimpleNamespace(hypotheses=(), u=sloping.reference.u, q=np.zeros(0))
    search.scan = SimpleNamespace(gain=np.zeros(len(sloping.hypotheses)),
                                  q=[np.full(len(one.axes), 0.5) for one in sloping.hypotheses])
    proposal = next_manoeuvre(SimpleNamespace(**{**vars(sloping), "search": search}))
    assert "side_force" in [name for each in proposal["not_split"] for name in each["effects"]] + proposal["splits"]


@quick
def test_nothing_is_proposed_where_nothing_is_named(subject):
    best, other = fitted(subject, "slope", along_x=0.01), fitted(subject, "side_force", sideways=5.0)
    assert next_manoeuvre(with_rivals(subject, best, other, "none")) is None
    alone = with_rivals(subject, best, other)
    alone.search.classes, alone.search.rounds = [["slope"]], [[best]]
    assert next_manoeuvre(alone) is None
    assert write_next_command("unused", None) is None


@quick
def test_nothing_is_proposed_where_the_drives_are_shorter_than_the_standstills(subject):
    short = SimpleNamespace(spec=subject.log.spec, training=(cut_to(straight_trial(), 1.5),), name="short")
    best, other = fitted(subject, "slope", along_x=0.01), fitted(subject, "side_force", sideways=5.0)
    result = with_rivals(SimpleNamespace(**{**vars(subject), "log": short}), best, other)
    assert drive_library(result) == []
    assert next_manoeuvre(result) is None


@quick
def test_the_library_keeps_to_the_speeds_and_the_space_of_the_log(subject):
    library = drive_library(subject)
    truth = subject.log.training[0].ground_truth
    low, high = (getattr(np, side)([truth.x, truth.y], 1) for side in ("min", "max"))
    assert len(library) > 20 and len({one.manoeuvre for one in library}) > 8
    for one in library:
        command = one.command
        assert np.abs(command.v).max() <= SPEED + 1e-9 and command.t[-1] <= TIME
        assert (low <= one.start[:2]).all() and (np.array(one.start[:2]) <= high).all()


@quick
@pytest.mark.parametrize("share", [0.08, -1.0])
def test_a_slow_log_and_one_that_only_reverses_get_drives_of_their_own_speed(subject, share):
    trial = subject.log.training[0]
    log = replace_command(subject.log, replace(trial.command, v=share * trial.command.v))
    library = drive_library(SimpleNamespace(**{**vars(subject), "log": log}))
    assert max(np.abs(one.command.v).max() for one in library) == pytest.approx(abs(share) * SPEED)


def replace_command(log, command):
    """A log of one trial, with other commands."""
    return SimpleNamespace(**{**vars(log), "training": (replace(log.training[0], command=command),)})


@quick
def test_what_another_coordinate_can_absorb_does_not_count():
    random = np.random.default_rng(0)
    columns = random.standard_normal((50, 3))
    inside, outside = columns @ [1.0, -2.0, 0.5], random.standard_normal(50)
    outside -= columns @ np.linalg.lstsq(columns, outside, rcond=None)[0]
    assert absorbed(inside, columns, np.zeros((3, 3))) < 1e-3
    assert abs(absorbed(inside + outside, columns, np.zeros((3, 3))) - np.linalg.norm(outside)) < 1e-3
    assert absorbed(inside, columns, 1e9 * np.eye(3)) > 0.99 * np.linalg.norm(inside)
