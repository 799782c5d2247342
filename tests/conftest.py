"""Fixtures of the end-to-end tests: a domain of its own, processes, an operator written with rclpy."""

from __future__ import annotations

import fcntl
import os
import pathlib
import tempfile
from collections.abc import Callable, Iterator

import pytest
from processes import REPOSITORY, Process, free_domain

# Read by rmw_fastrtps when the first participant is made.
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["RMW_IMPLEMENTATION"] = "rmw_fastrtps_cpp"
os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(REPOSITORY / "config/fastdds.xml")

from cell_operator import Operator

Start = Callable[..., Process]


@pytest.fixture(scope="module", autouse=True)
def processors(request: pytest.FixtureRequest) -> Iterator[None]:
    """A module marked `alone` runs while no other module does, of this run of the tests or another of this machine."""
    alone = request.node.get_closest_marker("alone") is not None
    folder = pathlib.Path(tempfile.gettempdir())
    # Who waits for the room holds the door: those who come later wait behind it.
    door, room = (folder / f"sctn_tests_{os.getuid()}_{name}.lock" for name in ("door", "room"))
    with room.open("ab") as room_lock:
        with door.open("ab") as door_lock:
            fcntl.flock(door_lock, fcntl.LOCK_EX)
            fcntl.flock(room_lock, fcntl.LOCK_EX if alone else fcntl.LOCK_SH)
        yield


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
