"""A cell whose driver behaves as a real one: late answers, servo lag, vacuum that takes time, processes that die."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from cell_operator import NAME, STREAM, Operator
from geometry_msgs.msg import Pose2D
from processes import REPOSITORY
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sctn_msgs.msg import Heightmap, PickPlace, StepConfirmation, StepResult
from sctn_msgs.srv import ProposeHome
from test_refusals import Cell
from ur_msgs.msg import IOStates
from whole_run import OBSERVATION_MAX_AGE_S, parameters

# Problems, signs of contact, and how many motions each may take: every step may be tried again a few times, the policy is learned.
WHOLE_RUNS = {("placing", "until_action"): 3 * 9, ("stacking", "until_action"): 3 * 6, ("placing", "height"): 3 * 9}
# A disk of placing with seed 10000.
DISK, DISK_RADIUS_M, DISK_HEIGHT_M = Pose2D(x=0.4354, y=0.1635, theta=0.0), 0.028, 0.012
VACUUM_PIN = 16
# The way of a cancel and the braking of the arm, which takes 0.15 s.
REST_AFTER_STOP_S = 0.4
# The same after the watchdog's timeout.
REST_AFTER_DEATH_S = 0.6


@pytest.fixture(scope="module", autouse=True)
def whole_runs(request: pytest.FixtureRequest) -> Iterator[dict[tuple[str, str], subprocess.Popen[str]]]:
    """The whole runs that are asked for, begun before the first test of this file: they take real time, and little of the processor."""
    whole_run = test_a_whole_run_completes_with_a_driver_as_it_is
    asked_for = [item.callspec.params for item in request.session.items if item.originalname == whole_run.__name__]
    runs = {}
    for run in ((params["problem"], params["contact"]) for params in asked_for):
        problem, contact = run
        command = [sys.executable, REPOSITORY / "tests/whole_run.py", problem, "10000", str(WHOLE_RUNS[run]), contact]
        runs[run] = subprocess.Popen(
            command, cwd=REPOSITORY / "tests", stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
    try:
        yield runs
    finally:
        for run in runs.values():
            # It ends what it has started.
            run.terminate()
            run.wait(30.0)


@pytest.fixture
def cell(start, operator: Operator) -> Cell:
    """Simulated cell and executor; the test plays everybody else."""
    start("sim_workcell", *parameters("sim_workcell", seed=10000))
    cell = Cell(operator)
    cell.executor = start("suction_executor", *parameters("suction_executor"))
    cell.wait_until_ready()
    return cell


def look_at(cell: Cell) -> Callable[[Heightmap], None]:
    """A heightmap of now, in which the table is there: black at height 0 is what no camera has seen."""

    def look(heightmap: Heightmap) -> None:
        heightmap.rgb = np.full(len(heightmap.rgb), 90, dtype=np.uint8)
        heightmap.header.stamp = cell.rest_state().header.stamp

    return look


def propose(cell: Cell) -> PickPlace:
    """A proposal from a heightmap of now."""
    return cell.propose(cell.observe(look_at(cell)))


def wait_until_moving(cell: Cell) -> None:
    """The arm has left its place."""
    before = np.array(cell.operator.newest("joint_states").position)
    cell.operator.until(lambda: np.abs(np.array(cell.operator.newest("joint_states").position) - before).max() > 0.1, "motion", 30.0)


def rest_after(cell: Cell, seconds: float) -> float:
    """Watches the arm for some time, and returns after how much of it nothing moved any more [s]."""
    begin = time.monotonic()
    moved = 0.0
    last = np.array(cell.operator.newest("joint_states").position)
    while time.monotonic() - begin < seconds:
        cell.operator.spin(0.02)
        now = np.array(cell.operator.newest("joint_states").position)
        if np.abs(now - last).max() > 5e-4:
            moved = time.monotonic() - begin
        last = now
    return moved


def seconds_in_motion(cell: Cell, seconds: float) -> float:
    """Watches the arm for some time, and returns for how much of it something moved [s]."""
    moved = 0.0
    begin = before = time.monotonic()
    last = np.array(cell.operator.newest("joint_states").position)
    while before - begin < seconds:
        cell.operator.spin(0.02)
        now = np.array(cell.operator.newest("joint_states").position)
        after = time.monotonic()
        if np.abs(now - last).max() > 5e-4:
            moved += after - before
        last, before = now, after
    return moved


def start_watchdog(cell: Cell, start) -> None:
    """The watchdog, once it hears the executor."""
    start("motion_watchdog", "--ros-args", "--params-file", REPOSITORY / "config/motion_watchdog.yaml")
    cell.operator.until(lambda: "motion_watchdog" in cell.operator.node.get_node_names(), "watchdog", 30.0)
    cell.operator.spin(1.0)


def test_an_executor_that_is_told_to_end_in_mid_motion_stops_the_arm_first(cell: Cell) -> None:
    # There is no watchdog: the executor does it itself.
    after = cell.operator.count("step_result")
    proposal = propose(cell)
    cell.operator.confirm(proposal.id, StepConfirmation.APPROVE)
    wait_until_moving(cell)
    cell.executor.signal(signal.SIGTERM)
    moved_s = rest_after(cell, 3.0)
    print(f"the arm came to rest {moved_s:.2f} s after SIGTERM")
    assert moved_s < REST_AFTER_STOP_S
    result = cell.operator.next("step_result", after, lambda result: result.proposal_id == proposal.id)
    assert result.outcome == StepResult.STOPPED, result
    assert "told to end" in result.reason, result.reason
    assert cell.executor.wait(5.0) == 0


def test_an_executor_that_ends_while_a_goal_is_unanswered_leaves_its_cancelling_to_the_watchdog(cell: Cell, start) -> None:
    start_watchdog(cell, start)
    proposal = propose(cell)
    cell.operator.confirm(proposal.id, StepConfirmation.APPROVE)
    wait_until_moving(cell)
    # Over the pick: the descent is asked for, and is answered a second or two later.
    cell.operator.until(lambda: rest_after(cell, 0.4) == 0.0, "end of the approach", 60.0)
    cell.executor.signal(signal.SIGKILL)
    # It is accepted when the executor is long gone, and cancelled at once.
    moved_s = seconds_in_motion(cell, 4.0)
    print(f"the arm moved for {moved_s:.2f} s")
    assert moved_s < REST_AFTER_STOP_S


def test_an_executor_that_is_killed_in_mid_motion_does_not_leave_the_arm_moving(cell: Cell, start) -> None:
    start_watchdog(cell, start)
    proposal = propose(cell)
    cell.operator.confirm(proposal.id, StepConfirmation.APPROVE)
    wait_until_moving(cell)
    cell.executor.signal(signal.SIGKILL)
    moved_s = rest_after(cell, 3.0)
    print(f"the arm came to rest {moved_s:.2f} s after the executor was killed")
    assert moved_s < REST_AFTER_DEATH_S


def test_a_stop_during_an_unanswered_descent_keeps_the_arm_where_it_is(cell: Cell) -> None:
    proposal = propose(cell)
    after = cell.operator.count("step_result")
    cell.operator.confirm(proposal.id, StepConfirmation.APPROVE)
    wait_until_moving(cell)
    # Over the pick: the descent is asked for, and is answered a second or two later.
    cell.operator.until(lambda: rest_after(cell, 0.4) == 0.0, "end of the approach", 60.0)
    said = time.monotonic()
    cell.operator.confirm(proposal.id, StepConfirmation.STOP)
    result = cell.operator.next("step_result", after, lambda result: result.proposal_id == proposal.id)
    took_s = time.monotonic() - said
    assert result.outcome == StepResult.STOPPED, result
    print(f"the stop was answered after {took_s:.2f} s")
    assert took_s < 1.0
    assert rest_after(cell, 3.0) < 0.1


def test_a_heightmap_with_the_arm_in_view_is_no_ground_to_move_on(cell: Cell) -> None:
    proposal = propose(cell)
    after = cell.operator.count("step_result")
    cell.operator.confirm(proposal.id, StepConfirmation.APPROVE)
    wait_until_moving(cell)
    cell.operator.confirm(proposal.id, StepConfirmation.STOP)
    stopped = cell.operator.next("step_result", after, lambda result: result.proposal_id == proposal.id)
    assert stopped.outcome == StepResult.STOPPED, stopped
    # Seen long after the end of the motion, by an arm at rest: only where it rests is wrong.
    cell.operator.spin(1.0)
    refused = cell.decide(propose(cell).id)
    assert refused.outcome == StepResult.REFUSED
    assert "the arm was not at home and at rest" in refused.reason
    assert rest_after(cell, 1.0) == 0.0


def test_an_approval_on_a_view_that_is_old_moves_nothing(cell: Cell) -> None:
    proposal = propose(cell)
    # Fusion or cameras have died.
    cell.operator.spin(OBSERVATION_MAX_AGE_S + 0.2)
    refused = cell.decide(proposal.id)
    assert refused.outcome == StepResult.REFUSED
    assert "observation_max_age_s" in refused.reason, refused.reason
    assert rest_after(cell, 1.0) == 0.0
    # With a fresh one the same proposal moves.
    cell.observe(look_at(cell))
    cell.operator.confirm(proposal.id, StepConfirmation.APPROVE)
    wait_until_moving(cell)


def test_a_goal_that_the_driver_rejects_is_a_fault_and_nothing_moves(start, operator: Operator) -> None:
    controller = "scaled_joint_trajectory_controller"
    start("sim_workcell", *parameters("sim_workcell", seed=10000, hardware__inactive_controllers=f"[{controller}]"))
    cell = Cell(operator)
    # An executor that looks at the controllers moves nothing at all: this one asks the driver.
    start("suction_executor", *parameters("suction_executor", driver__check_controllers="false"))
    cell.wait_until_ready()
    proposal = propose(cell)
    result = cell.decide(proposal.id)
    assert result.outcome == StepResult.FAULT, result
    assert "reject" in result.reason, result.reason
    assert rest_after(cell, 1.0) == 0.0
    # It is over: the same approval moves nothing later.
    assert cell.decide(proposal.id).outcome == StepResult.REFUSED


def test_an_arm_that_leaves_its_path_is_a_fault_and_stays_where_it_is(start, operator: Operator) -> None:
    start("sim_workcell", *parameters("sim_workcell", seed=10000, hardware__servo_delay_s=0.5))
    cell = Cell(operator)
    start("suction_executor", *parameters("suction_executor"))
    cell.wait_until_ready()
    after = operator.count("step_result")
    proposal = propose(cell)
    operator.confirm(proposal.id, StepConfirmation.APPROVE)
    result = operator.next("step_result", after, lambda result: result.proposal_id == proposal.id)
    assert result.outcome == StepResult.FAULT, result
    assert "path tolerance" in result.reason
    assert rest_after(cell, 2.0) == 0.0


def test_a_second_executor_does_not_become_active(cell: Cell, start) -> None:
    second = start("suction_executor", *parameters("suction_executor"))
    assert second.wait(30.0) != 0
    assert "another executor is active" in second.errors()
    # The first one works on.
    cell.operator.confirm(propose(cell).id, StepConfirmation.APPROVE)
    wait_until_moving(cell)


def test_of_two_executors_that_start_at_the_same_time_one_works(start, operator: Operator) -> None:
    start("sim_workcell", *parameters("sim_workcell", seed=10000))
    cell = Cell(operator)
    both = [start("suction_executor", *parameters("suction_executor")) for _ in range(2)]
    operator.until(lambda: any(executor.exit_code is not None for executor in both), "executor that gives way", 30.0)
    (gone,) = [executor for executor in both if executor.exit_code is not None]
    assert gone.exit_code != 0 and "another executor is active" in gone.errors()
    cell.wait_until_ready()
    cell.operator.confirm(propose(cell).id, StepConfirmation.APPROVE)
    wait_until_moving(cell)


def test_the_way_home_moves_only_by_an_approval_of_that_very_proposal(cell: Cell) -> None:
    client = cell.operator.node.create_client(ProposeHome, "suction_executor/propose_home")

    def propose_home() -> ProposeHome.Response:
        cell.operator.until(client.service_is_ready, "service propose_home", 30.0)
        answer = client.call_async(ProposeHome.Request())
        cell.operator.until(answer.done, "answer of propose_home", 30.0)
        return answer.result()

    proposal = propose(cell)
    after = cell.operator.count("step_result")
    cell.operator.confirm(proposal.id, StepConfirmation.APPROVE)
    wait_until_moving(cell)
    busy = propose_home()
    assert not busy.success and "being carried out" in busy.message
    cell.operator.confirm(proposal.id, StepConfirmation.STOP)
    cell.operator.next("step_result", after, lambda result: result.proposal_id == proposal.id)
    first = propose_home()
    assert first.success and first.needs_approval, first.message
    # Said twice it is the same one; no other approval moves the arm, and a stop withdraws it.
    assert propose_home().proposal_id == first.proposal_id
    assert cell.decide(proposal.id).outcome == StepResult.REFUSED
    assert cell.decide(first.proposal_id, StepConfirmation.STOP).outcome == StepResult.STOPPED
    assert cell.decide(first.proposal_id).outcome == StepResult.REFUSED
    assert rest_after(cell, 1.0) == 0.0
    second = propose_home()
    assert second.proposal_id != first.proposal_id
    assert cell.decide(second.proposal_id).outcome == StepResult.AT_HOME
    assert cell.decide(second.proposal_id).outcome == StepResult.REFUSED


def test_the_approval_of_somebody_who_does_not_decide_is_refused_by_name_and_everybody_may_stop(start, operator: Operator) -> None:
    start("sim_workcell", *parameters("sim_workcell", seed=10000))
    cell = Cell(operator)
    start("suction_executor", *parameters("suction_executor", operators=f'["{NAME}"]'))
    cell.wait_until_ready()
    proposal = propose(cell)
    after = operator.count("step_result")
    operator.confirm(proposal.id, StepConfirmation.APPROVE, "eve")
    refused = operator.next("step_result", after, lambda result: result.proposal_id == proposal.id)
    assert refused.outcome == StepResult.REFUSED, refused
    assert "`eve` does not decide here" in refused.reason and NAME in refused.reason, refused.reason
    assert rest_after(cell, 1.0) == 0.0
    # It can still be approved by who decides; anybody stops it.
    after = operator.count("step_result")
    cell.observe(look_at(cell))
    operator.confirm(proposal.id, StepConfirmation.APPROVE)
    wait_until_moving(cell)
    operator.confirm(proposal.id, StepConfirmation.STOP, "eve")
    stopped = operator.next("step_result", after, lambda result: result.proposal_id == proposal.id)
    assert stopped.outcome == StepResult.STOPPED, stopped


def look_at_disk(cell: Cell) -> Callable[[Heightmap], None]:
    """A heightmap of now with the disk of the simulated cell that `DISK` names."""

    def look(heightmap: Heightmap) -> None:
        look_at(cell)(heightmap)
        rows, cols = np.mgrid[: heightmap.rows, : heightmap.cols]
        x_m = heightmap.origin.x + (cols + 0.5) * heightmap.pixel_size_m
        y_m = heightmap.origin.y + (rows + 0.5) * heightmap.pixel_size_m
        heightmap.height_m = np.where(np.hypot(x_m - DISK.x, y_m - DISK.y) < DISK_RADIUS_M, DISK_HEIGHT_M, 0.0).astype(np.float32).ravel()

    return look


def test_what_is_held_after_a_stop_is_put_down_where_it_was_picked(cell: Cell) -> None:
    operator = cell.operator
    pins: list[IOStates] = []
    operator.node.create_subscription(IOStates, "io_and_status_controller/io_states", pins.append, STREAM)
    client = operator.node.create_client(ProposeHome, "suction_executor/propose_put_down")

    def holds() -> bool:
        return bool(pins) and any(pin.pin == VACUUM_PIN and pin.state for pin in pins[-1].digital_in_states)

    def propose_put_down() -> ProposeHome.Response:
        operator.until(client.service_is_ready, "service propose_put_down", 30.0)
        answer = client.call_async(ProposeHome.Request())
        operator.until(answer.done, "answer of propose_put_down", 30.0)
        return answer.result()

    def stop_in_transfer() -> None:
        def pick_the_disk(proposal: PickPlace) -> None:
            proposal.pick = DISK

        proposal = cell.propose(cell.observe(look_at_disk(cell)), pick_the_disk)
        after = operator.count("step_result")
        operator.confirm(proposal.id, StepConfirmation.APPROVE)
        operator.until(holds, "vacuum", 30.0)
        # Lifted, and on its way.
        operator.spin(1.5)
        operator.confirm(proposal.id, StepConfirmation.STOP)
        stopped = operator.next("step_result", after, lambda result: result.proposal_id == proposal.id)
        assert stopped.outcome == StepResult.STOPPED, stopped

    operator.until(lambda: bool(pins), "io_states", 30.0)
    nothing = propose_put_down()
    assert not nothing.success and "holds nothing" in nothing.message
    stop_in_transfer()
    assert holds()
    put_down = propose_put_down()
    assert put_down.success and put_down.needs_approval, put_down.message
    # The call moves nothing.
    assert rest_after(cell, 1.0) == 0.0
    assert holds()
    ended = cell.decide(put_down.proposal_id)
    assert ended.outcome == StepResult.AT_HOME and "put down where it was picked" in ended.reason, ended
    assert not holds()
    # It stands where it stood: it can be picked there again.
    operator.spin(0.5)
    stop_in_transfer()


def test_letting_the_enabling_switch_go_stops_the_arm_and_nothing_moves_before_it_is_held(start, operator: Operator) -> None:
    start("sim_workcell", *parameters("sim_workcell", seed=10000, hardware__enable_pin=3))
    cell = Cell(operator)
    start("suction_executor", *parameters("suction_executor", driver__enable_pin=3))
    cell.wait_until_ready()
    client = operator.node.create_client(SetParameters, "sim_workcell/set_parameters")

    def enable(held: bool) -> None:
        operator.until(client.service_is_ready, "sim_workcell", 30.0)
        value = Parameter("hardware.enabled", Parameter.Type.BOOL, held).to_parameter_msg()
        answer = client.call_async(SetParameters.Request(parameters=[value]))
        operator.until(answer.done, "answer of sim_workcell", 30.0)
        assert answer.result().results[0].successful, answer.result()

    proposal = propose(cell)
    after = operator.count("step_result")
    operator.confirm(proposal.id, StepConfirmation.APPROVE)
    wait_until_moving(cell)
    enable(False)
    stopped = operator.next("step_result", after, lambda result: result.proposal_id == proposal.id)
    assert stopped.outcome == StepResult.STOPPED and "enabling input" in stopped.reason, stopped
    assert rest_after(cell, 1.0) < 0.1
    client_home = operator.node.create_client(ProposeHome, "suction_executor/propose_home")
    operator.until(client_home.service_is_ready, "service propose_home", 30.0)
    answer = client_home.call_async(ProposeHome.Request())
    operator.until(answer.done, "answer of propose_home", 30.0)
    assert not answer.result().success and "enable_pin" in answer.result().message, answer.result()


def test_an_approval_counts_only_while_somebody_publishes_heightmaps(start, operator: Operator) -> None:
    # Its age alone would let it move.
    start("sim_workcell", *parameters("sim_workcell", seed=10000))
    cell = Cell(operator)
    start("suction_executor", *parameters("suction_executor", observation_max_age_s=60.0))
    cell.wait_until_ready()
    proposal = propose(cell)
    cell.stop_publishing_heightmaps()
    operator.spin(0.5)
    refused = cell.decide(proposal.id)
    assert refused.outcome == StepResult.REFUSED and "nobody publishes heightmaps" in refused.reason, refused
    assert rest_after(cell, 1.0) == 0.0


def test_an_object_that_is_lost_in_mid_air_ends_as_dropped_with_the_arm_at_home(start, operator: Operator) -> None:
    # Lost on the transfer, which takes 3 s at 0.1 m/s.
    start("sim_workcell", *parameters("sim_workcell", seed=10000, hardware__vacuum_leak_s=3.0))
    cell = Cell(operator)
    start("suction_executor", *parameters("suction_executor"))
    cell.wait_until_ready()
    home = np.array(operator.newest("joint_states").position)

    def pick_the_disk(proposal: PickPlace) -> None:
        proposal.pick, proposal.place = DISK, Pose2D(x=0.5, y=-0.2, theta=0.0)
        proposal.settings.lift_m, proposal.settings.carry_m_s = 0.05, 0.1

    proposal = cell.propose(cell.observe(look_at_disk(cell)), pick_the_disk)
    result = cell.decide(proposal.id)
    assert result.outcome == StepResult.DROPPED, result
    assert np.abs(np.array(operator.newest("joint_states").position) - home).max() < 1e-2
    # It is over: nothing goes on by itself.
    assert rest_after(cell, 1.0) == 0.0


@pytest.mark.parametrize(("problem", "contact"), WHOLE_RUNS)
def test_a_whole_run_completes_with_a_driver_as_it_is(
    whole_runs: dict[tuple[str, str], subprocess.Popen[str]], problem: str, contact: str
) -> None:
    output, log = whole_runs[problem, contact].communicate(timeout=600.0)
    assert output, log
    result = json.loads(output)
    print(f"{problem} ({contact}): {len(result['outcomes'])} motions in {result['took_s']} s, total reward {result['total_reward']:.3f}")
    assert result["complete"], (result, log)
