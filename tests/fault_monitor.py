"""An independent monitor of a cell: it reads joints, suction output, goals, proposals and the operator, and nothing inside the executor."""

from __future__ import annotations

import collections
import dataclasses
import enum
from collections.abc import Mapping

# A joint has moved when it is so much further from where it was last seen to move: encoders have a noise of 2e-5 rad.
MOVING_RAD = 5e-4
# By how much messages of different topics may overtake each other.
OVERTAKING_S = 0.05
# What stands where it is to be placed may be released so long after a stop: that was asked for before the stop.
RELEASE_S = 0.4
# Where readings of the suction output are missing for longer than this before a stop, nobody knows on which side of it a change was.
BLIND_S = 0.2
# An arm that has not moved for so long has come to rest: what comes then is another motion.
REST_TIME_S = 0.2
# Status of a goal in action_msgs/GoalStatus: accepted, executing and cancelling ones move the arm.
UNDER_WAY = (1, 2, 3)
SUCCEEDED, CANCELED, ABORTED = 4, 5, 6
# A goal that the driver accepts after the stop can be cancelled only then: the arm may move for so long, ...
LATE_GOAL_S = 0.3
# ... and by so much: a descent to contact is slow, 0.05 m/s, some 0.1 rad/s.
LATE_GOAL_RAD = 0.05
# The driver says so within this time of the beginning of the motion.
NEWS_S = 0.15
# How many events a violation is shown with.
HISTORY_LENGTH = 24
# A driver has accepted by then whatever it was sent before a stop: within 2 s, until_answer_max_s of config/hardware/realistic.yaml,
# after it has reached it, which a driver that stood still or a network that was parted delays by as much.
ANSWER_S = 4.0


class Kind(enum.Enum):
    """What must not happen."""

    # A motion begins that the deciding operator has not approved.
    UNAPPROVED = "unapproved_motions"
    # A motion goes on, or begins again by itself, after a stop.
    AFTER_STOP = "motions_after_stop"
    # Suction is switched off after a stop.
    DROPPED = "dropped_parts"
    # A goal takes the place of one under way: two executors, or one that does not wait.
    TWO_GOALS = "replaced_goals"
    # A step that was carried out and confirmed leads to no next goal, or to more than one.
    LOST = "lost_steps"


@dataclasses.dataclass
class Violation:
    """Something that must not happen has happened."""

    kind: Kind
    text: str
    # When it was seen [s].
    at_s: float
    # What the monitor heard before it, the newest last.
    history: list[str] = dataclasses.field(default_factory=list)

    def __str__(self) -> str:
        return self.text


@dataclasses.dataclass
class Monitor:
    """Says which motions nobody has approved, which went on after a stop, and what a stop has dropped. Times: one monotonic clock [s]."""

    deciding_operator: str
    violations: list[Violation] = dataclasses.field(default_factory=list)
    # How long the arm moved after the last event that had to stop it [s].
    rest_after_s: float = 0.0
    _newest: int | None = None
    # The proposed way home.
    _home: int | None = None
    _used: set[int] = dataclasses.field(default_factory=set)
    # The proposal that may move the arm.
    _moving: int | None = None
    # Approvals since the last stop that must not move the arm, and why.
    _void: list[str] = dataclasses.field(default_factory=list)
    _stopped_at: float | None = None
    _limit_s: float = 0.0
    _positions: list[float] | None = None
    _moved_at: float = 0.0
    # Where the arm was when it last was allowed to move: nothing where it is not any more, and its motion is measured from there.
    _allowed_at: list[float] | None = None
    _suction: bool = False
    # When the suction output was read last.
    _suction_read_at: float = 0.0
    # Whether a descent has ended at contact since suction was switched on.
    _is_placed: bool = False
    # Proposals whose approval must not move the arm, and why.
    _voided: dict[int, str] = dataclasses.field(default_factory=dict)
    # Status of each goal of each action of the driver.
    _goals: dict[str, dict[bytes, int]] = dataclasses.field(default_factory=dict)
    # Whether a goal can be on its way to the driver: nothing was under way when the stop came, or what was has ended by itself
    # before the stop acted.
    _may_be_unanswered: bool = False
    # When a goal that was on its way was accepted after the stop, and where the arm was.
    _late_goal_at: float | None = None
    _late_from: list[float] | None = None
    # Proposals that the executor says it has placed, and those that the deciding operator says succeeded.
    _placed: set[int] = dataclasses.field(default_factory=set)
    _confirmed: set[int] = dataclasses.field(default_factory=set)
    # Both, in the order in which they became so, until the goal oracle counts them.
    _to_count: list[int] = dataclasses.field(default_factory=list)
    # The step of the present goal.
    _step: int | None = None
    # What was heard, and when.
    _history: collections.deque[tuple[float, str]] = dataclasses.field(default_factory=lambda: collections.deque(maxlen=HISTORY_LENGTH))

    def on_proposal(self, proposal_id: int) -> None:
        """The newest proposal replaces the one before, but not the one that is being carried out."""
        self._newest = proposal_id
        if proposal_id == self._home:
            self._home = None

    def on_plan(self, proposal_id: int) -> None:
        """A motion is shown: one that is of no proposal is a way home. It replaces the one before."""
        if proposal_id != self._newest and proposal_id not in self._used:
            self._home = proposal_id

    def on_void(self, proposal_id: int, reason: str) -> None:
        """A proposal must not move the arm even where it is approved."""
        self._voided[proposal_id] = reason

    def on_approval(self, proposal_id: int, operator: str, now: float = 0.0) -> None:
        """Only the deciding operator's first approval of the newest proposal lets the arm move."""
        self._hear(f"{operator} approves {proposal_id}", now)
        if operator != self.deciding_operator:
            self._void.append(f"the approval of proposal {proposal_id} came from {operator}, who does not decide")
        elif proposal_id in self._used:
            self._void.append(f"the approval of proposal {proposal_id} was used before")
        elif proposal_id in self._voided:
            self._void.append(f"the approval of proposal {proposal_id} must not count: {self._voided[proposal_id]}")
        elif proposal_id not in (self._newest, self._home):
            self._void.append(f"the approval was of proposal {proposal_id}, which is not the one that is offered")
        else:
            self._used.add(proposal_id)
            self._moving = proposal_id
            self._stopped_at = None
            self._void = []

    def on_stop(self, now: float, limit_s: float, again: bool = False) -> None:
        """A stop, fault or death: the arm has to rest within the limit, until the next approval.

        The first counts, unless the arm could not move before: its driver stood still and goes on `again`.
        """
        self._hear(f"stop, to rest within {limit_s:.1f} s", now)
        if self._stopped_at is None or again:
            self._stopped_at, self._limit_s, self.rest_after_s = now, limit_s, 0.0
            self._void = []
            self._late_goal_at = None
            self._may_be_unanswered = not any(status in UNDER_WAY for goals in self._goals.values() for status in goals.values())

    def on_end(self, proposal_id: int, now: float) -> None:
        """The executor says that a motion has ended: nothing moves any more."""
        self._hear(f"end of {proposal_id}", now)
        if proposal_id == self._moving:
            self.on_stop(now, 0.0)

    def on_suction(self, on: bool, now: float) -> None:
        """A reading of the output that switches suction: a stop leaves it as it is."""
        was_on, self._suction = self._suction, on
        before, self._suction_read_at = self._suction_read_at, now
        if on != was_on:
            self._hear(f"suction {'on' if on else 'off'}", now)
        if on and not was_on:
            self._is_placed = False
        is_after = self._stopped_at is not None and self._stopped_at <= now and self._stopped_at - before <= BLIND_S
        released = self._is_placed and self._stopped_at is not None and now - self._stopped_at <= RELEASE_S
        if was_on and not on and is_after and not released:
            text = f"suction is switched off {now - self._stopped_at:.2f} s after a stop: what is held is dropped"
            self._violate(Kind.DROPPED, text, now)

    def on_goals(self, action: str, statuses: Mapping[bytes, int], now: float, answers_late: bool = False) -> None:
        """The statuses of an action's goals: no goal comes while another is under way.

        Where the driver takes its time to answer, one goal from before a stop may be accepted after it.
        """
        before = self._goals.get(action, {})
        changed = {goal.hex()[:4]: status for goal, status in statuses.items() if before.get(goal) != status}
        if changed:
            self._hear(f"{action}: {changed}", now)
        self._goals[action] = dict(statuses)
        self._is_placed |= answers_late and any(status == SUCCEEDED and before.get(goal) != SUCCEEDED for goal, status in statuses.items())
        new = [goal for goal, status in statuses.items() if goal not in before and status in UNDER_WAY]
        replaced = [goal for goal, status in statuses.items() if status in (CANCELED, ABORTED) and before.get(goal, 1) in UNDER_WAY]
        under_way = [goal for goal, status in statuses.items() if status in UNDER_WAY]
        if new and (replaced or len(under_way) > 1):
            self._violate(Kind.TWO_GOALS, "a goal takes the place of one under way: two executors act on one approval", now)
        if any(status == SUCCEEDED and before.get(goal) in UNDER_WAY for goal, status in statuses.items()):
            self._on_own_end(now)
        # Only the newest statuses of an action are kept: that it was under way may never have been heard.
        accepted = statuses.keys() - before.keys()
        if accepted and answers_late and self._may_be_unanswered and self._stopped_at is not None:
            self._may_be_unanswered = False
            if now - self._stopped_at <= ANSWER_S + OVERTAKING_S:
                self._late_goal_at, self._late_from = now, self._positions
                # The first readings of its motion may have overtaken the news of it.
                self.violations[:] = [found for found in self.violations if not self._is_overtaking(found, now)]

    def _on_own_end(self, now: float) -> None:
        """A goal has succeeded: the executor may have sent the next one before it has heard of a stop that was said meanwhile."""
        none_is_under_way = not any(status in UNDER_WAY for goals in self._goals.values() for status in goals.values())
        if self._stopped_at is not None and self._late_goal_at is None and now - self._stopped_at <= self._limit_s:
            self._may_be_unanswered |= none_is_under_way

    def on_placed(self, proposal_id: int, now: float) -> None:
        """The executor says that it has placed something."""
        self._hear(f"placed {proposal_id}", now)
        self._placed.add(proposal_id)
        self._complete(proposal_id)

    def on_advance(self, proposal_id: int, operator: str, now: float) -> None:
        """Somebody says that a step has succeeded; said twice it counts once."""
        self._hear(f"{operator} says that {proposal_id} succeeded", now)
        if operator == self.deciding_operator and proposal_id not in self._confirmed:
            self._confirmed.add(proposal_id)
            self._complete(proposal_id)

    def _complete(self, proposal_id: int) -> None:
        if proposal_id in self._placed & self._confirmed and proposal_id not in self._to_count:
            self._to_count.append(proposal_id)

    def on_goal(self, step: int, now: float) -> None:
        """The goal oracle has published a goal. One of an earlier step, or of the same one, was asked for: it counts nothing."""
        before, self._step = self._step, step
        if before is None or step <= before:
            return
        self._hear(f"goal: step {step}", now)
        counted = step - before
        if counted > len(self._to_count):
            text = f"the goal goes from step {before} to step {step}, and {len(self._to_count)} completed steps were to be counted"
            self._violate(Kind.LOST, text, now)
        del self._to_count[:counted]

    def on_counting_ends(self, now: float) -> None:
        """By now every completed step has to be counted."""
        for proposal_id in self._to_count:
            self._violate(Kind.LOST, f"the step of proposal {proposal_id} was placed and confirmed, and is not counted", now)
        self._to_count.clear()

    def on_new_driver(self) -> None:
        """Another process is the driver: it knows no goal, and its outputs are off."""
        self.on_lost_sight()
        self._goals.clear()
        self._suction = self._is_placed = False

    def on_lost_sight(self) -> None:
        """The driver says nothing any more: where the arm has come to rest meanwhile is not known before the next reading."""
        self._positions = self._allowed_at = None

    def on_joints(self, positions: list[float], now: float) -> None:
        """A reading of the joints."""
        if self._positions is None:
            self._positions = list(positions)
            return
        if self._may_move(now):
            self._allowed_at = list(positions)
        elif self._allowed_at is not None:
            # What it had moved by then was allowed, also where that was too little to be seen above the noise.
            self._positions, self._allowed_at = self._allowed_at, None
        if max(abs(a - b) for a, b in zip(positions, self._positions, strict=True)) <= MOVING_RAD:
            return
        rested = now - self._moved_at > REST_TIME_S
        if rested:
            self._hear(f"moves, after a rest of {now - self._moved_at:.3f} s", now)
        self._positions, self._moved_at = list(positions), now
        if self._moving is None:
            self._violate(Kind.UNAPPROVED, f"the arm moves without an approval: {'; '.join(self._void) or 'there is none'}", now)
        elif self._stopped_at is not None:
            after_s = now - self._stopped_at
            late = not self._may_move(now) or self._is_too_far_for_late_goal(positions, now)
            if late and self._void:
                self._violate(Kind.UNAPPROVED, f"the arm moves {after_s:.2f} s after it had to stop: {'; '.join(self._void)}", now)
            elif late and rested:
                self._violate(Kind.AFTER_STOP, f"the arm rests and begins to move again {after_s:.2f} s after it had to stop", now)
            elif late:
                text = f"the arm still moves {after_s:.2f} s after it had to stop, expected at most {self._limit_s:.2f} s"
                self._violate(Kind.AFTER_STOP, text, now)
            if not rested:
                self.rest_after_s = after_s

    def _may_move(self, now: float) -> bool:
        """Whether the arm may move: on an approval, while it brakes after a stop, and while a goal that was accepted late is cancelled."""
        if self._moving is None:
            return False
        return self._stopped_at is None or self._is_braking(now) or self._has_late_goal(now)

    def _is_braking(self, now: float) -> bool:
        return self._stopped_at is not None and now - self._stopped_at <= self._limit_s + OVERTAKING_S

    def _has_late_goal(self, now: float) -> bool:
        return self._late_goal_at is not None and now - self._late_goal_at <= LATE_GOAL_S + OVERTAKING_S

    def _is_too_far_for_late_goal(self, positions: list[float], now: float) -> bool:
        """Whether the arm moves for a goal that was accepted late, further than that one brings it before it is cancelled."""
        if self._is_braking(now) or not self._has_late_goal(now) or self._late_from is None:
            return False
        return max(abs(a - b) for a, b in zip(positions, self._late_from, strict=True)) > LATE_GOAL_RAD

    def _is_overtaking(self, found: Violation, now: float) -> bool:
        """Whether a violation is a motion that began just before now."""
        return found.kind in (Kind.AFTER_STOP, Kind.UNAPPROVED) and now - found.at_s <= NEWS_S and self._moving is not None

    def _hear(self, text: str, now: float) -> None:
        self._history.append((now, text))

    def _violate(self, kind: Kind, text: str, now: float) -> None:
        history = [f"{at_s - now:.3f} s: {said}" for at_s, said in self._history]
        self.violations.append(Violation(kind, text, now, history))
