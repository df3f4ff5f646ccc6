"""Global search with Optuna, TPE or CMA-ES, in studies that several processes share and that outlive any of them.

A study lives in a journal file (`journal:FILE`) or in a database by its URL, whose password is neither printed nor
stored. Processes ask for candidates in batches, simulate a batch in one replay and report the costs. What a killed
process leaves without a cost, the next one to look puts back into the queue.
"""

from __future__ import annotations

import fcntl
import os
import re
import socket
import time
import uuid
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any
from urllib.parse import unquote, unquote_plus

import numpy as np

from sysid.errors.pose_objective import Objective
from sysid.errors.space import Space
from sysid.search.result import FitResult, Progress
from sysid.search.settings import BATCH
from whill_mjx.io.steps import step

STARTUP = 32  # random candidates of TPE before it draws from those that it knows
LEASE = 600.0  # seconds after which a process on another machine that has not been heard of counts as dead
POLL = 0.2  # s between looks while others finish
UNNAMED = 10.0  # seconds after which a candidate without a process's name on it was made by one that died in between
HIDDEN = "***"
HOST = re.compile(r"(\[[^\]]*\]|[^:]*)(:\d*)?")  # name or address of a server, and its port
SECRET_OPTION = re.compile(r"([?&;][^=&;]*(?:pass|secret|token|key|auth)[^=&;]*)=([^&;]*)", re.IGNORECASE)
"""An option of a URL whose value is not shown."""
SIGMA = 0.2  # first standard deviation of CMA-ES, in unit coordinates


def open_storage(text: str | Any | None) -> Any:
    """Optuna storage of `journal:FILE` or a URL; None for a study in memory. ValueError where it cannot be opened."""
    import optuna
    from optuna.storages.journal import JournalFileBackend

    if not text:
        return None
    if not isinstance(text, str):
        return text
    kind, _, rest = text.partition(":")
    if kind == "journal" and rest:
        folder = os.path.dirname(os.path.abspath(rest))
        os.makedirs(folder, exist_ok=True)
        lock: Any = _Flock(rest)
        return optuna.storages.JournalStorage(JournalFileBackend(rest, lock_obj=lock))
    public = without_secrets(text)
    if "://" not in text:
        raise ValueError(f"storage {public!r} is neither journal:FILE nor a URL. Give for example "
                         "journal:runs/study.log or postgresql://user@host/name.")
    from sqlalchemy.engine import make_url
    from sqlalchemy.exc import ArgumentError, DBAPIError, SQLAlchemyError

    try:
        make_url(text)
    except (ArgumentError, ValueError):  # its message may quote the URL, or a part of the password
        raise ValueError(f"storage {public!r} cannot be opened: it is no database URL. Write it like "
                         "postgresql://user@host/name, special characters in it as %XX.") from None

    try:
        for _ in range(5):
            try:
                return optuna.storages.RDBStorage(text, engine_kwargs={"pool_pre_ping": True})
            except DBAPIError as error:  # another process may be making the tables at this moment
                if "connect" in str(error).lower():
                    raise
                time.sleep(POLL)
        return optuna.storages.RDBStorage(text, engine_kwargs={"pool_pre_ping": True})
    except ImportError as error:
        raise ValueError(f"storage {public!r} needs {error.name or 'a driver for this database'}. Install it, for "
                         "PostgreSQL by pip install psycopg2-binary.") from None
    except (SQLAlchemyError, TypeError, ValueError) as error:  # the last two of options that the driver does not know
        reason = _masked(str(error).strip().splitlines()[0], text)
        raise ValueError(f"storage {public!r} cannot be opened: {reason}. Check the server, the name and the "
                         "rights.") from None


def without_secrets(storage: Any) -> str:
    """The storage's text with *** for a password: what may be printed and stored."""
    if not isinstance(storage, str):
        return type(storage).__name__ if storage else ""
    if storage.startswith("journal:"):
        return storage
    scheme, mark, rest = storage.partition("://") if "://" in storage else ("", "", storage)
    login, at, place = rest.rpartition("@")
    if at:
        user, colon, secret = login.partition(":")
        rest = f"{user}{colon}{HIDDEN if secret else ''}@{place}"
    elif not HOST.fullmatch(rest.partition("/")[0].partition("?")[0]):  # a login without its host
        rest = f"{rest.partition(':')[0]}:{HIDDEN}"
    return scheme + mark + SECRET_OPTION.sub(rf"\1={HIDDEN}", rest)


def _masked(message: str, storage: str) -> str:
    """A message of a library in which neither the storage's URL nor a password of it appears."""
    message = message.replace(storage, without_secrets(storage))
    rest = storage.partition("://")[2]
    found = [rest.rpartition("@")[0].partition(":")[2], *(one[1] for one in SECRET_OPTION.findall(rest))]
    forms = {form for one in found for form in (one, unquote(one), unquote_plus(one)) if form}
    for secret in sorted(forms, key=len, reverse=True):
        message = message.replace(secret, HIDDEN)
    return message


@dataclass(frozen=True)
class StudyPlace:
    """Where a study is kept, and what it is about."""

    storage: Any = None  # of `open_storage`, or what it opens; None keeps the study in memory
    name: str = "fit"
    problem: Mapping[str, str] = field(default_factory=dict)  # what is searched; a study of another one is refused


class SharedStudy:
    """One process's part in a study."""

    def __init__(
        self, names: tuple[str, ...], initial: np.ndarray, place: StudyPlace, *, method: str = "tpe", seed: int = 0
    ):
        """Create or join the study of parameters `names` (unit coordinates), which begins at `initial` (P,); ValueError
        where the study is of another problem, or the method is unknown."""
        import optuna

        if method not in BATCH:
            raise ValueError(f"method {method!r} is no global search (known: {', '.join(BATCH)}).")
        storage, study = open_storage(place.storage), place.name
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self._optuna, self._names, self._storage = optuna, names, storage
        self._worker = uuid.uuid4().hex[:12]
        self.batch = BATCH[method]
        self._study = optuna.create_study(study_name=study if storage is not None else None, storage=storage,
                                          direction="minimize", load_if_exists=storage is not None)
        wanted = {"parameters": ", ".join(names), "method": method, **place.problem}
        for key, value in wanted.items():
            known = self._study.user_attrs.get(f"problem: {key}")
            if known is not None and known != value:
                raise ValueError(f"study {study!r} is of another problem: its {key} is {known!r}, here {value!r}. "
                                 "Choose another --study, or another storage.")
        begin = not self._study.user_attrs
        for key, value in wanted.items() if begin else ():
            self._study.set_user_attr(f"problem: {key}", value)
        self._beat()
        # Processes that draw with one seed would draw the same candidates.
        workers = sorted((value["began"], key) for key, value in self._study.user_attrs.items()
                         if key.startswith("worker: "))
        index = [key for _, key in workers].index(f"worker: {self._worker}")
        start = dict(zip(names, np.clip(initial, 0.0, 1.0).tolist(), strict=True))
        self._study.sampler = self._labelled(self._sampler(method, seed + 7919 * index, start))
        if begin:
            self._study.enqueue_trial(start, user_attrs={"initial": True})
        self._distributions: Any = {name: optuna.distributions.FloatDistribution(0.0, 1.0) for name in names}

    def run(self, costs: Callable[[np.ndarray], np.ndarray], evaluations: int,
            progress: Callable[[int, str], None] | None = None) -> None:
        """Ask, simulate (unit coordinates (N, P) -> costs (N,), whole batches) and tell until there are enough costs.
        """
        best = np.inf
        while True:
            self._beat()
            self.recover()
            trials = self._study.get_trials(deepcopy=False)
            done = sum(trial.state.name == "COMPLETE" for trial in trials)
            in_hand = sum(trial.state.name == "RUNNING" and "worker" in trial.user_attrs for trial in trials)
            count = min(self.batch, evaluations - done - in_hand)
            if done >= evaluations and not self._unsettled(trials):
                return
            if count <= 0:
                time.sleep(POLL)  # others have them in hand
                continue
            if done == 0 and count == self.batch:
                count = 1  # a sampler that knows nothing yet draws at random; the initial values give it the space
            asked = []
            for _ in range(count):
                asked.append(self._study.ask(self._distributions))
            u = np.array([[trial.params[name] for name in self._names] for trial in asked])
            found = costs(np.concatenate([u, np.repeat(u[-1:], self.batch - count, axis=0)]))[:count]
            for trial, value in zip(asked, found, strict=True):
                # The logarithm keeps diverged candidates from flattening the rest. Another process may have given this
                # one up and told the same candidate already.
                self._tell(trial, float(np.log(max(value, 1e-12))))
            best = min(best, float(found.min()))
            if progress is not None:
                progress(count, f"J {best:.4g}")

    def recover(self) -> int:
        """Queue again what dead processes left; returns how many candidates."""
        state = self._optuna.trial.TrialState
        trials = self._study.get_trials(deepcopy=False)
        dead = self._dead()
        left = [trial for trial in trials if trial.state == state.RUNNING and self._is_left(trial, dead)]
        again = {trial.user_attrs.get("retry_of") for trial in trials} if left else set()
        for trial in left:
            params = trial.params or trial.system_attrs.get("fixed_params", {})  # the latter where it was a repetition
            if trial.number not in again and set(params) == set(self._names):
                # Queued before it is given up: killed in between, it would be done twice, and never lost.
                self._study.enqueue_trial(params, user_attrs={"retry_of": trial.number})
            self._tell(trial.number, None, state.FAIL)
        return len(left)

    def table(self) -> tuple[np.ndarray, np.ndarray, int]:
        """Unit coordinates (N, P) and costs (N,) of all candidates, and which of them has the initial values."""
        trials = self._study.get_trials(deepcopy=False, states=(self._optuna.trial.TrialState.COMPLETE,))
        trials = sorted(trials, key=lambda trial: trial.number)
        initial = next((i for i, trial in enumerate(trials) if trial.user_attrs.get("initial")), 0)
        u = np.array([[trial.params[name] for name in self._names] for trial in trials])
        return u, np.exp(np.array([trial.value for trial in trials], float)), initial

    def _tell(self, trial: Any, value: float | None, state: Any = None) -> None:
        """Tell a result, unless another process has told one at this very moment."""
        try:
            self._study.tell(trial, value, state=state, skip_if_finished=True)
        except self._optuna.exceptions.UpdateFinishedTrialError:
            pass

    def _sampler(self, method: str, seed: int, start: dict[str, float]) -> Any:
        samplers = self._optuna.samplers
        if method == "tpe":
            return samplers.TPESampler(seed=seed, multivariate=True, constant_liar=True, n_startup_trials=STARTUP)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # x0 and sigma0 are to go in Optuna 6
            return samplers.CmaEsSampler(seed=seed, x0=start, sigma0=SIGMA, popsize=self.batch,
                                         warn_independent_sampling=False)

    def _labelled(self, sampler: Any) -> Any:
        """The sampler, writing this process's name on a candidate before drawing it: it may be killed meanwhile."""
        before = sampler.before_trial

        def label(study: Any, trial: Any) -> None:
            if self._storage is not None:
                self._storage.set_trial_user_attr(trial._trial_id, "worker", self._worker)
            before(study, trial)

        sampler.before_trial = label
        return sampler

    def _beat(self) -> None:
        if self._storage is None and self._study.user_attrs.get(f"worker: {self._worker}"):
            return  # nobody else looks
        about = self._study.user_attrs.get(f"worker: {self._worker}") or {
            "host": socket.gethostname(), "pid": os.getpid(), "began": time.time()}
        self._study.set_user_attr(f"worker: {self._worker}", {**about, "seen": time.time()})

    def _dead(self) -> set[str]:
        """Processes that can tell nothing any more."""
        found = set()
        for key, about in self._study.user_attrs.items():
            if key.startswith("worker: "):
                here = about["host"] == socket.gethostname()
                if not (_alive(about["pid"]) if here else time.time() - about["seen"] < LEASE):
                    found.add(key.removeprefix("worker: "))
        return found

    def _is_left(self, trial: Any, dead: set[str]) -> bool:
        worker = trial.user_attrs.get("worker")
        if worker is not None:
            return worker in dead
        begun = trial.datetime_start.timestamp() if trial.datetime_start else 0.0
        return time.time() - begun > (UNNAMED if dead else LEASE)

    def _unsettled(self, trials: Sequence[Any]) -> bool:
        """Whether a dead process may have made a candidate and not lived to write its name on it."""
        unnamed = any(trial.state.name == "RUNNING" and "worker" not in trial.user_attrs for trial in trials)
        return unnamed and bool(self._dead())


class _Flock:
    """Lock of a journal file that the system releases when its holder is killed; Optuna's own would be waited for."""

    def __init__(self, path: str):
        self._path, self._file = path, -1

    def acquire(self) -> bool:
        """Wait for the lock; then cut off a last line whose writer was killed before its end."""
        self._file = os.open(self._path + ".lock", os.O_RDWR | os.O_CREAT, 0o644)
        fcntl.flock(self._file, fcntl.LOCK_EX)
        with open(self._path, "r+b") as file:
            size = file.seek(0, os.SEEK_END)
            if size and (file.seek(size - 1), file.read(1))[1] != b"\n":
                file.seek(0)
                file.truncate(file.read().rfind(b"\n") + 1)
        return True

    def release(self) -> None:
        os.close(self._file)


def _alive(pid: int) -> bool:
    """Whether a process of this machine runs, and is more than a zombie."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return True


@dataclass(frozen=True)
class GlobalSearch:
    """How a global search goes."""

    evaluations: int = 500  # parameter sets to try; in a shared study, by all its processes together
    seed: int = 0
    cost: str = "weighted"  # "weighted" (least squares over all channels) or "paper" (sum of position RMSE)
    method: str = "tpe"  # "tpe" or "cmaes"
    best: int = 4  # how many of the best candidates to return in `starts`


def global_search(
    objective: Objective, space: Space, search: GlobalSearch, place: StudyPlace = StudyPlace(),  # noqa: B008
    progress: Progress | None = None,
) -> FitResult:
    """Minimise an objective over `space`, from the initial values on, in a study that processes may share."""
    costs: Callable[[np.ndarray], np.ndarray] = {
        "weighted": objective.weighted_cost, "paper": objective.paper_cost}[search.cost]
    about = {"cost": search.cost, "initial values": ", ".join(f"{value:.6g}" for value in space.initial),
             "bounds": ", ".join(f"{low:.6g} to {high:.6g}" for low, high in zip(space.low, space.high, strict=True)),
             **place.problem}
    shared = SharedStudy(space.names, space.to_unit(space.initial), replace(place, problem=about),
                         method=search.method, seed=search.seed)

    def kept(u: np.ndarray) -> np.ndarray:
        """Costs as a step, unless a storage keeps them: others may have added to it since."""
        return costs(u) if place.storage else step("candidates", lambda: [costs(u)], u)[0]

    shared.run(kept, search.evaluations, progress)
    u, values, initial = shared.table()
    order = np.argsort(values)
    return FitResult(u=u[order[0]], cost=float(values[order[0]]), initial_cost=float(values[initial]),
                     evaluations=len(values), starts=u[order[: search.best]], history=np.minimum.accumulate(values))
