"""Bad input gives a clear error: at the start the node refuses, while it runs it says so and lives on."""

from __future__ import annotations

import pathlib

import pytest

NODES = ["camera_fusion", "goal_oracle", "gctn_policy", "suction_executor", "sim_workcell"]


@pytest.mark.parametrize("node", NODES)
def test_an_unknown_parameter_is_refused_by_name(start, node: str) -> None:
    process = start(node, "--ros-args", "-p", "no_such_parameter:=1")
    assert process.wait(10.0) != 0
    assert "no_such_parameter" in process.errors()


@pytest.mark.parametrize("node", NODES)
def test_a_parameter_file_that_is_not_yaml_is_refused_by_name(start, node: str, tmp_path: pathlib.Path) -> None:
    file = tmp_path / "broken.yaml"
    file.write_text("/**: [not: closed")
    process = start(node, "--ros-args", "--params-file", file)
    assert process.wait(10.0) != 0
    assert "broken.yaml" in process.errors()


@pytest.mark.parametrize("node", NODES)
def test_an_unknown_argument_is_refused_by_name(start, node: str) -> None:
    process = start(node, "--no-such-flag")
    assert process.wait(10.0) != 0
    assert "--no-such-flag" in process.errors()
