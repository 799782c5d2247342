"""Nodes that start all at once, seen from scripts that were there before."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack

from peer import Peer
from rclpy.node import Node

SCRIPTS = 5
NODES = 6
ROUNDS = 8
# Names come one by one; after so long there are no more.
QUIET_S = 3.0


def test_scripts_hear_nodes_that_start_together_whole(start: Callable, domain: int) -> None:
    with ExitStack() as stack:
        peers = [stack.enter_context(Peer(domain, f"peer_{number}")) for number in range(SCRIPTS)]
        start("camera_fusion", "--ros-args", "-r", "__node:=alone")
        whole = settled(peers[0], "alone")
        assert {"/heightmap", "//transition_event", "//set_parameters"} <= whole
        for round_number in range(ROUNDS):
            names = [f"fusion_{round_number}_{number}" for number in range(NODES)]
            nodes = [start("camera_fusion", "--ros-args", "-r", f"__node:={name}") for name in names]
            for peer in peers:
                for name in names:
                    peer.until(lambda: ends(peer.node, name) == whole, f"{name} as a whole in round {round_number}")
            for node in nodes:
                node.end()


def settled(peer: Peer, name: str) -> set[str]:
    """What a node has once it is active and nothing comes any more."""
    peer.until(lambda: "/heightmap" in ends(peer.node, name), f"node {name}")
    found, since = ends(peer.node, name), time.monotonic()
    while time.monotonic() - since < QUIET_S:
        time.sleep(0.05)
        if (now := ends(peer.node, name)) != found:
            found, since = now, time.monotonic()
    return found


def ends(node: Node, name: str) -> set[str]:
    """Topics and services of a node, its own name left out."""
    if name not in node.get_node_names():
        return set()
    known = (
        node.get_publisher_names_and_types_by_node(name, "/")
        + node.get_subscriber_names_and_types_by_node(name, "/")
        + node.get_service_names_and_types_by_node(name, "/")
    )
    return {end.replace(name, "") for end, _ in known}
