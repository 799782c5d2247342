//! The work cell from urdf/.

use crate::{Arm, ArmCalibration, DhLengths, Joints};
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use std::collections::BTreeMap;
use std::path::Path;
use urdf_rs::{Geometry, JointType};

/// What the URDF says about the cell.
#[derive(Clone, Debug)]
pub struct WorkCell {
    /// The arm.
    pub arm: Arm,
    /// Names of the arm's joints, in order, as in `joint_states` and trajectories.
    pub joint_names: [String; 6],
    /// Name and pose of each camera's optical frame in the world, in the order of the URDF.
    pub cameras: Vec<(String, Isometry3<f64>)>,
    /// What is seen, in the order of the URDF.
    pub visuals: Vec<Body>,
    /// What collides, in the order of the URDF.
    pub collisions: Vec<Body>,
    /// Where each link but the root hangs, in the order of the URDF.
    pub frames: Vec<Frame>,
    /// Links with shapes that are no primitives (meshes, capsules), in the order of the URDF, each once. Those shapes are
    /// neither in `visuals` nor in `collisions`.
    pub skipped: Vec<String>,
    /// The URDF itself, for who draws the cell.
    pub urdf: String,
}

/// A link as a frame on the link below.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Name of the link below.
    pub parent: String,
    /// Name of the link.
    pub child: String,
    /// Which of the arm's joints moves it, 0 to 5; none when it is fixed.
    pub joint: Option<usize>,
    /// Pose on the link below, where that joint is at 0.
    pub origin: Isometry3<f64>,
}

impl Frame {
    /// Pose on the link below at a joint position.
    pub fn pose(&self, joints: &Joints) -> Isometry3<f64> {
        let angle_rad = self.joint.map_or(0.0, |joint| joints[joint]);
        self.origin * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), angle_rad)
    }
}

/// A primitive shape, centred on its frame; lengths in m.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// A box with these edges.
    Cuboid {
        /// Edge lengths along x, y and z.
        size_m: Vector3<f64>,
    },
    /// A cylinder along z.
    Cylinder {
        /// Radius.
        radius_m: f64,
        /// Length.
        length_m: f64,
    },
    /// A ball.
    Sphere {
        /// Radius.
        radius_m: f64,
    },
}

impl Shape {
    /// Distance in m from a point in the shape's frame to its surface, negative inside.
    pub fn distance_m(&self, point: &Point3<f64>) -> f64 {
        let outside =
            |beyond: Vector3<f64>| beyond.sup(&Vector3::zeros()).norm() + beyond.max().min(0.0);
        match self {
            Self::Cuboid { size_m } => outside(point.coords.abs() - 0.5 * size_m),
            Self::Cylinder { radius_m, length_m } => {
                let radial = point.coords.xy().norm() - radius_m;
                // Twice the same: a cylinder has two directions, not three.
                outside(Vector3::new(
                    radial,
                    radial.min(0.0),
                    point.z.abs() - 0.5 * length_m,
                ))
            }
            Self::Sphere { radius_m } => point.coords.norm() - radius_m,
        }
    }

    /// How far, in m, the shape reaches from its centre along a unit vector in its frame.
    pub fn extent_m(&self, along: &Vector3<f64>) -> f64 {
        match self {
            Self::Cuboid { size_m } => 0.5 * along.abs().dot(size_m),
            Self::Cylinder { radius_m, length_m } => {
                radius_m * along.xy().norm() + 0.5 * length_m * along.z.abs()
            }
            Self::Sphere { radius_m } => *radius_m,
        }
    }
}

/// A shape on a link.
#[derive(Clone, Debug, PartialEq)]
pub struct Body {
    /// Name of the link.
    pub link: String,
    /// The shape.
    pub shape: Shape,
    /// Colour.
    pub rgb: [u8; 3],
    /// Which of the arm's moving links carries it: 0 (shoulder) to 5 (flange and gripper), or
    /// none when it stands still.
    pub moving_link: Option<usize>,
    /// Pose of the shape in the frame of that moving link, or in the world.
    pub pose: Isometry3<f64>,
}

/// Why a URDF does not describe a work cell.
#[derive(Debug, thiserror::Error)]
pub enum WorkCellError {
    /// The file cannot be read or parsed.
    #[error("{path}: {reason}")]
    Unreadable {
        /// The file.
        path: String,
        /// What the parser said.
        reason: String,
    },
    /// A link or joint that the cell needs is missing or of another kind.
    #[error("{path}: {expected}")]
    Missing {
        /// The file.
        path: String,
        /// What was expected.
        expected: String,
    },
}

/// Where the arm rests: folded back over its own base, tool down, outside every line of sight
/// from the cameras to the workspace.
const HOME_DEG: [f64; 6] = [0.0, -160.0, 120.0, -50.0, -90.0, -90.0];
/// The UR3e is too short to fold that way: its gripper would touch its own upper arm. It rests behind its base.
const HOME_UR3E_DEG: [f64; 6] = [-180.0, -80.0, 80.0, -90.0, -90.0, -90.0];
/// Over the middle of the workspace, elbow up, tool down; of the UR5. Arms of other lengths take the solution nearest to it for the same pose.
const READY_DEG: [f64; 6] = [-13.0, -80.0, 105.0, -115.0, -90.0, -103.0];
/// Where a joint's frame is nearer to that of the drawing (m and rad), the difference is rounding in the URDF.
const ROUNDING: f64 = 1e-9;
/// How far (m) and by how much (rad) a factory calibration may move a joint's frame on the one before it.
const CALIBRATION_M: f64 = 0.02;
const CALIBRATION_RAD: f64 = 0.05;

/// Where the tip of an arm of other lengths is when it is ready.
const READY_OVER_M: [f64; 2] = [0.35, 0.0];
const READY_HEIGHT_M: f64 = 0.1;

const URDF: &str = include_str!("../../../urdf/workcell.urdf");

impl WorkCell {
    /// The cell of `urdf/workcell.urdf`, as it was when this was compiled.
    ///
    /// # Errors
    /// As [`Self::parse`].
    pub fn builtin() -> Result<Self, WorkCellError> {
        Self::parse(URDF, "urdf/workcell.urdf")
    }

    /// Reads a URDF.
    ///
    /// # Errors
    /// When it cannot be read, or as [`Self::parse`].
    pub fn load(path: &Path) -> Result<Self, WorkCellError> {
        let name = path.display().to_string();
        let text = std::fs::read_to_string(path).map_err(|error| WorkCellError::Unreadable {
            path: name.clone(),
            reason: error.to_string(),
        })?;
        Self::parse(&text, &name)
    }

    /// As [`Self::load`]; [`Self::builtin`] where the path is empty.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn load_or_builtin(path: &Path) -> Result<Self, WorkCellError> {
        if path.as_os_str().is_empty() {
            return Self::builtin();
        }
        Self::load(path)
    }

    /// As [`Self::with_calibration`], from a file; the same cell where the path is empty.
    ///
    /// # Errors
    /// As [`ArmCalibration::load`] and [`Self::with_calibration`].
    pub fn with_calibration_file(self, path: &Path) -> Result<Self, WorkCellError> {
        if path.as_os_str().is_empty() {
            return Ok(self);
        }
        self.with_calibration(&ArmCalibration::load(path)?)
    }

    /// The same cell with the arm's joints where its factory calibration says.
    ///
    /// # Errors
    /// When the calibration is one of another arm.
    pub fn with_calibration(&self, calibration: &ArmCalibration) -> Result<Self, WorkCellError> {
        let refuse = |expected| WorkCellError::Missing {
            path: calibration.path.clone(),
            expected,
        };
        let unreadable = |error: urdf_rs::UrdfError| refuse(error.to_string());
        let mut robot = urdf_rs::read_from_string(&self.urdf).map_err(unreadable)?;
        let found = DhLengths::of_origins(&calibration.origins);
        let difference_m = found.difference_m(&self.arm.lengths);
        if difference_m > CALIBRATION_M {
            let name = |lengths: &DhLengths| lengths.model().unwrap_or("arm of unknown lengths");
            return Err(refuse(format!(
                "this is the calibration of another robot: that of a {}, expected one of the {} of the URDF (a length differs by {:.1} mm)",
                name(&found),
                name(&self.arm.lengths),
                1000.0 * difference_m,
            )));
        }
        for (joint, origin) in self.joint_names.iter().zip(&calibration.origins) {
            let Some(joint) = robot.joints.iter_mut().find(|other| other.name == *joint) else {
                return Err(refuse(format!("the URDF has no joint {joint}")));
            };
            let (roll, pitch, yaw) = origin.rotation.euler_angles();
            joint.origin.xyz.0 = origin.translation.vector.into();
            joint.origin.rpy.0 = [roll, pitch, yaw];
        }
        let urdf = urdf_rs::write_to_string(&robot).map_err(unreadable)?;
        Self::from_robot(&robot, &urdf).map_err(refuse)
    }

    /// Reads the text of a URDF. It must hold a chain of six revolute joints with a UR arm's
    /// geometry, calibrated or not, up to a link `suction_tip`, by way of a link `tool0`; links named
    /// `NAME_camera_optical_frame` are cameras; everything else is fixed. Shapes that are no
    /// primitives are left out and their links named in [`Self::skipped`]; a shape without a
    /// colour is grey. `path` names the text in errors.
    ///
    /// # Errors
    /// Says what is missing or wrong.
    pub fn parse(text: &str, path: &str) -> Result<Self, WorkCellError> {
        let robot = urdf_rs::read_from_string(text).map_err(|error| WorkCellError::Unreadable {
            path: path.into(),
            reason: error.to_string(),
        })?;
        Self::from_robot(&robot, text).map_err(|expected| WorkCellError::Missing {
            path: path.into(),
            expected,
        })
    }

    fn from_robot(robot: &urdf_rs::Robot, text: &str) -> Result<Self, String> {
        let tree = Tree::new(robot)?;
        let arm_joints = tree.arm_joints()?;
        let arm = read_arm(&tree, &arm_joints)?;
        let mut cell = Self {
            arm,
            joint_names: arm_joints.map(|joint| joint.name.clone()),
            cameras: Vec::new(),
            visuals: Vec::new(),
            collisions: Vec::new(),
            frames: Vec::new(),
            skipped: Vec::new(),
            urdf: text.to_owned(),
        };
        for joint in &robot.joints {
            cell.frames.push(Frame {
                parent: joint.parent.link.clone(),
                child: joint.child.link.clone(),
                joint: cell.joint_names.iter().position(|name| *name == joint.name),
                origin: read_pose(&joint.origin, &joint.name)?,
            });
        }
        let mut colors = BTreeMap::new();
        for material in &robot.materials {
            if let Some(color) = &material.color {
                colors.insert(material.name.as_str(), color.rgba.0);
            }
        }
        for link in &robot.links {
            let (moving_link, link_pose) = tree.carrier(&link.name, &arm_joints)?;
            if let Some(name) = link.name.strip_suffix("_camera_optical_frame") {
                if moving_link.is_some() {
                    return Err(format!(
                        "camera link {} rides on the arm, expected it fixed",
                        link.name
                    ));
                }
                cell.cameras.push((name.into(), link_pose));
            }
            let body = |geometry, origin, rgb| {
                let pose = link_pose * read_pose(origin, &link.name)?;
                let shape = read_shape(geometry, &link.name)?;
                Ok::<_, String>(shape.map(|shape| Body {
                    link: link.name.clone(),
                    shape,
                    rgb,
                    moving_link,
                    pose,
                }))
            };
            let mut skipped = false;
            for visual in &link.visual {
                let rgb = read_color(visual.material.as_ref(), &colors, &link.name)?;
                match body(&visual.geometry, &visual.origin, rgb)? {
                    Some(body) => cell.visuals.push(body),
                    None => skipped = true,
                }
            }
            for collision in &link.collision {
                match body(&collision.geometry, &collision.origin, [0; 3])? {
                    Some(body) => cell.collisions.push(body),
                    None => skipped = true,
                }
            }
            if skipped {
                cell.skipped.push(link.name.clone());
            }
        }
        if cell.cameras.is_empty() {
            return Err("no link NAME_camera_optical_frame, expected at least one camera".into());
        }
        Ok(cell)
    }

    /// What a program that loads the cell should tell its user: which links have shapes that are left out. None when all shapes are used.
    pub fn warning(&self) -> Option<String> {
        (!self.skipped.is_empty()).then(|| {
            format!(
                "meshes and capsules of the links {} are left out, expected box, cylinder or sphere; they are neither drawn nor \
                 taken for obstacles",
                self.skipped.join(", ")
            )
        })
    }

    /// Name of the link that all others hang on.
    pub fn root(&self) -> &str {
        let is_child = |link: &str| self.frames.iter().any(|frame| frame.child == link);
        let mut parents = self.frames.iter().map(|frame| frame.parent.as_str());
        parents.find(|parent| !is_child(parent)).unwrap_or_default()
    }

    /// What is seen and where in the world at a joint position, for rendering.
    pub fn shapes<'a>(
        &'a self,
        joints: &Joints,
    ) -> impl Iterator<Item = (&'a Body, Isometry3<f64>)> + use<'a> {
        self.posed(&self.visuals, joints)
    }

    /// Poses in the world of bodies at a joint position.
    pub fn posed<'a>(
        &self,
        bodies: &'a [Body],
        joints: &Joints,
    ) -> impl Iterator<Item = (&'a Body, Isometry3<f64>)> + use<'a> {
        let links = self.arm.links(joints);
        bodies.iter().map(move |body| {
            let pose = body
                .moving_link
                .map_or(body.pose, |link| links[link] * body.pose);
            (body, pose)
        })
    }
}

/// The URDF as a tree.
struct Tree<'a> {
    /// The joint above each link.
    above: BTreeMap<&'a str, &'a urdf_rs::Joint>,
}

impl<'a> Tree<'a> {
    fn new(robot: &'a urdf_rs::Robot) -> Result<Self, String> {
        let mut links = std::collections::BTreeSet::new();
        for link in &robot.links {
            if !links.insert(link.name.as_str()) {
                return Err(format!("two links are named {}", link.name));
            }
        }
        let mut above = BTreeMap::new();
        for joint in &robot.joints {
            for link in [&joint.parent.link, &joint.child.link] {
                if !links.contains(link.as_str()) {
                    return Err(format!(
                        "joint {} names the link {link}, which does not exist",
                        joint.name
                    ));
                }
            }
            if let Some(other) = above.insert(joint.child.link.as_str(), joint) {
                return Err(format!(
                    "link {} hangs on both {} and {}",
                    joint.child.link, other.name, joint.name
                ));
            }
        }
        let tree = Self { above };
        let mut roots: Vec<_> = links
            .iter()
            .map(|link| tree.up(link))
            .collect::<Result<_, _>>()?;
        let mut roots: Vec<&str> = roots.iter_mut().map(|(root, _)| *root).collect();
        roots.sort_unstable();
        roots.dedup();
        match roots.as_slice() {
            [_] => Ok(tree),
            _ => Err(format!("expected one root link, found {roots:?}")),
        }
    }

    /// The root above a link, and the joints from the link up to it.
    fn up(&self, link: &'a str) -> Result<(&'a str, Vec<&'a urdf_rs::Joint>), String> {
        let mut joints = Vec::new();
        let mut at = link;
        while let Some(joint) = self.above.get(at) {
            joints.push(*joint);
            if joints.len() > self.above.len() {
                return Err(format!("the joints above link {link} form a circle"));
            }
            at = &joint.parent.link;
        }
        Ok((at, joints))
    }

    /// The six moving joints between the root and the suction tip.
    fn arm_joints(&self) -> Result<[&'a urdf_rs::Joint; 6], String> {
        if !self.above.contains_key("suction_tip") {
            return Err("no link suction_tip on a joint".into());
        }
        let (_, mut joints) = self.up("suction_tip")?;
        joints.retain(|joint| joint.joint_type != JointType::Fixed);
        joints.reverse();
        let names: Vec<&str> = joints.iter().map(|joint| joint.name.as_str()).collect();
        let joints: [_; 6] = joints.try_into().map_err(|_| {
            format!("expected six moving joints up to suction_tip, found {names:?}")
        })?;
        for joint in joints {
            if joint.joint_type != JointType::Revolute {
                return Err(format!("joint {} is not revolute", joint.name));
            }
            if joint.axis.xyz.0 != [0.0, 0.0, 1.0] {
                return Err(format!(
                    "axis of joint {} is {:?}, expected z",
                    joint.name, joint.axis.xyz.0
                ));
            }
        }
        Ok(joints)
    }

    /// Which of the arm's moving links carries a link, and the link's pose there or in the world.
    fn carrier(
        &self,
        link: &'a str,
        arm_joints: &[&urdf_rs::Joint; 6],
    ) -> Result<(Option<usize>, Isometry3<f64>), String> {
        let mut pose = Isometry3::identity();
        for joint in self.up(link)?.1 {
            if let Some(index) = arm_joints
                .iter()
                .position(|other| std::ptr::eq(*other, joint))
            {
                return Ok((Some(index), pose));
            }
            if joint.joint_type != JointType::Fixed {
                return Err(format!(
                    "joint {} moves but is no joint of the arm",
                    joint.name
                ));
            }
            pose = read_pose(&joint.origin, &joint.name)? * pose;
        }
        Ok((None, pose))
    }

    /// Pose of a joint's frame at zero in the frame of the moving link below it.
    fn origin(
        &self,
        joint: &'a urdf_rs::Joint,
        arm_joints: &[&urdf_rs::Joint; 6],
    ) -> Result<Isometry3<f64>, String> {
        let (_, parent) = self.carrier(&joint.parent.link, arm_joints)?;
        Ok(parent * read_pose(&joint.origin, &joint.name)?)
    }
}

fn read_arm<'a>(tree: &Tree<'a>, arm_joints: &[&'a urdf_rs::Joint; 6]) -> Result<Arm, String> {
    let (_, world_from_base) = tree.carrier(&arm_joints[0].parent.link, arm_joints)?;
    let mut origins = [Isometry3::identity(); 6];
    for (origin, joint) in origins.iter_mut().zip(arm_joints) {
        *origin = tree.origin(joint, arm_joints)?;
    }
    // The first origin counts from the base, not from the world.
    origins[0] = world_from_base.inv_mul(&origins[0]);
    let lengths = DhLengths::of_origins(&origins);
    let mut nominal = true;
    for ((found, expected), joint) in origins.iter().zip(lengths.joint_origins()).zip(arm_joints) {
        let shift = (found.translation.vector - expected.translation.vector).norm();
        let turn = found.rotation.angle_to(&expected.rotation);
        if shift > CALIBRATION_M || turn > CALIBRATION_RAD {
            return Err(format!(
                "joint {} sits at {found}, expected {expected} for the geometry of a UR arm, give or take the {CALIBRATION_M} m and \
                 {CALIBRATION_RAD} rad of a calibration",
                joint.name
            ));
        }
        nominal &= shift < ROUNDING && turn < ROUNDING;
    }
    if nominal {
        origins = lengths.joint_origins();
    }
    for (name, length) in [("upper arm", lengths.a2_m), ("forearm", lengths.a3_m)] {
        if length.abs() < CALIBRATION_M {
            return Err(format!("the {name} has no length"));
        }
    }
    let mut limits_rad = (Joints::zeros(), Joints::zeros());
    let mut max_speed_rad_s = Joints::zeros();
    for (i, joint) in arm_joints.iter().enumerate() {
        let limit = &joint.limit;
        let finite = [limit.lower, limit.upper, limit.velocity]
            .iter()
            .all(|value| value.is_finite());
        let in_order = limit.lower < limit.upper && limit.velocity > 0.0;
        if !(finite && in_order) {
            return Err(format!(
                "limits of joint {} are not finite, ordered and positive",
                joint.name
            ));
        }
        limits_rad.0[i] = limit.lower;
        limits_rad.1[i] = limit.upper;
        max_speed_rad_s[i] = limit.velocity;
    }
    let flange = |link: &'static str| match tree.carrier(link, arm_joints)? {
        (Some(5), pose) => Ok(pose),
        _ => Err(format!(
            "link {link} is not fixed to the last joint of the arm"
        )),
    };
    if !tree.above.contains_key("tool0") {
        return Err("no link tool0 on a joint".into());
    }
    let tool0 = flange("tool0")?;
    if tool0.translation.vector.norm() > 1e-6 || tool0.rotation.angle() > 1e-6 {
        return Err(format!(
            "link tool0 sits at {tool0} on the last joint, expected no offset"
        ));
    }
    let home_deg = match lengths.model() {
        Some("ur3e") => HOME_UR3E_DEG,
        _ => HOME_DEG,
    };
    let mut arm = Arm {
        world_from_base,
        flange_from_tip: flange("suction_tip")?,
        origins,
        nominal,
        lengths,
        limits_rad,
        max_speed_rad_s,
        max_acceleration_rad_s2: Joints::repeat(Arm::DEFAULT_ACCELERATION_RAD_S2),
        max_jerk_rad_s3: Joints::repeat(Arm::DEFAULT_JERK_RAD_S3),
        home: Joints::from(home_deg).map(f64::to_radians),
        ready: Joints::from(READY_DEG).map(f64::to_radians),
    };
    if !arm.within_limits(&arm.home) {
        return Err(format!(
            "joint limits exclude the home position {home_deg:?} degrees"
        ));
    }
    if lengths != DhLengths::UR5 {
        let over = nalgebra::Isometry2::new(nalgebra::Vector2::from(READY_OVER_M), 0.0);
        let tip = Arm::tip_down(&over, READY_HEIGHT_M);
        arm.ready = arm.solve(&tip, &arm.ready).map_err(|error| {
            format!("the arm does not reach the middle of the workspace: {error}")
        })?;
    }
    Ok(arm)
}

fn read_pose(pose: &urdf_rs::Pose, place: &str) -> Result<Isometry3<f64>, String> {
    let ([x, y, z], [roll, pitch, yaw]) = (pose.xyz.0, pose.rpy.0);
    if ![x, y, z, roll, pitch, yaw]
        .iter()
        .all(|value| value.is_finite())
    {
        return Err(format!("an origin of {place} is not finite"));
    }
    Ok(Isometry3::from_parts(
        Translation3::new(x, y, z),
        UnitQuaternion::from_euler_angles(roll, pitch, yaw),
    ))
}

/// None for a shape that is no primitive.
fn read_shape(geometry: &Geometry, link: &str) -> Result<Option<Shape>, String> {
    let shape = match *geometry {
        Geometry::Box { size } => Shape::Cuboid {
            size_m: Vector3::from(size.0),
        },
        Geometry::Cylinder { radius, length } => Shape::Cylinder {
            radius_m: radius,
            length_m: length,
        },
        Geometry::Sphere { radius } => Shape::Sphere { radius_m: radius },
        Geometry::Capsule { .. } | Geometry::Mesh { .. } => return Ok(None),
    };
    let lengths = match shape {
        Shape::Cuboid { size_m } => [size_m.x, size_m.y, size_m.z],
        Shape::Cylinder { radius_m, length_m } => [radius_m, length_m, 1.0],
        Shape::Sphere { radius_m } => [radius_m, 1.0, 1.0],
    };
    if !lengths
        .iter()
        .all(|length| *length > 0.0 && length.is_finite())
    {
        return Err(format!(
            "a shape of link {link} has a length that is not positive and finite"
        ));
    }
    Ok(Some(shape))
}

/// Of shapes whose colour the URDF does not say.
const GREY: [u8; 3] = [128; 3];

fn read_color(
    material: Option<&urdf_rs::Material>,
    named: &BTreeMap<&str, [f64; 4]>,
    link: &str,
) -> Result<[u8; 3], String> {
    let Some(material) = material else {
        return Ok(GREY);
    };
    let rgba = match (&material.color, named.get(material.name.as_str())) {
        (Some(color), _) => color.rgba.0,
        (None, Some(rgba)) => *rgba,
        (None, None) => return Ok(GREY),
    };
    if !rgba.iter().all(|value| (0.0..=1.0).contains(value)) {
        return Err(format!(
            "material {:?} of link {link} has a colour outside 0..1",
            material.name
        ));
    }
    Ok([rgba[0], rgba[1], rgba[2]].map(|value| (value * 255.0).round() as u8))
}
