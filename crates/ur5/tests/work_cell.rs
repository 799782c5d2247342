//! The cell of urdf/workcell.urdf: what it says, and that the arm fits into it.

use nalgebra::{
    Isometry2, Isometry3, Point3, Quaternion, Translation3, Unit, UnitQuaternion, Vector2, Vector3,
};
use proptest::prelude::*;
use std::path::Path;
use ur5::{Arm, Body, DhLengths, JointTrajectory, Joints, Shape, WorkCell};

const URDF: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../urdf/workcell.urdf");

fn cell() -> WorkCell {
    WorkCell::load(Path::new(URDF)).unwrap()
}

/// Poses over the workspace of 0.5 x 1 m, tool down.
fn grid(heights_m: &[f64]) -> Vec<Isometry3<f64>> {
    let mut poses = Vec::new();
    for x in 0..=5 {
        for y in 0..=10 {
            let at = Vector2::new(0.25 + 0.1 * f64::from(x), -0.5 + 0.1 * f64::from(y));
            for height_m in heights_m {
                poses.push(Arm::tip_down(&Isometry2::new(at, 0.0), *height_m));
            }
        }
    }
    poses
}

/// The generic way: every joint of the file in turn, knowing nothing of a UR5.
fn pose_by_urdf(
    robot: &urdf_rs::Robot,
    link: &str,
    angles: &dyn Fn(&str) -> f64,
) -> Isometry3<f64> {
    let Some(joint) = robot.joints.iter().find(|joint| joint.child.link == link) else {
        return Isometry3::identity();
    };
    let [x, y, z] = joint.origin.xyz.0;
    let [roll, pitch, yaw] = joint.origin.rpy.0;
    let origin = Isometry3::from_parts(
        Translation3::new(x, y, z),
        UnitQuaternion::from_euler_angles(roll, pitch, yaw),
    );
    let axis = Unit::new_normalize(Vector3::from(joint.axis.xyz.0));
    let turn = UnitQuaternion::from_axis_angle(&axis, angles(&joint.name));
    pose_by_urdf(robot, &joint.parent.link, angles) * origin * turn
}

proptest! {
    #[test]
    fn forward_kinematics_agrees_with_the_urdf(q in prop::array::uniform6(-6.0..6.0f64)) {
        let cell = cell();
        let robot = urdf_rs::read_file(URDF).unwrap();
        let angles = |name: &str| cell.joint_names.iter().position(|joint| joint == name).map_or(0.0, |i| q[i]);
        let expected = pose_by_urdf(&robot, "suction_tip", &angles).to_homogeneous();
        let tip = cell.arm.tip(&Joints::from(q)).to_homogeneous();
        prop_assert!((tip - expected).amax() < 1e-12, "{tip} {expected}");
        let mut bodies = cell.shapes(&Joints::from(q));
        for link in &robot.links {
            for visual in &link.visual {
                let (body, pose) = bodies.next().unwrap();
                prop_assert_eq!(&body.link, &link.name);
                let at = Point3::from(visual.origin.xyz.0);
                let expected = pose_by_urdf(&robot, &link.name, &angles) * at;
                prop_assert!((pose.translation.vector - expected.coords).norm() < 1e-12);
            }
        }
        prop_assert!(bodies.next().is_none());
    }
}

#[test]
fn the_compiled_in_cell_is_the_one_in_the_file() {
    let (builtin, file) = (WorkCell::builtin().unwrap(), cell());
    assert_eq!(builtin.visuals, file.visuals);
    assert_eq!(builtin.cameras, file.cameras);
}

#[test]
fn the_arm_has_the_published_lengths_of_a_ur5() {
    assert_eq!(cell().arm.lengths, DhLengths::UR5);
    let names = [
        "shoulder_pan_joint",
        "shoulder_lift_joint",
        "elbow_joint",
        "wrist_1_joint",
        "wrist_2_joint",
        "wrist_3_joint",
    ];
    assert_eq!(cell().joint_names, names);
}

#[test]
fn the_cameras_are_those_of_ravens() {
    let expected = [
        (
            "front",
            [1.0, 0.0, 0.75],
            [0.65328, 0.65328, -0.2706, -0.2706],
            [0.25, 0.0],
        ),
        (
            "left",
            [0.0, 0.5, 0.75],
            [-0.3596, 0.86816, -0.31599, 0.13089],
            [0.445, 0.055],
        ),
        (
            "right",
            [0.0, -0.5, 0.75],
            [-0.86816, 0.3596, -0.13089, 0.31599],
            [0.445, -0.055],
        ),
    ];
    let cell = cell();
    assert_eq!(cell.cameras.len(), 3);
    for ((name, pose), (expected_name, [x, y, z], [i, j, k, w], looks_at)) in
        cell.cameras.iter().zip(expected)
    {
        assert_eq!(name, expected_name);
        assert_eq!(pose.translation.vector, Vector3::new(x, y, z));
        let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, i, j, k));
        assert!(pose.rotation.angle_to(&rotation) < 1e-4, "{name}");
        let forward = pose.rotation * Vector3::z();
        let hit = pose.translation.vector - forward * (z / forward.z);
        assert!(
            (hit.xy() - Vector2::from(looks_at)).norm() < 1e-3,
            "{name} {hit}"
        );
    }
}

#[test]
fn the_top_of_the_table_is_zero_and_holds_the_workspace() {
    let cell = cell();
    let (table, pose) = cell
        .shapes(&cell.arm.home)
        .find(|(body, _)| body.link == "table")
        .unwrap();
    assert_eq!(
        pose.translation.z + table.shape.extent_m(&Vector3::z()),
        0.0
    );
    for tip in grid(&[-1e-3]) {
        let point = Point3::from(tip.translation.vector);
        assert!(
            table
                .shape
                .distance_m(&pose.inverse_transform_point(&point))
                < 0.0
        );
    }
}

#[test]
fn at_home_nothing_stands_between_a_camera_and_the_workspace() {
    for (file, _) in ARMS {
        assert_nothing_is_hidden(file, &cell_of(file));
    }
}

fn assert_nothing_is_hidden(file: &str, cell: &WorkCell) {
    let bodies: Vec<_> = cell
        .shapes(&cell.arm.home)
        .filter(|(body, _)| body.link != "table")
        .collect();
    assert!(
        bodies
            .iter()
            .filter(|(body, _)| body.moving_link.is_some())
            .count()
            > 15
    );
    let margin_m = 0.01;
    for (name, camera) in &cell.cameras {
        let eye = Point3::from(camera.translation.vector);
        for tip in grid(&[0.0, 0.1, 0.2, 0.28]) {
            let way = tip.translation.vector - eye.coords;
            let length_m = way.norm();
            // From just before the lens, in steps that distances allow to take at once.
            let mut travelled_m = 0.02;
            while travelled_m < length_m {
                let point = eye + way * (travelled_m / length_m);
                let (nearest, distance_m) = nearest(&bodies, &point);
                assert!(
                    distance_m > margin_m,
                    "{file}: {} hides {} from the {name} camera",
                    nearest.link,
                    tip.translation
                );
                travelled_m += distance_m - 0.5 * margin_m;
            }
        }
    }
}

fn nearest<'a>(bodies: &[(&'a Body, Isometry3<f64>)], point: &Point3<f64>) -> (&'a Body, f64) {
    bodies
        .iter()
        .map(|(body, pose)| {
            (
                *body,
                body.shape.distance_m(&pose.inverse_transform_point(point)),
            )
        })
        .min_by(|a, b| a.1.total_cmp(&b.1))
        .unwrap()
}

/// Joint positions on the ways from home to everywhere over the workspace, ends included.
fn ways_from_home(cell: &WorkCell) -> Vec<(Joints, Isometry3<f64>)> {
    let arm = &cell.arm;
    let mut positions = vec![(arm.home, arm.tip(&arm.home))];
    for tip in grid(&[0.0, 0.06, 0.1, 0.16, 0.24]) {
        // The far corners are out of reach higher up.
        let Ok(joints) = arm.solve(&tip, &arm.ready) else {
            assert!(
                tip.translation.vector.xy().norm() > 0.78 && tip.translation.z > 0.06,
                "{tip}"
            );
            continue;
        };
        let way = JointTrajectory::joint_space(arm, &arm.home, &joints).unwrap();
        for step in 0..=20 {
            positions.push((way.sample(way.duration() * step / 20), tip));
        }
    }
    positions
}

#[test]
fn on_the_way_from_home_no_link_hits_table_camera_or_another_link() {
    let cell = cell();
    for (joints, end) in ways_from_home(&cell) {
        let tip = cell.arm.tip(&joints);
        assert!(
            tip.translation.z > end.translation.z - 0.01,
            "the tip dips to {} on the way to {}",
            tip.translation,
            end.translation
        );
        let bodies: Vec<_> = cell.posed(&cell.collisions, &joints).collect();
        for (body, pose) in bodies.iter().filter(|(body, _)| body.moving_link.is_some()) {
            let down = pose.inverse_transform_vector(&-Vector3::z());
            let lowest_m = pose.translation.z - body.shape.extent_m(&down);
            assert!(lowest_m > -1e-3, "{} goes down to {lowest_m} m", body.link);
            for (name, camera) in &cell.cameras {
                let eye = pose.inverse_transform_point(&Point3::from(camera.translation.vector));
                assert!(
                    body.shape.distance_m(&eye) > 0.15,
                    "{} nears the {name} camera",
                    body.link
                );
            }
            for (other, other_pose) in &bodies {
                // Neighbours touch by design; table and cameras are checked above.
                let fixed = other.moving_link.is_none() && other.link != "base_link_inertia";
                let index = |body: &Body| body.moving_link.map_or(0, |link| link + 1);
                if fixed || index(body).abs_diff(index(other)) < 2 {
                    continue;
                }
                for point in surface(&body.shape) {
                    let point = other_pose.inverse_transform_point(&(pose * point));
                    let distance_m = other.shape.distance_m(&point);
                    assert!(distance_m > 0.0, "{} meets {}", body.link, other.link);
                }
            }
        }
    }
}

/// Points on a cylinder.
fn surface(shape: &Shape) -> impl Iterator<Item = Point3<f64>> {
    let Shape::Cylinder { radius_m, length_m } = *shape else {
        panic!("the arm is made of cylinders");
    };
    (0..12).flat_map(move |i| {
        let (sin, cos) = (f64::from(i) * std::f64::consts::TAU / 12.0).sin_cos();
        (0..=6).map(move |j| {
            Point3::new(
                radius_m * cos,
                radius_m * sin,
                length_m * (f64::from(j) / 6.0 - 0.5),
            )
        })
    })
}

#[test]
fn what_is_wrong_with_a_urdf_is_named() {
    let text = std::fs::read_to_string(URDF).unwrap();
    let refusal = |from: &str, to: &str| {
        assert!(text.contains(from), "{from}");
        let error = WorkCell::parse(&text.replace(from, to), "cell.urdf")
            .unwrap_err()
            .to_string();
        assert!(error.starts_with("cell.urdf: "), "{error}");
        error
    };
    let cases = [
        ("xyz=\"-0.425 0 0\"", "xyz=\"-0.425 0.03 0\"", "elbow_joint"),
        ("0 0 0.089159", "0.1 0 0.089159", "shoulder_pan_joint"),
        (
            "xyz=\"-0.425 0 0\"",
            "xyz=\"-0.425 nan 0\"",
            "elbow_joint is not finite",
        ),
        (
            "xyz=\"-0.425 0 0\"",
            "xyz=\"0 0 0\"",
            "upper arm has no length",
        ),
        ("<link name=\"suction_tip\"/>", "", "suction_tip"),
        (
            "name=\"elbow_joint\" type=\"revolute\"",
            "name=\"elbow_joint\" type=\"prismatic\"",
            "elbow_joint is not revolute",
        ),
        (
            "name=\"elbow_joint\" type=\"revolute\"",
            "name=\"elbow_joint\" type=\"fixed\"",
            "six moving joints",
        ),
        ("_camera_optical_frame", "_eye", "at least one camera"),
        (
            "<child link=\"table\"/>",
            "<child link=\"base_link\"/>",
            "hangs on both",
        ),
        (
            "<parent link=\"world\"/><child link=\"table\"/>",
            "<parent link=\"table\"/><child link=\"table\"/>",
            "circle",
        ),
        (
            "lower=\"-3.141592653589793\"",
            "lower=\"4\"",
            "limits of joint elbow_joint",
        ),
        (
            "lower=\"-3.141592653589793\"",
            "lower=\"2.9\"",
            "exclude the home position",
        ),
        (
            "<cylinder radius=\"0.01\"",
            "<cylinder radius=\"-0.01\"",
            "suction_gripper",
        ),
        ("0.12 0.12 0.12 1", "12 12 12 1", "0..1"),
        (
            "<link name=\"flange\"/>",
            "<link name=\"flange\"/><link name=\"flange\"/>",
            "two links are named flange",
        ),
        ("parent link=\"tool0\"", "parent link=\"tool1\"", "tool1"),
        ("</robot>", "", ""),
    ];
    for (from, to, expected) in cases {
        let error = refusal(from, to);
        assert!(
            error.contains(expected),
            "{error:?} does not name {expected:?}"
        );
    }
    let error = WorkCell::load(Path::new("no/such.urdf"))
        .unwrap_err()
        .to_string();
    assert!(error.starts_with("no/such.urdf: "), "{error}");
}

#[test]
fn an_arm_of_seven_joints_is_refused_with_their_names() {
    let text = std::fs::read_to_string(URDF).unwrap();
    // A joint more, between the flange and the tool.
    let fixed = r#"<joint name="tool0-suction_gripper" type="fixed">"#;
    assert!(text.contains(fixed));
    let seventh = r#"<joint name="wrist_4_joint" type="revolute"><axis xyz="0 0 1"/>
        <limit lower="-3" upper="3" effort="28" velocity="3"/>"#;
    let error = WorkCell::parse(&text.replace(fixed, seventh), "arm_of_seven.urdf")
        .unwrap_err()
        .to_string();
    for expected in [
        "arm_of_seven.urdf: ",
        "expected six moving joints",
        "shoulder_pan_joint",
        "wrist_4_joint",
    ] {
        assert!(error.contains(expected), "{error}");
    }
}

#[test]
fn meshes_are_left_out_with_one_warning_and_a_missing_color_is_grey() {
    let text = std::fs::read_to_string(URDF).unwrap();
    let plain = cell();
    assert_eq!((plain.skipped.len(), plain.warning()), (0, None));
    // As published descriptions of arms have it: a mesh for the eye, one for collisions, no material.
    let mesh = "<geometry><mesh filename=\"package://arm/meshes/extra.dae\" scale=\"0.001 0.001 0.001\"/></geometry>";
    let extra = format!(
        "<link name=\"extra\"><visual>{mesh}</visual><collision>{mesh}</collision></link>\
         <link name=\"bare\"><visual><geometry><sphere radius=\"0.02\"/></geometry></visual></link>\
         <joint name=\"to_extra\" type=\"fixed\"><parent link=\"world\"/><child link=\"extra\"/></joint>\
         <joint name=\"to_bare\" type=\"fixed\"><parent link=\"world\"/><child link=\"bare\"/></joint></robot>"
    );
    let with = WorkCell::parse(&text.replace("</robot>", &extra), "cell.urdf").unwrap();
    assert_eq!(with.skipped, ["extra"]);
    let warning = with.warning().unwrap();
    assert!(
        warning.contains("extra") && warning.contains("box"),
        "{warning}"
    );
    let bare: Vec<_> = with
        .visuals
        .iter()
        .filter(|body| body.link == "bare")
        .collect();
    assert_eq!((bare.len(), bare[0].rgb), (1, [128; 3]));
    assert_eq!(with.visuals.len(), plain.visuals.len() + 1);
    assert_eq!(with.collisions.len(), plain.collisions.len());
    // A material that is named and never described.
    let gum = text.replace(
        "<material name=\"rubber\"><color",
        "<material name=\"gum\"><color",
    );
    let gum = WorkCell::parse(&gum, "cell.urdf").unwrap();
    assert!(gum.visuals.iter().any(|body| body.rgb == [128; 3]));
}

#[test]
fn the_frames_of_the_links_lead_from_the_world_to_the_tip() {
    let cell = cell();
    assert_eq!(cell.root(), "world");
    assert_eq!(
        cell.frames
            .iter()
            .filter(|frame| frame.joint.is_some())
            .count(),
        6
    );
    for joints in [cell.arm.home, cell.arm.ready, Joints::repeat(0.3)] {
        let (mut at, mut pose) = ("suction_tip", Isometry3::identity());
        while at != "world" {
            let frame = cell.frames.iter().find(|frame| frame.child == at).unwrap();
            pose = frame.pose(&joints) * pose;
            at = &frame.parent;
        }
        let apart = pose.inv_mul(&cell.arm.tip(&joints));
        assert!(
            apart.translation.vector.norm() < 1e-9 && apart.rotation.angle() < 1e-9,
            "{apart}"
        );
    }
}

/// The arms of `urdf/`, by the name of their file and of their model.
const ARMS: [(&str, DhLengths); 4] = [
    ("workcell.urdf", DhLengths::UR5),
    ("workcell_ur3e.urdf", DhLengths::UR3E),
    ("workcell_ur5e.urdf", DhLengths::UR5E),
    ("workcell_ur10e.urdf", DhLengths::UR10E),
];

fn cell_of(file: &str) -> WorkCell {
    WorkCell::load(&Path::new(URDF).with_file_name(file)).unwrap()
}

#[test]
fn every_shipped_arm_has_its_published_lengths_and_reaches_its_share_of_the_workspace() {
    for (file, lengths) in ARMS {
        let cell = cell_of(file);
        assert_eq!(cell.arm.lengths, lengths, "{file}");
        assert!(cell.arm.is_nominal(), "{file}");
        let poses = grid(&[0.0, 0.06]);
        let reached = poses
            .iter()
            .filter(|tip| cell.arm.solve(tip, &cell.arm.ready).is_ok())
            .count();
        // The UR3e is an arm for the near half.
        let (least, most) = match file {
            "workcell_ur3e.urdf" => (30, 70),
            _ => (132, 132),
        };
        assert!(
            (least..=most).contains(&reached),
            "{file}: {reached} of {}",
            poses.len()
        );
        assert!(
            cell.arm
                .tip(&cell.arm.ready)
                .rotation
                .angle_to(&poses[0].rotation)
                < 2.0
        );
    }
}

/// Of the size of one that a factory writes.
const CALIBRATION: &str = "
kinematics:
  shoulder: {x: 0, y: 0, z: 0.16272, roll: -0, pitch: 0, yaw: 5.7e-08}
  upper_arm: {x: 0.000182, y: 0, z: 0, roll: 1.571315, pitch: 0, yaw: 1.1e-06}
  forearm: {x: -0.42517, y: 0, z: 0, roll: 3.140148, pitch: 3.141167, yaw: 3.141588}
  wrist_1: {x: -0.39265, y: -0.0004, z: 0.133106, roll: 0.003028, pitch: -0.001186, yaw: -2.6e-06}
  wrist_2: {x: -7.1e-06, y: -0.099604, z: -3.2e-07, roll: 1.5708, pitch: 0, yaw: 1.3e-06}
  wrist_3: {x: 1.4e-05, y: 0.099585, z: 9.5e-05, roll: 1.571752, pitch: 3.141592653589793, yaw: 3.1415925}
  hash: calib_14698139022496758595
";

#[test]
fn a_calibrated_arm_moves_as_its_calibration_says() {
    let nominal = cell_of("workcell_ur5e.urdf");
    let calibration = ur5::ArmCalibration::parse(CALIBRATION, "calibration.yaml").unwrap();
    assert_eq!(
        calibration.hash.as_deref(),
        Some("calib_14698139022496758595")
    );
    let cell = nominal.with_calibration(&calibration).unwrap();
    assert!(!cell.arm.is_nominal());
    let robot = urdf_rs::read_from_string(&cell.urdf).unwrap();
    let (mut least, mut most) = (f64::INFINITY, 0.0f64);
    for tip in grid(&[0.0, 0.06]) {
        let joints = cell.arm.solve(&tip, &cell.arm.ready).unwrap();
        let angles = |name: &str| {
            cell.joint_names
                .iter()
                .position(|joint| joint == name)
                .map_or(0.0, |i| joints[i])
        };
        // The URDF that is handed on says the same as the arm.
        let by_urdf = pose_by_urdf(&robot, "suction_tip", &angles);
        assert!((by_urdf.translation.vector - tip.translation.vector).norm() < 1e-6);
        let off_m = (nominal.arm.tip(&joints).translation.vector - tip.translation.vector).norm();
        (least, most) = (least.min(off_m), most.max(off_m));
    }
    // What the drawing would have missed by.
    assert!(
        least > 1e-4 && (5e-4..0.01).contains(&most),
        "{least} to {most} m"
    );
    let line =
        JointTrajectory::line(&cell.arm, &cell.arm.ready, &grid(&[0.05])[60], 0.3, 2.0).unwrap();
    assert!(
        (cell.arm.tip(&line.last().positions_rad).translation.vector
            - grid(&[0.05])[60].translation.vector)
            .norm()
            < 1e-6
    );
}

#[test]
fn a_calibration_of_another_robot_or_without_sense_is_refused_by_name() {
    let parse = |text: &str| ur5::ArmCalibration::parse(text, "my_calibration.yaml");
    let calibration = parse(CALIBRATION).unwrap();
    for (file, _) in ARMS.iter().filter(|(file, _)| !file.contains("ur5e")) {
        let error = cell_of(file)
            .with_calibration(&calibration)
            .unwrap_err()
            .to_string();
        assert!(
            error.starts_with("my_calibration.yaml: ")
                && error.contains("another robot")
                && error.contains("ur5e"),
            "{error}"
        );
    }
    for (from, to, expected) in [
        ("wrist_2:", "wrist_4:", "wrist_4"),
        ("z: 0.16272", "z: .nan", "kinematics.shoulder"),
        ("z: 0.16272", "z: tall", "kinematics"),
        ("kinematics:", "dynamics:", "kinematics"),
    ] {
        let error = parse(&CALIBRATION.replace(from, to))
            .unwrap_err()
            .to_string();
        assert!(
            error.starts_with("my_calibration.yaml: ") && error.contains(expected),
            "{error}"
        );
    }
    // A joint tilted by more than factories do.
    let tilted = parse(&CALIBRATION.replace("roll: 1.571315", "roll: 1.65")).unwrap();
    let error = cell_of("workcell_ur5e.urdf")
        .with_calibration(&tilted)
        .unwrap_err()
        .to_string();
    assert!(error.contains("shoulder_lift_joint"), "{error}");
}
