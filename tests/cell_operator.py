"""An operator as an rclpy node: it keeps every message it receives and speaks by topic only."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sctn_msgs.msg import Goal, Heightmap, PickPlace, Reward, StepConfirmation, StepResult
from sensor_msgs.msg import JointState

LATCHED = QoSProfile(
    depth=1,
    history=HistoryPolicy.KEEP_LAST,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
EVENT = QoSProfile(
    depth=10,
    history=HistoryPolicy.KEEP_LAST,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)
STREAM = QoSProfile(depth=5, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT)

# Who decides.
NAME = "end-to-end test"

TOPICS = {
    "heightmap": (Heightmap, LATCHED),
    "goal": (Goal, LATCHED),
    "pick_place": (PickPlace, LATCHED),
    "step_result": (StepResult, EVENT),
    "reward": (Reward, EVENT),
    "joint_states": (JointState, STREAM),
    "clock": (Clock, STREAM),
}

Message = TypeVar("Message")


class Operator:
    """Subscribes to all topics of a run on one domain; a context manager."""

    def __init__(self, domain: int, name: str = "operator", topics: Iterable[str] = TOPICS) -> None:
        """Keeps all messages of these topics."""
        # How many nodes have to hear a confirmation; more where the whole graph runs.
        self.listeners = 1
        # Is called with each confirmation before it is sent.
        self.before_confirmation: Callable[[StepConfirmation], None] = lambda _: None
        self.received: dict[str, list[Any]] = {topic: [] for topic in TOPICS}
        # What each node says of itself, by name.
        self.states: dict[str, DiagnosticStatus] = {}
        self._context = rclpy.Context()
        self._context.init(domain_id=domain)
        self.node = rclpy.create_node(name, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        for topic in topics:
            message_type, qos = TOPICS[topic]
            self.node.create_subscription(message_type, topic, self.received[topic].append, qos)
        self.node.create_subscription(
            DiagnosticArray, "/diagnostics", lambda said: self.states.update({one.name: one for one in said.status}), EVENT
        )
        self._confirmations = self.node.create_publisher(StepConfirmation, "step_confirmation", EVENT)

    def __enter__(self) -> Operator:
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()

    def spin(self, seconds: float) -> None:
        """Receives for a while."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)

    def until(self, condition: Callable[[], Message | None], what: str, timeout_s: float) -> Message:
        """Receives until `condition` returns something true, and returns that."""
        end = time.monotonic() + timeout_s
        while not (found := condition()):
            if time.monotonic() > end:
                counts = {topic: len(messages) for topic, messages in self.received.items()}
                raise TimeoutError(f"no {what} within {timeout_s} s; messages received: {counts}")
            self._executor.spin_once(timeout_sec=0.1)
        return found

    def next(self, topic: str, after: int = 0, accept: Callable[[Any], bool] = lambda _: True, timeout_s: float = 120.0) -> Any:
        """The first message of a topic, from the `after`th on, that is accepted."""
        messages = self.received[topic]
        return self.until(lambda: next((message for message in messages[after:] if accept(message)), None), f"{topic} message", timeout_s)

    def count(self, topic: str) -> int:
        """How many messages of a topic have come."""
        return len(self.received[topic])

    def newest(self, topic: str) -> Any:
        """The newest message of a topic."""
        return self.received[topic][-1]

    def diagnosed(self, state: str) -> dict[str, str]:
        """The values of a state in the diagnostics, such as `goal_oracle: topics`."""
        said = self.states.get(f"/{state}")
        return {value.key: value.value for value in said.values} if said else {}

    def has_heard(self, node: str, topic: str) -> bool:
        """Whether a message has reached a node, by its diagnostics."""
        return re.match("in messages=[1-9]", self.diagnosed(f"{node}: topics").get(topic, "")) is not None

    def executor_is_ready(self) -> bool:
        """Whether the executor hears the driver, and would move."""
        driver = self.states.get("/suction_executor: driver")
        return driver is not None and driver.message == "ready"

    def confirm(self, proposal_id: int, decision: int, name: str = NAME) -> None:
        """Says one word on a proposal."""
        self._confirm_when_heard()
        message = StepConfirmation(proposal_id=proposal_id, decision=decision, operator_name=name)
        if self.received["clock"]:
            message.header.stamp = self.newest("clock").clock
        self.before_confirmation(message)
        self._confirmations.publish(message)

    def approve(self, proposal: PickPlace) -> StepResult:
        """Approves a proposal and returns what became of it."""
        after = self.count("step_result")
        self.confirm(proposal.id, StepConfirmation.APPROVE)
        return self.next("step_result", after, lambda result: result.proposal_id == proposal.id)

    def _confirm_when_heard(self) -> None:
        # A volatile message to nobody is lost.
        self.until(
            lambda: self._confirmations.get_subscription_count() >= self.listeners,
            "subscription to step_confirmation",
            timeout_s=60.0,
        )


def nanoseconds(stamp: Any) -> int:
    """A builtin_interfaces/Time or Duration as one number."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec
