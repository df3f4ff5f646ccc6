"""What of a policy step needs no frame is computed before the frame comes, and nothing else changes."""

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from bridge.policy.halves import Cut
from bridge.policy.network import Network

pytestmark = pytest.mark.quick
node = helper.make_node
SEEN = "image"


def constant(name, values, kind=np.float32):
    return numpy_helper.from_array(np.asarray(values, kind), name)


def value(name, shape, kind=TensorProto.FLOAT):
    return helper.make_tensor_value_info(name, kind, shape)


def recurrent(*, more=(), weights=()):
    """A state of eight numbers that a large product advances and a small one corrects by what is seen."""
    rng = np.random.default_rng(0)
    nodes = [
        node("Concat", ["one", "eight"], ["row"], axis=0),  # depends on no input; both halves need it
        node("Reshape", ["carry_h", "row"], ["h"]),
        node("MatMul", ["h", "advance"], ["wide"]), node("MatMul", ["wide", "back"], ["ahead"]),
        node("Tanh", ["ahead"], ["prior"]),
        node("Cast", ["image"], ["x"], to=TensorProto.FLOAT),
        node("Reshape", ["x", "row"], ["seen"]), node("MatMul", ["seen", "see"], ["felt"]), *more,
        node("Add", ["prior", "felt"], ["after"]), node("Tanh", ["after"], ["next"]),
        node("Reshape", ["next", "eight"], ["next_h"]), node("Slice", ["next_h", "zero", "two"], ["action"]),
        node("Reshape", ["prior", "eight"], ["next_prior"]),
    ]
    initializers = [
        constant("one", [1], np.int64), constant("eight", [8], np.int64), constant("zero", [0], np.int64),
        constant("two", [2], np.int64), constant("advance", rng.normal(size=(8, 512))),
        constant("back", rng.normal(size=(512, 8)) / 50), constant("see", rng.normal(size=(8, 8)) / 500), *weights,
    ]
    graph = helper.make_graph(
        nodes, "recurrent", [value(SEEN, [8], TensorProto.UINT8), value("carry_h", [8]), value("carry_prior", [8])],
        [value("action", [2]), value("next_h", [8]), value("next_prior", [8])], initializers)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=8).SerializeToString()


def drive(model, steps=50):
    """Return the outputs of the whole network and of its halves over many steps, each from its own state."""
    session, network = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"]), Network(model, [SEEN])
    rng, results = np.random.default_rng(1), []
    state = own = {"carry_h": np.zeros(8, np.float32), "carry_prior": np.zeros(8, np.float32)}
    for _ in range(steps):
        seen = {SEEN: rng.integers(0, 256, 8, np.uint8)}
        whole = dict(zip(("action", "next_h", "next_prior"), session.run(None, {**seen, **state}), strict=True))
        halves = network.late(seen, own, network.early(own))
        state, own = ({"carry_h": one["next_h"], "carry_prior": one["next_prior"]} for one in (whole, halves))
        results.append((whole, halves))
    return network, results


def test_halves_of_a_network_give_what_the_whole_gives_over_many_steps():
    network, results = drive(recurrent())
    assert network.in_halves
    for whole, halves in results:
        for name, wanted in whole.items():
            np.testing.assert_allclose(halves[name], wanted, atol=1e-6)
    assert np.ptp([halves["action"] for _, halves in results], axis=0).min() > 0.01


def test_weights_that_no_observation_meets_are_read_before_it_comes():
    cut = Cut(recurrent(), frozenset([SEEN]))
    first, second = cut.first(), cut.second([])
    assert len(first) > 2 * 4 * 8 * 512 > 10 * len(second)
    graphs = [onnx.load_model_from_string(model).graph for model in (first, second)]
    assert SEEN not in [one.name for one in graphs[0].input]
    assert ["next_prior" in [one.name for one in graph.output] for graph in graphs] == [True, False]


BRANCH = helper.make_graph([node("Identity", ["seen"], ["branched"])], "branch", [], [value("branched", [1, 8])])
WHOLE = {
    "a branch": ([node("If", ["yes"], ["chosen"], then_branch=BRANCH, else_branch=BRANCH)],
                 [constant("yes", True, np.bool_)]),
    "chance": ([node("RandomNormal", [], ["noise"], shape=[8])], []),
}


@pytest.mark.parametrize("name", WHOLE)
def test_network_that_cannot_be_cut_safely_runs_whole(name):
    more, weights = WHOLE[name]
    network, results = drive(recurrent(more=more, weights=weights), steps=5)
    assert not network.in_halves
    for whole, halves in results:
        np.testing.assert_allclose(halves["action"], whole["action"], atol=1e-6)


def test_network_without_memory_runs_whole():
    graph = helper.make_graph([node("Cast", [SEEN], ["action"], to=TensorProto.FLOAT)], "plain",
                              [value(SEEN, [2], TensorProto.UINT8)], [value("action", [2])])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=8).SerializeToString()
    network = Network(model, [SEEN])
    seen = np.array([3, 4], np.uint8)
    assert not network.in_halves and network.early({}) == {}
    np.testing.assert_array_equal(network.late({SEEN: seen}, {}, {})["action"], [3, 4])


def test_bytes_that_are_no_network_are_refused_as_such():
    model, rng = bytearray(recurrent()), np.random.default_rng(2)
    refused = 0
    for _ in range(300):
        damaged = bytearray(model)
        for place in rng.integers(0, 600, 3):  # names and operations; most of the rest are weights
            damaged[place] = rng.integers(256)
        try:
            cut = Cut(bytes(damaged[:rng.integers(1, len(model))]), frozenset([SEEN]))
            cut.first(), cut.second([])
        except ValueError:
            refused += 1
    assert refused > 100
