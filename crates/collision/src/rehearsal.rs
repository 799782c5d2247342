//! Collision check of all motions of a pick and place, from its start to its end.

use std::cell::{Cell, RefCell};
use std::rc::Rc;

use crate::{Carried, Clearance, Collision, CollisionChecker, Contact, Scene, Terrain, lift_out};
use heightmap::Heightmap;
use nalgebra::{Point2, Vector3};
use pick_place::{
    Command, ExecuteError, Next, Outcome, Phase, PickPlace, Primitive, PrimitiveSettings, PutDown,
    Report, Robot, Touchdown, carry_out, go_home, put_down,
};
use ur5::{Arm, JointTrajectory, Joints};

/// The cup may touch what is this near its axis (m), beside what it holds.
const CUP_M: f64 = 0.02;
/// A way is straight down when it leads no further aside (m).
const STRAIGHT_M: f64 = 1e-3;
/// The tool may touch what is so much higher than where it meets the surface: noise, and the rim of something hollow.
const ROUGH_M: f64 = 0.015;
/// Within this distance of each joint the arm counts as home, out of everybody's way (rad).
const AT_HOME_RAD: f64 = 1e-2;
/// Joints that differ by less are the same: a tenth of a millimetre at the tip (rad).
const SAME_RAD: f64 = 1e-4;
/// The same for durations (s).
const SAME_S: f64 = 1e-3;

/// A robot that is where it was sent, and whose tool finds what the heightmap shows.
#[derive(Clone)]
struct Rehearsal<'a> {
    checker: &'a CollisionChecker,
    arm: &'a Arm,
    joints: Joints,
    holds: bool,
    /// What was seen on the table, with what is carried.
    seen: Option<Rc<Table>>,
    /// What stands on the table, without what is carried.
    table: Option<Rc<Table>>,
    carried: Option<Carried>,
    /// Where the tool is in contact, and what it stands beside there.
    contacts: Vec<Contact>,
    /// How the tip comes down, where the heights of the surfaces are known.
    touchdown: Option<Touchdown>,
    /// A descent that meets nothing leads no further below what was seen (m).
    sinks_m: f64,
    clearance: Rc<Cell<Clearance>>,
    /// Ways that the empty tool may take over what was seen.
    free: Rc<RefCell<Vec<StraightWay>>>,
}

/// A way that is straight in joint space.
struct StraightWay {
    ends_rad: [Joints; 2],
    duration_s: f64,
}

impl StraightWay {
    /// Nothing for a way that is not straight.
    fn of(trajectory: &JointTrajectory) -> Option<Self> {
        let points = trajectory.points();
        let (from, to) = (points[0].positions_rad, trajectory.last().positions_rad);
        let along = to - from;
        let length = along.norm_squared();
        let is_on_it = |joints: &Joints| {
            let share = (joints - from).dot(&along) / length;
            (joints - from - along * share).amax() < SAME_RAD
        };
        let is_straight = length > 0.0 && points.iter().all(|point| is_on_it(&point.positions_rad));
        is_straight.then(|| Self {
            ends_rad: [from, to],
            duration_s: trajectory.duration().as_secs_f64(),
        })
    }

    /// Whether both lead the same way, forth or back, as fast.
    fn is_same(&self, other: &Self) -> bool {
        let ends = |ends: [Joints; 2]| {
            let mut pairs = self.ends_rad.iter().zip(ends);
            pairs.all(|(own, other)| (own - other).amax() < SAME_RAD)
        };
        let [from, to] = other.ends_rad;
        (self.duration_s - other.duration_s).abs() < SAME_S
            && (ends([from, to]) || ends([to, from]))
    }
}

/// What stands on the table.
struct Table {
    heightmap: Heightmap,
    terrain: Terrain,
}

impl Table {
    fn new(heightmap: Heightmap) -> Rc<Self> {
        let terrain = Terrain::new(&heightmap);
        Rc::new(Self { heightmap, terrain })
    }
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

/// What an action would do that must not begin.
#[derive(Debug, thiserror::Error)]
#[error("{}{reason}", if_it_ends(.ends))]
pub struct RehearsalError {
    /// How the action ends where this happens; [`Outcome::Placed`] for what is expected.
    pub ends: Outcome,
    /// What cannot be planned, or the first collision, with the phase it is in.
    pub reason: Box<ExecuteError<Box<Collision>>>,
}

/// When it happens.
fn if_it_ends(outcome: &Outcome) -> &'static str {
    match outcome {
        Outcome::Placed => "",
        Outcome::NoContact => "if there is nothing to pick: ",
        Outcome::GraspFailed => "if suction holds nothing: ",
        Outcome::Dropped => "if the object is lost on its way: ",
        Outcome::LagAborted => "if the arm lags behind: ",
    }
}

/// An action half-way, on one of the ways in which it may go on.
struct Branch<'a> {
    ends: Outcome,
    /// Whether the command is answered otherwise than expected.
    turns: bool,
    primitive: Primitive<'a>,
    robot: Rehearsal<'a>,
    command: Command,
}

/// Plans every motion of an action from where the arm is and checks it against cell and heightmap: as it is expected to go, and every way in which it
/// ends without an object at the place, the arm going home by itself.
///
/// - [`Outcome::NoContact`]: from the lowest that the descent to the pick may lead to: 15 mm below what was seen, and further by the window of a touchdown.
/// - [`Outcome::GraspFailed`]: from where the object would be lifted to; it stands where it stood.
/// - [`Outcome::Dropped`]: the primitive notices it at the end of the transfer and at the end of the descent to the place. Until then the empty arm goes
///   where the loaded arm was expected to go, and that is free for it: arm and tool are the same, and the loaded arm has the object besides. Only the
///   descent leads further down without the object. Where it lies then is not known: it counts as lying where it was picked.
///
/// [`Outcome::LagAborted`] is left out: robots with the lag rule are simulated.
///
/// # Errors
/// What cannot be planned, or the first collision with the phase it is in.
pub fn rehearse(
    checker: &CollisionChecker,
    arm: &Arm,
    action: &PickPlace,
    settings: &PrimitiveSettings,
    situation: &Situation<'_>,
) -> Result<(Outcome, Clearance), RehearsalError> {
    let Situation {
        joints,
        holds,
        heightmap,
        touchdown,
    } = *situation;
    let primitive = Primitive::new(arm, action, settings, joints);
    let primitive = primitive.and_then(|primitive| match touchdown {
        Some(touchdown) => primitive.with_touchdown(touchdown),
        None => Ok(primitive),
    });
    let failed = |ends, reason| RehearsalError {
        ends,
        reason: Box::new(reason),
    };
    let primitive = primitive.map_err(|error| failed(Outcome::Placed, error.into()))?;
    let mut robot = Rehearsal::new(checker, arm, joints, heightmap);
    robot.holds = holds;
    robot.touchdown = touchdown.copied();
    robot.sinks_m += touchdown.map_or(0.0, |touchdown| touchdown.window_m);
    if (joints - arm.home).amax() > AT_HOME_RAD {
        // The arm may have been stopped on the table.
        robot.contacts = vec![robot.contact_here()];
    }
    let clearance = Rc::clone(&robot.clearance);
    let mut branches = vec![Branch {
        ends: Outcome::Placed,
        turns: false,
        command: primitive.start(),
        primitive,
        robot,
    }];
    let mut outcome = None;
    while let Some(branch) = branches.pop() {
        let ends = branch.ends;
        let ended = branch.finish(&mut branches);
        let ended = ended.map_err(|reason| failed(ends, reason))?;
        // The first one is what is expected.
        outcome.get_or_insert(ended);
    }
    let clearance = clearance.get();
    Ok((outcome.unwrap_or(Outcome::Placed), clearance))
}

impl Branch<'_> {
    /// Goes on to the end. Where something else than what is expected may come, that is another branch.
    fn finish(mut self, branches: &mut Vec<Self>) -> Result<Outcome, ExecuteError<Box<Collision>>> {
        loop {
            let phase = self.primitive.phase();
            if self.ends == Outcome::Placed
                && let Some(ends) = otherwise(phase, &self.command)
            {
                branches.push(Self {
                    ends,
                    turns: true,
                    primitive: self.primitive.clone(),
                    robot: self.robot.clone(),
                    command: self.command.clone(),
                });
            }
            let report = match std::mem::take(&mut self.turns) {
                true => self.robot.turn(&self.command, self.ends),
                false => carry_out(&mut self.robot, &self.command),
            };
            let report = report.map_err(|error| ExecuteError::Robot { phase, error })?;
            match self.primitive.next(report)? {
                Next::Do(command) => self.command = command,
                Next::Done(outcome) => return Ok(outcome),
            }
        }
    }
}

/// How a primitive ends where a command is answered otherwise than expected; nothing where nothing moves after that.
fn otherwise(phase: Phase, command: &Command) -> Option<Outcome> {
    match (phase, command) {
        (Phase::DescendToPick, Command::FollowUntilContact(_)) => Some(Outcome::NoContact),
        (Phase::CheckGrasp, Command::ReadVacuum) => Some(Outcome::GraspFailed),
        (Phase::Transfer, Command::ReadVacuum)
        | (Phase::DescendToPlace, Command::FollowUntilContact(_)) => Some(Outcome::Dropped),
        _ => None,
    }
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
    Ok(robot.clearance.get())
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
    Ok(robot.clearance.get())
}

impl<'a> Rehearsal<'a> {
    /// Stands still, with nothing at the cup.
    fn new(
        checker: &'a CollisionChecker,
        arm: &'a Arm,
        joints: &Joints,
        heightmap: Option<&Heightmap>,
    ) -> Self {
        let table = heightmap.cloned().map(Table::new);
        Self {
            checker,
            arm,
            joints: *joints,
            holds: false,
            seen: table.clone(),
            table,
            carried: None,
            contacts: Vec::new(),
            touchdown: None,
            sinks_m: ROUGH_M,
            clearance: Rc::new(Cell::new(Clearance {
                least_m: f64::INFINITY,
                samples: 0,
            })),
            free: Rc::default(),
        }
    }

    /// Stands still and may hold something, on the table maybe.
    fn carrying(
        checker: &'a CollisionChecker,
        arm: &'a Arm,
        joints: &Joints,
        carried: Option<Carried>,
        heightmap: Option<&Heightmap>,
    ) -> Self {
        let mut robot = Self::new(checker, arm, joints, heightmap);
        robot.holds = carried.is_some();
        robot.carried = carried;
        // The arm may have been stopped on the table.
        robot.contacts = vec![robot.contact_here()];
        robot
    }
}

impl Rehearsal<'_> {
    /// Contact where the tool is.
    fn contact_here(&self) -> Contact {
        self.contact_at(&self.joints)
    }

    /// Contact where the tool is with these joints.
    fn contact_at(&self, joints: &Joints) -> Contact {
        let tip = self.arm.tip(joints).translation.vector;
        let held_m = self.carried.map_or(0.0, |carried| carried.radius_m());
        Contact {
            center_m: Point2::from(tip.xy()),
            radius_m: self.checker.tool_radius_m()
                + CUP_M.max(held_m)
                + self.checker.margins().obstacle_m,
            above_m: f64::NEG_INFINITY,
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
        let is_bare = self.carried.is_none() && contacts.is_empty();
        if !is_bare || !self.is_free(trajectory) {
            self.check_over(self.table.as_deref(), trajectory, contacts)?;
        }
        self.joints = trajectory.last().positions_rad;
        Ok(())
    }

    /// Whether the empty tool may go a straight way through joint space over what was seen, also over what is carried meanwhile. That
    /// is found out once for each such way: the primitive may go it from both ends, and after more than one thing that may happen.
    fn is_free(&self, trajectory: &JointTrajectory) -> bool {
        let Some(way) = StraightWay::of(trajectory) else {
            return false;
        };
        let is_known = self.free.borrow().iter().any(|known| known.is_same(&way));
        if is_known {
            return true;
        }
        let found = self.check_over(self.seen.as_deref(), trajectory, Vec::new());
        if found.is_ok() {
            self.free.borrow_mut().push(way);
        }
        found.is_ok()
    }

    fn check_over(
        &self,
        table: Option<&Table>,
        trajectory: &JointTrajectory,
        contacts: Vec<Contact>,
    ) -> Result<(), Box<Collision>> {
        let scene = Scene {
            terrain: table.map(|table| &table.terrain),
            carried: self.carried,
            contacts,
        };
        let found = self.checker.check(trajectory, &scene)?;
        let before = self.clearance.get();
        self.clearance.set(Clearance {
            least_m: before.least_m.min(found.least_m),
            samples: before.samples + found.samples,
        });
        Ok(())
    }

    /// Nothing is held any more. What was picked counts as lying where it was picked.
    fn lose(&mut self) {
        self.holds = false;
        self.carried = None;
        self.table = self.seen.clone();
    }

    /// Has a command answered as it is where an action ends so.
    fn turn(&mut self, command: &Command, ends: Outcome) -> Result<Report, Box<Collision>> {
        // Height of the tip where what is carried would meet the surface.
        let loaded_m = match command {
            Command::FollowUntilContact(descent) => {
                self.surface_m(self.below(descent)) + self.hangs_m()
            }
            _ => 0.0,
        };
        self.lose();
        let Command::FollowUntilContact(descent) = command else {
            if ends == Outcome::GraspFailed {
                // The tool was lifted straight up beside what stands there, and goes on straight up.
                self.contacts = vec![self.contact_here()];
            }
            return Ok(Report::Holds(false));
        };
        // As far down as contact may come, or none: what was seen may be lower.
        let surface_m = self.surface_m(self.below(descent));
        let (descent, _) = self.until(descent, surface_m - self.sinks_m);
        let contact = Contact {
            up_to_m: surface_m + ROUGH_M,
            ..self.contact_at(&descent.last().positions_rad)
        };
        // What is higher than the tip where the object was to meet the surface stands beside the tool there, as expected. Further straight down it
        // does so still.
        let beside = Contact {
            above_m: loaded_m,
            up_to_m: loaded_m + ROUGH_M,
            ..contact
        };
        self.contacts = vec![contact, beside];
        self.check(&descent, self.contacts.clone())?;
        Ok(match ends {
            Outcome::NoContact => Report::NoContact(self.joints),
            _ => Report::Contact(self.joints),
        })
    }

    /// The part of a descent up to the first point that is no higher than a height of the tip, and whether there is one.
    fn until(&self, descent: &JointTrajectory, stop_m: f64) -> (JointTrajectory, bool) {
        let points = descent.points();
        let is_above = |point: &&ur5::TrajectoryPoint| {
            self.arm.tip(&point.positions_rad).translation.z > stop_m
        };
        let above = points.iter().take_while(is_above).count();
        let until = points[..(above + 1).min(points.len())].to_vec();
        let until = JointTrajectory::new(until).unwrap_or_else(|_| descent.clone());
        (until, above < points.len())
    }

    /// Where a trajectory ends, in the world's xy-plane.
    fn below(&self, trajectory: &JointTrajectory) -> Point2<f64> {
        let end = self.arm.tip(&trajectory.last().positions_rad);
        Point2::from(end.translation.vector.xy())
    }

    /// How far what is carried hangs below the tip.
    fn hangs_m(&self) -> f64 {
        self.carried.map_or(0.0, |carried| {
            carried.tip_from_shape.translation.z + carried.shape.extent_m(&Vector3::z())
        })
    }

    /// Height of the highest thing within the cup, 0 without a heightmap.
    fn surface_m(&self, at: Point2<f64>) -> f64 {
        let around = Vector3::repeat(0.5 * CUP_M).xy();
        let columns = self
            .table
            .iter()
            .flat_map(|table| table.terrain.columns(at - around, at + around));
        columns.map(|column| column.height_m).fold(0.0, f64::max)
    }
}

impl Robot for Rehearsal<'_> {
    type Error = Box<Collision>;

    fn joints(&mut self) -> Result<Joints, Box<Collision>> {
        Ok(self.joints)
    }

    fn follow(&mut self, trajectory: &JointTrajectory) -> Result<bool, Box<Collision>> {
        let mut contacts = std::mem::take(&mut self.contacts);
        if contacts.is_empty() {
            contacts.extend(self.contact_below(trajectory));
        }
        self.check(trajectory, contacts)?;
        Ok(true)
    }

    fn follow_until_contact(
        &mut self,
        trajectory: &JointTrajectory,
    ) -> Result<bool, Box<Collision>> {
        let surface_m = self.surface_m(self.below(trajectory));
        // Where the surfaces are known the tip comes down on them: single cells may be wrong, or show what is beside the tool.
        let expected_m = match self.touchdown {
            Some(touchdown) if self.holds => touchdown.place_m,
            Some(touchdown) => touchdown.pick_m,
            None => surface_m,
        };
        let hangs_m = self.hangs_m();
        let (descent, meets) = self.until(trajectory, expected_m + hangs_m);
        let contact = self.contact_at(&descent.last().positions_rad);
        self.contacts = vec![Contact {
            up_to_m: contact.up_to_m.max(surface_m + hangs_m + ROUGH_M),
            ..contact
        }];
        self.check(&descent, self.contacts.clone())?;
        Ok(meets)
    }

    fn set_suction(&mut self, on: bool) -> Result<(), Box<Collision>> {
        self.holds = on;
        if !on {
            self.carried = None;
            return Ok(());
        }
        if let Some(table) = &self.table
            && let tip = self.arm.tip(&self.joints)
            && let Some((carried, rest)) = lift_out(&table.heightmap, &tip)
        {
            self.table = Some(Table::new(rest));
            self.carried = Some(carried);
            // As wide as what is held: what stands beside it is passed on the way straight up, and on that way only.
            self.contacts = vec![self.contact_here()];
        }
        // The cup may have been pressed on.
        if self.contacts.is_empty() {
            self.contacts = vec![self.contact_here()];
        }
        Ok(())
    }

    fn holds(&mut self) -> Result<bool, Box<Collision>> {
        Ok(self.holds)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Isometry2;
    use ur5::WorkCell;

    #[test]
    fn a_way_back_is_the_same_way_unless_it_is_faster_or_bends() {
        let arm = WorkCell::builtin().unwrap().arm;
        let at = |y_m| Arm::tip_down(&Isometry2::translation(0.5, y_m), 0.24);
        let over = arm.solve(&at(-0.2), &arm.ready).unwrap();
        let way = |from: &Joints, to: &Joints, tip_m_s| {
            let way = JointTrajectory::joint_space_within(&arm, from, to, tip_m_s);
            StraightWay::of(&way.unwrap()).unwrap()
        };
        let known = way(&arm.home, &over, 0.8);
        assert!(known.is_same(&way(&arm.home, &over, 0.8)));
        assert!(known.is_same(&way(&over, &arm.home, 0.8)));
        assert!(!known.is_same(&way(&over, &arm.home, 0.2)));
        let elsewhere = arm.solve(&at(-0.19), &arm.ready).unwrap();
        assert!(!known.is_same(&way(&elsewhere, &arm.home, 0.8)));
        // Straight for the tip.
        let line = JointTrajectory::line(&arm, &over, &at(0.2), 0.5, 2.0).unwrap();
        assert!(StraightWay::of(&line).is_none());
    }
}
