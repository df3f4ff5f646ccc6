"""The real simulator behind the bridge's protocol."""

import argparse

import numpy as np
import pytest

from benchmarks.plant.first_day import write_urdf
from bridge.simulate import field, parse_arguments
from bridge.simulation.chair_simulator import ChairSimulator
from bridge.simulation.simulated import halfway
from bridge.simulation.simulator_choice import make_vehicle


@pytest.fixture(scope="module")
def chair():
    return ChairSimulator("corridor")


def test_chair_drives_forward_as_commanded_and_reports_its_odometry(chair):
    start = chair.reset(3)
    assert start.image.shape == (64, 64, 3) and start.image.dtype == np.uint8 and start.image.std() > 5
    for _ in range(20):
        frame = chair.step(0.3, 0.0)
    assert frame.v == pytest.approx(0.3, abs=0.02)
    assert 0.4 < np.hypot(frame.x - start.x, frame.y - start.y) < 0.62
    assert frame.odometry[0] == pytest.approx(np.hypot(frame.x - start.x, frame.y - start.y), abs=0.05)
    assert not np.array_equal(frame.image, start.image) and not frame.done


def test_scan_shows_the_free_distance_shrink_ahead_and_grow_behind(chair):
    start = chair.reset(3)
    for _ in range(20):
        frame = chair.step(0.3, 0.0)
    moved = np.hypot(frame.x - start.x, frame.y - start.y)
    ahead, behind = 0, len(frame.ranges) // 2
    assert start.ranges.shape == frame.ranges.shape and np.all((frame.ranges > 0) & (frame.ranges <= 10))
    assert start.ranges[ahead] - frame.ranges[ahead] == pytest.approx(moved, abs=0.1) or frame.ranges[ahead] == 10
    assert frame.ranges[behind] - start.ranges[behind] == pytest.approx(moved, abs=0.1) or start.ranges[behind] == 10
    assert np.any(frame.ranges != start.ranges)


def test_camera_of_the_chair_has_square_pixels_and_its_centre_in_the_middle(chair):
    fx, fy, cx, cy = chair.intrinsics
    assert fx == fy > 10 and (cx, cy) == (32, 32)


def test_same_seed_gives_the_same_first_image_and_another_seed_another(chair):
    first, again, other = (chair.reset(seed).image for seed in (5, 5, 6))
    assert np.array_equal(first, again) and not np.array_equal(first, other)


def test_left_turn_turns_left_and_commands_beyond_the_task_are_limited(chair):
    start = chair.reset(3)
    for _ in range(10):
        frame = chair.step(9.0, 9.0)
    assert 0.2 < frame.yaw - start.yaw < 0.65 and frame.v < 0.35


def test_pose_between_two_frames_takes_the_short_way_round(chair):
    a = chair.reset(0)
    b = chair.step(0.0, 0.0)
    a, b = (type(f)(f.image, x, 0.0, yaw, 0.0, 0.0, odometry=(0.0, 0.0, 0.0, v, 0.0))
            for f, x, yaw, v in ((a, 1.0, 3.1, 0.1), (b, 2.0, -3.1, 0.3)))
    middle = halfway(a, b)
    assert middle.x == 1.5 and abs(abs(middle.yaw) - np.pi) < 1e-6 and middle.odometry[3] == pytest.approx(0.2)


@pytest.mark.quick
@pytest.mark.parametrize(("text", "pair"), [("gates=1", ("gates", 1)), ("layout=fixed", ("layout", "fixed"))])
def test_fields_of_the_task_are_read_as_numbers_or_words(text, pair):
    assert field(text) == pair


@pytest.mark.quick
def test_a_field_without_a_value_is_refused():
    with pytest.raises(argparse.ArgumentTypeError, match="'gates' is not NAME=VALUE"):
        field("gates")


@pytest.mark.quick
def test_a_field_that_the_task_does_not_have_is_named():
    with pytest.raises(ValueError, match="no field 'doors' .*known: .*box_x"):
        ChairSimulator("corridor", doors=3)


def test_the_map_shows_as_occupied_what_the_scanner_meets_and_the_start_as_free():
    simulator = ChairSimulator("corridor", layout="fixed")
    frame = simulator.reset(0)
    grid = simulator.grid

    def occupied(x, y):
        return grid.occupied[int((y - grid.y) / grid.resolution), int((x - grid.x) / grid.resolution)]

    assert not occupied(frame.x, frame.y)
    angles = frame.yaw + np.arange(len(frame.ranges)) * 2 * np.pi / len(frame.ranges)
    met = [(r, a) for r, a in zip(frame.ranges, angles, strict=True) if r < 5]
    assert len(met) > 50
    hits = [occupied(frame.x + (r + 0.03) * np.cos(a), frame.y + (r + 0.03) * np.sin(a)) for r, a in met]
    before = [occupied(frame.x + (r - 0.15) * np.cos(a), frame.y + (r - 0.15) * np.sin(a)) for r, a in met]
    assert np.mean(hits) > 0.95 and np.mean(before) < 0.2


@pytest.mark.long
def test_people_walk_past_a_robot_of_ones_own_and_its_scanner_meets_them_but_the_map_does_not(tmp_path):
    robot = write_urdf(tmp_path / "small.urdf")
    words = ["--task", "point_goal", "--set", "people=8", "--robot", str(robot)]
    simulator = make_vehicle(parse_arguments(words))
    frames = [simulator.reset(1)]
    before = simulator.grid.occupied
    frames += [simulator.step(0.0, 0.0) for _ in range(30)]
    scans = np.stack([frame.ranges for frame in frames])
    assert np.any(np.ptp(scans, axis=0) > 0.3)  # somebody walked through a ray of a vehicle that stands
    assert np.array_equal(simulator.grid.occupied, before)
    moved = [simulator.step(0.2, 0.0) for _ in range(10)][-1]
    assert moved.v == pytest.approx(0.2, abs=0.02) or moved.done
