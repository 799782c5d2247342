"""What RViz needs to show the moving arm: a description, joint states, and every link's frame."""

from __future__ import annotations

import xml.etree.ElementTree

from cell_operator import LATCHED, Operator
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

# As tf2's listener subscribes.
DYNAMIC = QoSProfile(
    depth=100,
    history=HistoryPolicy.KEEP_LAST,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)


def test_every_link_of_the_description_has_a_frame_that_leads_to_the_world(start, operator: Operator) -> None:
    start("sim_workcell", "--ros-args", "-p", "seed:=10000")
    descriptions: list[str] = []
    parents: dict[str, str] = {}
    moving: set[str] = set()

    def tf(message: TFMessage, dynamic: bool) -> None:
        for one in message.transforms:
            parents[one.child_frame_id] = one.header.frame_id
            if dynamic:
                moving.add(one.child_frame_id)

    node = operator.node
    node.create_subscription(String, "robot_description", lambda message: descriptions.append(message.data), LATCHED)
    node.create_subscription(TFMessage, "/tf", lambda message: tf(message, True), DYNAMIC)
    node.create_subscription(TFMessage, "/tf_static", lambda message: tf(message, False), LATCHED)
    operator.until(lambda: descriptions and moving and "base_link" in parents, "description and frames", 60.0)
    robot = xml.etree.ElementTree.fromstring(descriptions[0])
    links = {link.get("name") for link in robot.findall("link")}
    assert links - {"world"} == set(parents)
    for link in links - {"world"}:
        at, steps = link, 0
        while at != "world":
            at, steps = parents[at], steps + 1
            assert steps < len(links), link
    turning = {joint.get("name"): joint.find("child").get("link") for joint in robot.findall("joint") if joint.get("type") == "revolute"}
    assert set(turning.values()) == moving
    assert set(operator.next("joint_states").name) == set(turning)
