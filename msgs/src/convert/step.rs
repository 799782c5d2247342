//! The messages of a step.

use super::error::unexpected;
use super::{
    ConvertError, duration_from_msg, duration_to_msg, header, heightmap_from_msg, heightmap_to_msg,
    pick_place_from_msg, pose2d_to_msg, settings_from_msg, settings_to_msg, time_from_msg,
    time_to_msg,
};
use crate::sctn_msgs;
use ::heightmap::Heightmap;
use std::sync::Arc;
use std::time::Duration;
use step_protocol::{
    Confirmation, ConfirmationRefusal, Coverage, Goal, Observation, OperatorDecision, Proposal,
    ProposalId, ProposalStatus, RefusalKind, Reward, StepOutcome, StepResult,
};

/// What is wrong with a part of a message.
fn part(field: &'static str) -> impl FnOnce(ConvertError) -> ConvertError {
    move |source| ConvertError::Part {
        field,
        source: Box::new(source),
    }
}

fn coverage(msg: &sctn_msgs::Heightmap) -> Coverage {
    Coverage {
        views: msg.views,
        fraction: msg.coverage,
    }
}

/// A heightmap with its stamp and frame.
pub fn observation_from_msg(msg: sctn_msgs::Heightmap) -> Result<Observation, ConvertError> {
    Ok(Observation {
        stamp: time_from_msg(&msg.header.stamp)?,
        frame: msg.header.frame_id.clone(),
        coverage: coverage(&msg),
        heightmap: Arc::new(heightmap_from_msg(msg)?),
    })
}

/// A goal; its images are copied.
pub fn goal_to_msg(goal: &Goal, frame: &str) -> Result<sctn_msgs::Goal, ConvertError> {
    let image = |image: &Arc<Heightmap>, coverage: Coverage| {
        heightmap_to_msg(
            Heightmap::clone(image),
            header(Duration::ZERO, frame)?,
            coverage.views as usize,
            f64::from(coverage.fraction),
        )
    };
    Ok(sctn_msgs::Goal {
        header: header(goal.stamp, frame)?,
        problem: goal.problem.clone(),
        demonstration: goal.demonstration.clone(),
        step: goal.step,
        step_count: goal.step_count,
        attempt: goal.attempt,
        complete: goal.complete,
        module: goal.module.clone(),
        settings: settings_to_msg(&goal.settings),
        heightmap: image(&goal.image, goal.coverage)?,
        previous: match &goal.previous {
            Some(previous) => image(previous, Coverage::default())?,
            None => sctn_msgs::Heightmap::default(),
        },
    })
}

/// A goal with checked images and settings.
pub fn goal_from_msg(msg: sctn_msgs::Goal) -> Result<Goal, ConvertError> {
    let previous = match msg.previous.rows {
        0 => None,
        _ => Some(heightmap_from_msg(msg.previous).map_err(part("previous"))?),
    };
    Ok(Goal {
        stamp: time_from_msg(&msg.header.stamp)?,
        problem: msg.problem,
        demonstration: msg.demonstration,
        step: msg.step,
        step_count: msg.step_count,
        attempt: msg.attempt,
        complete: msg.complete,
        module: msg.module,
        settings: settings_from_msg(&msg.settings).map_err(part("settings"))?,
        coverage: coverage(&msg.heightmap),
        image: Arc::new(heightmap_from_msg(msg.heightmap).map_err(part("heightmap"))?),
        previous: previous.map(Arc::new),
    })
}

/// A proposal.
pub fn proposal_to_msg(proposal: &Proposal) -> Result<sctn_msgs::PickPlace, ConvertError> {
    Ok(sctn_msgs::PickPlace {
        header: header(proposal.stamp, &proposal.frame)?,
        id: proposal.id.0,
        problem: proposal.problem.clone(),
        step: proposal.step,
        attempt: proposal.attempt,
        pick: pose2d_to_msg(&proposal.action.pick),
        place: pose2d_to_msg(&proposal.action.place),
        pick_score: proposal.pick_score,
        place_score: proposal.place_score,
        settings: settings_to_msg(&proposal.settings),
        module: proposal.module.clone(),
        success_probability: proposal.success_probability.unwrap_or(-1.0),
        checkpoint: proposal.checkpoint.clone(),
        author: proposal.author.clone(),
        done_probability: proposal.done_probability.unwrap_or(-1.0),
    })
}

/// A proposal with finite poses and positive settings.
pub fn proposal_from_msg(msg: &sctn_msgs::PickPlace) -> Result<Proposal, ConvertError> {
    let probability = |value: f32| (0.0..=1.0).contains(&value).then_some(value);
    Ok(Proposal {
        id: ProposalId(msg.id),
        frame: msg.header.frame_id.clone(),
        stamp: time_from_msg(&msg.header.stamp).map_err(part("header"))?,
        problem: msg.problem.clone(),
        step: msg.step,
        attempt: msg.attempt,
        module: msg.module.clone(),
        action: pick_place_from_msg(msg)?,
        settings: settings_from_msg(&msg.settings).map_err(part("settings"))?,
        pick_score: msg.pick_score,
        place_score: msg.place_score,
        success_probability: probability(msg.success_probability),
        checkpoint: msg.checkpoint.clone(),
        author: msg.author.clone(),
        done_probability: probability(msg.done_probability),
    })
}

/// A result.
pub fn result_to_msg(
    result: &StepResult,
    frame: &str,
) -> Result<sctn_msgs::StepResult, ConvertError> {
    Ok(sctn_msgs::StepResult {
        header: header(result.stamp, frame)?,
        proposal_id: result.proposal_id.0,
        outcome: result.outcome.code(),
        reason: result.reason.clone(),
        duration: duration_to_msg(result.duration)?,
        proposal_status: result.status.map_or(0, ProposalStatus::code),
    })
}

/// A result with a known outcome.
pub fn result_from_msg(msg: &sctn_msgs::StepResult) -> Result<StepResult, ConvertError> {
    let outcome = StepOutcome::from_repr(msg.outcome);
    Ok(StepResult {
        stamp: time_from_msg(&msg.header.stamp)?,
        proposal_id: ProposalId(msg.proposal_id),
        outcome: outcome.ok_or_else(|| unexpected("outcome", msg.outcome, "1 to 9"))?,
        reason: msg.reason.clone(),
        duration: duration_from_msg(&msg.duration)?,
        status: ProposalStatus::from_repr(msg.proposal_status),
    })
}

/// A confirmation.
pub fn confirmation_to_msg(
    confirmation: &Confirmation,
) -> Result<sctn_msgs::StepConfirmation, ConvertError> {
    Ok(sctn_msgs::StepConfirmation {
        header: header(confirmation.stamp, "")?,
        proposal_id: confirmation.proposal_id.0,
        decision: confirmation.decision.code(),
        operator_name: confirmation.operator_name.clone(),
    })
}

/// A confirmation with a known decision. Its stamp is for people: one that is no time counts as 0.
pub fn confirmation_from_msg(
    msg: &sctn_msgs::StepConfirmation,
) -> Result<Confirmation, ConfirmationRefusal> {
    let decision = OperatorDecision::from_repr(msg.decision);
    Ok(Confirmation {
        stamp: time_from_msg(&msg.header.stamp).unwrap_or_default(),
        proposal_id: ProposalId(msg.proposal_id),
        decision: decision.ok_or(ConfirmationRefusal::NoDecision(msg.decision))?,
        operator_name: msg.operator_name.clone(),
    })
}

/// A reward with finite numbers.
pub fn reward_from_msg(msg: &sctn_msgs::Reward) -> Result<Reward, ConvertError> {
    use super::error::finite;
    Ok(Reward {
        stamp: time_from_msg(&msg.header.stamp)?,
        delta: finite("delta", msg.delta)?,
        total: finite("total", msg.total)?,
        complete: msg.complete,
    })
}

/// Which proposal the refused confirmation named, and of what kind the refusal is; none is a kind of a later version.
pub fn confirmation_refused_from_msg(
    msg: &sctn_msgs::ConfirmationRefused,
) -> (ProposalId, Option<RefusalKind>) {
    (
        ProposalId(msg.proposal_id),
        RefusalKind::from_repr(msg.reason),
    )
}

/// Why a confirmation changed nothing.
pub fn confirmation_refused_to_msg(
    proposal_id: ProposalId,
    refusal: &ConfirmationRefusal,
    stamp: Duration,
    frame: &str,
) -> Result<sctn_msgs::ConfirmationRefused, ConvertError> {
    Ok(sctn_msgs::ConfirmationRefused {
        header: crate::std_msgs::Header {
            stamp: time_to_msg(stamp)?,
            frame_id: frame.to_owned(),
        },
        proposal_id: proposal_id.0,
        reason: refusal.kind().code(),
        message: refusal.to_string(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use ::heightmap::Workspace;
    use ::pick_place::{PickPlace, PrimitiveSettings};
    use nalgebra::{Isometry2, Vector2};

    fn image(height_m: f32) -> Arc<Heightmap> {
        let mut heightmap = Heightmap::new(Workspace {
            rows: 4,
            cols: 3,
            ..Workspace::RAVENS
        });
        heightmap.height_m.fill(height_m);
        Arc::new(heightmap)
    }

    fn goal() -> Goal {
        Goal {
            stamp: Duration::from_millis(1500),
            problem: "placing".into(),
            demonstration: "placing/7".into(),
            step: 2,
            step_count: 9,
            attempt: 1,
            complete: false,
            module: "placing".into(),
            settings: PrimitiveSettings::RIGID,
            image: image(0.02),
            coverage: Coverage {
                views: 3,
                fraction: 0.75,
            },
            previous: Some(image(0.01)),
        }
    }

    fn proposal() -> Proposal {
        Proposal {
            id: ProposalId(7),
            frame: "world".into(),
            stamp: Duration::from_millis(1500),
            problem: "placing".into(),
            step: 2,
            attempt: 1,
            module: "placing".into(),
            action: PickPlace {
                pick: Isometry2::new(Vector2::new(0.4, 0.2), 0.0),
                place: Isometry2::new(Vector2::new(0.5, -0.2), 1.0),
            },
            settings: PrimitiveSettings::RIGID,
            pick_score: 0.75,
            place_score: 0.5,
            success_probability: Some(0.25),
            checkpoint: "a checkpoint".into(),
            author: "a policy".into(),
            done_probability: Some(0.125),
        }
    }

    #[test]
    fn the_messages_of_a_step_pass_unchanged() {
        let starts = Goal {
            previous: None,
            ..goal()
        };
        for goal in [goal(), starts] {
            assert_eq!(
                goal_from_msg(goal_to_msg(&goal, "world").unwrap()),
                Ok(goal)
            );
        }
        let unknown = Proposal {
            success_probability: None,
            ..proposal()
        };
        for proposal in [proposal(), unknown] {
            let message = proposal_to_msg(&proposal).unwrap();
            assert_eq!(proposal_from_msg(&message), Ok(proposal));
        }
        for &outcome in StepOutcome::ALL {
            for status in ProposalStatus::ALL.iter().copied().map(Some).chain([None]) {
                let result = StepResult {
                    stamp: Duration::from_secs(3),
                    proposal_id: ProposalId(7),
                    outcome,
                    reason: "because".into(),
                    duration: Duration::from_millis(2500),
                    status,
                };
                let message = result_to_msg(&result, "world").unwrap();
                assert_eq!(result_from_msg(&message), Ok(result));
            }
        }
        for &decision in OperatorDecision::ALL {
            let confirmation = Confirmation {
                stamp: Duration::from_secs(3),
                proposal_id: ProposalId(7),
                decision,
                operator_name: "somebody".into(),
            };
            let message = confirmation_to_msg(&confirmation).unwrap();
            assert_eq!(confirmation_from_msg(&message), Ok(confirmation));
        }
    }

    #[test]
    fn codes_are_the_constants_of_the_messages() {
        use sctn_msgs::{ConfirmationRefused, StepConfirmation, StepResult as Message};
        assert_eq!(StepOutcome::Placed.code(), Message::PLACED);
        assert_eq!(StepOutcome::NoContact.code(), Message::NO_CONTACT);
        assert_eq!(StepOutcome::GraspFailed.code(), Message::GRASP_FAILED);
        assert_eq!(StepOutcome::Dropped.code(), Message::DROPPED);
        assert_eq!(StepOutcome::LagAborted.code(), Message::LAG_ABORTED);
        assert_eq!(StepOutcome::Refused.code(), Message::REFUSED);
        assert_eq!(StepOutcome::Rejected.code(), Message::REJECTED);
        assert_eq!(StepOutcome::Fault.code(), Message::FAULT);
        assert_eq!(StepOutcome::Stopped.code(), Message::STOPPED);
        assert_eq!(StepOutcome::AtHome.code(), Message::AT_HOME);
        assert_eq!(StepOutcome::NotHome.code(), Message::NOT_HOME);
        assert_eq!(ProposalStatus::Pending.code(), Message::PROPOSAL_PENDING);
        assert_eq!(
            ProposalStatus::Superseded.code(),
            Message::PROPOSAL_SUPERSEDED
        );
        assert_eq!(ProposalStatus::Moving.code(), Message::PROPOSAL_MOVING);
        assert_eq!(ProposalStatus::Done.code(), Message::PROPOSAL_DONE);
        assert_eq!(ProposalStatus::Rejected.code(), Message::PROPOSAL_REJECTED);
        assert_eq!(
            ProposalStatus::Withdrawn.code(),
            Message::PROPOSAL_WITHDRAWN
        );
        assert_eq!(OperatorDecision::Approve.code(), StepConfirmation::APPROVE);
        assert_eq!(OperatorDecision::Reject.code(), StepConfirmation::REJECT);
        assert_eq!(OperatorDecision::Advance.code(), StepConfirmation::ADVANCE);
        assert_eq!(OperatorDecision::Retry.code(), StepConfirmation::RETRY);
        assert_eq!(OperatorDecision::Stop.code(), StepConfirmation::STOP);
        assert_eq!(
            OperatorDecision::StepBack.code(),
            StepConfirmation::STEP_BACK
        );
        let id = ProposalId(1);
        let (step, attempt) = (1, 0);
        for (refusal, code) in [
            (
                ConfirmationRefusal::Unknown { id, step, attempt },
                ConfirmationRefused::UNKNOWN,
            ),
            (
                ConfirmationRefusal::Stale { id, step, attempt },
                ConfirmationRefused::STALE,
            ),
            (
                ConfirmationRefusal::Twice { id },
                ConfirmationRefused::TWICE,
            ),
            (ConfirmationRefusal::Stopped, ConfirmationRefused::STOPPED),
            (ConfirmationRefusal::Complete, ConfirmationRefused::COMPLETE),
            (
                ConfirmationRefusal::NoDecision(9),
                ConfirmationRefused::NO_DECISION,
            ),
            (
                ConfirmationRefusal::NotAsked,
                ConfirmationRefused::NOT_ASKED,
            ),
        ] {
            let stamp = Duration::from_secs(1);
            let message = confirmation_refused_to_msg(id, &refusal, stamp, "world").unwrap();
            assert_eq!(
                (message.reason, message.message),
                (code, refusal.to_string())
            );
        }
    }

    #[test]
    fn errors_name_the_part_and_its_field() {
        let mut bad = proposal_to_msg(&proposal()).unwrap();
        bad.pick.x = f64::NAN;
        let error = proposal_from_msg(&bad).unwrap_err().to_string();
        assert_eq!(error, "pick.x is not finite, expected a finite number");
        let mut bad = goal_to_msg(&goal(), "world").unwrap();
        bad.settings.lift_m = f64::NAN;
        let error = goal_from_msg(bad).unwrap_err().to_string();
        assert!(error.starts_with("settings.lift_m"), "{error}");
        let mut bad = goal_to_msg(&goal(), "world").unwrap();
        bad.previous.height_m.pop();
        let error = goal_from_msg(bad).unwrap_err().to_string();
        assert!(error.starts_with("previous.height_m"), "{error}");
        let bad = sctn_msgs::StepResult::default();
        let error = result_from_msg(&bad).unwrap_err().to_string();
        assert_eq!(error, "outcome is 0, expected 1 to 9");
        let bad = sctn_msgs::StepConfirmation {
            decision: 77,
            ..Default::default()
        };
        let refusal = confirmation_from_msg(&bad);
        assert_eq!(refusal, Err(ConfirmationRefusal::NoDecision(77)));
    }
}
