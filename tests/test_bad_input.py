"""Bad input gives a clear error: at the start the node refuses, while it runs it says so and lives on."""

from __future__ import annotations

import pathlib

import pytest
from processes import REPOSITORY

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


ARM_CALIBRATION_OF_A_UR5E = """
kinematics:
  shoulder: {x: 0, y: 0, z: 0.16272, roll: 0, pitch: 0, yaw: 0}
  upper_arm: {x: 0, y: 0, z: 0, roll: 1.571315, pitch: 0, yaw: 0}
  forearm: {x: -0.42517, y: 0, z: 0, roll: 0, pitch: 0, yaw: 0}
  wrist_1: {x: -0.39265, y: 0, z: 0.133106, roll: 0, pitch: 0, yaw: 0}
  wrist_2: {x: 0, y: -0.099604, z: 0, roll: 1.5708, pitch: 0, yaw: 0}
  wrist_3: {x: 0, y: 0.099585, z: 0, roll: 1.5708, pitch: 3.141592653589793, yaw: 3.141592653589793}
"""


def test_a_calibration_of_another_robot_or_of_the_cameras_is_refused_by_name(start, tmp_path: pathlib.Path) -> None:
    file = tmp_path / "my_robot_calibration.yaml"
    file.write_text(ARM_CALIBRATION_OF_A_UR5E)
    # The built-in cell has a UR5.
    of_another = start("suction_executor", "--ros-args", "-p", f"arm_calibration:={file}")
    of_cameras = start("suction_executor", "--ros-args", "-p", f"arm_calibration:={REPOSITORY / 'config/calibration.yaml'}")
    # And the other way round.
    of_arm = start("camera_fusion", "--ros-args", "-p", f"calibration:={file}")
    for process, expected in [
        (of_another, ("parameter arm_calibration", "my_robot_calibration.yaml", "another robot", "ur5e")),
        (of_cameras, ("parameter arm_calibration", "config/calibration.yaml", "kinematics")),
        (of_arm, ("calibration", "my_robot_calibration.yaml", "cameras")),
    ]:
        assert process.wait(60.0) != 0
        for text in expected:
            assert text in process.errors(), process.errors()
        assert "panicked" not in process.errors()


@pytest.mark.parametrize("node", ["suction_executor", "sim_workcell"])
def test_an_arm_of_seven_joints_is_refused_by_name(start, node: str, tmp_path: pathlib.Path) -> None:
    file = tmp_path / "arm_of_seven.urdf"
    fixed = '<joint name="tool0-suction_gripper" type="fixed">'
    text = (REPOSITORY / "urdf/workcell.urdf").read_text()
    assert fixed in text
    seventh = '<joint name="wrist_4_joint" type="revolute"><axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="28" velocity="3"/>'
    file.write_text(text.replace(fixed, seventh))
    process = start(node, "--ros-args", "-p", f"urdf:={file}")
    assert process.wait(60.0) != 0
    for expected in ("parameter urdf", "arm_of_seven.urdf", "six moving joints", "wrist_4_joint"):
        assert expected in process.errors(), process.errors()


def test_launching_an_unknown_problem_is_refused_by_name(start) -> None:
    process = start("sctn", "launch", "--problem", "no_such_problem", "--seed", 10000)
    assert process.wait(60.0) != 0
    assert "no_such_problem" in process.errors()
