"""`sctn operate`: a person at a terminal decides for a graph that runs, as on a real cell: nothing measures rewards."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from campaign_cell import arguments
from cell_operator import STREAM, Operator
from processes import Process
from rcl_interfaces.srv import SetParameters
from rclpy.action import ActionClient
from rclpy.parameter import Parameter
from sctn_msgs.action import ExecutePickPlace
from sctn_msgs.msg import PickPlace, StepConfirmation, StepResult
from test_hardware import DISK, VACUUM_PIN, look_at, look_at_disk, propose, wait_until_moving
from test_refusals import Cell
from ur_msgs.msg import IOStates


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
    # The next view is from after that.
    terminal.cell.operator.spin(0.5)
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


def test_a_goal_of_the_action_is_offered_at_the_terminal(terminal: Terminal) -> None:
    operator = terminal.cell.operator
    execute = ActionClient(operator.node, ExecutePickPlace, "execute_pick_place")
    operator.until(execute.server_is_ready, "action", 30.0)
    operator.until(lambda: operator.node.get_subscriptions_info_by_topic("/pick_place_goal"), "terminal that hears goals", 30.0)
    proposal = propose(terminal.cell)
    terminal.shows("carry it out?")
    goal = copy.deepcopy(proposal)
    goal.id = proposal.id + 1000
    sending = execute.send_goal_async(ExecutePickPlace.Goal(proposal=goal))
    operator.until(sending.done, "answer to the goal", 30.0)
    assert sending.result().accepted
    terminal.shows("carry it out?")
    after = operator.count("step_result")
    terminal.says("n")
    assert ended(terminal, after, goal.id).outcome == StepResult.REJECTED


def test_after_a_fault_a_person_puts_down_what_is_held_and_has_the_step_tried_again(terminal: Terminal) -> None:
    cell, operator = terminal.cell, terminal.cell.operator
    decided: list[StepConfirmation] = []
    operator.node.create_subscription(StepConfirmation, "step_confirmation", decided.append, 10)
    pins: list[IOStates] = []
    operator.node.create_subscription(IOStates, "io_and_status_controller/io_states", pins.append, STREAM)
    client = operator.node.create_client(SetParameters, "sim_workcell/set_parameters")
    operator.until(client.service_is_ready, "sim_workcell", 30.0)

    def holds() -> bool:
        return bool(pins) and any(pin.pin == VACUUM_PIN and pin.state for pin in pins[-1].digital_in_states)

    def robot_is(fault: str) -> None:
        value = Parameter("hardware.fault", Parameter.Type.STRING, fault).to_parameter_msg()
        answer = client.call_async(SetParameters.Request(parameters=[value]))
        operator.until(answer.done, "answer of sim_workcell", 30.0)
        assert answer.result().results[0].successful, answer.result()

    def pick_the_disk(proposal: PickPlace) -> None:
        proposal.pick = DISK

    terminal.says("r")
    terminal.shows("no step was broken off")
    terminal.says("p")
    terminal.shows("holds nothing")
    after = operator.count("step_result")
    proposal = cell.propose(cell.observe(look_at_disk(cell)), pick_the_disk)
    terminal.shows("carry it out?")
    terminal.says("y")
    operator.until(holds, "vacuum", 30.0)
    # Lifted, and on its way.
    operator.spin(1.5)
    robot_is("protective_stop")
    fault = ended(terminal, after, proposal.id)
    assert fault.outcome == StepResult.FAULT, fault
    terminal.shows("the arm stands where it is")
    robot_is("none")
    operator.states.clear()
    operator.until(operator.executor_is_ready, "executor that is ready again", 30.0)
    assert holds()
    after = operator.count("step_result")
    terminal.says("p")
    terminal.shows("what is held is put down where it was picked")
    terminal.shows("carry it out?")
    # Nothing moves before that.
    assert holds()
    terminal.says("y")
    put_down = operator.next("step_result", after)
    assert put_down.outcome == StepResult.AT_HOME and "put down where it was picked" in put_down.reason, put_down
    assert not holds()
    terminal.says("r")
    operator.until(lambda: decided and decided[-1].decision == StepConfirmation.RETRY, "RETRY", 30.0)
    assert decided[-1].proposal_id == proposal.id
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
