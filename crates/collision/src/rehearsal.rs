//! A whole pick and place carried out in thought, each motion checked before it would begin.

use crate::{Carried, Clearance, Collision, CollisionChecker, Contact, Scene, Terrain, lift_out};
use heightmap::Heightmap;
use nalgebra::{Point2, Vector3};
use pick_place::{ExecuteError, Outcome, PickPlace, PrimitiveSettings, Robot, go_home};
use ur5::{Arm, JointTrajectory, Joints};

/// The cup may touch what is this near its axis (m), beside what it holds.
const CUP_M: f64 = 0.02;
/// The tool may touch what is so much higher than where it meets the surface: noise, and the rim of something hollow.
const ROUGH_M: f64 = 0.015;

/// A robot that is where it was sent, and whose tool finds what the heightmap shows.
struct Rehearsal<'a> {
    checker: &'a CollisionChecker,
    arm: &'a Arm,
    joints: Joints,
    holds: bool,
    /// What stands on the table, without what is carried.
    heightmap: Option<Heightmap>,
    terrain: Option<Terrain>,
    carried: Option<Carried>,
    /// Where the tool is in contact.
    contact: Option<Contact>,
    clearance: Clearance,
}

/// Plans every motion of an action from where the arm is and checks it against cell and heightmap. `holds`: the gripper holds something already.
/// Without a heightmap the table counts as empty.
///
/// # Errors
/// What cannot be planned, or the first collision with the phase it is in.
pub fn rehearse(
    checker: &CollisionChecker,
    arm: &Arm,
    action: &PickPlace,
    settings: &PrimitiveSettings,
    joints: &Joints,
    holds: bool,
    heightmap: Option<&Heightmap>,
) -> Result<(Outcome, Clearance), ExecuteError<Box<Collision>>> {
    let mut robot = Rehearsal {
        checker,
        arm,
        joints: *joints,
        holds,
        heightmap: heightmap.cloned(),
        terrain: heightmap.map(Terrain::new),
        carried: None,
        contact: None,
        clearance: Clearance {
            least_m: f64::INFINITY,
            samples: 0,
        },
    };
    // The arm may have been stopped on the table.
    robot.contact = Some(robot.contact_here());
    let outcome = pick_place::execute(&mut robot, arm, action, settings, |_| ())?;
    Ok((outcome, robot.clearance))
}

/// Plans the way home from where the arm is and checks it, like [`rehearse`]. `carried`: what the gripper holds; `heightmap` must not show it, nor the arm.
///
/// # Errors
/// What cannot be planned, or the first collision with the phase it is in.
pub fn rehearse_home(
    checker: &CollisionChecker,
    arm: &Arm,
    settings: &PrimitiveSettings,
    joints: &Joints,
    carried: Option<Carried>,
    heightmap: Option<&Heightmap>,
) -> Result<Clearance, ExecuteError<Box<Collision>>> {
    let mut robot = Rehearsal {
        checker,
        arm,
        joints: *joints,
        holds: carried.is_some(),
        heightmap: None,
        terrain: heightmap.map(Terrain::new),
        carried,
        contact: None,
        clearance: Clearance {
            least_m: f64::INFINITY,
            samples: 0,
        },
    };
    // The arm may have been stopped on the table.
    robot.contact = Some(robot.contact_here());
    go_home(&mut robot, arm, settings)?;
    Ok(robot.clearance)
}

impl Rehearsal<'_> {
    /// Contact where the tool is.
    fn contact_here(&self) -> Contact {
        let tip = self.arm.tip(&self.joints).translation.vector;
        let held_m = self.carried.map_or(0.0, |carried| carried.radius_m());
        Contact {
            center_m: Point2::from(tip.xy()),
            radius_m: self.checker.tool_radius_m()
                + CUP_M.max(held_m)
                + self.checker.margins().obstacle_m,
            up_to_m: tip.z + ROUGH_M,
        }
    }

    fn check(
        &mut self,
        trajectory: &JointTrajectory,
        contacts: Vec<Contact>,
    ) -> Result<(), Box<Collision>> {
        let scene = Scene {
            terrain: self.terrain.as_ref(),
            carried: self.carried,
            contacts,
        };
        let found = self.checker.check(trajectory, &scene)?;
        self.clearance.least_m = self.clearance.least_m.min(found.least_m);
        self.clearance.samples += found.samples;
        self.joints = trajectory.last().positions_rad;
        Ok(())
    }

    /// Height of the highest thing within the cup, 0 without a heightmap.
    fn surface_m(&self, at: Point2<f64>) -> f64 {
        let around = Vector3::repeat(0.5 * CUP_M).xy();
        let columns = self
            .terrain
            .iter()
            .flat_map(|terrain| terrain.columns(at - around, at + around));
        columns.map(|column| column.height_m).fold(0.0, f64::max)
    }
}

impl Robot for Rehearsal<'_> {
    type Error = Box<Collision>;

    fn joints(&mut self) -> Result<Joints, Box<Collision>> {
        Ok(self.joints)
    }

    fn follow(&mut self, trajectory: &JointTrajectory) -> Result<bool, Box<Collision>> {
        let contacts = self.contact.take().into_iter().collect();
        self.check(trajectory, contacts)?;
        Ok(true)
    }

    fn follow_until_contact(
        &mut self,
        trajectory: &JointTrajectory,
    ) -> Result<bool, Box<Collision>> {
        let end = self
            .arm
            .tip(&trajectory.last().positions_rad)
            .translation
            .vector;
        let hangs_m = self.carried.map_or(0.0, |carried| {
            carried.tip_from_shape.translation.z + carried.shape.extent_m(&Vector3::z())
        });
        let stop_m = self.surface_m(Point2::from(end.xy())) + hangs_m;
        let points = trajectory.points();
        let is_above = |point: &&ur5::TrajectoryPoint| {
            self.arm.tip(&point.positions_rad).translation.z > stop_m
        };
        let above = points.iter().take_while(is_above).count();
        let meets = above < points.len();
        // Up to the first point that is not above the surface.
        let until = points[..(above + 1).min(points.len())].to_vec();
        let descent = match JointTrajectory::new(until) {
            Ok(descent) => descent,
            Err(_) => trajectory.clone(),
        };
        let start = self.joints;
        self.joints = descent.last().positions_rad;
        let contact = self.contact_here();
        self.joints = start;
        self.check(&descent, vec![contact])?;
        self.contact = Some(contact);
        Ok(meets)
    }

    fn set_suction(&mut self, on: bool) -> Result<(), Box<Collision>> {
        self.holds = on;
        if !on {
            self.carried = None;
        } else if let Some(heightmap) = &self.heightmap
            && let tip = self.arm.tip(&self.joints)
            && let Some((carried, rest)) = lift_out(heightmap, &tip)
        {
            self.terrain = Some(Terrain::new(&rest));
            self.heightmap = Some(rest);
            self.carried = Some(carried);
            // As wide as what is held: what stands beside it is passed on the way straight up, and on that way only.
            self.contact = Some(self.contact_here());
        }
        Ok(())
    }

    fn holds(&mut self) -> Result<bool, Box<Collision>> {
        Ok(self.holds)
    }
}
