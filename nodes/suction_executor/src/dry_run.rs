//! A dry run of a motion: it is planned to the end and checked for collisions, and nothing moves.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use collision::{
    Carried, CollisionChecker, Situation, lift_out, rehearse, rehearse_home, rehearse_put_down,
};
use heightmap::{ChangeRules, Heightmap, largest_change};
use msgs::convert::{self, ConvertError};
use msgs::std_msgs::Header;
use msgs::{sctn_msgs, trajectory_msgs};
use nalgebra::{Isometry2, Point2};
use pick_place::{PickPlace, PrimitiveSettings, PutDown, Robot, go_home, put_down};
use step_protocol::{
    AT_REST_RAD, CannotBegin, JointPositions, Proposal, ProposalId, Recovery, RobotState,
};
use ur_driver::ContactSign;
use ur_driver::status::DriverStatus;
use ur5::{Arm, JointTrajectory, Joints, TrajectoryPoint};

use crate::parameters::Contact;
use crate::surface::{top_m, touchdown};

/// The way home is slow, because something may be held or in the way, and begins with a rise as high as the arm can.
pub(crate) const HOME_SETTINGS: PrimitiveSettings = PrimitiveSettings {
    travel_m_s: 0.25,
    descend_m_s: 0.1,
    acceleration_m_s2: 0.5,
    ..PrimitiveSettings::RIGID
};

/// Where an object is put down the tip slows down so far above (m).
const SLOW_FROM_M: f64 = 0.03;

/// Where the last motion has picked, and what was seen before.
#[derive(Clone, Debug)]
pub(crate) struct Picked {
    /// Pose of the tip in the world's xy-plane.
    pub tip: Isometry2<f64>,
    /// The newest heightmap when the motion began.
    pub seen: Arc<Heightmap>,
}

/// A robot that is always where it was sent, and whose tool finds the table.
struct DryRun {
    joints: Joints,
    holds: bool,
    motion: PlannedPrimitive,
}

/// The whole motion of a proposal, from where the arm stands until it is home.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct PlannedPrimitive {
    /// Times are from the beginning and increase.
    points: Vec<TrajectoryPoint>,
    /// When suction is switched on, and when off.
    suction: [Duration; 2],
}

impl PlannedPrimitive {
    fn end(&self) -> Duration {
        self.points
            .last()
            .map_or(Duration::ZERO, |point| point.time)
    }

    fn append(&mut self, trajectory: &JointTrajectory) {
        let start = self.end();
        for point in trajectory.points() {
            let time = start + point.time;
            if self.points.is_empty() || time > self.end() {
                self.points.push(TrajectoryPoint { time, ..*point });
            }
        }
    }
}

/// The message that shows a proposal's motion, or why there is none.
pub(crate) fn planned_motion(
    planned: Result<PlannedPrimitive, String>,
    proposal_id: u64,
    joint_names: &[String; 6],
    header: Header,
) -> Result<sctn_msgs::PlannedMotion, ConvertError> {
    let (motion, reason) = match planned {
        Ok(motion) => (motion, String::new()),
        Err(reason) => (PlannedPrimitive::default(), reason),
    };
    let point = |point: &TrajectoryPoint| {
        Ok::<_, ConvertError>(trajectory_msgs::JointTrajectoryPoint {
            positions: point.positions_rad.iter().copied().collect(),
            velocities: point.velocities_rad_s.iter().copied().collect(),
            time_from_start: convert::duration_to_msg(point.time)?,
            ..Default::default()
        })
    };
    let [on, off] = motion.suction;
    Ok(sctn_msgs::PlannedMotion {
        trajectory: trajectory_msgs::JointTrajectory {
            header: header.clone(),
            joint_names: joint_names.to_vec(),
            points: motion.points.iter().map(point).collect::<Result<_, _>>()?,
        },
        header,
        proposal_id,
        suction_on: convert::duration_to_msg(on)?,
        suction_off: convert::duration_to_msg(off)?,
        reason,
    })
}

impl Robot for DryRun {
    type Error = Infallible;

    fn joints(&mut self) -> Result<Joints, Infallible> {
        Ok(self.joints)
    }

    fn follow(&mut self, trajectory: &JointTrajectory) -> Result<bool, Infallible> {
        self.joints = trajectory.last().positions_rad;
        self.motion.append(trajectory);
        Ok(true)
    }

    fn follow_until_contact(&mut self, trajectory: &JointTrajectory) -> Result<bool, Infallible> {
        self.follow(trajectory)
    }

    fn set_suction(&mut self, on: bool) -> Result<(), Infallible> {
        self.holds = on;
        self.motion.suction[usize::from(!on)] = self.motion.end();
        Ok(())
    }

    fn holds(&mut self) -> Result<bool, Infallible> {
        Ok(self.holds)
    }
}

/// What is rehearsed.
#[derive(Clone, Debug)]
pub(crate) enum Subject {
    Proposal(Box<Proposal>),
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
pub(crate) struct Rehearsed {
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
        planned.map_err(|reason| CannotBegin::Refused(reason.clone()))?;
        Ok(())
    }
}

/// What the gate asks about: the robot as its driver last said it was.
#[derive(Clone)]
pub(crate) struct RobotNow {
    pub arm: Arm,
    pub status: DriverStatus,
    /// Monotonic, as the arrivals in `status`.
    pub now: Duration,
    /// The driver's streams may not be older.
    pub max_age: Duration,
    /// Why nothing may begin to move, where an operator has to be present and none is.
    pub unattended: Option<String>,
    /// What the driver was found to lack.
    pub refused: Option<String>,
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
    pub contact: Contact,
    pub sign: ContactSign,
    pub checker: Arc<CollisionChecker>,
    /// The newest heightmap that is sure not to show the arm.
    pub without_arm: Option<Arc<Heightmap>>,
    /// What the gripper holds, where it holds something.
    pub picked: Option<Picked>,
    /// What counts as a change of the view.
    pub changes: ChangeRules,
    /// The proposal that was rehearsed last.
    pub rehearsed: Option<Arc<Rehearsed>>,
    /// The way home, or the putting down, that was rehearsed last.
    pub rehearsed_recovery: Option<Arc<Rehearsed>>,
}

impl RobotState for RobotNow {
    fn obstacle(&self) -> Option<String> {
        let unattended = self.unattended.clone();
        unattended
            .or_else(|| self.status.obstacle(self.now, self.max_age))
            .or_else(|| self.refused.clone())
    }

    fn check_motion(&self, proposal: &Proposal) -> Result<(), CannotBegin> {
        self.check_view(proposal).map_err(CannotBegin::Refused)?;
        let rehearsed = self.rehearsal_of(proposal.id);
        rehearsed.ok_or(CannotBegin::NotRehearsed)?.verdict()
    }

    fn check_recovery(&self, recovery: Recovery) -> Result<JointPositions, CannotBegin> {
        let rehearsed = self.rehearsal_of_recovery(recovery);
        rehearsed.ok_or(CannotBegin::NotRehearsed)?.verdict()?;
        self.joints_rad().map_err(CannotBegin::Refused)
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
        let in_view = |stamp| self.status.at_home.may_be_in_view(stamp);
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
        let (joints, pins) = (self.status.joints.as_ref()?, self.status.pins.as_ref()?);
        let (view, picked) = match subject {
            Subject::Proposal(_) => (Some(Arc::clone(&self.seen.as_ref()?.0)), None),
            Subject::Recovery(_) => (self.without_arm.clone(), self.picked.clone()),
        };
        Some(Basis {
            joints_rad: joints.value.positions_rad,
            holds: pins.value.vacuum,
            view,
            picked,
        })
    }

    fn joints_rad(&self) -> Result<JointPositions, String> {
        let joints = self.status.joints.as_ref();
        let joints = joints.ok_or("the robot's state is not known")?;
        Ok(joints.value.positions_rad)
    }

    /// How what is held is put down where it was picked, and the way home after that, checked like the way home alone.
    fn dry_run_put_down(&self) -> Result<PlannedPrimitive, String> {
        let what = self.put_down()?;
        let joints = self.joints_rad()?;
        let lifted = self.lifted_out(true);
        let (carried, heightmap) = lifted.ok_or("what is held lay outside the heightmap")?;
        let mut robot = DryRun {
            joints,
            holds: true,
            motion: PlannedPrimitive::default(),
        };
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
        Ok(robot.motion)
    }

    /// Where what is held was picked.
    pub fn put_down(&self) -> Result<PutDown, String> {
        let pins = self.status.pins.as_ref();
        if !pins.is_some_and(|pins| pins.value.vacuum) {
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
        let (Some(joints), Some(pins)) = (&self.status.joints, &self.status.pins) else {
            return Err("the robot's state is not known".into());
        };
        let joints = joints.value.positions_rad;
        let mut robot = DryRun {
            joints,
            holds: pins.value.vacuum,
            motion: PlannedPrimitive::default(),
        };
        let (arm, settings) = (&self.arm, &HOME_SETTINGS);
        go_home(&mut robot, arm, settings).map_err(|error| error.to_string())?;
        let lifted = self.lifted_out(pins.value.vacuum);
        let (carried, heightmap) = match &lifted {
            Some((carried, rest)) => (Some(*carried), Some(rest)),
            None => (None, self.without_arm.as_deref()),
        };
        rehearse_home(&self.checker, arm, settings, &joints, carried, heightmap)
            .map_err(|error| format!("the way home: {error}"))?;
        Ok(robot.motion)
    }

    /// What the gripper holds, and the heightmap without it; nothing where it holds nothing, or nobody saw it.
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
        let (Some(joints), Some((heightmap, _))) = (&self.status.joints, &self.seen) else {
            return Ok(planned);
        };
        let Proposal {
            action, settings, ..
        } = proposal;
        let touchdown = touchdown(heightmap, action, &self.contact, self.sign)?;
        let situation = Situation {
            joints: &joints.value.positions_rad,
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
        let (Some(joints), Some(pins)) = (&self.status.joints, &self.status.pins) else {
            return Err("the robot's state is not known".into());
        };
        let mut robot = DryRun {
            joints: joints.value.positions_rad,
            holds: pins.value.vacuum,
            motion: PlannedPrimitive::default(),
        };
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
        Ok(robot.motion)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use msgs::convert::JointReading;
    use nalgebra::{Isometry2, Vector2};
    use pick_place::{PickPlace, PrimitiveSettings};
    use step_protocol::ProposalId;
    use ur_driver::status::{Newest, Pins};
    use ur5::WorkCell;

    /// A driver that is ready.
    fn ready() -> DriverStatus {
        let reading = JointReading {
            stamp: Duration::from_secs(5),
            positions_rad: Joints::zeros(),
            velocities_rad_s: Joints::zeros(),
        };
        DriverStatus {
            // RUNNING and NORMAL.
            robot_mode: Some(7),
            safety_mode: Some(1),
            program_running: Some(true),
            joints: Some(Newest {
                value: reading,
                at: Duration::ZERO,
                count: 1,
            }),
            pins: Some(Newest {
                value: Pins::default(),
                at: Duration::ZERO,
                count: 1,
            }),
            ..DriverStatus::default()
        }
    }

    fn proposal(x_m: f64) -> Proposal {
        let pose = |y_m| Isometry2::new(Vector2::new(x_m, y_m), 0.0);
        Proposal {
            id: ProposalId(1),
            frame: "world".into(),
            stamp: Duration::ZERO,
            problem: "placing".into(),
            step: 1,
            attempt: 0,
            module: "placing".into(),
            action: PickPlace {
                pick: pose(0.1),
                place: pose(-0.1),
            },
            settings: PrimitiveSettings::RIGID,
            pick_score: 1.0,
            place_score: 1.0,
            success_probability: None,
            checkpoint: String::new(),
            author: "test".into(),
        }
    }

    fn text(cannot: CannotBegin) -> String {
        match cannot {
            CannotBegin::Refused(reason) => reason,
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
        let mut status = ready();
        status.joints.as_mut().unwrap().value.positions_rad = arm.home;
        let mut robot = RobotNow {
            arm,
            status,
            now: Duration::ZERO,
            max_age: Duration::from_secs(1),
            unattended: None,
            refused: None,
            unseen: false,
            needs_home: false,
            time: Duration::ZERO,
            seen: Some((
                Arc::new(Heightmap::new(heightmap::Workspace::RAVENS)),
                Duration::ZERO,
            )),
            observation_max_age: Duration::from_secs(10),
            contact: Contact::default(),
            sign: ContactSign::UntilAction,
            checker: checker(),
            without_arm: None,
            picked: None,
            changes: ChangeRules::default(),
            rehearsed: None,
            rehearsed_recovery: None,
        };
        assert_eq!(robot.obstacle(), None);
        planned(&robot, &proposal(0.5)).unwrap();
        let motion = robot.dry_run(&proposal(0.5)).unwrap();
        let names: [String; 6] = std::array::from_fn(|joint| format!("joint {joint}"));
        let message = planned_motion(Ok(motion), 7, &names, Header::default()).unwrap();
        assert_eq!((message.proposal_id, message.reason.as_str()), (7, ""));
        let points = &message.trajectory.points;
        assert!(points.len() > 100, "{}", points.len());
        let time =
            |stamp: &msgs::builtin_interfaces::Duration| convert::duration_from_msg(stamp).unwrap();
        let times: Vec<_> = points
            .iter()
            .map(|point| time(&point.time_from_start))
            .collect();
        assert!(times.is_sorted_by(|a, b| a < b));
        let [on, off] = [&message.suction_on, &message.suction_off].map(time);
        assert!(Duration::ZERO < on && on < off && off < times[times.len() - 1]);
        // From home to home, without a jump.
        let home: Vec<f64> = robot.arm.home.iter().copied().collect();
        assert_eq!(points[0].positions, home);
        for (a, b) in points[points.len() - 1].positions.iter().zip(&home) {
            assert!((a - b).abs() < 1e-6, "{a} {b}");
        }
        for pair in points.windows(2) {
            let steps = pair[0].positions.iter().zip(&pair[1].positions);
            assert!(steps.into_iter().all(|(a, b)| (a - b).abs() < 0.2));
        }
        let refused = robot.dry_run(&proposal(2.0));
        let message = planned_motion(refused, 8, &names, Header::default()).unwrap();
        assert!(message.trajectory.points.is_empty() && message.reason.contains("pick"));
        let reason = planned(&robot, &proposal(2.0)).unwrap_err();
        assert!(
            reason.contains("pick") && !reason.contains('\n'),
            "{reason}"
        );
        let holding = Pins {
            suction: true,
            vacuum: true,
            ..Pins::default()
        };
        robot.status.pins = Some(Newest {
            value: holding,
            at: Duration::ZERO,
            count: 1,
        });
        let reason = planned(&robot, &proposal(0.5)).unwrap_err();
        assert!(reason.contains("already holds"), "{reason}");
        robot.status.pins.as_mut().unwrap().value.vacuum = false;
        planned(&robot, &proposal(0.5)).unwrap();
        robot.unseen = true;
        let reason = planned(&robot, &proposal(0.5)).unwrap_err();
        assert!(reason.contains("nobody publishes heightmaps"), "{reason}");
        robot.unseen = false;
        robot.time = Duration::from_secs(11);
        let reason = planned(&robot, &proposal(0.5)).unwrap_err();
        assert!(reason.contains("11.0 s old"), "{reason}");
        robot.now = Duration::from_secs(11);
        assert!(robot.obstacle().unwrap().contains("joint_states"));
        robot.now = Duration::ZERO;
        robot.time = Duration::ZERO;
        robot.needs_home = true;
        let read = |robot: &mut RobotNow, stamp_s, offset_rad| {
            let home = robot.arm.home;
            let joints = home.add_scalar(offset_rad);
            let stamp = Duration::from_secs(stamp_s);
            let status = &mut robot.status;
            status.at_home.read(stamp, &joints, &Joints::zeros(), &home);
        };
        let in_view = |robot: &RobotNow, stamp_s| {
            let proposal = Proposal {
                stamp: Duration::from_secs(stamp_s),
                ..proposal(0.5)
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
        let reason = planned(&robot, &proposal(0.5)).unwrap_err();
        assert!(reason.contains("no heightmap"), "{reason}");
        robot.refused = Some("controller `x` is inactive".into());
        assert!(robot.obstacle().unwrap().contains("inactive"));
    }

    fn checker() -> Arc<CollisionChecker> {
        let cell = WorkCell::builtin().unwrap();
        Arc::new(CollisionChecker::new(&cell, collision::Margins::default()).unwrap())
    }

    /// A robot whose tip stands over (0.5, y) at a height.
    fn robot_at(y_m: f64, height_m: f64) -> RobotNow {
        let arm = WorkCell::builtin().unwrap().arm;
        let over = Isometry2::new(Vector2::new(0.5, y_m), 0.0);
        let mut status = ready();
        let joints = arm.solve(&Arm::tip_down(&over, height_m), &arm.ready);
        status.joints.as_mut().unwrap().value.positions_rad = joints.unwrap();
        RobotNow {
            arm,
            status,
            now: Duration::ZERO,
            max_age: Duration::from_secs(1),
            unattended: None,
            refused: None,
            unseen: false,
            needs_home: false,
            time: Duration::ZERO,
            seen: None,
            observation_max_age: Duration::from_secs(10),
            contact: Contact::default(),
            sign: ContactSign::UntilAction,
            checker: checker(),
            without_arm: None,
            picked: None,
            changes: ChangeRules::default(),
            rehearsed: None,
            rehearsed_recovery: None,
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
        let last = motion.points.last().unwrap().positions_rad;
        assert!((last - robot.arm.home).amax() < 1e-6);
        let from_rad = recovery(&robot, Recovery::Home).unwrap();
        assert_eq!(from_rad, motion.points[0].positions_rad);
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
        robot.picked = Some(Picked { tip, seen });
        robot.status.pins.as_mut().unwrap().value.vacuum = true;
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
        robot.status.pins.as_mut().unwrap().value.vacuum = true;
        let reason = recovery(&robot, Recovery::PutDown).unwrap_err();
        assert!(reason.contains("nobody saw"), "{reason}");
        robot.picked = Some(Picked { tip, seen });
        let motion = robot.dry_run_put_down().unwrap();
        assert!((robot.put_down().unwrap().contact_m - 0.04).abs() < 1e-6);
        // Suction is switched off where the cup was at the pick, and the arm ends at home.
        let release = motion.suction[1];
        let at = motion.points.iter().find(|point| point.time == release);
        let tip_at = robot.arm.tip(&at.unwrap().positions_rad);
        let expected = Arm::tip_down(&tip, 0.04 - robot.contact.window_m);
        assert!((tip_at.translation.vector - expected.translation.vector).norm() < 1e-4);
        assert!(tip_at.rotation.angle_to(&expected.rotation) < 1e-4);
        let last = motion.points.last().unwrap().positions_rad;
        assert!((last - robot.arm.home).amax() < 1e-6);
        // From behind the wall.
        let behind = robot_at(-0.35, 0.2);
        let refused = RobotNow {
            status: DriverStatus {
                pins: robot.status.pins,
                ..behind.status.clone()
            },
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
    fn a_rehearsal_holds_while_the_arm_stands_there_and_the_view_is_unchanged() {
        let mut robot = robot_at(0.35, 0.2);
        let proposal = proposal(0.5);
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
        robot.status.joints.as_mut().unwrap().value.positions_rad[2] += 0.01;
        assert!(is_due(&robot));
        robot.status.joints.as_mut().unwrap().value.positions_rad[2] -= 0.01;
        robot.status.pins.as_mut().unwrap().value.vacuum = true;
        assert!(is_due(&robot));
        // Of another proposal.
        robot.status.pins.as_mut().unwrap().value.vacuum = false;
        let other = Proposal {
            id: ProposalId(2),
            ..proposal.clone()
        };
        assert_eq!(robot.check_motion(&other), Err(CannotBegin::NotRehearsed));
    }
}
