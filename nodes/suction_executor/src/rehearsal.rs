//! A primitive carried out in thought, to know beforehand whether all of it can be planned.

use std::convert::Infallible;

use pick_place::Robot;
use ur5::{Arm, JointTrajectory, Joints};

use crate::gate::Proposal;
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

/// Plans every motion of a proposal from where the robot is; says why one cannot be planned.
pub(crate) fn rehearse(
    arm: &Arm,
    status: &DriverStatus,
    proposal: &Proposal,
) -> Result<(), String> {
    let (Some(joints), Some(pins)) = (&status.joints, &status.pins) else {
        return Err("the robot's state is not known".into());
    };
    let mut robot = Rehearsal {
        joints: joints.value.positions_rad,
        holds: pins.value.vacuum,
    };
    pick_place::execute(
        &mut robot,
        arm,
        &proposal.action,
        &proposal.settings,
        |_| (),
    )
    .map(|_| ())
    .map_err(|error| one_line(&error.to_string()))
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
    use std::time::Duration;
    use ur5::WorkCell;

    fn proposal(x_m: f64) -> Proposal {
        let pose = |y_m| Isometry2::new(Vector2::new(x_m, y_m), 0.0);
        Proposal {
            id: 1,
            frame: "world".into(),
            stamp: Duration::ZERO,
            action: PickPlace {
                pick: pose(0.1),
                place: pose(-0.1),
            },
            settings: PrimitiveSettings::RIGID,
        }
    }

    #[test]
    fn only_what_can_be_planned_to_its_end_may_begin() {
        let arm = WorkCell::builtin().unwrap().arm;
        let mut status = ready(Duration::ZERO);
        status.joints.as_mut().unwrap().value.positions_rad = arm.home;
        rehearse(&arm, &status, &proposal(0.5)).unwrap();
        let reason = rehearse(&arm, &status, &proposal(2.0)).unwrap_err();
        assert!(
            reason.contains("pick") && !reason.contains('\n'),
            "{reason}"
        );
        let holding = Pins {
            suction: true,
            vacuum: true,
        };
        status.pins = Some(Newest {
            value: holding,
            at: Duration::ZERO,
            count: 1,
        });
        let reason = rehearse(&arm, &status, &proposal(0.5)).unwrap_err();
        assert!(reason.contains("already holds"), "{reason}");
    }
}
