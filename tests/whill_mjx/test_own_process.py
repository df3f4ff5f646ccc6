"""What computes on the processor beside an accelerator."""

import multiprocessing
import os
import signal
import threading
import time
from pathlib import Path

import jax
import pytest

from whill_mjx.io.own_process import on_processor_apart
from whill_mjx.learning import vehicle_of_run


def seen(word):
    import jax

    return word, os.getpid(), jax.default_backend(), os.environ["JAX_PLATFORMS"]


def work_for_ever(path):
    path.touch()
    time.sleep(600)


def refuse(path):
    raise ValueError(f"{path}: not a log")


def test_the_call_runs_elsewhere_on_the_processor_and_this_process_stays_as_it_was(monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "cpu,cuda")
    word, process, backend, platforms = on_processor_apart(seen, "a")
    assert word == "a" and process != os.getpid() and backend == platforms == "cpu"
    assert os.environ["JAX_PLATFORMS"] == "cpu,cuda"
    monkeypatch.delenv("JAX_PLATFORMS")
    on_processor_apart(seen, "a")
    assert "JAX_PLATFORMS" not in os.environ


@pytest.mark.quick
def test_an_error_of_the_call_is_the_caller_s():
    with pytest.raises(ValueError, match="x: not a log"):
        on_processor_apart(refuse, "x")


@pytest.mark.quick
def test_a_process_that_is_ended_from_outside_is_said():
    with pytest.raises(OSError, match="ended from outside.*same command again"):
        on_processor_apart(os._exit, 1)


@pytest.mark.quick
def test_ctrl_c_ends_the_other_process_too(tmp_path):
    def interrupt():
        while not (tmp_path / "begun").exists():
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(KeyboardInterrupt):
        on_processor_apart(work_for_ever, tmp_path / "begun")
    end = time.monotonic() + 120  # it would sleep on for ten minutes
    while multiprocessing.active_children() and time.monotonic() < end:
        time.sleep(0.05)
    assert multiprocessing.active_children() == []


@pytest.mark.quick
@pytest.mark.parametrize("backend, apart", [("gpu", True), ("cpu", False)])
def test_a_vehicle_is_fitted_on_the_processor(monkeypatch, tmp_path, backend, apart):
    calls = []
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setattr(vehicle_of_run, "on_processor_apart", lambda call, *args: calls.append((call, args)))
    monkeypatch.setattr(vehicle_of_run, "fit_quickly", lambda *args: calls.append((None, args)))
    found = vehicle_of_run._fitted(Path("log"), tmp_path, lambda text: None)
    assert found == tmp_path / "vehicle.toml"
    assert calls == [(vehicle_of_run.fit_quickly if apart else None, (Path("log"), tmp_path))]
