"""A second host: a network namespace, joined to the caller's by a link that loses datagrams.

The caller has to be in a network namespace of its own, which `in_own_network` sees to. A process of this file holds the other namespace
and carries frames between two tap devices. Each datagram is one frame: the link takes 65,521 bytes.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import random
import select
import struct
import subprocess
import sys
from collections.abc import Iterator

MTU = 65_521
NETWORK = "10.77.0"
# Set in a process that has a network of its own.
VARIABLE = "SCTN_OWN_NETWORK"
IN_OWN_NETWORK = ["unshare", "--map-root-user", "--net"]
_TUNSETIFF, _IFF_TAP, _IFF_NO_PI, _CLONE_NEWNET = 0x400454CA, 0x0002, 0x1000, 0x40000000


def why_not() -> str:
    """Why this machine lets us make no second host; empty where it does."""
    if not os.access("/dev/net/tun", os.R_OK | os.W_OK):
        return "/dev/net/tun cannot be opened"
    try:
        tried = subprocess.run([*IN_OWN_NETWORK, "ip", "link", "set", "lo", "up"], capture_output=True, text=True, check=False)
    except FileNotFoundError as error:
        return f"{error.filename} is not installed"
    return tried.stderr.strip() if tried.returncode else ""


def in_own_network() -> str:
    """Starts this process again in a network namespace of its own; where the machine does not allow that, returns why."""
    if os.environ.get(VARIABLE):
        return ""
    if reason := why_not():
        return reason
    os.environ[VARIABLE] = "1"
    os.execvp(IN_OWN_NETWORK[0], [*IN_OWN_NETWORK, "sh", "-c", 'ip link set lo up && exec "$@"', "sh", sys.executable, *sys.argv])


class Link:
    """The link to the second host."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        # What starts a program on the second host.
        self.prefix = ["nsenter", f"--net=/proc/{process.pid}/ns/net"]

    def lose(self, share: float) -> None:
        """Loses this share of all datagrams, in both directions: 1 parts the hosts. It does so when this returns."""
        self._process.stdin.write(f"{share}\n")
        self._process.stdin.flush()
        said = self._process.stdout.readline()
        if said != f"{share}\n":
            raise RuntimeError(f"the link said {said!r}, expected that it loses {share}")


@contextlib.contextmanager
def second_host(seed: int) -> Iterator[Link]:
    """Makes the host. The seed draws which datagrams are lost."""
    command = [sys.executable, __file__, str(seed)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        if process.stdout.readline() != "ready\n":
            raise RuntimeError("no second host: see above")
        yield Link(process)
    finally:
        process.stdin.close()
        process.wait(10.0)


def _tap(address: int) -> int:
    """A tap device in the present namespace, ready for use."""
    device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(device, _TUNSETIFF, struct.pack("16sH", b"link0", _IFF_TAP | _IFF_NO_PI))
    for line in (f"link set link0 mtu {MTU} up", f"addr add {NETWORK}.{address}/24 dev link0", "route add 224.0.0.0/4 dev link0"):
        subprocess.run(["ip", *line.split()], check=True)
    return device


def _carry(devices: tuple[int, int], draw: random.Random) -> None:
    """Carries frames until standard input ends, which says what share to lose."""
    share = 0.0
    os.set_blocking(sys.stdin.fileno(), False)
    while True:
        ready, _, _ = select.select([sys.stdin.fileno(), *devices], [], [])
        for source in ready:
            if source == sys.stdin.fileno():
                said = os.read(source, 1000).decode()
                if not said:
                    return
                share = float(said)
                print(share, flush=True)
                continue
            frame = os.read(source, MTU + 100)
            if draw.random() >= share:
                with contextlib.suppress(BlockingIOError):
                    os.write(devices[source == devices[0]], frame)


def main() -> None:
    here = _tap(1)
    if ctypes.CDLL(None, use_errno=True).unshare(_CLONE_NEWNET):
        raise OSError(ctypes.get_errno(), "unshare")
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    there = _tap(2)
    print("ready", flush=True)
    _carry((here, there), random.Random(int(sys.argv[1])))


if __name__ == "__main__":
    main()
