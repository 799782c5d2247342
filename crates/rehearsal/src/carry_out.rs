//! What was rehearsed, carried out.

use pick_place::{ExecuteError, Outcome, Phase, Robot, execute_on, go_home, put_down};
use step_protocol::{MotionOrder, Proposal};

use crate::robot_now::HOME_SETTINGS;
use crate::{RobotNow, touchdown};

impl RobotNow {
    /// Carries out on a robot what may begin now; without an outcome where that is a way home. `fault`: an error of the robot for what is not
    /// known any more; the gate has asked for it before. `observe` is called with each phase of a proposal as it begins.
    ///
    /// # Errors
    /// Returns at once, without another command to the robot.
    pub fn carry_out<R: Robot>(
        &self,
        order: &MotionOrder,
        robot: &mut R,
        fault: impl FnOnce(String) -> R::Error,
        observe: impl FnMut(Phase),
    ) -> Result<Option<Outcome>, ExecuteError<R::Error>> {
        let unknown = move |phase| {
            move |reason| ExecuteError::Robot {
                phase,
                error: fault(reason),
            }
        };
        match order {
            MotionOrder::Proposal(proposal) => {
                let Proposal {
                    action, settings, ..
                } = proposal.as_ref();
                let seen = self.seen.as_ref();
                let touchdown =
                    seen.map(|(seen, _)| touchdown(seen, action, &self.contact, self.sign));
                let touchdown = touchdown.transpose().map_err(unknown(Phase::Approach))?;
                let touchdown = touchdown.flatten();
                execute_on(
                    robot,
                    &self.arm,
                    action,
                    settings,
                    touchdown.as_ref(),
                    observe,
                )
                .map(Some)
            }
            MotionOrder::Home(_) => go_home(robot, &self.arm, &HOME_SETTINGS).map(|()| None),
            MotionOrder::PutDown(_) => {
                let what = self.put_down().map_err(unknown(Phase::Retreat))?;
                put_down(robot, &self.arm, &what, &HOME_SETTINGS).map(|()| None)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use heightmap::{Heightmap, Workspace};
    use nalgebra::{Isometry2, Vector2};
    use pick_place::{ContactSign, PickPlace, PrimitiveSettings};
    use step_protocol::ProposalId;
    use ur5::{JointTrajectory, Joints};

    use super::*;
    use crate::fixtures::{proposal, reading, rehearsals};
    use crate::planned::DryRun;

    const ID: ProposalId = ProposalId(7);

    /// A robot that must not be asked anything.
    struct Untouched;

    impl Robot for Untouched {
        type Error = String;

        fn joints(&mut self) -> Result<Joints, String> {
            panic!("asked for the joints")
        }

        fn follow(&mut self, _: &JointTrajectory) -> Result<bool, String> {
            panic!("moved")
        }

        fn follow_until_contact(&mut self, _: &JointTrajectory) -> Result<bool, String> {
            panic!("moved")
        }

        fn set_suction(&mut self, _: bool) -> Result<(), String> {
            panic!("suction was switched")
        }

        fn holds(&mut self) -> Result<bool, String> {
            panic!("asked what is held")
        }
    }

    #[test]
    fn a_proposal_is_carried_out_as_it_was_rehearsed_and_tells_its_phases() {
        let mut rehearsals = rehearsals();
        let seen = std::sync::Arc::new(Heightmap::new(Workspace::RAVENS));
        let reading = reading();
        rehearsals.on_heightmap(Duration::ZERO, &seen, 1, &reading.at_home);
        let now = rehearsals.robot(reading);
        let home = now.arm.home;
        let mut robot = DryRun::new(home, false);
        let mut phases = Vec::new();
        let order = MotionOrder::Proposal(Box::new(proposal(ID)));
        let fault = |reason| panic!("{reason}");
        let done = now.carry_out(&order, &mut robot, fault, |phase| phases.push(phase));
        assert_eq!(done.unwrap(), Some(Outcome::Placed));
        assert_eq!(phases.last(), Some(&Phase::Home));
        let motion = robot.motion();
        let last = motion.points().last().unwrap().positions_rad;
        assert!((last - home).amax() < 1e-6);
    }

    #[test]
    fn the_way_home_ends_at_home_and_switches_nothing() {
        let now = rehearsals().robot(reading());
        let over = Isometry2::new(Vector2::new(0.5, 0.1), 0.0);
        let over = ur5::Arm::tip_down(&over, 0.2);
        let start = now.arm.solve(&over, &now.arm.ready).unwrap();
        let mut robot = DryRun::new(start, true);
        let fault = |reason| panic!("{reason}");
        let order = MotionOrder::Home(ID);
        let done = now.carry_out(&order, &mut robot, fault, |_| ());
        assert_eq!(done.unwrap(), None);
        assert!(robot.holds().unwrap());
        let motion = robot.motion();
        let last = motion.points().last().unwrap().positions_rad;
        assert!((last - now.arm.home).amax() < 1e-6);
    }

    #[test]
    fn without_what_the_gate_has_asked_for_the_robot_is_not_touched() {
        let mut rehearsals = rehearsals();
        let fault = |order: &MotionOrder, now: &RobotNow| {
            let done = now.carry_out(order, &mut Untouched, |reason| reason, |_| ());
            done.unwrap_err().to_string()
        };
        let now = rehearsals.robot(reading());
        let reason = fault(&MotionOrder::PutDown(ID), &now);
        assert!(
            reason.starts_with("Retreat: the gripper holds nothing"),
            "{reason}"
        );
        // Contact by height needs a slow part, and places at which something was seen.
        let seen = std::sync::Arc::new(Heightmap::new(Workspace::RAVENS));
        rehearsals.on_heightmap(Duration::ZERO, &seen, 1, &reading().at_home);
        let mut now = rehearsals.robot(reading());
        now.contact.slow_from_m = 0.0;
        now.sign = ContactSign::Height;
        let order = MotionOrder::Proposal(Box::new(Proposal {
            action: PickPlace {
                pick: Isometry2::new(Vector2::new(0.5, 0.1), 0.0),
                place: Isometry2::new(Vector2::new(0.5, -0.1), 0.0),
            },
            settings: PrimitiveSettings::RIGID,
            ..proposal(ID)
        }));
        let reason = fault(&order, &now);
        assert!(
            reason.starts_with("Approach: ") && reason.contains("slow_from_m"),
            "{reason}"
        );
    }
}
