//! The robot as the gate sees it, and what was rehearsed for it.

use std::sync::Arc;
use std::time::Duration;

use collision::{
    Carried, CollisionChecker, Situation, lift_out, rehearse, rehearse_home, rehearse_put_down,
};
use heightmap::{ChangeRules, Heightmap, largest_change};
use nalgebra::{Isometry2, Point2};
use pick_place::{
    ContactSettings, ContactSign, PickPlace, PrimitiveSettings, PutDown, go_home, put_down,
};
use step_protocol::{
    AT_REST_RAD, CannotBegin, JointPositions, Obstacle, Proposal, ProposalId, Recovery, RobotState,
};
use ur5::{Arm, AtHome, Joints};

use crate::planned::{DryRun, PlannedPrimitive};
use crate::surface::{top_m, touchdown};

/// The way home is slow, because something may be held or in the way, and begins with a rise as high as the arm can.
pub const HOME_SETTINGS: PrimitiveSettings = PrimitiveSettings {
    travel_m_s: 0.25,
    descend_m_s: 0.1,
    acceleration_m_s2: 0.5,
    ..PrimitiveSettings::RIGID
};

const UNKNOWN: &str = "the robot's state is not known";

/// Where an object is put down the tip slows down so far above (m).
const SLOW_FROM_M: f64 = 0.03;

/// Where the last motion has picked, and what was seen before.
#[derive(Clone, Debug)]
pub struct Picked {
    /// Pose of the tip in the world's xy-plane.
    pub tip: Isometry2<f64>,
    /// The newest heightmap from before the arm left home for it.
    pub seen: Arc<Heightmap>,
    /// Where the arm was when the motion began.
    pub at_home: AtHome,
}

/// What is rehearsed.
#[derive(Clone, Debug)]
pub enum Subject {
    /// A proposal.
    Proposal(Box<Proposal>),
    /// What brings the arm home.
    Recovery(Recovery),
}

/// From where a motion was rehearsed, and on what.
#[derive(Clone, Debug)]
struct Basis {
    joints_rad: Joints,
    holds: bool,
    /// What stood on the table; where nothing was seen yet, it counted as empty.
    view: Option<Arc<Heightmap>>,
    /// What is held, for recoveries.
    picked: Option<Picked>,
}

/// A motion that was rehearsed.
#[derive(Clone, Debug)]
pub struct Rehearsed {
    /// Of what.
    pub subject: Subject,
    /// The motion, or why it cannot be carried out.
    pub planned: Result<PlannedPrimitive, String>,
    /// None where the robot's state, or the view that a proposal needs, was not known.
    basis: Option<Basis>,
}

impl Subject {
    /// Where the tool meets the table.
    fn contacts(&self, picked: Option<&Picked>) -> Vec<Point2<f64>> {
        match self {
            Self::Proposal(proposal) => {
                let PickPlace { pick, place } = &proposal.action;
                vec![
                    pick.translation.vector.into(),
                    place.translation.vector.into(),
                ]
            }
            Self::Recovery(_) => {
                let picked = picked.map(|picked| picked.tip.translation.vector.into());
                picked.into_iter().collect()
            }
        }
    }
}

impl Rehearsed {
    /// Whether the arm stands where it stood, holds what it held, and nothing has changed in its view.
    fn is_valid(&self, now: &RobotNow) -> bool {
        let (then, now, changes) = (&self.basis, now.basis(&self.subject), &now.changes);
        let (Some(then), Some(now)) = (then, &now) else {
            return then.is_none() && now.is_none();
        };
        let is_unchanged = |then: &Arc<Heightmap>, now: &Arc<Heightmap>| {
            let around = self
                .subject
                .contacts(self.basis.as_ref().and_then(|basis| basis.picked.as_ref()));
            Arc::ptr_eq(then, now)
                || matches!(largest_change(then, now, changes, &around), Ok(None))
        };
        (then.joints_rad - now.joints_rad).amax() <= AT_REST_RAD
            && then.holds == now.holds
            && match (&then.picked, &now.picked) {
                (Some(then), Some(now)) => {
                    then.tip == now.tip && Arc::ptr_eq(&then.seen, &now.seen)
                }
                (then, now) => then.is_none() && now.is_none(),
            }
            && match (&then.view, &now.view) {
                (Some(then), Some(now)) => is_unchanged(then, now),
                (then, now) => then.is_none() && now.is_none(),
            }
    }

    /// Whether the robot's state and the view were known.
    pub fn was_seen(&self) -> bool {
        self.basis.is_some()
    }

    fn verdict(&self) -> Result<(), CannotBegin> {
        let planned = self.planned.as_ref();
        planned.map_err(|reason| CannotBegin::Refused(reason.clone().into()))?;
        Ok(())
    }
}

/// What the gate asks about: the robot as its driver last said it was, and what was seen.
#[derive(Clone)]
pub struct RobotNow {
    /// The arm.
    pub arm: Arm,
    /// Checks motions against cell and arm.
    pub checker: Arc<CollisionChecker>,
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
    /// The newest heightmap and its stamp.
    pub seen: Option<(Arc<Heightmap>, Duration)>,
    /// Whether nobody publishes heightmaps any more who did.
    pub unseen: bool,
    /// Whether the arm has to have been at home and at rest since the heightmaps were taken.
    pub needs_home: bool,
    /// An approval needs a heightmap that is not older.
    pub observation_max_age: Duration,
    /// What counts as a change of the view.
    pub changes: ChangeRules,
    /// How the tip comes down.
    pub contact: ContactSettings,
    /// What tells that the tool touches something.
    pub sign: ContactSign,
    /// The newest heightmap that is sure not to show the arm.
    pub without_arm: Option<Arc<Heightmap>>,
    /// What the gripper holds, where it holds something.
    pub picked: Option<Picked>,
    /// The proposal that was rehearsed last.
    pub rehearsed: Option<Arc<Rehearsed>>,
    /// The way home, or the putting down, that was rehearsed last.
    pub rehearsed_recovery: Option<Arc<Rehearsed>>,
}

impl RobotState for RobotNow {
    fn obstacle(&self) -> Option<Obstacle> {
        self.obstacle.clone().map(Obstacle::from)
    }

    fn check_motion(&self, proposal: &Proposal) -> Result<(), CannotBegin> {
        let refused = |reason: String| CannotBegin::Refused(reason.into());
        self.check_view(proposal).map_err(refused)?;
        let rehearsed = self.rehearsal_of(proposal.id);
        rehearsed.ok_or(CannotBegin::NotRehearsed)?.verdict()
    }

    fn check_recovery(&self, recovery: Recovery) -> Result<JointPositions, CannotBegin> {
        let rehearsed = self.rehearsal_of_recovery(recovery);
        rehearsed.ok_or(CannotBegin::NotRehearsed)?.verdict()?;
        let refused = |reason: String| CannotBegin::Refused(reason.into());
        self.known_joints().map_err(refused)
    }
}

impl RobotNow {
    /// Whether what was seen last is ground to move on.
    fn check_view(&self, proposal: &Proposal) -> Result<(), String> {
        let Some((_, stamp)) = &self.seen else {
            return Err("no heightmap has arrived".into());
        };
        if self.unseen {
            return Err("nobody publishes heightmaps any more: whether the cameras see what they saw is not known".into());
        }
        let in_view = |stamp| self.at_home.may_be_in_view(stamp);
        if self.needs_home && (in_view(proposal.stamp) || in_view(*stamp)) {
            return Err("the arm was not at home and at rest when the heightmap was taken, or has left home since: call it home first".into());
        }
        let age = self.time.saturating_sub(*stamp);
        if age > self.observation_max_age {
            return Err(format!(
                "the newest heightmap is {:.1} s old, expected at most {:.1} s (observation_max_age_s)",
                age.as_secs_f64(),
                self.observation_max_age.as_secs_f64()
            ));
        }
        Ok(())
    }

    /// The rehearsal of a proposal, where it is valid still.
    pub fn rehearsal_of(&self, id: ProposalId) -> Option<&Rehearsed> {
        let rehearsed = self.rehearsed.as_deref()?;
        let is_same = matches!(&rehearsed.subject, Subject::Proposal(known) if known.id == id);
        (is_same && rehearsed.is_valid(self)).then_some(rehearsed)
    }

    /// The rehearsal of a recovery, where it is valid still.
    pub fn rehearsal_of_recovery(&self, recovery: Recovery) -> Option<&Rehearsed> {
        let rehearsed = self.rehearsed_recovery.as_deref()?;
        let is_same = matches!(rehearsed.subject, Subject::Recovery(known) if known == recovery);
        (is_same && rehearsed.is_valid(self)).then_some(rehearsed)
    }

    /// Plans a motion to its end and checks all of it. This takes some tenths of a second.
    pub fn rehearse(&self, subject: Subject) -> Rehearsed {
        let planned = match &subject {
            Subject::Proposal(proposal) => self.planned(proposal),
            Subject::Recovery(Recovery::Home) => self.dry_run_home(),
            Subject::Recovery(Recovery::PutDown) => self.dry_run_put_down(),
        };
        Rehearsed {
            planned,
            basis: self.basis(&subject),
            subject,
        }
    }

    fn basis(&self, subject: &Subject) -> Option<Basis> {
        let (view, picked) = match subject {
            Subject::Proposal(_) => (Some(Arc::clone(&self.seen.as_ref()?.0)), None),
            Subject::Recovery(_) => (self.without_arm.clone(), self.picked.clone()),
        };
        Some(Basis {
            joints_rad: self.joints_rad?,
            holds: self.holds?,
            view,
            picked,
        })
    }

    fn known_joints(&self) -> Result<JointPositions, String> {
        self.joints_rad.ok_or_else(|| UNKNOWN.to_owned())
    }

    /// Where the joints are (rad), and whether something is held.
    fn known(&self) -> Result<(Joints, bool), String> {
        self.joints_rad
            .zip(self.holds)
            .ok_or_else(|| UNKNOWN.to_owned())
    }

    /// How what is held is put down where it was picked, and the way home after that, checked like the way home alone.
    fn dry_run_put_down(&self) -> Result<PlannedPrimitive, String> {
        let what = self.put_down()?;
        let joints = self.known_joints()?;
        let lifted = self.lifted_out(true);
        let (carried, heightmap) = lifted.ok_or("what is held lay outside the heightmap")?;
        let mut robot = DryRun::new(joints, true);
        let (arm, settings) = (&self.arm, &HOME_SETTINGS);
        put_down(&mut robot, arm, &what, settings).map_err(|error| error.to_string())?;
        rehearse_put_down(
            &self.checker,
            arm,
            (&what, settings),
            &joints,
            carried,
            &heightmap,
        )
        .map_err(|error| format!("putting down: {error}"))?;
        Ok(robot.motion())
    }

    /// Where what is held was picked.
    ///
    /// # Errors
    /// Nothing is held, or nobody saw where it was picked.
    pub fn put_down(&self) -> Result<PutDown, String> {
        if self.holds != Some(true) {
            return Err("the gripper holds nothing: there is nothing to put down".into());
        }
        let unseen = "nobody saw where what is held was picked: call the arm home, and take the part away by hand";
        let picked = self.picked.as_ref().ok_or(unseen)?;
        let at = Point2::from(picked.tip.translation.vector);
        Ok(PutDown {
            at: picked.tip,
            contact_m: top_m(&picked.seen, &at).ok_or(unseen)?,
            slow_from_m: self.contact.slow_from_m.max(SLOW_FROM_M),
            slow_m_s: self.contact.slow_m_s,
            window_m: self.contact.window_m,
            // What is held closes the cup: its vacuum does not tell of contact.
            senses: self.sign == ContactSign::UntilAction,
        })
    }

    /// The way home from where the robot is, checked against the cell and against what stood on the table when the arm was last out of view;
    /// else why it cannot be planned, or what it would hit.
    fn dry_run_home(&self) -> Result<PlannedPrimitive, String> {
        let (joints, holds) = self.known()?;
        let mut robot = DryRun::new(joints, holds);
        let (arm, settings) = (&self.arm, &HOME_SETTINGS);
        go_home(&mut robot, arm, settings).map_err(|error| error.to_string())?;
        let lifted = self.lifted_out(holds);
        let (carried, heightmap) = match &lifted {
            Some((carried, rest)) => (Some(*carried), Some(rest)),
            None => (None, self.without_arm.as_deref()),
        };
        rehearse_home(&self.checker, arm, settings, &joints, carried, heightmap)
            .map_err(|error| format!("the way home: {error}"))?;
        Ok(robot.motion())
    }

    /// What the gripper holds, and the heightmap without it; `None` where it holds nothing, or nobody saw it.
    fn lifted_out(&self, holds: bool) -> Option<(Carried, Heightmap)> {
        let picked = self.picked.as_ref().filter(|_| holds)?;
        let top_m = top_m(&picked.seen, &Point2::from(picked.tip.translation.vector))?;
        let (carried, rest) = lift_out(&picked.seen, &Arm::tip_down(&picked.tip, top_m))?;
        match &self.without_arm {
            // Seen since, with what is held out of view.
            Some(newer) if !Arc::ptr_eq(newer, &picked.seen) => {
                Some((carried, newer.as_ref().clone()))
            }
            _ => Some((carried, rest)),
        }
    }

    /// The motion of a proposal from where the robot is, each part of it checked against the cell and against what the newest heightmap shows; else why
    /// it cannot be planned, or what it would hit.
    fn planned(&self, proposal: &Proposal) -> Result<PlannedPrimitive, String> {
        let planned = self.dry_run(proposal)?;
        let (Some(joints), Some((heightmap, _))) = (&self.joints_rad, &self.seen) else {
            return Ok(planned);
        };
        let Proposal {
            action, settings, ..
        } = proposal;
        let touchdown = touchdown(heightmap, action, &self.contact, self.sign)?;
        let situation = Situation {
            joints,
            holds: false,
            heightmap: Some(heightmap),
            touchdown: touchdown.as_ref(),
        };
        rehearse(&self.checker, &self.arm, action, settings, &situation)
            .map_err(|error| error.to_string())?;
        Ok(planned)
    }

    /// The motion of a proposal from where the robot is; else why it cannot be planned.
    fn dry_run(&self, proposal: &Proposal) -> Result<PlannedPrimitive, String> {
        let (joints, holds) = self.known()?;
        let mut robot = DryRun::new(joints, holds);
        let Proposal {
            action, settings, ..
        } = proposal;
        let Some((heightmap, _)) = &self.seen else {
            return Err("no heightmap has arrived".into());
        };
        let touchdown = touchdown(heightmap, action, &self.contact, self.sign)?;
        pick_place::execute_on(
            &mut robot,
            &self.arm,
            action,
            settings,
            touchdown.as_ref(),
            |_| (),
        )
        .map_err(|error| error.to_string())?;
        Ok(robot.motion())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixtures::{proposal_at, reading, rehearsals};
    use nalgebra::Vector2;
    use ur5::WorkCell;

    fn text(cannot: CannotBegin) -> String {
        match cannot {
            CannotBegin::Refused(obstacle) => obstacle.into(),
            CannotBegin::NotRehearsed => "not rehearsed".to_owned(),
        }
    }

    /// What the gate hears of a proposal once it was rehearsed.
    fn planned(robot: &RobotNow, proposal: &Proposal) -> Result<(), String> {
        let subject = Subject::Proposal(Box::new(proposal.clone()));
        let robot = RobotNow {
            rehearsed: Some(Arc::new(robot.rehearse(subject))),
            ..robot.clone()
        };
        robot.check_motion(proposal).map_err(text)
    }

    /// The same of a recovery.
    fn recovery(robot: &RobotNow, recovery: Recovery) -> Result<JointPositions, String> {
        let robot = RobotNow {
            rehearsed_recovery: Some(Arc::new(robot.rehearse(Subject::Recovery(recovery)))),
            ..robot.clone()
        };
        robot.check_recovery(recovery).map_err(text)
    }

    #[test]
    fn only_what_can_be_planned_to_its_end_may_begin() {
        let arm = WorkCell::builtin().unwrap().arm;
        let mut robot = RobotNow {
            joints_rad: Some(arm.home),
            seen: Some((
                Arc::new(Heightmap::new(heightmap::Workspace::RAVENS)),
                Duration::ZERO,
            )),
            ..robot_at(0.0, 0.3)
        };
        assert_eq!(RobotState::obstacle(&robot), None);
        planned(&robot, &proposal_at(0.5)).unwrap();
        let motion = robot.dry_run(&proposal_at(0.5)).unwrap();
        let points = motion.points();
        assert!(points.len() > 100, "{}", points.len());
        assert!(points.is_sorted_by(|a, b| a.time < b.time));
        let [on, off] = motion.suction();
        assert!(Duration::ZERO < on && on < off && off < points[points.len() - 1].time);
        // From home to home, without a jump.
        let home = robot.arm.home;
        assert_eq!(points[0].positions_rad, home);
        let last = points[points.len() - 1].positions_rad;
        assert!((last - home).amax() < 1e-6);
        for pair in points.windows(2) {
            assert!((pair[0].positions_rad - pair[1].positions_rad).amax() < 0.2);
        }
        let reason = planned(&robot, &proposal_at(2.0)).unwrap_err();
        assert!(
            reason.contains("pick") && !reason.contains('\n'),
            "{reason}"
        );
        robot.holds = Some(true);
        let reason = planned(&robot, &proposal_at(0.5)).unwrap_err();
        assert!(reason.contains("already holds"), "{reason}");
        robot.holds = Some(false);
        planned(&robot, &proposal_at(0.5)).unwrap();
        robot.unseen = true;
        let reason = planned(&robot, &proposal_at(0.5)).unwrap_err();
        assert!(reason.contains("nobody publishes heightmaps"), "{reason}");
        robot.unseen = false;
        robot.time = Duration::from_secs(11);
        let reason = planned(&robot, &proposal_at(0.5)).unwrap_err();
        assert!(reason.contains("11.0 s old"), "{reason}");
        robot.time = Duration::ZERO;
        robot.needs_home = true;
        let read = |robot: &mut RobotNow, stamp_s, offset_rad| {
            let home = robot.arm.home;
            let joints = home.add_scalar(offset_rad);
            let stamp = Duration::from_secs(stamp_s);
            let at_home = &mut robot.at_home;
            at_home.read(stamp, &joints, &Joints::zeros(), &home);
        };
        let in_view = |robot: &RobotNow, stamp_s| {
            let proposal = Proposal {
                stamp: Duration::from_secs(stamp_s),
                ..proposal_at(0.5)
            };
            let planned = planned(robot, &proposal);
            planned.is_err_and(|reason| reason.contains("call it home"))
        };
        // Nothing is known; at rest elsewhere; at home since 3 s.
        assert!(in_view(&robot, 2));
        read(&mut robot, 1, 0.3);
        assert!(in_view(&robot, 2));
        read(&mut robot, 3, 0.0);
        let heightmap = robot.seen.clone().unwrap().0;
        robot.seen = Some((Arc::clone(&heightmap), Duration::from_secs(4)));
        assert!(in_view(&robot, 2));
        assert!(!in_view(&robot, 3));
        robot.seen = Some((heightmap, Duration::from_secs(2)));
        assert!(in_view(&robot, 3));
        robot.seen = None;
        let reason = planned(&robot, &proposal_at(0.5)).unwrap_err();
        assert!(reason.contains("no heightmap"), "{reason}");
        robot.obstacle = Some("controller `x` is inactive".into());
        let obstacle = RobotState::obstacle(&robot).map(String::from);
        assert_eq!(obstacle, robot.obstacle);
    }

    /// A robot whose tip stands over (0.5, y) at a height.
    fn robot_at(y_m: f64, height_m: f64) -> RobotNow {
        let arm = WorkCell::builtin().unwrap().arm;
        let over = Isometry2::new(Vector2::new(0.5, y_m), 0.0);
        let joints = arm.solve(&Arm::tip_down(&over, height_m), &arm.ready);
        RobotNow {
            joints_rad: Some(joints.unwrap()),
            ..rehearsals().robot(reading())
        }
    }

    /// A table with a block of 40 mm, and 40 mm high, around (0.5, 0.1), and a wall of 0.5 m height at y = -0.2 m.
    fn table_with_a_wall() -> Arc<Heightmap> {
        let mut heightmap = Heightmap::new(heightmap::Workspace::RAVENS);
        heightmap.rgb.fill(90);
        let workspace = heightmap.workspace;
        for row in 0..workspace.rows {
            for col in 0..workspace.cols {
                let center = workspace.center(heightmap::Pixel { row, col });
                let height_m = &mut heightmap.height_m[row * workspace.cols + col];
                if (center.coords - Vector2::new(0.5, 0.1)).amax() < 0.02 {
                    *height_m = 0.04;
                } else if (center.y + 0.2).abs() < 0.01 {
                    *height_m = 0.5;
                }
            }
        }
        Arc::new(heightmap)
    }

    #[test]
    fn the_way_home_is_planned_from_the_table_too_and_names_what_it_would_hit() {
        let mut robot = robot_at(-0.35, 0.001);
        let motion = robot.dry_run_home().unwrap();
        let last = motion.points().last().unwrap().positions_rad;
        assert!((last - robot.arm.home).amax() < 1e-6);
        let from_rad = recovery(&robot, Recovery::Home).unwrap();
        assert_eq!(from_rad, motion.points()[0].positions_rad);
        // Home lies on the other side of a wall that the cameras saw.
        robot.without_arm = Some(table_with_a_wall());
        let reason = robot.dry_run_home().unwrap_err();
        assert!(
            reason.contains("the way home") && reason.contains("the heightmap at"),
            "{reason}"
        );
    }

    #[test]
    fn what_is_held_is_carried_home_and_not_hit_where_it_was_picked() {
        let mut robot = robot_at(0.1, 0.04);
        let seen = table_with_a_wall();
        robot.without_arm = Some(Arc::clone(&seen));
        robot.dry_run_home().unwrap();
        let tip = Isometry2::new(Vector2::new(0.5, 0.1), 0.0);
        robot.picked = Some(Picked {
            tip,
            seen,
            at_home: AtHome::default(),
        });
        robot.holds = Some(true);
        let (carried, rest) = robot.lifted_out(true).unwrap();
        assert!((0.02..0.05).contains(&carried.radius_m()), "{carried:?}");
        let index = |at: &Point2<f64>| {
            let pixel = rest.workspace.pixel(at).unwrap();
            pixel.row * rest.workspace.cols + pixel.col
        };
        assert_eq!(rest.height_m[index(&Point2::new(0.5, 0.1))], 0.0);
        robot.dry_run_home().unwrap();
        assert!(robot.lifted_out(false).is_none());
        // Once the arm was home, the cameras saw the table without it.
        let bare = Heightmap::new(heightmap::Workspace::RAVENS);
        robot.without_arm = Some(Arc::new(bare.clone()));
        let (same, rest) = robot.lifted_out(true).unwrap();
        assert_eq!((same, rest), (carried, bare));
    }

    #[test]
    fn what_is_held_is_put_down_where_it_was_picked_unless_something_stands_in_the_way() {
        // Stopped over the other end of the table, on this side of the wall.
        let mut robot = robot_at(0.35, 0.2);
        let seen = table_with_a_wall();
        let tip = Isometry2::new(Vector2::new(0.5, 0.1), 0.4);
        robot.without_arm = Some(Arc::clone(&seen));
        let reason = recovery(&robot, Recovery::PutDown).unwrap_err();
        assert!(reason.contains("holds nothing"), "{reason}");
        robot.holds = Some(true);
        let reason = recovery(&robot, Recovery::PutDown).unwrap_err();
        assert!(reason.contains("nobody saw"), "{reason}");
        robot.picked = Some(Picked {
            tip,
            seen,
            at_home: AtHome::default(),
        });
        let motion = robot.dry_run_put_down().unwrap();
        assert!((robot.put_down().unwrap().contact_m - 0.04).abs() < 1e-6);
        // Suction is switched off where the cup was at the pick, and the arm ends at home.
        let release = motion.suction()[1];
        let at = motion.points().iter().find(|point| point.time == release);
        let tip_at = robot.arm.tip(&at.unwrap().positions_rad);
        let expected = Arm::tip_down(&tip, 0.04 - robot.contact.window_m);
        assert!((tip_at.translation.vector - expected.translation.vector).norm() < 1e-4);
        assert!(tip_at.rotation.angle_to(&expected.rotation) < 1e-4);
        let last = motion.points().last().unwrap().positions_rad;
        assert!((last - robot.arm.home).amax() < 1e-6);
        // From behind the wall.
        let behind = robot_at(-0.35, 0.2);
        let refused = RobotNow {
            holds: robot.holds,
            without_arm: robot.without_arm.clone(),
            picked: robot.picked.clone(),
            ..behind
        };
        let reason = recovery(&refused, Recovery::PutDown).unwrap_err();
        assert!(
            reason.contains("putting down") && reason.contains("the heightmap at"),
            "{reason}"
        );
    }

    #[test]
    fn a_proposal_is_refused_where_only_the_way_home_after_a_failure_would_hit_something() {
        // Stopped over the place; the pick lies on the other side.
        let seen = Arc::new(Heightmap::new(heightmap::Workspace::RAVENS));
        let robot = RobotNow {
            seen: Some((seen, Duration::ZERO)),
            ..robot_at(0.25, 0.45)
        };
        let pose = |y_m| Isometry2::new(Vector2::new(0.5, y_m), 0.0);
        let proposal = Proposal {
            action: PickPlace {
                pick: pose(-0.25),
                place: pose(0.25),
            },
            settings: PrimitiveSettings {
                clearance_m: 0.05,
                lift_m: 0.45,
                ..PrimitiveSettings::RIGID
            },
            ..proposal_at(0.5)
        };
        planned(&robot, &proposal).unwrap();
        let arm = &robot.arm;
        let over_pick = Arm::tip_down(&proposal.action.pick, 0.05);
        let over_pick = arm.solve(&over_pick, &arm.ready).unwrap();
        // A ball hangs on the way home from the pick.
        let on_the_way = over_pick + 0.4 * (arm.home - over_pick);
        let ball_at = arm.tip(&on_the_way).translation;
        let ball = format!(
            "<link name=\"ball\"><collision><geometry><sphere radius=\"0.02\"/></geometry></collision></link>\
            <joint name=\"world-ball\" type=\"fixed\"><parent link=\"world\"/><child link=\"ball\"/>\
            <origin xyz=\"{} {} {}\" rpy=\"0 0 0\"/></joint></robot>",
            ball_at.x, ball_at.y, ball_at.z
        );
        let urdf = WorkCell::builtin().unwrap().urdf;
        let cell = WorkCell::parse(&urdf.replace("</robot>", &ball), "cell.urdf").unwrap();
        let checker = CollisionChecker::new(&cell, collision::Margins::default()).unwrap();
        let robot = RobotNow {
            checker: Arc::new(checker),
            ..robot
        };
        let reason = planned(&robot, &proposal).unwrap_err();
        assert!(
            reason.starts_with("if there is nothing to pick: Home") && reason.contains("ball"),
            "{reason}"
        );
    }

    #[test]
    fn a_rehearsal_holds_while_the_arm_stands_there_and_the_view_is_unchanged() {
        let mut robot = robot_at(0.35, 0.2);
        let proposal = proposal_at(0.5);
        let seen = table_with_a_wall();
        let is_due = |robot: &RobotNow| {
            let checked = robot.check_motion(&proposal);
            checked == Err(CannotBegin::NotRehearsed)
        };
        robot.seen = Some((Arc::clone(&seen), Duration::ZERO));
        assert!(is_due(&robot));
        let rehearsed = robot.rehearse(Subject::Proposal(Box::new(proposal.clone())));
        robot.rehearsed = Some(Arc::new(rehearsed));
        assert!(!is_due(&robot));
        // The next view shows the same, but for noise.
        let mut next = seen.as_ref().clone();
        next.height_m
            .iter_mut()
            .for_each(|height_m| *height_m += 0.001);
        robot.seen = Some((Arc::new(next.clone()), Duration::from_secs(1)));
        assert!(!is_due(&robot));
        // Something has been put there, far from pick and place.
        let at = next.workspace.pixel(&Point2::new(0.3, 0.4)).unwrap();
        for row in at.row..at.row + 8 {
            let start = row * next.workspace.cols + at.col;
            next.height_m[start..start + 8].fill(0.1);
        }
        robot.seen = Some((Arc::new(next), Duration::from_secs(1)));
        assert!(is_due(&robot));
        robot.seen = Some((seen, Duration::from_secs(1)));
        assert!(!is_due(&robot));
        robot.joints_rad.as_mut().unwrap()[2] += 0.01;
        assert!(is_due(&robot));
        robot.joints_rad.as_mut().unwrap()[2] -= 0.01;
        robot.holds = Some(true);
        assert!(is_due(&robot));
        // Of another proposal.
        robot.holds = Some(false);
        let other = Proposal {
            id: ProposalId(2),
            ..proposal.clone()
        };
        assert_eq!(robot.check_motion(&other), Err(CannotBegin::NotRehearsed));
    }
}
