//! The whole workspace can be worked on, at every yaw.

use nalgebra::{Isometry2, Vector2};
use pick_place::{Outcome, PickPlace, PrimitiveSettings, Robot, execute};
use std::convert::Infallible;
use std::f64::consts::PI;
use std::time::Duration;
use ur5::{Arm, JointTrajectory, Joints, WorkCell};

/// Follows perfectly; whatever it touches lies 1 cm over the table.
struct Ideal {
    arm: Arm,
    joints: Joints,
    holds: bool,
    time: Duration,
}

impl Robot for Ideal {
    type Error = Infallible;
    fn joints(&mut self) -> Result<Joints, Infallible> {
        Ok(self.joints)
    }
    fn follow(&mut self, trajectory: &JointTrajectory) -> Result<bool, Infallible> {
        trajectory.check_limits(&self.arm).unwrap();
        self.joints = trajectory.last().positions_rad;
        self.time += trajectory.duration();
        Ok(true)
    }
    fn follow_until_contact(&mut self, trajectory: &JointTrajectory) -> Result<bool, Infallible> {
        trajectory.check_limits(&self.arm).unwrap();
        let touches = |joints: &Joints| self.arm.tip(joints).translation.z < 0.01;
        let point = trajectory
            .points()
            .iter()
            .find(|point| touches(&point.positions_rad))
            .unwrap();
        self.joints = point.positions_rad;
        self.time += point.time;
        Ok(true)
    }
    fn set_suction(&mut self, on: bool) -> Result<(), Infallible> {
        self.holds = on;
        Ok(())
    }
    fn holds(&mut self) -> Result<bool, Infallible> {
        Ok(self.holds)
    }
}

/// Poses that step through the workspace, edges and corners included, and through all yaws.
fn poses() -> Vec<Isometry2<f64>> {
    let mut poses = Vec::new();
    for x in 0..=4 {
        for y in 0..=8 {
            let at = Vector2::new(0.25 + 0.125 * f64::from(x), -0.5 + 0.125 * f64::from(y));
            poses.push(Isometry2::new(
                at,
                PI * f64::from((7 * x + 5 * y) % 16 - 8) / 8.0,
            ));
        }
    }
    poses
}

fn run_all(settings: &PrimitiveSettings) -> Duration {
    let arm = WorkCell::builtin().unwrap().arm;
    let mut robot = Ideal {
        joints: arm.home,
        arm: arm.clone(),
        holds: false,
        time: Duration::ZERO,
    };
    let poses = poses();
    let mut count = 0;
    for (i, pick) in poses.iter().enumerate() {
        for (j, place) in poses.iter().enumerate() {
            // Every third pair, all yaw differences among them.
            if (i + j) % 3 == 0 {
                let action = PickPlace {
                    pick: *pick,
                    place: *place,
                };
                let outcome = execute(&mut robot, &arm, &action, settings, |_| ());
                assert_eq!(outcome, Ok(Outcome::Placed), "{action:?}");
                count += 1;
            }
        }
    }
    robot.time / count
}

#[test]
fn every_rigid_pick_and_place_in_the_workspace_can_be_done() {
    let time = run_all(&PrimitiveSettings::RIGID);
    println!("mean {time:?}");
    assert!(time < Duration::from_secs(8), "{time:?}");
}

#[test]
fn every_slow_pick_and_place_in_the_workspace_can_be_done() {
    let time = run_all(&PrimitiveSettings::BEADS);
    println!("mean {time:?}");
    assert!(time < Duration::from_secs(15), "{time:?}");
}
