"""Any bytes give commands, parameters, a message or an image, or the documented error, within bounds of cost."""

import contextlib
import csv
import json
import socket

import numpy as np
import pytest
from damage import Costs, few
from damaged_bytes import check, damaged
from hypothesis import given
from hypothesis import strategies as st

from bridge.driving.command_table import make_table, read_commands
from bridge.episodes import LENGTH, EpisodeServer, ProtocolError, encode, number, receive
from bridge.nodes.parameters import as_options
from bridge.recording.mcap_file import HEAD, MAGIC, _end, mend
from bridge.recording.recovery import recover
from bridge.safeguards.heartbeat import read_beat
from bridge.sensing.image import ImageError, compressed_to_rgb8
from bridge.sensing.view import read_calibration

pytestmark = pytest.mark.quick


def test_a_damaged_command_table_of_a_manoeuvre(tmp_path):
    path = tmp_path / "command.csv"

    def read():
        rows = read_commands(path)
        with path.open(newline="", encoding="utf-8-sig") as file:
            width = len(next(line for line in csv.reader(file) if line))
        assert width >= 3 and np.isfinite(rows).all() and (np.diff(rows[:, 0]) > 0).all()
        try:
            assert make_table(rows, (-1.0, -1.0), (1.0, 1.0), (0.5, 1.0), str(path)).seconds < 700
        except ValueError as error:
            assert "is not within" in str(error)

    check(path, b"t,v,omega\n0,0,0\n0.5,0.2,-0.1\n1,0.25,0\n", read, 100)


def test_a_row_that_is_longer_than_the_header_of_a_command_table_is_refused(tmp_path):
    path = tmp_path / "command.csv"
    path.write_text("t,v,omega\n0,0,0\n1,1,2,0\n")  # decimal commas
    with pytest.raises(ValueError, match="line 3: has 4 cells, the header 3"):
        read_commands(path)


def test_a_damaged_file_of_ros_parameters(tmp_path):
    path = tmp_path / "drive.yaml"

    def read():
        words = as_options(["--ros-args", "--params-file", str(path)], "bridge_drive", "policy")
        assert all(isinstance(word, str) and len(word) < 300_000 for word in words)

    check(path, b"/**:\n  ros__parameters:\n    policy: run/policy\n    v_max: 0.5\n    crop: [0, 0, 64, 64]\n"
          b"bridge_drive:\n  ros__parameters: {stale: 0.3, blind: stop, use_sim_time: true}\n", read, 100)


def test_a_damaged_calibration_of_a_camera(tmp_path):
    path = tmp_path / "camera.yaml"

    def read():
        lens = read_calibration(path)
        assert min(lens.width, lens.height, *lens.matrix[:2]) > 0 and np.isfinite(lens.coefficients).all()

    check(path, b"image_width: 640\nimage_height: 480\ncamera_matrix: {data: [400, 0, 321, 0, 410, 238, 0, 0, 1]}\n"
          b"distortion_model: plumb_bob\ndistortion_coefficients: {data: [-0.3, 0.1, 0.001, -0.002, 0.01]}\n",
          read, 50)


def test_parameters_that_name_each_other_a_billion_times_are_refused_before_they_are_written_out(tmp_path):
    path = tmp_path / "bomb.yaml"
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 10)]
    path.write_text("\n".join([*lines, "/**:", "  ros__parameters: {policy: *a9}", ""]))
    with Costs(), pytest.raises(ValueError, match="bomb.yaml"):
        as_options(["--ros-args", "--params-file", str(path)], "bridge_drive", "policy")


@few(200)
@given(data=damaged(json.dumps({"topic": "/cmd_vel", "type": "Twist", "ready": True, "zeros": 0, "hears": ["a"]}
                               ).encode()))  # fmt: skip
def test_a_damaged_heartbeat_is_none(data):
    beat = read_beat(data.decode("utf-8", errors="surrogateescape"), topic=str, zeros=int, hears=list)
    assert beat == {} or isinstance(beat["topic"], str)


CALL = encode({"id": 1, "call": "step", "v": 0.5, "omega": -0.25, "periods": 2})


@few(200)
@given(data=st.one_of(damaged(CALL), damaged(CALL[4:]).map(lambda text: LENGTH.pack(len(text)) + text)))
def test_a_damaged_message_of_episode_control_is_a_table_or_a_protocol_error(data):
    ours, theirs = socket.socketpair()
    with ours, theirs, Costs():
        ours.sendall(data[:200_000])
        ours.shutdown(socket.SHUT_WR)
        try:
            message = receive(theirs, 5.0)
        except ProtocolError:
            return
        assert message is None or isinstance(message, dict)


def test_a_server_outlives_damaged_messages_and_answers_the_next_client(capfd):
    server = EpisodeServer({"hello": lambda message: {"period": 0.1},
                            "step": lambda message: {"v": number(message, "v", -1.0, 1.0)}})
    try:
        @few(30)
        @given(data=damaged(encode({"id": 1, "call": "hello", "protocol": 1, "token": ""}) + CALL))
        def talk(data):
            with socket.create_connection(("127.0.0.1", server.port), timeout=10) as client:
                with contextlib.suppress(OSError):  # the server may part before it has read all
                    client.sendall(data[:200_000])
                    client.shutdown(socket.SHUT_WR)
                    while client.recv(65536):
                        pass

        talk()
        for changes in ({"token": "\ud800"}, {"id": True}, {"id": [1]}, {"call": ["hello"]}, {"protocol": 10**400}):
            with socket.create_connection(("127.0.0.1", server.port), timeout=10) as client:
                client.sendall(encode({"id": 1, "call": "hello", "protocol": 1, "token": "", **changes}))
                assert set(receive(client, 10.0)) & {"error", "result"}
        with socket.create_connection(("127.0.0.1", server.port), timeout=10) as client:
            client.sendall(encode({"id": 1, "call": "hello", "protocol": 1, "token": ""}) + CALL)
            client.sendall(encode({"id": 2, "call": "step", "v": 10**400}))
            assert [receive(client, 10.0)["result"] for _ in range(2)] == [{"period": 0.1}, {"v": 0.5}]
            assert "must be a number from -1 to 1" in receive(client, 10.0)["error"]
    finally:
        server.close()
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_a_damaged_compressed_image(suffix):
    import cv2

    picture = np.random.default_rng(0).integers(0, 255, (16, 24, 3), np.uint8)
    good = cv2.imencode(f".{suffix}", picture)[1].tobytes()
    assert compressed_to_rgb8(good, (8, 8)).shape == (8, 8, 3)

    @few(100)
    @given(data=damaged(good))
    def one(data):
        try:
            with Costs():
                assert compressed_to_rgb8(data, (8, 8)).shape == (8, 8, 3)
        except ImageError as error:
            assert len(str(error)) < 600

    one()


@few(60)
@given(data=damaged(MAGIC + HEAD.pack(1, 8) + bytes(8) + HEAD.pack(5, 40) + bytes(40) + _end()))
def test_a_damaged_mcap_file_is_made_whole_or_left_alone(data, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "one.mcap"
    path.write_bytes(data)
    with Costs():
        mend(path)
    mended = path.read_bytes()
    assert mended == data or (mended.startswith(MAGIC) and mended.endswith(_end()))
    mend(path)
    assert path.read_bytes() == mended


def test_recordings_of_killed_recorders_with_damaged_names_and_rows_are_recovered_or_left_alone(tmp_path):
    for process in ("99999999999999999999999", "4194304", "-1", "0x1"):
        folder = tmp_path / f".circle_{process[:3]}.partial-{process}"
        folder.mkdir()
        (folder / "command.csv").write_bytes(b"t,v,omega\n0,0,0\n1,\xff")
    found = recover(tmp_path)
    assert all((folder / "command.csv").read_bytes() == b"t,v,omega\n0,0,0\n" for folder in found)
    assert not (tmp_path / "trials" / "circle_999").exists()
