//! Writes the work cell with the other arms: `cargo run --release -p ur5 --example arms -- urdf/`.
//!
//! Lengths are the published ones; radii of the links are those of the UR5 in `workcell.urdf`, scaled by estimate, and enclose the arms.

use std::fmt::Write as _;
use ur5::DhLengths;

/// What the published lengths do not say.
struct Arm {
    name: &'static str,
    lengths: DhLengths,
    /// Upper arm and forearm along the axis of the shoulder lift, from the base's axis (m). Source: `mesh_offset` in the visual parameters of
    /// the UR driver's description.
    upper_arm_m: f64,
    forearm_m: f64,
    /// Radii, relative to the UR5's.
    scale: f64,
    /// rad/s and Nm of the joints. Source: joint limits of the UR driver's description, from the user manuals.
    speeds_rad_s: [f64; 6],
    efforts_nm: [f64; 6],
}

const HALF: f64 = 2.0943951023931953;
const PI: f64 = std::f64::consts::PI;
const TAU: f64 = std::f64::consts::TAU;

const ARMS: [Arm; 3] = [
    Arm {
        name: "ur3e",
        lengths: DhLengths::UR3E,
        upper_arm_m: 0.12,
        forearm_m: 0.027,
        scale: 0.85,
        speeds_rad_s: [PI, PI, PI, TAU, TAU, TAU],
        efforts_nm: [56.0, 56.0, 28.0, 12.0, 12.0, 12.0],
    },
    Arm {
        name: "ur5e",
        lengths: DhLengths::UR5E,
        upper_arm_m: 0.138,
        forearm_m: 0.007,
        scale: 1.08,
        speeds_rad_s: [PI; 6],
        efforts_nm: [150.0, 150.0, 150.0, 28.0, 28.0, 28.0],
    },
    Arm {
        name: "ur10e",
        lengths: DhLengths::UR10E,
        upper_arm_m: 0.1762,
        forearm_m: 0.0393,
        scale: 1.3,
        speeds_rad_s: [HALF, HALF, PI, PI, PI, PI],
        efforts_nm: [330.0, 330.0, 150.0, 56.0, 56.0, 56.0],
    },
];

const START: &str = "  <link name=\"base_link_inertia\">";
const END: &str = "  <link name=\"flange\"/>";

/// Where, turned how, radius (m), length (m), material.
type Cylinder = ([f64; 3], &'static str, f64, f64, &'static str);

/// A length as short as it can be written.
fn short(value: f64) -> String {
    let rounded = (value * 1e6).round() / 1e6;
    if rounded == 0.0 {
        "0".into()
    } else {
        rounded.to_string()
    }
}

fn cylinder(text: &mut String, at: [f64; 3], rpy: &str, radius_m: f64, length_m: f64, color: &str) {
    let origin = format!(
        "<origin xyz=\"{} {} {}\" rpy=\"{rpy}\"/>",
        short(at[0]),
        short(at[1]),
        short(at[2])
    );
    let geometry = format!(
        "<geometry><cylinder radius=\"{}\" length=\"{}\"/></geometry>",
        short(radius_m),
        short(length_m)
    );
    let _ = writeln!(
        text,
        "    <visual>{origin}{geometry}<material name=\"{color}\"/></visual>"
    );
    let _ = writeln!(text, "    <collision>{origin}{geometry}</collision>");
}

fn arm(arm: &Arm) -> String {
    let DhLengths {
        d1_m,
        a2_m,
        a3_m,
        d4_m,
        d5_m,
        d6_m,
    } = arm.lengths;
    let radius = |ur5_m: f64| ur5_m * arm.scale;
    let (upright, across, along) = ("0 0 0", "1.5707963267948966 0 0", "0 1.5707963267948966 0");
    let links: [(&str, Vec<Cylinder>); 7] = [
        (
            "base_link_inertia",
            vec![([0.0, 0.0, 0.025], upright, radius(0.075), 0.05, "ur_dark")],
        ),
        (
            "shoulder_link",
            vec![
                ([0.0; 3], upright, radius(0.06), radius(0.11), "ur_grey"),
                (
                    [0.0, -0.02 * arm.scale, 0.0],
                    across,
                    radius(0.055),
                    radius(0.13),
                    "ur_blue",
                ),
            ],
        ),
        (
            "upper_arm_link",
            vec![
                (
                    [0.0, 0.0, arm.upper_arm_m],
                    upright,
                    radius(0.055),
                    radius(0.11),
                    "ur_blue",
                ),
                (
                    [0.5 * a2_m, 0.0, arm.upper_arm_m],
                    along,
                    radius(0.048),
                    -a2_m,
                    "ur_grey",
                ),
                (
                    [a2_m, 0.0, arm.upper_arm_m - 0.026 * arm.scale],
                    upright,
                    radius(0.055),
                    radius(0.11),
                    "ur_blue",
                ),
            ],
        ),
        (
            "forearm_link",
            vec![
                (
                    [0.0, 0.0, arm.forearm_m],
                    upright,
                    radius(0.047),
                    radius(0.09),
                    "ur_blue",
                ),
                (
                    [0.5 * a3_m, 0.0, arm.forearm_m],
                    along,
                    radius(0.037),
                    -a3_m,
                    "ur_grey",
                ),
                (
                    [a3_m, 0.0, arm.forearm_m],
                    upright,
                    radius(0.04),
                    radius(0.08),
                    "ur_blue",
                ),
            ],
        ),
        (
            "wrist_1_link",
            vec![
                (
                    [0.0, 0.0, -0.01],
                    upright,
                    radius(0.036),
                    radius(0.09),
                    "ur_grey",
                ),
                (
                    [0.0, 0.03 - d5_m, 0.0],
                    across,
                    radius(0.034),
                    0.06,
                    "ur_blue",
                ),
            ],
        ),
        (
            "wrist_2_link",
            vec![
                (
                    [0.0, 0.0, -0.01],
                    upright,
                    radius(0.036),
                    radius(0.09),
                    "ur_grey",
                ),
                (
                    [0.0, d6_m - 0.025, 0.0],
                    across,
                    radius(0.034),
                    0.05,
                    "ur_blue",
                ),
            ],
        ),
        (
            "wrist_3_link",
            vec![([0.0, 0.0, -0.015], upright, radius(0.0375), 0.03, "ur_dark")],
        ),
    ];
    let joints = [
        ("shoulder_pan_joint", [0.0, 0.0, d1_m], "0 0 0"),
        ("shoulder_lift_joint", [0.0; 3], across),
        ("elbow_joint", [a2_m, 0.0, 0.0], "0 0 0"),
        ("wrist_1_joint", [a3_m, 0.0, d4_m], "0 0 0"),
        ("wrist_2_joint", [0.0, -d5_m, 0.0], across),
        (
            "wrist_3_joint",
            [0.0, d6_m, 0.0],
            "1.5707963267948966 3.141592653589793 3.141592653589793",
        ),
    ];
    let mut text = String::new();
    for (i, (link, shapes)) in links.iter().enumerate() {
        if i > 0 {
            let (joint, [x, y, z], rpy) = joints[i - 1];
            let limit = if joint == "elbow_joint" { PI } else { TAU };
            let _ = write!(
                text,
                "  <joint name=\"{joint}\" type=\"revolute\">\n    <parent link=\"{}\"/><child link=\"{link}\"/>\n    \
                 <origin xyz=\"{} {} {}\" rpy=\"{rpy}\"/><axis xyz=\"0 0 1\"/>\n    \
                 <limit lower=\"{}\" upper=\"{limit}\" effort=\"{}\" velocity=\"{}\"/>\n  </joint>\n",
                links[i - 1].0,
                short(x),
                short(y),
                short(z),
                -limit,
                arm.efforts_nm[i - 1],
                arm.speeds_rad_s[i - 1],
            );
        }
        let _ = writeln!(text, "  <link name=\"{link}\">");
        for (at, rpy, radius_m, length_m, color) in shapes {
            cylinder(&mut text, *at, rpy, *radius_m, *length_m, color);
        }
        text.push_str("  </link>\n");
        if i == 0 {
            text.push_str(
                "  <joint name=\"base_link-base_link_inertia\" type=\"fixed\"><parent link=\"base_link\"/><child link=\"base_link_inertia\"/>\
                 <origin xyz=\"0 0 0\" rpy=\"0 0 3.141592653589793\"/></joint>\n",
            );
        }
    }
    text
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = std::env::args().nth(1).ok_or("expected the folder urdf/")?;
    let folder = std::path::Path::new(&folder);
    let template = std::fs::read_to_string(folder.join("workcell.urdf"))?;
    let start = template
        .find(START)
        .ok_or("workcell.urdf has another layout")?;
    let end = template
        .find(END)
        .ok_or("workcell.urdf has another layout")?;
    for model in &ARMS {
        let name = model.name.to_uppercase().replace('E', "e");
        let text = format!("{}{}{}", &template[..start], arm(model), &template[end..]);
        let text = text.replace("UR5", &name).replacen(
            "     Joint names",
            "     Written by crates/ur5/examples/arms.rs from workcell.urdf.\n     Joint names",
            1,
        );
        std::fs::write(folder.join(format!("workcell_{}.urdf", model.name)), text)?;
    }
    Ok(())
}
