"""`sctn operate`: a person at a terminal decides for a graph that runs, as on a real cell: nothing measures rewards."""

from __future__ import annotations

import numpy as np
import pytest
from campaign_cell import arguments
from cell_operator import Operator
from processes import Process
from sctn_msgs.msg import PickPlace, StepConfirmation, StepResult
from test_hardware import look_at, propose, wait_until_moving
from test_refusals import Cell


class Terminal:
    """`sctn operate`, and who types at it."""

    def __init__(self, cell: Cell, process: Process) -> None:
        self.cell = cell
        self.process = process
        self._read = 0

    def shows(self, text: str) -> None:
        """Waits until it prints a text, after the one that was waited for last."""
        self.cell.operator.until(lambda: text in self.process.output()[self._read :], f"{text!r} in {self.process.output()!r}", 30.0)
        self._read = self.process.output().index(text, self._read) + len(text)

    def says(self, line: str) -> None:
        self.process.type(line)

    def offered(self) -> PickPlace:
        """A new proposal, offered at the terminal."""
        proposal = propose(self.cell)
        self.shows("step 1/")
        self.shows("carry it out?")
        return proposal


@pytest.fixture
def terminal(start, operator: Operator) -> Terminal:
    start("sim_workcell", *arguments("sim_workcell", seed=10000))
    cell = Cell(operator)
    start("suction_executor", *arguments("suction_executor", require_presence="true"))
    process = start("sctn", "operate", "--name", "anna", typed=True)
    cell.wait_until_ready()
    operator.until(lambda: "sctn_operate" in operator.node.get_node_names(), "sctn operate", 30.0)
    return Terminal(cell, process)


def ended(terminal: Terminal, after: int, proposal_id: int) -> StepResult:
    """The result of a proposal."""
    return terminal.cell.operator.next("step_result", after, lambda result: result.proposal_id == proposal_id)


def test_a_person_at_the_terminal_rejects_approves_stops_and_calls_the_arm_home(terminal: Terminal) -> None:
    operator = terminal.cell.operator
    decided: list[StepConfirmation] = []
    operator.node.create_subscription(StepConfirmation, "step_confirmation", decided.append, 10)
    after = operator.count("step_result")
    rejected = terminal.offered()
    terminal.says("what?")
    terminal.shows("at any time")
    terminal.says("n")
    assert ended(terminal, after, rejected.id).outcome == StepResult.REJECTED
    proposal = terminal.offered()
    terminal.says("y")
    wait_until_moving(terminal.cell)
    terminal.says("s")
    stopped = ended(terminal, after, proposal.id)
    assert stopped.outcome == StepResult.STOPPED, stopped
    terminal.shows("the arm stands where it is")
    terminal.says("h")
    terminal.shows("the way home")
    terminal.shows("carry it out?")
    terminal.says("y")
    terminal.shows("at home")
    # A step that was carried out is asked about, without a reward.
    proposal = terminal.offered()
    terminal.says("y")
    result = ended(terminal, after, proposal.id)
    if result.outcome == StepResult.REFUSED:
        # The newest view may be of a moment before the motion had ended.
        assert "before the last motion ended" in result.reason
        proposal = terminal.offered()
        terminal.says("y")
        result = ended(terminal, after, proposal.id)
    assert result.outcome == StepResult.GRASP_FAILED, result
    terminal.shows("did the step succeed?")
    terminal.says("n")
    operator.until(lambda: decided and decided[-1].decision == StepConfirmation.RETRY, "RETRY", 30.0)
    assert {said.operator_name for said in decided} == {"anna"}


def test_an_arm_whose_terminal_is_closed_in_mid_motion_stops(terminal: Terminal) -> None:
    after = terminal.cell.operator.count("step_result")
    proposal = terminal.offered()
    terminal.says("y")
    wait_until_moving(terminal.cell)
    terminal.process.close_terminal()
    assert ended(terminal, after, proposal.id).outcome == StepResult.STOPPED
    assert terminal.process.wait(10.0) == 0
    # With nobody at a terminal nothing moves.
    proposal = terminal.cell.propose(terminal.cell.observe(look_at(terminal.cell)))
    before = np.array(terminal.cell.operator.newest("joint_states").position)
    refused = terminal.cell.decide(proposal.id)
    assert refused.outcome == StepResult.REFUSED and "no operator is present" in refused.reason, refused
    assert np.abs(np.array(terminal.cell.operator.newest("joint_states").position) - before).max() < 1e-3
