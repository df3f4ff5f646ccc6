"""What the commands of this package share beyond `whill_mjx.io.command_line`: the progress of long work."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from sysid.replay.model_files import steps_mjx
from sysid.search.result import Progress
from whill_mjx.io import command_line
from whill_mjx.io.heartbeat import Heartbeat

STOPPED = "stopped; give the same command again to go on."


class OwnModels:
    """Options of a command that may step a user's robot."""

    model: str
    wheels: tuple[str, ...] = ()
    parameters: tuple[str, ...] = ()

    @property
    def shares_results(self) -> bool:
        """Whether XLA may share results: it may abort then on a user's robot."""
        return not steps_mjx(self.model, self.wheels, self.parameters)


_heartbeats: list[Heartbeat] = []  # of the command in this process; none where the package is used from Python


def run(options: type, main: Callable[[Any], Any], description: str | None, **more: Any) -> None:
    """`whill_mjx.io.command_line.run` with signs of life."""

    def alive(chosen: Any) -> None:
        with Heartbeat() as heartbeat:  # progress bars tick while something long is computed
            _heartbeats.append(heartbeat)
            try:
                main(chosen)
            finally:
                _heartbeats.remove(heartbeat)

    command_line.run(options, alive, description, **more)


def stage(text: str) -> None:
    """Say what a command begins now, where no bar shows it; its time is shown until the next bar or stage."""
    for heartbeat in _heartbeats:
        heartbeat.stage(text)


@contextmanager
def progress_bar(total: int, what: str = "fit") -> Iterator[Progress]:
    """A line with elapsed and remaining time and a remark."""
    from tqdm import tqdm

    form = "{desc} {n_fmt}/{total_fmt} [{elapsed}<{remaining}{postfix}]"  # a stage and its cost fit into 80 columns
    bar: Any = tqdm(total=total, desc=what, dynamic_ncols=True, bar_format=form)

    def advance(count: int, remark: str) -> None:
        bar.set_postfix_str(remark, refresh=count == 0)
        bar.update(min(count, max(bar.total - bar.n, 0)))

    try:
        yield advance
        bar.total = bar.n or total  # the total is the most that there may be to do
    finally:
        bar.close()

