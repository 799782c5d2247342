"""Starts our executables for a test and ends them by process id, leaving nothing behind."""

from __future__ import annotations

import fcntl
import os
import pathlib
import pty
import signal
import socket
import subprocess
import tempfile
import termios
import time
from typing import IO

REPOSITORY = pathlib.Path(__file__).resolve().parent.parent
BINARIES = REPOSITORY / os.environ.get("CARGO_TARGET_DIR", "target") / "release"

# How long a process may take to end after SIGTERM.
GRACE_S = 10.0


def free_domain() -> int:
    """A ROS domain id whose discovery ports nobody on this machine has, and which no other run of the tests was given.

    Ids above 100 would use ports that the kernel hands out to others.
    """
    for domain in [1 + (free_domain.next + offset) % 100 for offset in range(100)]:
        ports = [7400 + 250 * domain + port for port in (0, 1, *range(10, 34))]
        if all(_is_free(port) for port in ports) and _claim(domain):
            free_domain.next = domain
            return domain
    raise RuntimeError("no free ROS domain id between 1 and 100")


free_domain.next = os.getpid()
# The lock of each domain id that was given out, held until this process ends.
_claims: dict[int, IO[bytes]] = {}


def _claim(domain: int) -> bool:
    """Takes the lock of a domain id, which one process of this machine holds at a time."""
    if domain in _claims:
        return True
    lock = (pathlib.Path(tempfile.gettempdir()) / f"sctn_ros_domain_{os.getuid()}_{domain}.lock").open("ab")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.close()
        return False
    _claims[domain] = lock
    return True


def _is_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("0.0.0.0", port))
        except OSError:
            return False
    return True


def environment(domain: int) -> dict[str, str]:
    """The environment of a node under test: its own domain, this machine only."""
    return {
        **{name: value for name, value in os.environ.items() if not name.startswith(("ROS_", "RMW_"))},
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "RUST_BACKTRACE": "0",
        "NO_COLOR": "1",
    }


class Process:
    """One running executable, its output in files."""

    def __init__(
        self,
        name: str,
        arguments: list[str],
        domain: int,
        log_directory: pathlib.Path,
        variables: dict[str, str] | None = None,
        prefix: list[str] | None = None,
        typed: bool = False,
    ) -> None:
        """With a prefix the executable is started by another program, which has to become it. Typed: at a pseudo terminal, by `type`."""
        self.name = name
        executable = BINARIES / name
        if not executable.exists():
            raise FileNotFoundError(f"{executable}: build first, `cargo build --release --workspace --bins`")
        number = len(list(log_directory.glob(f"{name}-*.out")))
        self._output_file = log_directory / f"{name}-{number}.out"
        self._error_file = log_directory / f"{name}-{number}.err"
        # A person's end of the terminal, and the executable's.
        self._terminal, its_terminal = pty.openpty() if typed else (None, subprocess.DEVNULL)
        with self._output_file.open("wb") as output, self._error_file.open("wb") as errors:
            # Its own session: whatever it starts can be found and ended with it.
            self._child = subprocess.Popen(
                [*(prefix or []), executable, *map(str, arguments)],
                cwd=REPOSITORY,
                env={**environment(domain), **(variables or {})},
                stdin=its_terminal,
                stdout=output,
                stderr=errors,
                start_new_session=True,
                # The terminal of its session: who closes it hangs up on the executable.
                preexec_fn=(lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0)) if typed else None,
            )
        if typed:
            os.close(its_terminal)

    @property
    def pid(self) -> int:
        return self._child.pid

    @property
    def exit_code(self) -> int | None:
        return self._child.poll()

    def signal(self, number: int) -> None:
        """Sends it a signal."""
        self._child.send_signal(number)

    def type(self, line: str) -> None:
        """Types a line at its terminal."""
        os.write(self._terminal, f"{line}\n".encode())

    def close_terminal(self) -> None:
        """Closes the terminal, as a person who closes its window."""
        if self._terminal is not None:
            os.close(self._terminal)
            self._terminal = None

    def output(self) -> str:
        """Standard output so far."""
        return self._output_file.read_text(errors="replace")

    def errors(self) -> str:
        """Standard error so far: the log."""
        return self._error_file.read_text(errors="replace")

    def log(self) -> str:
        """The ends of both, for a person to read."""
        return f"{self.output()[-1000:]}\n{self.errors()[-4000:]}"

    def wait(self, timeout_s: float) -> int:
        """The exit code; an error with the end of the log when it is still running after the time."""
        try:
            return self._child.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise TimeoutError(f"{self.name} still runs after {timeout_s} s; its output ends:\n{self.log()}") from None

    def descendants(self) -> list[int]:
        """Living processes of its session, itself included; zombies do not count."""
        found = []
        for entry in pathlib.Path("/proc").iterdir():
            if not entry.name.isdigit():
                continue
            try:
                fields = (entry / "stat").read_text().rsplit(")", 1)[1].split()
            except OSError:
                continue
            state, session = fields[0], int(fields[3])
            if session == self.pid and state != "Z":
                found.append(int(entry.name))
        return found

    def end(self) -> None:
        """Asks it to end, and kills what is left of its session after the grace time."""
        if self.exit_code is None:
            self._child.send_signal(signal.SIGTERM)
        deadline = time.monotonic() + GRACE_S
        while (self.exit_code is None or self.descendants()) and time.monotonic() < deadline:
            time.sleep(0.05)
        for pid in self.descendants():
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                pass
        self._child.wait(GRACE_S)
        self.close_terminal()
