//! Recoveries, the way home or putting down what is held before it: proposed by the executor, shown, and approved by the operator.

use std::time::Duration;

use serde::{Serialize, Serializer};
use step_protocol::{ProposalId, Recovery};

use super::{Command, State};
use crate::refusal::{Refusal, advice_on};
use crate::run::Decision;
use crate::session::ViewerId;

/// A recovery that the executor has proposed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Home {
    /// A 64-bit number, which JavaScript's numbers cannot hold.
    #[serde(serialize_with = "crate::preview::as_text")]
    pub(super) proposal_id: ProposalId,
    #[serde(serialize_with = "as_name")]
    pub(super) recovery: Recovery,
    /// The arm is on its way.
    pub(super) approved: bool,
}

fn as_name<S: Serializer>(recovery: &Recovery, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(match recovery {
        Recovery::Home => "home",
        Recovery::PutDown => "put_down",
    })
}

/// Why a recovery cannot be carried out, as a sentence.
pub(super) fn no_recovery(recovery: Recovery, reason: &str) -> Refusal {
    let because = reason.trim().trim_end_matches('.');
    let text = match recovery {
        Recovery::Home => format!("There is no way home: {because}."),
        Recovery::PutDown => format!("What is held cannot be put down: {because}."),
    };
    Refusal::new(text, advice_on(reason))
}

impl State {
    /// The operator asks for a recovery. Nothing moves before it is approved.
    ///
    /// # Errors
    /// When somebody else decides, or nothing is held that could be put down.
    pub fn recover(&mut self, viewer: ViewerId, recovery: Recovery) -> Result<(), Refusal> {
        self.sessions.check_operator(viewer)?;
        if recovery == Recovery::PutDown && !self.run.holds() {
            return Err(Refusal::new(
                "The gripper holds nothing.",
                "Bring the arm home.",
            ));
        }
        let name = self.sessions.name(viewer).to_owned();
        self.send(Command::Recover(recovery, name))
    }

    /// The executor has proposed a recovery; it `needs_approval`, or the arm is on its way.
    pub(super) fn on_recovery(
        &mut self,
        recovery: Recovery,
        proposal_id: ProposalId,
        needs_approval: bool,
    ) {
        self.home = Some(Home {
            proposal_id,
            recovery,
            approved: !needs_approval,
        });
    }

    /// The operator decides on the recovery that is shown. A rejected one is forgotten: nothing moves without an approval.
    pub(super) fn decide_home(
        &mut self,
        viewer: ViewerId,
        home: Home,
        decision: Decision,
        now: Duration,
    ) -> Result<(), Refusal> {
        self.sessions.check_operator(viewer)?;
        let proposal_id = home.proposal_id;
        match decision {
            Decision::Approve => {
                let motion = self.run.motion_of(proposal_id).ok_or_else(|| {
                    Refusal::new(
                        "The motion has not been shown yet.",
                        "Wait a moment, and look at it.",
                    )
                })?;
                if !motion.reason.is_empty() {
                    return Err(no_recovery(home.recovery, &motion.reason));
                }
                let name = self.sessions.name(viewer).to_owned();
                self.confirm(proposal_id, decision.into(), name, now)?;
                self.home = Some(Home {
                    approved: true,
                    ..home
                });
                Ok(())
            }
            Decision::Reject => {
                self.home = None;
                Ok(())
            }
            _ => Err(Refusal::new(
                "What brings the arm home is only approved or rejected.",
                "Approve it or reject it.",
            )),
        }
    }
}
