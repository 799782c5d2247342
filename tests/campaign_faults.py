"""What the fault campaign does to a cell while the arm moves."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable

from campaign_cell import (
    ATTEMPTS,
    CONTROLLER,
    GRAPH,
    UNDECIDED_S,
    Bench,
    Layout,
    begin,
    begin_from_home,
    begin_with_disk,
    carried_out,
    count_step,
    end_of_step,
    has_ended,
    hold_disk,
    is_unheard,
    propose,
    propose_home,
)
from sctn_msgs.msg import PickPlace, StepConfirmation, StepResult
from whole_run import OBSERVATION_MAX_AGE_S

# A stop reaches the executor, its cancel the driver, and the arm brakes, which takes 0.12 s.
REST_S = 0.3
# The same after the watchdog's timeout.
REST_AFTER_DEATH_S = REST_S + 0.3
# The same where a fifth of the datagrams is lost: a stop that is lost is sent again when the reader says that it lacks it.
REST_WITH_LOSS_S = 1.0
# How long a process is frozen.
FROZEN_S = 1.5
# Share of the datagrams that a bad network loses.
LOSS = 0.2
# A second executor has found out by then that there is one, or has become active, also on a machine that does much else.
LISTENING_S = 60.0
# Suction is on within this time of a motion's beginning, or not any more.
SUCTION_S = 8.0
# servo_delay_s [s], vacuum_leak_s [s] and tool_voltage [V] with config/hardware/realistic.yaml.
USUAL_DELAY_S, USUAL_LEAK_S, USUAL_TOOL_V = 0.03, 60.0, 24
# An arm that is no further from home arrives there in a moment [rad].
NEAR_HOME_RAD = 0.2
# A process that was killed, or told to end, has ended by then.
EXIT_S = 10.0
# A recorder cannot write more to one file [blocks of 512 bytes].
DISK_BLOCKS = 400
# A view is older then than may be [s].
OLD_S = OBSERVATION_MAX_AGE_S + 0.3

Fault = Callable[[Bench], None]


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


def killed(name: str, number: signal.Signals) -> Fault:
    """Ends the watchdog or the driver."""

    def inject(bench: Bench) -> None:
        process = bench.watchdog if name == "watchdog" else bench.driver
        if name == "driver":
            # The simulated arm is gone with it: what counts is that nothing moves when another driver is there.
            bench.stopped(REST_S)
        process.signal(number)
        process.wait(EXIT_S)
        if name == "watchdog":
            # The arm goes on, and can be stopped.
            bench.operator.spin(0.3)
            stop(bench)

    inject.__name__ = f"{'kill' if number is signal.SIGKILL else 'terminate'}_{name}"
    return inject


def freeze_executor(bench: Bench) -> None:
    bench.stopped(REST_AFTER_DEATH_S)
    bench.executor.signal(signal.SIGSTOP)
    bench.operator.spin(FROZEN_S)
    bench.executor.signal(signal.SIGCONT)


def freeze_driver(bench: Bench) -> None:
    """Simulation and arm are frozen too: what counts is that the arm does not go on when they come back."""
    bench.driver.signal(signal.SIGSTOP)
    bench.operator.spin(FROZEN_S)
    # The executor has said meanwhile that the motion has failed, and that the arm may still be moving.
    bench.stopped(REST_S, again=True)
    bench.driver.signal(signal.SIGCONT)


def freeze_watchdog(bench: Bench) -> None:
    """The arm goes on, and can be stopped."""
    bench.watchdog.signal(signal.SIGSTOP)
    bench.operator.spin(0.3)
    stop(bench)
    bench.operator.spin(FROZEN_S)
    bench.watchdog.signal(signal.SIGCONT)


def gone(name: str, number: signal.Signals) -> Fault:
    """A node that neither moves the arm nor stops it is killed, or stands still for a while: the arm goes on, and can be stopped."""

    def inject(bench: Bench) -> None:
        process = bench.oracle if name == "goal_oracle" else bench.graph[name]
        process.signal(number)
        if number is signal.SIGKILL:
            process.wait(EXIT_S)
            bench.operator.listeners -= GRAPH.get(name, True)
        bench.operator.spin(0.3)
        stop(bench)
        if number is signal.SIGSTOP:
            bench.operator.spin(FROZEN_S)
            process.signal(signal.SIGCONT)

    inject.__name__ = f"{'kill' if number is signal.SIGKILL else 'freeze'}_{name}_in_graph"
    return inject


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
    old = propose(bench)
    propose(bench)
    # The monitor has to know of both.
    bench.operator.spin(0.2)
    bench.operator.confirm(old.id, StepConfirmation.APPROVE)


def another_executor(bench: Bench) -> None:
    """A second executor, then a stop and an approval of the old proposal: neither moves the arm.

    It counts only once the second one has ended or hears confirmations: on a busy machine it may take longer to start than everything else.
    """
    before = bench.confirmation_readers()
    second = bench.start_executor()
    end = time.monotonic() + LISTENING_S
    while second.exit_code is None and not bench.confirmation_readers() - before and time.monotonic() < end:
        bench.operator.spin(0.05)
    if second.exit_code is None:
        assert bench.confirmation_readers() - before, f"the second executor has neither ended nor become active: {second.log()}"
        # Both have to hear what is approved from now on.
        bench.operator.listeners += 1
    stop(bench)
    bench.operator.confirm(bench.proposal.id, StepConfirmation.APPROVE)


def approval_of_another(bench: Bench) -> None:
    """After a stop somebody who does not decide approves the proposal that is offered."""
    stop(bench)
    bench.operator.spin(0.6)
    proposal = propose(bench)
    bench.operator.spin(0.2)
    bench.operator.confirm(proposal.id, StepConfirmation.APPROVE, "eve")


def controllers_inactive(bench: Bench) -> None:
    """Somebody deactivates the controller that follows trajectories."""
    bench.set_hardware("inactive_controllers", [CONTROLLER], [])
    bench.stopped(REST_S)


def speed_changes(bench: Bench) -> None:
    """Somebody moves the speed slider in mid-motion; then the arm is stopped."""
    for scaling in (0.3, 0.8, 0.1):
        bench.set_hardware("speed_scaling", scaling, 1.0)
        bench.operator.spin(0.4)
    stop(bench)


def path_tolerance(bench: Bench) -> None:
    """After a stop the arm lags so far behind that the driver aborts the next motion."""
    stop(bench)
    bench.operator.spin(0.6)
    bench.set_hardware("servo_delay_s", 0.5, USUAL_DELAY_S)

    # Home slowly, which it can follow.
    went_on = begin_from_home(bench)
    for _ in range(ATTEMPTS):
        if went_on.startswith("moves"):
            went_on = end_of_step(bench).reason
        if not is_unheard(bench, went_on):
            break
        went_on = begin_from_home(bench)
    assert "path tolerance" in went_on, went_on


def vacuum_leaks(bench: Bench) -> None:
    """What is held falls in mid-air: nobody has decided that, and the motion ends as it was approved."""

    def attempt(bench: Bench) -> StepResult:
        bench.set_hardware("vacuum_leak_s", USUAL_LEAK_S, USUAL_LEAK_S)
        hold_disk(bench)
        bench.set_hardware("vacuum_leak_s", 0.1, USUAL_LEAK_S)
        return end_of_step(bench)

    stop(bench)
    end = carried_out(bench, attempt)
    assert end.outcome == StepResult.DROPPED, end


def tool_voltage_off(bench: Bench) -> None:
    """The tool has no power any more while something is held: it falls, and nothing begins to move before the power is back."""
    stop(bench)
    hold_disk(bench)
    bench.set_hardware("tool_voltage", 0, USUAL_TOOL_V)
    end = end_of_step(bench)
    assert end.outcome in (StepResult.DROPPED, StepResult.FAULT), end


def advance_is_repeated(bench: Bench) -> None:
    """A step is carried out, and the operator says three times that it has succeeded."""
    completed(bench)
    count_step(bench, times=3)


def kill_executor_after_step(bench: Bench) -> None:
    """The executor is killed when it has just said that a step is carried out."""
    completed(bench)
    bench.stopped(REST_AFTER_DEATH_S)
    bench.executor.signal(signal.SIGKILL)
    # It hears confirmations no more.
    bench.operator.listeners -= 1
    count_step(bench)
    bench.operator.listeners += 1


def freeze_oracle(bench: Bench) -> None:
    """The goal oracle stands still while a step ends and is confirmed."""

    def attempt(bench: Bench) -> StepResult:
        begin_with_disk(bench)
        bench.oracle.signal(signal.SIGSTOP)
        end = end_of_step(bench)
        if end.outcome != StepResult.PLACED:
            bench.oracle.signal(signal.SIGCONT)
        return end

    completed(bench, attempt)
    bench.operator.confirm(bench.proposal.id, StepConfirmation.ADVANCE)
    bench.operator.spin(FROZEN_S)
    bench.oracle.signal(signal.SIGCONT)
    count_step(bench)


def step_with_loss(bench: Bench) -> None:
    """A step ends and is confirmed while a fifth of all datagrams is lost. For longer the watchdog would not hear the executor in time."""

    def attempt(bench: Bench) -> StepResult:
        bench.link.lose(0.0)
        hold_disk(bench)
        bench.operator.until(lambda: not bench.vacuum or has_ended(bench), "release", 30.0)
        bench.operator.until(lambda: is_near_home(bench) or has_ended(bench), "way home", 30.0)
        bench.link.lose(LOSS)
        return end_of_step(bench)

    completed(bench, attempt)
    count_step(bench)


def is_near_home(bench: Bench) -> bool:
    """Whether the arm is almost where it was brought last when it was sent home."""
    return max(abs(a - b) for a, b in zip(bench.positions(), bench.home_rad, strict=True)) < NEAR_HOME_RAD


def whole_step(bench: Bench) -> StepResult:
    """How the step of a disk ends."""
    begin_with_disk(bench)
    return end_of_step(bench)


def completed(bench: Bench, attempt: Callable[[Bench], StepResult] = whole_step) -> None:
    """A whole step is carried out."""
    stop(bench)
    end = carried_out(bench, attempt)
    assert end.outcome == StepResult.PLACED, end


def stop_while_suction_is_on(bench: Bench) -> None:
    """A stop when suction is on, which it is at the end of the descent."""
    end = time.monotonic() + SUCTION_S
    while not bench.suction and time.monotonic() < end:
        bench.operator.spin(0.02)
    stop(bench)


def unapproved_way_home(bench: Bench) -> None:
    """After a stop the way home is proposed, and another proposal is approved: the arm stays."""
    stop(bench)
    bench.operator.spin(0.5)
    propose_home(bench)
    bench.operator.spin(UNDECIDED_S)
    bench.operator.confirm(bench.proposal.id, StepConfirmation.APPROVE)


def stale_messages(bench: Bench) -> None:
    """After a stop heightmap, proposal and approval of before come once more."""
    heightmap = bench.cell.newest_heightmap
    stop(bench)
    bench.operator.spin(0.6)
    bench.cell.repeat_heightmap(heightmap)
    bench.cell.repeat(bench.proposal)
    bench.operator.confirm(bench.proposal.id, StepConfirmation.APPROVE)


def stale_view(bench: Bench) -> None:
    """After a stop the approval of a new proposal comes when its view is old."""
    stop(bench)
    bench.operator.spin(0.6)
    proposal = propose(bench)
    bench.void(proposal.id, "its view is old")
    bench.operator.spin(OLD_S)
    bench.operator.confirm(proposal.id, StepConfirmation.APPROVE)


def spoofed_proposals(bench: Bench) -> None:
    """Proposals that make no sense, in mid-motion and after a stop, and their approvals."""

    def no_number(proposal: PickPlace) -> None:
        proposal.pick.x = math.nan

    def far_away(proposal: PickPlace) -> None:
        proposal.place.y = 5.0

    def too_fast(proposal: PickPlace) -> None:
        proposal.settings.travel_m_s = 50.0

    def approve(change: Callable[[PickPlace], None]) -> None:
        proposal = propose(bench, change)
        bench.void(proposal.id, "it makes no sense")
        bench.operator.spin(0.1)
        bench.operator.confirm(proposal.id, StepConfirmation.APPROVE)

    approve(no_number)
    stop(bench)
    bench.operator.spin(0.6)
    for change in (no_number, far_away, too_fast):
        approve(change)


def full_disk(bench: Bench) -> None:
    """The recorder's disk is full: it ends and says why, and the arm can be stopped."""
    full = ["sh", "-c", f"trap '' XFSZ; ulimit -f {DISK_BLOCKS}; exec \"$@\"", "sh"]
    recorder = bench.start("sctn", "bag", "record", "--all", "--out", bench.logs / f"bag-{time.monotonic()}", prefix=full)
    # It finds the graph first, which takes its time on a busy machine.
    end = time.monotonic() + 40.0
    while recorder.exit_code is None and time.monotonic() < end:
        bench.cell.repeat_heightmap(bench.cell.newest_heightmap)
        bench.operator.spin(0.1)
    assert recorder.exit_code, f"the recorder did not end: {recorder.log()}"
    assert "the disk is full" in recorder.errors(), recorder.log()
    stop(bench)


def clock_jumps(bench: Bench) -> None:
    """/clock jumps forth and back in mid-motion; then the arm is stopped."""
    for ahead_s in (100.0, -100.0, 0.0, 3600.0, -3600.0):
        bench.clock_ahead_s = ahead_s
        bench.operator.spin(0.1)
    stop(bench)
    bench.operator.spin(0.3)
    bench.clock_ahead_s = 0.0


def partition(bench: Bench) -> None:
    """The executor's host is cut off: the watchdog on the driver's host stops the arm."""
    # From when the link is cut: until then the executor acts, also where the machine is busy.
    bench.link.lose(1.0)
    bench.stopped(REST_AFTER_DEATH_S)
    bench.operator.spin(2.0)
    bench.link.lose(0.0)


def stop_with_loss(bench: Bench) -> None:
    """A stop while a fifth of all datagrams is lost."""
    bench.link.lose(LOSS)
    bench.operator.spin(0.5)
    bench.stopped(REST_WITH_LOSS_S)
    bench.operator.confirm(bench.proposal.id, StepConfirmation.STOP)


def whole_step_with_loss(bench: Bench) -> None:
    """A proposal, its approval, motion and stop while a fifth of all datagrams is lost."""
    stop(bench)
    bench.operator.spin(0.6)
    bench.link.lose(LOSS)
    begin(bench)
    bench.operator.spin(1.0)
    bench.stopped(REST_WITH_LOSS_S)
    bench.operator.confirm(bench.proposal.id, StepConfirmation.STOP)


# Of the whole graph. Only where they are named: `--kinds`. Some runs hang on a busy machine, for a reason that is not known yet.
GONE = [gone(name, number) for name in ("goal_oracle", *GRAPH) for number in (signal.SIGKILL, signal.SIGSTOP)]

FAULTS = [
    stop,
    stop_naming_no_proposal,
    kill_executor,
    terminate_executor,
    killed("watchdog", signal.SIGKILL),
    killed("watchdog", signal.SIGTERM),
    killed("driver", signal.SIGKILL),
    killed("driver", signal.SIGTERM),
    freeze_executor,
    freeze_driver,
    freeze_watchdog,
    robot("protective_stop"),
    robot("emergency_stop"),
    robot("program_stopped"),
    robot("driver_dead"),
    controllers_inactive,
    speed_changes,
    path_tolerance,
    vacuum_leaks,
    tool_voltage_off,
    spoofed_approvals,
    spoofed_proposals,
    superseded_approval,
    approval_of_another,
    stale_messages,
    stale_view,
    another_executor,
    stop_while_suction_is_on,
    unapproved_way_home,
    full_disk,
    clock_jumps,
    partition,
    stop_with_loss,
    whole_step_with_loss,
    advance_is_repeated,
    kill_executor_after_step,
    freeze_oracle,
    step_with_loss,
]

# Faults that need another cell than the usual one.
LAYOUTS = {
    clock_jumps: Layout.CLOCK,
    partition: Layout.TWO_HOSTS,
    stop_with_loss: Layout.TWO_HOSTS,
    whole_step_with_loss: Layout.TWO_HOSTS,
    step_with_loss: Layout.TWO_HOSTS,
    **dict.fromkeys(GONE, Layout.WHOLE_GRAPH),
}
