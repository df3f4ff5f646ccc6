"""Pedestrians beside recorded ones: speeds, flow, headways: `python -m benchmarks.people`.

The recordings are those of ../shared/data/pedestrians: a corridor with one direction and one with two. Simulated people
enter at the recorded times and places, and walk to where the recorded ones left. The law and its time gap are the
same in both. Each half of a recording, every other block of 10 s, is simulated with the speed and spread that fit the
other half best; figures are of both halves together, but "fitted", which is of one speed and spread for all.
"""

from __future__ import annotations

import dataclasses
import gzip
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import figure, record
from whill_mjx.io import command_line
from whill_mjx.world.people import law
from whill_mjx.world.people.crowd import GAP, Crowd, people_on
from whill_mjx.world.plane import Vector

CLAIM = "Obstacle course with physics, camera image, reward and auto-reset"
DT = 0.1
WINDOW = 0.5
"""Time over which a speed is taken [s]."""
RATE = 25
"""Frames per second of the recordings."""
INSIDE = (-4.5, 3.5)
"""Part of the corridor in which speeds are taken, along it [m]."""
GATE, HALF = -0.5, 2.0
"""Middle and half length of the stretch in which density and flow are taken [m]."""
LANE = 0.8
"""How far apart sideways two people are who follow one another [m]."""
DENSITIES = np.arange(0.5, 2.01, 0.25)
"""Borders of the bins of density [1/m2]."""
BLOCK = 10.0
"""Duration of the blocks of time that are fitted and compared in turn [s]."""
SPEEDS, SPREADS = np.arange(-0.08, 0.081, 0.04), np.arange(-0.06, 0.061, 0.06)
"""What is tried around them [m/s]."""
LEAST = 50
"""Moments that a bin must have in both."""


@dataclass(frozen=True)
class Options:
    """Options of the benchmark."""

    recordings: Path = Path("../shared/data/pedestrians/juelich_pedpy")
    """Folder of the recordings."""


class Recording(NamedTuple):
    """A corridor along x whose walls are at two y, and where the fit of its people's speeds begins."""

    file: str
    scale: float
    walls: tuple[float, float]
    speed: float
    spread: float


RECORDINGS = {
    "one_way": Recording("traj_UNI_CORR_500_01.txt.gz", 1.0, (0.0, 5.0), 1.47, 0.18),
    "two_ways": Recording("bi_corr_400_b_03.txt.gz", 0.01, (0.0, 4.0), 1.22, 0.18),
}


class Track(NamedTuple):
    """One person."""

    time: np.ndarray  # (T,) s
    place: np.ndarray  # (T, 2) m


def read(folder: Path, recording: Recording) -> list[Track]:
    """Everybody of a recording who was seen for longer than the window."""
    with gzip.open(folder / recording.file) as file:
        rows = np.loadtxt(file, comments="#")
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    people = np.split(rows, np.flatnonzero(np.diff(rows[:, 0])) + 1)
    tracks = [Track(one[:, 1] / RATE, one[:, 2:4] * recording.scale) for one in people]
    return [track for track in tracks if track.time[-1] - track.time[0] > 2 * WINDOW]


def simulator(tracks: list[Track], walls: tuple[float, float]) -> Callable[[float, float, float], list[Track]]:
    """Function of mean speed, its spread and the time gap that gives the tracks of simulated people."""
    begin = min(track.time[0] for track in tracks)
    duration = max(track.time[-1] for track in tracks) - begin + 15.0
    begins = np.array([track.place[0] for track in tracks])
    last = np.array([track.place[-1] for track in tracks])
    way = np.sign(last[:, 0] - begins[:, 0])
    route = jnp.asarray(np.stack([begins, last + np.stack([3.0 * way, 0.0 * way], 1)], 1), jnp.float32)
    enter, first, out = jnp.asarray([track.time[0] - begin for track in tracks]), jnp.asarray(begins), jnp.asarray(last)
    side, count = jnp.asarray(way), len(tracks)
    nobody = jnp.zeros(count, bool)
    people = people_on(jax.random.key(0), Crowd(), route, jnp.zeros(count, jnp.int32), nobody)
    # Everybody gets a quantile of the normal distribution of his own, so that the sample is as even as can be.
    order = jax.random.permutation(jax.random.key(1), count)
    quantile = jax.scipy.special.ndtri((order + 0.5) / count)

    def near(place: Vector) -> law.Near:
        points = Vector(jnp.stack([place.x] * len(walls)), jnp.stack([jnp.full(count, wall) for wall in walls]))
        return law.Near(points, jnp.ones((len(walls), count), bool))

    @jax.jit
    def run(speed, spread, gap):
        crowd = dataclasses.replace(people, speed=jnp.maximum(speed + spread * quantile, 0.4), gap=jnp.full(count, gap))

        def one_step(carry, number):
            crowd, entered = carry
            apart = jnp.linalg.norm(crowd.position[None] - first[:, None], axis=-1)
            blocked = jnp.any(crowd.there & (apart < 2 * law.RADIUS + law.ASIDE), -1)
            enters = (number * DT >= enter) & ~entered & ~blocked
            crowd = law.walk(dataclasses.replace(crowd, there=crowd.there | enters), lambda _: near, None, DT)
            seen = (crowd.position, crowd.there)
            gone = (crowd.position[:, 0] - out[:, 0]) * side >= 0.0
            return (dataclasses.replace(crowd, there=crowd.there & ~gone), entered | enters), seen

        return jax.lax.scan(one_step, (crowd, nobody), jnp.arange(int(duration / DT)))[1]

    def tracks_of(speed: float, spread: float, gap: float) -> list[Track]:
        place, there = (np.asarray(leaf) for leaf in run(speed, spread, gap))
        found = []
        for index in range(count):
            row = np.flatnonzero(there[:, index])
            if len(row) * DT > 2 * WINDOW:
                found.append(Track(begin + row * DT, place[row, index]))
        return found

    return tracks_of


def moving(tracks: list[Track]) -> np.ndarray:
    """(M, 5) time, x, y, speed along the corridor and speed, taken over the window, of everybody inside."""
    rows = []
    for track in tracks:
        step = round(WINDOW / (track.time[1] - track.time[0]))
        span = track.time[step:] - track.time[:-step]
        velocity = (track.place[step:] - track.place[:-step]) / span[:, None]
        middle = slice(step // 2, step // 2 + len(velocity))
        speed = np.hypot(*velocity.T)
        rows.append(np.column_stack([track.time[middle], track.place[middle], velocity[:, 0], speed]))
    found = np.concatenate(rows)
    return found[(found[:, 1] > INSIDE[0]) & (found[:, 1] < INSIDE[1])]


def flows(tracks: list[Track], walls: tuple[float, float]) -> np.ndarray:
    """(F, 2) density [1/m2] and flow [1/(m s)], both ways added up, in the stretch at each moment."""
    rows = moving(tracks)
    rows = rows[np.abs(rows[:, 1] - GATE) < HALF]
    moment = np.round(rows[:, 0] / DT).astype(int)
    # A recording has several frames in a moment: everybody counts once.
    own = round(DT / np.min([track.time[1] - track.time[0] for track in tracks]))
    area = 2 * HALF * (walls[1] - walls[0])
    count = np.bincount(moment) / own
    return np.column_stack([count, np.bincount(moment, np.abs(rows[:, 3])) / own])[count > 0] / area


def headways(tracks: list[Track]) -> np.ndarray:
    """Times [s] between two people who pass the gate one behind the other in the same direction."""
    passes = []
    for track in tracks:
        x = track.place[:, 0] - GATE
        over = np.flatnonzero(x[1:] * x[:-1] < 0)
        if len(over):
            row = over[0]
            share = x[row] / (x[row] - x[row + 1])
            time = track.time[row] + share * (track.time[row + 1] - track.time[row])
            passes.append((time, track.place[row, 1], np.sign(x[-1] - x[0])))
    time, aside, way = np.array(sorted(passes)).T
    found = []
    for index in range(len(time)):
        behind = np.flatnonzero((way == way[index]) & (np.abs(aside - aside[index]) < LANE) & (time > time[index]))
        if len(behind):
            found.append(time[behind[0]] - time[index])
    return np.array(found)


def largest_gap(one: np.ndarray, other: np.ndarray) -> float:
    """Kolmogorov-Smirnov distance of two samples."""
    both = np.concatenate([one, other])
    shares = [np.searchsorted(np.sort(sample), both, "right") / len(sample) for sample in (one, other)]
    return float(np.abs(shares[0] - shares[1]).max())


def flow_errors(recorded: np.ndarray, simulated: np.ndarray) -> dict[str, float]:
    """Relative error of the mean flow in each bin of density that both have."""
    errors = {}
    for low, high in zip(DENSITIES[:-1], DENSITIES[1:], strict=True):
        means = []
        for rows in (recorded, simulated):
            chosen = (rows[:, 0] >= low) & (rows[:, 0] < high)
            # Flow over density is speed: bins are wide, and the densities in them differ.
            means.append(rows[chosen, 1].sum() / rows[chosen, 0].sum() if chosen.sum() >= LEAST else np.nan)
        if np.isfinite(means).all():
            errors[f"{low:g} to {high:g}"] = means[1] / means[0] - 1.0
    return errors


def of_blocks(tracks: list[Track], odd: bool) -> list[Track]:
    """What tracks have in the odd or the even blocks of time; a piece shorter than the window is left out."""
    pieces = []
    for track in tracks:
        block = (track.time // BLOCK).astype(int)
        for piece in np.split(np.arange(len(block)), np.flatnonzero(np.diff(block)) + 1):
            if block[piece[0]] % 2 == odd and track.time[piece[-1]] - track.time[piece[0]] > 2 * WINDOW:
                pieces.append(Track(track.time[piece], track.place[piece]))
    return pieces


def crossed(recording: Recording, tracks: list[Track]) -> tuple[list[Track], list[Track]]:
    """Simulated tracks of both halves, each by what fits the other half best, and by what fits all best."""
    run = simulator(tracks, recording.walls)
    recorded = [moving(of_blocks(tracks, odd))[:, 4] for odd in (False, True)]
    best: list[tuple[float, float, float, list[Track]]] = [(np.inf, 0.0, 0.0, [])] * 2
    least, fitted = np.inf, tracks
    for speed in recording.speed + SPEEDS:
        for spread in recording.spread + SPREADS:
            simulated = run(speed, spread, GAP)
            whole = [piece for odd in (False, True) for piece in of_blocks(simulated, odd)]
            off = largest_gap(np.concatenate(recorded), moving(whole)[:, 4])
            if off < least:
                least, fitted = off, whole
            for odd in (False, True):
                off = largest_gap(recorded[odd], moving(of_blocks(simulated, odd))[:, 4])
                if off < best[odd][0]:
                    best[odd] = off, speed, spread, of_blocks(simulated, not odd)
    for (off, speed, spread, _), half in zip(best, ("even", "odd"), strict=True):
        print(f"{recording.file}: {half} blocks are {off:.3f} apart at speed {speed:.2f}, spread {spread:.2f} m/s")
    return [*best[False][3], *best[True][3]], fitted


def main(options: Options) -> None:
    """Compare and record."""
    found: dict[str, list[float]] = {"speed": [], "fitted": [], "flow": [], "within": [], "headway": []}
    figures = {}
    for name, recording in RECORDINGS.items():
        tracks = read(options.recordings, recording)
        simulated, fitted = crossed(recording, tracks)
        recorded = [piece for odd in (False, True) for piece in of_blocks(tracks, odd)]
        found["speed"].append(largest_gap(moving(recorded)[:, 4], moving(simulated)[:, 4]))
        found["fitted"].append(largest_gap(moving(recorded)[:, 4], moving(fitted)[:, 4]))
        errors = flow_errors(flows(recorded, recording.walls), flows(simulated, recording.walls))
        found["flow"] += map(abs, errors.values())
        times = headways(recorded), headways(simulated)
        found["headway"].append(largest_gap(*times))
        parts = [moving(of_blocks(tracks, odd))[:, 4] for odd in (False, True)]
        found["within"].append(largest_gap(*parts))
        flow_line = ", ".join(f"{bin}: {error:+.1%}" for bin, error in errors.items())
        print(f"{name}: {len(tracks)} people; speeds {found['speed'][-1]:.3f} apart, {found['fitted'][-1]:.3f} "
              f"if fitted to all (the recording's own two halves "
              f"{found['within'][-1]:.3f}); headway median "
              f"{np.median(times[0]):.2f} s recorded, {np.median(times[1]):.2f} s simulated, "
              f"{found['headway'][-1]:.3f} apart; flow {flow_line}", flush=True)  # fmt: skip
        figures[f"people_headway_ratio_{name}"] = figure([float(np.median(times[1]) / np.median(times[0]))], "ratio")
    path = record("environment", CLAIM, {
        "people_speed_distance": figure([max(found["speed"])], "-"),
        "people_speed_distance_fitted": figure([max(found["fitted"])], "-"),
        "people_flow_error": figure([max(found["flow"])], "share"),
        "people_speed_distance_within": figure([max(found["within"])], "-"),
        "people_headway_distance": figure([max(found["headway"])], "-"),
        **figures,
    })  # fmt: skip
    print(f"-> {path}")


if __name__ == "__main__":
    command_line.run(Options, main, __doc__, positional=False)
