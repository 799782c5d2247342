"""kill -9 of the recorder at random moments: every step whose result it has said to be recorded is in the recovered bag.

A recorder says every step result again, on `step_result/_recorded`, once the bag holds it. `sctn launch` goes on from these
alone. SCTN_KILLS: how many kills of each kind.
"""

from __future__ import annotations

import os
import pathlib
import random
import signal
import time

import pytest
from bag_contents import DEEP, contents, wait_for_recorder
from cell_operator import EVENT, Operator, nanoseconds
from sctn_msgs.msg import StepConfirmation, StepResult
from std_msgs.msg import String

KILLS = int(os.environ.get("SCTN_KILLS", "3"))
# Without waiting for the recorder's word: what was published so long before the kill is in the bag too.
SETTLED_S = 0.3


def recovered(start, partial: pathlib.Path, copy: pathlib.Path) -> pathlib.Path:
    """The repaired copy of a bag whose recorder was killed; it is whole."""
    recover = start("sctn", "bag", "recover", partial, "--out", copy)
    assert recover.wait(60.0) == 3, recover.log()
    assert start("sctn", "bag", "verify", copy).wait(60.0) == 0
    return copy


@pytest.mark.parametrize("seed", range(KILLS))
def test_a_killed_recorder_has_lost_no_result_that_it_has_said_to_be_recorded(
    start, operator: Operator, tmp_path: pathlib.Path, seed: int
) -> None:
    chance = random.Random(seed)
    recorder = start("sctn", "bag", "record", "--all", "--out", tmp_path / "bag")
    results = operator.node.create_publisher(StepResult, "/killed/step_result", EVENT)
    chatter = operator.node.create_publisher(String, "/killed/chatter", DEEP)
    said: list[StepResult] = []
    operator.node.create_subscription(StepResult, "/killed/step_result/_recorded", said.append, DEEP)
    wait_for_recorder(operator, results, chatter)
    kill_at = time.monotonic() + chance.uniform(0.8, 2.5)
    published: list[float] = []
    while time.monotonic() < kill_at or len(said) <= 3:
        for _ in range(20):
            chatter.publish(String(data="x" * chance.randrange(10_000)))
        results.publish(StepResult(proposal_id=len(published), outcome=StepResult.PLACED))
        published.append(time.monotonic())
        operator.spin(0.01)
    recorder.signal(signal.SIGKILL)
    killed = time.monotonic()
    recorder.wait(10.0)
    # What it has said before may still be on its way.
    operator.spin(0.5)
    copy = recovered(start, tmp_path / "bag.partial", tmp_path / "copy")
    saved = [result.proposal_id for _, result in contents(copy, "/killed/step_result")]
    assert saved == list(range(len(saved)))
    assert len(said) > 3
    assert [result.proposal_id for result in said] == list(range(said[0].proposal_id, said[-1].proposal_id + 1))
    assert said[-1].proposal_id < len(saved)
    assert len(saved) >= sum(at < killed - SETTLED_S for at in published)
    topics = {topic for topic, _ in contents(copy)}
    assert topics == {"/killed/step_result", "/killed/chatter"}, "what a recorder says itself is not recorded"


@pytest.mark.parametrize("seed", range(KILLS))
def test_of_a_killed_run_every_step_that_went_on_is_in_the_recovered_bag(
    start, operator: Operator, tmp_path: pathlib.Path, seed: int
) -> None:
    launch = start(
        "sctn", "launch", "--problem", "placing", "--seed", 11000 + seed, "--processes", "--record", tmp_path / "run",
        "--record-images",
    )  # fmt: skip
    said: list[StepResult] = []
    operator.node.create_subscription(StepResult, "step_result/_recorded", said.append, DEEP)
    confirmations: list[StepConfirmation] = []
    operator.node.create_subscription(StepConfirmation, "step_confirmation", confirmations.append, DEEP)
    operator.next("pick_place")
    # A moment of the run, however fast the machine is: after some of its nine steps, and a little later.
    moment = random.Random(seed)
    steps = moment.randrange(8)
    deadline = time.monotonic() + 60.0
    while len(said) < steps and time.monotonic() < deadline:
        operator.spin(0.02)
    operator.spin(moment.uniform(0.0, 0.3))
    assert launch.exit_code is None, launch.log()
    launch.signal(signal.SIGKILL)
    launch.wait(10.0)
    operator.spin(0.5)
    bag = tmp_path / "run/run.partial"
    copy = recovered(start, bag, tmp_path / "copy")

    found: dict[str, list] = {}
    for topic, message in contents(copy, "/heightmap", "/pick_place", "/step_confirmation", "/step_result", "/reward"):
        found.setdefault(topic, []).append(message)
    results = {result.proposal_id for result in found.get("/step_result", [])}
    # What the operator was told, what he went on from, and what the recorder has said.
    told = launch.output().count(", delta reward ")
    gone_on = {c.proposal_id for c in confirmations if c.decision in (StepConfirmation.ADVANCE, StepConfirmation.RETRY)}
    kept = {result.proposal_id for result in said}
    assert gone_on <= results
    assert kept <= results
    assert told <= len(results)
    print(f"{told} told, {len(gone_on)} gone on, {len(kept)} kept, {len(operator.received['step_result'])} heard, {len(results)} saved")
    # Each is a whole step: what was seen, proposed, approved, and how it ended.
    proposals = {proposal.id: proposal for proposal in found.get("/pick_place", [])}
    heightmaps = {nanoseconds(heightmap.header.stamp) for heightmap in found.get("/heightmap", [])}
    approved = {c.proposal_id for c in found.get("/step_confirmation", []) if c.decision == StepConfirmation.APPROVE}
    for step in results:
        assert step in proposals
        assert step in approved
        assert nanoseconds(proposals[step].header.stamp) in heightmaps
    # Nothing that anybody has heard of is missing either, beyond what was still on its way to the recorder.
    heard = [result.proposal_id for result in operator.received["step_result"]]
    assert set(heard[:-1]) <= results
