"""Reads our launch files without the packages launch and launch_ros, which cannot be had with pip: stand-ins record what is asked for."""

from __future__ import annotations

import importlib.util
import pathlib
import sys
import types
from collections.abc import Callable

from processes import BINARIES, REPOSITORY

PACKAGE = REPOSITORY / "nodes"
LAUNCH_FILES = sorted((PACKAGE / "launch").glob("*.launch.py"))
CLASSES = {
    "launch": ["LaunchDescription"],
    "launch.actions": ["DeclareLaunchArgument", "ExecuteProcess", "LogInfo", "RegisterEventHandler"],
    "launch.conditions": ["IfCondition", "UnlessCondition"],
    "launch.event_handlers": ["OnProcessExit"],
    "launch.substitutions": ["Command", "EnvironmentVariable", "LaunchConfiguration", "PathJoinSubstitution"],
    "launch_ros": [],
    "launch_ros.actions": ["Node"],
    "launch_ros.parameter_descriptions": ["ParameterValue"],
    "launch_ros.substitutions": ["FindPackagePrefix", "FindPackageShare"],
}


class Recorded:
    """What a launch file asked for: a class of `launch` with its arguments."""

    def __init__(self, *values: object, **named: object) -> None:
        self.values, self.named = values, named

    def __iter__(self):
        yield from (*self.values, *self.named.values())


def kind(value: object) -> str:
    """The class that was asked for."""
    return type(value).__name__


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


def description(file: pathlib.Path) -> list[Recorded]:
    """What a launch file describes."""
    stand_ins = {}
    for name, classes in CLASSES.items():
        stand_ins[name] = types.ModuleType(name)
        for item in classes:
            setattr(stand_ins[name], item, type(item, (Recorded,), {}))
    before = {name: sys.modules.get(name) for name in stand_ins}
    sys.modules.update(stand_ins)
    try:
        specification = importlib.util.spec_from_file_location(file.name.split(".")[0], file)
        module = importlib.util.module_from_spec(specification)
        specification.loader.exec_module(module)
        return module.generate_launch_description().values[0]
    finally:
        for name, module in before.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module


def path_of(path: Recorded) -> pathlib.Path:
    """A path below the package's share folder, where the repository has it, or that of an executable, where it was built."""
    place, *names = path.values[0]
    assert place.values == ("sctn_nodes",)
    if kind(place) == "FindPackagePrefix":
        assert names[:2] == ["lib", "sctn_nodes"]
        return BINARIES.joinpath(*names[2:])
    return REPOSITORY.joinpath(*names)


class Launch:
    """A launch file with its arguments given."""

    def __init__(self, file: pathlib.Path, **arguments: str) -> None:
        self.entities = description(file)
        declared = {entity.values[0]: entity.named["default_value"] for entity in self.entities if kind(entity) == "DeclareLaunchArgument"}
        assert set(arguments) <= set(declared)
        self.arguments = {**declared, **arguments}

    def text(self, value: object) -> str:
        """What a substitution stands for."""
        if isinstance(value, str):
            return value
        if isinstance(value, list):
            return "".join(self.text(part) for part in value)
        if kind(value) == "LaunchConfiguration":
            return self.text(self.arguments[value.values[0]])
        assert kind(value) == "PathJoinSubstitution", kind(value)
        return str(path_of(value))

    def applies(self, entity: Recorded) -> bool:
        """Whether its condition holds."""
        condition = entity.named.get("condition")
        if condition is None:
            return True
        holds = self.text(condition.values[0]) == "true"
        return holds if kind(condition) == "IfCondition" else not holds

    def nodes(self) -> list[str]:
        """Executables of the nodes that start at once."""
        return [entity.named["executable"] for entity in self.entities if kind(entity) == "Node" and self.applies(entity)]

    def processes(self) -> list[list[str]]:
        """Command lines of other processes that start at once."""
        chosen = [entity for entity in self.entities if kind(entity) == "ExecuteProcess" and self.applies(entity)]
        return [[self.text(word) for word in entity.named["cmd"]] for entity in chosen]

    def after(self, returncode: int) -> list[Recorded]:
        """What is started when the processes have ended with that exit code."""
        handlers = [entity for entity in self.entities if kind(entity) == "RegisterEventHandler" and self.applies(entity)]
        on_exit: list[Callable] = [handler.values[0].named["on_exit"] for handler in handlers]
        event = types.SimpleNamespace(returncode=returncode)
        return [action for act in on_exit for action in act(event, None)]
