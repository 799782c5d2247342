//! Teaching: the operator shows a task step by step.

use std::time::Duration;

use bags::Demonstration;
use pick_place::PrimitiveSettings;
use step_protocol::{OperatorDecision, ProposalId, RunPhase};

use super::{Command, State};
use crate::lesson::Lesson;
use crate::preview::Motion;
use crate::refusal::{Refusal, advice_on};
use crate::run::Pose;
use crate::session::ViewerId;

/// The executor plans a motion in this time.
const PLANNED_WITHIN: Duration = Duration::from_secs(5);

/// A motion of the lesson that the executor has not planned yet.
pub(super) struct Planning {
    proposal_id: ProposalId,
    since: Duration,
}

impl State {
    /// The operator begins a lesson.
    ///
    /// # Errors
    /// When somebody else decides, the arm moves, or a lesson is being given.
    pub fn begin_lesson(&mut self, viewer: ViewerId) -> Result<(), Refusal> {
        self.sessions.check_operator(viewer)?;
        self.check_no_lesson()?;
        if self.run.phase() == RunPhase::Moving {
            return Err(Refusal::new("The arm is moving.", "Wait until it is back."));
        }
        self.lesson = Some(Lesson::default());
        Ok(())
    }

    /// The operator ends the lesson; what is not saved is forgotten.
    ///
    /// # Errors
    /// When somebody else decides.
    pub fn end_lesson(&mut self, viewer: ViewerId) -> Result<(), Refusal> {
        self.sessions.check_operator(viewer)?;
        self.lesson = None;
        self.planning = None;
        Ok(())
    }

    fn lesson(&mut self, viewer: ViewerId) -> Result<&mut Lesson, Refusal> {
        self.sessions.check_operator(viewer)?;
        self.lesson
            .as_mut()
            .ok_or_else(|| Refusal::new("No lesson is being given.", "Begin a lesson first."))
    }

    /// The operator shows a step: it is proposed, and its planned motion is shown. Nothing moves before
    /// [`Self::execute_step`].
    ///
    /// # Errors
    /// When somebody else decides, the last motion is not judged, something is stale, or a pose lies outside the workspace.
    pub fn show_step(
        &mut self,
        viewer: ViewerId,
        pick: Pose,
        place: Pose,
        settings: PrimitiveSettings,
        now: Duration,
    ) -> Result<(), Refusal> {
        self.move_in_lesson(viewer, pick, place, settings, false, now)
    }

    /// The operator takes the last step of the lesson back: the arm is to move the object back.
    ///
    /// # Errors
    /// As [`Self::show_step`], and when there is no step.
    pub fn undo_step(&mut self, viewer: ViewerId, now: Duration) -> Result<(), Refusal> {
        let (pick, place, settings) = self.lesson(viewer)?.undo()?;
        self.move_in_lesson(viewer, pick, place, settings, true, now)
    }

    fn move_in_lesson(
        &mut self,
        viewer: ViewerId,
        pick: Pose,
        place: Pose,
        settings: PrimitiveSettings,
        undoes: bool,
        now: Duration,
    ) -> Result<(), Refusal> {
        let number = self.lesson(viewer)?.next();
        let author = self.sessions.name(viewer);
        let (proposal, view) = self
            .run
            .lesson_step(pick, place, settings, number, author, now)?;
        let view = view.clone();
        let id = proposal.id;
        self.lesson(viewer)?
            .begin(proposal.clone(), &view, undoes)?;
        self.send(Command::Propose(Box::new(proposal.clone())))?;
        // Its poses and settings were checked.
        let _ = self.run.on_proposal(proposal);
        self.planning = Some(Planning {
            proposal_id: id,
            since: now,
        });
        Ok(())
    }

    /// A new proposal of somebody else's, for instance of the policy, has superseded the motion of the lesson that waits for its
    /// approval: it is proposed again.
    pub(super) fn propose_again(&mut self, now: Duration) {
        let Some(pending) = self.lesson.as_ref().and_then(Lesson::pending) else {
            return;
        };
        let [pick, place] = [&pending.action.pick, &pending.action.place].map(Pose::from);
        let (settings, author) = (pending.settings, pending.author.clone());
        let Some(number) = self.lesson.as_ref().and_then(Lesson::next_renewal) else {
            let refusal = Refusal::new(
                "Other proposals take the place of the lesson's again and again: nothing has moved.",
                "Look which program proposes too, then show the step again.",
            );
            return self.forget_trial(refusal, now);
        };
        let again = self
            .run
            .lesson_step(pick, place, settings, number, &author, now);
        let sent = again.and_then(|(proposal, view)| {
            let view = view.clone();
            self.send(Command::Propose(Box::new(proposal.clone())))?;
            Ok((proposal, view))
        });
        match sent {
            Ok((proposal, view)) => {
                self.planning = Some(Planning {
                    proposal_id: proposal.id,
                    since: now,
                });
                if let Some(lesson) = &mut self.lesson {
                    lesson.renew(proposal.clone(), &view);
                }
                // Its poses and settings were checked.
                let _ = self.run.on_proposal(proposal);
            }
            Err(refusal) => self.forget_trial(refusal, now),
        }
    }

    /// The executor has planned a motion. That of the lesson is shown; where it cannot be planned, the lesson goes on without.
    pub fn on_planned_motion(&mut self, motion: Motion, now: Duration) {
        let (id, reason) = (motion.proposal_id, motion.reason.clone());
        self.run.on_planned_motion(motion);
        let asked = self.planning.take_if(|asked| asked.proposal_id == id);
        if asked.is_none() {
            return;
        }
        if reason.is_empty() {
            if let Some(lesson) = &mut self.lesson {
                lesson.planned();
            }
        } else {
            let refusal = Refusal::new(
                format!("The motion cannot be planned: {reason}."),
                advice_on(&reason),
            );
            self.forget_trial(refusal, now);
        }
    }

    /// The operator has the motion carried out whose plan is shown. It passes the executor's checks as every proposal does.
    ///
    /// # Errors
    /// When somebody else decides, no planned motion waits, or something is stale.
    pub fn execute_step(&mut self, viewer: ViewerId, now: Duration) -> Result<(), Refusal> {
        self.lesson(viewer)?;
        if let Some(refusal) = self.run.obstacle(now) {
            return Err(refusal);
        }
        let proposal_id = self.lesson(viewer)?.execute()?;
        let name = self.sessions.name(viewer).to_owned();
        let sent = self.confirm(proposal_id, OperatorDecision::Approve, name, now);
        if sent.is_err()
            && let Some(lesson) = &mut self.lesson
        {
            lesson.forget();
        }
        sent
    }

    /// The operator does not have the motion carried out whose plan is shown, and chooses pick and place anew.
    ///
    /// # Errors
    /// When somebody else decides, or no motion waits for its approval.
    pub fn change_step(&mut self, viewer: ViewerId) -> Result<(), Refusal> {
        self.lesson(viewer)?.change()?;
        self.planning = None;
        Ok(())
    }

    /// Nothing waits for an approval any more.
    pub(super) fn drop_planning(&mut self) {
        self.planning = None;
        if let Some(lesson) = &mut self.lesson
            && lesson.pending().is_some()
        {
            lesson.forget();
        }
    }

    /// Forgets a motion of the lesson that the executor has not planned. Returns whether there was one.
    pub(super) fn give_planning_up(&mut self, now: Duration) -> bool {
        let late = |asked: &mut Planning| now.saturating_sub(asked.since) > PLANNED_WITHIN;
        if self.planning.take_if(late).is_none() {
            return false;
        }
        let refusal = Refusal::new(
            "The executor has not planned the motion: nothing has moved.",
            "Look whether suction_executor is active, then show the step again.",
        );
        self.forget_trial(refusal, now);
        true
    }

    fn forget_trial(&mut self, refusal: Refusal, now: Duration) {
        self.planning = None;
        if let Some(lesson) = &mut self.lesson {
            lesson.forget();
        }
        self.run
            .note("refusal", refusal.reason, refusal.advice, now);
    }

    /// The operator says whether the step that was shown is as it should be.
    ///
    /// # Errors
    /// When somebody else decides, or there is nothing to judge.
    pub fn judge_step(&mut self, viewer: ViewerId, reached: bool) -> Result<(), Refusal> {
        self.lesson(viewer)?.judge(reached)
    }

    /// The lesson as a demonstration.
    ///
    /// # Errors
    /// When somebody else decides, the name cannot be one, or there is no step.
    pub fn lesson_demonstration(
        &mut self,
        viewer: ViewerId,
        name: &str,
    ) -> Result<Demonstration, Refusal> {
        self.lesson(viewer)?.demonstration(name)
    }

    /// The lesson is on disk.
    pub fn lesson_saved(&mut self) {
        self.library_version += 1;
        if let Some(lesson) = &mut self.lesson {
            lesson.saved();
        }
    }
}
