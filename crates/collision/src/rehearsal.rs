//! Collision check of all motions of a pick and place, from its start to its end.

use crate::{Carried, Clearance, Collision, CollisionChecker, Contact, Scene, Terrain, lift_out};
use heightmap::Heightmap;
use nalgebra::{Point2, Vector3};
use pick_place::{
    ExecuteError, Outcome, PickPlace, PrimitiveSettings, PutDown, Robot, Touchdown, execute_on,
    go_home, put_down,
};
use ur5::{Arm, JointTrajectory, Joints};

/// The cup may touch what is this near its axis (m), beside what it holds.
const CUP_M: f64 = 0.02;
/// A way is straight down when it leads no further aside (m).
const STRAIGHT_M: f64 = 1e-3;
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

/// Where an action begins.
#[derive(Clone, Copy, Debug)]
pub struct Situation<'a> {
    /// Where the joints are (rad).
    pub joints: &'a Joints,
    /// Whether the gripper holds something already.
    pub holds: bool,
    /// What stands on the table; without one it counts as empty.
    pub heightmap: Option<&'a Heightmap>,
    /// How the tip comes down, where the heights of the surfaces are known.
    pub touchdown: Option<&'a Touchdown>,
}

/// Plans every motion of an action from where the arm is and checks it against cell and heightmap.
///
/// # Errors
/// What cannot be planned, or the first collision with the phase it is in.
pub fn rehearse(
    checker: &CollisionChecker,
    arm: &Arm,
    action: &PickPlace,
    settings: &PrimitiveSettings,
    situation: &Situation<'_>,
) -> Result<(Outcome, Clearance), ExecuteError<Box<Collision>>> {
    let Situation {
        joints,
        holds,
        heightmap,
        touchdown,
    } = *situation;
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
    let outcome = execute_on(&mut robot, arm, action, settings, touchdown, |_| ())?;
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
    let mut robot = Rehearsal::carrying(checker, arm, joints, carried, heightmap);
    go_home(&mut robot, arm, settings)?;
    Ok(robot.clearance)
}

/// Plans how something that is held is put down, and the way home after that, like [`rehearse_home`].
///
/// # Errors
/// What cannot be planned, or the first collision with the phase it is in.
pub fn rehearse_put_down(
    checker: &CollisionChecker,
    arm: &Arm,
    (what, settings): (&PutDown, &PrimitiveSettings),
    joints: &Joints,
    carried: Carried,
    heightmap: &Heightmap,
) -> Result<Clearance, ExecuteError<Box<Collision>>> {
    let mut robot = Rehearsal::carrying(checker, arm, joints, Some(carried), Some(heightmap));
    put_down(&mut robot, arm, what, settings)?;
    Ok(robot.clearance)
}

impl<'a> Rehearsal<'a> {
    /// Stands still and may hold something, on the table maybe.
    fn carrying(
        checker: &'a CollisionChecker,
        arm: &'a Arm,
        joints: &Joints,
        carried: Option<Carried>,
        heightmap: Option<&Heightmap>,
    ) -> Self {
        let mut robot = Self {
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
        robot
    }
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

    /// Contact where a trajectory ends, with what stands there; only where it leads straight down.
    fn contact_below(&self, trajectory: &JointTrajectory) -> Option<Contact> {
        let tip = |joints| self.arm.tip(joints).translation.vector;
        let (from, to) = (tip(&self.joints), tip(&trajectory.last().positions_rad));
        let down = (from - to).xy().norm() < STRAIGHT_M && to.z < from.z;
        let at = Point2::from(to.xy());
        down.then(|| Contact {
            center_m: at,
            up_to_m: self.surface_m(at) + ROUGH_M,
            ..self.contact_here()
        })
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
        let contact = self.contact.take();
        let contact = contact.or_else(|| self.contact_below(trajectory));
        self.check(trajectory, contact.into_iter().collect())?;
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
        // The cup may have been pressed on.
        let here = self.contact_here();
        self.contact.get_or_insert(here);
        Ok(())
    }

    fn holds(&mut self) -> Result<bool, Box<Collision>> {
        Ok(self.holds)
    }
}
