"""Studies of a global search: batches, CMA-ES, several processes, and processes that are killed."""

from __future__ import annotations

import glob
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import TRUTH, UNICYCLE_SPACE

from sysid.search import studies
from sysid.search.studies import BATCH, SharedStudy, StudyPlace, open_storage

NAMES = ("a", "b")
GOAL = np.array([0.3, 0.8])
WORKER = """
import os, sys, time
import numpy as np
from sysid.search.studies import SharedStudy, StudyPlace

storage, evaluations, pause, gate = sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), sys.argv[5]
batches = 0

def costs(u):
    global batches
    batches += 1
    if gate and batches > 2:
        open(gate + ".reached", "w").close()
        while not os.path.exists(gate):
            time.sleep(0.02)
    time.sleep(pause)
    return np.square(u - [0.3, 0.8]).sum(-1) + 1e-3

study = SharedStudy(("a", "b"), np.array([0.5, 0.5]), StudyPlace(storage, "shared"), method=sys.argv[4])
study.run(costs, evaluations)
"""
LONG = 300
"""Seconds that only end a hang."""


def quadratic(u):
    return np.square(u - GOAL).sum(-1) + 1e-3


def start_worker(storage, evaluations, pause, method="tpe", gate=""):
    """A process that searches; with a gate, it keeps its third batch in hand until there is a file of that name."""
    words = [storage, str(evaluations), str(pause), method, str(gate)]
    return subprocess.Popen([sys.executable, "-c", WORKER, *words], cwd=Path(__file__).parents[2])


def trials_of(storage):
    """All trials; a storage that is open already is not opened again, which takes a database a while."""
    import optuna

    return optuna.load_study(study_name="shared", storage=open_storage(storage)).get_trials(deepcopy=False)


def process_of(storage, worker):
    import optuna

    study = optuna.load_study(study_name="shared", storage=open_storage(storage))
    return study.user_attrs[f"worker: {worker}"]["pid"]


def candidates_of(storage, process):
    """How many candidates bear the name of a process."""
    try:
        named = [trial.user_attrs["worker"] for trial in trials_of(storage) if "worker" in trial.user_attrs]
        return sum(process_of(storage, worker) == process.pid for worker in named)
    except (KeyError, ValueError):  # there is no study yet
        return 0


def wait_for(condition):
    end = time.monotonic() + LONG
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)


def counted(storage, state):
    try:
        return sum(trial.state.name == state for trial in trials_of(storage))
    except (KeyError, ValueError):
        return 0


def one_of_three_is_killed(storage, evaluations, tmp_path):
    """Two processes search; one is killed with candidates in hand, and a third takes its place. Returns the first.

    Gates hold the first two while this test, or the third process, is late: they would have done everything meanwhile.
    """
    place = storage if isinstance(storage, str) else storage.url
    first = start_worker(place, evaluations, 0.3, gate=tmp_path / "never")
    second = start_worker(place, evaluations, 0.6, gate=tmp_path / "gate")
    workers = [first, second]
    try:
        wait_for(lambda: (tmp_path / "never.reached").exists() and candidates_of(storage, second))
        first.kill()
        first.wait()
        workers.append(third := start_worker(place, evaluations, 0.05))
        wait_for(lambda: candidates_of(storage, third))
        (tmp_path / "gate").touch()
        assert second.wait(LONG) == third.wait(LONG) == 0
    finally:
        for worker in workers:  # whatever has failed, nobody waits at a gate for ever
            worker.kill()
    return first


def check_nothing_is_lost(trials, evaluations):
    """Every candidate that was drawn has a cost, its own or that of its repetition, and the costs are right."""
    done = {trial.number: trial for trial in trials if trial.state.name == "COMPLETE"}
    assert len(done) >= evaluations
    repeated = {trial.user_attrs["retry_of"]: trial for trial in trials if "retry_of" in trial.user_attrs}
    for trial in trials:
        assert trial.state.name in ("COMPLETE", "FAIL")
        if trial.state.name == "FAIL" and trial.params.keys() == set(NAMES):
            assert repeated[trial.number].params == trial.params
    for trial in done.values():
        u = np.array([trial.params[name] for name in NAMES])
        assert np.exp(trial.value) == pytest.approx(quadratic(u))


def test_a_killed_process_loses_no_trial_of_a_journal(tmp_path):
    storage = f"journal:{tmp_path / 'study.log'}"
    first = one_of_three_is_killed(storage, 96, tmp_path)
    trials = trials_of(storage)
    check_nothing_is_lost(trials, 96)
    given_up = [trial for trial in trials if trial.state.name == "FAIL"]
    named = [trial.user_attrs["worker"] for trial in given_up if "worker" in trial.user_attrs]
    # Of the killed process alone; it may have died before it wrote its name on its last one.
    assert given_up and len(given_up) - len(named) <= 1
    assert {process_of(storage, worker) for worker in named} <= {first.pid}
    assert len({trial.user_attrs["worker"] for trial in trials if "worker" in trial.user_attrs}) == 3
    assert len(trials) < 96 + 3 * BATCH["tpe"] + len(given_up)


def test_a_study_that_lost_its_only_process_goes_on_where_it_was(tmp_path):
    storage = f"journal:{tmp_path / 'study.log'}"
    alone = start_worker(storage, 10**6, 0.05, "cmaes")
    wait_for(lambda: counted(storage, "COMPLETE") >= 3 * BATCH["cmaes"])
    alone.kill()
    alone.wait()
    before = {trial.number: trial.value for trial in trials_of(storage) if trial.state.name == "COMPLETE"}
    study = SharedStudy(NAMES, np.array([0.5, 0.5]), StudyPlace(storage, "shared"), method="cmaes")
    study.run(quadratic, len(before) + 2 * BATCH["cmaes"])
    after = {trial.number: trial.value for trial in trials_of(storage) if trial.state.name == "COMPLETE"}
    assert before.items() <= after.items()
    check_nothing_is_lost(trials_of(storage), len(before) + 2 * BATCH["cmaes"])


@pytest.fixture
def postgresql():
    """URL of a PostgreSQL server of this test's own, reached by a socket in its own folder."""
    pytest.importorskip("psycopg2", reason="psycopg2 is not installed")
    programs = [*glob.glob("/usr/lib/postgresql/*/bin"), os.path.dirname(shutil.which("initdb") or "")]
    programs = [folder for folder in programs if folder and os.access(f"{folder}/pg_ctl", os.X_OK)]
    if not programs:
        pytest.skip("PostgreSQL is not installed (Debian: apt-get install postgresql)")
    as_user = []
    if os.geteuid() == 0:  # the server refuses to run as root
        if subprocess.run(["id", "postgres"], capture_output=True).returncode or not shutil.which("runuser"):
            pytest.skip("PostgreSQL does not run as root, and there is no user postgres")
        as_user = ["runuser", "-u", "postgres", "--"]
    folder = tempfile.mkdtemp(prefix="pg", dir="/tmp")  # short: a socket's path has at most 107 characters
    if as_user:
        shutil.chown(folder, "postgres")

    def call(*words):
        done = subprocess.run([*as_user, *words], cwd=folder, capture_output=True, text=True, timeout=LONG)
        assert done.returncode == 0, done.stdout + done.stderr

    try:
        call(f"{programs[0]}/initdb", "-D", f"{folder}/data", "-U", "postgres", "-A", "trust", "--no-sync")
        call(f"{programs[0]}/pg_ctl", "-D", f"{folder}/data", "-w", "-l", f"{folder}/log", "-o",
             f"-k {folder} -c listen_addresses='' -c fsync=off", "start")
        yield f"postgresql+psycopg2:///postgres?host={folder}&user=postgres"
    finally:
        subprocess.run([*as_user, f"{programs[0]}/pg_ctl", "-D", f"{folder}/data", "-m", "immediate", "stop"],
                       cwd="/tmp", capture_output=True)
        shutil.rmtree(folder, ignore_errors=True)


def test_processes_share_a_study_in_postgresql_and_one_may_be_killed(postgresql, tmp_path):
    storage = open_storage(postgresql)
    one_of_three_is_killed(storage, 64, tmp_path)
    check_nothing_is_lost(trials_of(storage), 64)


def test_cmaes_finds_the_planted_parameters(objective):
    search = studies.GlobalSearch(15 * BATCH["cmaes"], 1, method="cmaes")
    result = studies.global_search(objective, objective.space, search)
    assert result.evaluations == 15 * BATCH["cmaes"]
    assert result.cost < 1.5 < result.initial_cost
    np.testing.assert_allclose(UNICYCLE_SPACE.to_values(result.u), TRUTH, rtol=0.15)


@pytest.mark.quick
@pytest.mark.parametrize(("method", "batch"), BATCH.items())
def test_candidates_are_simulated_in_whole_batches_and_the_initial_values_come_first(method, batch):
    sizes, first = [], []

    def costs(u):
        sizes.append(len(u))
        first.append(u[0])
        return quadratic(u)

    study = SharedStudy(NAMES, np.array([0.5, 0.6]), StudyPlace(), method=method, seed=3)
    study.run(costs, 60)
    u, values, initial = study.table()
    assert set(sizes) == {batch} and len(sizes) == 1 + -(-59 // batch) and len(u) == 60
    np.testing.assert_allclose(first[0], [0.5, 0.6])
    np.testing.assert_allclose(u[initial], [0.5, 0.6])
    np.testing.assert_allclose(values, quadratic(u))
    assert values.min() < 0.1 * values[initial]


@pytest.mark.quick
def test_a_line_that_was_not_written_to_its_end_is_cut_off(tmp_path):
    path = tmp_path / "study.log"
    SharedStudy(NAMES, np.array([0.5, 0.5]), StudyPlace(f"journal:{path}")).run(quadratic, 5)
    with open(path, "ab") as file:
        file.write(b'{"op_code": 6, "worker')
    study = SharedStudy(NAMES, np.array([0.5, 0.5]), StudyPlace(f"journal:{path}"))
    study.run(quadratic, 9)
    assert len(study.table()[0]) == 9


@pytest.mark.quick
@pytest.mark.parametrize("repetition", [False, True])
def test_a_candidate_whose_process_died_before_naming_it_is_given_up_before_the_end(tmp_path, monkeypatch, repetition):
    monkeypatch.setattr(studies, "UNNAMED", 0.5)
    storage = open_storage(f"journal:{tmp_path / 'study.log'}")
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    study = SharedStudy(NAMES, np.array([0.5, 0.5]), StudyPlace(storage, "shared"))
    study.run(quadratic, 1)
    known = study._study
    known.set_user_attr("worker: 1", {"host": socket.gethostname(), "pid": dead.pid, "began": 0.0, "seen": 0.0})
    if repetition:
        known.enqueue_trial({"a": 0.1, "b": 0.2})
        number = storage.get_trial(known._pop_waiting_trial_id()).number
    else:
        number = storage.get_trial(storage.create_new_trial(known._study_id)).number
    study.run(quadratic, 1)
    assert known.trials[number].state.name == "FAIL"
    study.run(quadratic, 9)
    again = [trial for trial in known.trials if trial.user_attrs.get("retry_of") == number]
    assert [trial.params for trial in again] == ([{"a": 0.1, "b": 0.2}] if repetition else [])
    assert all(trial.state.name == "COMPLETE" for trial in known.trials if trial.number != number)


@pytest.mark.quick
def test_processes_with_one_seed_draw_different_candidates(tmp_path):
    storage = open_storage(f"journal:{tmp_path / 'study.log'}")
    one, other = (SharedStudy(NAMES, np.array([0.5, 0.5]), StudyPlace(storage), seed=5) for _ in range(2))
    one.run(quadratic, 17)
    other.run(quadratic, 33)
    u = one.table()[0]
    assert len(u) == 33 and len(np.unique(u, axis=0)) == 33


@pytest.mark.quick
def test_a_study_of_another_problem_is_refused(tmp_path):
    storage = open_storage(f"journal:{tmp_path / 'study.log'}")
    SharedStudy(NAMES, np.array([0.5, 0.5]), StudyPlace(storage, problem={"data": "monday"}))
    with pytest.raises(ValueError, match="its data is 'monday', here 'tuesday'. Choose another --study"):
        SharedStudy(NAMES, np.array([0.5, 0.5]), StudyPlace(storage, problem={"data": "tuesday"}))
    with pytest.raises(ValueError, match="its method is 'tpe', here 'cmaes'"):
        SharedStudy(NAMES, np.array([0.5, 0.5]), StudyPlace(storage, problem={"data": "monday"}), method="cmaes")


URLS = [
    "postgresql://bob:hush-hush@localhost:1/name", "postgresql://bob:hush%2Dhush@localhost:1/name",
    "postgresql://bob:hush-hush@server:port/name", "postgresql://bob:hush-@:/hush@localhost:1/name",
    "postgresql://bob:hush-hush", "bob:hush-hush@localhost/name", "nosuch://bob:hush-hush@localhost/name",
    "postgresql://localhost:1/name?sslpassword=hush-hush&connect_timeout=1",
]


@pytest.mark.quick
@pytest.mark.parametrize("url", URLS)
def test_a_password_in_a_storage_is_not_in_its_errors(url):
    with pytest.raises(ValueError, match="storage") as caught:
        open_storage(url)
    assert "hush" not in str(caught.value) and "***" in str(caught.value)
    # A traceback would show the library's own error.
    assert caught.value.__suppress_context__ or caught.value.__context__ is None


@pytest.mark.quick
def test_a_storage_is_shown_with_user_server_and_name_and_without_its_password():
    shown = studies.without_secrets("postgresql://bob:hush-hush@server:5432/name?sslpassword=hush&application_name=fit")
    assert shown == "postgresql://bob:***@server:5432/name?sslpassword=***&application_name=fit"
    for harmless in ("", "journal:runs/a:b@c.log", "postgresql://bob@server/name", "sqlite:////tmp/study.db",
                     "postgresql://server:5432/name", "postgresql://[::1]:5432/name"):
        assert studies.without_secrets(harmless) == harmless


@pytest.mark.quick
@pytest.mark.parametrize(("text", "message"), [
    ("study.log", "neither journal:FILE nor a URL"),
    ("postgresql:///nowhere?host=/nonexistent", "cannot be opened|needs"), ("nosuch://x", "cannot be opened")])
def test_a_storage_that_cannot_be_opened_says_why(text, message):
    with pytest.raises(ValueError, match=message):
        open_storage(text)
