//! Which motion is rehearsed next, and what was seen and rehearsed before.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use collision::CollisionChecker;
use heightmap::{ChangeRules, Heightmap};
use pick_place::{ContactSettings, ContactSign};
use step_protocol::{CannotBegin, MotionOrder, Proposal, Recovery};
use ur5::{Arm, AtHome, Joints};

use crate::{Picked, Rehearsed, RobotNow, Subject};

/// What rehearsals go by, the same for all of them.
#[derive(Clone)]
pub struct RehearsalRules {
    /// The arm.
    pub arm: Arm,
    /// Checks motions against cell and arm.
    pub checker: Arc<CollisionChecker>,
    /// Whether the arm has to have been at home and at rest since the heightmaps were taken.
    pub needs_home: bool,
    /// An approval needs a heightmap that is not older.
    pub observation_max_age: Duration,
    /// How the tip comes down.
    pub contact: ContactSettings,
    /// What tells that the tool touches something.
    pub sign: ContactSign,
    /// What counts as a change of the view.
    pub changes: ChangeRules,
}

/// What the robot's driver and the graph say now.
#[derive(Clone, Debug, Default)]
pub struct Reading {
    /// Why nothing may begin to move, where there is a reason.
    pub obstacle: Option<String>,
    /// Where the joints are (rad), where that is known.
    pub joints_rad: Option<Joints>,
    /// Whether the gripper holds something, where that is known.
    pub holds: Option<bool>,
    /// Whether the arm is out of the cameras' view.
    pub at_home: AtHome,
    /// ROS time.
    pub time: Duration,
    /// How many publish heightmaps.
    pub publishers: usize,
}

/// Motions are rehearsed one at a time. `C`: a call for a recovery, to be answered when that was rehearsed.
pub struct Rehearsals<C> {
    rules: RehearsalRules,
    /// The newest heightmap and its stamp.
    seen: Option<(Arc<Heightmap>, Duration)>,
    /// Whether anybody was known to publish heightmaps.
    had_publisher: bool,
    /// The newest heightmap that is sure not to show the arm.
    without_arm: Option<Arc<Heightmap>>,
    /// Where the last motion has picked.
    picked: Option<Picked>,
    /// The last rehearsal of a proposal.
    proposal: Option<Arc<Rehearsed>>,
    /// The last rehearsal of a recovery.
    recovery: Option<Arc<Rehearsed>>,
    /// Whether a rehearsal is under way.
    is_running: bool,
    /// Calls that wait for the rehearsal of a recovery.
    calls: VecDeque<(Recovery, C)>,
}

impl<C> Rehearsals<C> {
    /// Nothing was seen or rehearsed yet.
    pub fn new(rules: RehearsalRules) -> Self {
        Self {
            rules,
            seen: None,
            had_publisher: false,
            without_arm: None,
            picked: None,
            proposal: None,
            recovery: None,
            is_running: false,
            calls: VecDeque::new(),
        }
    }

    /// Takes the newest observation; `publishers` as many publish them.
    pub fn on_heightmap(
        &mut self,
        stamp: Duration,
        heightmap: &Arc<Heightmap>,
        publishers: usize,
        at_home: &AtHome,
    ) {
        self.seen = Some((Arc::clone(heightmap), stamp));
        self.had_publisher |= publishers > 0;
        if at_home.may_be_in_view(stamp) {
            return;
        }
        self.without_arm = Some(Arc::clone(heightmap));
        // It was on its way when the motion began: the arm has not left home yet, and nothing is picked.
        if let Some(picked) = &mut self.picked
            && picked.at_home == *at_home
        {
            picked.seen = Arc::clone(heightmap);
        }
    }

    /// The robot as the gate sees it.
    pub fn robot(&self, reading: Reading) -> RobotNow {
        let rules = self.rules.clone();
        RobotNow {
            arm: rules.arm,
            checker: rules.checker,
            obstacle: reading.obstacle,
            joints_rad: reading.joints_rad,
            holds: reading.holds,
            at_home: reading.at_home,
            time: reading.time,
            seen: self.seen.clone(),
            unseen: self.had_publisher && reading.publishers == 0,
            needs_home: rules.needs_home,
            observation_max_age: rules.observation_max_age,
            changes: rules.changes,
            contact: rules.contact,
            sign: rules.sign,
            without_arm: self.without_arm.clone(),
            picked: self.picked.clone(),
            rehearsed: self.proposal.clone(),
            rehearsed_recovery: self.recovery.clone(),
        }
    }

    /// A motion begins. `at_home`: where the arm is before it.
    pub fn on_motion(&mut self, order: &MotionOrder, at_home: &AtHome) {
        if let MotionOrder::Proposal(proposal) = order {
            self.picked = self.seen.as_ref().map(|(seen, _)| Picked {
                tip: proposal.action.tips().0,
                seen: Arc::clone(seen),
                at_home: *at_home,
            });
        }
    }

    /// Somebody asks for a recovery. The call may come again because its answer was lost.
    pub fn call(&mut self, recovery: Recovery, call: C) {
        self.calls.push_back((recovery, call));
    }

    /// What is to be rehearsed now, if something is; [`Self::ended`] has to follow. `pending`: the proposal that can be approved. Not to be asked
    /// while the arm moves: a motion would begin elsewhere.
    pub fn next(&mut self, pending: Option<&Proposal>, robot: &RobotNow) -> Option<Subject> {
        if self.is_running {
            return None;
        }
        let subject = match (self.calls.front(), pending) {
            (Some((recovery, _)), _) => Subject::Recovery(*recovery),
            (None, Some(pending)) if robot.rehearsal_of(pending.id).is_none() => {
                Subject::Proposal(Box::new(pending.clone()))
            }
            (None, _) => return None,
        };
        self.is_running = true;
        Some(subject)
    }

    /// Whether the last rehearsal of a proposal had not seen enough: the first heightmap may come after the first proposal.
    pub fn was_unseen(&self) -> bool {
        let rehearsed = self.proposal.as_ref();
        rehearsed.is_none_or(|rehearsed| !rehearsed.was_seen())
    }

    /// The rehearsal under way has ended; without a result where its thread has failed.
    pub fn ended(&mut self, rehearsed: Option<Arc<Rehearsed>>) {
        self.is_running = false;
        match rehearsed.as_ref().map(|rehearsed| &rehearsed.subject) {
            Some(Subject::Proposal(_)) => self.proposal = rehearsed,
            Some(Subject::Recovery(_)) => self.recovery = rehearsed,
            None => {}
        }
    }

    /// The last rehearsal of a recovery.
    pub fn recovery(&self) -> Option<&Rehearsed> {
        self.recovery.as_deref()
    }

    /// Takes the calls that need not wait, with their answers: nothing can be proposed now, or it was rehearsed. `rehearsed`: what has just been; where
    /// that is not valid any more, the caller has to call again.
    pub fn answers<T>(
        &mut self,
        rehearsed: Option<Recovery>,
        mut propose: impl FnMut(Recovery) -> Result<T, CannotBegin>,
    ) -> Vec<(Recovery, C, Result<T, String>)> {
        let mut answers = Vec::new();
        for (recovery, call) in std::mem::take(&mut self.calls) {
            let answer = match propose(recovery) {
                Ok(proposed) => Ok(proposed),
                Err(CannotBegin::Refused(obstacle)) => Err(obstacle.into()),
                Err(CannotBegin::NotRehearsed) if rehearsed == Some(recovery) => Err(
                    "the arm, what is held or what is seen has changed meanwhile: call again"
                        .to_owned(),
                ),
                Err(CannotBegin::NotRehearsed) => {
                    self.calls.push_back((recovery, call));
                    continue;
                }
            };
            answers.push((recovery, call, answer));
        }
        answers
    }
}

#[cfg(test)]
mod tests {
    use heightmap::Workspace;
    use step_protocol::{ProposalId, RefusalReason};
    use ur5::WorkCell;

    use super::*;
    use crate::fixtures::{proposal, reading, rehearsals};

    const ID: ProposalId = ProposalId(7);

    fn table() -> Arc<Heightmap> {
        Arc::new(Heightmap::new(Workspace::RAVENS))
    }

    /// Rehearses what is due, and says what that was.
    fn rehearse(rehearsals: &mut Rehearsals<u32>, pending: &Proposal) -> Option<Subject> {
        let robot = rehearsals.robot(reading());
        let subject = rehearsals.next(Some(pending), &robot)?;
        // One at a time.
        assert!(rehearsals.next(Some(pending), &robot).is_none());
        rehearsals.ended(Some(Arc::new(robot.rehearse(subject.clone()))));
        Some(subject)
    }

    #[test]
    fn a_proposal_is_rehearsed_once_and_again_when_something_has_been_seen() {
        let mut rehearsals = rehearsals();
        let pending = proposal(ID);
        assert!(rehearsals.was_unseen());
        assert!(rehearse(&mut rehearsals, &pending).is_some());
        assert!(rehearsals.was_unseen());
        assert!(rehearse(&mut rehearsals, &pending).is_none());
        let at_home = AtHome::default();
        rehearsals.on_heightmap(Duration::ZERO, &table(), 1, &at_home);
        assert!(rehearse(&mut rehearsals, &pending).is_some());
        assert!(!rehearsals.was_unseen());
        assert!(rehearse(&mut rehearsals, &pending).is_none());
        let robot = rehearsals.robot(reading());
        assert!(robot.rehearsal_of(ID).is_some());
        let next = proposal(ProposalId(8));
        assert!(rehearse(&mut rehearsals, &next).is_some());
        assert!(rehearsals.next(None, &robot).is_none());
    }

    #[test]
    fn a_call_goes_before_the_proposal_and_is_answered_when_its_motion_was_rehearsed() {
        let mut rehearsals = rehearsals();
        rehearsals.call(Recovery::Home, 1);
        rehearsals.call(Recovery::PutDown, 2);
        let not_rehearsed = |_| -> Result<(), CannotBegin> { Err(CannotBegin::NotRehearsed) };
        assert_eq!(rehearsals.answers(None, not_rehearsed), []);
        let subject = rehearse(&mut rehearsals, &proposal(ID));
        assert!(matches!(subject, Some(Subject::Recovery(Recovery::Home))));
        let home = rehearsals.recovery().unwrap();
        assert!(matches!(home.subject, Subject::Recovery(Recovery::Home)));
        // What was rehearsed is proposed; the other call goes on waiting.
        let propose = |recovery| match recovery {
            Recovery::Home => Ok("home"),
            Recovery::PutDown => Err(CannotBegin::NotRehearsed),
        };
        let answers = rehearsals.answers(Some(Recovery::Home), propose);
        assert_eq!(answers, [(Recovery::Home, 1, Ok("home"))]);
        let refuse = |_| -> Result<(), CannotBegin> {
            let reason = RefusalReason::HoldsNothing.because("the gripper holds nothing");
            Err(CannotBegin::Refused(reason))
        };
        let refused = Err("the gripper holds nothing".to_owned());
        let answers = rehearsals.answers(None, refuse);
        assert_eq!(answers, [(Recovery::PutDown, 2, refused)]);
        assert_eq!(rehearsals.answers(None, refuse), []);
    }

    #[test]
    fn a_caller_whose_rehearsal_holds_no_more_has_to_call_again() {
        let mut rehearsals = rehearsals();
        rehearsals.call(Recovery::Home, 1);
        let not_rehearsed = |_| -> Result<(), CannotBegin> { Err(CannotBegin::NotRehearsed) };
        let answers = rehearsals.answers(Some(Recovery::Home), not_rehearsed);
        let [(Recovery::Home, 1, Err(reason))] = &answers[..] else {
            panic!("expected a refusal, found {answers:?}");
        };
        assert!(reason.contains("has changed meanwhile"), "{reason}");
    }

    #[test]
    fn after_a_rehearsal_that_failed_the_next_one_begins() {
        let mut rehearsals = rehearsals();
        let (pending, robot) = (proposal(ID), rehearsals.robot(reading()));
        assert!(rehearsals.next(Some(&pending), &robot).is_some());
        rehearsals.ended(None);
        assert!(rehearsals.next(Some(&pending), &robot).is_some());
    }

    #[test]
    fn the_table_without_the_arm_and_the_place_of_the_pick_are_remembered() {
        let mut rehearsals = rehearsals();
        let home = WorkCell::builtin().unwrap().arm.home;
        let mut at_home = AtHome::default();
        let (first, second) = (table(), table());
        // Where the arm is is not known: it may be in view.
        rehearsals.on_heightmap(Duration::from_secs(1), &first, 1, &at_home);
        assert!(rehearsals.robot(reading()).without_arm.is_none());
        at_home.read(Duration::from_secs(2), &home, &Joints::zeros(), &home);
        rehearsals.on_heightmap(Duration::from_secs(3), &second, 1, &at_home);
        rehearsals.on_motion(&MotionOrder::Proposal(Box::new(proposal(ID))), &at_home);
        let away = AtHome::default();
        rehearsals.on_heightmap(Duration::from_secs(4), &first, 1, &away);
        // A way home picks nothing.
        rehearsals.on_motion(&MotionOrder::Home(ProposalId(8)), &away);
        let robot = rehearsals.robot(reading());
        assert!(Arc::ptr_eq(&robot.without_arm.unwrap(), &second));
        let picked = robot.picked.unwrap();
        assert!(Arc::ptr_eq(&picked.seen, &second));
        assert_eq!(picked.tip, proposal(ID).action.tips().0);
        assert!(Arc::ptr_eq(&robot.seen.unwrap().0, &first));
    }

    #[test]
    fn a_view_that_comes_as_the_motion_begins_shows_what_is_picked_where_it_was() {
        let mut rehearsals = rehearsals();
        let home = WorkCell::builtin().unwrap().arm.home;
        let mut at_home = AtHome::default();
        let mut read = |second, offset_rad| {
            let positions = home.add_scalar(offset_rad);
            at_home.read(
                Duration::from_secs(second),
                &positions,
                &Joints::zeros(),
                &home,
            );
            at_home
        };
        let [before, late, after] = [(); 3].map(|()| table());
        let at_first = read(1, 0.0);
        rehearsals.on_heightmap(Duration::from_secs(2), &before, 1, &at_first);
        rehearsals.on_motion(&MotionOrder::Proposal(Box::new(proposal(ID))), &at_first);
        rehearsals.on_heightmap(Duration::from_secs(3), &late, 1, &at_first);
        let picked = rehearsals.robot(reading()).picked.unwrap();
        assert!(Arc::ptr_eq(&picked.seen, &late));
        // The arm has been away, and what it holds is no longer where it was.
        read(4, 0.1);
        let at_last = read(5, 0.0);
        rehearsals.on_heightmap(Duration::from_secs(6), &after, 1, &at_last);
        let robot = rehearsals.robot(reading());
        assert!(Arc::ptr_eq(&robot.picked.unwrap().seen, &late));
        assert!(Arc::ptr_eq(&robot.without_arm.unwrap(), &after));
    }

    #[test]
    fn cameras_that_have_gone_are_noticed_and_those_that_never_came_are_not() {
        let without = || Reading {
            publishers: 0,
            ..reading()
        };
        let mut rehearsals = rehearsals();
        // A bag may have been played before this was started.
        rehearsals.on_heightmap(Duration::ZERO, &table(), 0, &AtHome::default());
        assert!(!rehearsals.robot(without()).unseen);
        rehearsals.on_heightmap(Duration::ZERO, &table(), 1, &AtHome::default());
        assert!(!rehearsals.robot(reading()).unseen);
        assert!(rehearsals.robot(without()).unseen);
    }
}
