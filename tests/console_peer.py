"""Hostile and slow peers of the operator's console: a WebSocket without a library, and random input."""

from __future__ import annotations

import base64
import http.client
import json
import os
import random
import socket
import string
import struct
import time
import urllib.parse
from typing import Any

# Every route that a program can post to, with what a right body has.
ROUTES = {
    "sessions": {"name": "Eve"},
    "presence": {},
    "operator": {"action": "take", "from": 12345},
    "decisions": {"proposal_id": "1", "decision": "approve"},
    "proposals": {"pick": {"x_m": 0.5, "y_m": 0.0, "yaw_rad": 0.0}, "place": {"x_m": 0.4, "y_m": 0.1, "yaw_rad": 0.0}},
    "home": {},
    "put_down": {},
    "step": {"step": 1},
    "lesson/begin": {},
    "lesson/show": {
        "pick": {"x_m": 0.5, "y_m": 0.0, "yaw_rad": 0.0},
        "place": {"x_m": 0.4, "y_m": 0.1, "yaw_rad": 0.0},
        "settings": {"clearance_m": 0.2, "lift_m": 0.1, "travel_m_s": 1, "carry_m_s": 0.5, "descend_m_s": 0.2, "acceleration_m_s2": 2},
    },
    "lesson/execute": {},
    "lesson/change": {},
    "lesson/judge": {"reached": True},
    "lesson/undo": {},
    "lesson/save": {"name": "fuzz"},
    "lesson/end": {},
    "checkpoints/use": {"name": "fuzz"},
    "checkpoints/back": {},
    "training/start": {"name": "fuzz", "learn": ["a"], "held_out": ["b"], "steps": 1},
    "training/cancel": {},
    "demonstrations/repeat": {"name": "fuzz"},
}


class WebSocket:
    """A client of /api/v1/live."""

    def __init__(self, address: str, session: str | None, receive_buffer: int | None = None) -> None:
        url = urllib.parse.urlsplit(address)
        token = urllib.parse.parse_qs(url.fragment)["token"][0]
        self.socket = socket.socket()
        if receive_buffer is not None:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        self.socket.settimeout(10.0)
        self.socket.connect((url.hostname, url.port))
        key = base64.b64encode(os.urandom(16)).decode()
        lines = ["GET /api/v1/live HTTP/1.1", f"Host: {url.netloc}", "Connection: Upgrade", "Upgrade: websocket"]
        lines += ["Sec-WebSocket-Version: 13", f"Sec-WebSocket-Key: {key}", "", ""]
        self.socket.sendall("\r\n".join(lines).encode())
        self._buffer = b""
        while b"\r\n\r\n" not in self._buffer:
            self._buffer += self._more()
        head, self._buffer = self._buffer.split(b"\r\n\r\n", 1)
        assert b" 101 " in head, head
        self.send(json.dumps({"type": "hello", "token": token, "session": session}).encode())

    def _more(self) -> bytes:
        data = self.socket.recv(65536)
        if not data:
            raise ConnectionError("the console has closed the connection")
        return data

    def _take(self, count: int) -> bytes:
        while len(self._buffer) < count:
            self._buffer += self._more()
        taken, self._buffer = self._buffer[:count], self._buffer[count:]
        return taken

    def send(self, data: bytes, opcode: int = 1) -> None:
        """One frame, masked as a client's have to be."""
        length = len(data)
        size = (
            bytes([0x80 | length])
            if length < 126
            else struct.pack("!BH", 0x80 | 126, length)
            if length < 65536
            else struct.pack("!BQ", 0x80 | 127, length)
        )
        mask = os.urandom(4)
        self.socket.sendall(bytes([0x80 | opcode]) + size + mask + bytes(byte ^ mask[index % 4] for index, byte in enumerate(data)))

    def receive(self) -> dict[str, Any]:
        """The next state."""
        while True:
            first, second = self._take(2)
            length = second & 0x7F
            if length == 126:
                (length,) = struct.unpack("!H", self._take(2))
            elif length == 127:
                (length,) = struct.unpack("!Q", self._take(8))
            data = self._take(length)
            if first & 0x0F == 1:
                return json.loads(data)
            if first & 0x0F == 8:
                raise ConnectionError(f"closed: {data[2:].decode(errors='replace')}")

    def receive_until(self, end: float) -> None:
        """Takes what comes until a time of the monotonic clock."""
        while (left := end - time.monotonic()) > 0:
            self.socket.settimeout(left)
            try:
                self._more()
            except TimeoutError:
                break
        self.socket.settimeout(10.0)

    def close(self) -> None:
        """Hangs up."""
        self.socket.close()


def random_value(generator: random.Random, depth: int = 0) -> Any:
    """Something that JSON can hold."""
    kind = generator.randrange(8 if depth < 3 else 6)
    if kind == 0:
        return None
    if kind == 1:
        return generator.choice([True, False])
    if kind == 2:
        return generator.choice([0, -1, 7, 2**31, 2**63, 2**64, -(2**63), 10**30])
    if kind == 3:
        return generator.choice([0.5, -0.0, 1e308, -1e308, 5e-324])
    if kind in (4, 5):
        return "".join(generator.choices(string.printable + "äß€😀\u0000\u202e", k=generator.choice([0, 1, 5, 40, 300])))
    if kind == 6:
        return [random_value(generator, depth + 1) for _ in range(generator.randrange(4))]
    return {
        generator.choice(["name", "x_m", "to", "decision", ""]): random_value(generator, depth + 1) for _ in range(generator.randrange(4))
    }


def spoiled(generator: random.Random, body: dict[str, Any]) -> bytes:
    """A right body with something wrong in it, or bytes that are no JSON. Never a stop, which everybody may send."""
    kind = generator.randrange(5)
    if kind == 0:
        return generator.randbytes(generator.randrange(200))
    text = json.dumps(body).encode()
    if kind == 1:
        cut = generator.randrange(len(text) + 1)
        return text[:cut] + generator.randbytes(generator.randrange(8)) + text[cut:]
    changed = dict(body)
    if kind == 2 and changed:
        changed[generator.choice(list(changed))] = random_value(generator)
    elif kind == 3:
        changed[generator.choice(["more", "name", "\u0000"])] = random_value(generator)
    elif kind == 4 and changed:
        del changed[generator.choice(list(changed))]
    return json.dumps(changed).encode()


def post(connection: http.client.HTTPConnection, headers: dict[str, str], path: str, body: bytes) -> int:
    """The status of the answer; 0 where the connection was cut."""
    try:
        connection.request("POST", f"/api/v1/{path}", body, headers)
        answer = connection.getresponse()
        answer.read()
        return answer.status
    except (http.client.HTTPException, OSError):
        connection.close()
        return 0
