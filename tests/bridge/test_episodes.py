"""Episode control over TCP: answers, refusals, and bytes that are no message."""

import json
import socket
import struct
import threading

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge import episodes
from bridge.episodes import (
    CLIENTS,
    LARGEST,
    EpisodeClient,
    EpisodeServer,
    ProtocolError,
    encode,
    number,
    receive,
    whole,
)

pytestmark = pytest.mark.quick


def double(message):
    return {"twice": 2 * number(message, "value", 0, 10)}


CALLS = {"hello": lambda _: {"protocol": 1, "period": 0.1}, "double": double}


@pytest.fixture(scope="module")
def server():
    server = EpisodeServer(CALLS)
    yield server
    server.close()


def raw(server, content):
    """Send bytes and return what the server answers before it closes."""
    with socket.create_connection(("127.0.0.1", server.port), timeout=10) as connection:
        connection.sendall(content)
        connection.shutdown(socket.SHUT_WR)
        return receive(connection, 10)


def test_a_client_calls_and_gets_its_results(server):
    client = EpisodeClient(server.port)
    assert client.period == 0.1 and client.call("double", value=4) == {"twice": 8}
    client.close()


@pytest.mark.parametrize(("call", "arguments", "words"), [
    ("nothing", {}, "unknown call 'nothing'; there are hello, double"),
    ("double", {"value": 11}, "value is 11; it must be a number from 0 to 10"),
    ("double", {"value": "4"}, "it must be a number"),
    ("double", {"value": True}, "it must be a number"),
    ("double", {}, "value is None"),
])
def test_a_call_that_fails_says_why_and_the_next_one_works(server, call, arguments, words):
    client = EpisodeClient(server.port)
    with pytest.raises(ProtocolError, match=words):
        client.call(call, **arguments)
    assert client.call("double", value=1) == {"twice": 2}
    client.close()


@pytest.mark.parametrize(("message", "words"), [
    ({"id": 1, "call": "double", "value": 1}, "first call must be hello"),
    ({"id": 1, "call": "hello", "protocol": 2}, "protocol 2 is not served"),
    ({"id": 1, "call": "hello"}, "protocol None"),
    ({"id": "a", "call": "hello", "protocol": 1}, "id must be a whole number"),
])
def test_a_first_message_that_is_no_greeting_is_refused(server, message, words):
    answer = raw(server, encode(message))
    assert words in answer["error"]


@pytest.mark.parametrize(("content", "words"), [
    (struct.pack(">I", LARGEST + 1), "longer than"),
    (struct.pack(">I", 0xFFFFFFFF) + b"x" * 100, "longer than"),
    (struct.pack(">I", 3) + b"abc", "no JSON"),
    (struct.pack(">I", 2) + b"[]", "JSON object"),
    (struct.pack(">I", 4) + b"\xff\xfe\x00\x01", "no JSON"),
    (struct.pack(">I", 60000) + b"[" * 60000, "no JSON"),
    (struct.pack(">I", 16) + b'{"id":1,"id": 2}', "no JSON: a key is given twice"),
    (struct.pack(">I", 36) + '{"call": "hello"}'.encode("utf-16"), "no JSON"),
])
def test_bytes_that_are_no_message_are_named(server, content, words):
    assert words in raw(server, content)["error"]


@settings(max_examples=200, deadline=None)
@given(content=st.one_of(st.binary(max_size=300),
                         st.binary(max_size=300).map(lambda one: struct.pack(">I", len(one)) + one),
                         st.recursive(st.none() | st.booleans() | st.floats() | st.text(max_size=9),
                                      lambda inner: st.lists(inner, max_size=3) | st.dictionaries(
                                          st.sampled_from(["id", "call", "protocol", "token", "x"]), inner, max_size=4),
                                      max_leaves=9)
                         .map(lambda one: json.dumps(one).encode())
                         .map(lambda one: struct.pack(">I", len(one)) + one)))
def test_any_bytes_get_an_error_or_nothing_and_the_server_lives_on(server, content):
    answer = raw(server, content)
    assert answer is None or "error" in answer or answer["result"]["protocol"] == 1


def test_server_still_serves_after_all_that(server):
    client = EpisodeClient(server.port)
    assert client.call("double", value=2) == {"twice": 4}
    client.close()


def test_a_client_that_trickles_a_message_is_left(monkeypatch):
    monkeypatch.setattr(episodes, "PATIENCE", 0.5)
    server = EpisodeServer(CALLS)
    with socket.create_connection(("127.0.0.1", server.port), timeout=0.1) as connection:
        connection.sendall(struct.pack(">I", 1000))
        for _ in range(600):
            try:
                connection.sendall(b" ")
                if connection.recv(1) == b"":
                    break
            except TimeoutError:
                continue  # it still waits
            except OSError:
                break
        else:
            pytest.fail("the server waits for a message that never becomes whole")
    server.close()


def test_an_answer_that_comes_too_late_is_not_taken_for_that_of_the_next_call():
    free = threading.Event()
    server = EpisodeServer({**CALLS, "slow": lambda _: {"waited": free.wait(60)}})
    client = EpisodeClient(server.port)
    client._wait = 0.1
    with pytest.raises(TimeoutError):
        client.call("slow")
    client._wait = 60
    free.set()
    assert client.call("double", value=3) == {"twice": 6}
    client.close()
    server.close()


def test_a_simulator_that_raises_gives_its_error_as_the_answer(capsys):
    server = EpisodeServer({**CALLS, "break": lambda _: {}["x"]})
    client = EpisodeClient(server.port)
    with pytest.raises(ProtocolError, match="break failed: KeyError: 'x'"):
        client.call("break")
    assert client.call("double", value=3) == {"twice": 6} and "KeyError" in capsys.readouterr().err
    client.close()
    server.close()


@pytest.mark.parametrize("value", [1.5, 1.0, True, "1", None, -1, 11])
def test_a_whole_number_of_a_message_is_whole_and_in_its_range(value):
    with pytest.raises(ValueError, match="seed is .*; it must be a"):
        whole({"seed": value}, "seed", 0, 10)
    assert whole({"seed": 4}, "seed", 0, 10) == 4 and whole({}, "seed", 0, 10, 2) == 2


def test_more_clients_than_there_are_places_are_told_so():
    server = EpisodeServer(CALLS)
    clients = [EpisodeClient(server.port) for _ in range(CLIENTS)]
    with pytest.raises(ProtocolError, match="clients are connected"):
        EpisodeClient(server.port)
    for client in clients:
        client.close()
    server.close()


def test_a_wrong_token_is_refused_and_an_open_address_needs_one():
    server = EpisodeServer(CALLS, token="secret")
    with pytest.raises(ProtocolError, match="token is wrong"):
        EpisodeClient(server.port, token="guess")
    EpisodeClient(server.port, token="secret").close()
    server.close()
    with pytest.raises(ValueError, match=r"episode control on 0.0.0.0.*Give a token"):
        EpisodeServer(CALLS, "0.0.0.0")


def test_calls_of_two_clients_never_run_at_the_same_time():
    inside, most = [], []

    def slow(_):
        inside.append(1)
        most.append(len(inside))
        threading.Event().wait(0.01)
        inside.pop()
        return {}

    server = EpisodeServer({**CALLS, "slow": slow})
    threads = [threading.Thread(target=lambda: [EpisodeClient(server.port).call("slow") for _ in range(2)])
               for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    server.close()
    assert len(most) == 8 and max(most) == 1
