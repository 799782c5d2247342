"""`sctn check` beside a cell whose cameras are as real ones."""

from __future__ import annotations

import json
import math
import pathlib
import signal
import subprocess
from typing import NamedTuple

import pytest
from cameras import NAMES, Cameras, unregistered
from cameras import TOPICS as ALL_TOPICS
from cell_operator import Operator
from launch_files import PACKAGE, Launch, kind
from processes import REPOSITORY, environment, free_domain

CALIBRATION = REPOSITORY / "config/calibration.yaml"
# The other rows measure how busy this machine is: clocks and rates.
GEOMETRY = {"tilt", "height", "offset", "fill", "reach"}


@pytest.fixture(scope="module")
def recorded(start_for_module, domain: int, tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """A bag of three cameras, whose calibration is off by what the perturbation draws, and of the joints."""
    parameters = ["--ros-args"]
    for file in ("sim_workcell.yaml", "hardware/realistic.yaml"):
        parameters += ["--params-file", REPOSITORY / "config" / file]
    # A bag of images at 30 Hz would be large.
    parameters += ["-p", f"perturbation:={REPOSITORY / 'config/perturbations/mild.yaml'}", "-p", "frames_period_s:=0.5"]
    start_for_module("sim_workcell", *parameters)
    bag = tmp_path_factory.mktemp("check") / "bag"
    topics = [f"/{camera}/{topic}" for camera in ("front", "left", "right") for topic in TOPICS]
    command = ["bag", "record", "/joint_states", "/tf_static", *topics, "--out", bag, "--duration", "6"]
    sctn(domain, *command).check_returncode()
    return bag


TOPICS = ("color/image_raw", "depth/image_rect_raw", "color/camera_info")


class Quaternion(NamedTuple):
    """As in a calibration file."""

    x: float
    y: float
    z: float
    w: float

    @classmethod
    def about_x(cls, angle_rad: float) -> Quaternion:
        return cls(math.sin(angle_rad / 2), 0.0, 0.0, math.cos(angle_rad / 2))

    def __mul__(self, other: Quaternion) -> Quaternion:
        (x, y, z, w), (a, b, c, d) = self, other
        return Quaternion(
            w * a + x * d + y * c - z * b,
            w * b - x * c + y * d + z * a,
            w * c + x * b - y * a + z * d,
            w * d - x * a - y * b - z * c,
        )


def sctn(domain: int, *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [REPOSITORY / "target/release/sctn", *map(str, arguments)]
    return subprocess.run(command, env=environment(domain), capture_output=True, text=True, timeout=120.0, check=False)


def check(
    domain: int, bag: pathlib.Path, *arguments: object, parameters: tuple[str, ...] = ("frames:=5",)
) -> tuple[int, dict[tuple[str, str], bool]]:
    """The exit code, and what each row says."""
    ros = [word for parameter in parameters for word in ("-p", f"camera_fusion:{parameter}")]
    ended = sctn(domain, "check", "--bag", bag, "--json", *arguments, "--", *ros)
    assert ended.stdout, ended.stderr
    rows = json.loads(ended.stdout.splitlines()[-1])["measures"]
    return ended.returncode, {(row["name"], row["subject"]): row["good"] for row in rows}


def test_a_calibrated_cell_has_a_flat_table_that_all_cameras_see_alike(domain: int, recorded: pathlib.Path) -> None:
    code, rows = check(domain, recorded)
    geometry = {row: good for row, good in rows.items() if row[0] in GEOMETRY}
    assert {name for name, _ in geometry} == GEOMETRY
    assert all(geometry.values()), geometry
    assert (code == 0) == all(rows.values())


def test_a_camera_that_stands_elsewhere_than_its_calibration_says_is_red_by_name(
    domain: int, recorded: pathlib.Path, tmp_path: pathlib.Path
) -> None:
    wrong = tmp_path / "calibration.yaml"
    # The front camera 20 mm too high.
    wrong.write_text(CALIBRATION.read_text().replace("[1.0, 0.0, 0.75]", "[1.0, 0.0, 0.77]"))
    code, rows = check(domain, recorded, "--calibration", wrong)
    assert code == 1
    red = {row for row, good in rows.items() if not good and row[0] in GEOMETRY}
    assert ("height", "front") in red
    assert ("offset", "front and left") in red
    assert ("offset", "left and right") not in red


def test_an_error_of_5_mm_and_half_a_degree_of_the_calibration_is_red(domain: int, recorded: pathlib.Path, tmp_path: pathlib.Path) -> None:
    wrong = tmp_path / "calibration.yaml"
    # The left camera 5 mm higher and turned by half a degree about the table's x.
    turn = Quaternion.about_x(math.radians(0.5)) * Quaternion(-0.359604797490, 0.868162779196, -0.315985410125, 0.130885442386)
    text = CALIBRATION.read_text().replace("[0.0, 0.5, 0.75]", "[0.0, 0.5, 0.755]")
    text = text.replace("[-0.359604797490, 0.868162779196, -0.315985410125, 0.130885442386]", str(list(turn)))
    assert text.count("0.755") == 1
    wrong.write_text(text)
    code, rows = check(domain, recorded, "--calibration", wrong)
    assert code == 1
    red = {row for row, good in rows.items() if not good and row[0] in GEOMETRY}
    assert red
    assert all("left" in subject for _, subject in red), red


def test_it_measures_with_the_median_and_the_workspace_of_the_fusion(domain: int, recorded: pathlib.Path) -> None:
    ended = sctn(domain, "check", "--bag", recorded, "--", "-p", "camera_fusion:frames:=31")
    assert ended.returncode == 1
    assert "expected 62 or more" in ended.stderr
    # Twice as far as the arm reaches.
    code, rows = check(domain, recorded, parameters=("workspace.origin_x_m:=1.2",))
    assert code == 1
    assert not any(good for (name, _), good in rows.items() if name == "reach")
    ended = sctn(domain, "check", "--bag", recorded, "--", "-p", "camera_fusion:camera_preset:=kinect")
    assert ended.returncode == 1
    assert "camera_preset" in ended.stderr and "realsense_aligned" in ended.stderr


def test_where_no_two_cameras_see_the_board_that_is_red_if_it_is_asked_for(domain: int, recorded: pathlib.Path) -> None:
    _, rows = check(domain, recorded)
    assert "board" not in {name for name, _ in rows}
    code, rows = check(domain, recorded, "--require-board")
    assert code == 1
    assert rows["board", "seen by no two cameras"] is False


@pytest.mark.parametrize("wrong", [{"calibration"}, {"controllers"}])
def test_a_red_row_keeps_the_executor_of_a_real_cell_from_starting(start, tmp_path: pathlib.Path, wrong: set[str]) -> None:
    """What real_cell.launch.py runs, beside a simulated cell on a domain of its own."""
    parameters = ["--ros-args"]
    for file in ("sim_workcell.yaml", "hardware/realistic.yaml"):
        parameters += ["--params-file", REPOSITORY / "config" / file]
    parameters += ["-p", "frames_period_s:=0.1"]
    if "controllers" in wrong:
        parameters += ["-p", "hardware.inactive_controllers:=[tool_contact_controller]"]
    own = free_domain()
    start("sim_workcell", *parameters, domain=own)
    calibration = tmp_path / "calibration.yaml"
    calibration.write_text(
        CALIBRATION.read_text().replace("[1.0, 0.0, 0.75]", "[1.0, 0.0, 0.76]" if "calibration" in wrong else "[1.0, 0.0, 0.75]")
    )
    launch = Launch(PACKAGE / "launch/real_cell.launch.py", camera_preset="simulated", frames="3", calibration=str(calibration))
    assert "suction_executor" not in launch.nodes()
    [command] = launch.processes()
    ended = subprocess.run(command, env=environment(own), capture_output=True, text=True, timeout=120.0, check=False)
    print(ended.stdout, ended.stderr)
    rows = [line for line in ended.stdout.splitlines() if line.startswith(("red", "green"))]
    red = {row.split()[1] for row in rows if row.startswith("red")}
    assert ("height" in red) == ("calibration" in wrong)
    assert ("controllers" in red) == ("controllers" in wrong)
    if "controllers" in wrong:
        assert "`tool_contact_controller` is inactive" in ended.stdout
    assert ended.returncode == 1
    assert [kind(action) for action in launch.after(ended.returncode)] == ["LogInfo"]


def test_depth_that_the_fusion_registers_is_measured_as_it_registers_it(tmp_path: pathlib.Path) -> None:
    own, bag = free_domain(), tmp_path / "bag"
    topics = [f"/{camera}/{topic}" for camera in NAMES for topic in ALL_TOPICS]
    command = [REPOSITORY / "target/release/sctn", "bag", "record", "/tf_static", *topics, "--out", bag, "--duration", "60"]
    recorder = subprocess.Popen(list(map(str, command)), env=environment(own), stdout=subprocess.DEVNULL)
    try:
        with Operator(own) as operator:
            cameras = Cameras(operator)
            cameras.wait_for_fusion()
            cameras.publish_extrinsics()
            cameras.publish_depth_frames()
            for _ in range(16):
                cameras.publish(unregistered, None)
                operator.spin(0.2)
        recorder.send_signal(signal.SIGINT)
        assert recorder.wait(30.0) == 0
    finally:
        recorder.kill()
        recorder.wait()
    _, rows = check(own, bag)
    # 20 mm off where it is not registered.
    assert all(rows["height", camera] and rows["tilt", camera] for camera in NAMES), rows


def test_a_camera_without_messages_is_named(domain: int, recorded: pathlib.Path) -> None:
    ended = sctn(domain, "check", "--bag", recorded, "--cameras", "front,ceiling")
    assert ended.returncode == 1
    assert "/ceiling/color/camera_info" in ended.stderr
