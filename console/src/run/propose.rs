//! Proposals of the operator's: corrections, and steps of a lesson.

use std::time::Duration;

use nalgebra::{Isometry2, Point2, Vector2};
use pick_place::{PickPlace, PrimitiveSettings};
use serde::{Deserialize, Serialize};
use step_protocol::{Proposal, ProposalId, RunPhase, yaw_rad};

use super::decide::out_of_phase;
use super::{Run, View};
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
    fn is_finite(&self) -> bool {
        [self.x_m, self.y_m, self.yaw_rad]
            .into_iter()
            .all(f64::is_finite)
    }
}

impl From<&Isometry2<f64>> for Pose {
    fn from(pose: &Isometry2<f64>) -> Self {
        Self {
            x_m: pose.translation.x,
            y_m: pose.translation.y,
            yaw_rad: yaw_rad(&pose.rotation),
        }
    }
}

impl From<Pose> for Isometry2<f64> {
    fn from(pose: Pose) -> Self {
        Self::new(Vector2::new(pose.x_m, pose.y_m), pose.yaw_rad)
    }
}

impl Run {
    /// A proposal of the operator's for the present goal, made from the newest heightmap.
    ///
    /// # Errors
    /// When nothing can be proposed now, or a pose lies outside the workspace.
    pub fn correction(&self, pick: Pose, place: Pose, author: &str) -> Result<Proposal, Refusal> {
        let phase = self.phase();
        if !matches!(phase, RunPhase::Proposed | RunPhase::AwaitingProposal) {
            return Err(out_of_phase(phase));
        }
        let (Some(goal), Some(view)) = (self.goal(), self.views.back()) else {
            return Err(no_picture());
        };
        if view.stamp < goal.stamp {
            return Err(Refusal::new(
                "The picture is from before the last motion.",
                "Wait for the next one.",
            ));
        }
        let proposal = Shown {
            problem: &goal.problem,
            module: &goal.module,
            step: goal.step,
            attempt: goal.attempt,
            pick,
            place,
            settings: goal.settings,
            author,
        };
        let proposal = proposal.on(view)?;
        if self.proposal(proposal.id).is_some() {
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
    ) -> Result<(Proposal, &View), Refusal> {
        if let Some(refusal) = self.obstacle(now) {
            return Err(refusal);
        }
        let view = self.views.back().ok_or_else(no_picture)?;
        let proposal = Shown {
            problem: LESSON,
            module: LESSON,
            step,
            attempt,
            pick,
            place,
            settings,
            author,
        };
        Ok((proposal.on(view)?, view))
    }
}

/// What a person shows on a picture.
struct Shown<'a> {
    problem: &'a str,
    module: &'a str,
    step: u32,
    attempt: u32,
    pick: Pose,
    place: Pose,
    settings: PrimitiveSettings,
    author: &'a str,
}

impl Shown<'_> {
    /// The proposal that is made from this view.
    fn on(self, view: &View) -> Result<Proposal, Refusal> {
        for (which, pose) in [("pick", self.pick), ("place", self.place)] {
            let point = Point2::new(pose.x_m, pose.y_m);
            if !pose.is_finite() || view.heightmap.workspace.pixel(&point).is_none() {
                return Err(Refusal::new(
                    format!("The {which} lies outside the workspace."),
                    "Choose a place on the picture.",
                ));
            }
        }
        Ok(Proposal {
            id: self.id(view.stamp),
            frame: view.frame.clone(),
            stamp: view.stamp,
            problem: self.problem.to_owned(),
            step: self.step,
            attempt: self.attempt,
            module: self.module.to_owned(),
            action: PickPlace {
                pick: self.pick.into(),
                place: self.place.into(),
            },
            settings: self.settings,
            pick_score: 0.0,
            place_score: 0.0,
            success_probability: None,
            done_probability: None,
            checkpoint: String::new(),
            author: self.author.to_owned(),
        })
    }

    /// A hash of what makes the proposal what it is, and of a word that no policy's proposal has.
    fn id(&self, stamp: Duration) -> ProposalId {
        let poses = [self.pick, self.place].map(|pose| [pose.x_m, pose.y_m, pose.yaw_rad]);
        let words = [
            stamp.as_nanos() as u64,
            self.step.into(),
            self.attempt.into(),
        ]
        .into_iter()
        .chain(poses.concat().into_iter().map(f64::to_bits))
        .flat_map(u64::to_le_bytes);
        ProposalId(fnv1a(b"operator".iter().copied().chain(words)))
    }
}

/// FNV-1a of 64 bits.
pub(super) fn fnv1a(bytes: impl Iterator<Item = u8>) -> u64 {
    bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
    })
}

fn no_picture() -> Refusal {
    Refusal::new(
        "There is no picture of the table yet.",
        "Wait for the cameras.",
    )
}
