"""Evaluation: a hand-made policy with sight, blinded; figures of made-up traces; sweeps; what the command leaves."""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import re

import jax
import jax.numpy as jnp
import marker_seeker
import numpy as np
import pytest

from whill_mjx.effects import EFFECTS
from whill_mjx.env import make_env, reset_state
from whill_mjx.evaluate import main
from whill_mjx.evaluation.conditions import nominal, seen_under
from whill_mjx.evaluation.drivers import Driver
from whill_mjx.evaluation.episodes import Course, Episodes, episode_figures, headline, summarise
from whill_mjx.evaluation.intervals import bootstrap_interval, wilson_interval
from whill_mjx.evaluation.options import EvaluateOptions
from whill_mjx.evaluation.output import pages
from whill_mjx.evaluation.output.output_files import write_pictures
from whill_mjx.evaluation.output.pages import episode_video
from whill_mjx.evaluation.policies.onnx_network import Network
from whill_mjx.evaluation.policies.policy_file import load_policy
from whill_mjx.evaluation.preparation import choose_task, make_plan
from whill_mjx.evaluation.rollouts import CHANNELS, View, rollout
from whill_mjx.evaluation.sweeps import Axis, Sweep, parse_sweep, with_parameter
from whill_mjx.io.html import STYLE
from whill_mjx.io.video import write_h264
from whill_mjx.tasks.tasks import make_task
from whill_mjx.vehicle.kinematics import camera_pose, rotation_from_quaternion
from whill_mjx.vehicle.presets import preset
from whill_mjx.world.maps.walls import map_walls
from whill_mjx.world.solids import Solids, post


@pytest.fixture(scope="module")
def seeker(tmp_path_factory):
    """A policy that drives towards the blue marker."""
    return marker_seeker.write(tmp_path_factory.mktemp("seeker") / "policy")


@pytest.fixture(scope="module")
def evaluated(seeker, tmp_path_factory):
    """One command with everything: the start is turned so far that only who sees the marker gets to it."""
    out = tmp_path_factory.mktemp("evaluation")
    options = EvaluateOptions(
        str(seeker), episodes=5, batch=4, out=out, set=("gates=0", "max_steps=110"), blind=("freeze", "replay"),
        sweep=("start_yaw_deg=-18,18 latency_s=0,0.2",), sweep_episodes=3, html=True,
    )  # fmt: skip
    return out, main(options)


def test_a_seeing_policy_arrives_and_its_figures_have_intervals(evaluated):
    out, result = evaluated
    policy = result["drivers"]["policy"]
    assert policy["success"] == 1.0 and policy["episodes"] == 5
    assert 4.2 < policy["path_length_m"] < 5.0 and 7.0 < policy["time_to_goal_s"] < 8.5
    for name in ("success", "return", "time_to_goal_s", "min_clearance_m"):
        low, high = policy[f"{name}_interval_95"]
        assert low <= policy[name] + 1e-9 and policy[name] - 1e-9 <= high
    assert json.loads((out / "evaluation.json").read_text())["drivers"]["policy"] == policy


def test_a_turned_start_is_corrected_by_who_sees(evaluated):
    sweep = evaluated[1]["sweeps"][0]
    assert [axis["name"] for axis in sweep["axes"]] == ["start_yaw_deg", "latency_s"]
    np.testing.assert_array_equal(np.array(sweep["success"]), 1.0)
    assert np.array(sweep["success_interval_95"]).shape == (2, 2, 2)


def test_blinded_episodes_are_reported_beside_the_sighted_ones(evaluated):
    drivers = evaluated[1]["drivers"]
    assert set(drivers) == {"policy", "policy freeze", "policy replay"}
    # A frozen first image keeps turning to one side; actions of another episode lead somewhere else.
    assert drivers["policy freeze"]["return"] < drivers["policy"]["return"] - 5
    assert drivers["policy replay"]["return"] < drivers["policy"]["return"]


def test_pictures_and_page_are_written_and_the_video_where_something_failed(evaluated):
    out, result = evaluated
    left = {path.name for path in out.iterdir()}
    assert left >= {"evaluation.json", "report.html", "paths.png", "paths_policy_freeze.png",
                    "sweep_start_yaw_deg_latency_s.png"}
    assert "failures.mp4" not in left  # the policy itself never failed
    assert (out / "report.html").read_text().count("<img") == len([name for name in left if name.endswith(".png")])


def test_the_compiled_network_acts_like_the_vehicles_runtime(seeker):
    compiled, on_host = load_policy(seeker), load_policy(seeker, "onnxruntime")
    images = np.random.default_rng(0).integers(0, 256, (3, 64, 64, 3), dtype=np.uint8)
    carry = jax.tree.map(lambda leaf: jnp.zeros((3, *leaf.shape)), compiled.start())
    for policy in (compiled, on_host):
        assert policy.action_repeat == 2 and policy.low == (0.0, -1.0)
    ours, theirs = (jax.jit(jax.vmap(policy.step))(carry, images) for policy in (compiled, on_host))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), ours, theirs)


@pytest.mark.quick
def test_network_operators_agree_with_onnxruntime_on_a_graph_of_many():
    """Convolution, padding, slicing, splitting, reductions, argmax and constant shapes in one graph."""
    import onnxruntime
    from onnx import TensorProto, helper, numpy_helper

    def constant(name, values, kind=np.int64):
        return numpy_helper.from_array(np.asarray(values, kind), name)

    rng, node = np.random.default_rng(0), helper.make_node
    nodes = [
        node("Transpose", ["x"], ["t"], perm=[2, 0, 1]), node("Unsqueeze", ["t", "zero"], ["u"]),
        node("Pad", ["u", "pads"], ["p"]), node("Conv", ["p", "kernel", "bias"], ["c"], strides=[2, 2], group=1),
        node("Slice", ["c", "starts", "ends", "axes", "steps"], ["s"]), node("Shape", ["s"], ["shape"]),
        node("Gather", ["shape", "zero"], ["first"]), node("Concat", ["first", "minus"], ["wanted"], axis=0),
        node("Reshape", ["s", "wanted"], ["r"]), node("Gemm", ["r", "w", "b"], ["g"], transB=1, alpha=0.5),
        node("Split", ["g", "sizes"], ["l", "m"], axis=1), node("Softmax", ["l"], ["soft"], axis=1),
        node("ArgMax", ["soft"], ["best"], axis=1, keepdims=1), node("Cast", ["best"], ["b32"], to=TensorProto.FLOAT),
        node("ReduceMax", ["m", "one"], ["top"], keepdims=1), node("Softplus", ["top"], ["plus"]),
        node("Max", ["plus", "b32"], ["larger"]), node("Greater", ["larger", "half"], ["flag"]),
        node("Where", ["flag", "larger", "half"], ["y"]),
    ]  # fmt: skip
    initializers = [
        constant("zero", [0]), constant("one", [1]), constant("minus", [-1]), constant("sizes", [3, 2]),
        constant("pads", [0, 0, 1, 1, 0, 0, 1, 1]), constant("starts", [-1, 0]), constant("ends", [-(2**31), 3]),
        constant("axes", [2, 3]), constant("steps", [-2, 1]), constant("half", [0.5], np.float32),
        constant("kernel", rng.normal(size=(4, 3, 3, 3)), np.float32), constant("bias", np.ones(4), np.float32),
        constant("w", rng.normal(size=(5, 24)), np.float32), constant("b", np.arange(5), np.float32),
    ]  # fmt: skip
    graph = helper.make_graph(
        nodes, "many", [helper.make_tensor_value_info("x", TensorProto.FLOAT, [8, 6, 3])],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in ("y", "g")], initializers,
    )  # fmt: skip
    data = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=8).SerializeToString()
    x = rng.normal(size=(8, 6, 3)).astype(np.float32)
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    for ours, theirs in zip(jax.jit(Network(data))(x), session.run(None, {"x": x}), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-5)


ONE_OPERATOR = (  # with its attributes, and the constants after the first input (3, 4)
    ("Atan", {}, ()), ("Ceil", {}, ()), ("Round", {}, ()), ("Tan", {}, ()), ("Erf", {}, ()), ("Dropout", {}, ()),
    ("Elu", {"alpha": 0.7}, ()), ("LeakyRelu", {"alpha": 0.2}, ()), ("LogSoftmax", {"axis": 0}, ()),
    ("Flatten", {"axis": 0}, ()),
    ("CastLike", {}, (np.zeros(1, np.float32),)), ("Tile", {}, (np.array([2, 1]),)),
    ("Mod", {"fmod": 1}, (np.array([0.7], np.float32),)), ("ReduceProd", {"keepdims": 0}, (np.array([1]),)),
    ("ReduceL1", {}, (np.array([1]),)), ("ReduceL2", {"keepdims": 0}, (np.array([0]),)),
    ("ReduceLogSumExp", {}, (np.array([0, 1]),)), ("ReduceSumSquare", {}, (np.array([1]),)),
    ("LayerNormalization", {"epsilon": 1e-3}, (np.arange(4, dtype=np.float32), np.ones(4, np.float32))),
    ("BatchNormalization", {}, tuple(np.arange(1, 5, dtype=np.float32) * k for k in (1, 2, 3, 4))),
)  # fmt: skip


@pytest.mark.quick
@pytest.mark.parametrize(("kind", "attributes", "constants"), ONE_OPERATOR, ids=[one[0] for one in ONE_OPERATOR])
def test_an_operator_of_other_libraries_agrees_with_onnxruntime(kind, attributes, constants):
    import onnxruntime
    from onnx import TensorProto, helper, numpy_helper

    named = [numpy_helper.from_array(value, f"c{k}") for k, value in enumerate(constants)]
    graph = helper.make_graph(
        [helper.make_node(kind, ["x", *(one.name for one in named)], ["y"], **attributes)], kind,
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, [3, 4])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, None)], named,
    )  # fmt: skip
    data = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=8).SerializeToString()
    x = np.random.default_rng(0).normal(size=(3, 4)).astype(np.float32)
    [theirs] = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"]).run(None, {"x": x})
    np.testing.assert_allclose(Network(data)(x)[0], theirs, atol=1e-5)
    np.testing.assert_allclose(jax.jit(Network(data))(x)[0], theirs, atol=1e-5)


@pytest.mark.quick
def test_largest_values_of_windows_agree_with_onnxruntime():
    import onnxruntime
    from onnx import TensorProto, helper

    pool = helper.make_node("MaxPool", ["x"], ["y"], kernel_shape=[2, 3], strides=[2, 1], pads=[0, 1, 1, 1])
    graph = helper.make_graph([pool], "pool", [helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 2, 5, 4])],
                              [helper.make_tensor_value_info("y", TensorProto.FLOAT, None)])  # fmt: skip
    data = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=8).SerializeToString()
    x = np.random.default_rng(0).normal(size=(1, 2, 5, 4)).astype(np.float32)
    [theirs] = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"]).run(None, {"x": x})
    np.testing.assert_array_equal(Network(data)(x)[0], theirs)


@pytest.mark.quick
def test_sums_of_large_exponentials_do_not_overflow():
    from onnx import TensorProto, helper

    graph = helper.make_graph([helper.make_node("ReduceLogSumExp", ["x"], ["y"], keepdims=0)], "large",
                              [helper.make_tensor_value_info("x", TensorProto.FLOAT, [2])],
                              [helper.make_tensor_value_info("y", TensorProto.FLOAT, None)])  # fmt: skip
    data = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=8).SerializeToString()
    assert Network(data)(np.array([100.0, 101.0], np.float32))[0] == pytest.approx(101.3133, abs=1e-3)


@pytest.mark.quick
def test_damaged_and_foreign_policy_files_are_refused(seeker, tmp_path):
    import shutil

    with pytest.raises(ValueError, match="does not exist"):
        load_policy(tmp_path / "nothing")
    broken = tmp_path / "broken"
    shutil.copytree(seeker, broken)
    (broken / "policy.onnx").write_bytes(b"x")
    with pytest.raises(ValueError, match="SHA-256"):
        load_policy(broken)


def made_up(clearances, ends, dt=0.1):
    """Episodes that drive along x at 1 m/s with these clearances."""
    count, rows = len(clearances), len(clearances[0])
    trace = np.zeros((count, rows, len(CHANNELS)), np.float32)
    trace[..., CHANNELS.index("x")] = np.arange(rows) * dt
    trace[..., CHANNELS.index("clearance")] = clearances
    trace[..., CHANNELS.index("omega_command")] = np.arange(rows) % 2
    names = ("success", "collision", "timeout", "diverged")
    table = {name: np.array([float(end == name) for end, _ in ends]) for name in names}
    table |= {"time_s": np.array([seconds for _, seconds in ends]), "episode_return": np.arange(count, dtype=float)}
    return Episodes(trace, table, None, jax.random.split(jax.random.key(0), count), dt)


@pytest.mark.quick
def test_figures_of_made_up_traces():
    """Two near misses; a collision, which is none; and what lies after the end does not count."""
    episodes = made_up(
        [[1, 0.05, 1, 0.05, 0.05, 1], [1, 1, 1, 0.05, 0.0, 0.0], [1, 1, 1, 0.05, 0.05, 0.0]],
        [("success", 0.5), ("collision", 0.4), ("timeout", 0.2)],
    )
    figures = episode_figures(episodes)
    np.testing.assert_array_equal(figures["near_misses"], [2, 0, 0])
    np.testing.assert_allclose(figures["near_s"], [0.3, 0.2, 0.0], atol=1e-6)
    np.testing.assert_allclose(figures["min_clearance_m"], [0.05, 0.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(figures["path_length_m"], [0.5, 0.4, 0.2], atol=1e-6)
    np.testing.assert_allclose(figures["command_change_rad_s2"], 10.0, rtol=1e-5)
    np.testing.assert_allclose(figures["acceleration_rms_m_s2"], 0.0)
    summary = summarise(episodes)
    assert summary["time_to_goal_s"] == 0.5 and summary["collision"] == pytest.approx(1 / 3)
    assert summary["episodes_with_near_miss"] == pytest.approx(1 / 3)


@pytest.mark.quick
def test_episodes_that_come_near_nothing_have_figures_that_json_can_hold():
    """Of a map only walls within reach count, so in a hall the clearance is infinite."""
    far = [np.inf] * 3
    for near, middle in ((1, 0.5), (2, None)):
        episodes = made_up([[0.5] * 3] * (3 - near) + [far] * near, [("timeout", 0.2)] * 3)
        summary = json.loads(json.dumps(summarise(episodes), allow_nan=False))
        assert summary["min_clearance_m"] == 0.5 and summary["min_clearance_m_quantiles"]["0.5"] == middle
    assert summarise(made_up([far], [("timeout", 0.2)]))["min_clearance_m"] is None


def walled(task, place):
    """Scene in a map with a post, and its goal at a place (2,)."""
    scene = task.sample_world(jax.random.key(0)).scene
    walls = map_walls(np.array([[[0.0, 0.0], [20.0, 0.0]], [[20.0, 0.0], [20.0, 9.0]]]), keep=1)
    marker = dataclasses.replace(scene.marker, position=jnp.array([*place, 1.0]))
    rounds = Solids(None, post(place[0] - 1.0, place[1], 1.0, 0.2, (0.5, 0.5, 0.5)))
    return dataclasses.replace(scene, marker=marker, walls=walls, solids=rounds)


@pytest.mark.quick
def test_a_picture_of_any_world_holds_path_goal_walls_and_posts():
    plt, task = pages.pyplot(), make_task("point_goal")
    for place, path in (((12.0, 5.0), [[18.0, 2.0], [12.5, 5.0]]), ((-3.0, -1.0), [[0.0, 0.0], [-2.8, -0.9]])):
        figure, axes = plt.subplots()
        pages.draw_scene(axes, walled(task, place), 0.5, np.array(path))
        (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
        for x, y in (*path, place):
            assert left + 1.0 < x < right - 1.0 and low + 1.0 < y < high - 1.0
        assert len(axes.collections[0].get_segments()) == 2
        circles = [one.center for one in axes.patches if hasattr(one, "center")]
        assert any(np.allclose(one, [place[0] - 1.0, place[1]]) for one in circles)
        plt.close(figure)
    figure, axes = plt.subplots()
    lane = make_task("obstacle_course").sample_world(jax.random.key(0)).scene
    pages.draw_scene(axes, lane, 1.0, np.array([[0.0, 0.0], [5.0, 0.5], [np.nan, np.inf]]))
    assert axes.get_xlim() == pytest.approx((-1.0, 5.3 + 1.6)) and axes.get_ylim() == (-2.2, 2.2)
    plt.close(figure)


@pytest.mark.quick
def test_an_ending_of_the_tasks_own_is_shown_by_its_name():
    episodes = made_up([[1.0] * 3] * 2, [("lost_sight", 0.2), ("success", 0.1)])
    episodes = dataclasses.replace(episodes, ends={**episodes.ends, "lost_sight": np.array([1.0, 0.0])})
    assert [pages.ending(episodes, index) for index in range(2)] == ["lost_sight", "success"]
    table = pages._figures({"policy": summarise(episodes)})
    assert re.search(r"lost sight.{0,40}50\W*%", table)
    assert "time-out  0.0%  lost_sight 50.0%  return" in headline("policy", summarise(episodes))
    broken = made_up([[1.0] * 3] * 2, [("diverged", 0.2), ("success", 0.1)])
    assert "time-out  0.0%  diverged 50.0%  return" in headline("policy", summarise(broken))


def test_an_evaluation_replaces_page_pictures_and_video_of_an_earlier_one(tmp_path):
    stale = ("report.html", "failures.mp4", "sweep_light.png", "paths_planner.png")
    options = EvaluateOptions("random", "point_goal", episodes=1, out=tmp_path / "out", set=("max_steps=2",), videos=0)
    main(options)
    for name in stale:
        (options.out / name).write_text("of an earlier evaluation")
    (options.out / "notes.txt").write_text("somebody's own")
    main(options)
    left = {path.name for path in options.out.iterdir()}
    assert not left & set(stale) and {"evaluation.json", "paths.png", "failures.png", "notes.txt"} <= left


@pytest.mark.quick
def test_two_grids_over_the_same_thing_have_a_picture_each(tmp_path, monkeypatch):
    monkeypatch.setattr(pages, "paths_from_above", lambda *_, **__: None)
    monkeypatch.setattr(pages, "sweep_picture", lambda sweep, path, name: path.write_text(str(sweep.axes[0].values)))
    sweeps = [Sweep((Axis("light", values),), 1, {}, {}, []) for values in ((0.5, 1.0), (1.0, 1.5), (1.5, 2.0))]
    options, driven = EvaluateOptions("planner", out=tmp_path), {"planner": made_up([[1.0] * 3], [("success", 0.1)])}
    pictures, _ = write_pictures(options, make_task("point_goal"), None, driven, "planner", sweeps)
    assert [path.read_text() for path in pictures[1:]] == [str(sweep.axes[0].values) for sweep in sweeps]


@pytest.mark.quick
def test_a_mean_of_one_value_has_no_interval():
    one, two = made_up([[1.0] * 3], [("success", 0.1)]), made_up([[1.0] * 3] * 2, [("success", 0.1), ("timeout", 0.2)])
    assert summarise(one)["return_interval_95"] is None and summarise(one)["success_interval_95"][0] < 0.5
    assert summarise(two)["return_interval_95"] and summarise(two)["time_to_goal_s_interval_95"] is None


@pytest.mark.quick
def test_bootstrap_interval_of_normal_numbers_is_that_of_the_t_distribution():
    values = np.random.default_rng(1).normal(3.0, 2.0, 400)
    half = 1.96 * values.std(ddof=1) / 20
    np.testing.assert_allclose(bootstrap_interval(values), (values.mean() - half, values.mean() + half), atol=0.03)
    assert wilson_interval(10, 10)[0] > 0.7
    with pytest.raises(ValueError, match="at least one"):
        bootstrap_interval(np.zeros(0))


@pytest.mark.quick
def test_the_video_shows_each_episode_until_its_end(tmp_path):
    import cv2

    episodes = made_up([[1.0] * 6] * 2, [("collision", 0.2), ("timeout", 0.5)])
    frames = np.zeros((2, 6, 16, 16, 3), np.uint8)
    frames[:] = (40 * np.arange(6))[None, :, None, None, None]
    above = np.zeros((2, 6, 32, 16, 3), np.uint8)
    path = episode_video(episodes, frames, above, tmp_path / "two.mp4", 10.0, scale=2)
    film = cv2.VideoCapture(str(path))
    shown = np.array([film.read()[1] for _ in range(15)], float)
    assert not film.read()[0]
    assert shown.shape == (15, 96, 64, 3)
    np.testing.assert_allclose(shown[[0, 2, 5, 14], 16, 16].mean(-1), [0, 80, 80, 80], atol=12)
    np.testing.assert_allclose(shown[[0, 2, 5, 14], 16, 48].mean(-1), [0, 80, 200, 200], atol=12)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.quick
def test_sweeps_are_read_and_bad_ones_refused():
    first, second = parse_sweep("obstacle_x=2,3 start_y=-0.5:0.5:3")
    assert first.values == (2.0, 3.0) and second.values == (-0.5, 0.0, 0.5)
    (mass,) = parse_sweep("body.mass=0.5x:1.5x:3")
    assert mass.relative and mass.values == (0.5, 1.0, 1.5) and mass.labels == ["0.5x", "1x", "1.5x"]
    assert parse_sweep("latency_s=0:0.3:4")[0].values == (0.0, 0.1, 0.2, 0.3)
    for text, message in (
        ("wind=1", "unknown axis"), ("wing.span=1", "no effect"), ("body.colour=1", "no parameter"),
        ("light=", "no axis"),
        ("light=-1", "light is -1.0; it must lie within 0 to 100"), ("light=0:1:1001", "more than 1000"),
        ("latency_s=99", "within 0 to 10"),
        ("latency_s=0,0.05,0.1", "whole control periods of 0.1 s"),
        ("latency_s=0:0.2:4", "Give multiples"), ("light=1x", "no factor"), ("body.mass=1x,2", "mixed"),
        ("light=a", "could not"),
        ("light=1 light=2", "twice"), ("light=1 start_y=1 start_x=1", "one or two"), ("", "0 axes"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            parse_sweep(text)


@pytest.mark.quick
def test_a_swept_parameter_changes_its_effect_or_adds_it():
    _, params = preset("whill_cr_ramp")
    heavier = with_parameter(params, "body.mass", jnp.asarray(2.0), relative=True)
    assert float(heavier.body.mass) == pytest.approx(2 * float(params.body.mass))
    late = with_parameter(params, "command_delay.delay", jnp.asarray(0.2), relative=False)
    assert len(late.effects) == len(params.effects) + 1
    assert isinstance(late.effects[-1], EFFECTS["command_delay"])
    assert float(late.effects[-1].delay) == pytest.approx(0.2)
    again = with_parameter(late, "command_delay.delay", jnp.asarray(0.1), relative=False)
    assert len(again.effects) == len(late.effects)


@pytest.mark.quick
def test_a_displaced_camera_is_where_the_condition_puts_it():
    env, params = make_env("corridor", layout="fixed", photometric=False, random_looks=False)
    state = reset_state(env, params, jax.random.key(0))
    change = dataclasses.replace(
        nominal(), camera_x=jnp.array(0.1), camera_y=jnp.array(0.2), camera_z=jnp.array(-0.05),
        camera_pitch_deg=jnp.array(10.0), camera_yaw_deg=jnp.array(90.0),
    )  # fmt: skip
    chassis = rotation_from_quaternion(state.vehicle.qpos[3:7])
    before, _ = camera_pose(env.model, state.vehicle.qpos)
    after, turned = camera_pose(env.model, seen_under(change, env, state).vehicle.qpos)
    np.testing.assert_allclose(chassis.T @ (after - before), [0.1, 0.2, -0.05], atol=1e-5)
    down = env.model.spec.camera.pitch + np.deg2rad(10.0)
    np.testing.assert_allclose(chassis.T @ turned[:, 2], [0.0, np.cos(down), -np.sin(down)], atol=1e-5)


@pytest.mark.quick
def test_task_fields_come_from_the_run_the_policy_and_the_command(seeker):
    run = seeker.parent / "run.json"
    run.write_text(json.dumps({"preset": {"task": {"gates": 1, "gate_x": [2.0, 3.5], "v_min": -1.0}}}))
    policy = load_policy(seeker)
    task = choose_task(EvaluateOptions(str(seeker), set=("goal_x=5.0",)), policy)
    assert (task.gates, task.gate_x, task.goal_x, task.v_min, task.action_repeat) == (1, (2.0, 3.5), 5.0, 0.0, 2)
    run.unlink()
    with pytest.raises(ValueError, match="no field 'gate'"):
        choose_task(EvaluateOptions(str(seeker), set=("gate=1",)), policy)
    with pytest.raises(ValueError, match="is no whole number"):
        choose_task(EvaluateOptions(str(seeker), set=("gates=two",)), policy)
    with pytest.raises(ValueError, match="action_repeat=3: .* holds each decision for 2 control periods"):
        choose_task(EvaluateOptions(str(seeker), set=("action_repeat=3",)), policy)
    assert choose_task(EvaluateOptions(str(seeker), set=("action_repeat=2",)), policy).action_repeat == 2


@pytest.mark.quick
def test_a_sweep_by_factors_of_what_the_vehicle_lacks_is_refused(tmp_path):
    options = EvaluateOptions("random", "point_goal", vehicle="whill_cr_physical", out=tmp_path / "out", videos=0,
                              sweep=("sensor_delay.delay=0.5x,2x",))
    with pytest.raises(ValueError, match="sweep sensor_delay.delay=0.5x,2x: the vehicle lacks sensor_delay"):
        make_plan(options)


@pytest.fixture(scope="module")
def swerving():
    """A corridor and eight drives of a driver that never drives alike twice; some end at a wall, some do not."""
    course = Course(*make_env(make_task("corridor", max_steps=60)))
    drives = itertools.count()

    def begin(state, key):
        shape = jax.ShapeDtypeStruct((), jnp.float32)
        moment = jax.pure_callback(lambda key: np.float32(next(drives)), shape, jax.random.key_data(key),
                                   vmap_method="sequential")  # fmt: skip
        return jax.random.uniform(jax.random.fold_in(key, moment.astype(int)), minval=-1.0) * (moment % 2)

    driver = Driver("swerving", begin, lambda turn, state, image, key: (turn, jnp.stack([1.0, turn])))
    keys = jax.random.split(jax.random.key(5), 8)
    view = View(frames=True)
    recorded = jax.jit(lambda params: rollout(course.env, params, keys, driver, view=view))(course.vehicles(keys))
    whole = jax.device_get(recorded)
    episodes = Episodes(whole.trace, whole.ends, whole.scene, keys, course.env.model.config.control_dt)
    return course, episodes, whole.frames


def test_a_film_shows_the_recorded_drives_though_their_driver_would_drive_otherwise_now(swerving):
    """Two of eight drives are filmed in a batch of two: pixel by pixel what the camera saw when they were recorded."""
    course, episodes, seen = swerving
    crashed = np.flatnonzero(episodes.ends["collision"] > 0.5)
    assert 0 < len(crashed) < 8
    chosen = np.array([crashed[0], np.flatnonzero(episodes.ends["collision"] < 0.5)[0]])
    frames, above = course.film(episodes.some(chosen))
    assert above.shape[:2] == frames.shape[:2] == (2, 61)
    for film, index in zip(frames, chosen, strict=True):
        last = episodes.length[index]
        np.testing.assert_array_less(np.abs(film[:last].astype(int) - seen[index][:last]).mean((1, 2, 3)), 1.0)
    end = above[0, episodes.length[crashed[0]]]
    assert np.any(above[0, 0] != end)


def test_a_video_is_written_without_a_fork_of_this_process(tmp_path, recwarn):
    """JAX warns of os.fork beside its threads; a hook counts forks, which a plain start of ffmpeg does not need."""
    forks = []
    os.register_at_fork(before=lambda: forks.append(1))
    jax.block_until_ready(jnp.ones(3) + 1)  # its threads run
    path = write_h264(tmp_path / "grey.mp4", [np.full((16, 16, 3), 40 * k, np.uint8) for k in range(4)], 10.0)
    assert path.stat().st_size > 500 and not forks
    assert not [one for one in recwarn if "fork" in str(one.message)]


def test_a_video_that_cannot_be_written_says_what_ffmpeg_said(tmp_path):
    with pytest.raises(OSError, match="ffmpeg ended with code"):
        write_h264(tmp_path / "nothing.unknown", [np.zeros((16, 16, 3), np.uint8)], 10.0)
    assert not list(tmp_path.iterdir())


def test_the_page_of_an_evaluation_has_words_and_the_style_of_all_reports(evaluated):
    out, _ = evaluated
    text = (out / "report.html").read_text()
    assert STYLE in text and re.search(r'class="lead">[^<]* succeeds in [^<]*%[^<]* Without sight it succeeds in', text)
    for words in ("smallest clearance [m]", "time to the goal [s]", "the policy with its first image alone"):
        assert words in text
    for key in ("min_clearance_m", "time_to_goal_s", "acceleration_rms_m_s2"):
        assert key not in text


@pytest.mark.parametrize("columns", [1, 2])
def test_the_legend_of_few_maps_is_not_wider_than_their_picture(columns):
    plt = pages.pyplot()
    figure, _ = plt.subplots(1, columns, figsize=(3.2 * columns, 2.2), layout="constrained")
    pages._legend(figure, set(pages.ENDINGS), columns)
    figure.canvas.draw()
    place = figure.legends[0].get_window_extent()
    plt.close(figure)
    assert 0 <= place.x0 and place.x1 <= figure.bbox.width
