"""The cell of the fault campaign: simulated hardware as it is, executor, watchdog and monitor, on one host or on two."""

from __future__ import annotations

import contextlib
import dataclasses
import enum
import heapq
import itertools
import os
import pathlib
import signal
import tempfile
import time
from collections.abc import Callable, Iterator

from processes import REPOSITORY, Process, free_domain

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
os.environ.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(REPOSITORY / "config/fastdds.xml"))

import lossy_link
import numpy as np
from action_msgs.msg import GoalStatusArray
from builtin_interfaces.msg import Time
from cell_operator import EVENT, LATCHED, STREAM, Operator
from fault_monitor import Monitor
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sctn_msgs.msg import Heightmap, PickPlace, PlannedMotion, StepConfirmation, StepResult
from sctn_msgs.srv import ProposeHome
from sensor_msgs.msg import JointState
from test_refusals import Cell
from ur_msgs.msg import IOStates

OPERATOR = "end-to-end test"
# The arm has moved when a joint is so much further [rad].
MOVED_RAD = 0.02
# So long a proposal waits for its approval: the arm must not move.
UNDECIDED_S = 0.4
# Output that switches suction: suction_pin of the executor.
SUCTION_PIN = 16
# The driver's actions. The second one answers a goal after 1 to 2 s.
FOLLOW_ACTION = "scaled_joint_trajectory_controller/follow_joint_trajectory"
UNTIL_ACTION = "trajectory_until_node/execute"
# So much later the monitor hears of what was sent and done: by then all messages from before have come.
REORDER_S = 0.5
COUNTER = itertools.count()
# Every reading counts, also where this process is late.
ALL = QoSProfile(depth=500, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)
# Period of /clock where the campaign is its source.
CLOCK_PERIOD_S = 0.02


class CampaignCell(Cell):
    """What is published waits for nobody: an executor that was killed acknowledges nothing."""

    @staticmethod
    def _publish(publisher: Publisher, message: Heightmap | PickPlace) -> None:
        publisher.publish(message)


class Layout(enum.Enum):
    """Where the processes of a cell run, and whose time they have."""

    ONE_HOST = "one host"
    # The executor on a host of its own; driver, watchdog and operator on another.
    TWO_HOSTS = "two hosts"
    # The executor's time is that of /clock.
    CLOCK = "clock"


@dataclasses.dataclass
class Bench:
    """One cell, and what the campaign may do to it."""

    operator: Operator
    cell: Cell
    monitor: Monitor
    start: Callable[..., Process]
    layout: Layout
    logs: pathlib.Path
    driver: Process
    watchdog: Process
    executor: Process
    # To the executor's host, where that is another.
    link: lossy_link.Link | None = None
    # The newest proposal, which moves the arm when a fault comes.
    proposal: PickPlace | None = None
    suction: bool = False
    # What is wrong with the robot.
    fault: str = "none"
    # The proposal whose planned motion was said last.
    planned_id: int = 0
    # How far /clock is ahead of the wall clock [s].
    clock_ahead_s: float = 0.0
    # What was sent and done, by when [s], and what the monitor makes of it: it hears of it in that order, a little later.
    events: list[tuple[float, int, Callable[[], None]]] = dataclasses.field(default_factory=list)
    # When something was done that exposes a fault of the executor: a proposal, an injected fault [s].
    exposed_s: list[float] = dataclasses.field(default_factory=list)

    def positions(self) -> list[float]:
        """Where the joints are [rad]."""
        return list(self.operator.newest("joint_states").position)

    def has_moved(self, before: list[float]) -> bool:
        """Whether the arm has left a place."""
        return max(abs(a - b) for a, b in zip(self.positions(), before, strict=True)) > MOVED_RAD

    def exposed_by(self, now: float) -> float:
        """The last time before now at which something was done that exposes a fault [s]."""
        return max((time_s for time_s in self.exposed_s if time_s <= now), default=now)

    def stopped(self, limit_s: float, again: bool = False) -> None:
        """From now on the arm has so long to come to rest."""
        now = time.monotonic()
        self.happened(now, lambda: self.monitor.on_stop(now, limit_s, again))

    def void(self, proposal_id: int, reason: str) -> None:
        """An approval of this proposal must not move the arm from now on."""
        self.happened(time.monotonic(), lambda: self.monitor.on_void(proposal_id, reason))

    def happened(self, at_s: float, event: Callable[[], None]) -> None:
        """Something was sent or done. A busy machine delivers messages late, and those of one topic before those of another."""
        heapq.heappush(self.events, (at_s, next(COUNTER), event))
        self.settle(time.monotonic() - REORDER_S)

    def settle(self, until_s: float = float("inf")) -> None:
        """The monitor hears of everything that was sent or done before a time."""
        while self.events and self.events[0][0] <= until_s:
            heapq.heappop(self.events)[2]()

    def set_fault(self, fault: str) -> None:
        """Sets what is wrong with the simulated robot."""
        client = self.operator.node.create_client(SetParameters, "sim_workcell/set_parameters")
        self.operator.until(client.service_is_ready, "sim_workcell", 30.0)
        value = Parameter("hardware.fault", Parameter.Type.STRING, fault).to_parameter_msg()
        answer = client.call_async(SetParameters.Request(parameters=[value]))
        self.operator.until(answer.done, "answer of sim_workcell", 30.0)
        assert answer.result().results[0].successful, answer.result()
        self.fault = fault

    def start_executor(self) -> Process:
        """Starts an executor on its host."""
        values = {"use_sim_time": "true"} if self.layout is Layout.CLOCK else {}
        return self.start("suction_executor", *arguments("suction_executor", **values), prefix=self.link.prefix if self.link else None)

    def confirmation_readers(self) -> set[bytes]:
        """The endpoints that hear confirmations."""
        found = self.operator.node.get_subscriptions_info_by_topic("step_confirmation")
        return {bytes(reader.endpoint_gid) for reader in found}


def arguments(node: str, **values: object) -> list[object]:
    """The arguments of a node of the realistic cell."""
    files = [REPOSITORY / f"config/{node}.yaml", REPOSITORY / "config/hardware/realistic.yaml"]
    line: list[object] = ["--ros-args"]
    for file in files:
        line += ["--params-file", file]
    # The arm goes on from where a fault left it.
    if node == "suction_executor":
        values = {"observation_needs_home": "false", **values}
    for name, value in values.items():
        line += ["-p", f"{name}:={value}"]
    return line


def watch(bench: Bench) -> None:
    """Connects the monitor to what is said on the domain."""
    monitor = bench.monitor
    # Of the wall clock's origin, which messages are stamped with, on the monotonic clock [s].
    origin_s = time.monotonic() - time.time()

    def sent_at(info: dict[str, int]) -> float:
        """When a message was sent [s]."""
        return origin_s + 1e-9 * info["source_timestamp"]

    def on_confirmation(said: StepConfirmation) -> None:
        if said.decision == StepConfirmation.APPROVE:
            now = time.monotonic()
            bench.happened(now, lambda: monitor.on_approval(said.proposal_id, said.operator_name, now))

    def on_confirmation_of_others(said: StepConfirmation, info: dict[str, int]) -> None:
        if said.operator_name != OPERATOR and said.decision == StepConfirmation.APPROVE:
            bench.happened(sent_at(info), lambda: monitor.on_approval(said.proposal_id, said.operator_name, sent_at(info)))

    def on_proposal(made: PickPlace, info: dict[str, int]) -> None:
        bench.happened(sent_at(info), lambda: monitor.on_proposal(made.id))

    def on_result(result: StepResult, info: dict[str, int]) -> None:
        if result.outcome not in (StepResult.REFUSED, StepResult.REJECTED):
            bench.happened(sent_at(info), lambda: monitor.on_end(result.proposal_id, sent_at(info)))

    def on_plan(plan: PlannedMotion, info: dict[str, int]) -> None:
        bench.planned_id = plan.proposal_id
        bench.happened(sent_at(info), lambda: monitor.on_plan(plan.proposal_id))

    def on_pins(pins: IOStates, info: dict[str, int]) -> None:
        suction = any(output.pin == SUCTION_PIN and output.state for output in pins.digital_out_states)
        bench.suction = suction
        bench.happened(sent_at(info), lambda: monitor.on_suction(suction, sent_at(info)))

    def on_goals(action: str, goals: GoalStatusArray, info: dict[str, int]) -> None:
        statuses = {bytes(one.goal_info.goal_id.uuid): one.status for one in goals.status_list}
        late = action == UNTIL_ACTION
        bench.happened(sent_at(info), lambda: monitor.on_goals(action, statuses, sent_at(info), answers_late=late))

    def on_joints(read: JointState, info: dict[str, int]) -> None:
        bench.happened(sent_at(info), lambda: monitor.on_joints(read.position, sent_at(info)))

    def goals_of(action: str) -> Callable[[GoalStatusArray, dict[str, int]], None]:
        return lambda goals, info: on_goals(action, goals, info)

    node = bench.operator.node
    if bench.layout is Layout.CLOCK:
        clock = node.create_publisher(Clock, "/clock", STREAM)
        node.create_timer(CLOCK_PERIOD_S, lambda: clock.publish(Clock(clock=time_message(time.time() + bench.clock_ahead_s))))
    node.create_subscription(PickPlace, "pick_place", on_proposal, LATCHED)
    node.create_subscription(PlannedMotion, "planned_motion", on_plan, LATCHED)
    bench.operator.before_confirmation = on_confirmation
    node.create_subscription(StepConfirmation, "step_confirmation", on_confirmation_of_others, EVENT)
    node.create_subscription(StepResult, "step_result", on_result, EVENT)
    for action in (FOLLOW_ACTION, UNTIL_ACTION):
        node.create_subscription(GoalStatusArray, f"{action}/_action/status", goals_of(action), LATCHED)
    node.create_subscription(JointState, "joint_states", on_joints, ALL)
    node.create_subscription(IOStates, "io_and_status_controller/io_states", on_pins, STREAM)


def time_message(seconds: float) -> Time:
    """Seconds since 1970 as a message."""
    whole = int(seconds)
    return Time(sec=whole, nanosec=int(1e9 * (seconds - whole)))


@contextlib.contextmanager
def processes(domain: int, logs: pathlib.Path, variables: dict[str, str]) -> Iterator[Callable[..., Process]]:
    """Starts executables and ends them, also those that were frozen. A planted fault in the variables is one of the executor."""
    started: list[Process] = []

    def start(name: str, *line: object, prefix: list[str] | None = None) -> Process:
        if "SCTN_PLANTED_FAULT" in variables and name == "suction_executor":
            name = "suction_executor_planted"
        started.append(Process(name, [str(argument) for argument in line], domain, logs, variables, prefix))
        return started[-1]

    try:
        yield start
    finally:
        for process in reversed(started):
            if process.exit_code is None:
                process.signal(signal.SIGCONT)
            process.end()


@contextlib.contextmanager
def discovery(reach: str) -> Iterator[None]:
    """How far participants of this process look for others, while they are made."""
    before = os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"]
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = reach
    try:
        yield
    finally:
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = before


@contextlib.contextmanager
def working_cell(layout: Layout = Layout.ONE_HOST, planted: str | None = None, seed: int = 0) -> Iterator[Bench]:
    """A cell whose executor is ready, maybe with a planted fault. The seed draws which datagrams a link loses."""
    domain = free_domain()
    reach = "SUBNET" if layout is Layout.TWO_HOSTS else "LOCALHOST"
    variables = {"ROS_AUTOMATIC_DISCOVERY_RANGE": reach, **({"SCTN_PLANTED_FAULT": planted} if planted else {})}
    with contextlib.ExitStack() as stack:
        link = stack.enter_context(lossy_link.second_host(seed)) if layout is Layout.TWO_HOSTS else None
        logs = pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory()))
        start = stack.enter_context(processes(domain, logs, variables))
        with discovery(reach):
            operator = stack.enter_context(Operator(domain))
        driver = start("sim_workcell", *arguments("sim_workcell", seed=10000))
        watchdog = start("motion_watchdog", "--ros-args", "--params-file", REPOSITORY / "config/motion_watchdog.yaml")
        cell = CampaignCell(operator)
        bench = Bench(operator, cell, Monitor(OPERATOR), start, layout, logs, driver, watchdog, watchdog, link)
        watch(bench)
        bench.executor = bench.start_executor()
        cell.wait_until_ready()
        operator.until(lambda: "motion_watchdog" in operator.node.get_node_names(), "watchdog", 30.0)
        # The executor, and the monitor.
        operator.listeners = 2
        operator.spin(0.5)
        yield bench


def begin(bench: Bench) -> str:
    """An approval of a new proposal moves the arm, or is refused for a reason."""
    operator = bench.operator
    bench.proposal = propose(bench)
    bench.exposed_s.append(time.monotonic())
    before = bench.positions()
    operator.spin(UNDECIDED_S)
    after = operator.count("step_result")
    operator.confirm(bench.proposal.id, StepConfirmation.APPROVE)

    def outcome() -> str | None:
        answers = [result for result in operator.received["step_result"][after:] if result.proposal_id == bench.proposal.id]
        if answers and answers[-1].outcome == StepResult.REFUSED:
            return f"refused: {answers[-1].reason}"
        if answers:
            return f"ended with outcome {answers[-1].outcome}: {answers[-1].reason}"
        return "moves" if bench.has_moved(before) else None

    return operator.until(outcome, "motion or refusal", 30.0)


def recover(bench: Bench) -> None:
    """After a fault: clock and network are in order, an executor that is dead is started again, the robot is ready again."""
    operator = bench.operator
    bench.clock_ahead_s = 0.0
    if bench.link:
        bench.link.lose(0.0)
    if bench.executor.exit_code is not None:
        before = bench.confirmation_readers()
        bench.executor = bench.start_executor()
        operator.until(lambda: bench.confirmation_readers() - before, "executor that was started again", 30.0)
    if bench.fault == "driver_dead":
        bench.happened(time.monotonic(), bench.monitor.on_lost_sight)
    bench.set_fault("none")
    operator.states.clear()
    operator.until(operator.executor_is_ready, "executor that is ready again", 60.0)
    operator.spin(0.5)


def propose_home(bench: Bench) -> ProposeHome.Response:
    """Has the way home proposed."""
    client = bench.operator.node.create_client(ProposeHome, "suction_executor/propose_home")
    bench.operator.until(client.service_is_ready, "service propose_home", 30.0)
    answer = client.call_async(ProposeHome.Request())
    bench.operator.until(answer.done, "answer of propose_home", 30.0)
    return answer.result()


def go_home(bench: Bench) -> bool:
    """Brings the arm home by an approved proposal; whether it got there."""
    home = propose_home(bench)
    if not home.success:
        return False
    # The monitor has to know of it.
    bench.operator.spin(0.2)
    after = bench.operator.count("step_result")
    bench.operator.confirm(home.proposal_id, StepConfirmation.APPROVE)
    end = bench.operator.next("step_result", after, lambda result: result.proposal_id == home.proposal_id)
    return end.outcome == StepResult.AT_HOME


def propose(bench: Bench, change: Callable[[PickPlace], None] = lambda _: None) -> PickPlace:
    """A proposal that the executor has heard, from a heightmap of now.

    The table is there: black at height 0 is what no camera has seen.
    """
    operator = bench.operator

    def look(heightmap: Heightmap) -> None:
        heightmap.rgb = np.full(len(heightmap.rgb), 90, dtype=np.uint8)
        heightmap.header.stamp = operator.newest("joint_states").header.stamp

    proposal = bench.cell.propose(bench.cell.observe(look), change)
    # An executor that was killed acknowledges nothing: the present one says what it makes of the proposal.
    operator.until(lambda: bench.planned_id == proposal.id, "planned motion", 30.0)
    return proposal
