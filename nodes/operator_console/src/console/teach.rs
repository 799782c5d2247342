//! Teaching: the operator shows a task step by step.

use std::time::Duration;

use bags::Demonstration;
use msgs::sctn_msgs::{PrimitiveSettings, StepConfirmation};

use super::{Command, State};
use crate::lesson::Lesson;
use crate::refusal::Refusal;
use crate::run::{Decision, Phase, Pose};
use crate::session::ViewerId;

impl State {
    /// The operator begins a lesson.
    ///
    /// # Errors
    /// When somebody else decides, the arm moves, or a lesson is being given.
    pub fn begin_lesson(&mut self, viewer: ViewerId) -> Result<(), Refusal> {
        self.sessions.check_operator(viewer)?;
        self.check_no_lesson()?;
        if self.run.phase() == Phase::Moving {
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
        Ok(())
    }

    fn lesson(&mut self, viewer: ViewerId) -> Result<&mut Lesson, Refusal> {
        self.sessions.check_operator(viewer)?;
        self.lesson
            .as_mut()
            .ok_or_else(|| Refusal::new("No lesson is being given.", "Begin a lesson first."))
    }

    /// The operator shows a step: it is proposed and approved at once, and passes the executor's checks as every proposal does.
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

    /// The operator takes the last step of the lesson back: the arm moves the object back.
    ///
    /// # Errors
    /// As [`Self::show_step`], and when there is no step.
    pub fn undo_step(&mut self, viewer: ViewerId, now: Duration) -> Result<(), Refusal> {
        let (pick, place, shown) = self.lesson(viewer)?.undo()?;
        self.move_in_lesson(viewer, pick, place, shown.settings, true, now)
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
        self.confirm(StepConfirmation {
            proposal_id: id,
            decision: Decision::Approve.to_msg(),
            operator_name: self.sessions.name(viewer).to_owned(),
            ..StepConfirmation::default()
        })
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
        if let Some(lesson) = &mut self.lesson {
            lesson.saved();
        }
    }
}
