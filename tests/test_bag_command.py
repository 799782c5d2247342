"""`sctn bag` on bags of ours and of others: what it prints, and its exit codes."""

from __future__ import annotations

import json
import pathlib

import numpy as np
import pytest
from bag_contents import KINDS, STORE, writer_of
from rosbags.highlevel import AnyReader

WHOLE, FAILED, USAGE, DAMAGED = 0, 1, 2, 3
SCAN = "sensor_msgs/msg/LaserScan"


def write_scans(bag: pathlib.Path, kind: str, count: int = 50) -> None:
    """A bag of a type that is none of ours, by rosbags."""
    Scan, Header, Time = (STORE.types[name] for name in (SCAN, "std_msgs/msg/Header", "builtin_interfaces/msg/Time"))
    with writer_of(bag, kind) as writer:
        connection = writer.add_connection("/scan", SCAN, typestore=STORE)
        for index in range(count):
            ranges = np.arange(index, index + 100, dtype=np.float32)
            scan = Scan(Header(Time(index, 0), "lidar"), 0.0, 1.0, 0.1, 0.0, 0.1, 0.0, 9.0, ranges, ranges)
            writer.write(connection, 10**9 * index, STORE.serialize_cdr(scan, SCAN))


def scans(bag: pathlib.Path) -> list[tuple[int, bytes]]:
    """The messages of a bag by rosbags."""
    with AnyReader([bag], default_typestore=STORE) as reader:
        return [(time, bytes(raw)) for _, time, raw in reader.messages()]


def bag_command(start, *arguments: object) -> tuple[int, dict]:
    """Exit code and JSON of `sctn bag`."""
    process = start("sctn", "bag", *arguments, "--json")
    code = process.wait(60.0)
    return code, json.loads(process.output().splitlines()[-1]) if code in (WHOLE, DAMAGED) else {}


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_of_rosbags_is_listed(start, tmp_path: pathlib.Path, kind: str) -> None:
    write_scans(tmp_path / "bag", kind)
    code, info = bag_command(start, "info", tmp_path / "bag")
    assert code == WHOLE
    assert (info["messages"], info["start_s"], info["duration_s"]) == (50, 0.0, 49.0)
    (topic,) = info["topics"]
    assert (topic["name"], topic["type"], topic["messages"], topic["has_definition"]) == ("/scan", SCAN, 50, True)


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_of_rosbags_is_copied_message_by_message(start, tmp_path: pathlib.Path, kind: str) -> None:
    write_scans(tmp_path / "bag", kind)
    assert bag_command(start, "verify", tmp_path / "bag")[0] == WHOLE
    code, recovery = bag_command(start, "recover", tmp_path / "bag", "--out", tmp_path / "copy")
    assert (code, recovery["messages"], recovery["complete"]) == (WHOLE, 50, True)
    # And rosbags reads what we have written of a type that we do not know.
    assert scans(tmp_path / "copy") == scans(tmp_path / "bag")
    assert bag_command(start, "verify", tmp_path / "copy")[0] == WHOLE


def test_a_cut_bag_is_told_and_repaired(start, tmp_path: pathlib.Path) -> None:
    write_scans(tmp_path / "bag", "mcap zstd", count=20_000)
    (file,) = (tmp_path / "bag").glob("*.mcap")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    code, verification = bag_command(start, "verify", tmp_path / "bag")
    assert (code, verification["whole"]) == (DAMAGED, False)
    code, recovery = bag_command(start, "recover", tmp_path / "bag", "--out", tmp_path / "copy")
    assert (code, recovery["complete"]) == (DAMAGED, False)
    assert 1000 < recovery["messages"] < 20_000
    copied = scans(tmp_path / "copy")
    assert [time for time, _ in copied] == [10**9 * index for index in range(recovery["messages"])]


def test_what_cannot_be_done_has_its_exit_code_and_reason(start, tmp_path: pathlib.Path) -> None:
    missing = start("sctn", "bag", "info", tmp_path / "missing")
    assert missing.wait(60.0) == FAILED
    assert "missing" in missing.errors()
    write_scans(tmp_path / "bag", "mcap")
    late = start("sctn", "bag", "play", tmp_path / "bag", "--start", 1000)
    assert late.wait(60.0) == FAILED
    assert "--start is 1000 s, expected at most the 49.000 s" in late.errors()
    occupied = start("sctn", "bag", "recover", tmp_path / "bag", "--out", tmp_path / "bag")
    assert occupied.wait(60.0) == FAILED
    assert "exists already" in occupied.errors()
    assert start("sctn", "bag", "recover", tmp_path / "bag").wait(60.0) == USAGE
