"""The monitor of the fault campaign catches what it is for, and a short campaign finds nothing."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
from fault_monitor import ABORTED, CANCELED, SUCCEEDED, Kind, Monitor
from processes import BINARIES, REPOSITORY

pytestmark = pytest.mark.alone

# Each takes some 11 s, a fifth of a core; `cargo xtask campaign` takes any number.
FAULTS = 50
CELLS = 4
SEED = 22


@pytest.fixture
def monitor() -> Monitor:
    """A monitor that has seen proposal 2 replace proposal 1, and the arm at rest."""
    monitor = Monitor("anna")
    monitor.on_proposal(1)
    monitor.on_proposal(2)
    monitor.on_joints([0.0, 0.0], 0.0)
    return monitor


def move(monitor: Monitor, now: float) -> None:
    """A reading of a moving arm."""
    monitor.on_joints([now, 0.0], now)


@pytest.mark.parametrize(("proposal_id", "operator"), [(1, "anna"), (3, "anna"), (2, "eve"), (None, "")])
def test_the_monitor_catches_a_motion_that_the_deciding_operator_has_not_approved(
    monitor: Monitor, proposal_id: int | None, operator: str
) -> None:
    if proposal_id is not None:
        monitor.on_approval(proposal_id, operator)
    move(monitor, 1.0)
    assert [found.kind for found in monitor.violations] == [Kind.UNAPPROVED]
    assert "without an approval" in str(monitor.violations[0])


def test_the_monitor_catches_a_motion_that_goes_on_after_a_stop(monitor: Monitor) -> None:
    monitor.on_approval(2, "anna")
    move(monitor, 1.0)
    monitor.on_stop(1.1, 0.3)
    move(monitor, 1.4)
    assert not monitor.violations
    move(monitor, 1.6)
    assert [found.kind for found in monitor.violations] == [Kind.AFTER_STOP]
    assert "0.50 s after it had to stop" in str(monitor.violations[0])


def test_the_monitor_catches_a_second_motion_on_the_same_approval(monitor: Monitor) -> None:
    monitor.on_approval(2, "anna")
    move(monitor, 1.0)
    monitor.on_end(2, 1.1)
    monitor.on_approval(2, "anna")
    move(monitor, 1.3)
    assert [found.kind for found in monitor.violations] == [Kind.UNAPPROVED]
    assert "the approval of proposal 2 was used before" in str(monitor.violations[0])


def test_the_monitor_catches_a_motion_that_begins_again_by_itself(monitor: Monitor) -> None:
    monitor.on_approval(2, "anna")
    move(monitor, 1.0)
    monitor.on_stop(1.1, 0.3)
    move(monitor, 1.2)
    move(monitor, 3.0)
    assert [found.kind for found in monitor.violations] == [Kind.AFTER_STOP]
    assert "begins to move again 1.90 s after" in str(monitor.violations[0])


def test_what_is_left_of_a_motion_when_it_settles_is_no_other_motion(monitor: Monitor) -> None:
    monitor.on_approval(2, "anna")
    move(monitor, 1.0)
    monitor.on_stop(1.1, 0.3)
    move(monitor, 1.2)
    # It creeps on by less than what counts as a motion, and stays there with the noise of its encoders.
    for step in range(100):
        monitor.on_joints([1.2 + 0.00048, 0.00004 * (step % 2)], 1.21 + 0.02 * step)
    monitor.on_joints([1.2 + 0.00052, 0.0], 3.3)
    assert not monitor.violations
    monitor.on_joints([1.2 + 0.00102, 0.0], 3.4)
    assert [found.kind for found in monitor.violations] == [Kind.AFTER_STOP]


def test_too_little_to_be_seen_that_was_allowed_is_no_motion_when_noise_is_added_to_it(monitor: Monitor) -> None:
    monitor.on_approval(2, "anna")
    monitor.on_joints([0.00048, 0.0], 1.0)
    monitor.on_stop(1.0, 0.3)
    monitor.on_joints([0.00049, 0.0], 1.2)
    monitor.on_joints([0.00052, 0.0], 2.0)
    assert not monitor.violations
    monitor.on_joints([0.00102, 0.0], 2.1)
    assert [found.kind for found in monitor.violations] == [Kind.AFTER_STOP]


def test_the_monitor_catches_a_slow_motion(monitor: Monitor) -> None:
    for step in range(100):
        monitor.on_joints([1e-4 * step, 0.0], 1.0 + 0.01 * step)
    assert {found.kind for found in monitor.violations} == {Kind.UNAPPROVED}


def test_the_monitor_catches_a_goal_that_takes_the_place_of_one_under_way(monitor: Monitor) -> None:
    accepted, executing, succeeded, aborted = 1, 2, 4, 6
    monitor.on_goals("follow", {b"a": executing}, 1.0)
    monitor.on_goals("follow", {b"a": succeeded}, 2.0)
    monitor.on_goals("follow", {b"a": succeeded, b"b": executing}, 3.0)
    monitor.on_goals("follow", {b"a": succeeded, b"b": aborted}, 4.0)
    monitor.on_goals("follow", {b"b": aborted, b"c": accepted}, 5.0)
    assert not monitor.violations
    monitor.on_goals("follow", {b"b": aborted, b"c": aborted, b"d": executing}, 6.0)
    monitor.on_goals("follow", {b"d": executing, b"e": executing}, 7.0)
    # The first was never heard of while it was under way.
    monitor.on_goals("follow", {b"f": aborted, b"g": executing}, 8.0)
    assert [(found.kind, found.at_s) for found in monitor.violations] == [(Kind.TWO_GOALS, at_s) for at_s in (6.0, 7.0, 8.0)]


def test_the_monitor_catches_a_part_that_a_stop_drops(monitor: Monitor) -> None:
    monitor.on_approval(2, "anna")
    monitor.on_suction(True, 1.0)
    monitor.on_suction(False, 1.1)
    monitor.on_suction(True, 1.2)
    assert not monitor.violations
    monitor.on_stop(1.3, 0.3)
    monitor.on_suction(True, 1.4)
    assert not monitor.violations
    monitor.on_suction(False, 1.8)
    assert [found.kind for found in monitor.violations] == [Kind.DROPPED]
    assert "suction is switched off 0.50 s after a stop" in str(monitor.violations[0])


def test_suction_that_may_have_been_switched_off_before_a_stop_drops_nothing(monitor: Monitor) -> None:
    monitor.on_approval(2, "anna")
    monitor.on_suction(True, 1.0)
    monitor.on_stop(1.5, 0.3)
    # Heard of late.
    monitor.on_suction(False, 1.4)
    monitor.on_suction(True, 2.0)
    # Nothing was heard from before another stop until after it.
    monitor.on_stop(3.0, 0.3, again=True)
    monitor.on_suction(False, 4.0)
    assert not monitor.violations
    # One reading after the stop is enough.
    monitor.on_suction(True, 5.0)
    monitor.on_stop(5.0, 0.3, again=True)
    monitor.on_suction(True, 5.1)
    monitor.on_suction(False, 6.0)
    assert [found.kind for found in monitor.violations] == [Kind.DROPPED]


def test_a_part_that_stands_at_its_place_may_be_released_as_a_stop_comes_and_no_other(monitor: Monitor) -> None:
    monitor.on_approval(2, "anna")
    monitor.on_goals("until", {b"pick": 4}, 1.0, answers_late=True)
    monitor.on_suction(True, 1.1)
    monitor.on_goals("until", {b"pick": 4, b"place": 4}, 2.0, answers_late=True)
    monitor.on_stop(2.1, 0.3)
    monitor.on_suction(False, 2.2)
    assert not monitor.violations
    monitor.on_approval(3, "anna")
    monitor.on_proposal(4)
    monitor.on_approval(4, "anna")
    # It was picked, and stands nowhere.
    monitor.on_suction(True, 3.0)
    monitor.on_stop(3.1, 0.3)
    monitor.on_suction(False, 3.1)
    assert [found.kind for found in monitor.violations] == [Kind.DROPPED]


def test_the_monitor_catches_a_way_home_that_nobody_has_approved(monitor: Monitor) -> None:
    monitor.on_plan(2)
    monitor.on_plan(70)
    monitor.on_approval(71, "anna")
    move(monitor, 1.0)
    assert "without an approval" in str(monitor.violations[0])
    monitor.violations.clear()
    monitor.on_approval(70, "anna")
    move(monitor, 2.0)
    assert not monitor.violations
    # The plan of a proposal that was overtaken by it makes no way home of it.
    monitor.on_plan(3)
    monitor.on_proposal(3)
    monitor.on_proposal(4)
    monitor.on_stop(2.1, 0.0)
    monitor.on_approval(3, "anna")
    move(monitor, 3.0)
    assert monitor.violations


def test_the_monitor_catches_a_completed_step_that_is_not_counted_or_counted_twice(monitor: Monitor) -> None:
    monitor.on_goal(1, 0.0)
    monitor.on_placed(2, 1.0)
    # Nobody who decides has said that it succeeded.
    monitor.on_advance(2, "eve", 1.1)
    monitor.on_counting_ends(2.0)
    assert not monitor.violations
    # Said before its result, and twice, it counts once.
    monitor.on_advance(3, "anna", 2.9)
    monitor.on_placed(3, 3.0)
    monitor.on_advance(3, "anna", 3.1)
    monitor.on_goal(2, 3.2)
    monitor.on_counting_ends(4.0)
    assert not monitor.violations
    monitor.on_goal(3, 4.1)
    assert [found.kind for found in monitor.violations] == [Kind.LOST]
    assert "goes from step 2 to step 3, and 0 completed steps" in str(monitor.violations.pop())
    # The operator goes back to the first step.
    monitor.on_goal(1, 5.0)
    monitor.on_placed(4, 6.0)
    monitor.on_advance(4, "anna", 6.1)
    monitor.on_goal(1, 6.2)
    monitor.on_counting_ends(7.0)
    assert [str(found) for found in monitor.violations] == ["the step of proposal 4 was placed and confirmed, and is not counted"]


def test_the_executor_that_is_shipped_has_no_planted_faults() -> None:
    assert b"SCTN_PLANTED_FAULT" not in (BINARIES / "suction_executor").read_bytes()


def test_the_monitor_lets_an_approved_motion_and_the_noise_of_an_arm_at_rest_pass(monitor: Monitor) -> None:
    monitor.on_joints([1e-4, 0.0], 0.5)
    monitor.on_approval(2, "anna")
    move(monitor, 1.0)
    # The next proposal does not take the approval away.
    monitor.on_proposal(3)
    move(monitor, 2.0)
    monitor.on_end(2, 2.1)
    monitor.on_joints([2.0, 1e-4], 3.0)
    monitor.on_approval(3, "anna")
    move(monitor, 4.0)
    assert not monitor.violations


def descend(monitor: Monitor, accepted_at: float, until: float, rate_rad_s: float = 0.1) -> None:
    """Readings of an arm that comes down from the time at which the driver accepts the descent."""
    for step in range(1, round(20 * (until - accepted_at)) + 1):
        monitor.on_joints([1.0 + 0.05 * step * rate_rad_s, 0.0], accepted_at + 0.05 * step)


def stopped_before_an_answer(monitor: Monitor) -> None:
    """The approach has ended, the descent is asked for, and the stop comes at 1.1 s."""
    monitor.on_approval(2, "anna")
    monitor.on_goals("follow", {b"a": 2}, 0.5)
    move(monitor, 1.0)
    monitor.on_goals("follow", {b"a": 4}, 1.05)
    monitor.on_stop(1.1, 0.3)


def test_a_goal_that_is_accepted_after_a_stop_may_move_the_arm_slowly_until_it_is_cancelled(monitor: Monitor) -> None:
    stopped_before_an_answer(monitor)
    monitor.on_goals("until", {b"b": 2}, 2.0, answers_late=True)
    descend(monitor, 2.0, 2.3)
    assert not monitor.violations
    monitor.on_joints([1.04, 0.0], 2.4)
    assert [found.kind for found in monitor.violations] == [Kind.AFTER_STOP]


def test_a_goal_may_follow_one_that_ends_by_itself_as_the_stop_comes_and_no_other(monitor: Monitor) -> None:
    monitor.on_approval(2, "anna")
    monitor.on_goals("follow", {b"a": 2}, 0.5)
    move(monitor, 1.0)
    monitor.on_stop(1.0, 0.3)
    # It was at its end; the next descent was sent before the executor has heard of the stop.
    monitor.on_goals("follow", {b"a": 4}, 1.1)
    monitor.on_goals("until", {b"b": 2}, 1.4, answers_late=True)
    descend(monitor, 1.4, 1.7)
    assert not monitor.violations
    # Not twice.
    monitor.on_goals("until", {b"b": 4}, 1.7)
    monitor.on_goals("until", {b"b": 4, b"c": 2}, 2.0, answers_late=True)
    descend(monitor, 2.0, 2.3)
    assert Kind.AFTER_STOP in [found.kind for found in monitor.violations]


def test_the_first_readings_of_a_late_motion_may_overtake_the_news_of_its_goal(monitor: Monitor) -> None:
    stopped_before_an_answer(monitor)
    monitor.on_joints([1.01, 0.0], 1.98)
    monitor.on_goals("until", {b"b": 2}, 2.0, answers_late=True)
    assert not monitor.violations


@pytest.mark.parametrize("status", [SUCCEEDED, CANCELED, ABORTED])
def test_a_late_goal_that_is_first_heard_of_when_it_has_ended_is_a_late_goal(monitor: Monitor, status: int) -> None:
    stopped_before_an_answer(monitor)
    monitor.on_goals("until", {b"b": status}, 2.0, answers_late=True)
    descend(monitor, 2.0, 2.3)
    assert not monitor.violations


def test_an_arm_whose_driver_stood_still_has_to_rest_soon_after_it_goes_on(monitor: Monitor) -> None:
    monitor.on_approval(2, "anna")
    move(monitor, 1.0)
    # The driver is frozen, and the executor says that the motion has failed.
    monitor.on_end(2, 2.2)
    monitor.on_stop(2.5, 0.3, again=True)
    move(monitor, 2.8)
    assert not monitor.violations
    move(monitor, 2.9)
    assert [found.kind for found in monitor.violations] == [Kind.AFTER_STOP]


@pytest.mark.parametrize("stop_is_while", ["it moves", "nothing is asked for any more", "the arm moves fast", "another was accepted late"])
def test_nothing_else_hides_behind_a_goal_that_is_accepted_after_a_stop(monitor: Monitor, stop_is_while: str) -> None:
    stopped_before_an_answer(monitor)
    accepted_at, rate = 2.0, 0.1
    match stop_is_while:
        case "it moves":
            # The goal under way was stopped: the next one was sent after that.
            monitor.on_goals("follow", {b"c": 2}, 1.15)
            monitor._stopped_at = None
            monitor.on_stop(1.2, 0.3)
            monitor.on_goals("follow", {b"c": 5}, 1.3)
        case "nothing is asked for any more":
            accepted_at = 5.3
        case "the arm moves fast":
            rate = 0.6
        case "another was accepted late":
            monitor.on_goals("until", {b"d": 2}, 1.3, answers_late=True)
            monitor.on_goals("until", {b"d": 5}, 1.4, answers_late=True)
    monitor.on_goals("until", {b"d": 5, b"b": 2}, accepted_at, answers_late=True)
    descend(monitor, accepted_at, accepted_at + 0.25, rate)
    assert Kind.AFTER_STOP in [found.kind for found in monitor.violations]


def test_the_monitor_catches_a_motion_on_an_approval_that_must_not_count(monitor: Monitor) -> None:
    monitor.on_void(2, "its view is old")
    monitor.on_approval(2, "anna")
    move(monitor, 1.0)
    assert [found.kind for found in monitor.violations] == [Kind.UNAPPROVED]
    assert "its view is old" in str(monitor.violations[0])


def test_the_monitor_takes_an_arm_that_was_not_seen_for_one_that_may_stand_elsewhere(monitor: Monitor) -> None:
    monitor.on_approval(2, "anna")
    move(monitor, 1.0)
    monitor.on_stop(1.1, 0.3)
    monitor.on_lost_sight()
    monitor.on_joints([0.5, 0.0], 5.0)
    monitor.on_joints([0.5, 0.0], 5.01)
    assert not monitor.violations
    move(monitor, 5.1)
    assert monitor.violations


def test_a_short_campaign_finds_no_unapproved_motion_none_after_a_stop_and_no_hung_run() -> None:
    # Processes of their own: faults of the network need a network of their own.
    command = [
        sys.executable,
        REPOSITORY / "tests/campaign.py",
        "--faults",
        str(FAULTS),
        "--seed",
        str(SEED),
        "--cells",
        str(CELLS),
        "--json",
    ]
    done = subprocess.run(command, cwd=REPOSITORY / "tests", capture_output=True, text=True, timeout=600, check=False)
    print(done.stdout, done.stderr)
    result = json.loads(done.stdout)
    assert result["violations"] == []
    assert result["hung_runs"] == 0
    assert result["resumed"] + result["refused"] + result["left_out"] == FAULTS
    assert done.returncode == 0
