//! A dry run of a proposal: its motion is planned to the end and nothing moves.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use collision::{Carried, CollisionChecker, lift_out, rehearse_home};
use heightmap::Heightmap;
use msgs::convert::{self, ConvertError};
use msgs::std_msgs::Header;
use msgs::{sctn_msgs, trajectory_msgs};
use nalgebra::{Isometry2, Point2};
use pick_place::{PrimitiveSettings, Robot, go_home};
use step_protocol::{JointPositions, Proposal, RobotState};
use ur_driver::ContactSign;
use ur_driver::status::DriverStatus;
use ur5::{Arm, JointTrajectory, Joints, TrajectoryPoint};

use crate::parameters::Contact;
use crate::surface::{top_m, touchdown};

/// The way home is slow, because something may be held or in the way, and begins with a rise as high as the arm can.
pub(crate) const HOME_SETTINGS: PrimitiveSettings = PrimitiveSettings {
    travel_m_s: 0.25,
    acceleration_m_s2: 0.5,
    ..PrimitiveSettings::RIGID
};

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

/// What the gate asks about: the robot as its driver last said it was.
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
    /// Whether the arm has to have been at home and at rest since the heightmaps were taken.
    pub needs_home: bool,
    /// An approval needs a heightmap that is not older.
    pub observation_max_age: Duration,
    pub contact: Contact,
    pub sign: ContactSign,
    pub checker: Arc<CollisionChecker>,
    /// The newest heightmap that is sure not to show the arm.
    pub without_arm: Option<Arc<Heightmap>>,
    /// Where the last motion has picked.
    pub picked: Option<Isometry2<f64>>,
}

impl RobotState for RobotNow {
    fn obstacle(&self) -> Option<String> {
        let unattended = self.unattended.clone();
        unattended
            .or_else(|| self.status.obstacle(self.now, self.max_age))
            .or_else(|| self.refused.clone())
    }

    /// Plans every motion of a proposal from where the robot is.
    fn plan(&self, proposal: &Proposal) -> Result<(), String> {
        let Some((_, stamp)) = &self.seen else {
            return Err("no heightmap has arrived".into());
        };
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
        self.dry_run(proposal).map(|_| ())
    }

    fn plan_home(&self) -> Result<JointPositions, String> {
        self.dry_run_home()?;
        let joints = self.status.joints.as_ref();
        let joints = joints.ok_or("the robot's state is not known")?;
        Ok(joints.value.positions_rad)
    }
}

impl RobotNow {
    /// The way home from where the robot is, checked against the cell and against what stood on the table when the arm was last out of view;
    /// else why it cannot be planned, or what it would hit.
    pub fn dry_run_home(&self) -> Result<PlannedPrimitive, String> {
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
        let (heightmap, pick) = (self.without_arm.as_ref()?, self.picked.filter(|_| holds)?);
        let top_m = top_m(heightmap, &Point2::from(pick.translation.vector))?;
        lift_out(heightmap, &Arm::tip_down(&pick, top_m))
    }

    /// The motion of a proposal from where the robot is; else why it cannot be planned.
    pub fn dry_run(&self, proposal: &Proposal) -> Result<PlannedPrimitive, String> {
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
        };
        assert_eq!(robot.obstacle(), None);
        robot.plan(&proposal(0.5)).unwrap();
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
        let reason = robot.plan(&proposal(2.0)).unwrap_err();
        assert!(
            reason.contains("pick") && !reason.contains('\n'),
            "{reason}"
        );
        let holding = Pins {
            suction: true,
            vacuum: true,
        };
        robot.status.pins = Some(Newest {
            value: holding,
            at: Duration::ZERO,
            count: 1,
        });
        let reason = robot.plan(&proposal(0.5)).unwrap_err();
        assert!(reason.contains("already holds"), "{reason}");
        robot.status.pins.as_mut().unwrap().value.vacuum = false;
        robot.plan(&proposal(0.5)).unwrap();
        robot.time = Duration::from_secs(11);
        let reason = robot.plan(&proposal(0.5)).unwrap_err();
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
            let planned = robot.plan(&proposal);
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
        let reason = robot.plan(&proposal(0.5)).unwrap_err();
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
            needs_home: false,
            time: Duration::ZERO,
            seen: None,
            observation_max_age: Duration::from_secs(10),
            contact: Contact::default(),
            sign: ContactSign::UntilAction,
            checker: checker(),
            without_arm: None,
            picked: None,
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
        let from_rad = robot.plan_home().unwrap();
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
        robot.without_arm = Some(table_with_a_wall());
        robot.dry_run_home().unwrap();
        robot.picked = Some(Isometry2::new(Vector2::new(0.5, 0.1), 0.0));
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
    }
}
