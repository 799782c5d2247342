//! The way home: proposed by the executor, shown, and approved by the operator.

use std::time::Duration;

use serde::Serialize;
use step_protocol::ProposalId;

use super::{Command, State};
use crate::refusal::{Refusal, advice};
use crate::run::Decision;
use crate::session::ViewerId;

/// A way home that the executor has proposed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Home {
    /// A 64-bit number, which JavaScript's numbers cannot hold.
    #[serde(serialize_with = "crate::preview::as_text")]
    pub(super) proposal_id: ProposalId,
    /// The arm is on its way.
    pub(super) approved: bool,
}

impl State {
    /// The operator asks for the way home. Nothing moves before it is approved.
    ///
    /// # Errors
    /// When somebody else decides.
    pub fn home(&mut self, viewer: ViewerId) -> Result<(), Refusal> {
        self.sessions.check_operator(viewer)?;
        let name = self.sessions.name(viewer).to_owned();
        self.send(Command::Home(name))
    }

    /// The executor has proposed the way home; it `needs_approval`, or the arm is on its way.
    pub fn on_home(&mut self, proposal_id: ProposalId, needs_approval: bool) {
        self.home = Some(Home {
            proposal_id,
            approved: !needs_approval,
        });
    }

    /// The operator decides on the way home that is shown. A rejected one is forgotten: nothing moves without an approval.
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
                        "The way home has not been shown yet.",
                        "Wait a moment, and look at it.",
                    )
                })?;
                if !motion.reason.is_empty() {
                    return Err(Refusal::new(
                        format!("There is no way home: {}.", motion.reason),
                        advice(&motion.reason),
                    ));
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
                "The way home is only approved or rejected.",
                "Approve it or reject it.",
            )),
        }
    }
}
