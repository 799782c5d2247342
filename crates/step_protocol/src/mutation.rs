//! Faults planted on purpose, in tests only: the property test has to find each of them.

/// A fault in one of the machines.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mutation {
    /// The gate does not remember that a proposal was carried out.
    ApprovalMovesTwice,
    /// A superseded proposal can still be approved.
    SupersededStaysPending,
    /// Approvals that wait for their proposal survive a stop.
    WaitingSurvivesStop,
    /// Approvals that wait for their proposal survive a deactivation.
    WaitingSurvivesDeactivation,
    /// Any approval moves the newest proposal.
    AnyApprovalMovesNewest,
    /// An approval while the arm moves is accepted.
    MovesWhileMoving,
    /// A motion begins that was not rehearsed.
    MovesUnrehearsed,
    /// A call for the way home moves the arm.
    HomeMovesUnasked,
    /// The proposed way home can still be approved after a stop.
    HomeSurvivesStop,
    /// The proposed way home can still be approved after another motion.
    HomeSurvivesMotion,
    /// Any approval moves the arm home where a way home is proposed.
    AnyApprovalMovesHome,
    /// The executor does not keep a stop for the next process.
    StopIsNotRecorded,
    /// A way home lets things go on in the next process.
    HomeClearsStop,
    /// After a fault things go on by themselves.
    FaultIsNoStop,
    /// A motion begins though no operator is present.
    MovesUnattended,
    /// A motion goes on when the operator goes away.
    AbsenceStopsNothing,
    /// Everybody decides, whoever the operators are.
    StrangerDecides,
    /// A goal of the executor's action moves without an approval.
    GoalMovesUnasked,
    /// The proposal of a goal that has ended can still be approved.
    EndedGoalStaysPending,
    /// The proposal of a goal that a deactivation has ended can still be approved.
    DeactivatedGoalStaysPending,
    /// A word says where its proposal stood before the rest of the same answer.
    StatusIsOutdated,
    /// A decision that does not count ends a goal.
    UncountedDecisionEndsGoal,
    /// A motion goes on though its goal is cancelled.
    CancelStopsNothing,
    /// The arm goes home with what it was to put down.
    PutDownGoesHome,
    /// A decision that waits for its result is lost when another proposal comes.
    SupersessionDropsDecision,
    /// A decision counts before the arm has moved.
    AdvanceWithoutMotion,
    /// A repeated result counts once more.
    ResultCountsTwice,
    /// The planner forgets an approval when a second one is refused.
    RefusalReopensMoving,
    /// In silence the operator asks about proposals only, not about the last motion.
    SilenceForgetsMotion,
    /// A refused proposal is never made anew.
    RefusedIsNotRenewed,
    /// A page does not ask again where a decision was not answered.
    UnansweredIsForgotten,
    /// A proposal for another goal hides that for the present one from the page.
    OtherGoalHidesProposal,
    /// A motion that the goal tracker does not know hides what is proposed after it from the page.
    UnknownMotionHidesProposal,
    /// A motion that the goal tracker does not decide on hides others from the page.
    StaleMotionHidesOthers,
}

impl Mutation {
    /// All of them.
    #[cfg(test)]
    pub(crate) const ALL: [Self; 34] = [
        Self::ApprovalMovesTwice,
        Self::SupersededStaysPending,
        Self::WaitingSurvivesStop,
        Self::WaitingSurvivesDeactivation,
        Self::AnyApprovalMovesNewest,
        Self::MovesWhileMoving,
        Self::MovesUnrehearsed,
        Self::HomeMovesUnasked,
        Self::HomeSurvivesStop,
        Self::HomeSurvivesMotion,
        Self::AnyApprovalMovesHome,
        Self::StopIsNotRecorded,
        Self::HomeClearsStop,
        Self::FaultIsNoStop,
        Self::MovesUnattended,
        Self::AbsenceStopsNothing,
        Self::StrangerDecides,
        Self::GoalMovesUnasked,
        Self::EndedGoalStaysPending,
        Self::DeactivatedGoalStaysPending,
        Self::StatusIsOutdated,
        Self::UncountedDecisionEndsGoal,
        Self::CancelStopsNothing,
        Self::PutDownGoesHome,
        Self::SupersessionDropsDecision,
        Self::AdvanceWithoutMotion,
        Self::ResultCountsTwice,
        Self::RefusalReopensMoving,
        Self::SilenceForgetsMotion,
        Self::RefusedIsNotRenewed,
        Self::UnansweredIsForgotten,
        Self::OtherGoalHidesProposal,
        Self::UnknownMotionHidesProposal,
        Self::StaleMotionHidesOthers,
    ];
}

#[cfg(not(test))]
pub(crate) const fn planted(_: Mutation) -> bool {
    false
}

#[cfg(test)]
thread_local! {
    static PLANTED: std::cell::Cell<Option<Mutation>> = const { std::cell::Cell::new(None) };
}

#[cfg(test)]
pub(crate) fn planted(mutation: Mutation) -> bool {
    PLANTED.get() == Some(mutation)
}

/// Plants a fault in the machines of this thread, or none.
#[cfg(test)]
pub(crate) fn plant(mutation: Option<Mutation>) {
    PLANTED.set(mutation);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_fault_at_a_time_is_planted() {
        for mutation in Mutation::ALL {
            plant(Some(mutation));
            let found: Vec<_> = Mutation::ALL
                .into_iter()
                .filter(|one| planted(*one))
                .collect();
            assert_eq!(found, [mutation]);
        }
        plant(None);
        assert!(!Mutation::ALL.into_iter().any(planted));
    }
}
