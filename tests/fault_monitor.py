"""An independent monitor of a cell: it reads joints, suction output, proposals and the operator, and nothing of the executor."""

from __future__ import annotations

import dataclasses

# A joint moves when it goes further from one reading to the next: encoders have a noise of 2e-5 rad.
MOVING_RAD = 5e-4
# By how much messages of different topics may overtake each other.
OVERTAKING_S = 0.05


@dataclasses.dataclass
class Monitor:
    """Says which motions nobody has approved, which went on after a stop, and what a stop has dropped. Times: one monotonic clock [s]."""

    deciding_operator: str
    violations: list[str] = dataclasses.field(default_factory=list)
    # How long the arm moved after the last event that had to stop it [s].
    rest_after_s: float = 0.0
    _newest: int | None = None
    # The proposed way home.
    _home: int | None = None
    _used: set[int] = dataclasses.field(default_factory=set)
    # The proposal that may move the arm.
    _moving: int | None = None
    _stopped_at: float | None = None
    _limit_s: float = 0.0
    _positions: list[float] | None = None
    _suction: bool = False

    def on_proposal(self, proposal_id: int) -> None:
        """The newest proposal replaces the one before, but not the one that is being carried out."""
        self._newest = proposal_id
        if proposal_id == self._home:
            self._home = None

    def on_plan(self, proposal_id: int) -> None:
        """A motion is shown: one that is of no proposal is a way home. It replaces the one before."""
        if proposal_id != self._newest and proposal_id not in self._used:
            self._home = proposal_id

    def on_approval(self, proposal_id: int, operator: str) -> None:
        """Only the deciding operator's first approval of the newest proposal lets the arm move."""
        is_offered = proposal_id in (self._newest, self._home)
        if operator == self.deciding_operator and is_offered and proposal_id not in self._used:
            self._used.add(proposal_id)
            self._moving = proposal_id
            self._stopped_at = None

    def on_stop(self, now: float, limit_s: float) -> None:
        """A stop, fault or death: the arm has to rest within the limit, until the next approval."""
        if self._stopped_at is None:
            self._stopped_at, self._limit_s, self.rest_after_s = now, limit_s, 0.0

    def on_end(self, proposal_id: int, now: float) -> None:
        """The executor says that a motion has ended: nothing moves any more."""
        if proposal_id == self._moving:
            self.on_stop(now, 0.0)

    def on_suction(self, on: bool, now: float) -> None:
        """A reading of the output that switches suction: a stop leaves it as it is."""
        was_on, self._suction = self._suction, on
        if was_on and not on and self._stopped_at is not None:
            self._violate(f"suction is switched off {now - self._stopped_at:.2f} s after a stop: what is held is dropped")

    def on_joints(self, positions: list[float], now: float) -> None:
        """A reading of the joints."""
        before, self._positions = self._positions, list(positions)
        if before is None or max(abs(a - b) for a, b in zip(positions, before, strict=True)) <= MOVING_RAD:
            return
        if self._moving is None:
            self._violate(f"the arm moves without an approval at {now:.3f} s")
        elif self._stopped_at is not None:
            self.rest_after_s = now - self._stopped_at
            if self.rest_after_s > self._limit_s + OVERTAKING_S:
                self._violate(f"the arm moves {self.rest_after_s:.2f} s after it had to stop, expected at most {self._limit_s:.2f} s")

    def _violate(self, what: str) -> None:
        self.violations.append(what)
