"""Nothing moves without a valid approval, and every refusal has its reason in `step_result`.

The executor and the simulated cell are real; this test speaks in place of fusion, policy and operator.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from cell_operator import LATCHED, Operator, nanoseconds
from geometry_msgs.msg import Point, Pose2D
from processes import free_domain
from rcl_interfaces.srv import SetParameters
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from sctn_msgs.msg import Heightmap, PickPlace, PrimitiveSettings, StepConfirmation, StepResult
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

ROWS, COLS, PIXEL_SIZE_M = 320, 160, 0.003125
SETTINGS = PrimitiveSettings(clearance_m=0.12, lift_m=0.08, travel_m_s=0.5, carry_m_s=0.25, descend_m_s=0.05, acceleration_m_s2=1.0)

# How long the arm is watched for a motion that must not come; an approved one starts within a fraction of this.
WATCH_S = 2.0
# The controller's own noise; a motion of the primitive is a thousand times larger.
STILL_RAD = 1e-4


class Cell:
    """The executor with the simulated arm, and a test that plays everybody else."""

    def __init__(self, operator: Operator) -> None:
        self.operator = operator
        self._heightmaps = operator.node.create_publisher(Heightmap, "heightmap", LATCHED)
        self._proposals = operator.node.create_publisher(PickPlace, "pick_place", LATCHED)
        self._id = 0
        self.newest_heightmap: Heightmap | None = None

    def wait_until_ready(self) -> None:
        """Everybody knows everybody, and the arm has reported where it stands."""
        self.operator.until(
            # The operator subscribes to both itself.
            lambda: (
                min(self._heightmaps.get_subscription_count(), self._proposals.get_subscription_count()) >= 2
                and self.operator.executor_is_ready()
            ),
            "executor that listens",
            60.0,
        )
        self.operator.next("joint_states")

    def observe(self, change: Callable[[Heightmap], None] = lambda _: None) -> Heightmap:
        """Publishes a heightmap of an empty table, with a stamp of now."""
        self.operator.spin(0.1)
        heightmap = Heightmap(
            header=Header(stamp=self._now(), frame_id="world"),
            rows=ROWS,
            cols=COLS,
            pixel_size_m=PIXEL_SIZE_M,
            origin=Point(x=0.25, y=-0.5, z=0.0),
            z_min_m=0.0,
            z_max_m=0.28,
            rgb=np.full(3 * ROWS * COLS, 100, dtype=np.uint8),
            height_m=np.zeros(ROWS * COLS, dtype=np.float32),
            views=3,
            coverage=1.0,
        )
        change(heightmap)
        self.repeat_heightmap(heightmap)
        return heightmap

    def repeat_heightmap(self, heightmap: Heightmap) -> None:
        """Publishes a heightmap, maybe once more."""
        self.newest_heightmap = heightmap
        self._publish(self._heightmaps, heightmap)

    def stop_publishing_heightmaps(self) -> None:
        """The camera fusion has gone."""
        self.operator.node.destroy_publisher(self._heightmaps)

    def propose(self, heightmap: Heightmap, change: Callable[[PickPlace], None] = lambda _: None) -> PickPlace:
        """Publishes a proposal that is good unless changed."""
        self._id += 1
        proposal = PickPlace(
            header=copy.deepcopy(heightmap.header),
            id=self._id,
            problem="placing",
            step=1,
            attempt=0,
            pick=Pose2D(x=0.5, y=0.2, theta=0.0),
            place=Pose2D(x=0.5, y=-0.2, theta=0.0),
            pick_score=1.0,
            place_score=1.0,
            settings=copy.deepcopy(SETTINGS),
            module="placing",
        )
        change(proposal)
        self.repeat(proposal)
        return proposal

    def repeat(self, proposal: PickPlace) -> None:
        """Publishes a proposal once more."""
        self._publish(self._proposals, proposal)

    def decide(self, proposal_id: int, decision: int = StepConfirmation.APPROVE) -> StepResult:
        """Says a word and returns the answer to it."""
        after = self.operator.count("step_result")
        self.operator.confirm(proposal_id, decision)
        return self.operator.next("step_result", after, lambda result: result.proposal_id == proposal_id)

    def assert_still(self) -> None:
        """The arm does not move for a while."""
        before = self.joints()
        first = self.operator.count("joint_states")
        self.operator.spin(WATCH_S)
        reported = self.operator.received["joint_states"][first:]
        assert reported, "no joint states came while watching"
        travel = max(np.abs(np.array(state.position) - before).max() for state in reported)
        assert travel < STILL_RAD, f"the arm moved by {travel} rad"

    def joints(self) -> np.ndarray:
        """Joint positions in the order of the message, no older than the executor's last word [rad]."""
        return np.array(self.rest_state().position)

    def rest_state(self) -> JointState:
        """A new joint state, no older than the executor's last word: a busy machine hands over older ones after it."""
        return self.operator.next(
            "joint_states",
            self.operator.count("joint_states"),
            lambda state: nanoseconds(state.header.stamp) >= nanoseconds(self._last_word()),
        )

    def _last_word(self) -> Time:
        said = self.operator.received["step_result"]
        return said[-1].header.stamp if said else Time()

    @staticmethod
    def _publish(publisher: Publisher, message: Heightmap | PickPlace) -> None:
        """Returns when the executor has it: a lost packet is sent again."""
        publisher.publish(message)
        assert publisher.wait_for_all_acked(Duration(seconds=60)), f"{publisher.topic_name} was not acknowledged"

    def _now(self) -> Time:
        # A clock may come later than what was said at its time.
        clocks = [message.clock for message in self.operator.received["clock"][-1:]]
        return max([*clocks, self._last_word()], key=nanoseconds)


@pytest.fixture(scope="module")
def cell(start_for_module, operator_for_module: Operator) -> Cell:
    start_for_module("sim_workcell", "--ros-args", "-p", "problem:=placing", "-p", "seed:=10000")
    start_for_module("suction_executor", "--ros-args", "-p", "use_sim_time:=true")
    cell = Cell(operator_for_module)
    cell.wait_until_ready()
    return cell


def refused(cell: Cell, result: StepResult, *reasons: str) -> None:
    """The answer is a refusal that gives the reason, and the arm stays where it is."""
    assert result.outcome == StepResult.REFUSED, result
    for reason in reasons:
        assert reason in result.reason, result.reason
    cell.assert_still()


def test_without_a_confirmation_nothing_moves(cell: Cell) -> None:
    results = cell.operator.count("step_result")
    cell.propose(cell.observe())
    cell.assert_still()
    assert cell.operator.count("step_result") == results


def test_a_rejected_proposal_moves_nothing_and_cannot_be_approved_later(cell: Cell) -> None:
    proposal = cell.propose(cell.observe())
    assert cell.decide(proposal.id, StepConfirmation.REJECT).outcome == StepResult.REJECTED
    cell.assert_still()
    refused(cell, cell.decide(proposal.id), "already rejected")


def test_a_stale_approval_moves_nothing(cell: Cell) -> None:
    heightmap = cell.observe()
    old = cell.propose(heightmap)
    cell.propose(heightmap)
    refused(cell, cell.decide(old.id), str(old.id), "superseded")


def test_an_approval_of_an_unknown_proposal_moves_nothing(cell: Cell) -> None:
    cell.propose(cell.observe())
    refused(cell, cell.decide(123_456_789), "123456789", "unknown")


@pytest.mark.parametrize("which", ["pick", "place"])
@pytest.mark.parametrize(("x", "y"), [(0.8, 0.0), (0.2, 0.0), (0.5, 0.6), (0.5, -0.6)])
def test_a_pose_outside_the_workspace_moves_nothing(cell: Cell, which: str, x: float, y: float) -> None:
    def move_outside(proposal: PickPlace) -> None:
        setattr(proposal, which, Pose2D(x=x, y=y, theta=0.0))

    result = cell.decide(cell.propose(cell.observe(), move_outside).id)
    assert result.outcome == StepResult.REFUSED
    assert which in result.reason
    assert "outside the workspace" in result.reason


@pytest.mark.parametrize("which", ["pick", "place"])
@pytest.mark.parametrize("field", ["x", "y", "theta"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_pose_that_is_not_finite_moves_nothing(cell: Cell, which: str, field: str, value: float) -> None:
    result = cell.decide(cell.propose(cell.observe(), lambda proposal: setattr(getattr(proposal, which), field, value)).id)
    assert result.outcome == StepResult.REFUSED
    assert which in result.reason


@pytest.mark.parametrize("value", [math.nan, -0.1, 50.0])
def test_settings_out_of_range_move_nothing(cell: Cell, value: float) -> None:
    result = cell.decide(cell.propose(cell.observe(), lambda proposal: setattr(proposal.settings, "travel_m_s", value)).id)
    assert result.outcome == StepResult.REFUSED
    assert "travel_m_s" in result.reason


def test_all_those_bad_proposals_left_the_arm_where_it_was(cell: Cell) -> None:
    home = cell.joints()
    bad = cell.propose(cell.observe(), lambda proposal: setattr(proposal.pick, "x", math.nan))
    refused(cell, cell.decide(bad.id), "pick")
    assert np.abs(cell.joints() - home).max() < STILL_RAD


def test_a_proposal_in_another_frame_moves_nothing(cell: Cell) -> None:
    result = cell.decide(cell.propose(cell.observe(), lambda proposal: setattr(proposal.header, "frame_id", "camera")).id)
    refused(cell, result, "camera", "world")


def test_an_approval_after_the_observation_changed_moves_nothing(cell: Cell) -> None:
    proposal = cell.propose(cell.observe())

    def put_a_box_there(heightmap: Heightmap) -> None:
        heights = np.zeros((ROWS, COLS), dtype=np.float32)
        heights[100:150, 50:100] = 0.05
        heightmap.height_m = heights.ravel()
        # Later than the proposal's, also where simulated time stands still.
        heightmap.header.stamp.sec += 1

    cell.observe(put_a_box_there)
    cell.operator.spin(0.5)
    refused(cell, cell.decide(proposal.id), "changed")


def test_a_way_through_something_moves_nothing(cell: Cell) -> None:
    def wall(heightmap: Heightmap) -> None:
        """0.3 m high and 19 mm thick, across the table between pick and place."""
        heights_m = np.zeros((ROWS, COLS), dtype=np.float32)
        heights_m[157:163] = 0.3
        heightmap.height_m = heights_m.ravel()
        # Simulated time stands still: a view of its own all the same.
        heightmap.header.stamp.nanosec += 1_000

    refused(cell, cell.decide(cell.propose(cell.observe(wall)).id), "the heightmap at (", "expected 0.01")


def test_a_proposal_from_a_heightmap_that_nobody_saw_moves_nothing(cell: Cell) -> None:
    heightmap = cell.observe()
    heightmap.header.stamp.sec += 1000
    refused(cell, cell.decide(cell.propose(heightmap).id), "has not arrived")


def test_a_good_proposal_does_move_and_a_duplicate_approval_moves_nothing(cell: Cell) -> None:
    """Also the proof that the tests above could have failed."""
    proposal = cell.propose(cell.observe())
    home = cell.joints()
    first = cell.operator.count("joint_states")
    moved = cell.decide(proposal.id)
    assert moved.outcome not in (StepResult.REFUSED, StepResult.REJECTED, StepResult.FAULT), moved.reason
    assert moved.duration.sec > 0
    reported = cell.operator.received["joint_states"][first:]
    assert max(np.abs(np.array(state.position) - home).max() for state in reported) > 0.2
    refused(cell, cell.decide(proposal.id), "already carried out")
    # The same message once more is no new proposal.
    cell.repeat(proposal)
    refused(cell, cell.decide(proposal.id), "already carried out")


def test_a_proposal_from_before_the_last_motion_moves_nothing(cell: Cell) -> None:
    heightmap = cell.observe()
    proposal = cell.propose(heightmap)
    assert cell.decide(proposal.id).duration.sec > 0
    refused(cell, cell.decide(cell.propose(heightmap).id), "before the last motion")


def test_nobody_on_the_network_weakens_what_the_executor_asks_for(start) -> None:
    domain = free_domain()
    start("sim_workcell", "--ros-args", "-p", "problem:=placing", "-p", "seed:=10000", domain=domain)
    start("suction_executor", "--ros-args", "-p", "use_sim_time:=true", "-p", "require_approval:=unsure", domain=domain)
    with Operator(domain) as operator:
        cell = Cell(operator)
        cell.wait_until_ready()
        client = operator.node.create_client(SetParameters, "suction_executor/set_parameters")
        operator.until(client.service_is_ready, "parameters of the executor", 30.0)
        weaker = {
            "require_approval": "never",
            "sure_probability": 0.0,
            "presence_timeout_s": 1000.0,
            "stop_file": "/dev/null",
            "limits.travel_m_s": 9.0,
            "joints.acceleration_rad_s2": 99.0,
            "observation_changed_area_mm2": 1e6,
            "observation_max_age_s": 1000.0,
            "collision_margin_m": 0.0,
            "driver.enable_pin": 3,
            "driver.status_max_age_s": 1000.0,
        }
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg() for name, value in weaker.items()])
        answer = client.call_async(request)
        operator.until(answer.done, "answer of the executor", 30.0)
        for name, result in zip(weaker, answer.result().results, strict=True):
            assert not result.successful and f"{name} is read when the node is started" in result.reason, result
        # It is not sure to succeed, and nobody is asked.
        cell.propose(cell.observe(), lambda proposal: setattr(proposal, "success_probability", 0.5))
        cell.assert_still()
