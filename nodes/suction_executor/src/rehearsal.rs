//! A primitive carried out in thought, to know beforehand whether all of it can be planned.

use std::convert::Infallible;
use std::time::Duration;

use pick_place::Robot;
use step_protocol::{Proposal, RobotState};
use ur5::{Arm, JointTrajectory, Joints};

use crate::status::DriverStatus;

/// A robot that is always where it was sent, and whose tool finds the table.
struct Rehearsal {
    joints: Joints,
    holds: bool,
}

impl Robot for Rehearsal {
    type Error = Infallible;

    fn joints(&mut self) -> Result<Joints, Infallible> {
        Ok(self.joints)
    }

    fn follow(&mut self, trajectory: &JointTrajectory) -> Result<bool, Infallible> {
        self.joints = trajectory.last().positions_rad;
        Ok(true)
    }

    fn follow_until_contact(&mut self, trajectory: &JointTrajectory) -> Result<bool, Infallible> {
        self.follow(trajectory)
    }

    fn set_suction(&mut self, on: bool) -> Result<(), Infallible> {
        self.holds = on;
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
}

impl RobotState for RobotNow {
    fn obstacle(&self) -> Option<String> {
        let unattended = self.unattended.clone();
        unattended.or_else(|| self.status.obstacle(self.now, self.max_age))
    }

    /// Plans every motion of a proposal from where the robot is.
    fn plan(&self, proposal: &Proposal) -> Result<(), String> {
        let (Some(joints), Some(pins)) = (&self.status.joints, &self.status.pins) else {
            return Err("the robot's state is not known".into());
        };
        let mut robot = Rehearsal {
            joints: joints.value.positions_rad,
            holds: pins.value.vacuum,
        };
        let Proposal {
            action, settings, ..
        } = proposal;
        pick_place::execute(&mut robot, &self.arm, action, settings, |_| ())
            .map(|_| ())
            .map_err(|error| one_line(&error.to_string()))
    }
}

/// Poses print themselves over several lines.
fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::status::tests::ready;
    use crate::status::{Newest, Pins};
    use nalgebra::{Isometry2, Vector2};
    use pick_place::{PickPlace, PrimitiveSettings};
    use step_protocol::ProposalId;
    use ur5::WorkCell;

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
        let mut status = ready(Duration::ZERO);
        status.joints.as_mut().unwrap().value.positions_rad = arm.home;
        let mut robot = RobotNow {
            arm,
            status,
            now: Duration::ZERO,
            max_age: Duration::from_secs(1),
            unattended: None,
        };
        assert_eq!(robot.obstacle(), None);
        robot.plan(&proposal(0.5)).unwrap();
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
        robot.now = Duration::from_secs(3);
        assert!(robot.obstacle().unwrap().contains("joint_states"));
    }
}
