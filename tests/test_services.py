"""Services and the action beside the topics, called from rclpy as anybody would, and twice where a reply could be lost."""

from __future__ import annotations

import importlib.util
import pathlib
import signal
import sys
import uuid
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest
from action_msgs.msg import GoalStatus
from bag_contents import contents
from cell_operator import Operator, nanoseconds
from geometry_msgs.msg import Pose2D
from processes import REPOSITORY, free_domain
from rclpy.action import ActionClient
from rclpy.client import Client
from sctn_msgs.action import ExecutePickPlace
from sctn_msgs.msg import Goal, Heightmap, PickPlace, PrimitiveSettings, StepConfirmation, StepResult
from sctn_msgs.srv import CaptureGoal, LoadDemonstration, ResetCell, SetStep

SETTINGS = PrimitiveSettings(clearance_m=0.12, lift_m=0.08, travel_m_s=0.5, carry_m_s=0.25, descend_m_s=0.05, acceleration_m_s2=1.0)


# A disk of placing with seed 10000.
DISK = Pose2D(x=0.4354, y=0.1635, theta=0.0)


def console_client() -> Any:
    """The example client of the operator's page as a module."""
    path = REPOSITORY / "docs/examples/operator_console.py"
    specification = importlib.util.spec_from_file_location("operator_console_client", path)
    module = importlib.util.module_from_spec(specification)
    sys.modules[specification.name] = module
    specification.loader.exec_module(module)
    return module


class Cell:
    """The simulated cell, fusion, oracle and executor, and a test in the place of policy and operator."""

    def __init__(self, operator: Operator) -> None:
        self.operator = operator
        node = operator.node
        self.load = node.create_client(LoadDemonstration, "goal_oracle/load_demonstration")
        self.capture = node.create_client(CaptureGoal, "goal_oracle/capture_goal")
        self.set_step = node.create_client(SetStep, "goal_oracle/set_step")
        self.reset = node.create_client(ResetCell, "sim_workcell/reset")
        self.execute = ActionClient(node, ExecutePickPlace, "execute_pick_place")
        self._id = 1000

    def wait_until_ready(self) -> None:
        ends = [self.load, self.capture, self.set_step, self.reset]
        self.operator.until(
            lambda: all(client.service_is_ready() for client in ends) and self.operator.has_heard("goal_oracle", "/heightmap"),
            "servers",
            60.0,
        )
        self.wait_for_executor()
        self.operator.next("heightmap")

    def wait_for_executor(self) -> None:
        self.operator.until(
            lambda: (
                self.execute.server_is_ready()
                and self.operator.executor_is_ready()
                and self.operator.has_heard("suction_executor", "/heightmap")
            ),
            "executor that sees the cell",
            60.0,
        )
        self.operator.next("joint_states")

    def call(self, client: Client, request: object) -> object:
        """Asks again where no reply comes, under the same id: the first can be lost while the ends still meet."""
        for _ in range(5):
            future = client.call_async(request)
            try:
                self.operator.until(future.done, f"reply of {client.srv_name}", 5.0)
                return future.result()
            except TimeoutError:
                client.remove_pending_request(future)
        raise TimeoutError(f"no reply of {client.srv_name}")

    def heightmap(self) -> Heightmap:
        return self.operator.newest("heightmap")

    def proposal(self, **changes: object) -> PickPlace:
        """A good proposal of our own, from the present heightmap."""
        self._id += 1
        fields = {
            "header": self.heightmap().header,
            "id": self._id,
            "problem": "placing",
            "step": 1,
            "pick": Pose2D(x=0.5, y=0.2, theta=0.0),
            "place": Pose2D(x=0.5, y=-0.2, theta=0.0),
            "settings": SETTINGS,
            "module": "placing",
        }
        return PickPlace(**{**fields, **changes})

    def send(self, proposal: PickPlace) -> tuple[object, list[ExecutePickPlace.Feedback]]:
        """Sends a goal; its handle, and a list that fills with feedback."""
        feedback: list[ExecutePickPlace.Feedback] = []
        sending = self.execute.send_goal_async(
            ExecutePickPlace.Goal(proposal=proposal), feedback_callback=lambda message: feedback.append(message.feedback)
        )
        self.operator.until(sending.done, "answer to the goal", 60.0)
        return sending.result(), feedback

    def result(self, handle: object) -> object:
        future = handle.get_result_async()
        self.operator.until(future.done, "result of the goal", 120.0)
        return future.result()

    def awaits_approval(self, feedback: list[ExecutePickPlace.Feedback]) -> None:
        self.reaches(ExecutePickPlace.Feedback.AWAITING_APPROVAL, feedback)

    def reaches(self, phase: int, feedback: list[ExecutePickPlace.Feedback]) -> None:
        self.operator.until(lambda: any(message.phase == phase for message in feedback), f"phase {phase}", 60.0)


@pytest.fixture(scope="module")
def demonstration(start_for_module, tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """The folder of one demonstration of placing."""
    out = tmp_path_factory.mktemp("demonstrations")
    demos = start_for_module("sctn", "demos", "--problem", "placing", "--episodes", 1, "--seed", 0, "--out", out)
    assert demos.wait(120.0) == 0, demos.log()
    return out / "placing" / "000000"


@pytest.fixture(scope="module")
def cell(start_for_module, operator_for_module: Operator) -> Cell:
    start_for_module("sim_workcell", "--ros-args", "-p", "problem:=placing", "-p", "seed:=10000")
    start_for_module("camera_fusion", "--ros-args", "-p", "use_sim_time:=true")
    start_for_module("goal_oracle", "--ros-args", "-p", "use_sim_time:=true", "-p", "start_empty:=true")
    start_for_module("suction_executor", "--ros-args", "-p", "use_sim_time:=true")
    cell = Cell(operator_for_module)
    cell.wait_until_ready()
    return cell


def name() -> str:
    return str(uuid.uuid4())


def newest_goal(cell: Cell, after: int, **fields: object) -> Goal:
    return cell.operator.next("goal", after, lambda goal: all(getattr(goal, field) == value for field, value in fields.items()))


def test_a_sequence_is_taught_from_nothing_and_a_repeated_call_captures_nothing_more(cell: Cell) -> None:
    refused = cell.call(cell.capture, CaptureGoal.Request(request_id=name()))
    assert not refused.success
    assert "settings" in refused.message
    goals = cell.operator.count("goal")
    request = CaptureGoal.Request(request_id=name(), append=True, module="placing", settings=SETTINGS)
    first = cell.call(cell.capture, request)
    assert first.success, first.message
    assert (first.step, first.step_count) == (1, 1)
    goal = newest_goal(cell, goals, step=1, step_count=1)
    assert np.array_equal(goal.heightmap.height_m, cell.heightmap().height_m)
    assert goal.heightmap.views == 3
    assert cell.call(cell.capture, request) == first
    second = cell.call(cell.capture, CaptureGoal.Request(request_id=name(), append=True))
    assert (second.step, second.step_count) == (2, 2)


def test_a_demonstration_is_loaded_and_what_is_none_is_refused_by_its_path(cell: Cell, demonstration: pathlib.Path) -> None:
    refused = cell.call(cell.load, LoadDemonstration.Request(request_id=name(), path="/no/such/bag"))
    assert not refused.success
    assert "/no/such/bag" in refused.message
    goals = cell.operator.count("goal")
    loaded = cell.call(cell.load, LoadDemonstration.Request(request_id=name(), path=str(demonstration)))
    assert loaded.success, loaded.message
    assert loaded.demonstration == "placing/0"
    goal = newest_goal(cell, goals, demonstration="placing/0", step=1)
    assert goal.step_count == loaded.step_count > 1


def test_the_step_is_set_and_one_that_is_not_there_is_refused(cell: Cell, demonstration: pathlib.Path) -> None:
    loaded = cell.call(cell.load, LoadDemonstration.Request(request_id=name(), path=str(demonstration)))
    goals = cell.operator.count("goal")
    request = SetStep.Request(request_id=name(), step=2)
    first = cell.call(cell.set_step, request)
    assert first.success
    assert (first.step, first.step_count) == (2, loaded.step_count)
    newest_goal(cell, goals, step=2)
    # The same call again, after somebody else's: answered as before, and nothing changes.
    cell.call(cell.set_step, SetStep.Request(request_id=name(), step=1))
    assert cell.call(cell.set_step, request) == first
    present = cell.call(cell.set_step, SetStep.Request(request_id=name(), step=1))
    assert present.step == 1
    for step in (0, loaded.step_count + 1):
        refused = cell.call(cell.set_step, SetStep.Request(request_id=name(), step=step))
        assert not refused.success
        assert f"step is {step}" in refused.message


def test_the_cell_is_reset_to_a_seed_once_and_time_goes_on(cell: Cell) -> None:
    before = cell.heightmap()
    request = ResetCell.Request(request_id=name(), seed=10002)
    first = cell.call(cell.reset, request)
    assert first.success, first.message
    assert nanoseconds(first.stamp) > nanoseconds(before.header.stamp)
    after = cell.operator.next("heightmap", 0, lambda made: nanoseconds(made.header.stamp) >= nanoseconds(first.stamp))
    assert not np.array_equal(after.height_m, before.height_m)
    heightmaps = cell.operator.count("heightmap")
    assert cell.call(cell.reset, request) == first
    cell.operator.spin(1.5)
    assert cell.operator.count("heightmap") == heightmaps
    # The scene that was there before is there again.
    again = cell.call(cell.reset, ResetCell.Request(request_id=name(), seed=10000))
    same = cell.operator.next("heightmap", 0, lambda made: nanoseconds(made.header.stamp) >= nanoseconds(again.stamp))
    assert np.array_equal(same.height_m, before.height_m)
    refused = cell.call(cell.reset, ResetCell.Request(request_id=name(), problem="no_such_problem"))
    assert not refused.success
    assert "no_such_problem" in refused.message


def test_a_reset_that_names_no_problem_keeps_that_of_the_reset_before(cell: Cell) -> None:
    def heightmap_of(problem: str) -> Heightmap:
        begun = cell.call(cell.reset, ResetCell.Request(request_id=name(), problem=problem, seed=10000))
        assert begun.success, begun.message
        return cell.operator.next("heightmap", 0, lambda made: nanoseconds(made.header.stamp) >= nanoseconds(begun.stamp))

    placing = heightmap_of("")
    stacking = heightmap_of("stacking")
    assert not np.array_equal(stacking.height_m, placing.height_m)
    assert np.array_equal(heightmap_of("").height_m, stacking.height_m)
    assert np.array_equal(heightmap_of("placing").height_m, placing.height_m)


@pytest.mark.parametrize("client", ["load", "capture", "set_step", "reset"])
def test_a_request_without_an_id_is_refused(cell: Cell, client: str) -> None:
    client = getattr(cell, client)
    refused = cell.call(client, client.srv_type.Request())
    assert not refused.success
    assert "request_id" in refused.message


def test_a_goal_waits_for_its_approval_and_says_its_phases(cell: Cell) -> None:
    proposal = cell.proposal()
    handle, feedback = cell.send(proposal)
    assert handle.accepted
    cell.awaits_approval(feedback)
    home = np.array(cell.operator.newest("joint_states").position)
    cell.operator.spin(1.0)
    assert np.abs(np.array(cell.operator.newest("joint_states").position) - home).max() < 1e-4
    cell.operator.confirm(proposal.id, StepConfirmation.APPROVE)
    end = cell.result(handle)
    result = end.result.result
    assert result.proposal_id == proposal.id
    succeeded = end.status == GoalStatus.STATUS_SUCCEEDED
    assert succeeded == (result.outcome == StepResult.PLACED), result
    assert result.outcome in (StepResult.PLACED, StepResult.NO_CONTACT, StepResult.GRASP_FAILED)
    # The result comes by another way than the feedback.
    cell.reaches(10, feedback)
    phases = [message.phase for message in feedback]
    assert phases == sorted(phases)
    assert {0, 1, 2, 10} <= set(phases) <= set(range(11))
    # The topic says the same.
    assert cell.operator.next("step_result", 0, lambda said: said.proposal_id == proposal.id) == result
    # A late question for the result has the same answer.
    assert cell.result(handle).result.result == result


def test_a_goal_is_seen_by_page_and_oracle_and_a_bag_of_the_run_holds_it_as_a_step(
    cell: Cell, start, demonstration: pathlib.Path, tmp_path: pathlib.Path
) -> None:
    operator = cell.operator
    began = cell.call(cell.reset, ResetCell.Request(request_id=name(), problem="placing", seed=10000))
    operator.next("heightmap", 0, lambda made: nanoseconds(made.header.stamp) >= nanoseconds(began.stamp))
    goals = operator.count("goal")
    cell.call(cell.load, LoadDemonstration.Request(request_id=name(), path=str(demonstration)))
    goal = newest_goal(cell, goals, step=1)
    address = tmp_path / "address"
    start("operator_console", "--ros-args", "-p", "port:=0", "-p", f"address_file:={address}", "-p", "use_sim_time:=true")
    bag = tmp_path / "run"
    topics = ["heightmap", "pick_place", "pick_place_goal", "step_confirmation", "step_result", "reward"]
    recorder = start("sctn", "bag", "record", *(f"/{topic}" for topic in topics), "--out", bag, "--json")
    # Oracle, page and recorder; and for confirmations the executor.
    operator.until(lambda: len(operator.node.get_subscriptions_info_by_topic("/pick_place_goal")) >= 3, "readers of goals", 60.0)
    operator.listeners = 4
    operator.until(lambda: operator.has_heard("operator_console", "/heightmap"), "page that sees the cell", 60.0)
    page = console_client().Console(address.read_text().strip(), "a program")
    try:
        proposal = cell.proposal(pick=DISK, attempt=goal.attempt)
        handle, feedback = cell.send(proposal)
        cell.awaits_approval(feedback)
        operator.until(lambda: (page.state()["proposal"] or {}).get("id") == str(proposal.id), "proposal on the page", 60.0)
        operator.confirm(proposal.id, StepConfirmation.APPROVE)
        end = cell.result(handle).result.result
        assert end.outcome == StepResult.PLACED, end
        operator.next("heightmap", 0, lambda made: nanoseconds(made.header.stamp) >= nanoseconds(end.header.stamp))
        goals = operator.count("goal")
        operator.confirm(proposal.id, StepConfirmation.ADVANCE)
        newest_goal(cell, goals, step=2)
    finally:
        operator.listeners = 1
    recorder.signal(signal.SIGINT)
    assert recorder.wait(60.0) == 0, recorder.log()
    assert [said for _, said in contents(bag, "/pick_place_goal") if said.id == proposal.id]
    data = tmp_path / "data"
    export = start("sctn", "bag", "export", bag, "--out", data, "--json")
    assert export.wait(60.0) == 0, export.log()
    (step,) = pyarrow.parquet.read_table(data / "data").to_pylist()
    poses = [coordinate for pose in (proposal.pick, proposal.place) for coordinate in (pose.x, pose.y, pose.theta)]
    assert np.allclose(step["action"], poses, atol=1e-6)


def test_one_goal_runs_and_others_are_rejected_with_a_reason(cell: Cell) -> None:
    first, feedback = cell.send(cell.proposal())
    cell.awaits_approval(feedback)
    others = [cell.proposal() for _ in range(2)]
    for other in others:
        handle, _ = cell.send(other)
        assert not handle.accepted
        answer = cell.operator.next("step_result", 0, lambda said: said.proposal_id == other.id)
        assert answer.outcome == StepResult.REFUSED
        assert "is active" in answer.reason
    cancelling = first.cancel_goal_async()
    cell.operator.until(cancelling.done, "answer to the cancel", 60.0)
    end = cell.result(first)
    assert end.status == GoalStatus.STATUS_CANCELED
    assert end.result.result.outcome == StepResult.STOPPED
    # The topic says the same, before or after.
    proposal_id = end.result.result.proposal_id
    assert cell.operator.next("step_result", 0, lambda said: said.proposal_id == proposal_id) == end.result.result
    # What was cancelled cannot be approved any more.
    after = cell.operator.count("step_result")
    cell.operator.confirm(proposal_id, StepConfirmation.APPROVE)
    refused = cell.operator.next("step_result", after, lambda said: said.proposal_id == proposal_id)
    assert refused.outcome == StepResult.REFUSED
    assert "withdrawn" in refused.reason


def test_a_goal_that_the_gate_refuses_moves_nothing(cell: Cell) -> None:
    bad, _ = cell.send(cell.proposal(pick=Pose2D(x=0.9, y=0.0, theta=0.0)))
    assert not bad.accepted
    rejected = cell.proposal()
    handle, feedback = cell.send(rejected)
    cell.awaits_approval(feedback)
    cell.operator.confirm(rejected.id, StepConfirmation.REJECT)
    end = cell.result(handle)
    assert end.status == GoalStatus.STATUS_ABORTED
    assert end.result.result.outcome == StepResult.REJECTED


def test_without_required_approvals_a_goal_moves_at_once_and_a_cancel_stops_the_arm_where_it_is(start) -> None:
    domain = free_domain()
    start("sim_workcell", "--ros-args", "-p", "real_time_factor:=1.0", domain=domain)
    start("camera_fusion", "--ros-args", "-p", "use_sim_time:=true", domain=domain)
    start("suction_executor", "--ros-args", "-p", "use_sim_time:=true", "-p", "require_approval:=never", domain=domain)
    with Operator(domain) as operator:
        cell = Cell(operator)
        cell.wait_for_executor()
        operator.next("heightmap")
        home = np.array(operator.newest("joint_states").position)
        handle, feedback = cell.send(cell.proposal())
        assert handle.accepted
        operator.until(lambda: feedback, "phase", 60.0)
        assert feedback[0].phase == ExecutePickPlace.Feedback.APPROACH
        operator.next("joint_states", 0, lambda state: np.abs(np.array(state.position) - home).max() > 1e-2)
        cancelling = handle.cancel_goal_async()
        operator.until(cancelling.done, "answer to the cancel", 60.0)
        end = cell.result(handle)
        assert end.status == GoalStatus.STATUS_CANCELED
        assert end.result.result.outcome == StepResult.STOPPED
        # Simulated time stands still with the arm. Joint states of the motion may still be on their way.
        states = operator.received["joint_states"]
        operator.until(lambda: states[-1] == states[-2], "arm that stands still", 60.0)
        stopped = states[-1]
        assert np.abs(np.array(stopped.position) - home).max() > 1e-3
        after = len(states)
        operator.spin(1.0)
        assert len(states) > after
        assert all(state == stopped for state in states[after:])
