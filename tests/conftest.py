"""Fixtures of the end-to-end tests: a domain of its own, processes, an operator written with rclpy."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Callable, Iterator

import pytest
from processes import REPOSITORY, Process, free_domain

# Read by rmw_fastrtps when the first participant is made.
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["RMW_IMPLEMENTATION"] = "rmw_fastrtps_cpp"
os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(REPOSITORY / "config/fastdds.xml")

from cell_operator import Operator

Start = Callable[..., Process]


@pytest.fixture(scope="module")
def domain() -> int:
    """A ROS domain id for this test module alone."""
    return free_domain()


@pytest.fixture
def start(request: pytest.FixtureRequest, domain: int, tmp_path: pathlib.Path) -> Iterator[Start]:
    """Starts an executable of ours: `start("suction_executor", "--ros-args", ...)`; it is ended after the test."""
    yield from _starter(request, domain, tmp_path)


@pytest.fixture(scope="module")
def start_for_module(request: pytest.FixtureRequest, domain: int, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Start]:
    """The same for the tests of a module together."""
    yield from _starter(request, domain, tmp_path_factory.mktemp("logs"))


def _starter(request: pytest.FixtureRequest, domain: int, log_directory: pathlib.Path) -> Iterator[Start]:
    processes: list[Process] = []

    def start(name: str, *arguments: object, domain: int = domain, typed: bool = False) -> Process:
        process = Process(name, [str(argument) for argument in arguments], domain, log_directory, typed=typed)
        processes.append(process)
        return process

    yield start
    for process in reversed(processes):
        process.end()
        print(f"--- {process.name} (exit code {process.exit_code})\n{process.log()}")


@pytest.fixture
def operator(domain: int) -> Iterator[Operator]:
    """A person's rclpy script on the same domain."""
    with Operator(domain) as person:
        yield person


@pytest.fixture(scope="module")
def operator_for_module(domain: int) -> Iterator[Operator]:
    """The same for the tests of a module together."""
    with Operator(domain) as person:
        yield person
