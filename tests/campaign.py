"""A fault campaign: faults at random moments of motions, with a monitor that does not know the executor.

python tests/campaign.py --faults 20 --seed 1 --json

A cell is the simulated one as hardware behaves, the executor and the watchdog; the campaign plays everybody else. A few faults follow
each other in one cell: the motion that shows that the arm goes on after a fault is the one that the next fault breaks off. The same seed
draws the same faults at the same moments.

--planted runs executors with a planted fault instead, and says which of them the monitor catches.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import dataclasses
import json
import os
import pathlib
import random
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator

from processes import REPOSITORY, Process, free_domain

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
os.environ.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(REPOSITORY / "config/fastdds.xml"))

import numpy as np
from action_msgs.msg import GoalStatusArray
from cell_operator import EVENT, LATCHED, STREAM, Operator
from fault_monitor import Kind, Monitor, Violation
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sctn_msgs.msg import Heightmap, PickPlace, PlannedMotion, StepConfirmation, StepResult
from sctn_msgs.srv import ProposeHome
from sensor_msgs.msg import JointState
from test_refusals import Cell
from ur_msgs.msg import IOStates

OPERATOR = "end-to-end test"
# A stop reaches the executor, its cancel the driver, and the arm brakes, which takes 0.12 s.
REST_S = 0.3
# The same after the watchdog's timeout.
REST_AFTER_DEATH_S = REST_S + 0.3
# How long the arm is watched after a fault.
WATCH_S = 2.5
# A motion of these proposals takes longer.
LATEST_S = 3.0
# Faults that follow each other in one cell.
FAULTS_OF_A_CELL = 8
# The arm has moved when a joint is so much further [rad].
MOVED_RAD = 0.02
# So long a proposal waits for its approval: the arm must not move.
UNDECIDED_S = 0.4
# A second executor has found out by then that there is one.
LISTENING_S = 2.0
# Output that switches suction: suction_pin of the executor.
SUCTION_PIN = 16
# The driver's action.
FOLLOW_ACTION = "scaled_joint_trajectory_controller/follow_joint_trajectory"


Fault = Callable[["Bench"], None]


@dataclasses.dataclass
class Bench:
    """One cell, and what the campaign may do to it."""

    operator: Operator
    cell: Cell
    monitor: Monitor
    executor: Process
    start: Callable[..., Process]
    # The newest proposal, which moves the arm when a fault comes.
    proposal: PickPlace | None = None
    suction: bool = False
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

    def stopped(self, limit_s: float) -> None:
        self.monitor.on_stop(time.monotonic(), limit_s)

    def set_fault(self, fault: str) -> None:
        """Sets what is wrong with the simulated robot."""
        client = self.operator.node.create_client(SetParameters, "sim_workcell/set_parameters")
        self.operator.until(client.service_is_ready, "sim_workcell", 30.0)
        value = Parameter("hardware.fault", Parameter.Type.STRING, fault).to_parameter_msg()
        answer = client.call_async(SetParameters.Request(parameters=[value]))
        self.operator.until(answer.done, "answer of sim_workcell", 30.0)
        assert answer.result().results[0].successful, answer.result()


def stop(bench: Bench) -> None:
    bench.stopped(REST_S)
    bench.operator.confirm(bench.proposal.id, StepConfirmation.STOP)


def stop_naming_no_proposal(bench: Bench) -> None:
    bench.stopped(REST_S)
    bench.operator.confirm(987_654_321, StepConfirmation.STOP)


def kill_executor(bench: Bench) -> None:
    bench.stopped(REST_AFTER_DEATH_S)
    bench.executor.signal(signal.SIGKILL)


def terminate_executor(bench: Bench) -> None:
    bench.stopped(REST_S)
    bench.executor.signal(signal.SIGTERM)


def freeze_executor(bench: Bench) -> None:
    bench.stopped(REST_AFTER_DEATH_S)
    bench.executor.signal(signal.SIGSTOP)
    bench.operator.spin(1.5)
    bench.executor.signal(signal.SIGCONT)


def robot(fault: str) -> Fault:
    """A fault of the robot. It acts at some time of the call that sets it."""

    def inject(bench: Bench) -> None:
        bench.set_fault(fault)
        bench.stopped(REST_S)

    inject.__name__ = fault
    return inject


def spoofed_approvals(bench: Bench) -> None:
    """Approvals of a proposal that is unknown, and of the one that moves: they change nothing, and the operator stops the arm."""
    for proposal_id in (123_456_789, bench.proposal.id, 0):
        bench.operator.confirm(proposal_id, StepConfirmation.APPROVE)
    stop(bench)
    # The arm rests, and the executor has said so.
    bench.operator.spin(0.6)
    for proposal_id in (123_456_789, bench.proposal.id, 0):
        bench.operator.confirm(proposal_id, StepConfirmation.APPROVE)


def superseded_approval(bench: Bench) -> None:
    """After a stop the approval of a proposal that was replaced moves nothing."""
    stop(bench)
    bench.operator.spin(0.5)
    old = propose(bench.cell)
    propose(bench.cell)
    # The monitor has to know of both.
    bench.operator.spin(0.2)
    bench.operator.confirm(old.id, StepConfirmation.APPROVE)


def another_executor(bench: Bench) -> None:
    """A second executor in mid-motion, then a stop and an approval of the old proposal: neither moves the arm."""
    second = bench.start("suction_executor", *arguments("suction_executor"))
    end = time.monotonic() + LISTENING_S
    while second.exit_code is None and time.monotonic() < end:
        bench.operator.spin(0.05)
    stop(bench)
    bench.operator.confirm(bench.proposal.id, StepConfirmation.APPROVE)


def stop_while_suction_is_on(bench: Bench) -> None:
    """A stop when suction is on, at the earliest at the end of the descent."""
    bench.operator.until(lambda: bench.suction, "suction", 60.0)
    stop(bench)


def unapproved_way_home(bench: Bench) -> None:
    """After a stop the way home is proposed, and another proposal is approved: the arm stays."""
    stop(bench)
    bench.operator.spin(0.5)
    propose_home(bench)
    bench.operator.spin(UNDECIDED_S)
    bench.operator.confirm(bench.proposal.id, StepConfirmation.APPROVE)


FAULTS = [
    stop,
    stop_naming_no_proposal,
    kill_executor,
    terminate_executor,
    freeze_executor,
    robot("protective_stop"),
    robot("emergency_stop"),
    robot("program_stopped"),
    spoofed_approvals,
    superseded_approval,
    another_executor,
    stop_while_suction_is_on,
    unapproved_way_home,
]

# Faults planted in the executor: what exposes each, how long after the motion has begun, and what the monitor has to say of it.
PLANTED = {
    "MovesUnapproved": (stop, 1.0, Kind.UNAPPROVED),
    "AnyApproval": (superseded_approval, 1.0, Kind.UNAPPROVED),
    "ApprovesSuperseded": (superseded_approval, 1.0, Kind.UNAPPROVED),
    "ApprovesTwice": (spoofed_approvals, 1.0, Kind.UNAPPROVED),
    "IgnoresStop": (stop, 0.5, Kind.AFTER_STOP),
    "IgnoresStopOfAnother": (stop_naming_no_proposal, 0.5, Kind.AFTER_STOP),
    "AnswersWithoutCancel": (stop, 0.5, Kind.AFTER_STOP),
    "GoesOnAfterStop": (stop, 0.5, Kind.AFTER_STOP),
    "GoesOnAfterFault": (robot("protective_stop"), 0.5, Kind.AFTER_STOP),
    "DropsOnStop": (stop_while_suction_is_on, 1.0, Kind.DROPPED),
    "HomeUnasked": (unapproved_way_home, 1.0, Kind.AFTER_STOP),
    # The approach takes some 1.4 s: killed in its beginning, it goes on for longer than the watchdog takes.
    "NoHeartbeat": (kill_executor, 0.2, Kind.AFTER_STOP),
    "SecondExecutor": (another_executor, 1.0, Kind.TWO_GOALS),
}


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

    def on_confirmation(said: StepConfirmation) -> None:
        if said.decision == StepConfirmation.APPROVE:
            monitor.on_approval(said.proposal_id, said.operator_name)

    def on_result(result: StepResult) -> None:
        if result.outcome not in (StepResult.REFUSED, StepResult.REJECTED):
            monitor.on_end(result.proposal_id, time.monotonic())

    def on_pins(pins: IOStates) -> None:
        bench.suction = any(output.pin == SUCTION_PIN and output.state for output in pins.digital_out_states)
        monitor.on_suction(bench.suction, time.monotonic())

    def on_goals(goals: GoalStatusArray) -> None:
        monitor.on_goals({bytes(one.goal_info.goal_id.uuid): one.status for one in goals.status_list}, time.monotonic())

    node = bench.operator.node
    node.create_subscription(PickPlace, "pick_place", lambda made: monitor.on_proposal(made.id), LATCHED)
    node.create_subscription(PlannedMotion, "planned_motion", lambda plan: monitor.on_plan(plan.proposal_id), LATCHED)
    node.create_subscription(StepConfirmation, "step_confirmation", on_confirmation, EVENT)
    node.create_subscription(StepResult, "step_result", on_result, EVENT)
    node.create_subscription(GoalStatusArray, f"{FOLLOW_ACTION}/_action/status", on_goals, LATCHED)
    node.create_subscription(JointState, "joint_states", lambda read: monitor.on_joints(read.position, time.monotonic()), STREAM)
    node.create_subscription(IOStates, "io_and_status_controller/io_states", on_pins, STREAM)


@contextlib.contextmanager
def processes(domain: int, logs: pathlib.Path, variables: dict[str, str]) -> Iterator[Callable[..., Process]]:
    """Starts executables and ends them, also those that were frozen. With variables the executor is the one with a planted fault."""
    started: list[Process] = []

    def start(name: str, *line: object) -> Process:
        if variables and name == "suction_executor":
            name = "suction_executor_planted"
        started.append(Process(name, [str(argument) for argument in line], domain, logs, variables))
        return started[-1]

    try:
        yield start
    finally:
        for process in reversed(started):
            if process.exit_code is None:
                process.signal(signal.SIGCONT)
            process.end()


@contextlib.contextmanager
def working_cell(planted: str | None = None) -> Iterator[Bench]:
    """A cell whose executor is ready, maybe with a planted fault."""
    domain = free_domain()
    variables = {"SCTN_PLANTED_FAULT": planted} if planted else {}
    with tempfile.TemporaryDirectory() as logs, processes(domain, pathlib.Path(logs), variables) as start, Operator(domain) as operator:
        start("sim_workcell", *arguments("sim_workcell", seed=10000))
        start("motion_watchdog", "--ros-args", "--params-file", REPOSITORY / "config/motion_watchdog.yaml")
        executor = start("suction_executor", *arguments("suction_executor"))
        cell = Cell(operator)
        cell.wait_until_ready()
        operator.until(lambda: "motion_watchdog" in operator.node.get_node_names(), "watchdog", 30.0)
        bench = Bench(operator, cell, Monitor(OPERATOR), executor, start)
        watch(bench)
        # The executor, and the monitor.
        operator.listeners = 2
        operator.spin(0.5)
        yield bench


def begin(bench: Bench) -> str:
    """An approval of a new proposal moves the arm, or is refused for a reason."""
    operator = bench.operator
    bench.proposal = propose(bench.cell)
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
    """After a fault: an executor that is dead is started again, the robot is ready again."""
    operator = bench.operator
    if bench.executor.exit_code is not None:
        bench.executor = bench.start("suction_executor", *arguments("suction_executor"))
        # Acknowledged when the dead one is forgotten, which takes a while.
        bench.cell.observe()
    bench.set_fault("none")
    operator.states.clear()
    operator.until(operator.executor_is_ready, "executor that is ready again", 60.0)
    bench.cell.wait_until_ready()
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


def inject(bench: Bench, fault: Fault, moment_s: float) -> str:
    """Injects a fault so long after the arm has begun to move. Returns how it went on."""
    bench.operator.spin(moment_s)
    bench.exposed_s.append(time.monotonic())
    fault(bench)
    bench.operator.spin(WATCH_S)
    recover(bench)
    went_on = begin(bench)
    if went_on == "moves":
        return "resumed"
    # From where the fault has left it the arm may not get to the pick: it goes home first.
    if go_home(bench) and begin(bench) == "moves":
        return f"resumed from home ({went_on})"
    return went_on


def propose(cell: Cell) -> PickPlace:
    """A proposal from a heightmap of now, in which the table is there: black at height 0 is what no camera has seen."""

    def look(heightmap: Heightmap) -> None:
        heightmap.rgb = np.full(len(heightmap.rgb), 90, dtype=np.uint8)
        heightmap.header.stamp = cell.operator.newest("joint_states").header.stamp

    return cell.propose(cell.observe(look))


@dataclasses.dataclass(frozen=True)
class Planned:
    """A fault that is to be injected so long after a motion has begun."""

    number: int
    fault: Fault
    moment_s: float


def drawn(count: int, seed: int) -> list[Planned]:
    """So many faults and their moments. Every kind comes once before any comes again."""
    draw = random.Random(seed)
    kinds: list[Fault] = []
    while len(kinds) < count:
        kinds += draw.sample(FAULTS, len(FAULTS))
    return [Planned(number, fault, draw.uniform(0.0, LATEST_S)) for number, fault in enumerate(kinds[:count])]


@dataclasses.dataclass
class Injected:
    """What came of a fault: a line of the log."""

    seed: int
    number: int
    fault: str
    moment_s: float
    # How it went on; empty where it hung.
    went_on: str
    hung: str = ""
    # The kinds and words of what must not happen.
    violations: list[tuple[str, str]] = dataclasses.field(default_factory=list)


def run_cells(faults: list[Planned], seed: int, until_s: float = float("inf")) -> Iterator[Injected]:
    """Injects faults, some in each cell, until a monotonic time is over; says each with what came of it on standard error."""
    left = list(faults)
    while left and time.monotonic() < until_s:
        with working_cell() as bench:
            went_on = begin(bench)
            for _ in range(FAULTS_OF_A_CELL):
                if not left or not went_on.startswith(("moves", "resumed")) or time.monotonic() > until_s:
                    break
                planned = left.pop(0)
                line = Injected(seed, planned.number, planned.fault.__name__, round(planned.moment_s, 3), "")
                known = len(bench.monitor.violations)
                try:
                    line.went_on = went_on = inject(bench, planned.fault, planned.moment_s)
                except (TimeoutError, AssertionError) as error:
                    line.hung = went_on = str(error) or type(error).__name__
                line.violations = [(found.kind.value, found.text) for found in bench.monitor.violations[known:]][:5]
                print(f"{json.dumps(dataclasses.asdict(line))}", file=sys.stderr, flush=True)
                yield line


def summed(lines: list[Injected], faults: int, seed: int) -> dict[str, object]:
    """The result of a campaign."""
    counts = collections.Counter(kind.value for kind in Kind for line in lines if kind.value in dict(line.violations))
    return {
        "faults": faults,
        "seed": seed,
        "runs": len(lines),
        "resumed": sum(line.went_on.startswith("resumed") for line in lines),
        "refused": sum(bool(line.went_on) and not line.went_on.startswith("resumed") for line in lines),
        **{kind.value: counts[kind.value] for kind in Kind},
        "hung_runs": sum(bool(line.hung) for line in lines),
        "violations": [
            f"fault {line.number} of seed {line.seed}: {line.fault} at {line.moment_s:.2f} s: {line.violations[0][1]}"
            for line in lines
            if line.violations
        ],
    }


def campaign(count: int, seed: int, log: pathlib.Path | None = None, minutes: float = float("inf")) -> dict[str, object]:
    """Injects so many faults. With a log, those that are in it are not injected again, and the result is of all of them."""
    faults = drawn(count, seed)
    done = read_log(log, faults, seed) if log and log.exists() else []
    known = {line.number for line in done}
    until_s = time.monotonic() + 60.0 * minutes
    for line in run_cells([planned for planned in faults if planned.number not in known], seed, until_s):
        done.append(line)
        if log:
            with log.open("a") as file:
                print(json.dumps(dataclasses.asdict(line)), file=file)
    return summed(done, count, seed)


def read_log(log: pathlib.Path, faults: list[Planned], seed: int) -> list[Injected]:
    """The faults of a campaign that were injected before. An error where they are those of another program."""
    done = []
    for number, text in enumerate(log.read_text().splitlines(), 1):
        line = Injected(**json.loads(text))
        if line.seed != seed or line.number >= len(faults):
            continue
        expected = faults[line.number]
        if (line.fault, line.moment_s) != (expected.fault.__name__, round(expected.moment_s, 3)):
            raise SystemExit(
                f"{log}:{number}: fault {line.number} of seed {seed} is {line.fault} at {line.moment_s} s, "
                f"expected {expected.fault.__name__} at {expected.moment_s:.3f} s: written by another version of the campaign"
            )
        done.append(line)
    return done


def planted_campaign(only: str | None = None) -> dict[str, Violation | None]:
    """Runs the executor with each planted fault; what the monitor says of it, nothing where it is missed or takes it for something else."""
    caught: dict[str, Violation | None] = {}
    for planted, (fault, moment_s, expected) in PLANTED.items():
        if only not in (None, planted):
            continue
        with working_cell(planted) as bench:
            try:
                begin(bench)
                inject(bench, fault, moment_s)
            except (TimeoutError, AssertionError) as error:
                print(f"{planted}: the run hangs: {error}", file=sys.stderr, flush=True)
            found = bench.monitor.violations
            # Later ones may be what comes of the first.
            first = found[0] if found and found[0].kind == expected else None
            caught[planted] = first
            said = f"MISSED {list(map(str, found[:1]))}"
            if first:
                said = f"{expected.value} after {first.at_s - bench.exposed_by(first.at_s):.2f} s: {first}"
        print(f"{planted}: {fault.__name__}: {said}", file=sys.stderr, flush=True)
    return caught


def same_situations(seed: int) -> list[str]:
    """What the monitor says of the shipped executor where those with planted faults are caught: nothing."""
    situations = {fault.__name__: Planned(number, fault, moment_s) for number, (fault, moment_s, _) in enumerate(PLANTED.values())}
    result = summed(list(run_cells(list(situations.values()), seed)), len(situations), seed)
    hung = [f"{result['hung_runs']} runs hung"] if result["hung_runs"] else []
    return [*result["violations"], *hung]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faults", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--log", type=pathlib.Path, help="append a line of JSON for each fault; those in the file are left out")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="end after so long; with --log the next call goes on")
    parser.add_argument("--planted", action="store_true", help="run executors with planted faults: each has to be caught")
    parser.add_argument("--only", choices=PLANTED, help="with --planted: this fault alone")
    parser.add_argument("--json", action="store_true", help="print the result as one line of JSON")
    given = parser.parse_args()
    if given.planted:
        caught = planted_campaign(given.only)
        missed = [planted for planted, violation in caught.items() if not violation]
        unplanted = [] if given.only else same_situations(given.seed)
        result = {"planted": len(caught), "caught": len(caught) - len(missed), "missed": missed, "unplanted": unplanted}
        failed = bool(missed or unplanted)
    else:
        result = campaign(given.faults, given.seed, given.log, given.minutes)
        failed = bool(result["violations"] or result["hung_runs"])
    print(json.dumps(result) if given.json else "\n".join(f"{name}: {value}" for name, value in result.items()))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
