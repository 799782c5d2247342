"""A person only watches: what is seen after a motion says which goal is next, and every proposal is carried out."""

from __future__ import annotations

import json

import pytest
from cell_operator import Operator
from sctn_msgs.msg import StepConfirmation, StepResult


@pytest.mark.parametrize("goal_module", ["image_distance", "embedding"])
def test_placing_is_completed_with_a_person_only_watching(start, operator: Operator, goal_module: str) -> None:
    launch = start(
        "sctn", "launch", "--problem", "placing", "--seed", 10000, "--goal-module", goal_module, "--operator", "watch",
        "--json",
    )  # fmt: skip
    # What was seen led to the last of the goals.
    goal = operator.next("goal", accept=lambda goal: goal.step == goal.step_count, timeout_s=200.0)
    assert goal.step == 9
    assert launch.wait(120.0) == 0, launch.log()
    outcome = json.loads(launch.output().splitlines()[-1])
    assert outcome["completed"] is True and outcome["reward"] == pytest.approx(1.0), outcome


def test_a_stop_of_the_watcher_ends_the_motions(start, operator: Operator) -> None:
    start(
        "sctn", "launch", "--problem", "placing", "--seed", 10000, "--goal-module", "image_distance",
        "--operator", "watch",
    )  # fmt: skip
    # Executor, oracle and policy.
    operator.listeners = 3
    operator.next("step_result")
    before = operator.count("step_result")
    operator.confirm(0, StepConfirmation.STOP)
    # The end of the motion under way, or the answer to the stop where there was none.
    operator.next(
        "step_result",
        before,
        lambda said: said.outcome == StepResult.STOPPED or said.proposal_id == 0 or said.reason.startswith("the stop came"),
    )
    results = operator.count("step_result")
    operator.spin(2.5)
    assert operator.count("step_result") == results < 9
    assert not operator.newest("goal").complete
