"""`sctn check` beside a cell whose cameras are as real ones."""

from __future__ import annotations

import json
import pathlib
import subprocess

import pytest
from processes import REPOSITORY, environment

CALIBRATION = REPOSITORY / "config/calibration.yaml"
# The other rows measure how busy this machine is: clocks and rates.
GEOMETRY = {"tilt", "height", "offset", "fill", "reach"}


@pytest.fixture(scope="module")
def recorded(start_for_module, domain: int, tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """A bag of three cameras, whose calibration is off by what the perturbation draws, and of the joints."""
    parameters = ["--ros-args"]
    for file in ("sim_workcell.yaml", "hardware/realistic.yaml"):
        parameters += ["--params-file", REPOSITORY / "config" / file]
    parameters += ["-p", f"perturbation:={REPOSITORY / 'config/perturbations/mild.yaml'}"]
    start_for_module("sim_workcell", *parameters)
    bag = tmp_path_factory.mktemp("check") / "bag"
    topics = [f"/{camera}/{topic}" for camera in ("front", "left", "right") for topic in TOPICS]
    command = ["bag", "record", "/joint_states", "/tf_static", *topics, "--out", bag, "--duration", "15"]
    sctn(domain, *command).check_returncode()
    return bag


TOPICS = ("color/image_raw", "depth/image_rect_raw", "color/camera_info")


def sctn(domain: int, *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [REPOSITORY / "target/release/sctn", *map(str, arguments)]
    return subprocess.run(command, env=environment(domain), capture_output=True, text=True, timeout=120.0, check=False)


def check(domain: int, bag: pathlib.Path, *arguments: object) -> tuple[int, dict[tuple[str, str], bool]]:
    """The exit code, and what each row says."""
    ended = sctn(domain, "check", "--bag", bag, "--json", *arguments)
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


def test_a_camera_without_messages_is_named(domain: int, recorded: pathlib.Path) -> None:
    ended = sctn(domain, "check", "--bag", recorded, "--cameras", "front,ceiling")
    assert ended.returncode == 1
    assert "/ceiling/color/camera_info" in ended.stderr
