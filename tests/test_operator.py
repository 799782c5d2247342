"""A Python operator carries a whole run of placing through, by topic only."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
from cell_operator import LATCHED, Operator, nanoseconds
from rclpy.duration import Duration
from sctn_msgs.msg import Goal, Heightmap, PickPlace, StepConfirmation, StepResult

NODES = {"camera_fusion", "goal_oracle", "gctn_policy", "suction_executor", "sim_workcell"}
DISKS = 9

# Each step may be tried again a few times: the policy is learned. The run has to end all the same.
MOST_PROPOSALS = 3 * DISKS


def test_an_operator_in_python_sees_the_graph_and_places_all_nine_disks(start, operator: Operator, domain: int) -> None:
    launch = start("sctn", "launch", "--problem", "placing", "--seed", 10000, "--operator", "none", "--processes")

    # Executor, oracle and policy.
    operator.listeners = 3
    heightmap = latched("heightmap", domain)
    check_heightmap(heightmap)
    assert (heightmap.views, heightmap.header.frame_id) == (3, "world")
    assert heightmap.coverage > 0.95
    goal = operator.next("goal")
    assert (goal.problem, goal.step, goal.step_count, goal.attempt, goal.complete) == ("placing", 1, DISKS, 0, False)
    check_heightmap(goal.heightmap)

    # The first proposal is rejected: nothing moves, and another one is made.
    first = next_proposal(operator, goal)
    with Operator(domain, "onlooker") as onlooker:
        names = onlooker.node.get_node_names_and_namespaces
        onlooker.until(lambda: NODES <= {name for name, _ in names()}, f"graph of {NODES}", 60.0)
        # A proposal is latched: who comes later sees it too.
        assert onlooker.next("pick_place") == first
    rejected = operator.count("step_result")
    operator.confirm(first.id, StepConfirmation.REJECT)
    result = operator.next("step_result", rejected)
    assert (result.proposal_id, result.outcome) == (first.id, StepResult.REJECTED)
    goal = next_goal(operator, step=1, attempt=1)
    proposal = next_proposal(operator, goal)
    assert proposal.id != first.id
    assert (proposal.pick.x, proposal.pick.y) != (first.pick.x, first.pick.y)

    # Somebody's garbage takes nothing away: its approval is refused, the policy says its own again, and that one can be approved.
    garbage = copy.deepcopy(proposal)
    garbage.id ^= 1
    garbage.pick.x = 9.0
    somebody = operator.node.create_publisher(PickPlace, "pick_place", LATCHED)
    # Executor, oracle, launch and this test.
    operator.until(lambda: somebody.get_subscription_count() >= 4, "readers of proposals", 30.0)
    somebody.publish(garbage)
    assert somebody.wait_for_all_acked(Duration(seconds=60))
    operator.next("pick_place", accept=lambda made: made.id == garbage.id)
    said = operator.count("pick_place")
    refusal = operator.approve(garbage)
    assert refusal.outcome == StepResult.REFUSED
    assert "outside the workspace" in refusal.reason
    assert operator.next("pick_place", said) == proposal
    operator.node.destroy_publisher(somebody)

    total, steps_done = 0.0, 0
    for _ in range(MOST_PROPOSALS):
        rewards = operator.count("reward")
        result = operator.approve(proposal)
        assert nanoseconds(result.duration) > 0, result.reason
        reward = operator.next("reward", rewards)
        total = reward.total
        steps_done += reward.delta > 0
        if reward.complete:
            break
        if reward.delta > 0:
            operator.confirm(proposal.id, StepConfirmation.ADVANCE)
            step, attempt = goal.step + 1, 0
        else:
            operator.confirm(proposal.id, StepConfirmation.RETRY)
            step, attempt = goal.step, goal.attempt + 1
        goal = next_goal(operator, step, attempt)
        proposal = next_proposal(operator, goal)

    assert steps_done == DISKS
    assert np.isclose(total, 1.0)
    # The launch watches the reward too, and ends the graph when the task is done.
    assert launch.wait(120.0) == 0, launch.log()
    assert "completed" in launch.output()
    assert launch.descendants() == []


def test_a_late_joiner_gets_the_latched_heightmap_and_goal(start, operator: Operator, domain: int) -> None:
    start("sctn", "launch", "--problem", "placing", "--seed", 10002, "--operator", "none", "--processes")
    goal = operator.next("goal")
    assert latched("goal", domain) == goal
    check_heightmap(latched("heightmap", domain))


def test_refusals_do_not_end_a_launch_whose_operator_is_elsewhere(start, operator: Operator) -> None:
    launch = start("sctn", "launch", "--problem", "placing", "--seed", 10008, "--operator", "none")
    operator.until(operator.executor_is_ready, "executor that has checked its driver", 60.0)
    proposal = next_proposal(operator, operator.next("goal"))
    unknown = copy.deepcopy(proposal)
    unknown.id += 1
    # One more than an automatic operator takes.
    for _ in range(6):
        assert operator.approve(unknown).outcome == StepResult.REFUSED
    assert operator.approve(proposal).outcome == StepResult.PLACED, launch.log()


def latched(topic: str, domain: int) -> Any:
    """What a late joiner gets of a latched topic."""
    with Operator(domain, "late_joiner") as late:
        return late.next(topic)


def check_heightmap(heightmap: Heightmap) -> None:
    """Sizes agree with each other, heights are those of disks."""
    cells = heightmap.rows * heightmap.cols
    assert (heightmap.rows, heightmap.cols) == (320, 160)
    assert len(heightmap.rgb) == 3 * cells
    assert len(heightmap.height_m) == cells
    assert np.isfinite(heights(heightmap)).all()
    assert 0.002 < heights(heightmap).max() < 0.3


def heights(heightmap: Heightmap) -> np.ndarray:
    """Height of each cell [m]."""
    return np.asarray(heightmap.height_m).reshape(heightmap.rows, heightmap.cols)


def next_goal(operator: Operator, step: int, attempt: int) -> Goal:
    """The goal of a step and attempt."""
    return operator.next("goal", accept=lambda goal: (goal.step, goal.attempt) == (step, attempt))


def next_proposal(operator: Operator, goal: Goal) -> PickPlace:
    """The proposal for a goal, made from an observation that is not older than the goal."""
    proposal = operator.next("pick_place", accept=lambda made: (made.step, made.attempt) == (goal.step, goal.attempt))
    assert nanoseconds(proposal.header.stamp) >= nanoseconds(goal.header.stamp)
    assert proposal.settings == goal.settings
    return proposal
