"""The collision monitor of a policy: what it lets through, what it slows down, and what it cannot be asked for."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.env import make_env
from whill_mjx.learning.monitor import PLACE, SCAN, Monitor, monitor_of
from whill_mjx.learning.shaping import find_safety, limited_policy, limiter_of
from whill_mjx.sensors.lidar import Lidar
from whill_mjx.sensors.odometry import Odometry

pytestmark = pytest.mark.quick

SCANNER = Lidar(rays=180, reach=8.0)
MONITOR = Monitor((("lidar", SCANNER),), half_length=0.5, half_width=0.3, turns_at=-0.36, time=1.0, margin=0.2,
                  seconds=0.1, odometry=None)  # fmt: skip
STANDS = jnp.zeros(2)


def scan(points: np.ndarray, width: float = 0.15) -> jax.Array:
    """(180,) m: what the scanner sees of discs of this radius around points (N, 2) m from the chassis origin."""
    angles = SCANNER.angles()
    along = points @ np.stack([np.cos(angles), np.sin(angles)])  # (N, 180)
    aside = points @ np.stack([-np.sin(angles), np.cos(angles)])
    met = (np.abs(aside) < width) & (along > 0)
    far = along - np.sqrt(np.maximum(width**2 - aside**2, 0.0))
    return jnp.minimum(jnp.asarray(np.where(met, far, np.inf).min(0)), SCANNER.reach)


def wall(ahead: float) -> jax.Array:
    """(180,) m: what it sees of a wall straight across, so far ahead of the chassis origin."""
    cos = np.cos(SCANNER.angles())
    return jnp.asarray(np.minimum(np.where(cos > 0.01, ahead / np.maximum(cos, 0.01), np.inf), SCANNER.reach))


def given(command, now, before=None, last=STANDS):
    """What is left of a command (2,); without a scan before, nothing moves."""
    before = jnp.zeros(SCANNER.rays) if before is None else before
    return MONITOR.slowed(jnp.array(command), jnp.asarray(last), {"lidar": now}, {SCAN + "lidar": before})[0]


def test_a_free_way_leaves_the_command_as_it_is():
    for command in ([0.8, 0.0], [0.5, -1.0], [0.0, 1.0]):
        np.testing.assert_allclose(given(command, scan(np.array([[-3.0, 2.0]]))), command, atol=1e-6)


def test_a_vehicle_that_follows_late_stands_before_a_wall():
    """It takes up 40 % of a change of command in a period, and never comes nearer than 10 cm."""
    place, speed, before = 0.0, 0.8, wall(3.0)
    for _ in range(150):
        now = wall(3.0 - place)
        left = given([0.8, 0.0], now, before, [speed, 0.0])
        speed += 0.4 * (float(left[0]) - speed)
        place, before = place + 0.1 * speed, now
    assert 0.1 < 3.0 - place - MONITOR.half_length < 0.3
    assert speed < 0.02


def test_walls_12_cm_beside_the_way_slow_nobody_down_who_drives_straight():
    beside = jnp.asarray(np.minimum(0.42 / np.maximum(np.abs(np.sin(SCANNER.angles())), 0.01), SCANNER.reach))
    np.testing.assert_allclose(given([0.8, 0.0], beside, beside, [0.8, 0.0]), [0.8, 0.0], atol=1e-6)
    turning = given([0.8, 0.5], beside, beside, [0.8, 0.0])
    assert turning[1] < 0.1 < turning[0]  # the turn would touch them; straight on goes


@pytest.mark.parametrize("start", [(2.2, 0.0), (1.2, -1.8), (0.0, 2.0), (-2.2, 0.3)])
def test_who_comes_from_any_side_finds_a_vehicle_that_does_not_near_them(start):
    """A person walks to the nearest point of the vehicle with 1.3 m/s; the vehicle wants to go ahead, and turns."""
    person, before, speed = np.array([start]), None, np.array([0.0, 0.0])
    half = np.array([MONITOR.half_length, MONITOR.half_width])
    for _ in range(40):
        border = np.clip(person[0], -half, half)
        away = (person[0] - border) / np.linalg.norm(person[0] - border)
        if np.linalg.norm(person[0] - border) < 0.15 + 0.02:
            break
        now = scan(person)
        left = given([0.4, 0.3], now, before, speed)
        speed = speed + 0.4 * (np.asarray(left) - speed)
        person, before = person - 0.13 * away, now  # the vehicle hardly moves in the meantime
    else:
        raise AssertionError("the person never arrived")
    arm = border - np.array([MONITOR.turns_at, 0.0])
    assert np.dot([speed[0] - speed[1] * arm[1], speed[1] * arm[0]], away) < 0.05


def test_the_vehicle_may_drive_away_from_somebody_who_comes_and_not_towards():
    """Somebody has come to 25 cm behind it, in a corridor: a vehicle that stood still would be walked into."""
    behind, before = scan(np.array([[-0.9, 0.0]])), scan(np.array([[-1.03, 0.0]]))
    np.testing.assert_allclose(given([0.8, 0.0], behind, before), [0.8, 0.0], atol=1e-6)
    np.testing.assert_allclose(given([-0.8, 0.0], behind, before), [0.0, 0.0], atol=1e-6)


def test_things_that_stand_do_not_come_while_the_vehicle_drives_and_turns():
    """A post ahead to the right and a wall, from a vehicle that drives a curve; its odometry says how it moved."""
    monitor = dataclasses.replace(MONITOR, odometry="odometry")
    axle, twist = np.array([-0.36, 0.0]), np.array([0.8, 0.9])
    turn = 0.1 * twist[1]
    moved = 0.1 * twist[0] * np.array([np.cos(turn / 2), np.sin(turn / 2)])
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    things = np.array([[1.6, -1.2], *([x, 1.5] for x in np.arange(-3.0, 3.0, 0.05))])
    after = (things - axle - moved) @ rotation.T + axle
    heading = 0.7
    cos, sin = np.cos(heading), np.sin(heading)
    place = np.array([3.0 + moved[0] * cos - moved[1] * sin, -1.0 + moved[0] * sin + moved[1] * cos, heading + turn])
    seen = {"lidar": scan(after, 0.1), "odometry": jnp.array([*place, 0.0, 0.0])}  # its speeds come late
    memory = {SCAN + "lidar": scan(things, 0.1), PLACE: jnp.array([3.0, -1.0, heading])}
    left, memory = monitor.slowed(jnp.array([0.3, 0.0]), STANDS, seen, memory)
    np.testing.assert_allclose(left, [0.3, 0.0], atol=1e-6)
    np.testing.assert_allclose(memory[PLACE], place, atol=1e-6)


def test_something_that_a_ray_loses_or_that_was_hidden_stops_nobody():
    post = scan(np.array([[2.5, 0.8]]), 0.1)
    lost = jnp.where(jnp.arange(180) == int(jnp.argmin(post)), SCANNER.reach, post)
    np.testing.assert_allclose(given([0.8, 0.0], post, lost), [0.8, 0.0], atol=1e-6)


def test_the_monitor_knows_vehicle_and_scanners_and_refuses_what_does_not_scan():
    env, _ = make_env("obstacle_course", observations={"scan": Lidar(rays=30), "odometry": Odometry()})
    monitor = monitor_of(env, 1.0, 0.2)
    assert monitor.odometry == "odometry" and [name for name, _ in monitor.scanners] == ["scan"]
    assert monitor.half_length == env.model.spec.body_length / 2 and monitor.turns_at == env.model.spec.reference_x
    with pytest.raises(ValueError, match="needs a scan, and the task corridor shows none"):
        limiter_of(find_safety("monitor"), make_env("corridor")[0])


def test_a_policy_with_the_monitor_gives_what_the_training_drove():
    """The limits inside the policy are those of the environment: the same commands for the same scans."""
    env, _ = make_env("obstacle_course", observations={"scan": Lidar(rays=30), "odometry": Odometry()})
    limiter = limiter_of(find_safety("monitor"), env)
    step, carry = limited_policy(limiter, lambda weights, carry, seen: (carry, weights), {})
    command, memory = jnp.zeros(2), limiter.memory()
    span = jnp.array([env.task.v_max - env.task.v_min, 2.0 * env.task.omega_max]) / 2.0
    low = jnp.array([env.task.v_min, -env.task.omega_max])
    for number in range(6):
        seen = {"scan": jax.random.uniform(jax.random.key(number), (30,), maxval=3.0), "odometry": jnp.zeros(5)}
        wanted = jnp.array([0.9, -0.4])
        carry, action = step(wanted, carry, seen)
        other, memory = limiter.limited(wanted, command, seen, memory)
        np.testing.assert_allclose(action, other, atol=1e-6)
        command = low + (other + 1.0) * span
        np.testing.assert_allclose(carry["command"], command, atol=1e-6)
    assert bool((carry["before_scan_scan"] == seen["scan"]).all())


def test_scanners_may_have_the_names_of_what_the_monitor_remembers():
    scanners = tuple((name, SCANNER) for name in (PLACE, SCAN + PLACE))
    monitor = dataclasses.replace(MONITOR, scanners=scanners, odometry="odometry")
    assert len(monitor.memory()) == len(scanners) + 1
    seen = {**{name: wall(3.0) for name, _ in scanners}, "odometry": jnp.zeros(5)}
    _, memory = monitor.slowed(jnp.array([0.8, 0.0]), STANDS, seen, monitor.memory())
    shapes = {name: value.shape for name, value in monitor.memory().items()}
    assert {name: value.shape for name, value in memory.items()} == shapes
