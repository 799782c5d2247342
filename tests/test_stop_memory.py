"""A stop outlives the executor's process: with `stop_file` nothing moves by itself after a restart until somebody approves."""

from __future__ import annotations

import pathlib
import signal
from collections.abc import Callable

import pytest
from campaign_cell import CampaignCell
from cell_operator import LATCHED, Operator, nanoseconds
from processes import Process
from sctn_msgs.msg import PickPlace, PlannedMotion, StepConfirmation, StepResult
from test_hardware import look_at, rest_after, wait_until_moving
from whole_run import parameters

# How long the arm is watched for a motion that must not come; where it may it begins within half a second.
WATCH_S = 2.0


class StoppedCell:
    """Simulated hardware as it is, and an executor that is killed and started again; the test plays everybody else."""

    def __init__(self, start: Callable[..., Process], operator: Operator, require_approval: str, stop_file: pathlib.Path | None) -> None:
        start("sim_workcell", *parameters("sim_workcell", seed=10000))
        self._start = start
        self.operator = operator
        self.cell = CampaignCell(operator)
        self._values: dict[str, object] = {"require_approval": require_approval} | ({"stop_file": stop_file} if stop_file else {})
        # The arm goes on from where a stop left it, and the test takes its time.
        self._values |= {"observation_needs_home": "false", "observation_max_age_s": 60.0}
        self.planned: list[PlannedMotion] = []
        operator.node.create_subscription(PlannedMotion, "planned_motion", self.planned.append, LATCHED)
        self.executor = self.start_executor()
        self.cell.wait_until_ready()

    def start_executor(self) -> Process:
        return self._start("suction_executor", *parameters("suction_executor", **self._values))

    def _readers(self) -> set[bytes]:
        """The endpoints that hear confirmations."""
        found = self.operator.node.get_subscriptions_info_by_topic("step_confirmation")
        return {bytes(reader.endpoint_gid) for reader in found}

    def kill_executor(self) -> None:
        self.executor.signal(signal.SIGKILL)
        self.executor.wait(10.0)
        self.operator.until(lambda: rest_after(self.cell, 0.5) == 0.0, "arm at rest", 60.0)

    def start_executor_again(self) -> None:
        """Returns when it has planned the proposal that is latched: it would have begun to move by then."""
        self.planned.clear()
        before = self._readers()
        self.executor = self.start_executor()
        self.operator.until(lambda: self._readers() - before, "executor that was started again", 30.0)
        self.operator.states.clear()
        self.operator.until(self.operator.executor_is_ready, "executor that is ready again", 60.0)
        self.operator.until(lambda: self.planned, "planned motion", 30.0)
        assert self.planned[-1].reason == "", "it could move"

    def propose(self) -> PickPlace:
        """A proposal that is sure to succeed, and that the executor has heard."""

        def sure(proposal: PickPlace) -> None:
            proposal.success_probability = 1.0

        proposal = self.cell.propose(self.cell.observe(look_at(self.cell)), sure)
        self.operator.until(lambda: any(plan.proposal_id == proposal.id for plan in self.planned), "planned motion", 30.0)
        return proposal

    def moves_unasked(self) -> PickPlace:
        """A proposal that moves the arm by itself."""
        proposal = self.propose()
        wait_until_moving(self.cell)
        return proposal

    def stays(self) -> None:
        """Nothing moves for a while."""
        assert rest_after(self.cell, WATCH_S) == 0.0

    def moves_by_approval(self) -> None:
        """A proposal is approved, moves, and is carried out to its end; the one after it moves by itself."""
        proposal = self.propose()
        self.stays()
        after = self.operator.count("step_result")
        self.operator.confirm(proposal.id, StepConfirmation.APPROVE)
        wait_until_moving(self.cell)
        ended = self.operator.next("step_result", after, lambda result: result.proposal_id == proposal.id)
        assert ended.outcome not in (StepResult.FAULT, StepResult.STOPPED, StepResult.REFUSED), ended
        # What is seen from then on.
        self.operator.next("joint_states", 0, lambda state: nanoseconds(state.header.stamp) > nanoseconds(ended.header.stamp))
        self.moves_unasked()


@pytest.fixture
def stop_file(tmp_path: pathlib.Path) -> pathlib.Path:
    """In a folder that does not exist yet."""
    return tmp_path / "sctn/cell/stopped"


@pytest.mark.parametrize("require_approval", ["never", "unsure"])
def test_after_a_stop_and_a_restart_nothing_moves_by_itself_until_an_approval(
    start, operator: Operator, stop_file: pathlib.Path, require_approval: str
) -> None:
    cell = StoppedCell(start, operator, require_approval, stop_file)
    after = operator.count("step_result")
    proposal = cell.moves_unasked()
    operator.confirm(proposal.id, StepConfirmation.STOP)
    stopped = operator.next("step_result", after, lambda result: result.proposal_id == proposal.id)
    assert stopped.outcome == StepResult.STOPPED, stopped
    assert stop_file.exists()
    cell.kill_executor()
    cell.start_executor_again()
    cell.stays()
    assert "stopped before this start" in cell.executor.errors()
    cell.moves_by_approval()


def test_an_executor_that_was_killed_in_mid_motion_moves_nothing_by_itself_when_it_is_started_again(
    start, operator: Operator, stop_file: pathlib.Path
) -> None:
    cell = StoppedCell(start, operator, "never", stop_file)
    cell.moves_unasked()
    # Nobody has said anything; who or what has killed it is not known.
    cell.kill_executor()
    cell.start_executor_again()
    cell.stays()
    assert "in the middle of the motion of proposal" in cell.executor.errors()
    # Killed and started once more it is no other.
    cell.kill_executor()
    cell.start_executor_again()
    cell.stays()


def test_without_a_file_a_restart_forgets_the_stop(start, operator: Operator) -> None:
    cell = StoppedCell(start, operator, "never", None)
    after = operator.count("step_result")
    proposal = cell.moves_unasked()
    operator.confirm(proposal.id, StepConfirmation.STOP)
    operator.next("step_result", after, lambda result: result.proposal_id == proposal.id)
    cell.kill_executor()
    cell.executor = cell.start_executor()
    # What is latched moves by itself: this is what the file is for.
    wait_until_moving(cell.cell)


def test_a_stop_file_that_cannot_be_written_is_refused_at_the_start(start, tmp_path: pathlib.Path) -> None:
    file = tmp_path / "a_file"
    file.write_text("")
    process = start("suction_executor", *parameters("suction_executor", stop_file=file / "stopped"))
    assert process.wait(30.0) != 0
    assert "parameter stop_file" in process.errors() and "a_file" in process.errors()
