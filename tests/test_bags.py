"""Other people's readers open our bags: mcap-ros2-support and rosbags."""

from __future__ import annotations

import pathlib

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
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


def messages(file: pathlib.Path) -> dict[str, list]:
    """The decoded messages of each topic, in order, by mcap-ros2-support."""
    found: dict[str, list] = {}
    with file.open("rb") as stream:
        for _, channel, _, message in make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            found.setdefault(channel.topic, []).append(message)
    return found


def test_the_metadata_describes_the_file(bag: pathlib.Path) -> None:
    information = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert information["storage_identifier"] == "mcap"
    (name,) = information["relative_file_paths"]
    counts = {topic: len(found) for topic, found in messages(bag / name).items()}
    assert information["message_count"] == sum(counts.values())
    listed = {entry["topic_metadata"]["name"]: entry["message_count"] for entry in information["topics_with_message_count"]}
    assert {topic: count for topic, count in listed.items() if count} == counts


def test_mcap_ros2_support_reads_heightmaps_and_actions(bag: pathlib.Path) -> None:
    (file,) = bag.glob("*.mcap")
    found = messages(file)
    assert len(found["/heightmap"]) == STEPS + 1
    assert len(found["/pick_place"]) == STEPS
    for heightmap in found["/heightmap"]:
        assert len(heightmap.height_m) == heightmap.rows * heightmap.cols
        assert len(heightmap.rgb) == 3 * heightmap.rows * heightmap.cols


def test_rosbags_reads_the_same_with_the_definitions_in_the_bag(bag: pathlib.Path) -> None:
    (file,) = bag.glob("*.mcap")
    expected = messages(file)["/heightmap"]
    with AnyReader([bag]) as reader:
        connections = [connection for connection in reader.connections if connection.topic == "/heightmap"]
        found = [reader.deserialize(raw, connection.msgtype) for connection, _, raw in reader.messages(connections)]
    assert len(found) == len(expected)
    for ours, theirs in zip(found, expected, strict=True):
        assert np.array_equal(ours.height_m, np.asarray(theirs.height_m, dtype=np.float32))
        assert bytes(ours.rgb) == bytes(theirs.rgb)
