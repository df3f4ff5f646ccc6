"""Builds a network and runs one step of it in a process of its own, within limits of time and memory.

A damaged network can loop for ever, ask for all memory or end the process that runs it, and no library call can be
stopped from outside in every case. A process can. What passes here is then built again by the reader.
"""

import dataclasses
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

import numpy as np

from bridge.policy.contract import DTYPES, Tensor
from bridge.policy.parts import EXPORT_AGAIN, MIB, PolicyFileError

TRIAL_SECONDS = 0.5
"""Processor time in which a small network must be built and make a step, twice: five control periods at 10 Hz."""
START_SECONDS = 0.2
"""Processor time in which a desktop starts this process. A computer that takes longer is given more in proportion."""
BUILD_RATE = 100e6
"""Bytes of a network for which one more second is given. A desktop builds 25 MB twice in 0.2 s."""
WALL_SECONDS = 60.0
"""Longest time of the whole trial, for a computer so busy that the processor time does not pass."""
ROOM = 256 * MIB
"""Memory for a step of a small network [bytes], beyond that of the runtime itself."""
NETWORK_COPIES = 4
"""Copies of a network's parameters that building it makes at most."""
ROOM_PER_PIXEL = 256
"""Memory per byte of the observation: three activations of 64 float32 channels at full resolution take 256 times it."""
OK, BAD, LATE = "ok", "bad: ", "late"
PROGRAM = "from bridge.policy.trial import main; main()"


class Trial:
    """A process that waits for a network. It starts while the reader still checks hashes."""

    def __init__(self) -> None:
        path = os.pathsep.join(os.path.abspath(entry) for entry in sys.path)
        try:
            self._folder = tempfile.TemporaryDirectory()  # empty: a network that names files beside itself finds none
            self._process = subprocess.Popen(
                [sys.executable, "-c", PROGRAM], cwd=self._folder.name, env={**os.environ, "PYTHONPATH": path},
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        except OSError as error:
            raise PolicyFileError(f"the trial step of a policy cannot be run: {error}. It needs a process of its own "
                                  "and a folder for temporary files. Free memory, processes or disk space.") from error

    def __enter__(self) -> "Trial":
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()
        self._folder.cleanup()

    def run(self, name: str, network: bytes, inputs: list[Tensor], outputs: list[Tensor]) -> None:
        """Build the network and run one step on zeros, such as a black image.

        Args:
            name: the file, for messages.
            network: serialised ONNX model.
            inputs: its inputs, all zero in this step.
            outputs: the outputs to compute.

        Raises:
            PolicyFileError: the runtime refuses it, it needs too much time or memory, it ends the process, or what it
                gives is not finite.
        """
        seconds = TRIAL_SECONDS + len(network) / BUILD_RATE
        observed = sum(math.prod(tensor.shape) for tensor in inputs)
        request = {"seconds": seconds, "memory": ROOM + NETWORK_COPIES * len(network) + ROOM_PER_PIXEL * observed,
                   "inputs": [dataclasses.astuple(tensor) for tensor in inputs],
                   "outputs": [dataclasses.astuple(tensor) for tensor in outputs]}
        try:
            given = json.dumps(request).encode() + b"\n" + network
            said = self._process.communicate(given, WALL_SECONDS)
            output, errors = (text.decode("utf-8", "replace") for text in said)
            granted, _, answer = output.partition("\n")
            allowed = f"{granted} of processor time"
        except subprocess.TimeoutExpired:
            self._process.kill()
            answer, errors, allowed = LATE, "", f"{WALL_SECONDS:.0f} s"
        code = self._process.poll() or 0
        if answer == OK:
            return
        if answer.startswith(BAD):
            raise PolicyFileError(f"{name}: {answer.removeprefix(BAD)}. {EXPORT_AGAIN}.")
        if answer == LATE or code == -getattr(signal, "SIGPROF", 0):
            raise PolicyFileError(f"{name}: a first step is not done after {allowed}. A step "
                                  f"must be much shorter than a control period. {EXPORT_AGAIN}.")
        problem = (answer or errors[-500:]).strip() or f"the process of its trial step ended with code {code}"
        raise PolicyFileError(f"{name}: onnxruntime refuses it: {problem}. It must hold standard operators that this "
                              f"runtime knows, and a step must fit in {request['memory']} bytes. {EXPORT_AGAIN}, or "
                              "install a newer onnxruntime.")


def leave_realtime() -> None:
    """Run as a normal process where one in real time started this: a network that loops must not take its core."""
    if hasattr(os, "sched_setscheduler"):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def main() -> None:
    """Answer one trial: the request as a line of JSON and the network come in; time granted and answer go out."""
    leave_realtime()
    import onnxruntime

    onnxruntime.set_default_logger_severity(4)
    started = time.process_time()
    request = json.loads(sys.stdin.buffer.readline())
    network = sys.stdin.buffer.read()
    seconds = request["seconds"] * max(1.0, started / START_SECONDS)
    print(f"{seconds:.1f} s", flush=True)
    _limit(seconds, request["memory"])
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.enable_cpu_mem_arena = False  # it grows by powers of two, beyond what is needed
    levels = onnxruntime.GraphOptimizationLevel
    inputs, outputs = ([Tensor(name, tuple(shape), dtype) for name, shape, dtype in request[key]]
                       for key in ("inputs", "outputs"))
    try:
        # First as it stands: then nothing is computed while it is built. Then as the reader builds it.
        for level in (levels.ORT_DISABLE_ALL, levels.ORT_ENABLE_ALL):
            options.graph_optimization_level = level
            session = onnxruntime.InferenceSession(network, options, providers=["CPUExecutionProvider"])
            _compare("inputs", inputs, _declared(session.get_inputs()))
            _compare("outputs", outputs, _declared(session.get_outputs()))
            results = session.run([tensor.name for tensor in outputs],
                                  {tensor.name: np.zeros(tensor.shape, tensor.dtype) for tensor in inputs})
            _compare("outputs of a step on zeros", outputs, [
                Tensor(tensor.name, np.shape(value), str(np.asarray(value).dtype))
                for tensor, value in zip(outputs, results, strict=True)])
            bad = [tensor.name for tensor, value in zip(outputs, results, strict=True) if not np.isfinite(value).all()]
            if bad:
                raise _Refused(f"a step on zeros gives {', '.join(bad)} that is not finite, but actions and states "
                               "must be finite, and so must the parameters of the training")
            del session
        answer = OK
    except _Refused as error:
        answer = BAD + str(error)
    except Exception as error:  # onnxruntime's own exception types all derive from Exception directly
        answer = f"{type(error).__name__} of version {onnxruntime.__version__}: {str(error)[:500]}"
    sys.stdout.buffer.write(answer.encode("utf-8", "replace"))


class _Refused(Exception):
    """The network contradicts policy.json: what it has, and the rule."""


def _declared(tensors: list[Any]) -> list[Tensor]:
    return [Tensor(tensor.name, tuple(tensor.shape), DTYPES.get(tensor.type, tensor.type)) for tensor in tensors]


def _compare(kind: str, wanted: list[Tensor], found: list[Tensor]) -> None:
    want, got = ({tensor.name: (tensor.shape, tensor.dtype) for tensor in tensors} for tensors in (wanted, found))
    if want != got:
        raise _Refused(f"{kind} {str(got)[:1000]}, but policy.json says {str(want)[:1000]}: both must agree")


def _limit(seconds: float, memory: int) -> None:
    """Let the system end this process after `seconds` of processor time, and refuse it more `memory` [bytes]."""
    try:
        import resource
    except ImportError:
        return  # not on Windows: there only the wall clock limits the trial
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        with open("/proc/self/statm") as statm:
            used = int(statm.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + memory,) * 2)
    except (OSError, ValueError):
        pass  # no such limit on this system
