"""What the fault campaign does to a cell while the arm moves."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable

from campaign_cell import UNDECIDED_S, Bench, Layout, begin, propose, propose_home
from sctn_msgs.msg import PickPlace, StepConfirmation

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
# A second executor has found out by then that there is one.
LISTENING_S = 2.0
# Suction is on within this time of a motion's beginning, or not any more.
SUCTION_S = 8.0
# A recorder cannot write more to one file [blocks of 512 bytes].
DISK_BLOCKS = 400
# observation_max_age_s of config/hardware/realistic.yaml, and some more [s].
OLD_S = 3.3

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
    """A second executor in mid-motion, then a stop and an approval of the old proposal: neither moves the arm."""
    second = bench.start_executor()
    end = time.monotonic() + LISTENING_S
    while second.exit_code is None and time.monotonic() < end:
        bench.operator.spin(0.05)
    stop(bench)
    bench.operator.confirm(bench.proposal.id, StepConfirmation.APPROVE)


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


FAULTS = [
    stop,
    stop_naming_no_proposal,
    kill_executor,
    terminate_executor,
    freeze_executor,
    freeze_driver,
    freeze_watchdog,
    robot("protective_stop"),
    robot("emergency_stop"),
    robot("program_stopped"),
    robot("driver_dead"),
    spoofed_approvals,
    spoofed_proposals,
    superseded_approval,
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
]

# Faults that need another cell than the usual one.
LAYOUTS = {
    clock_jumps: Layout.CLOCK,
    partition: Layout.TWO_HOSTS,
    stop_with_loss: Layout.TWO_HOSTS,
    whole_step_with_loss: Layout.TWO_HOSTS,
}
