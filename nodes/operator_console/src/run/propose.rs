//! Proposals of the operator's: corrections, and steps of a lesson.

use std::time::Duration;

use msgs::geometry_msgs::Pose2D;
use msgs::sctn_msgs::{PickPlace, PrimitiveSettings};
use serde::{Deserialize, Serialize};

use super::decide::out_of_phase;
use super::view::contains;
use super::{Phase, Run, View, duration};
use crate::refusal::Refusal;

/// Problem and task module of what is shown in a lesson.
const LESSON: &str = "lesson";

/// Where to pick or place, in the world frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Pose {
    /// Position along x.
    pub x_m: f64,
    /// Position along y.
    pub y_m: f64,
    /// Turn about z.
    pub yaw_rad: f64,
}

impl Pose {
    pub(crate) fn from_msg(pose: &Pose2D) -> Self {
        Self {
            x_m: pose.x,
            y_m: pose.y,
            yaw_rad: pose.theta,
        }
    }

    fn to_msg(self) -> Pose2D {
        Pose2D {
            x: self.x_m,
            y: self.y_m,
            theta: self.yaw_rad,
        }
    }
}

impl Run {
    /// A proposal of the operator's for the present goal, made from the newest heightmap.
    ///
    /// # Errors
    /// When nothing can be proposed now, or a pose lies outside the workspace.
    pub fn correction(&self, pick: Pose, place: Pose, author: &str) -> Result<PickPlace, Refusal> {
        let phase = self.phase();
        if !matches!(phase, Phase::Proposed | Phase::AwaitingProposal) {
            return Err(out_of_phase(phase));
        }
        let (Some(goal), Some(view)) = (&self.goal, self.views.back()) else {
            return Err(no_picture());
        };
        if duration(&goal.header.stamp).is_ok_and(|since| view.stamp < since) {
            return Err(Refusal::new(
                "The picture is from before the last motion.",
                "Wait for the next one.",
            ));
        }
        let proposal = from_view(
            view,
            PickPlace {
                problem: goal.problem.clone(),
                step: goal.step,
                attempt: goal.attempt,
                pick: pick.to_msg(),
                place: place.to_msg(),
                settings: goal.settings,
                module: goal.module.clone(),
                author: author.to_owned(),
                ..PickPlace::default()
            },
        )?;
        if self
            .offered
            .iter()
            .any(|known| known.message.id == proposal.id)
        {
            return Err(Refusal::new(
                "The same correction was made before.",
                "Approve it, or move pick, place or turn.",
            ));
        }
        Ok(proposal)
    }

    /// A step of a lesson, made from the newest heightmap; and that heightmap.
    ///
    /// # Errors
    /// When the robot or a stream is not ready, or a pose lies outside the workspace.
    pub fn lesson_step(
        &self,
        pick: Pose,
        place: Pose,
        settings: PrimitiveSettings,
        (step, attempt): (u32, u32),
        author: &str,
        now: Duration,
    ) -> Result<(PickPlace, &View), Refusal> {
        if let Some(refusal) = self.obstacle(now) {
            return Err(refusal);
        }
        let view = self.views.back().ok_or_else(no_picture)?;
        let proposal = PickPlace {
            problem: LESSON.to_owned(),
            module: LESSON.to_owned(),
            step,
            attempt,
            pick: pick.to_msg(),
            place: place.to_msg(),
            settings,
            author: author.to_owned(),
            ..PickPlace::default()
        };
        Ok((from_view(view, proposal)?, view))
    }
}

/// Completes a proposal of the operator's that is made from this heightmap.
fn from_view(view: &View, mut proposal: PickPlace) -> Result<PickPlace, Refusal> {
    for (which, pose) in [("pick", &proposal.pick), ("place", &proposal.place)] {
        let finite = [pose.x, pose.y, pose.theta].into_iter().all(f64::is_finite);
        if !finite || !contains(&view.heightmap, pose.x, pose.y) {
            return Err(Refusal::new(
                format!("The {which} lies outside the workspace."),
                "Choose a place on the picture.",
            ));
        }
    }
    proposal.header = view.heightmap.header.clone();
    proposal.id = correction_id(&proposal, view.stamp);
    Ok(proposal)
}

fn no_picture() -> Refusal {
    Refusal::new(
        "There is no picture of the table yet.",
        "Wait for the cameras.",
    )
}

/// FNV-1a of 64 bits over what makes the proposal what it is, and over a word that no policy's proposal has.
fn correction_id(proposal: &PickPlace, stamp: Duration) -> u64 {
    let PickPlace {
        step,
        attempt,
        pick,
        place,
        ..
    } = proposal;
    let poses = [pick.x, pick.y, pick.theta, place.x, place.y, place.theta];
    let words = [stamp.as_nanos() as u64, (*step).into(), (*attempt).into()]
        .into_iter()
        .chain(poses.map(f64::to_bits))
        .flat_map(u64::to_le_bytes);
    b"operator"
        .iter()
        .copied()
        .chain(words)
        .fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
            (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
        })
}
