"""Episode control over TCP: reset with a seed, steps in lock-step, the state. Sensors stay on ROS topics.

A message is its length as four bytes, big end first, and a JSON object in UTF-8. The first one of a client is

    {"id": 1, "call": "hello", "protocol": 1, "token": "..."}

and each call gets one answer, {"id": 1, "result": {...}} or {"id": 1, "error": "..."}. After bytes that are no message
the server says so and closes. It listens on the loopback address unless another is given, which needs a token.

| call | arguments | result |
|---|---|---|
| hello | protocol, token | protocol, period [s] |
| mode | mode: "step" or "realtime" | mode |
| reset | seed | episode, stamp of its first image [s, ns] |
| step | v [m/s], omega [rad/s], periods | episode, stamp, reward, terminated, truncated, collided, reached_goal |
| state | | episode, mode, x, y, yaw, v, omega, done |
"""

import contextlib
import hmac
import json
import socket
import socketserver
import struct
import threading
import time
import traceback
from collections.abc import Callable
from typing import Any

from bridge.nodes.exits import OptionError

PROTOCOL = 1
LARGEST = 65536
"""Bytes of the longest message."""
PATIENCE = 5.0
"""Seconds in which a message that has begun must be whole, and in which a new client must say hello."""
FAREWELL = 0.5
"""Seconds of silence after which a refused client is left; one that goes on sending is left after PATIENCE."""
CLIENTS = 8
"""Clients at a time; further ones are refused."""
LENGTH = struct.Struct(">I")
LOOPBACK = ("127.0.0.1", "::1", "localhost")

Calls = dict[str, Callable[[dict[str, Any]], dict[str, Any]]]


class ProtocolError(ValueError):
    """Bytes that are no message, a call that is none, or an answer that says why a call failed."""


def encode(message: dict[str, Any]) -> bytes:
    """Return a message as bytes."""
    content = json.dumps(message).encode()
    if len(content) > LARGEST:
        raise ProtocolError(f"a message of {len(content)} bytes is longer than {LARGEST}")
    return LENGTH.pack(len(content)) + content


def receive(connection: socket.socket, wait: float | None) -> dict[str, Any] | None:
    """Return the next message, None where the other side has closed.

    Args:
        connection: where it comes from.
        wait: seconds until its first byte; None: without end. The rest must come within PATIENCE.

    Raises:
        ProtocolError: what came is no message.
        TimeoutError: nothing came, or not all of it.
    """
    connection.settimeout(wait)
    begun = connection.recv(LENGTH.size)
    if not begun:
        return None
    end = time.monotonic() + PATIENCE
    head = _read(connection, LENGTH.size, end, begun)
    if head is None:
        return None
    (length,) = LENGTH.unpack(head)
    if length > LARGEST:
        raise ProtocolError(f"a message of {length} bytes is longer than {LARGEST}")
    content = _read(connection, length, end)
    if content is None:
        return None
    try:
        message = json.loads(content.decode(), object_pairs_hook=_table)
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"no JSON: {error}") from error
    if not isinstance(message, dict):
        raise ProtocolError("a message is a JSON object")
    return message


def _table(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object, whose keys must differ."""
    table = dict(pairs)
    if len(table) < len(pairs):
        raise ValueError("a key is given twice")
    return table


def _read(connection: socket.socket, count: int, end: float, begun: bytes = b"") -> bytes | None:
    """Return this many bytes, of which some may be there, None where the connection ends before.

    Raises:
        TimeoutError: they have not come by the steady time `end` [s], however steadily they trickle.
    """
    parts = bytearray(begun)
    while len(parts) < count:
        left = end - time.monotonic()
        if left <= 0:
            raise TimeoutError(f"a message was not whole within {PATIENCE:g} s")
        connection.settimeout(left)
        part = connection.recv(count - len(parts))
        if not part:
            return None
        parts += part
    return bytes(parts)


def _part(connection: socket.socket, why: str) -> None:
    """Say why the connection ends, and read for a moment: closing over unread bytes would take the answer back."""
    with contextlib.suppress(OSError):  # the client may be gone
        connection.sendall(encode({"id": None, "error": why}))
        connection.shutdown(socket.SHUT_WR)
        connection.settimeout(FAREWELL)
        left, end = 16 * LARGEST, time.monotonic() + PATIENCE
        while left > 0 and time.monotonic() < end and (part := connection.recv(LARGEST)):
            left -= len(part)


class EpisodeServer:
    """Serves calls of clients, one at a time, from threads of its own."""

    def __init__(self, calls: Calls, address: str = "127.0.0.1", port: int = 0, token: str = "") -> None:
        """Listen.

        Args:
            calls: functions by name, which take the message and return the result; a ValueError becomes the error of
                the answer. They are never called at the same time.
            address: to listen on; another than the loopback needs a token.
            port: 0 takes a free one.
            token: what clients must know; empty: nothing.

        Raises:
            ValueError: an open address without a token.
            OSError: the address or port cannot be had.
        """
        if address not in LOOPBACK and not token:
            raise OptionError(f"episode control on {address}: others could drive the simulator. Give a token, or "
                              "listen on 127.0.0.1.")
        self._calls, self._token = calls, token
        self._one = threading.Lock()
        self._free = threading.Semaphore(CLIENTS)
        serve = self._serve

        class Handler(socketserver.BaseRequestHandler):
            def handle(self) -> None:
                serve(self.request)

        class Server(socketserver.ThreadingTCPServer):
            allow_reuse_address = True
            request_queue_size = 128  # more at once wait a second for their next try
            daemon_threads = True
            address_family = socket.AF_INET6 if ":" in address else socket.AF_INET

            def handle_error(self, request: Any, client_address: Any) -> None:
                """A connection that breaks ends its own thread only."""

        self._server = Server((address, port), Handler)
        self.port = int(self._server.server_address[1])
        """Where it listens."""
        threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True).start()

    def close(self) -> None:
        """Stop listening."""
        self._server.shutdown()
        self._server.server_close()

    def _serve(self, connection: socket.socket) -> None:
        """Answer one client until it closes or breaks the protocol."""
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if not self._free.acquire(blocking=False):
            _part(connection, f"{CLIENTS} clients are connected; no more are served")
            return
        greeted = False
        try:
            while (message := receive(connection, None if greeted else PATIENCE)) is not None:
                answer, greeted = self._answer(message, greeted)
                connection.settimeout(PATIENCE)
                connection.sendall(encode(answer))
                if not greeted:
                    connection.shutdown(socket.SHUT_WR)
                    return
        except ProtocolError as error:
            _part(connection, str(error))
        except (TimeoutError, OSError):
            pass  # a client that stalls or breaks off
        finally:
            self._free.release()

    def _answer(self, message: dict[str, Any], greeted: bool) -> tuple[dict[str, Any], bool]:
        """Return the answer to a message, and whether the client is known now."""
        number, name = message.get("id"), message.get("call")
        if not isinstance(number, int | None):
            return {"id": None, "error": "id must be a whole number"}, greeted
        if not greeted:
            why = self._refusal(message)
            if why:
                return {"id": number, "error": why}, False
        call = self._calls.get(name) if isinstance(name, str) else None
        if call is None:
            return {"id": number, "error": f"unknown call {name!r}; there are {', '.join(self._calls)}"}, greeted
        try:
            with self._one:
                return {"id": number, "result": call(message)}, True
        except ValueError as error:
            return {"id": number, "error": str(error)}, greeted
        except Exception as error:  # whatever a simulator raises is an answer too, and not a lost connection
            traceback.print_exc()
            return {"id": number, "error": f"{name} failed: {type(error).__name__}: {str(error)[:1000]}"}, greeted

    def _refusal(self, message: dict[str, Any]) -> str:
        """Return why a first message does not open the connection; empty where it does."""
        if message.get("call") != "hello":
            return "the first call must be hello"
        if message.get("protocol") != PROTOCOL:
            return f"protocol {message.get('protocol')!r} is not served; it is {PROTOCOL}"
        given, want = (one.encode(errors="surrogatepass") for one in (str(message.get("token", "")), self._token))
        if not hmac.compare_digest(given, want):
            return "the token is wrong"
        return ""


class EpisodeClient:
    """Calls the episode control of a simulator."""

    def __init__(self, port: int, address: str = "127.0.0.1", token: str = "", wait: float = 30.0) -> None:
        """Connect, and say hello.

        Raises:
            OSError: nobody listens there.
            ProtocolError: the server refuses us.
        """
        self._socket = socket.create_connection((address, port), timeout=wait)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._wait, self._number = wait, 0
        self.period = float(self.call("hello", protocol=PROTOCOL, token=token)["period"])
        """Control period of the simulator [s]."""

    def call(self, name: str, **arguments: Any) -> dict[str, Any]:
        """Call and return the result.

        Raises:
            ProtocolError: the call failed; the message says why.
            ConnectionError: the server has gone.
            TimeoutError: no answer came in time.
        """
        self._number += 1
        self._socket.sendall(encode({"id": self._number, "call": name, **arguments}))
        answer = receive(self._socket, self._wait)
        while answer is not None and isinstance(answer.get("id"), int) and answer["id"] < self._number:
            answer = receive(self._socket, self._wait)  # that was to a call whose time was over
        if answer is None:
            raise ConnectionError("the simulator closed the connection")
        if "error" in answer:
            raise ProtocolError(str(answer["error"]))
        if answer.get("id") != self._number:
            raise ProtocolError(f"the answer is to call {answer.get('id')!r}, not {self._number}")
        return dict(answer["result"])

    def close(self) -> None:
        """Hang up."""
        self._socket.close()


def number(message: dict[str, Any], name: str, low: float, high: float, default: float | None = None) -> float:
    """Return a finite number of a message.

    Raises:
        ValueError: it is missing, no number, or out of range.
    """
    value = message.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ValueError(f"{name} is {repr(value)[:60]}; it must be a number from {low:g} to {high:g}")
    return float(value)


def whole(message: dict[str, Any], name: str, low: int, high: int, default: int | None = None) -> int:
    """Return a whole number of a message; errors as of `number`."""
    if not isinstance(message.get(name, default), int):
        raise ValueError(f"{name} is {repr(message.get(name))[:60]}; it must be a whole number from {low} to {high}")
    return int(number(message, name, low, high, default))
