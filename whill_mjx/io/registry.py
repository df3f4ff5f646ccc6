"""Things by name: those of a room of this package, of installed packages, and those that a program registers.

An installed package offers its own by entry points of the registry's group. Modules and entry points are loaded when a
thing is first looked up, not on import. So a module that defines one can import this package, whichever of the two is
imported first.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

Named = TypeVar("Named")


class Registry(Mapping[str, Named]):
    """Things with a `name`: this package's in order of their names, then entry points by name, then registered ones."""

    def __init__(
        self,
        what: str,
        room: str,
        files: str,
        found_in: Callable[[ModuleType], Iterable[Named]],
        checked: Callable[[Any, str], Named],
        apart: tuple[str, ...] = (),
    ) -> None:
        """A registry that has loaded nothing yet.

        Args:
            what: a word for one thing, in errors.
            room: package that holds those of this project; also the group of the entry points.
            files: `__file__` of a module in that room.
            found_in: the things that a module defines itself.
            checked: (value, where it comes from) -> the thing; raises TypeError or ValueError where it is none.
            apart: modules of the room that are not searched.
        """
        self._what, self._room, self._files, self._apart = what, room, files, apart
        self._found_in, self._checked = found_in, checked
        self._known: dict[str, Named] = {}
        self._state, self._lock = "new", threading.RLock()

    def __getitem__(self, name: str) -> Named:
        return self._all()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._all())

    def __len__(self) -> int:
        return len(self._all())

    def add(self, value: Any, where: str = "") -> Named:
        """Check a thing and add it at the end; one that is defined again takes the place of its older self.

        Raises:
            TypeError, ValueError: it is none, or another thing has its name.
        """
        known, thing = self._all(), self._checked(value, where)
        name: str = thing.name  # type: ignore[attr-defined]
        if name in known and home(known[name]) != home(thing):
            raise ValueError(
                f"{self._what} {name!r} of {home(thing)}: {home(known[name])} has one of this name. "
                "Choose another name."
            )
        known[name] = thing
        return thing

    def remove(self, name: str) -> None:
        """Forget a thing; KeyError where there is none of this name."""
        del self._all()[name]

    def _all(self) -> dict[str, Named]:
        if self._state != "loaded":
            with self._lock:  # another thread waits until all are there; what is loaded may itself register one
                if self._state == "new":
                    self._state = "loading"
                    try:
                        self._load()
                        self._state = "loaded"
                    except BaseException:
                        self._known, self._state = {}, "new"
                        raise
        return self._known

    def _load(self) -> None:
        own = [info.name for info in pkgutil.iter_modules([str(Path(self._files).parent)])]
        modules = [importlib.import_module(f"{self._room}.{name}") for name in own if name not in self._apart]
        found = [thing for module in modules for thing in self._found_in(module)]
        for thing in sorted(found, key=lambda thing: thing.name):  # type: ignore[attr-defined]
            self.add(thing)
        for point in sorted(entry_points(group=self._room), key=lambda point: (point.name, point.value)):
            self.add(self._of(point), f"entry point {point.name} = {point.value}")

    def _of(self, point: EntryPoint) -> Any:
        """What an entry point names; ImportError names the package that it comes from."""
        try:
            return point.load()
        except Exception as error:
            package = point.dist.name if point.dist else "unknown"
            raise ImportError(
                f"{self._what} {point.name!r} of the installed package {package!r} ({point.value}) cannot "
                f"be loaded: {error}. Mend or uninstall that package."
            ) from error


def home(thing: Any) -> str:
    """Module and name of a class, or of a value's class."""
    kind = thing if isinstance(thing, type) else type(thing)
    return f"{kind.__module__}.{kind.__qualname__}"


def failed(what: str, kind: type, method: str, error: BaseException) -> ValueError:
    """The error, in one line, of a method of a user's own class that fails while it is traced."""
    said = str(error).strip().split("\n")[0].rstrip(".")
    traced = {"ConcretizationTypeError", "TracerArrayConversionError"} & {one.__name__ for one in type(error).__mro__}
    hint = " (it is traced: jax.numpy for numpy, jnp.where for if)" if traced else ""
    return ValueError(f"{what}: {method}{_line(kind, error)}: {type(error).__name__}: {said}. Correct the "
                      f"method{hint}.")


def _line(kind: type, error: BaseException) -> str:
    """Where in the file of a class an error arose."""
    try:
        own = inspect.getfile(kind)
    except (OSError, TypeError):
        return ""
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == own]
    return f", line {lines[-1]}" if lines else ""
