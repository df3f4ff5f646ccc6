"""Most of the suite's time is XLA compiling small programs: none is compiled twice, many with few optimisations."""

import ctypes
import gc
import os
import signal
from collections import Counter
from contextlib import contextmanager, suppress
from pathlib import Path

import jax
import jaxlib
import pytest

from whill_mjx import share_results

share_results()
ROOT = str(Path(__file__).parents[1])
os.environ["PYTHONPATH"] = os.pathsep.join([ROOT, *filter(None, [os.environ.get("PYTHONPATH")])])
"""Commands that tests start are of this tree; other packages stay where they were found."""
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # in the background of a script; processes of tests need it
    signal.signal(signal.SIGINT, signal.default_int_handler)
FLAGS = ["--xla_cpu_parallel_codegen_split_count=1"]  # the cores have workers of their own
if jaxlib.__version__.startswith("0.10."):
    # Half the time to compile; later versions of XLA do not know this flag, and end over one that they do not know.
    FLAGS.append("--xla_cpu_use_fusion_emitters=false")
os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *FLAGS]).strip()
os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(Path(__file__).with_name("loopback.xml"))
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "SYSTEM_DEFAULT"
MOST_BYTES = 2_000_000_000
"""Memory of a worker beyond which it forgets what it has compiled."""

QUICK_TO_COMPILE = (
    "dreamer", "whill_mjx", "test_among.py", "test_calibration.py", "test_effect_from_outside.py", "test_fit.py",
    "test_loop_vehicle_file.py", "test_normal_equations.py", "test_pieces.py", "test_rollout.py", "test_search.py",
)  # fmt: skip
"""Folders and files whose programs take far longer to compile than to run; most of `sysid` replay many long drives."""


def pytest_collection_finish():
    """What was imported stays: Python need not look through it for garbage, nor so often through what is traced."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 50)


@contextmanager
def options(**values):
    """JAX's options with these values, in processes that are started meanwhile too."""
    old = {name: jax.config.values[name] for name in values}
    with pytest.MonkeyPatch.context() as patch:
        for name, value in values.items():
            jax.config.update(name, value)
            patch.setenv(name.upper(), str(value))
        try:
            yield
        finally:
            for name, value in old.items():
                jax.config.update(name, value)


@pytest.fixture(scope="session", autouse=True)
def compilation_cache(tmp_path_factory):
    """One cache of compiled programs for all workers of a run and for the processes that tests start.

    JAX_COMPILATION_CACHE_DIR names one that is kept for later runs.
    """
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    kept = os.environ.get("JAX_COMPILATION_CACHE_DIR", str(folder / "compiled"))
    with options(jax_compilation_cache_dir=kept, jax_persistent_cache_min_compile_time_secs=0.1):
        yield


@pytest.fixture
def programs():
    """Counts cache_hits and cache_misses of the compiled programs; every one of the test is kept."""
    counted = Counter()

    def count(name, **about):
        counted[name.rpartition("/")[2]] += 1

    jax.monitoring.register_event_listener(count)
    with options(jax_persistent_cache_min_compile_time_secs=0.0):
        yield counted
    jax.monitoring.unregister_event_listener(count)


@pytest.fixture(scope="module", autouse=True)
def few_optimisations(request):
    """XLA compiles these programs in about half the time."""
    if not {request.path.parent.name, request.path.name} & set(QUICK_TO_COMPILE):
        yield
        return
    with options(jax_disable_most_optimizations=True):
        yield


@pytest.fixture(scope="module", autouse=True)
def less_memory():
    """Compiling leaves much memory free that the C library keeps: a worker grew to 6 GB. It is given back."""
    yield
    with suppress(OSError, AttributeError):
        trim = ctypes.CDLL("libc.so.6").malloc_trim
        trim(0)
        if int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") > MOST_BYTES:
            jax.clear_caches()
            trim(0)
