"""Bad input gives a clear error: at the start the node refuses, while it runs it says so and lives on."""

from __future__ import annotations

import pathlib

import pytest

NODES = ["camera_fusion", "goal_oracle", "gctn_policy", "suction_executor", "sim_workcell"]


@pytest.mark.parametrize("node", NODES)
def test_an_unknown_parameter_is_refused_by_name(start, node: str) -> None:
    process = start(node, "--ros-args", "-p", "no_such_parameter:=1")
    assert process.wait(60.0) != 0
    assert "no_such_parameter" in process.errors()


@pytest.mark.parametrize("node", NODES)
def test_a_parameter_file_that_is_not_yaml_is_refused_by_name(start, node: str, tmp_path: pathlib.Path) -> None:
    file = tmp_path / "broken.yaml"
    file.write_text("/**: [not: closed")
    process = start(node, "--ros-args", "--params-file", file)
    assert process.wait(60.0) != 0
    assert "broken.yaml" in process.errors()


@pytest.mark.parametrize("node", NODES)
def test_an_unknown_argument_is_refused_by_name(start, node: str) -> None:
    process = start(node, "--no-such-flag")
    assert process.wait(60.0) != 0
    assert "--no-such-flag" in process.errors()


@pytest.mark.parametrize(
    "contents",
    [b"", b"not safetensors", b"\xff" * 64, b"\x08\x00\x00\x00\x00\x00\x00\x00{}      "],
    ids=["empty", "text", "header_too_long", "no_configuration"],
)
def test_a_broken_checkpoint_is_refused_by_name(start, tmp_path: pathlib.Path, contents: bytes) -> None:
    file = tmp_path / "broken.safetensors"
    file.write_bytes(contents)
    process = start("gctn_policy", "--ros-args", "-p", f"checkpoint:={file}")
    assert process.wait(60.0) != 0
    assert "broken.safetensors" in process.errors()
    assert "panicked" not in process.errors()


@pytest.mark.parametrize("contents", [b"", b"not a bag", b"\x89MCAP0\r\n" + b"\xff" * 64], ids=["empty", "text", "records_of_nonsense"])
def test_a_bag_that_is_not_one_is_refused_by_name(start, tmp_path: pathlib.Path, contents: bytes) -> None:
    file = tmp_path / "broken.mcap"
    file.write_bytes(contents)
    process = start("goal_oracle", "--ros-args", "-p", f"demonstration:={file}")
    assert process.wait(60.0) != 0
    assert "broken.mcap" in process.errors()
    assert "panicked" not in process.errors()


@pytest.mark.parametrize(
    ("node", "parameter"), [("gctn_policy", "checkpoint"), ("goal_oracle", "demonstration"), ("sim_workcell", "problems_dir")]
)
def test_a_file_that_is_missing_is_refused_by_name(start, node: str, parameter: str, tmp_path: pathlib.Path) -> None:
    process = start(node, "--ros-args", "-p", f"{parameter}:={tmp_path / 'no_such_file'}")
    assert process.wait(60.0) != 0
    assert "no_such_file" in process.errors()
    assert "panicked" not in process.errors()


def test_launching_an_unknown_problem_is_refused_by_name(start) -> None:
    process = start("sctn", "launch", "--problem", "no_such_problem", "--seed", 10000)
    assert process.wait(60.0) != 0
    assert "no_such_problem" in process.errors()
