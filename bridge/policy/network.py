"""Runs the network of a checked policy, in two halves where a part of it needs no observation."""

from collections.abc import Iterable, Mapping
from typing import Any

from bridge.policy.halves import Between, Cut, UnknownForm

Arrays = Mapping[str, Any]
"""Arrays by the name of an input or an output."""


class Network:
    """A recurrent network: what `early` gives depends on its state alone, and `late` needs it and the observations."""

    def __init__(self, model: bytes, observations: Iterable[str], threads: int = 1) -> None:
        """Build the sessions of a serialised ONNX model, which was tried as a whole before, on so many threads."""
        self._halves: list[Any] = []
        try:
            cut = Cut(model, frozenset(observations))
            first = build(cut.first(), threads)
            second = cut.second([_between(one) for one in first.get_outputs() if one.name in cut.between])
            self._halves = [first, build(second, threads)]
        except Exception:  # also of onnxruntime, whose types all derive from Exception directly: the whole is sound
            self._whole = build(model, threads)

    @property
    def in_halves(self) -> bool:
        """Whether a part of a step can be computed before its observation."""
        return bool(self._halves)

    def early(self, state: Arrays) -> Arrays:
        """Return what of a step no observation changes."""
        return _run(self._halves[0], state) if self._halves else {}

    def late(self, observed: Arrays, state: Arrays, early: Arrays) -> Arrays:
        """Return all outputs of a step."""
        if not self._halves:
            return _run(self._whole, {**observed, **state})
        return {**early, **_run(self._halves[1], {**observed, **state, **early})}


def build(model: bytes, threads: int = 1) -> Any:
    """Return a session of onnxruntime for a serialised model, on so many threads, the calling one among them."""
    import onnxruntime

    onnxruntime.set_default_logger_severity(3)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    session.disable_fallback()
    vars(session).pop("_model_bytes", None)  # it keeps the whole file to build itself again for a fallback
    return session


def _run(session: Any, known: Arrays) -> dict[str, Any]:
    names, given = ([one.name for one in some] for some in (session.get_outputs(), session.get_inputs()))
    return dict(zip(names, session.run(names, {name: known[name] for name in given}), strict=True))


def _between(one: Any) -> Between:
    """Return what onnxruntime found of an output."""
    if not all(isinstance(size, int) for size in one.shape):
        raise UnknownForm(f"a value of open shape {one.shape} between the halves")
    return Between(one.name, one.type, tuple(one.shape))
