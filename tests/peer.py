"""An rclpy node that a test talks through, and random contents for any message."""

from __future__ import annotations

import importlib
import pathlib
import random
import re
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import numpy as np
import rclpy
from processes import REPOSITORY
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

RELIABLE = QoSProfile(depth=64, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.VOLATILE)
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
BEST_EFFORT = QoSProfile(depth=8, reliability=ReliabilityPolicy.BEST_EFFORT)

Found = TypeVar("Found")


class Peer:
    """A node that spins in a thread of its own; a context manager."""

    def __init__(self, domain: int, name: str = "peer", namespace: str = "") -> None:
        self._context = rclpy.Context()
        self._context.init(domain_id=domain)
        self.node = rclpy.create_node(name, context=self._context, namespace=namespace)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._ending = False
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        while not self._ending:
            try:
                self._executor.spin_once(timeout_sec=0.05)
            except (_rclpy.InvalidHandle, _rclpy.RCLError):
                # The other thread has just destroyed what was to be waited for; next time it is not.
                pass

    def __enter__(self) -> Peer:
        return self

    def __exit__(self, *_: object) -> None:
        self._ending = True
        self._thread.join()
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()

    def until(self, condition: Callable[[], Found], what: str, timeout_s: float = 60.0) -> Found:
        """Waits until `condition` returns something true, and returns that."""
        end = time.monotonic() + timeout_s
        while not (found := condition()):
            assert self._thread.is_alive(), "an exception has ended the thread that spins"
            if time.monotonic() > end:
                raise TimeoutError(f"no {what} within {timeout_s} s")
            time.sleep(0.02)
        return found

    def listen(self, kind: type, topic: str, qos: QoSProfile = RELIABLE) -> list[Any]:
        """What comes on a topic from now on."""
        received: list[Any] = []
        self.node.create_subscription(kind, topic, received.append, qos)
        return received

    def speak(self, kind: type, topic: str, qos: QoSProfile = RELIABLE) -> Any:
        """A publisher that somebody hears."""
        publisher = self.node.create_publisher(kind, topic, qos)
        self.until(publisher.get_subscription_count, f"subscription to {topic}")
        return publisher

    def client(self, kind: type, name: str) -> Any:
        """A service client whose server is there."""
        client = self.node.create_client(kind, name)
        assert client.wait_for_service(60.0), f"no service {name}"
        return client

    def wait(self, future: Any, what: str, timeout_s: float = 60.0) -> Any:
        """The result of a future."""
        self.until(future.done, what, timeout_s)
        return future.result()

    def call(self, kind: type, name: str, request: Any = None, timeout_s: float = 60.0) -> Any:
        """Calls a service once."""
        client = self.client(kind, name)
        try:
            return self.wait(client.call_async(request or kind.Request()), f"answer of {name}", timeout_s)
        finally:
            self.node.destroy_client(client)


def interfaces(kind: str) -> Iterator[tuple[str, str, type]]:
    """Package, name and rclpy's class of each interface of this repository that this environment has."""
    packages = {"sctn_msgs": REPOSITORY / "msgs"}
    packages |= {path.name: path for path in sorted((REPOSITORY / "msgs/vendor").iterdir()) if path.is_dir()}
    for package, folder in packages.items():
        try:
            module = importlib.import_module(f"{package}.{kind}")
        except ImportError:
            continue
        for path in sorted(pathlib.Path(folder, kind).glob(f"*.{kind}")):
            # A newer distribution may have dropped one.
            if hasattr(module, path.stem):
                yield package, path.stem, getattr(module, path.stem)


def filled(kind: type, chance: random.Random) -> Any:
    """A message with random contents."""
    message = kind()
    for field, type_name in kind.get_fields_and_field_types().items():
        setattr(message, field, _value(type_name, chance))
    return message


def _value(type_name: str, chance: random.Random) -> Any:
    if sequence := re.fullmatch(r"sequence<([^,]+)(?:, (\d+))?>", type_name):
        count = chance.randrange(int(sequence[2] or 4) + 1)
        return [_value(sequence[1], chance) for _ in range(count)]
    if array := re.fullmatch(r"(.+)\[(\d+)\]", type_name):
        return [_value(array[1], chance) for _ in range(int(array[2]))]
    if integer := re.fullmatch(r"(u?)int(\d+)", type_name):
        bits = int(integer[2])
        return chance.getrandbits(bits) - (0 if integer[1] else 1 << (bits - 1))
    if type_name.startswith("string"):
        return "".join(chance.choice("ab /~éü火") for _ in range(chance.randrange(8)))
    match type_name:
        case "boolean":
            return chance.random() < 0.5
        case "octet":
            return bytes([chance.randrange(256)])
        case "char":
            return chance.randrange(256)
        case "float":
            return float(np.float32(chance.gauss(0, 1e3)))
        case "double":
            return chance.gauss(0, 1e9)
    package, name = type_name.split("/")
    return filled(getattr(importlib.import_module(f"{package}.msg"), name), chance)
