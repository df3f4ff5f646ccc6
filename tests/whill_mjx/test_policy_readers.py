"""One reader of policy files for all: bridge, learner and evaluation refuse the same, with the same words."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import zipfile

import jax
import jax.numpy as jnp
import marker_seeker
import numpy as np
import pytest

import bridge.policy
import dreamer.policy
from bridge.policy import PolicyFileError
from whill_mjx.evaluation.policies.policy_file import camera_contract, load_policy
from whill_mjx.vehicle.dynamics import drive, place
from whill_mjx.vehicle.kinematics import camera_pose
from whill_mjx.vehicle.model import build_model
from whill_mjx.vehicle.presets import preset
from whill_mjx.world.render.camera import camera_rotation

READERS = (bridge.policy.Policy.load, dreamer.policy.Policy.load, load_policy)


@pytest.fixture
def folder(tmp_path):
    return marker_seeker.write(tmp_path / "seeker")


def edit(folder, change):
    table = json.loads((folder / "policy.json").read_text())
    change(table)
    (folder / "policy.json").write_text(json.dumps(table))


FAULTS = {
    "units": lambda table: table["action"].update(units=["km/h", "rad/s"]),
    "channel order": lambda table: table["image"].update(encoding="bgr8"),
    "low above high": lambda table: table["action"].update(low=[2.0, -1.0]),
    "NaN": lambda table: table["action"].update(high=[float("nan"), 1.0]),
    "infinite": lambda table: table["action"].update(high=[float("inf"), 1.0]),
    "hash": lambda table: table["files"].update({"policy.onnx": "0" * 64}),
    "missing": lambda table: table["files"].update({"notes.txt": "0" * 64}),
    "other tensors": lambda table: table["onnx"].update(inputs=["picture", "carry_count"]),
    "other state": lambda table: table["carry"][0].update(shape=[2]),
    "rate": lambda table: table.update(rate_hz=0),
    "version": lambda table: table.update(schema=2),
    "camera": lambda table: table.update(camera={"pitch": "down"}),
}


@pytest.mark.quick
@pytest.mark.parametrize("fault", FAULTS)
def test_every_reader_refuses_the_same_fault_and_names_file_and_remedy(folder, fault):
    edit(folder, FAULTS[fault])
    messages = []
    for load in READERS:
        with pytest.raises(PolicyFileError) as error:
            load(folder)
        messages.append(str(error.value))
    assert all(str(folder) in message and "again" in message for message in messages)
    if fault != "version":  # the learner knows one more kind
        assert len(set(messages)) == 1


@pytest.mark.quick
def test_every_reader_refuses_a_network_whose_state_is_not_finite(folder, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(marker_seeker.np, "linspace", lambda *_: np.full(64, np.nan))
        data = marker_seeker.build_onnx()
    (folder / "policy.onnx").write_bytes(data)
    edit(folder, lambda table: table["files"].update({"policy.onnx": hashlib.sha256(data).hexdigest()}))
    for load in READERS:
        with pytest.raises(PolicyFileError, match="policy.onnx: .* gives action that is not finite"):
            load(folder)


@pytest.mark.quick
def test_every_reader_takes_a_zip_and_the_evaluation_finds_the_vehicle_in_it(folder, tmp_path):
    vehicle = b"schema = 1\n"
    (folder / "vehicle.toml").write_bytes(vehicle)
    digest = hashlib.sha256(vehicle).hexdigest()
    edit(folder, lambda table: (table["files"].update({"vehicle.toml": digest}), table.update(vehicle_sha256=digest)))
    with zipfile.ZipFile(tmp_path / "seeker.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for item in folder.iterdir():
            archive.write(item, f"seeker/{item.name}")
    image = np.zeros((64, 64, 3), np.uint8)
    commands = [load(tmp_path / "seeker.zip").step(image) for load in READERS[:2]]
    np.testing.assert_array_equal(commands[0], commands[1][0])
    evaluated = load_policy(tmp_path / "seeker.zip")
    assert evaluated.vehicle.read_bytes() == vehicle and load_policy(folder).vehicle == folder / "vehicle.toml"


@pytest.mark.quick
def test_a_vehicle_file_that_is_not_listed_is_not_used(folder):
    (folder / "vehicle.toml").write_text("schema = 1\n")
    assert load_policy(folder).vehicle is None


@pytest.mark.quick
def test_an_operator_that_cannot_be_compiled_is_refused_with_the_other_runtime_as_the_remedy(folder, monkeypatch):
    monkeypatch.setattr("whill_mjx.evaluation.policies.onnx_network.OPERATORS", {})
    with pytest.raises(PolicyFileError, match="policy.onnx: operator .* is not known.*runtime 'onnxruntime'"):
        load_policy(folder)
    load_policy(folder, "onnxruntime")


@pytest.mark.parametrize("name", ["whill_cr_ramp", "whill_cr_physical", "husky"])
def test_the_camera_of_a_policy_file_is_that_of_the_vehicle_after_it_has_settled(name):
    spec, params = preset(name)
    model = build_model(spec)
    camera = camera_contract(model, params)
    state = place(model, params, 0.0, 0.0, 0.0)
    period = jax.jit(lambda state: drive(model, params, state, jnp.zeros(2)))
    for _ in range(20):
        state = period(state)
    position, rotation = camera_pose(model, state.qpos)
    np.testing.assert_allclose([camera[axis] for axis in "xyz"], position, atol=1e-3)
    stated = camera_rotation(*(jnp.asarray(camera[angle]) for angle in ("yaw", "pitch", "roll")))
    np.testing.assert_allclose(stated, rotation, atol=1e-3)
    assert camera["frame"] == "base_footprint" and camera["fov_y"] == spec.camera.fov_y


@pytest.mark.quick
@pytest.mark.parametrize("mount", [{"roll": 3.0}, {"roll": -2.0, "yaw": 0.4}, {"roll": 1.5707963, "pitch": 0.3},
                                   {"pitch": 1.6}, {"roll": 3.14159, "yaw": 3.0}])  # fmt: skip
def test_a_policy_file_states_how_a_camera_on_its_head_or_side_is_turned(mount):
    spec, params = preset("whill_cr_ramp")
    model = build_model(dataclasses.replace(spec, camera=dataclasses.replace(spec.camera, **mount)))
    stated = camera_contract(model, params)
    _, rotation = camera_pose(model, place(model, params, 0.0, 0.0, 0.0).qpos)
    turned = camera_rotation(*(jnp.asarray(stated[angle]) for angle in ("yaw", "pitch", "roll")))
    np.testing.assert_allclose(turned, rotation, atol=1e-3)


@pytest.mark.quick
def test_the_chair_with_its_suspension_looks_up_by_what_it_sinks():
    spec, params = preset("whill_cr_ramp")
    assert spec.camera.pitch == 0.15
    assert camera_contract(build_model(spec), params)["pitch"] == pytest.approx(0.1386, abs=1e-4)


@pytest.mark.quick
def test_a_ramp_in_the_room_does_not_change_the_camera_of_the_vehicle():
    from whill_mjx.effects.incline import Incline

    spec, params = preset("whill_cr_ramp")
    model = build_model(spec)
    steep = dataclasses.replace(params, effects=(*params.effects, Incline(*(jnp.array(0.1),) * len(
        dataclasses.fields(Incline)))))
    assert camera_contract(model, steep) == camera_contract(model, params)


def test_files_of_earlier_versions_are_read(folder):
    """Files that name no frame, hold the pose in the chassis frame and list the archive of the weights."""
    edit(folder, lambda table: table.update(camera={"x": 0.35, "z": 0.55, "pitch": 0.15, "fov_y": 1.2}))
    edit(folder, lambda table: table["files"].update({"weights.npz": "0" * 64}))
    for load in READERS:
        load(folder)
