"""The simulator that the options of `bridge.simulate` name, in the world that they and the policy give."""

import argparse
import importlib
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from bridge.nodes.exits import OptionError
from bridge.simulation.moved_simulator import MovedSimulator
from bridge.simulation.simulated import SimulatedVehicle

SIMULATOR = "bridge.simulation.chair_simulator:ChairSimulator"
"""What `--simulator` names unless given."""


def ready_vehicle(options: argparse.Namespace) -> SimulatedVehicle:
    """Return the simulator of `make_vehicle` after a first period, in which it compiles: nobody waits for frames yet.

    Raises:
        ValueError, FileNotFoundError: as of `make_vehicle`, or a simulator of the user's own ended in an error.
    """
    vehicle = make_vehicle(options)
    print("bridge.simulate: compiling the simulator: up to a minute where it has not run before", file=sys.stderr)
    with _placed(options.simulator):
        vehicle.reset(options.seed)
        vehicle.step(0.0, 0.0)
    return vehicle


@contextmanager
def _placed(simulator: str) -> Iterator[None]:
    """Turn any error in a simulator of the user's own into an OptionError with the line where it happened."""
    try:
        yield
    except OptionError:
        raise
    except Exception as error:
        if simulator == SIMULATOR:
            raise
        own = getattr(sys.modules.get(simulator.partition(":")[0]), "__file__", None)
        frames = [one for one in traceback.extract_tb(error.__traceback__)
                  if one.filename != __file__ and not one.filename.startswith("<")]
        frames = [one for one in frames if one.filename == own] or frames  # rather than a place in a library
        places = [f"{one.filename}, line {one.lineno}: " for one in frames]
        raise OptionError(f"--simulator {simulator}: {places[-1] if places else ''}{type(error).__name__}: {error}. It "
                          "must be MODULE:FACTORY, called with task and vehicle, and give what SimulatedVehicle says. "
                          "Correct it.") from error


def make_vehicle(options: argparse.Namespace) -> SimulatedVehicle:
    """Return the simulator that `--simulator MODULE:FACTORY` names.

    Raises:
        ValueError, FileNotFoundError: an option, or the policy's folder, is refused.
    """
    module, _, name = options.simulator.partition(":")
    rule = "It must be MODULE:FACTORY, called with task and vehicle. Correct it or leave it out."
    if not (module and name):
        raise OptionError(f"--simulator {options.simulator}: {rule}")
    with _placed(options.simulator):
        try:
            factory = getattr(importlib.import_module(module), name, None)
        except ModuleNotFoundError as error:
            if not f"{module}.".startswith(f"{error.name}."):
                raise  # one that the module itself imports
            raise OptionError(f"--simulator {options.simulator}: {error}. {rule}") from error
    if factory is None:
        raise OptionError(f"--simulator {options.simulator}: the module has no {name}. {rule}")
    changes = dict(options.set)
    if options.policy is None:
        given = {"task": options.task or "corridor", "vehicle": options.vehicle, **changes}
    else:
        from whill_mjx.evaluation.policies.policy_world import read_world

        world = read_world(options.policy, options.task)
        given = {"task": world.task, "vehicle": options.vehicle or world.vehicle,
                 "size": (world.height, world.width), **world.fields, **changes}
        if world.senses:
            given["senses"] = world.senses
    if options.robot is None:
        if options.wheels:
            raise OptionError("--wheels names the wheels of a robot file. Give --robot too, or leave it out.")
        with _placed(options.simulator):
            return factory(**given)
    from sysid.replay.robot_online import OnlineRobot
    from whill_mjx.env import as_vehicle

    if options.simulator != SIMULATOR:
        raise OptionError(f"--robot {options.robot} is driven by a simulator of its own. Leave --simulator out.")
    if given.get("senses"):
        raise OptionError(f"--robot {options.robot} shows its camera alone, and the policy reads "
                              f"{', '.join(sorted(given['senses']))}. Leave --robot out.")
    robot = OnlineRobot(options.robot, options.wheels or ())
    given["vehicle"] = robot.spec(as_vehicle(given["vehicle"])[0])
    moved: Any = MovedSimulator(robot, **given)
    return moved
