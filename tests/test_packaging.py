"""What a colcon workspace, ROS 2 launch, RViz and Foxglove take from this repository fits together."""

from __future__ import annotations

import importlib.util
import json
import os
import pathlib
import re
import subprocess
import sys
import types

import pytest
import yaml
from catkin_pkg.packages import find_packages
from processes import BINARIES, REPOSITORY

PACKAGE = REPOSITORY / "nodes"
NODES = ["camera_fusion", "gctn_policy", "goal_oracle", "motion_watchdog", "operator_console", "sim_workcell", "suction_executor"]
LAUNCH_FILES = sorted((PACKAGE / "launch").glob("*.launch.py"))


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


class Recorded:
    """What a launch file asked for: a class of `launch` with its arguments."""

    def __init__(self, *values: object, **named: object) -> None:
        self.values, self.named = values, named

    def __iter__(self):
        yield from (*self.values, *self.named.values())


def parts(value: object):
    """Everything in a description."""
    yield value
    if isinstance(value, Recorded):
        for part in value:
            yield from parts(part)
    elif isinstance(value, dict):
        for part in value.values():
            yield from parts(part)
    elif isinstance(value, (list, tuple)):
        for part in value:
            yield from parts(part)


@pytest.fixture
def launch_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stands in for the packages launch and launch_ros, which cannot be had with pip."""
    contents = {
        "launch": ["LaunchDescription"],
        "launch.actions": ["DeclareLaunchArgument"],
        "launch.conditions": ["IfCondition"],
        "launch.substitutions": ["Command", "LaunchConfiguration", "PathJoinSubstitution"],
        "launch_ros": [],
        "launch_ros.actions": ["Node"],
        "launch_ros.parameter_descriptions": ["ParameterValue"],
        "launch_ros.substitutions": ["FindPackageShare"],
    }
    for name, classes in contents.items():
        module = types.ModuleType(name)
        for item in classes:
            setattr(module, item, type(item, (Recorded,), {}))
        monkeypatch.setitem(sys.modules, name, module)


def description(file: pathlib.Path) -> list[Recorded]:
    specification = importlib.util.spec_from_file_location(file.name.split(".")[0], file)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module.generate_launch_description().values[0]


def kind(value: object) -> str:
    return type(value).__name__


def shared_path(path: Recorded) -> pathlib.Path:
    """A path below the share folder of the package, where the repository has it."""
    share, *names = path.values[0]
    assert share.values == ("sctn_nodes",)
    return REPOSITORY.joinpath(*names)


def parameters_of(node: str) -> dict:
    return yaml.safe_load((REPOSITORY / f"config/{node}.yaml").read_text())[f"/**/{node}"]["ros__parameters"]


@pytest.mark.parametrize("file", LAUNCH_FILES, ids=lambda file: file.name)
def test_what_a_launch_file_names_is_there(launch_modules, file: pathlib.Path) -> None:
    entities = description(file)
    declared = {entity.values[0] for entity in entities if kind(entity) == "DeclareLaunchArgument"}
    asked = {part.values[0] for part in parts(entities) if kind(part) == "LaunchConfiguration"}
    assert asked == declared
    for part in parts(entities):
        if kind(part) == "PathJoinSubstitution":
            assert shared_path(part).exists(), shared_path(part)
    ours = [entity.named for entity in entities if kind(entity) == "Node" and entity.named["package"] == "sctn_nodes"]
    names = {node["executable"] for node in ours}
    assert names == set(NODES) - (set() if "simulated" in file.name else {"sim_workcell"})
    for node in ours:
        files, given = node["parameters"]
        assert shared_path(files) == REPOSITORY / f"config/{node['executable']}.yaml"
        known = parameters_of(node["executable"])
        assert set(given) <= set(known), node["executable"]
        assert given["use_sim_time"] is ("simulated" in file.name)
    foreign = {entity.named["package"] for entity in entities if kind(entity) == "Node"} - {"sctn_nodes"}
    depends = re.findall(r"<exec_depend>(.*)</exec_depend>", (PACKAGE / "package.xml").read_text())
    assert foreign <= set(depends)


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
