//! A lesson: picks and places that a person shows become a demonstration. No clock, no node.

use std::sync::Arc;
use std::time::Duration;

use bags::{Demonstration, DemonstrationStep};
use heightmap::Heightmap;
use pick_place::{Outcome, PrimitiveSettings};
use serde::Serialize;
use step_protocol::{Proposal, ProposalId, StepOutcome, StepResult};

use crate::refusal::Refusal;
use crate::run::{Pose, View};

/// Most steps of a lesson: each holds a heightmap.
const MOST_STEPS: usize = 100;
/// Most times that a motion is proposed again because another proposal has taken its place.
const MOST_RENEWALS: u32 = 8;
/// Longest name that a person gives [characters].
pub(crate) const LONGEST_NAME: usize = 40;

/// How far a lesson is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum LessonPhase {
    /// The person chooses pick and place.
    Choosing,
    /// The executor plans the motion.
    Planning,
    /// The planned motion is shown: the person has it carried out, or changes it.
    Previewing,
    /// The arm moves.
    Moving,
    /// The arm has moved, and its result is not in view yet.
    Looking,
    /// The person says whether the step is as it should be.
    Judging,
}

/// A motion that the person has asked for.
#[derive(Clone, Debug)]
struct Trial {
    proposal: Proposal,
    before: Arc<Heightmap>,
    /// It takes the last step back.
    undoes: bool,
    is_planned: bool,
    is_approved: bool,
    /// How often it was proposed again.
    renewals: u32,
    /// Outcome, and the end of the motion.
    ended: Option<(StepOutcome, Duration)>,
    after: Option<Arc<Heightmap>>,
}

/// A step that is kept.
#[derive(Clone, Debug)]
struct Shown {
    proposal: Proposal,
    outcome: Outcome,
    before: Arc<Heightmap>,
    after: Arc<Heightmap>,
}

/// Steps so far, and the one that is being shown.
#[derive(Clone, Debug, Default)]
pub struct Lesson {
    steps: Vec<Shown>,
    trial: Option<Trial>,
    trials: u32,
    /// Steps have been shown since the lesson was saved.
    unsaved: bool,
}

/// A lesson, as JSON for the page.
#[derive(Debug, Serialize)]
pub struct LessonState {
    phase: LessonPhase,
    /// Number of steps that are kept.
    step_count: usize,
    /// How the last motion ended, in words; nothing before the first.
    outcome: Option<&'static str>,
    /// The motion takes the last step back.
    undoes: bool,
    unsaved: bool,
    /// Pick and place of the motion that is planned, shown, carried out or judged.
    pick: Option<Pose>,
    place: Option<Pose>,
}

impl Lesson {
    /// How far it is.
    pub fn phase(&self) -> LessonPhase {
        match &self.trial {
            None => LessonPhase::Choosing,
            Some(Trial {
                is_planned: false,
                is_approved: false,
                ..
            }) => LessonPhase::Planning,
            Some(Trial {
                is_approved: false, ..
            }) => LessonPhase::Previewing,
            Some(Trial { ended: None, .. }) => LessonPhase::Moving,
            Some(Trial { after: None, .. }) => LessonPhase::Looking,
            Some(_) => LessonPhase::Judging,
        }
    }

    /// For the page.
    pub fn state(&self) -> LessonState {
        let ended = self.trial.as_ref().and_then(|trial| trial.ended);
        LessonState {
            phase: self.phase(),
            step_count: self.steps.len(),
            outcome: ended.map(|(outcome, _)| crate::run::outcome_words(outcome)),
            undoes: self.trial.as_ref().is_some_and(|trial| trial.undoes),
            unsaved: self.unsaved,
            pick: self
                .trial
                .as_ref()
                .map(|trial| Pose::from(&trial.proposal.action.pick)),
            place: self
                .trial
                .as_ref()
                .map(|trial| Pose::from(&trial.proposal.action.place)),
        }
    }

    /// The proposal of the motion that waits for its approval.
    pub fn pending(&self) -> Option<&Proposal> {
        let trial = self.trial.as_ref().filter(|trial| !trial.is_approved)?;
        Some(&trial.proposal)
    }

    fn check(&self, expected: LessonPhase) -> Result<(), Refusal> {
        if self.phase() == expected {
            return Ok(());
        }
        let (reason, advice) = match self.phase() {
            LessonPhase::Choosing => ("Nothing has been shown.", "Choose pick and place first."),
            LessonPhase::Planning => ("The executor plans the motion.", "Wait a moment."),
            LessonPhase::Previewing => (
                "The planned motion is shown.",
                "Have it carried out, or change it.",
            ),
            LessonPhase::Moving => ("The arm is moving.", "Wait until it is back, or stop it."),
            LessonPhase::Looking => (
                "The cameras have not shown the result yet.",
                "Wait a moment.",
            ),
            LessonPhase::Judging => (
                "The last motion has not been judged.",
                "Say first whether the step is as it should be.",
            ),
        };
        Err(Refusal::new(reason, advice))
    }

    /// A motion begins: `proposal` was made from `before`.
    ///
    /// # Errors
    /// When another one is not finished, or the lesson is full.
    pub fn begin(
        &mut self,
        proposal: Proposal,
        before: &View,
        undoes: bool,
    ) -> Result<(), Refusal> {
        self.check(LessonPhase::Choosing)?;
        if self.steps.len() >= MOST_STEPS {
            return Err(Refusal::new(
                format!("The lesson has {MOST_STEPS} steps, which is the most."),
                "Save it.",
            ));
        }
        self.trials += 1;
        self.trial = Some(Trial {
            proposal,
            before: Arc::clone(&before.heightmap),
            undoes,
            is_planned: false,
            is_approved: false,
            renewals: 0,
            ended: None,
            after: None,
        });
        Ok(())
    }

    /// The executor has planned the motion that was begun.
    pub fn planned(&mut self) {
        if let Some(trial) = &mut self.trial {
            trial.is_planned = true;
        }
    }

    /// The person has the planned motion carried out. Returns its proposal, which has to be approved.
    ///
    /// # Errors
    /// When there is no planned motion that waits.
    pub fn execute(&mut self) -> Result<ProposalId, Refusal> {
        self.check(LessonPhase::Previewing)?;
        let trial = self.trial.as_mut().ok_or_else(|| {
            Refusal::new("Nothing has been shown.", "Choose pick and place first.")
        })?;
        trial.is_approved = true;
        Ok(trial.proposal.id)
    }

    /// The person chooses pick and place anew.
    ///
    /// # Errors
    /// When the motion is carried out already, or there is none.
    pub fn change(&mut self) -> Result<(), Refusal> {
        match self.phase() {
            LessonPhase::Planning | LessonPhase::Previewing => {
                self.trial = None;
                Ok(())
            }
            _ => self.check(LessonPhase::Previewing),
        }
    }

    /// The motion that was begun has not been approved: it is as though it was never asked for.
    pub fn forget(&mut self) {
        self.trial = None;
    }

    /// The motion that was approved is not carried out.
    pub fn forget_motion(&mut self) {
        self.trial.take_if(|trial| trial.ended.is_none());
    }

    /// Step number and attempt of the motion that waits, if it is proposed again; `None` where that was done too often.
    pub fn next_renewal(&self) -> Option<(u32, u32)> {
        let trial = self.trial.as_ref()?;
        (trial.renewals < MOST_RENEWALS).then(|| self.next())
    }

    /// Somebody else's proposal has taken the place of the one that waits: it is proposed again, as another one made from `before`.
    pub fn renew(&mut self, proposal: Proposal, before: &View) {
        self.trials += 1;
        if let Some(trial) = &mut self.trial {
            trial.proposal = proposal;
            trial.before = Arc::clone(&before.heightmap);
            trial.is_planned = false;
            trial.renewals += 1;
        }
    }

    /// Step number and attempt of the next motion.
    pub fn next(&self) -> (u32, u32) {
        (self.steps.len() as u32 + 1, self.trials)
    }

    /// The executor has reported. A motion that was refused or rejected is forgotten.
    pub fn on_result(&mut self, result: &StepResult) {
        let Some(trial) = &mut self.trial else {
            return;
        };
        if trial.proposal.id != result.proposal_id {
            return;
        }
        match result.outcome {
            StepOutcome::Refused | StepOutcome::Rejected => self.trial = None,
            outcome => {
                (trial.is_planned, trial.is_approved) = (true, true);
                trial.ended = Some((outcome, result.stamp));
            }
        }
    }

    /// A heightmap has come: the first one after the motion shows its result.
    pub fn on_heightmap(&mut self, view: &View) {
        if let Some(trial) = &mut self.trial
            && let Some((_, ended)) = trial.ended
            && trial.after.is_none()
            && view.stamp >= ended
        {
            trial.after = Some(Arc::clone(&view.heightmap));
        }
    }

    /// The person says whether the step is as it should be: it is kept, or forgotten.
    ///
    /// # Errors
    /// When there is nothing to judge.
    pub fn judge(&mut self, reached: bool) -> Result<(), Refusal> {
        self.check(LessonPhase::Judging)?;
        let ended = self.trial.as_ref().and_then(|trial| trial.ended);
        let motion = ended.and_then(|(outcome, _)| outcome.motion());
        if reached && motion.is_none() {
            return Err(Refusal::new(
                "The motion was broken off: it cannot be a step.",
                "Bring the arm home, then try again.",
            ));
        }
        let Some(Trial {
            proposal,
            before,
            undoes,
            after: Some(after),
            ..
        }) = self.trial.take()
        else {
            return Ok(());
        };
        match (motion.filter(|_| reached), undoes) {
            (Some(outcome), false) => {
                self.steps.push(Shown {
                    proposal,
                    outcome,
                    before,
                    after,
                });
                self.unsaved = true;
            }
            (Some(_), true) => {
                self.steps.pop();
                self.unsaved = true;
            }
            (None, _) => {}
        }
        Ok(())
    }

    /// Pick, place and settings that take the last step back: the object goes from where it was placed to where it was picked.
    ///
    /// # Errors
    /// When there is no step, or the last motion is not judged.
    pub fn undo(&self) -> Result<(Pose, Pose, PrimitiveSettings), Refusal> {
        self.check(LessonPhase::Choosing)?;
        let Some(last) = self.steps.last() else {
            return Err(Refusal::new(
                "There is no step to take back.",
                "Choose pick and place.",
            ));
        };
        let Proposal {
            action, settings, ..
        } = &last.proposal;
        let (pick, place) = (Pose::from(&action.pick), Pose::from(&action.place));
        Ok((place, pick, *settings))
    }

    /// The steps as a demonstration. Each of them is worth the same.
    ///
    /// # Errors
    /// When the name cannot be that of a folder, there is no step, or the last motion is not judged.
    pub fn demonstration(&self, name: &str) -> Result<Demonstration, Refusal> {
        check_name(name)?;
        self.check(LessonPhase::Choosing)?;
        let Some(last) = self.steps.last() else {
            return Err(Refusal::new(
                "The lesson has no step.",
                "Show at least one step, and say that it is as it should be.",
            ));
        };
        let steps = self.steps.iter().map(|shown| DemonstrationStep {
            observation: Heightmap::clone(&shown.before),
            action: shown.proposal.action,
            settings: shown.proposal.settings,
            module: shown.proposal.module.clone(),
            delta_reward: 1.0 / self.steps.len() as f64,
            outcome: shown.outcome,
        });
        Ok(Demonstration {
            problem: name.to_owned(),
            seed: 0,
            start_seed: 0,
            steps: steps.collect(),
            last: Heightmap::clone(&last.after),
        })
    }

    /// What was shown has been saved.
    pub fn saved(&mut self) {
        self.unsaved = false;
    }
}

/// Checks the name that a person gives to a demonstration or a policy: it becomes that of a folder or file.
///
/// # Errors
/// When it cannot be one.
pub fn check_name(name: &str) -> Result<(), Refusal> {
    check_name_up_to(name, LONGEST_NAME)
}

/// As [`check_name`], for names of up to so many characters.
pub(crate) fn check_name_up_to(name: &str, longest: usize) -> Result<(), Refusal> {
    let good = |character: char| character.is_ascii_alphanumeric() || "-_".contains(character);
    if (1..=longest).contains(&name.len()) && name.chars().all(good) {
        return Ok(());
    }
    Err(Refusal::new(
        format!("A demonstration's name has 1 to {longest} letters, digits, - and _."),
        "Type another name.",
    ))
}
