//! The simulated hardware behind the UR driver's interface: arm, suction, cameras.

use crate::camera_rig::CameraRig;
use crate::render::{RenderError, RgbdImage};
use crate::world::{self, World};
use camera_noise::ClutterItem;
use heightmap::{Camera, Intrinsics, View};
use nalgebra::Vector3;
use pick_place::{ExecuteError, Outcome, PickPlace, PrimitiveSettings, Robot};
use std::time::Duration;
use ur5::{JointTrajectory, Joints, WorkCell, joints_text};

/// The arm counts as home within this distance of each joint.
const HOME_TOLERANCE_RAD: f64 = 1e-3;
/// A trajectory must begin within this distance of each present joint position.
const START_TOLERANCE_RAD: f64 = 1e-2;
/// The lag rule: a tip further behind stops the arm (an over-pulled cable).
pub const MAX_LAG_M: f64 = 0.02;
/// A tip that has just been let go of has this long to spring back before the lag rule holds.
const SPRING_BACK_STEPS: u64 = world::STEPS_PER_SECOND as u64 / 10;
/// A motion is over when the tip has caught up this far, ...
const CAUGHT_UP_M: f64 = 1e-3;
/// ... or when it has had this long to do so.
const CATCH_UP_STEPS: u64 = world::STEPS_PER_SECOND as u64 / 2;
/// Settled: every free body slower than this (Ravens) ...
const REST_SPEED_M_S: f64 = 5e-3;
/// ... for this long without a break, since a body is also slow where it turns back.
const REST_STEPS: u64 = world::STEPS_PER_SECOND as u64 / 20;
/// What has not come to rest by then is left as it is.
const MAX_SETTLE_STEPS: u64 = 10 * world::STEPS_PER_SECOND as u64;

/// What a tick has done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Tick {
    /// No motion is under way: simulated time stands still.
    Idle,
    /// The motion goes on.
    Moving,
    /// The motion has just ended.
    Ended(MotionEnd),
}

/// How a motion ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MotionEnd {
    /// At the end of its trajectory.
    Reached,
    /// At a contact, as asked for.
    Contact,
    /// By the lag rule: the tip was more than [`MAX_LAG_M`] behind.
    Lag,
}

/// A command that the cell refuses.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CellError {
    /// One motion at a time.
    #[error("a motion is under way")]
    Busy,
    /// A trajectory starts elsewhere.
    #[error(
        "the trajectory starts at {}, the arm is at {}",
        joints_text(start),
        joints_text(present)
    )]
    Jump {
        /// First joint position of the trajectory, in rad.
        start: Joints,
        /// Present joint position, in rad.
        present: Joints,
    },
    /// The physics left the finite numbers.
    #[error("the state of a body became non-finite")]
    Broken,
}

#[derive(Debug)]
struct Motion {
    trajectory: JointTrajectory,
    until_contact: bool,
    steps: u64,
    phase: Phase,
}

#[derive(Clone, Copy, Debug)]
enum Phase {
    Moving,
    /// The trajectory is over, the tip is still behind.
    CatchingUp(u64),
    /// Home with nothing held.
    Settling(Rest),
}

/// How long all bodies have been slow, and how long that was waited for.
#[derive(Clone, Copy, Debug, Default)]
struct Rest {
    slow: u64,
    waited: u64,
}

impl Rest {
    /// Looks at the world after a step; says whether waiting is over.
    fn is_over(&mut self, world: &World) -> bool {
        self.waited += 1;
        self.slow = if world.fastest_m_s() < REST_SPEED_M_S {
            self.slow + 1
        } else {
            0
        };
        self.slow >= REST_STEPS || self.waited >= MAX_SETTLE_STEPS
    }

    fn rests(&self) -> bool {
        self.slow >= REST_STEPS
    }
}

/// What an action would do: how it would end, and arm and bodies afterwards.
pub struct Rehearsal {
    outcome: Outcome,
    world: World,
    joints: Joints,
    suction: bool,
    settled: bool,
}

impl Rehearsal {
    /// How the action would end.
    pub fn outcome(&self) -> Outcome {
        self.outcome
    }

    /// The bodies afterwards.
    pub fn world(&self) -> &World {
        &self.world
    }
}

/// A work cell in simulation.
///
/// Simulated time advances in [`Self::tick`] and [`Self::settle`] only. A motion that ends with
/// the arm at home and nothing held is reported as ended when all bodies have come to rest, so
/// that both ways to drive the cell, tick by tick and through [`Robot`], give the same times and states.
pub struct Cell {
    work_cell: WorkCell,
    world: World,
    joints: Joints,
    motion: Option<Motion>,
    suction: bool,
    settled: bool,
    camera_rig: CameraRig,
}

impl Cell {
    /// An empty table, the arm at home.
    pub fn new(work_cell: &WorkCell) -> Self {
        let cameras = work_cell.cameras.iter();
        let cameras = cameras.map(|(name, world_from_camera)| Camera {
            name: name.clone(),
            intrinsics: Intrinsics::RAVENS,
            world_from_camera: *world_from_camera,
        });
        let joints = work_cell.arm.home;
        Self {
            world: World::new(&work_cell.arm.tip(&joints)),
            camera_rig: CameraRig::new(cameras.collect()),
            work_cell: work_cell.clone(),
            joints,
            motion: None,
            suction: false,
            settled: false,
        }
    }

    /// A work cell with these bodies on its table.
    #[cfg(test)]
    pub(crate) fn around(world: &World) -> Self {
        let work_cell = WorkCell::builtin().expect("the work cell of this repository");
        let mut cell = Self::new(&work_cell);
        cell.world = world.clone();
        cell
    }

    /// Clears the table and puts the arm at home, for another episode.
    pub fn clear(&mut self) {
        self.joints = self.work_cell.arm.home;
        self.world = World::new(&self.work_cell.arm.tip(&self.joints));
        self.motion = None;
        self.suction = false;
        self.settled = false;
    }

    /// The arm and the cameras.
    pub fn work_cell(&self) -> &WorkCell {
        &self.work_cell
    }

    /// What is on the table.
    pub fn world(&self) -> &World {
        &self.world
    }

    /// What is on the table, to set up a scene.
    pub fn world_mut(&mut self) -> &mut World {
        self.settled = false;
        &mut self.world
    }

    /// Present joint positions.
    pub fn joint_positions(&self) -> Joints {
        self.joints
    }

    /// Whether the arm is out of the cameras' sight.
    pub fn is_home(&self) -> bool {
        (self.joints - self.work_cell.arm.home).amax() < HOME_TOLERANCE_RAD
    }

    /// Whether a motion is under way.
    pub fn is_moving(&self) -> bool {
        self.motion.is_some()
    }

    /// Whether all bodies have come to rest since something last moved.
    pub fn is_settled(&self) -> bool {
        self.settled
    }

    /// Simulated time since the table was cleared.
    pub fn time(&self) -> Duration {
        self.world.time()
    }

    /// Whether suction is switched on.
    pub fn suction(&self) -> bool {
        self.suction
    }

    /// Whether the vacuum sensor says that something is held.
    pub fn is_holding(&self) -> bool {
        self.world.held().is_some()
    }

    /// Switches suction. Takes no simulated time.
    pub fn set_suction(&mut self, on: bool) {
        if on && !self.suction {
            self.world.grasp();
        } else if !on {
            self.world.release();
        }
        self.suction = on;
        self.settled = false;
    }

    /// Begins to follow a trajectory, to its end or `until_contact`.
    pub fn begin(
        &mut self,
        trajectory: JointTrajectory,
        until_contact: bool,
    ) -> Result<(), CellError> {
        if self.motion.is_some() {
            return Err(CellError::Busy);
        }
        let start = trajectory.sample(Duration::ZERO);
        // Not "further than": NaN is refused, too.
        let near = (start - self.joints).amax() <= START_TOLERANCE_RAD;
        if !near {
            let present = self.joints;
            return Err(CellError::Jump { start, present });
        }
        self.settled = false;
        self.motion = Some(Motion {
            trajectory,
            until_contact,
            steps: 0,
            phase: Phase::Moving,
        });
        Ok(())
    }

    /// Stops where the arm is; says whether there was a motion to stop.
    pub fn cancel(&mut self) -> bool {
        self.motion.take().is_some()
    }

    /// One physics step of the motion under way.
    pub fn tick(&mut self) -> Result<Tick, CellError> {
        let Some(mut motion) = self.motion.take() else {
            return Ok(Tick::Idle);
        };
        motion.steps += 1;
        let elapsed = world::time_of(motion.steps);
        if let Phase::Moving = motion.phase {
            self.joints = motion.trajectory.sample(elapsed);
        }
        self.step()?;
        let lag_m = self.world.lag_m();
        let ended = match &mut motion.phase {
            Phase::Settling(rest) => {
                let over = rest.is_over(&self.world);
                self.settled = rest.rests();
                over.then_some(MotionEnd::Reached)
            }
            _ if motion.until_contact && self.world.touches() => Some(MotionEnd::Contact),
            _ if lag_m > MAX_LAG_M && motion.steps > SPRING_BACK_STEPS => Some(MotionEnd::Lag),
            Phase::Moving => {
                if elapsed >= motion.trajectory.duration() {
                    motion.phase = Phase::CatchingUp(0);
                }
                None
            }
            Phase::CatchingUp(waited) => {
                *waited += 1;
                let over = lag_m < CAUGHT_UP_M || *waited >= CATCH_UP_STEPS;
                if over && self.is_home() && self.world.held().is_none() {
                    motion.phase = Phase::Settling(Rest::default());
                    None
                } else {
                    over.then_some(MotionEnd::Reached)
                }
            }
        };
        Ok(match ended {
            Some(end) => Tick::Ended(end),
            None => {
                self.motion = Some(motion);
                Tick::Moving
            }
        })
    }

    /// Lets all bodies come to rest; says whether they did within 10 s of simulated time.
    pub fn settle(&mut self) -> Result<bool, CellError> {
        if self.motion.is_some() {
            return Err(CellError::Busy);
        }
        let mut rest = Rest::default();
        loop {
            self.step()?;
            if rest.is_over(&self.world) {
                self.settled = rest.rests();
                return Ok(self.settled);
            }
        }
    }

    /// One physics step in which the arm stands still; whether the bodies are settled stays as it was known.
    ///
    /// # Errors
    /// While a motion is under way.
    pub fn pass_time(&mut self) -> Result<(), CellError> {
        if self.motion.is_some() {
            return Err(CellError::Busy);
        }
        self.step()
    }

    /// Carries out an action on a copy of arm and bodies, which goes on as the cell would bit for bit.
    pub fn rehearse(
        &self,
        action: &PickPlace,
        settings: &PrimitiveSettings,
    ) -> Result<Rehearsal, ExecuteError<CellError>> {
        let mut copy = Self {
            work_cell: self.work_cell.clone(),
            world: self.world.clone(),
            joints: self.joints,
            motion: None,
            suction: self.suction,
            settled: self.settled,
            camera_rig: CameraRig::new(Vec::new()),
        };
        let arm = &self.work_cell.arm;
        let outcome = pick_place::execute(&mut copy, arm, action, settings, |_| ())?;
        Ok(Rehearsal {
            outcome,
            world: copy.world,
            joints: copy.joints,
            suction: copy.suction,
            settled: copy.settled,
        })
    }

    /// Goes on from where a rehearsal ended. It has to be one of this cell in its present state.
    pub(crate) fn adopt(&mut self, rehearsal: Rehearsal) -> Outcome {
        self.world = rehearsal.world;
        self.joints = rehearsal.joints;
        self.suction = rehearsal.suction;
        self.settled = rehearsal.settled;
        rehearsal.outcome
    }

    /// Lights the scene from another side and adds boxes that are seen and that nothing touches, until this is called again.
    pub fn perturb(&mut self, light: Vector3<f64>, clutter: Vec<ClutterItem>) {
        self.camera_rig.perturb(light, clutter);
    }

    /// What the cameras see now.
    pub fn render(&mut self) -> Result<&[RgbdImage], RenderError> {
        self.camera_rig
            .render(&self.work_cell, &self.joints, &self.world)
    }

    /// The images of the last [`Self::render`] with their cameras.
    pub fn views(&self) -> impl Iterator<Item = View<'_>> {
        self.camera_rig.views()
    }

    /// The cameras, in the order of [`Self::render`].
    pub fn cameras(&self) -> &[Camera] {
        self.camera_rig.cameras()
    }

    fn step(&mut self) -> Result<(), CellError> {
        self.world.step(&self.work_cell.arm.tip(&self.joints));
        if self.world.is_broken() {
            return Err(CellError::Broken);
        }
        Ok(())
    }

    /// Carries out a motion to its end, looked at after every physics step.
    fn run<E: From<CellError>>(
        &mut self,
        trajectory: &JointTrajectory,
        until_contact: bool,
        watch: &mut impl FnMut(&mut Self) -> Result<(), E>,
    ) -> Result<MotionEnd, E> {
        self.begin(trajectory.clone(), until_contact)?;
        loop {
            let tick = self.tick()?;
            watch(self)?;
            if let Tick::Ended(end) = tick {
                return Ok(end);
            }
        }
    }
}

impl Robot for Cell {
    type Error = CellError;

    fn joints(&mut self) -> Result<Joints, CellError> {
        Ok(self.joints)
    }

    fn follow(&mut self, trajectory: &JointTrajectory) -> Result<bool, CellError> {
        let end = self.run(trajectory, false, &mut |_| Ok::<_, CellError>(()))?;
        Ok(end == MotionEnd::Reached)
    }

    fn follow_until_contact(&mut self, trajectory: &JointTrajectory) -> Result<bool, CellError> {
        let end = self.run(trajectory, true, &mut |_| Ok::<_, CellError>(()))?;
        Ok(end == MotionEnd::Contact)
    }

    fn set_suction(&mut self, on: bool) -> Result<(), CellError> {
        Cell::set_suction(self, on);
        Ok(())
    }

    fn holds(&mut self) -> Result<bool, CellError> {
        Ok(self.is_holding())
    }
}

/// A cell as [`Robot`] that is looked at after every physics step: to film it, or to measure.
pub struct Watched<'a, F> {
    /// The cell.
    pub cell: &'a mut Cell,
    /// What looks; its error ends the motion.
    pub watch: F,
}

impl<F, E> Robot for Watched<'_, F>
where
    F: FnMut(&mut Cell) -> Result<(), E>,
    E: From<CellError>,
{
    type Error = E;

    fn joints(&mut self) -> Result<Joints, E> {
        Ok(self.cell.joints)
    }

    fn follow(&mut self, trajectory: &JointTrajectory) -> Result<bool, E> {
        let end = self.cell.run(trajectory, false, &mut self.watch)?;
        Ok(end == MotionEnd::Reached)
    }

    fn follow_until_contact(&mut self, trajectory: &JointTrajectory) -> Result<bool, E> {
        let end = self.cell.run(trajectory, true, &mut self.watch)?;
        Ok(end == MotionEnd::Contact)
    }

    fn set_suction(&mut self, on: bool) -> Result<(), E> {
        Cell::set_suction(self.cell, on);
        Ok(())
    }

    fn holds(&mut self) -> Result<bool, E> {
        Ok(self.cell.is_holding())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::{BodyId, Mobility, Part, Shape};
    use nalgebra::{Isometry2, Isometry3, Vector2};
    use ur5::Arm;

    const DISK_HEIGHT_M: f64 = 0.012;

    fn cell() -> Cell {
        Cell::new(&WorkCell::builtin().unwrap())
    }

    fn add_disk(cell: &mut Cell, x: f64, y: f64) -> BodyId {
        cell.world_mut().add(&Part {
            shape: Shape::Cylinder {
                radius_m: 0.026,
                length_m: DISK_HEIGHT_M,
            },
            pose: Isometry3::translation(x, y, DISK_HEIGHT_M / 2.0),
            mobility: Mobility::Free {
                mass_kg: 0.02,
                suction_force_n: 5.0,
            },
            friction: 0.5,
            rgb: [255; 3],
        })
    }

    fn line(cell: &Cell, x: f64, y: f64, z: f64, speed: f64) -> JointTrajectory {
        let tip = Arm::tip_down(&Isometry2::new(Vector2::new(x, y), 0.0), z);
        let arm = &cell.work_cell().arm;
        JointTrajectory::line(arm, &cell.joint_positions(), &tip, speed, 2.5).unwrap()
    }

    fn fly(cell: &mut Cell, x: f64, y: f64, z: f64) {
        let arm = &cell.work_cell().arm;
        let tip = Arm::tip_down(&Isometry2::new(Vector2::new(x, y), 0.0), z);
        let to = arm.solve(&tip, &cell.joint_positions()).unwrap();
        let trajectory = JointTrajectory::joint_space(arm, &cell.joint_positions(), &to).unwrap();
        assert!(cell.follow(&trajectory).unwrap());
    }

    fn go_home(cell: &mut Cell) -> JointTrajectory {
        let arm = &cell.work_cell().arm;
        JointTrajectory::joint_space(arm, &cell.joint_positions(), &arm.home).unwrap()
    }

    fn tip_height(cell: &Cell) -> f64 {
        cell.work_cell()
            .arm
            .tip(&cell.joint_positions())
            .translation
            .z
    }

    #[test]
    fn a_descent_stops_where_the_tip_touches() {
        let mut cell = cell();
        fly(&mut cell, 0.5, 0.1, 0.05);
        let down = line(&cell, 0.5, 0.1, -0.02, 0.1);
        assert!(cell.follow_until_contact(&down).unwrap());
        assert!(tip_height(&cell).abs() < 1e-3, "{}", tip_height(&cell));
        // The table cannot be gripped.
        cell.set_suction(true);
        assert!(!cell.is_holding());
    }

    #[test]
    fn a_descent_above_the_table_meets_nothing() {
        let mut cell = cell();
        fly(&mut cell, 0.5, 0.1, 0.05);
        let down = line(&cell, 0.5, 0.1, 0.005, 0.1);
        assert!(!cell.follow_until_contact(&down).unwrap());
    }

    #[test]
    fn a_disk_is_carried_and_set_down() {
        let mut cell = cell();
        let disk = add_disk(&mut cell, 0.5, 0.1);
        assert!(cell.settle().unwrap());
        fly(&mut cell, 0.51, 0.1, 0.05);
        let down = line(&cell, 0.51, 0.1, -0.02, 0.1);
        assert!(cell.follow_until_contact(&down).unwrap());
        assert!((tip_height(&cell) - DISK_HEIGHT_M).abs() < 1e-3);
        cell.set_suction(true);
        assert!(cell.is_holding());
        for (x, y, z) in [(0.51, 0.1, 0.08), (0.4, -0.2, 0.08)] {
            let to = line(&cell, x, y, z, 0.5);
            assert!(cell.follow(&to).unwrap());
        }
        assert!(cell.world().position(disk).z > 0.05);
        let down = line(&cell, 0.4, -0.2, -0.02, 0.1);
        assert!(cell.follow_until_contact(&down).unwrap());
        cell.set_suction(false);
        assert!(!cell.is_holding());
        let up = line(&cell, 0.4, -0.2, 0.08, 0.5);
        assert!(cell.follow(&up).unwrap());
        assert!(!cell.is_settled());
        let home = go_home(&mut cell);
        assert!(cell.follow(&home).unwrap());
        assert!(cell.is_home() && cell.is_settled());
        let off = cell.world().position(disk) - nalgebra::Point3::new(0.39, -0.2, 0.006);
        assert!(off.norm() < 1e-3, "{off}");
    }

    #[test]
    fn pressing_into_the_table_stops_by_the_lag_rule() {
        let mut cell = cell();
        fly(&mut cell, 0.5, 0.1, 0.05);
        let down = line(&cell, 0.5, 0.1, -0.05, 0.1);
        assert!(!cell.follow(&down).unwrap());
        assert!((tip_height(&cell) + MAX_LAG_M).abs() < 2e-3);
    }

    #[test]
    fn ticks_and_whole_motions_give_the_same_bits() {
        let scene = || {
            let mut cell = cell();
            add_disk(&mut cell, 0.5, 0.1);
            cell.settle().unwrap();
            cell
        };
        let (mut whole, mut ticked) = (scene(), scene());
        let arm = whole.work_cell().arm.clone();
        let tip = Arm::tip_down(&Isometry2::new(Vector2::new(0.47, 0.1), 0.0), 0.006);
        let to = arm.solve(&tip, &arm.home).unwrap();
        // Sweeps the disk aside.
        let out = JointTrajectory::joint_space(&arm, &arm.home, &to).unwrap();
        let back = JointTrajectory::joint_space(&arm, &to, &arm.home).unwrap();
        for trajectory in [&out, &back] {
            whole.follow(trajectory).unwrap();
            ticked.begin(trajectory.clone(), false).unwrap();
            let mut ticks = 0;
            while ticked.tick().unwrap() == Tick::Moving {
                ticks += 1;
            }
            assert!(ticks > 100);
            assert_eq!(ticked.tick().unwrap(), Tick::Idle);
            assert_eq!(whole.time(), ticked.time());
            assert_eq!(whole.joint_positions(), ticked.joint_positions());
            assert_eq!(whole.world().state_hash(), ticked.world().state_hash());
        }
        assert!(whole.is_settled() && ticked.is_settled());
    }

    #[test]
    fn only_one_motion_at_a_time_and_only_from_where_the_arm_is() {
        let mut cell = cell();
        let arm = cell.work_cell().arm.clone();
        let away = arm.home + Joints::repeat(0.2);
        let there = JointTrajectory::joint_space(&arm, &away, &arm.home).unwrap();
        assert!(matches!(
            cell.begin(there, false),
            Err(CellError::Jump { .. })
        ));
        let out = JointTrajectory::joint_space(&arm, &arm.home, &away).unwrap();
        cell.begin(out.clone(), false).unwrap();
        cell.tick().unwrap();
        assert_eq!(cell.begin(out, false), Err(CellError::Busy));
        assert_eq!(cell.settle(), Err(CellError::Busy));
        assert!(cell.cancel() && !cell.cancel());
        assert_eq!(cell.tick(), Ok(Tick::Idle));
    }

    #[test]
    fn a_rehearsal_foretells_the_bits_and_leaves_the_cell_as_it_is() {
        let mut cell = cell();
        add_disk(&mut cell, 0.5, 0.0);
        add_disk(&mut cell, 0.51, 0.08);
        cell.settle().unwrap();
        let at = |x, y| Isometry2::new(Vector2::new(x, y), 0.0);
        // On the rim of the other disk, from where it falls.
        let action = PickPlace {
            pick: at(0.505, 0.0),
            place: at(0.5, 0.05),
        };
        let settings = PrimitiveSettings {
            clearance_m: 0.08,
            lift_m: 0.05,
            travel_m_s: 1.2,
            carry_m_s: 0.8,
            descend_m_s: 0.2,
            acceleration_m_s2: 4.0,
        };
        let before = cell.world().state_hash();
        let foretold = cell.rehearse(&action, &settings).unwrap();
        assert_eq!(cell.world().state_hash(), before);
        let arm = cell.work_cell().arm.clone();
        let done = pick_place::execute(&mut cell, &arm, &action, &settings, |_| ()).unwrap();
        assert_eq!(foretold.outcome(), done);
        assert_eq!(foretold.world().state_hash(), cell.world().state_hash());
        assert_ne!(foretold.world().state_hash(), before);
    }

    #[test]
    fn simulated_time_stands_still_between_motions() {
        let mut cell = cell();
        cell.settle().unwrap();
        let time = cell.time();
        cell.set_suction(true);
        cell.render().unwrap();
        assert_eq!(cell.tick(), Ok(Tick::Idle));
        assert_eq!(cell.time(), time);
    }
}
