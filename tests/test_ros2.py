"""What a user of ROS 2 expects of a node, capability by capability: the table of docs/ros2.md."""

from __future__ import annotations

import pathlib
import random
import re
import signal
import subprocess
import time
from collections.abc import Iterator
from typing import Any

import pytest
from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from lifecycle_msgs.msg import Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetAvailableStates, GetAvailableTransitions, GetState
from peer import BEST_EFFORT, LATCHED, RELIABLE, Peer, filled, interfaces
from processes import REPOSITORY, Process, free_domain
from rcl_interfaces.msg import Log, Parameter, ParameterEvent, ParameterType, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.action import ActionClient, ActionServer
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sctn_msgs.action import ExecutePickPlace
from sctn_msgs.msg import PickPlace, Reward
from sensor_msgs.msg import CameraInfo

ROUNDS = 3


@pytest.fixture(scope="module")
def peer(domain: int) -> Iterator[Peer]:
    with Peer(domain) as one:
        yield one


@pytest.fixture(scope="module")
def echo(start_for_module, peer: Peer) -> Process:
    """The node that gives everything back (ros/node_kit/src/bin/interface_echo.rs)."""
    process = start_for_module("interface_echo")
    wait_for_node(peer, "interface_echo")
    return process


def wait_for_node(peer: Peer, name: str, namespace: str = "/") -> None:
    peer.until(lambda: (name, namespace) in peer.node.get_node_names_and_namespaces(), f"node {name}")


# --- messages, services, actions


def test_every_message_goes_both_ways_unchanged(echo: Process, peer: Peer) -> None:
    chance = random.Random(1)
    lines = []
    for package, name, kind in interfaces("msg"):
        publisher = peer.node.create_publisher(kind, f"echo/{package}/{name}", RELIABLE)
        lines.append((f"{package}/{name}", kind, publisher, peer.listen(kind, f"echoed/{package}/{name}")))
    assert len(lines) > 60
    for name, _, publisher, _ in lines:
        peer.until(publisher.get_subscription_count, f"subscription to echo/{name}")
        peer.until(lambda topic=f"/echoed/{name}": peer.node.count_publishers(topic), f"publisher of echoed/{name}")
    for name, kind, publisher, received in lines:
        # The other way back may not be matched yet.
        first = filled(kind, chance)

        def back(publisher=publisher, received=received, first=first) -> bool:
            publisher.publish(first)
            return first in received or (time.sleep(0.05) or first in received)

        peer.until(back, f"echo of {name}")
        for message in [filled(kind, chance) for _ in range(ROUNDS)]:
            publisher.publish(message)
            peer.until(lambda message=message, received=received: message in received, f"echo of {message}")


def test_every_service_goes_both_ways_unchanged_also_repeated(echo: Process, peer: Peer) -> None:
    chance = random.Random(2)
    names = []
    for package, name, kind in interfaces("srv"):
        if package != "sctn_msgs" and name not in ("GetParameters", "SetParameters"):
            continue
        names.append(name)
        topic = f"{package}/{name}"
        # rclpy asks, we answer.
        asked = peer.listen(kind.Request, f"asked/{topic}")
        reply = peer.speak(kind.Response, f"reply/{topic}")
        client = peer.client(kind, f"served/{topic}")
        for _ in range(ROUNDS):
            request, response = filled(kind.Request, chance), filled(kind.Response, chance)
            reply.publish(response)

            def answered(client=client, request=request, response=response) -> bool:
                # What is to be answered goes another way than the question.
                return peer.wait(client.call_async(request), f"answer of {topic}") == response

            peer.until(answered, f"right answer of {topic}")
            peer.until(lambda asked=asked, request=request: request in asked, f"question of {topic}")
        # We ask, rclpy answers.
        heard: list[Any] = []
        answer = [kind.Response()]
        peer.node.create_service(kind, f"answer/{topic}", lambda request, _, h=heard, a=answer: h.append(request) or a[0])
        answers = peer.listen(kind.Response, f"answered/{topic}")
        ask = peer.speak(kind.Request, f"ask/{topic}")
        for _ in range(ROUNDS):
            request, answer[0] = filled(kind.Request, chance), filled(kind.Response, chance)
            ask.publish(request)
            peer.until(lambda answers=answers, answer=answer: answer[0] in answers, f"answer to {topic}")
            assert request in heard
    assert "SetParameters" in names


def test_the_action_goes_both_ways_unchanged_with_feedback(echo: Process, peer: Peer) -> None:
    chance = random.Random(3)
    kind, topic = ExecutePickPlace, "sctn_msgs/ExecutePickPlace"
    # rclpy asks, we carry it out.
    asked = peer.listen(kind.Goal, f"asked/{topic}")
    feedback, result = peer.speak(kind.Feedback, f"feedback/{topic}"), peer.speak(kind.Result, f"result/{topic}")
    client = ActionClient(peer.node, kind, f"served/{topic}")
    assert client.wait_for_server(60.0)
    for _ in range(ROUNDS):
        goal, said, end = filled(kind.Goal, chance), filled(kind.Feedback, chance), filled(kind.Result, chance)
        feedback.publish(said)
        result.publish(end)
        heard: list[Any] = []

        def carried_out(goal=goal, said=said, end=end, heard=heard) -> bool:
            # What is to be said goes another way than the goal.
            sending = client.send_goal_async(goal, feedback_callback=lambda message: heard.append(message.feedback))
            handle = peer.wait(sending, "answer to the goal")
            back = peer.wait(handle.get_result_async(), "result")
            return back.status == GoalStatus.STATUS_SUCCEEDED and back.result == end and said in heard

        peer.until(carried_out, "right result and feedback")
        peer.until(lambda goal=goal: goal in asked, "goal")
    # We ask, rclpy carries it out.
    goals: list[Any] = []
    answer = [kind.Result()]

    def carry_out(handle: Any) -> Any:
        goals.append(handle.request)
        handle.succeed()
        return answer[0]

    server = ActionServer(peer.node, kind, f"answer/{topic}", carry_out)
    answers = peer.listen(kind.Result, f"answered/{topic}")
    ask = peer.speak(kind.Goal, f"ask/{topic}")
    for _ in range(ROUNDS):
        goal, answer[0] = filled(kind.Goal, chance), filled(kind.Result, chance)
        ask.publish(goal)
        peer.until(lambda: answer[0] in answers, "result of our goal")
        assert goal in goals
    server.destroy()


def test_three_goals_run_side_by_side_one_is_cancelled_and_a_late_request_gets_its_result(echo: Process, peer: Peer) -> None:
    client = ActionClient(peer.node, ExecutePickPlace, "held/sctn_msgs/ExecutePickPlace")
    assert client.wait_for_server(60.0)
    said: list[int] = []

    def send(number: int, tenths_s: int) -> Any:
        goal = ExecutePickPlace.Goal(proposal=PickPlace(id=number, step=tenths_s))
        return client.send_goal_async(goal, feedback_callback=lambda message: said.append(message.feedback.proposal_id))

    sending = [send(1, 600), send(2, 20), send(3, 600)]
    first, second, third = (peer.wait(sent, "answer to a goal") for sent in sending)
    assert first.accepted and second.accepted and third.accepted
    peer.until(lambda: set(said) == {1, 2, 3}, "feedback of all")

    def ended(handle: Any) -> tuple[int, int]:
        end = peer.wait(handle.get_result_async(), "result")
        return end.status, end.result.result.proposal_id

    # The one in the middle ends while the others run, and asking twice gives the same.
    assert ended(second) == (GoalStatus.STATUS_SUCCEEDED, 2)
    cancelled = peer.wait(third.cancel_goal_async(), "answer to the cancel")
    assert [bytes(info.goal_id.uuid) for info in cancelled.goals_canceling] == [bytes(third.goal_id.uuid)]
    assert ended(third) == (GoalStatus.STATUS_CANCELED, 3)
    # Another goal has come and gone before they are asked for again.
    fourth = peer.wait(send(4, 5), "answer to a goal")
    assert ended(fourth) == (GoalStatus.STATUS_SUCCEEDED, 4)
    assert ended(second) == (GoalStatus.STATUS_SUCCEEDED, 2)
    assert ended(third) == (GoalStatus.STATUS_CANCELED, 3)
    peer.wait(first.cancel_goal_async(), "answer to the cancel")
    assert ended(first) == (GoalStatus.STATUS_CANCELED, 1)
    client.destroy()


def test_a_service_answers_many_calls_at_once_and_the_first_one_too(echo: Process, domain: int) -> None:
    kind = GetParameters
    for number in range(4):
        with Peer(domain, f"caller_{number}") as caller:
            # Each peer is new to the server: the reply to a first call must not be lost.
            client = caller.client(kind, "served/rcl_interfaces/GetParameters")
            for _ in range(3):
                # rclpy keeps ten answers.
                futures = [client.call_async(kind.Request(names=[str(call)])) for call in range(8)]
                for future in futures:
                    caller.wait(future, "answer of each call")


# --- latched topics, restarts, names


def test_latched_messages_reach_late_joiners_both_ways(start, peer: Peer, domain: int) -> None:
    before = Reward(delta=0.25, total=3.0)
    # Nobody listens yet.
    publisher = peer.node.create_publisher(Reward, "late/latched", LATCHED)
    publisher.publish(before)
    start("interface_echo", "--ros-args", "-r", "__ns:=/late")
    early = peer.listen(Reward, "late/latched_echoed", LATCHED)
    peer.until(lambda: before in early, "latched message")
    # It is there: who comes now is late.
    with Peer(domain, "late_joiner") as late:
        received = late.listen(Reward, "late/latched_echoed", LATCHED)
        late.until(lambda: before in received, "latched message")
        assert len(received) == 1
    peer.node.destroy_publisher(publisher)


def test_a_node_comes_back_while_rclpy_stays(start, peer: Peer) -> None:
    client = peer.node.create_client(GetState, "/again/camera_fusion/get_state")
    for way_to_end in (signal.SIGKILL, signal.SIGTERM):
        process = start("camera_fusion", "--ros-args", "-r", "__ns:=/again")
        assert client.wait_for_service(60.0)
        # A killed node stands in the graph until its lease ends: requests go to both.
        peer.until(lambda: answers(peer, client), "answer")
        process.signal(way_to_end)
        process.wait(60.0)
    peer.node.destroy_client(client)


def answers(peer: Peer, client: Any) -> bool:
    try:
        return peer.wait(client.call_async(GetState.Request()), "answer", 2.0).current_state.label == "active"
    except TimeoutError:
        return False


def test_rclpy_comes_back_while_nodes_stay(echo: Process, domain: int) -> None:
    for number in range(3):
        with Peer(domain, "comes_and_goes") as visitor:
            received = visitor.listen(Reward, "echoed/sctn_msgs/Reward")
            publisher = visitor.speak(Reward, "echo/sctn_msgs/Reward")
            message = Reward(delta=float(number))

            def back(publisher=publisher, message=message, received=received) -> bool:
                publisher.publish(message)
                return message in received

            visitor.until(back, "echo")


def test_two_cells_live_in_one_domain_by_namespace_and_remap(start, peer: Peer) -> None:
    start("interface_echo", "--ros-args", "-r", "__ns:=/cell_a", "-r", "echoed/sctn_msgs/Reward:=/elsewhere")
    start("interface_echo", "--ros-args", "-r", "__ns:=/cell_b", "-r", "__node:=other_echo")
    wait_for_node(peer, "interface_echo", "/cell_a")
    wait_for_node(peer, "other_echo", "/cell_b")
    a, b = peer.listen(Reward, "/elsewhere"), peer.listen(Reward, "/cell_b/echoed/sctn_msgs/Reward")
    to_a = peer.speak(Reward, "/cell_a/echo/sctn_msgs/Reward")
    to_b = peer.speak(Reward, "/cell_b/echo/sctn_msgs/Reward")

    def both() -> bool:
        to_a.publish(Reward(delta=1.0))
        to_b.publish(Reward(delta=2.0))
        time.sleep(0.1)
        return bool(a and b)

    peer.until(both, "echo of both cells")
    assert {message.delta for message in a} == {1.0}
    assert {message.delta for message in b} == {2.0}
    # Private names follow the node's new name.
    services = peer.node.get_service_names_and_types_by_node
    peer.until(lambda: "/cell_b/other_echo/get_parameters" in dict(services("other_echo", "/cell_b")), "service of the new name")


def test_rclpy_sees_names_types_and_qos_of_the_graph(start, peer: Peer) -> None:
    start("camera_fusion", "--ros-args", "-r", "__ns:=/seen")
    wait_for_node(peer, "camera_fusion", "/seen")
    node = peer.node

    def offered() -> Any:
        # Names come after endpoints.
        found = node.get_publishers_info_by_topic("/seen/heightmap")
        return next((one for one in found if (one.node_name, one.node_namespace) == ("camera_fusion", "/seen")), None)

    heightmap = peer.until(offered, "publisher of the heightmap")
    assert heightmap.topic_type == "sctn_msgs/msg/Heightmap"
    assert heightmap.qos_profile.reliability == ReliabilityPolicy.RELIABLE
    assert heightmap.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    wanted = peer.until(lambda: node.get_subscriptions_info_by_topic("/seen/front/color/image_raw"), "image subscription")
    assert wanted[0].topic_type == "sensor_msgs/msg/Image"
    assert wanted[0].qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT

    def published() -> Any:
        return dict(node.get_publisher_names_and_types_by_node("camera_fusion", "/seen"))

    peer.until(lambda: "/seen/heightmap" in published(), "names of topics")
    assert published()["/seen/heightmap"] == ["sctn_msgs/msg/Heightmap"]

    def served() -> Any:
        return dict(node.get_service_names_and_types_by_node("camera_fusion", "/seen"))

    peer.until(lambda: "/seen/camera_fusion/change_state" in served(), "names of services")
    assert served()["/seen/camera_fusion/change_state"] == ["lifecycle_msgs/srv/ChangeState"]


def test_type_hashes_of_our_endpoints_are_not_told_over_dds(echo: Process, peer: Peer) -> None:
    """What docs/ros2.md says is missing. When this fails, the crates have learned it: say so there."""
    topic = "/echoed/sctn_msgs/Reward"
    (ours,) = peer.until(lambda: peer.node.get_publishers_info_by_topic(topic), "publisher")
    own = peer.node.create_publisher(Reward, "own_reward", RELIABLE)
    (theirs,) = peer.until(lambda: peer.node.get_publishers_info_by_topic("/own_reward"), "own publisher")
    assert str(theirs.topic_type_hash) != str(ours.topic_type_hash)
    peer.node.destroy_publisher(own)


# --- parameters


@pytest.fixture(scope="module")
def fusion(start_for_module, peer: Peer) -> str:
    """A node with parameters."""
    start_for_module("camera_fusion", "--ros-args", "-r", "__ns:=/parameters", "-p", "tolerance_s:=0.05")
    wait_for_node(peer, "camera_fusion", "/parameters")
    return "/parameters/camera_fusion"


def double(name: str, value: float) -> Parameter:
    return Parameter(name=name, value=ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value))


def words(key: str) -> str:
    """What the parameter file says about a parameter of two lines' comment or one."""
    lines = (REPOSITORY / "config/camera_fusion.yaml").read_text().splitlines()
    end = next(number for number, line in enumerate(lines) if line.strip().startswith(f"{key}:"))
    start = end
    while lines[start - 1].strip().startswith("#"):
        start -= 1
    return " ".join(line.strip().lstrip("# ") for line in lines[start:end])


def test_parameters_are_listed_described_and_got(fusion: str, peer: Peer) -> None:
    listed = peer.call(ListParameters, f"{fusion}/list_parameters").result
    assert {"use_sim_time", "autostart", "tolerance_s", "cameras", "workspace.rows"} <= set(listed.names)
    assert listed.prefixes == ["workspace"]
    request = ListParameters.Request(prefixes=["workspace"], depth=1)
    below = peer.call(ListParameters, f"{fusion}/list_parameters", request).result
    assert all(name.startswith("workspace.") for name in below.names) and below.names
    described = peer.call(DescribeParameters, f"{fusion}/describe_parameters", DescribeParameters.Request(names=listed.names)).descriptors
    assert [one.name for one in described] == list(listed.names)
    assert all(one.description for one in described)
    by_name = {one.name: one for one in described}
    tolerance, rows = by_name["tolerance_s"], by_name["workspace.rows"]
    assert tolerance.description == words("tolerance_s")
    assert not tolerance.read_only
    assert tolerance.floating_point_range[0].from_value == 0.0
    assert rows.read_only
    assert rows.integer_range[0].from_value == 1
    names = ["tolerance_s", "cameras", "no_such_parameter"]
    tolerance_s, cameras, unknown = peer.call(GetParameters, f"{fusion}/get_parameters", GetParameters.Request(names=names)).values
    assert (tolerance_s.double_value, list(cameras.string_array_value)) == (0.05, ["front", "left", "right"])
    assert unknown.type == ParameterType.PARAMETER_NOT_SET
    types = peer.call(GetParameterTypes, f"{fusion}/get_parameter_types", GetParameterTypes.Request(names=names)).types
    assert list(types) == [ParameterType.PARAMETER_DOUBLE, ParameterType.PARAMETER_STRING_ARRAY, 0]


def test_parameters_are_set_one_by_one_or_all_or_none_and_events_tell(fusion: str, peer: Peer) -> None:
    events = peer.listen(ParameterEvent, "/parameter_events")

    def heard() -> bool:
        # The first events may find nobody.
        request = SetParameters.Request(parameters=[double("tolerance_s", 0.04)])
        peer.call(SetParameters, f"{fusion}/set_parameters", request)
        return any(event.node == fusion for event in events) or time.sleep(0.1)

    peer.until(heard, "event of the node")
    good, too_small, fixed = double("tolerance_s", 0.03), double("camera_timeout_s", -1.0), double("workspace.z_max_m", 1.0)
    unknown = double("no_such_parameter", 1.0)
    wrong = Parameter(name="tolerance_s", value=ParameterValue(type=ParameterType.PARAMETER_STRING, string_value="x"))
    request = SetParameters.Request(parameters=[good, too_small, fixed, unknown, wrong])
    results = peer.call(SetParameters, f"{fusion}/set_parameters", request).results
    assert [result.successful for result in results] == [True, False, False, False, False]
    reasons = [result.reason for result in results]
    assert "camera_timeout_s" in reasons[1] and "-1" in reasons[1]
    assert "configured" in reasons[2]
    assert "no_such_parameter" in reasons[3]
    assert "expected a double" in reasons[4]

    def told(value: float) -> bool:
        changed = [one for event in events if event.node == fusion for one in event.changed_parameters]
        return any(one.name == "tolerance_s" and one.value.double_value == value for one in changed)

    peer.until(lambda: told(0.03), "event")

    def atomically(*parameters: Parameter) -> Any:
        request = SetParametersAtomically.Request(parameters=list(parameters))
        return peer.call(SetParametersAtomically, f"{fusion}/set_parameters_atomically", request).result

    assert not atomically(double("tolerance_s", 0.01), too_small).successful
    get = GetParameters.Request(names=["tolerance_s"])
    assert peer.call(GetParameters, f"{fusion}/get_parameters", get).values[0].double_value == 0.03
    assert atomically(double("tolerance_s", 0.01), double("camera_timeout_s", 3.0)).successful
    peer.until(lambda: told(0.01), "event")


# --- lifecycle


class Life:
    """The lifecycle of a node as a manager sees it."""

    def __init__(self, peer: Peer, node: str) -> None:
        self.peer, self.node = peer, node
        self.events = peer.listen(TransitionEvent, f"{node}/transition_event")

    def state(self) -> str:
        return self.peer.call(GetState, f"{self.node}/get_state").current_state.label

    def change(self, label: str = "", number: int = 0) -> bool:
        request = ChangeState.Request(transition=Transition(id=number, label=label))
        return self.peer.call(ChangeState, f"{self.node}/change_state", request).success

    def available(self) -> set[str]:
        transitions = self.peer.call(GetAvailableTransitions, f"{self.node}/get_available_transitions")
        return {one.transition.label for one in transitions.available_transitions}


def test_lifecycle_goes_through_all_transitions(start, peer: Peer) -> None:
    arguments = ("-r", "__ns:=/led", "-p", "autostart:=false")
    process = start("camera_fusion", "--ros-args", *arguments)
    wait_for_node(peer, "camera_fusion", "/led")
    life = Life(peer, "/led/camera_fusion")
    peer.until(lambda: peer.node.count_publishers("/led/camera_fusion/transition_event"), "events")
    # The node knows the listener, too, once it answers a client: discovery tells of endpoints in the order in which they were made.
    assert life.state() == "unconfigured"
    states = peer.call(GetAvailableStates, "/led/camera_fusion/get_available_states").available_states
    assert {one.id for one in states} >= {0, 1, 2, 3, 4, 10, 11, 12, 13, 14, 15}
    graph = peer.call(GetAvailableTransitions, "/led/camera_fusion/get_transition_graph").available_transitions
    assert len(graph) == 25
    assert life.available() == {"configure", "shutdown"}
    # What does not lead out of the present state is refused.
    assert not life.change("activate")
    images = "/led/front/color/image_raw"
    assert not peer.node.count_publishers("/led/heightmap")
    assert life.change("configure")
    assert life.state() == "inactive"
    assert life.available() == {"activate", "cleanup", "shutdown"}
    peer.until(lambda: peer.node.count_publishers("/led/heightmap"), "heightmap")
    # An inactive node hears nothing. (What it has taken back stands in rclpy's graph for a while: docs/ros2.md.)
    assert not peer.node.count_subscribers(images)
    for _ in range(2):
        assert life.change(number=Transition.TRANSITION_ACTIVATE)
        assert life.state() == "active"
        peer.until(lambda: peer.node.count_subscribers(images), "subscription")
        assert life.available() == {"deactivate", "shutdown"}
        assert life.change(number=Transition.TRANSITION_DEACTIVATE)
        assert life.state() == "inactive"
    assert life.change("cleanup")
    assert life.state() == "unconfigured"
    # A node that is not configured takes every parameter; one that cannot work is said when it is configured.
    calibration = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value="no/such/file.yaml")
    request = SetParameters.Request(parameters=[Parameter(name="calibration", value=calibration)])
    assert peer.call(SetParameters, "/led/camera_fusion/set_parameters", request).results[0].successful
    assert not life.change("configure")
    assert life.state() == "unconfigured"
    peer.until(lambda: "no/such/file.yaml" in process.errors(), "reason in the log")
    calibration.string_value = ""
    assert peer.call(SetParameters, "/led/camera_fusion/set_parameters", request).results[0].successful
    assert life.change("configure") and life.change("activate")
    assert life.change("shutdown")
    assert life.state() == "finalized"
    assert life.available() == set()
    peer.until(lambda: life.events and life.events[-1].goal_state.label == "finalized", "last event")
    way = [(event.start_state.label, event.goal_state.label) for event in life.events]
    round_trip = [("inactive", "activating"), ("activating", "active"), ("active", "deactivating"), ("deactivating", "inactive")]
    configured = [("unconfigured", "configuring"), ("configuring", "inactive")]
    assert way == [
        *configured,
        *round_trip,
        *round_trip,
        ("inactive", "cleaningup"),
        ("cleaningup", "unconfigured"),
        ("unconfigured", "configuring"),
        ("configuring", "unconfigured"),
        *configured,
        *round_trip[:2],
        ("active", "shuttingdown"),
        ("shuttingdown", "finalized"),
    ]
    assert {event.transition.id for event in life.events} == {1, 2, 3, 4, 7, 10, 11, 20, 30, 40, 50}
    process.signal(signal.SIGINT)
    assert process.wait(60.0) == 0


# --- time, logs, diagnostics, end


def test_simulated_time_stamps_what_a_node_says(start, peer: Peer) -> None:
    start("camera_fusion", "--ros-args", "-r", "__ns:=/timed", "-p", "use_sim_time:=true")
    wait_for_node(peer, "camera_fusion", "/timed")
    events = peer.listen(ParameterEvent, "/parameter_events")
    clock = peer.speak(Clock, "/clock", BEST_EFFORT)
    values = iter(range(1, 1000))

    def stamped() -> bool:
        clock.publish(Clock(clock=Time(sec=1234, nanosec=5)))
        parameter = double("tolerance_s", 0.001 * next(values))
        peer.call(SetParameters, "/timed/camera_fusion/set_parameters", SetParameters.Request(parameters=[parameter]))
        time.sleep(0.1)
        stamps = [event.stamp for event in events if event.node == "/timed/camera_fusion"]
        return Time(sec=1234, nanosec=5) in stamps

    peer.until(stamped, "event with the simulated time")
    peer.node.destroy_publisher(clock)


def test_logs_come_on_rosout_at_the_level_that_was_asked_for(start, peer: Peer) -> None:
    logs = peer.listen(Log, "/rosout")
    for namespace, level in (("/loud", "info"), ("/quiet", "error")):
        start("camera_fusion", "--ros-args", "-r", f"__ns:={namespace}", "--log-level", level)
        wait_for_node(peer, "camera_fusion", namespace)
    parameters = [double("no_such_parameter", 1.0)]

    def spoken() -> bool:
        for namespace in ("/loud", "/quiet"):
            request = SetParameters.Request(parameters=parameters)
            peer.call(SetParameters, f"{namespace}/camera_fusion/set_parameters", request)
        time.sleep(0.1)
        said = [log for log in logs if log.name == "loud.camera_fusion" and "no_such_parameter" in log.msg]
        # A byte in one distribution, a number in another.
        return bool(said) and said[0].level in (Log.INFO, *bytes([20]))

    peer.until(spoken, "log")
    assert not [log for log in logs if log.name == "quiet.camera_fusion"]


def test_diagnostics_tell_rates_ages_drops_and_the_last_error(start, peer: Peer) -> None:
    start("camera_fusion", "--ros-args", "-r", "__ns:=/ill")
    wait_for_node(peer, "camera_fusion", "/ill")
    arrays = peer.listen(DiagnosticArray, "/diagnostics")
    topic = "/ill/front/color/camera_info"
    calibrations = peer.speak(CameraInfo, topic, BEST_EFFORT)

    def told() -> bool:
        # Of a camera without size and focal length.
        calibrations.publish(CameraInfo())
        time.sleep(0.1)
        topics = [status for array in arrays for status in array.status if status.name == "/ill/camera_fusion: topics"]
        values = {one.key: one.value for one in topics[-1].values} if topics else {}
        line = values.get(topic, "")
        counts = re.fullmatch(r"in messages=(\d+) rate_hz=([\d.]+) age_s=([\d.]+) dropped=(\d+) errors=(\d+)", line)
        return bool(counts) and int(counts[5]) > 0 and float(counts[2]) > 1 and bool(values.get(f"{topic} last_error"))

    peer.until(told, "diagnostics of the topic")

    def state() -> str:
        return {one.name: one.message for array in arrays for one in array.status}["/ill/camera_fusion: lifecycle"]

    peer.until(lambda: state() == "active", "state in the diagnostics")


def test_a_qos_mismatch_is_said_with_both_ends_in_log_and_diagnostics(start, peer: Peer) -> None:
    process = start("interface_echo", "--ros-args", "-r", "__ns:=/apart")
    wait_for_node(peer, "interface_echo", "/apart")
    arrays = peer.listen(DiagnosticArray, "/diagnostics")
    # Our subscription is reliable, our publisher volatile.
    best_effort = peer.node.create_publisher(Reward, "/apart/echo/sctn_msgs/Reward", BEST_EFFORT)
    latched = peer.node.create_subscription(Reward, "/apart/echoed/sctn_msgs/Reward", lambda _: None, LATCHED)
    other_type = peer.node.create_publisher(PoseStamped, "/apart/echo/sctn_msgs/Goal", RELIABLE)

    def said() -> bool:
        errors = process.errors()
        return all(
            any(topic in line and reason in line and "/peer" in line for line in errors.splitlines())
            for topic, reason in (
                ("/apart/echo/sctn_msgs/Reward", "Reliability"),
                ("/apart/echoed/sctn_msgs/Reward", "Durability"),
                ("/apart/echo/sctn_msgs/Goal", "PoseStamped"),
            )
        )

    peer.until(said, "warnings")
    peer.until(
        lambda: [
            status
            for array in arrays
            for status in array.status
            if status.name == "/apart/interface_echo: graph" and "/peer" in status.message
        ],
        "diagnostics of the graph",
    )
    peer.node.destroy_publisher(best_effort)
    peer.node.destroy_subscription(latched)
    peer.node.destroy_publisher(other_type)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_node_cleanly(start, peer: Peer, number: signal.Signals) -> None:
    namespace = f"/ended_by_{number.name.lower()}"
    process = start("camera_fusion", "--ros-args", "-r", f"__ns:={namespace}")
    wait_for_node(peer, "camera_fusion", namespace)
    peer.until(lambda: peer.node.count_publishers(f"{namespace}/heightmap"), "heightmap")
    life = Life(peer, f"{namespace}/camera_fusion")
    peer.until(lambda: life.state() == "active", "active node")
    process.signal(number)
    assert process.wait(60.0) == 0
    assert "finalized" in process.errors()
    peer.until(
        lambda: (
            ("camera_fusion", namespace) not in peer.node.get_node_names_and_namespaces()
            and not peer.node.count_publishers(f"{namespace}/heightmap")
        ),
        "end of the node in rclpy's graph",
        5.0,
    )


def test_a_node_that_was_stopped_and_goes_on_answers_again(start, peer: Peer) -> None:
    process = start("camera_fusion", "--ros-args", "-r", "__ns:=/stopped")
    life = Life(peer, "/stopped/camera_fusion")
    peer.until(lambda: life.state() == "active", "active node")
    for _ in range(5):
        process.signal(signal.SIGSTOP)
        time.sleep(0.2)
        process.signal(signal.SIGCONT)
        assert life.state() == "active"


def test_parameter_files_reach_the_nodes_they_name(start, peer: Peer, tmp_path: pathlib.Path) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text(
        "/**:\n  ros__parameters:\n    tolerance_s: 0.5\n"
        "/filed/camera_fusion:\n  ros__parameters:\n    camera_timeout_s: 7.0\n"
        "/other/camera_fusion:\n  ros__parameters:\n    camera_timeout_s: 8.0\n"
    )
    start("camera_fusion", "--ros-args", "-r", "__ns:=/filed", "--params-file", file)
    wait_for_node(peer, "camera_fusion", "/filed")
    request = GetParameters.Request(names=["tolerance_s", "camera_timeout_s"])
    values = peer.call(GetParameters, "/filed/camera_fusion/get_parameters", request).values
    assert [value.double_value for value in values] == [0.5, 7.0]


def test_nodes_of_another_domain_are_not_seen(start, peer: Peer) -> None:
    other = free_domain()
    start("camera_fusion", "--ros-args", "-r", "__ns:=/far", domain=other)
    with Peer(other, "neighbour") as neighbour:
        wait_for_node(neighbour, "camera_fusion", "/far")
    assert ("camera_fusion", "/far") not in peer.node.get_node_names_and_namespaces()


# --- the table


def test_the_table_names_tests_that_exist() -> None:
    lines = (REPOSITORY / "docs/ros2.md").read_text().splitlines()
    begin = lines.index("| capability | what holds | tests |") + 2
    rows = lines[begin : lines.index("", begin)]
    pattern = r"(def|fn) [a-z0-9_]+"
    found = subprocess.run(
        ["git", "grep", "-hoE", pattern, "--", "*.py", "*.rs"], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    functions = {line.split()[1] for line in found.stdout.splitlines()}
    named = set()
    for row in rows:
        tests = re.findall(r"`([a-z0-9_]+)`", row.split("|")[3])
        assert tests, f"no test in the row {row}"
        assert set(tests) <= functions, f"no such test: {set(tests) - functions}"
        named.update(tests)
    own = {name for name in globals() if name.startswith("test_")} - {"test_the_table_names_tests_that_exist"}
    assert own <= named, f"in no row of the table: {own - named}"
