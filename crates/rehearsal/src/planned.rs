//! The whole motion of an action, planned.

use std::convert::Infallible;
use std::time::Duration;

use pick_place::Robot;
use ur5::{JointTrajectory, Joints, TrajectoryPoint};

/// A robot that is always where it was sent, and whose tool finds the table.
pub(crate) struct DryRun {
    joints: Joints,
    holds: bool,
    motion: PlannedPrimitive,
}

impl DryRun {
    /// From these joints (rad), with something held or not.
    pub(crate) fn new(joints: Joints, holds: bool) -> Self {
        Self {
            joints,
            holds,
            motion: PlannedPrimitive::default(),
        }
    }

    /// What it was sent along.
    pub(crate) fn motion(self) -> PlannedPrimitive {
        self.motion
    }
}

/// The whole motion of a proposal, from where the arm stands until it is home.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PlannedPrimitive {
    /// Times are from the beginning and increase.
    points: Vec<TrajectoryPoint>,
    /// When suction is switched on, and when off.
    suction: [Duration; 2],
}

impl PlannedPrimitive {
    /// Where the arm is and when; times are from the beginning and increase.
    pub fn points(&self) -> &[TrajectoryPoint] {
        &self.points
    }

    /// When suction is switched on, and when off.
    pub fn suction(&self) -> [Duration; 2] {
        self.suction
    }

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
