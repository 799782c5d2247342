"""Bags by rosbags: what they hold, and new ones of every kind; what is published so that a recorder hears it."""

from __future__ import annotations

import pathlib

from cell_operator import Operator
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_JAZZY)
# Many messages in a short time: none may fall out of a reader's history.
DEEP = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.VOLATILE)

# The kinds of bag that rosbag2 writes.
KINDS = {
    "mcap": (StoragePlugin.MCAP, None),
    "mcap zstd": (StoragePlugin.MCAP, CompressionMode.STORAGE),
    "mcap file": (StoragePlugin.MCAP, CompressionMode.FILE),
    "mcap messages": (StoragePlugin.MCAP, CompressionMode.MESSAGE),
    "sqlite": (StoragePlugin.SQLITE3, None),
    "sqlite file": (StoragePlugin.SQLITE3, CompressionMode.FILE),
    "sqlite messages": (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
}


def writer_of(bag: pathlib.Path, kind: str) -> Writer:
    """What writes a new bag of a kind, by rosbags."""
    plugin, mode = KINDS[kind]
    writer = Writer(bag, version=9, storage_plugin=plugin)
    if mode:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    return writer


def contents(bag: pathlib.Path, *topics: str) -> list[tuple[str, object]]:
    """Topic and deserialised message, in the order of the bag, by rosbags."""
    with AnyReader([bag], default_typestore=STORE) as reader:
        chosen = [connection for connection in reader.connections if not topics or connection.topic in topics]
        return [(c.topic, reader.deserialize(raw, c.msgtype)) for c, _, raw in reader.messages(chosen)]


def wait_for_recorder(operator: Operator, *publishers) -> None:
    """Until each of them has a subscription beside the operator's own."""

    def own(publisher) -> int:
        subscriptions = operator.node.get_subscriptions_info_by_topic(publisher.topic_name)
        return sum(subscription.node_name == operator.node.get_name() for subscription in subscriptions)

    operator.until(lambda: all(p.get_subscription_count() > own(p) for p in publishers), "recorder that listens", 60.0)


def wait_until_heard(*publishers) -> None:
    """Until the recorder has everything: what it has when it ends is in the bag."""
    for publisher in publishers:
        assert publisher.wait_for_all_acked(Duration(seconds=60)), f"{publisher.topic_name} was not acknowledged"


def same(ours: object, theirs: object) -> bool:
    """Whether a message decoded by mcap-ros2-support says what the same message does by rosbags."""
    if (fields := getattr(ours, "__slots__", None)) is not None:
        return all(same(getattr(ours, name), getattr(theirs, name)) for name in fields if not name.startswith("_"))
    if isinstance(ours, (list, tuple)):
        return len(ours) == len(theirs) and all(map(same, ours, theirs))
    if isinstance(ours, (bytes, bytearray, memoryview)):
        return bytes(ours) == bytes(theirs)
    return ours == theirs
