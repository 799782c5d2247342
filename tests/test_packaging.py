"""What a colcon workspace, ROS 2 launch, RViz and Foxglove take from this repository fits together."""

from __future__ import annotations

import json
import os
import pathlib
import re
import subprocess
import sys

import pytest
import yaml
from catkin_pkg.packages import find_packages
from launch_files import LAUNCH_FILES, PACKAGE, Launch, description, kind, parts, path_of
from processes import BINARIES, REPOSITORY

NODES = ["camera_fusion", "gctn_policy", "goal_oracle", "motion_watchdog", "operator_console", "sim_workcell", "suction_executor"]


def test_a_workspace_finds_both_packages_and_each_is_valid() -> None:
    warnings: list[str] = []
    packages = find_packages(REPOSITORY, exclude_paths=["target", "out"], warnings=warnings)
    assert {package.name: path for path, package in packages.items()} == {"sctn_msgs": "msgs", "sctn_nodes": "nodes"}
    for package in packages.values():
        assert package.package_format == 3
        package.validate(warnings=warnings)
    assert warnings == []


def test_the_package_installs_every_executable_parameter_and_launch_file(tmp_path: pathlib.Path) -> None:
    # The executables are built already; cargo is not asked.
    build, prefix = tmp_path / "build", tmp_path / "install"
    configure = [
        "import cmake; cmake.cmake()",
        *("-S", PACKAGE, "-B", build, "-G", "Ninja", f"-DCMAKE_INSTALL_PREFIX={prefix}", f"-DSCTN_EXECUTABLES={BINARIES}"),
        *("-DBUILD_TESTING=OFF", "-DPython3_FIND_VIRTUALENV=ONLY"),
    ]
    install = ["import cmake; cmake.cmake()", "--build", build, "--target", "install"]
    # The environment's own ninja and packages.
    path = f"{pathlib.Path(sys.prefix) / 'bin'}:{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "CMAKE_PREFIX_PATH": sys.prefix, "AMENT_PREFIX_PATH": sys.prefix}
    for arguments in (configure, install):
        command = [sys.executable, "-c", *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stdout + done.stderr
    for executable in (*NODES, "sctn"):
        assert (prefix / "lib/sctn_nodes" / executable).is_file()
    share = prefix / "share/sctn_nodes"
    installed = ["package.xml", "config/camera_fusion.yaml", "config/fastdds.xml", "urdf/workcell.urdf", "config/problems/placing.yaml"]
    for path in installed + [f"launch/{file.name}" for file in LAUNCH_FILES]:
        assert (share / path).is_file(), path
    # The installed command finds its files beside itself.
    shown = subprocess.run([prefix / "lib/sctn_nodes/sctn", "bench", "no_such_benchmark"], capture_output=True, text=True, cwd=tmp_path)
    assert "no benchmark of that name" in shown.stderr, shown.stderr


def parameters_of(node: str) -> dict:
    return yaml.safe_load((REPOSITORY / f"config/{node}.yaml").read_text())[f"/**/{node}"]["ros__parameters"]


@pytest.mark.parametrize("file", LAUNCH_FILES, ids=lambda file: file.name)
def test_what_a_launch_file_names_is_there(file: pathlib.Path) -> None:
    entities = description(file)
    declared = {entity.values[0] for entity in entities if kind(entity) == "DeclareLaunchArgument"}
    asked = {part.values[0] for part in parts(entities) if kind(part) == "LaunchConfiguration"}
    assert asked == declared
    for part in parts(entities):
        if kind(part) == "PathJoinSubstitution":
            assert path_of(part).exists(), path_of(part)
    ours = [entity.named for entity in entities if kind(entity) == "Node" and entity.named["package"] == "sctn_nodes"]
    names = {node["executable"] for node in ours}
    assert names == set(NODES) - (set() if "simulated" in file.name else {"sim_workcell"})
    for node in ours:
        (given,) = [part for part in node["parameters"] if isinstance(part, dict)]
        assert path_of(node["parameters"][0]) == REPOSITORY / f"config/{node['executable']}.yaml"
        known = parameters_of(node["executable"])
        assert set(given) <= set(known), node["executable"]
        assert given["use_sim_time"] is ("simulated" in file.name)
    foreign = {entity.named["package"] for entity in entities if kind(entity) == "Node"} - {"sctn_nodes"}
    depends = re.findall(r"<exec_depend>(.*)</exec_depend>", (PACKAGE / "package.xml").read_text())
    assert foreign <= set(depends)


REAL_CELL = PACKAGE / "launch/real_cell.launch.py"


def test_on_a_real_cell_a_file_of_the_engineer_wins_and_a_stop_is_remembered() -> None:
    launch = Launch(REAL_CELL, check="false")
    entities = launch.entities
    nodes = {entity.named["executable"]: entity.named for entity in entities if kind(entity) == "Node"}
    for name in set(NODES) - {"sim_workcell"}:
        _, real_cell, _, of_engineer = nodes[name]["parameters"]
        assert path_of(real_cell) == REPOSITORY / "config/real_cell.yaml"
        assert (kind(of_engineer), of_engineer.values) == ("LaunchConfiguration", ("parameters",))
    given = nodes["suction_executor"]["parameters"][2]
    asked = {name: value.values[0] for name, value in given.items() if kind(value) == "LaunchConfiguration"}
    assert asked == {name: name for name in ("urdf", "arm_calibration", "stop_file")}
    defaults = {entity.values[0]: entity.named["default_value"] for entity in entities if kind(entity) == "DeclareLaunchArgument"}
    home, *path = defaults["stop_file"]
    assert (kind(home), home.values) == ("EnvironmentVariable", ("ROS_HOME",))
    # Two cells on one host, in two namespaces, have two files.
    assert any(kind(part) == "LaunchConfiguration" and part.values == ("namespace",) for part in path)
    # The file that is read where the engineer names none is one that is read before, too.
    assert path_of(defaults["parameters"]) == REPOSITORY / "config/real_cell.yaml"


def test_a_real_cell_has_a_median_and_the_topics_of_its_cameras_in_fusion_page_and_check() -> None:
    launch = Launch(
        REAL_CELL,
        camera_preset="orbbec",
        frames="7",
        calibration="/cell/calibration.yaml",
        arm_calibration="/cell/arm.yaml",
        contact="vacuum",
        namespace="cell",
    )
    given = {
        node["executable"]: node["parameters"][2]
        for node in (entity.named for entity in launch.entities if kind(entity) == "Node")
        if "package" in node and node["package"] == "sctn_nodes"
    }
    assert launch.text(given["camera_fusion"]["frames"]) == "7"
    assert int(Launch(REAL_CELL).arguments["frames"]) > 1
    for node in ("camera_fusion", "operator_console"):
        assert launch.text(given[node]["camera_preset"]) == "orbbec"
    [check] = launch.processes()
    assert check[:2] == [str(BINARIES / "sctn"), "check"]
    for words in (
        ["-p", "camera_fusion:frames:=7"],
        ["-p", "camera_fusion:camera_preset:=orbbec"],
        ["-p", 'camera_fusion:calibration:="/cell/calibration.yaml"'],
        ["-p", "suction_executor:driver.contact:=vacuum"],
        ["-p", 'suction_executor:arm_calibration:="/cell/arm.yaml"'],
        ["-r", "__ns:=/cell"],
    ):
        at = check.index(words[1])
        assert check[at - 1 : at + 1] == words


def test_the_executor_of_a_real_cell_starts_only_when_the_check_has_found_nothing() -> None:
    launch = Launch(REAL_CELL)
    assert "suction_executor" not in launch.nodes()
    started = launch.after(0)
    assert [(kind(action), action.named["executable"]) for action in started] == [("Node", "suction_executor")]
    # As it starts at once where nobody asks for the check.
    unchecked = Launch(REAL_CELL, check="false")
    assert "suction_executor" in unchecked.nodes()
    assert unchecked.processes() == []
    assert unchecked.after(0) == []
    [at_once] = [entity for entity in unchecked.entities if kind(entity) == "Node" and entity.named["executable"] == "suction_executor"]
    assert launch.text(started[0].named["parameters"][0]) == unchecked.text(at_once.named["parameters"][0])
    assert set(started[0].named["parameters"][2]) == set(at_once.named["parameters"][2])
    for returncode in (1, 2, 101, -9):
        [said] = launch.after(returncode)
        assert kind(said) == "LogInfo"
        assert "sctn check" in said.named["msg"]


def interface_page() -> str:
    return (REPOSITORY / "docs/interfaces.md").read_text()


def test_every_topic_that_rviz_shows_is_one_of_ours() -> None:
    displays = yaml.safe_load((REPOSITORY / "config/sctn.rviz").read_text())["Visualization Manager"]["Displays"]
    topics = [display[key]["Value"] for display in displays for key in ("Topic", "Description Topic") if key in display]
    assert len(topics) >= 6
    for topic in topics:
        assert f"`{topic}`" in interface_page(), topic


def test_every_topic_that_foxglove_shows_is_one_of_ours() -> None:
    layout = json.loads((REPOSITORY / "config/foxglove.json").read_text())
    panels = layout["configById"]
    topics = set(panels["3D!cell"]["topics"])
    for panel in panels.values():
        topics |= {panel[key] for key in ("topicPath", "topicToRender") if key in panel}
        topics |= {panel["imageMode"]["imageTopic"]} if "imageMode" in panel else set()
        topics |= {path["value"].rsplit(".", 1)[0] for path in panel.get("paths", [])}
    assert len(topics) >= 8
    for topic in topics:
        assert f"`{topic[1:]}`" in interface_page() or f"`{topic}`" in interface_page(), topic

    def leaves(node: object) -> set[str]:
        return {node} if isinstance(node, str) else leaves(node["first"]) | leaves(node["second"])

    assert leaves(layout["layout"]) == set(panels)
