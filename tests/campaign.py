"""A fault campaign: faults at random moments of motions, with a monitor that does not know the executor.

python tests/campaign.py --faults 20 --seed 1 --json

Every fault has a cell of its own: the simulated one as hardware behaves, the executor and the watchdog. The campaign plays everybody else.
The same seed draws the same faults at the same moments.
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
from cell_operator import EVENT, LATCHED, STREAM, Operator
from fault_monitor import Monitor
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sctn_msgs.msg import Heightmap, PickPlace, StepConfirmation, StepResult
from sensor_msgs.msg import JointState
from test_refusals import Cell

OPERATOR = "end-to-end test"
# A stop reaches the executor, its cancel the driver, and the arm brakes, which takes 0.12 s.
REST_S = 0.3
# The same after the watchdog's timeout.
REST_AFTER_DEATH_S = REST_S + 0.3
# How long the arm is watched after a fault.
WATCH_S = 2.5
# A motion of these proposals takes longer.
LATEST_S = 3.0


@dataclasses.dataclass
class Bench:
    """One cell, and what the campaign may do to it."""

    operator: Operator
    cell: Cell
    monitor: Monitor
    executor: Process
    start: Callable[..., Process]
    proposal: PickPlace

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


def robot(fault: str) -> Callable[[Bench], None]:
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
    for proposal_id in (123_456_789, bench.proposal.id, 0):
        bench.operator.confirm(proposal_id, StepConfirmation.APPROVE)


def superseded_approval(bench: Bench) -> None:
    """After a stop the approval of a proposal that was replaced moves nothing."""
    stop(bench)
    bench.operator.spin(0.5)
    old = bench.cell.propose(bench.cell.observe())
    bench.cell.propose(bench.cell.observe())
    bench.operator.confirm(old.id, StepConfirmation.APPROVE)


def another_executor(bench: Bench) -> None:
    """A second executor in mid-motion, then a stop and an approval of the old proposal: neither moves the arm."""
    bench.start("suction_executor", *arguments("suction_executor"))
    bench.operator.spin(0.3)
    stop(bench)
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
]


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


def watch(operator: Operator, monitor: Monitor) -> None:
    """Connects the monitor to what is said on the domain."""

    def on_confirmation(said: StepConfirmation) -> None:
        if said.decision == StepConfirmation.APPROVE:
            monitor.on_approval(said.proposal_id, said.operator_name)

    def on_result(result: StepResult) -> None:
        if result.outcome not in (StepResult.REFUSED, StepResult.REJECTED):
            monitor.on_end(result.proposal_id, time.monotonic())

    node = operator.node
    node.create_subscription(PickPlace, "pick_place", lambda made: monitor.on_proposal(made.id), LATCHED)
    node.create_subscription(StepConfirmation, "step_confirmation", on_confirmation, EVENT)
    node.create_subscription(StepResult, "step_result", on_result, EVENT)
    node.create_subscription(JointState, "joint_states", lambda read: monitor.on_joints(read.position, time.monotonic()), STREAM)


@contextlib.contextmanager
def processes(domain: int, logs: pathlib.Path) -> Iterator[Callable[..., Process]]:
    """Starts executables; they are ended at the end, also those that were frozen."""
    started: list[Process] = []

    def start(name: str, *line: object) -> Process:
        started.append(Process(name, [str(argument) for argument in line], domain, logs))
        return started[-1]

    try:
        yield start
    finally:
        for process in reversed(started):
            if process.exit_code is None:
                process.signal(signal.SIGCONT)
            process.end()


def run(fault: Callable[[Bench], None], moment_s: float) -> tuple[Monitor, str]:
    """Injects a fault so long after the arm has begun to move. Returns what the monitor says, and how the run ended."""
    domain = free_domain()
    monitor = Monitor(OPERATOR)
    with tempfile.TemporaryDirectory() as logs, processes(domain, pathlib.Path(logs)) as start, Operator(domain) as operator:
        start("sim_workcell", *arguments("sim_workcell", seed=10000))
        start("motion_watchdog", "--ros-args", "--params-file", REPOSITORY / "config/motion_watchdog.yaml")
        executor = start("suction_executor", *arguments("suction_executor"))
        cell = Cell(operator)
        cell.wait_until_ready()
        operator.until(lambda: "motion_watchdog" in operator.node.get_node_names(), "watchdog", 30.0)
        watch(operator, monitor)
        # The executor, and the monitor.
        operator.listeners = 2
        operator.spin(0.5)
        proposal = propose(cell)
        bench = Bench(operator, cell, monitor, executor, start, proposal)
        before = list(operator.newest("joint_states").position)
        operator.confirm(proposal.id, StepConfirmation.APPROVE)
        operator.until(
            lambda: max(abs(a - b) for a, b in zip(operator.newest("joint_states").position, before, strict=True)) > 0.02, "motion", 30.0
        )
        operator.spin(moment_s)
        fault(bench)
        operator.spin(WATCH_S)
        return monitor, go_on(bench)


def go_on(bench: Bench) -> str:
    """After the fault: an approval of a new proposal moves the arm again, or is refused for a reason."""
    operator = bench.operator
    if bench.executor.exit_code is not None:
        bench.start("suction_executor", *arguments("suction_executor"))
        # Acknowledged when the dead one is forgotten, which takes a while.
        bench.cell.observe()
    bench.set_fault("none")
    operator.states.clear()
    operator.until(operator.executor_is_ready, "executor that is ready again", 60.0)
    bench.cell.wait_until_ready()
    operator.spin(0.5)
    proposal = propose(bench.cell)
    after = operator.count("step_result")
    before = list(operator.newest("joint_states").position)
    operator.confirm(proposal.id, StepConfirmation.APPROVE)

    def outcome() -> str | None:
        answers = [result for result in operator.received["step_result"][after:] if result.proposal_id == proposal.id]
        if answers and answers[-1].outcome == StepResult.REFUSED:
            return f"refused: {answers[-1].reason}"
        moved = max(abs(a - b) for a, b in zip(operator.newest("joint_states").position, before, strict=True))
        return "resumed" if moved > 0.02 else None

    return operator.until(outcome, "motion or refusal after the fault", 30.0)


def propose(cell: Cell) -> PickPlace:
    """A proposal from a heightmap of now, in which the table is there: black at height 0 is what no camera has seen."""

    def look(heightmap: Heightmap) -> None:
        heightmap.rgb = np.full(len(heightmap.rgb), 90, dtype=np.uint8)
        heightmap.header.stamp = cell.operator.newest("joint_states").header.stamp

    return cell.propose(cell.observe(look))


def campaign(count: int, seed: int) -> dict[str, object]:
    """Injects so many faults; prints each with what came of it on standard error."""
    draw = random.Random(seed)
    counts: collections.Counter[str] = collections.Counter()
    violations: list[str] = []
    for number in range(count):
        # Every kind once before any comes again.
        if number % len(FAULTS) == 0:
            order = draw.sample(FAULTS, len(FAULTS))
        fault, moment_s = order[number % len(FAULTS)], draw.uniform(0.0, LATEST_S)
        name = f"fault {number} of seed {seed}: {fault.__name__} at {moment_s:.2f} s"
        try:
            monitor, ended = run(fault, moment_s)
        except (TimeoutError, AssertionError) as error:
            counts["hung"] += 1
            print(f"{name}: hung: {error}", file=sys.stderr)
            continue
        counts["resumed" if ended == "resumed" else "refused"] += 1
        counts["unapproved_motions"] += any("without an approval" in violation for violation in monitor.violations)
        counts["motions_after_stop"] += any("after it had to stop" in violation for violation in monitor.violations)
        violations += [f"{name}: {violation}" for violation in monitor.violations[:1]]
        print(f"{name}: at rest after {monitor.rest_after_s:.2f} s, {ended}; {monitor.violations[:1]}", file=sys.stderr, flush=True)
    return {
        "faults": count,
        "seed": seed,
        "runs": count,
        "resumed": counts["resumed"],
        "refused": counts["refused"],
        "unapproved_motions": counts["unapproved_motions"],
        "motions_after_stop": counts["motions_after_stop"],
        "hung_runs": counts["hung"],
        "violations": violations,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faults", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="print the result as one line of JSON")
    given = parser.parse_args()
    result = campaign(given.faults, given.seed)
    print(json.dumps(result) if given.json else "\n".join(f"{name}: {value}" for name, value in result.items()))
    return 1 if result["violations"] or result["hung_runs"] else 0


if __name__ == "__main__":
    sys.exit(main())
