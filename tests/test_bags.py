"""Other people's readers open our bags: mcap-ros2-support and rosbags."""

from __future__ import annotations

import pathlib

import numpy as np
import pytest
import yaml
from mcap_ros2.reader import read_ros2_messages
from rosbags.highlevel import AnyReader

STEPS = 9


@pytest.fixture(scope="module")
def bag(start_for_module, tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """The folder of one demonstration of placing."""
    out = tmp_path_factory.mktemp("demonstrations") / "placing"
    demos = start_for_module("sctn", "demos", "--problem", "placing", "--episodes", 1, "--seed", 0, "--out", out)
    assert demos.wait(120.0) == 0, demos.log()
    (metadata,) = out.rglob("metadata.yaml")
    return metadata.parent


def test_the_metadata_describes_the_file(bag: pathlib.Path) -> None:
    information = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert information["storage_identifier"] == "mcap"
    (name,) = information["relative_file_paths"]
    counts: dict[str, int] = {}
    for message in read_ros2_messages(bag / name):
        counts[message.channel.topic] = counts.get(message.channel.topic, 0) + 1
    assert information["message_count"] == sum(counts.values())
    listed = {entry["topic_metadata"]["name"]: entry["message_count"] for entry in information["topics_with_message_count"]}
    assert {topic: count for topic, count in listed.items() if count} == counts


def test_mcap_ros2_support_reads_heightmaps_and_actions(bag: pathlib.Path) -> None:
    (file,) = bag.glob("*.mcap")
    messages = {topic: [] for topic in ("heightmap", "pick_place")}
    for message in read_ros2_messages(file):
        messages.setdefault(message.channel.topic.strip("/"), []).append(message.ros_msg)
    assert len(messages["heightmap"]) == STEPS + 1
    assert len(messages["pick_place"]) == STEPS
    for heightmap in messages["heightmap"]:
        assert len(heightmap.height_m) == heightmap.rows * heightmap.cols
        assert len(heightmap.rgb) == 3 * heightmap.rows * heightmap.cols


def test_rosbags_reads_the_same_with_the_definitions_in_the_bag(bag: pathlib.Path) -> None:
    (file,) = bag.glob("*.mcap")
    expected = [message.ros_msg for message in read_ros2_messages(file) if message.channel.topic.strip("/") == "heightmap"]
    with AnyReader([bag]) as reader:
        connections = [connection for connection in reader.connections if connection.topic.strip("/") == "heightmap"]
        found = [reader.deserialize(raw, connection.msgtype) for connection, _, raw in reader.messages(connections)]
    assert len(found) == len(expected)
    for ours, theirs in zip(found, expected, strict=True):
        assert np.array_equal(ours.height_m, np.asarray(theirs.height_m, dtype=np.float32))
        assert bytes(ours.rgb) == bytes(theirs.rgb)
