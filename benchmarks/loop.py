"""The whole loop over ROS 2, in one command: drive, record, fit, find what is missing, drive again, train, drive.

    make loop                                            # python -m benchmarks.loop --out runs/loop
    python -m benchmarks.loop --out runs/loop_3 --draw 3 --days-of runs/loop --until loop_again

The vehicle is the contact plant (`benchmarks/plant`): a process of its own behind ROS topics, with an effect built in
that a number draws and nothing else knows. `bridge.manoeuvre` drives it and records. Its days without the effect are
the reference. Simulated time runs faster than the wall clock and waits for its driver, so a busy computer only takes
longer.

Each stage leaves its result in the run's folder. The same command goes on after the last whole stage; a stage that
fails is named with its log. RUN/report.html shows before and after.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from benchmarks.loop_direct import drive_directly, write_answers
from benchmarks.loop_drives import Plan, StageError, Station, drive_plans, last_line, station
from benchmarks.loop_figures import collect, summary
from benchmarks.loop_page import write_page
from benchmarks.plant.chair import VEHICLES
from benchmarks.plant.commands import nine
from benchmarks.plant.draw import draw_effect
from benchmarks.ros_domains import free_domain
from whill_mjx.io.command_line import COUNT, SEED, OptionError, Range, run
from whill_mjx.io.folders import claim_folder, write_whole

KIND = "benchmarks.loop"
FIVE = ("straight", "turn", "circle", "s_curve", "figure_eight")
FIRST_DAY = 501
"""Seed of the first reference day; the day in question has a seed of its own for each draw."""
SEED_OF_DRAWS = 700
STAGES = ("days", "fit", "drives", "loop", "proposed", "loop_again", "train", "drive", "report")
STOPPED = "stopped; give the same command again to go on after the last whole stage."


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    out: Path = Path("runs/loop")
    """Folder of the run."""
    draw: Annotated[int, SEED] = 0
    """Number that draws the effect and its size."""
    days: Annotated[int, Range(1, 20)] = 3
    """Reference days without the effect."""
    days_of: Path | None = None
    """Run whose reference days and fit are used, instead of driving them anew."""
    manoeuvres: tuple[str, ...] = FIVE
    """Which of the nine are driven; the last one is held out where there are several."""
    replicates: Annotated[int, COUNT] = 2
    """Drives of each manoeuvre in question, and on the first reference day."""
    seconds: Annotated[float, Range(2, 60)] = 60.0
    """Manoeuvres are cut to this length."""
    speed: Annotated[float, Range(0.01, 1000)] = 8.0
    """Simulated seconds per second at most."""
    quick: bool = False
    """Fewer iterations of fit and loop."""
    preset: Literal["cpu", "smoke", "paper", "wallclock"] = "cpu"
    """Of the training."""
    steps: Annotated[int | None, COUNT] = None
    """Environment steps of the training; none takes the preset's."""
    episodes: Annotated[int, COUNT] = 5
    """Episodes that the policy drives on the plant."""
    until: Literal["days", "fit", "drives", "loop", "proposed", "loop_again", "train", "drive", "report"] = "report"
    """Last stage to do; the report is written after it."""
    direct: bool = False
    """Drive the plant in this process, without topics: the same drives in seconds, on a computer without ROS. A run may
    go on so that was driven over topics; its stages say which."""
    domain: Annotated[int | None, Range(0, 101)] = None
    """ROS domain; none takes one that no other loop of this computer holds."""
    collect: tuple[Path, ...] = ()
    """Only record the figures of these runs, each with another draw, into bridge.json."""


@dataclass
class Loop:
    """One run of the loop."""

    options: Options

    @property
    def out(self) -> Path:
        """Folder of the run."""
        return self.options.out

    def done(self, stage: str) -> dict[str, Any] | None:
        """What a stage left to say; None where it is not done."""
        path = self.out / "stages" / f"{stage}.json"
        return json.loads(path.read_text()) if path.exists() else None

    @property
    def days(self) -> list[Path]:
        """Folders of the reference days."""
        of = self.options.days_of or self.out
        return [of / f"day_{number + 1}" for number in range(self.options.days)]

    @property
    def last_loop(self) -> Path:
        """Folder of the newest verdict."""
        again = self.out / "loop_again"
        return again if (again / "report.json").exists() else self.out / "loop"

    def command(self, stage: str, *words: str | Path) -> None:
        """Run `python -m ...` with its output in the stage's log.

        Raises:
            StageError: it ended with another code than 0.
        """
        log = self.out / "logs" / f"{stage}.log"
        log.parent.mkdir(parents=True, exist_ok=True)
        with open(log, "wb") as file:
            process = subprocess.Popen([sys.executable, "-m", *map(str, words)], stdout=file, stderr=file)
            try:
                beat = time.monotonic()
                while process.poll() is None:
                    time.sleep(0.1)
                    if time.monotonic() - beat > 15:
                        beat = time.monotonic()
                        print(f"  {stage}: {last_line(log)[-100:]}", flush=True)
            finally:
                if process.poll() is None:
                    process.terminate()
                    process.wait(30)
        if process.returncode:
            raise StageError(f"{words[0]} ended with {process.returncode}: {last_line(log)}; see {log}")

    def drive(self, stage: str, dataset: Path, plans: list[Plan], seed: int, draw: int | None) -> None:
        """Drive and record manoeuvres on the plant of a day."""
        plant = ["--seed", str(seed), "--speed", str(self.options.speed)]
        if draw is not None:
            plant += ["--draw", str(draw), "--answers", str(self.out / "answers.json")]
        nominal = VEHICLES["chair"].nominal
        held_out = [f"{plan.name}_{n + 1}" for plan in plans[-1:] if len(plans) > 1 for n in range(plan.replicates)]
        if self.options.direct:
            effects = {} if draw is None else draw_effect(draw)
            drive_directly(plans, dataset, effects, seed, nominal, held_out)
            if draw is not None:
                write_answers(self.out / "answers.json", effects, seed)
            return
        saying = ["--vehicle", "contact plant", "--wheel-radius", str(nominal.radius), "--track", str(nominal.track),
                  "--wheelbase", str(nominal.wheelbase), "--mass", str(nominal.mass)]
        if held_out:
            saying += ["--held-out", *held_out]
        with self.hold_station(stage) as here:
            drive_plans(here, plans, dataset, plant, saying)

    @contextlib.contextmanager
    def hold_station(self, stage: str) -> Iterator[Station]:
        """A station with the logs of a stage, on the domain that was asked for or one that nobody else holds."""
        asked = self.options.domain
        with free_domain() if asked is None else contextlib.nullcontext(asked) as domain:
            with station(domain, self.out / "logs" / stage) as here:
                yield here

    def plans(self, replicates: int) -> list[Plan]:
        """The manoeuvres as command files."""
        folder = self.out / "commands"
        folder.mkdir(exist_ok=True)
        tables = nine(0)
        plans = []
        for name in self.options.manoeuvres:
            rows = tables[name]
            rows = rows[rows[:, 0] <= self.options.seconds]
            path = folder / f"{name}.csv"
            write_whole(path, "t,v,omega\n" + "".join(f"{t:.3f},{v:.4f},{w:.4f}\n" for t, v, w in rows))
            plans.append(Plan(name, path, replicates))
        return plans

    def do_days(self) -> str:
        """Drive the reference days."""
        if self.options.days_of is not None:
            missing = [day for day in self.days if not (day / "dataset.toml").exists()]
            if missing:
                raise StageError(f"{missing[0]} is missing. Finish that run's stage `days` first")
            return f"those of {self.options.days_of}"
        for number, day in enumerate(self.days):
            replicates = self.options.replicates if number == 0 else 1
            self.drive(f"day_{number + 1}", day, self.plans(replicates), FIRST_DAY + number, None)
            print(f"  day {number + 1} of {len(self.days)} is driven", flush=True)
        return f"{len(self.days)} days{self._how}"

    def do_fit(self) -> str:
        """Fit the vehicle to the first reference day."""
        if self.options.days_of is not None:
            return f"that of {self.options.days_of}"
        self.command("fit", "sysid.fit", self.days[0], "--out", self.out / "fit", *self._quick())
        return "fit/vehicle.toml"

    def do_drives(self) -> str:
        """Drive the vehicle with the undeclared effect."""
        self.drive("drives", self.out / "drives", self.plans(self.options.replicates), self.seed, self.options.draw)
        from sysid.logs.inspection import inspect
        from sysid.logs.log import load_log

        log = load_log(self.out / "drives")
        return ". ".join([f"{len(log.trials)} trials{self._how}", *inspect(log)["sanity"]])

    def do_loop(self) -> str:
        """Close the loop on these drives."""
        return self._close("loop", self.out / "drives", self.days)

    def do_proposed(self) -> str:
        """Drive the manoeuvre that the loop proposes, with the effect and on the reference days, beside the drives so
        far.

        The verdict subtracts what the same manoeuvre leaves unexplained on reference days. Where they lack it, all that
        the fitted vehicle does not know of it, such as reversing at full speed, counts as an effect without a name.
        """
        commands = self.out / "loop" / "next_command.csv"
        if not commands.exists():
            return "the loop proposes none: nothing is to be separated"
        proposed = json.loads((self.out / "loop" / "report.json").read_text())["next_manoeuvre"]
        start = proposed["start"]
        place = {"x": start["x"], "y": start["y"], "yaw": start["heading"]}
        fitted = (self.options.days_of or self.out) / "fit" / "vehicle.toml"
        check = ("--vehicle-file", str(fitted)) if fitted.exists() else ()
        plan = Plan("proposed", commands, min(proposed["replicates"], 3), place, check)
        self.drive("proposed", self._copied(self.out / "drives"), [plan], self.seed, self.options.draw)
        for number, day in enumerate(self.days):  # what a vehicle shows in a new manoeuvre is its form error, too
            self.drive(f"proposed_{day.name}", self._copied(day), [replace(plan, replicates=1)], FIRST_DAY + number,
                       None)
        what = f"{proposed['name']}, {plan.replicates} times{self._how}"
        return f"{what}, to separate {' and '.join(proposed['splits'])}"

    def do_loop_again(self) -> str:
        """Close the loop on all drives."""
        more = self._again(self.out / "drives")
        if not more.exists():
            return "no further drives"
        return self._close("loop_again", more, [self._again(day) for day in self.days])

    def do_train(self) -> str:
        """Train a policy in the vehicle that was found."""
        steps = () if self.options.steps is None else ("--steps", str(self.options.steps))
        self.command("train", "whill_mjx.train", "--out", self.out / "train", "--vehicle",
                     self.last_loop / "vehicle.toml", "--preset", self.options.preset, "--videos", "0", "--episodes",
                     "20", *steps)
        return "train/policy"

    def do_drive(self) -> str:
        """Let the policy drive the plant over ROS topics."""
        policy, results = self.out / "train" / "policy", self.out / "drive.json"
        with self.hold_station("drive") as here:
            here.start("policy", "bridge.drive", str(policy), "--base", "generic")
            process = here.start(
                "simulate", "bridge.simulate", str(policy), "--simulator", "benchmarks.loop_world:contact_vehicle",
                "--set", f"plant_seed={self.seed}", "--set", f"draw={self.options.draw}", "--episodes",
                str(self.options.episodes), "--results", str(results), "--wait", "60")
            while process.poll() is None:
                time.sleep(0.2)
            if process.returncode or not results.exists():
                raise StageError(f"bridge.simulate ended with {process.returncode}: "
                                 f"{last_line(here.log('simulate'))}; see {here.log('simulate')}")
        episodes = json.loads(results.read_text())["episodes"]
        arrived, collided = (sum(one[name] for one in episodes) for name in ("reached_goal", "collided"))
        return f"{len(episodes)} episodes: {arrived} arrived, {collided} collided"

    def _again(self, drives: Path) -> Path:
        """Folder of this run for drives with the proposed one among them."""
        return self.out / f"{drives.name}_again"

    def _copied(self, drives: Path) -> Path:
        """Copy drives to where the proposed one is added, and return the copy."""
        again, temporary = self._again(drives), self.out / f".{drives.name}_again.tmp"
        if not again.exists():
            shutil.copytree(drives, temporary, dirs_exist_ok=True)
            os.replace(temporary, again)
        return again

    def _close(self, stage: str, drives: Path, references: list[Path]) -> str:
        self.command(stage, "sysid.close_loop", drives, "--reference", *references, "--out", self.out / stage,
                     *self._quick())
        report = json.loads((self.out / stage / "report.json").read_text())
        names = [one["name"] for one in report["effects"]]
        return f"{report['verdict']}{': ' + ', '.join(names) if names else ''}"

    @property
    def _how(self) -> str:
        return ", without topics" if self.options.direct else ""

    def _quick(self) -> tuple[str, ...]:
        return ("--quick",) if self.options.quick else ()

    @property
    def seed(self) -> int:
        """Seed of the day in question."""
        return SEED_OF_DRAWS + self.options.draw


def main(options: Options) -> None:
    """Do the stages that are missing, then write the report."""
    if options.collect:
        collect(options.collect)
        return
    for name in options.manoeuvres:
        if name not in nine(0):
            raise OptionError(f"--manoeuvres {name}: unknown (known: {', '.join(nine(0))}). Correct the name.")
    loop = Loop(options)
    where = ("out", "until", "domain", "speed", "collect", "episodes", "direct")
    identity = {name: str(value) for name, value in asdict(options).items() if name not in where}
    with claim_folder(options.out, KIND, ("stages", "drives")) as claim:
        claim.settle(identity, (options.out / "stages").exists())
        for number, stage in enumerate(STAGES[:-1], 1):
            there = loop.done(stage)
            if there is None:
                print(f"[{number}/{len(STAGES)}] {stage} ...", flush=True)
                there = do(loop, stage)
            print(f"[{number}/{len(STAGES)}] {stage}: {there['what']} ({there['seconds']:.0f} s)", flush=True)
            if stage == options.until:
                break
        print(f"[{len(STAGES)}/{len(STAGES)}] report: {write_page(loop.out, loop.last_loop, summary(loop.out))}",
              flush=True)


def do(loop: Loop, stage: str) -> dict[str, Any]:
    """Do a stage, and note that it is done."""
    work: Callable[[], str] = getattr(loop, f"do_{stage}")
    began = time.monotonic()
    try:
        what = work()
    except StageError as error:
        raise OSError(f"stage {stage}: {error}. Mend the cause and give the same command again.") from None
    there = {"what": what, "seconds": time.monotonic() - began}
    (loop.out / "stages").mkdir(exist_ok=True)
    write_whole(loop.out / "stages" / f"{stage}.json", json.dumps(there) + "\n")
    return there


if __name__ == "__main__":
    run(Options, main, __doc__, stopped=STOPPED)
