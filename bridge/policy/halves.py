"""Cuts a network into what a step can compute before its observation comes, and the rest.

A recurrent policy reads most of its weights to advance its state by the last action. No observation enters there, so a
vehicle can compute it in the idle time after a command. Both halves hold the nodes of the whole as they are. A vehicle
has no package for ONNX, so the wire format of Protocol Buffers is read and written here.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

GRAPH, FUNCTIONS = 7, 25  # fields of a model
NODE, WEIGHT, INPUT, OUTPUT, VALUE = 1, 5, 11, 12, 13  # of a graph
TAKES, GIVES, OPERATOR, ATTRIBUTE = 1, 2, 4, 5  # of a node
WEIGHT_NAME, VALUE_NAME = 8, 1
SUBGRAPH, SUBGRAPHS = 6, 11  # of an attribute
BY_CHANCE = ("Random", "Multinomial", "Bernoulli")
"""Beginnings of the operators that give something else each time."""
ELEMENTS = {"tensor(float)": 1, "tensor(uint8)": 2, "tensor(int32)": 6, "tensor(int64)": 7, "tensor(bool)": 9,
            "tensor(float16)": 10, "tensor(double)": 11, "tensor(uint32)": 12}
"""ONNX's numbers of the types that a value between the halves may have."""


class Field(NamedTuple):
    """One field of a message."""

    number: int
    """That says what it is."""
    value: memoryview
    """A text, packed numbers or a message of its own; empty of a single number."""
    written: memoryview
    """The field as it stands in the message."""


class UnknownForm(ValueError):
    """A network that is left whole: its bytes or its operators have a form that is not known here."""


@dataclass(frozen=True)
class Between:
    """A value that the first half gives the second."""

    name: str
    kind: str
    """As onnxruntime names it, such as tensor(float)."""
    shape: tuple[int, ...]


class Cut:
    """Where a network is cut."""

    def __init__(self, network: bytes, observations: frozenset[str]) -> None:
        """Sort the nodes of a network whose inputs of these names come late.

        Raises:
            UnknownForm: the network is better left whole.
        """
        model = list(fields(memoryview(network)))
        graphs = [one.value for one in model if one.number == GRAPH]
        if len(graphs) != 1 or any(one.number == FUNCTIONS for one in model):
            raise UnknownForm("a model of other parts than one graph")
        self._about = b"".join(one.written for one in model if one.number != GRAPH)
        self._graph = list(fields(graphs[0]))
        self._inputs = {_text(one, VALUE_NAME): one for one in self._all(INPUT)}
        self._outputs = {_text(one, VALUE_NAME): one for one in self._all(OUTPUT)}
        self._weights = {_text(one, WEIGHT_NAME): one for one in self._all(WEIGHT)}
        self._nodes = [_Node(one) for one in self._all(NODE)]
        early = set(self._inputs) - observations - set(self._weights)
        late = set(observations)
        for node in self._nodes:  # what depends on no input is in both halves, so that it is computed at once
            if late.intersection(node.takes):
                late.update(node.gives)
                node.is_early = False
            elif early.intersection(node.takes):
                early.update(node.gives)
                node.is_late = False
        given = {name for node in self._nodes if not node.is_late for name in node.gives}
        wanted = {name for node in self._nodes if not node.is_early for name in node.takes}
        self.between = sorted(given & wanted)
        """Names of the values that the first half gives the second."""
        self._first = [name for name in self._outputs if name in given and name not in wanted]
        self._both = [name for name in self._outputs if name in given and name in wanted]
        if not given or not wanted:
            raise UnknownForm("a model of one half")

    def first(self) -> bytes:
        """Return the ONNX model of what no observation enters; its outputs are `between` and outputs of the whole."""
        names = [*self.between, *self._first]
        outputs = [self._outputs.get(name) or _field(VALUE_NAME, name.encode()) for name in names]
        return self._half([node for node in self._nodes if node.is_early], [], names, outputs)

    def second(self, between: list[Between]) -> bytes:
        """Return the ONNX model of the rest; its inputs are observations, the state and what lies between."""
        inputs = [_declared(one) for one in between]
        names = [name for name in self._outputs if name not in (*self._first, *self._both)]
        late = [node for node in self._nodes if node.is_late]
        return self._half(late, inputs, names, [self._outputs[name] for name in names])

    def _half(self, nodes: "list[_Node]", inputs: list[bytes], names: list[str],
              outputs: Sequence[bytes | memoryview]) -> bytes:
        needed, kept = set(names), []
        for node in reversed(nodes):
            if needed.intersection(node.gives):
                needed.update(node.takes)
                kept.append(node)
        own = [one for name, one in self._inputs.items() if name in needed and name not in self._weights]
        weights = [one for name, one in self._weights.items() if name in needed]
        others = [one.written for one in self._graph if one.number not in (NODE, WEIGHT, INPUT, OUTPUT, VALUE)]
        parts: tuple[tuple[int, Sequence[bytes | memoryview]], ...] = (
            (NODE, [node.content for node in reversed(kept)]), (WEIGHT, weights), (INPUT, [*own, *inputs]),
            (OUTPUT, outputs))
        graph = b"".join([*others, *(_field(number, value) for number, values in parts for value in values)])
        return self._about + _field(GRAPH, graph)

    def _all(self, wanted: int) -> list[memoryview]:
        return [one.value for one in self._graph if one.number == wanted]


class _Node:
    """One operation: what it takes and gives, and in which halves it is."""

    def __init__(self, content: memoryview) -> None:
        self.content = content
        self.is_early = self.is_late = True
        parts = list(fields(content))
        self.takes, self.gives = ([bytes(one.value).decode() for one in parts if one.number == wanted and one.value]
                                  for wanted in (TAKES, GIVES))
        if _text(content, OPERATOR).startswith(BY_CHANCE):
            raise UnknownForm("an operator that gives something else each time")
        attributes = [inner.number for one in parts if one.number == ATTRIBUTE for inner in fields(one.value)]
        if SUBGRAPH in attributes or SUBGRAPHS in attributes:
            raise UnknownForm("an operator with a graph of its own")


def fields(content: memoryview) -> Iterator[Field]:
    """Yield the fields of a message in order.

    Raises:
        UnknownForm: these bytes are no message.
    """
    place = 0
    while place < len(content):
        begin = place
        tag, place = _number(content, place)
        size = {1: 8, 5: 4}.get(tag & 7, 0)
        if tag & 7 == 2:
            size, place = _number(content, place)
        elif tag & 7 == 0:
            _, place = _number(content, place)
        elif not size:
            raise UnknownForm(f"a field of wire type {tag & 7}")
        if place + size > len(content):
            raise UnknownForm("a field that ends after its message")
        place += size
        yield Field(tag >> 3, content[place - size:place], content[begin:place])


def _number(content: memoryview, place: int) -> tuple[int, int]:
    value = 0
    for i in range(10):
        if place >= len(content):
            break
        byte = content[place]
        value, place = value | (byte & 127) << 7 * i, place + 1
        if byte < 128:
            return value, place
    raise UnknownForm("a number that does not end")


def _written(number: int) -> bytes:
    parts = []
    while number > 127:
        parts.append(number & 127 | 128)
        number >>= 7
    return bytes([*parts, number])


def _field(number: int, value: bytes | memoryview) -> bytes:
    return b"".join((_written(number << 3 | 2), _written(len(value)), value))


def _text(content: bytes | memoryview, wanted: int) -> str:
    return next((bytes(one.value).decode() for one in fields(memoryview(content)) if one.number == wanted), "")


def _declared(one: Between) -> bytes:
    """Return name, type and shape of an input as ONNX declares them."""
    if one.kind not in ELEMENTS:
        raise UnknownForm(f"a value of type {one.kind} between the halves")
    shape = b"".join(_field(1, _written(1 << 3) + _written(size)) for size in one.shape)
    kind = _field(1, _written(1 << 3) + _written(ELEMENTS[one.kind]) + _field(2, shape))
    return _field(VALUE_NAME, one.name.encode()) + _field(2, kind)
