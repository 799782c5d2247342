"""A person only watches: what is seen after a motion says which goal is next, and every proposal is carried out."""

from __future__ import annotations

import json
import statistics

import pytest
from cell_operator import Operator
from processes import free_domain
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


def test_a_demonstration_is_repeated_from_another_start_with_nobody_deciding(start, operator: Operator) -> None:
    launch = start(
        "sctn", "launch", "--problem", "stacking", "--seed", 10000, "--demonstration-seed", 10001, "--goal-module", "sequence",
        "--operator", "watch", "--json",
    )  # fmt: skip
    goal = operator.next("goal", accept=lambda goal: goal.step == goal.step_count, timeout_s=200.0)
    assert goal.previous.rows == goal.heightmap.rows > 0
    assert launch.wait(120.0) == 0, launch.log()
    outcome = json.loads(launch.output().splitlines()[-1])
    assert outcome["completed"] is True and outcome["reward"] == pytest.approx(1.0), outcome
    assert operator.newest("pick_place").checkpoint == "any_start"


def test_only_proposals_that_are_not_sure_to_succeed_wait_for_the_operator(start, operator: Operator) -> None:
    launch = ["sctn", "launch", "--problem", "stacking", "--seed", 10000, "--demonstration-seed", 10001, "--goal-module", "sequence"]
    # What the policy says of the steps of this run, whichever policy is shipped: about half of them are to be asked for.
    said = set()
    with Operator(before := free_domain()) as witness:
        start(*launch, "--operator", "none", domain=before)
        witness.listeners = 3
        while not is_complete(witness):
            proposal = witness.next("pick_place", len(said))
            said.add(proposal.success_probability)
            assert witness.approve(proposal).outcome == StepResult.PLACED
            witness.until(lambda: witness.count("pick_place") > len(said) or is_complete(witness), "next proposal", timeout_s=60.0)
    threshold = statistics.median(said)
    assert min(said) < threshold
    start(*launch, "--operator", "none", "--require-approval", "unsure", "--sure-probability", threshold)
    operator.listeners = 3
    asked = 0
    while not is_complete(operator):
        proposals, results = operator.count("pick_place"), operator.count("step_result")
        proposal = operator.next("pick_place", max(proposals - 1, 0))
        if proposal.success_probability < threshold and not has_result(operator, proposal.id):
            operator.spin(1.0)
            assert not has_result(operator, proposal.id), "an unsure proposal moved without an approval"
            assert operator.approve(proposal).outcome == StepResult.PLACED
            asked += 1
        operator.until(
            lambda known=(proposals, results): operator.count("pick_place") > known[0] or is_complete(operator),
            "next proposal",
            timeout_s=60.0,
        )
    placed = [result for result in operator.received["step_result"] if result.outcome == StepResult.PLACED]
    assert 0 < asked < len(placed)


def is_complete(operator: Operator) -> bool:
    """Whether the last goal that was received says that all steps are done."""
    return bool(operator.received["goal"]) and operator.newest("goal").complete


def has_result(operator: Operator, proposal_id: int) -> bool:
    """Whether the executor has said what became of a proposal."""
    return any(result.proposal_id == proposal_id for result in operator.received["step_result"])


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
