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
import uuid
from collections.abc import Callable, Iterator

from processes import REPOSITORY, Process, free_domain

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
os.environ.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(REPOSITORY / "config/fastdds.xml"))

import lossy_link
import numpy as np
from action_msgs.msg import GoalStatusArray
from builtin_interfaces.msg import Time
from cell_operator import EVENT, LATCHED, NAME, STREAM, Operator
from fault_monitor import Monitor
from geometry_msgs.msg import Pose2D
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sctn_msgs.msg import Goal, Heightmap, PickPlace, PlannedMotion, StepConfirmation, StepResult
from sctn_msgs.srv import ProposeHome, SetStep
from sensor_msgs.msg import JointState
from test_refusals import Cell
from ur_msgs.msg import IOStates
from whole_run import OBSERVATION_MAX_AGE_S, STATUS_MAX_AGE_S

# The arm has moved when a joint is so much further [rad].
MOVED_RAD = 0.02
# So long a proposal waits for its approval: the arm must not move.
UNDECIDED_S = 0.4
# Output that switches suction, and input of the vacuum sensor: suction_pin and vacuum_pin of the executor.
SUCTION_PIN = VACUUM_PIN = 16
# Disks of placing with seed 10000, in the order in which they are used, and free places of the table for them.
DISKS = [(0.3219, -0.1542), (0.5851, -0.1614), (0.4123, -0.1593), (0.6608, -0.1550), (0.3627, 0.1716), (0.6776, 0.1589), (0.4336, 0.1578)]
FREE_PLACES = [(x_m, y_m) for y_m in (-0.33, 0.33) for x_m in (0.38, 0.48, 0.58, 0.65)]
DISK_RADIUS_M, DISK_HEIGHT_M = 0.028, 0.012
# The goals of the oracle.
DEMONSTRATION = REPOSITORY / "bags/sample/placing"
# What the whole graph has beside driver, watchdog, executor and oracle, and whether it hears confirmations.
GRAPH = {"camera_fusion": False, "gctn_policy": True, "operator_console": True}
# Images come so often in the whole graph [s]: enough for the faults, and the processors are not busy with them.
FRAMES_PERIOD_S = 0.1
# The policy has proposed by then what the executor can plan, also where the oracle was just started again.
PROPOSED_S = 60.0
# A step that was confirmed is counted by then.
COUNTED_S = 15.0
# The driver's actions. The second one answers a goal after 1 to 2 s.
CONTROLLER = "scaled_joint_trajectory_controller"
FOLLOW_ACTION = f"{CONTROLLER}/follow_joint_trajectory"
UNTIL_ACTION = "trajectory_until_node/execute"
# So much later the monitor hears of what was sent and done, and no sooner than readings of that time have come: by then all messages from
# before have.
REORDER_S = 0.5
# A driver that is not heard for so long has nothing to say. On a machine that is too busy its readings come seconds late.
SILENT_S = 5.0
# Messages that come seldom arrive within this time of the readings.
LAST_MESSAGES_S = 0.2
# A step is tried again so often where somebody was not heard in time, the driver by the executor or the executor by the watchdog, and
# what is said then.
ATTEMPTS = 5
UNHEARD = ("s old, expected at most", "were interrupted for more than", "ended as Canceled")
# After a cancel the watchdog cancels everything for so long: insist_s of config/motion_watchdog.yaml.
INSIST_S = 3.0
COUNTER = itertools.count()
# Every reading counts, also where this process is late.
ALL = QoSProfile(depth=500, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)
# Period of /clock where the campaign is its source.
CLOCK_PERIOD_S = 0.02


# The value of a parameter of the simulated hardware.
Hardware = float | int | str | list[str]


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
    # Cameras, fusion, policy, oracle and page run too: the policy proposes.
    WHOLE_GRAPH = "whole graph"


@dataclasses.dataclass
class Bench:
    """One cell, and what the campaign may do to it."""

    operator: Operator
    cell: Cell
    monitor: Monitor
    start: Callable[..., Process]
    layout: Layout
    logs: pathlib.Path
    driver: Process | None = None
    watchdog: Process | None = None
    executor: Process | None = None
    # Whether a heightmap counts only where the arm has been at home since.
    needs_home: bool = False
    # Once a step is to be counted.
    oracle: Process | None = None
    # The others of the whole graph, by name.
    graph: dict[str, Process] = dataclasses.field(default_factory=dict)
    # To the executor's host, where that is another.
    link: lossy_link.Link | None = None
    # The newest proposal, which moves the arm when a fault comes.
    proposal: PickPlace | None = None
    suction: bool = False
    vacuum: bool = False
    # What is wrong with the robot.
    fault: str = "none"
    # Disks that were picked.
    disks_used: int = 0
    # Where the joints are at home, once the arm was brought there [rad].
    home_rad: list[float] | None = None
    # What was changed of the simulated hardware, and what it was.
    changed: dict[str, Hardware] = dataclasses.field(default_factory=dict)
    # The proposal whose planned motion was said last.
    planned_id: int = 0
    # How far /clock is ahead of the wall clock [s].
    clock_ahead_s: float = 0.0
    # What was sent and done, by when [s], and what the monitor makes of it: it hears of it in that order, a little later.
    events: list[tuple[float, int, Callable[[], None]]] = dataclasses.field(default_factory=list)
    # When the newest readings that have come were sent [s].
    joints_read_s: float = float("-inf")
    pins_read_s: float = float("-inf")
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
        now = time.monotonic()
        read_s = max(min(self.joints_read_s, self.pins_read_s), now - SILENT_S)
        self.settle(min(read_s, now - REORDER_S))

    def catch_up(self) -> None:
        """The monitor hears of everything that was sent or done until now, which may be on its way."""
        now = time.monotonic()
        with contextlib.suppress(TimeoutError):
            self.operator.until(lambda: min(self.joints_read_s, self.pins_read_s) >= now, "readings of the driver", SILENT_S)
        self.operator.spin(LAST_MESSAGES_S)
        self.settle()

    def settle(self, until_s: float = float("inf")) -> None:
        """The monitor hears of everything that was sent or done before a time."""
        while self.events and self.events[0][0] <= until_s:
            heapq.heappop(self.events)[2]()

    def set_hardware(self, name: str, value: Hardware, usual: Hardware) -> None:
        """Sets a parameter of the simulated hardware, which usually has another value."""
        kinds = {
            str: Parameter.Type.STRING,
            int: Parameter.Type.INTEGER,
            float: Parameter.Type.DOUBLE,
            list: Parameter.Type.STRING_ARRAY,
        }
        parameter = Parameter(f"hardware.{name}", kinds[type(value)], value).to_parameter_msg()
        answer = self.call(SetParameters, "sim_workcell/set_parameters", SetParameters.Request(parameters=[parameter]))
        assert answer.results[0].successful, answer
        self.changed[name] = usual
        if value == usual:
            del self.changed[name]

    def set_fault(self, fault: str) -> None:
        """Sets what is wrong with the simulated robot."""
        self.set_hardware("fault", fault, "none")
        self.fault = fault

    def call(self, kind: type, name: str, request: object) -> object:
        """Calls a service once."""
        client = self.operator.node.create_client(kind, name)
        try:
            self.operator.until(client.service_is_ready, f"service {name}", 30.0)
            answer = client.call_async(request)
            self.operator.until(answer.done, f"answer of {name}", 30.0)
            return answer.result()
        finally:
            self.operator.node.destroy_client(client)

    def start_driver(self) -> None:
        """Starts the simulated cell, with an arm at home."""
        values: dict[str, object] = {"seed": 10000}
        if self.layout is Layout.WHOLE_GRAPH:
            values["frames_period_s"] = FRAMES_PERIOD_S
        self.driver = self.start("sim_workcell", *arguments("sim_workcell", **values))

    def start_watchdog(self) -> None:
        """Starts the watchdog."""
        self.watchdog = self.start("motion_watchdog", "--ros-args", "--params-file", REPOSITORY / "config/motion_watchdog.yaml")

    def start_executor(self) -> Process:
        """Starts an executor on its host."""
        values: dict[str, object] = {
            "observation_needs_home": str(self.needs_home).lower(),
            "operators": f'["{NAME}"]',
            "driver.status_max_age_s": STATUS_MAX_AGE_S,
            "observation_max_age_s": OBSERVATION_MAX_AGE_S,
        }
        if self.layout is Layout.CLOCK:
            values["use_sim_time"] = "true"
        return self.start("suction_executor", *arguments("suction_executor", **values), prefix=self.link.prefix if self.link else None)

    def start_oracle(self) -> None:
        """Starts a goal oracle, on the driver's host."""
        values = ["-p", f"demonstration:={DEMONSTRATION}"]
        after = self.operator.count("goal")
        self.oracle = self.start("goal_oracle", *arguments("goal_oracle"), *values)
        self.operator.next("goal", after, timeout_s=60.0)
        # It hears confirmations too.
        self.operator.listeners += 1

    def start_in_graph(self, name: str) -> None:
        """Starts a node of the whole graph, on the driver's host."""
        values: dict[str, dict[str, object]] = {
            "camera_fusion": {},
            "gctn_policy": {"checkpoint": REPOSITORY / "config/checkpoints/ten_problems.safetensors"},
            "operator_console": {"port": 0, "library": self.logs / "library", "training": self.logs / "training"},
        }
        self.graph[name] = self.start(name, *arguments(name, **values[name]))
        self.operator.listeners += GRAPH[name]

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
        # Who decides is heard of before the executor can be.
        if said.operator_name == NAME:
            hear(said, time.monotonic())

    def on_confirmation_of_others(said: StepConfirmation, info: dict[str, int]) -> None:
        if said.operator_name != NAME:
            hear(said, sent_at(info))

    def hear(said: StepConfirmation, at_s: float) -> None:
        match said.decision:
            case StepConfirmation.APPROVE:
                bench.happened(at_s, lambda: monitor.on_approval(said.proposal_id, said.operator_name, at_s))
            case StepConfirmation.ADVANCE:
                bench.happened(at_s, lambda: monitor.on_advance(said.proposal_id, said.operator_name, at_s))

    def on_proposal(made: PickPlace, info: dict[str, int]) -> None:
        bench.happened(sent_at(info), lambda: monitor.on_proposal(made.id))

    def on_result(result: StepResult, info: dict[str, int]) -> None:
        if result.outcome not in (StepResult.REFUSED, StepResult.REJECTED):
            bench.happened(sent_at(info), lambda: monitor.on_end(result.proposal_id, sent_at(info)))
        if result.outcome == StepResult.PLACED:
            bench.happened(sent_at(info), lambda: monitor.on_placed(result.proposal_id, sent_at(info)))

    def on_goal(goal: Goal, info: dict[str, int]) -> None:
        bench.happened(sent_at(info), lambda: monitor.on_goal(goal.step, sent_at(info)))

    def on_plan(plan: PlannedMotion, info: dict[str, int]) -> None:
        bench.planned_id = plan.proposal_id
        bench.happened(sent_at(info), lambda: monitor.on_plan(plan.proposal_id))

    def on_pins(pins: IOStates, info: dict[str, int]) -> None:
        suction = any(output.pin == SUCTION_PIN and output.state for output in pins.digital_out_states)
        bench.suction = suction
        bench.vacuum = any(sensor.pin == VACUUM_PIN and sensor.state for sensor in pins.digital_in_states)
        bench.pins_read_s = sent_at(info)
        bench.happened(sent_at(info), lambda: monitor.on_suction(suction, sent_at(info)))

    def on_goals(action: str, goals: GoalStatusArray, info: dict[str, int]) -> None:
        statuses = {bytes(one.goal_info.goal_id.uuid): one.status for one in goals.status_list}
        late = action == UNTIL_ACTION
        bench.happened(sent_at(info), lambda: monitor.on_goals(action, statuses, sent_at(info), answers_late=late))

    def on_joints(read: JointState, info: dict[str, int]) -> None:
        bench.joints_read_s = sent_at(info)
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
    node.create_subscription(Goal, "goal", on_goal, LATCHED)
    for action in (FOLLOW_ACTION, UNTIL_ACTION):
        node.create_subscription(GoalStatusArray, f"{action}/_action/status", goals_of(action), LATCHED)
    node.create_subscription(JointState, "joint_states", on_joints, ALL)
    node.create_subscription(IOStates, "io_and_status_controller/io_states", on_pins, ALL)


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
def working_cell(layout: Layout = Layout.ONE_HOST, planted: str | None = None, seed: int = 0, needs_home: bool = False) -> Iterator[Bench]:
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
        cell = CampaignCell(operator)
        bench = Bench(operator, cell, Monitor(NAME), start, layout, logs, link=link, needs_home=needs_home)
        bench.start_driver()
        bench.start_watchdog()
        watch(bench)
        bench.executor = bench.start_executor()
        cell.wait_until_ready()
        operator.until(lambda: "motion_watchdog" in operator.node.get_node_names(), "watchdog", 30.0)
        # The executor, and the monitor.
        operator.listeners = 2
        if layout is Layout.WHOLE_GRAPH:
            bench.start_oracle()
            for name in GRAPH:
                bench.start_in_graph(name)
        operator.spin(0.5)
        yield bench


def begin(bench: Bench, make: Callable[[Bench], PickPlace] | None = None) -> str:
    """An approval of a new proposal moves the arm, or is refused for a reason."""
    operator = bench.operator
    bench.proposal = (make or propose)(bench)
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


def begin_from_home(bench: Bench) -> str:
    """The same; where the arm cannot begin from where it stands it goes home first."""
    # The policy proposes what the cameras have seen while the arm was at home.
    went_on = "the cameras see the arm" if bench.layout is Layout.WHOLE_GRAPH else begin(bench)
    if went_on == "moves":
        return went_on
    # From where a fault has left it the arm may not get to the pick, or may be in view.
    if reason := go_home(bench):
        return f"stays, and does not get home: {reason} (before: {went_on})"
    again = begin(bench)
    return f"moves from home ({went_on})" if again == "moves" else f"stays: {again}"


def recover(bench: Bench) -> None:
    """After a fault: clock and network are in order, what is dead is started again, the robot is ready again."""
    operator = bench.operator
    bench.clock_ahead_s = 0.0
    if bench.link:
        bench.link.lose(0.0)
    if bench.watchdog.exit_code is not None:
        bench.start_watchdog()
    if bench.driver.exit_code is not None:
        bench.changed.clear()
        bench.happened(time.monotonic(), bench.monitor.on_new_driver)
        bench.start_driver()
    if bench.fault == "driver_dead":
        bench.happened(time.monotonic(), bench.monitor.on_lost_sight)
    for name, usual in list(bench.changed.items()):
        bench.set_hardware(name, usual, usual)
    bench.fault = "none"
    if bench.oracle and bench.oracle.exit_code is not None:
        bench.start_oracle()
    for name, node in list(bench.graph.items()):
        if node.exit_code is not None:
            bench.start_in_graph(name)
    if bench.executor.exit_code is not None:
        before = bench.confirmation_readers()
        bench.executor = bench.start_executor()
        operator.until(lambda: bench.confirmation_readers() - before, "executor that was started again", 30.0)
    operator.states.clear()
    operator.until(operator.executor_is_ready, "executor that is ready again", 60.0)
    operator.spin(0.5)


def propose_home(bench: Bench, service: str = "propose_home") -> ProposeHome.Response:
    """Has the way home proposed, or that what is held is put down first: propose_put_down."""
    return bench.call(ProposeHome, f"suction_executor/{service}", ProposeHome.Request())


def go_home(bench: Bench) -> str:
    """Brings the arm home by an approved proposal; why it did not get there, if it did not."""
    for _ in range(ATTEMPTS):
        reason = get_home(bench, propose_home(bench, way_home(bench)))
        if not is_unheard(bench, reason):
            break
    return reason


def way_home(bench: Bench) -> str:
    """The service that proposes it: the policy proposes another part, so that what is held is put down first."""
    return "propose_put_down" if bench.vacuum and bench.layout is Layout.WHOLE_GRAPH else "propose_home"


def get_home(bench: Bench, proposed: ProposeHome.Response) -> str:
    """Approves a way that ends at home; why the arm did not get there, if it did not."""
    if not proposed.success:
        return proposed.message
    # The monitor has to know of it.
    bench.operator.spin(0.2)
    after = bench.operator.count("step_result")
    bench.operator.confirm(proposed.proposal_id, StepConfirmation.APPROVE)
    end = bench.operator.next("step_result", after, lambda result: result.proposal_id == proposed.proposal_id)
    if end.outcome != StepResult.AT_HOME:
        return end.reason
    wait_for_readings_after(bench, end)
    bench.home_rad = bench.positions()
    return ""


def wait_for_readings_after(bench: Bench, end: StepResult) -> None:
    """What is seen from now on is from after the end of a motion."""

    def seconds(stamp: Time) -> tuple[int, int]:
        return stamp.sec, stamp.nanosec

    bench.operator.until(
        lambda: seconds(bench.operator.newest("joint_states").header.stamp) > seconds(end.header.stamp), "readings after a motion", 30.0
    )


def is_unheard(bench: Bench, reason: str) -> bool:
    """Whether somebody was not heard in time, as where the machine is too busy: the arm has to stop then. Waits until it may move again."""
    unheard = any(words in reason for words in UNHEARD)
    if unheard:
        bench.operator.spin(INSIST_S)
    return unheard


def carried_out(bench: Bench, attempt: Callable[[Bench], StepResult]) -> StepResult:
    """How a step ends; it is tried again where the executor has not heard the driver in time."""
    for _ in range(ATTEMPTS):
        end = attempt(bench)
        if end.outcome != StepResult.FAULT or not is_unheard(bench, end.reason):
            break
    return end


def propose(bench: Bench, change: Callable[[PickPlace], None] = lambda _: None, disk: tuple[float, float] | None = None) -> PickPlace:
    """A proposal that the executor has heard, from a heightmap of now, with a disk where there is one.

    The table is there: black at height 0 is what no camera has seen.
    """
    operator = bench.operator
    if bench.layout is Layout.WHOLE_GRAPH:
        return proposal_of_policy(bench)

    def look(heightmap: Heightmap) -> None:
        heightmap.rgb = np.full(len(heightmap.rgb), 90, dtype=np.uint8)
        heightmap.header.stamp = operator.newest("joint_states").header.stamp
        if disk:
            rows, cols = np.mgrid[: heightmap.rows, : heightmap.cols]
            x_m = heightmap.origin.x + (cols + 0.5) * heightmap.pixel_size_m
            y_m = heightmap.origin.y + (rows + 0.5) * heightmap.pixel_size_m
            is_disk = np.hypot(x_m - disk[0], y_m - disk[1]) < DISK_RADIUS_M
            heightmap.height_m = np.where(is_disk, DISK_HEIGHT_M, 0.0).astype(np.float32).ravel()

    proposal = bench.cell.propose(bench.cell.observe(look), change)
    # An executor that was killed acknowledges nothing: the present one says what it makes of the proposal.
    operator.until(lambda: bench.planned_id == proposal.id, "planned motion", 30.0)
    return proposal


def proposal_of_policy(bench: Bench) -> PickPlace:
    """What the policy proposes for the oracle's first goal, once the executor has planned it."""
    goal = first_goal(bench)

    def proposal() -> PickPlace | None:
        made = [made for made in bench.operator.received["pick_place"][-1:] if (made.step, made.attempt) == (goal.step, goal.attempt)]
        return made[0] if made and made[0].id == bench.planned_id else None

    return bench.operator.until(proposal, "planned proposal of the policy", PROPOSED_S)


def begin_with_disk(bench: Bench) -> None:
    """The arm goes home and begins the next step of the oracle's first goal: a disk that was not picked yet goes to a free place."""
    bench.operator.spin(0.6)
    for _ in range(ATTEMPTS):
        reason = begin_next_disk(bench)
        if not is_unheard(bench, reason):
            break
    assert not reason, f"the step of a disk does not begin: {reason}"


def begin_next_disk(bench: Bench) -> str:
    """The same, once; why it did not begin, if it did not."""
    # What is left from an attempt is put down first.
    reason = get_home(bench, propose_home(bench, "propose_put_down" if bench.vacuum else "propose_home"))
    if reason:
        return reason
    goal = first_goal(bench)
    disk, place = DISKS[bench.disks_used % len(DISKS)], FREE_PLACES[bench.disks_used % len(FREE_PLACES)]
    bench.disks_used += 1

    def of_goal(proposal: PickPlace) -> None:
        proposal.problem, proposal.step, proposal.attempt, proposal.module = goal.problem, goal.step, goal.attempt, goal.module
        proposal.pick = Pose2D(x=disk[0], y=disk[1], theta=0.0)
        proposal.place = Pose2D(x=place[0], y=place[1], theta=0.0)

    began = begin(bench, lambda bench: propose(bench, of_goal, disk))
    return "" if began == "moves" else began


def first_goal(bench: Bench) -> Goal:
    """Has the oracle publish its first goal again, with an attempt of its own."""
    if not bench.oracle:
        bench.start_oracle()
    after = bench.operator.count("goal")
    request = SetStep.Request(request_id=str(uuid.uuid4()), step=1)
    answer = bench.call(SetStep, "goal_oracle/set_step", request)
    assert answer.success and answer.step == 1, answer
    newest = bench.operator.newest("goal")
    if (newest.step, newest.attempt) == (1, answer.attempt):
        return newest
    return bench.operator.next("goal", after, lambda goal: (goal.step, goal.attempt) == (1, answer.attempt))


def end_of_step(bench: Bench) -> StepResult:
    """What the executor says of the proposal that moves, at its end."""
    proposal_id = bench.proposal.id
    return bench.operator.next("step_result", accept=lambda said: said.proposal_id == proposal_id, timeout_s=60.0)


def hold_disk(bench: Bench) -> None:
    """A disk is held, and on its way through the air."""
    begin_with_disk(bench)
    bench.operator.until(lambda: bench.vacuum or has_ended(bench), "vacuum", 30.0)
    bench.operator.spin(1.0)


def has_ended(bench: Bench) -> bool:
    """Whether the executor has said what has become of the proposal that was approved last."""
    return any(said.proposal_id == bench.proposal.id for said in bench.operator.received["step_result"])


def count_step(bench: Bench, times: int = 1) -> None:
    """The operator says that the step has succeeded; the monitor looks whether it is counted, once."""
    before = bench.operator.count("goal")
    for _ in range(times):
        bench.operator.confirm(bench.proposal.id, StepConfirmation.ADVANCE)
    with contextlib.suppress(TimeoutError):
        bench.operator.next("goal", before, lambda goal: goal.step > 1, timeout_s=COUNTED_S)
    # More than one would come now.
    bench.operator.spin(1.0)
    now = time.monotonic()
    bench.happened(now, lambda: bench.monitor.on_counting_ends(now))
