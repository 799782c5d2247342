//! The work cell as the parameters say: which arm, where its joints sit, and how it may move.

use anyhow::Context as _;
use ur5::WorkCell;

use crate::parameters::SuctionExecutorParameters;

/// Reads the URDF, puts the arm's joints where its calibration says, and limits its motions.
///
/// # Errors
/// Names the parameter, and the file where it is one.
pub(crate) fn load(parameters: &SuctionExecutorParameters) -> anyhow::Result<WorkCell> {
    let mut cell = node_kit::load_work_cell(&parameters.urdf)?
        .with_calibration_file(&parameters.arm_calibration)
        .context("parameter arm_calibration")?;
    let joints = &parameters.joints;
    cell.arm
        .set_motion_limits(joints.acceleration_rad_s2, joints.jerk_rad_s3)
        .context("parameters joints.acceleration_rad_s2 and joints.jerk_rad_s3")?;
    if joints.hose_turn_rad > 0.0 {
        cell.arm
            .set_hose_limit(joints.hose_turn_rad)
            .context("parameter joints.hose_turn_rad")?;
    }
    Ok(cell)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use nalgebra::{Isometry2, Vector2};
    use ur5::{Arm, Joints};

    use super::*;
    use crate::parameters::JointLimits;

    fn parameters(urdf: &str) -> SuctionExecutorParameters {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../urdf");
        SuctionExecutorParameters {
            urdf: folder.join(urdf),
            ..SuctionExecutorParameters::default()
        }
    }

    /// Of the size of one that a factory writes, for a UR5e.
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
    fn without_a_calibration_and_limits_the_arm_is_that_of_the_demonstrations() {
        let cell = load(&SuctionExecutorParameters::default()).unwrap();
        let builtin = WorkCell::builtin().unwrap().arm;
        assert!(cell.arm.is_nominal());
        assert_eq!(cell.arm.limits_rad, builtin.limits_rad);
        assert_eq!(
            (cell.arm.max_acceleration_rad_s2, cell.arm.max_jerk_rad_s3),
            (builtin.max_acceleration_rad_s2, builtin.max_jerk_rad_s3)
        );
    }

    #[test]
    fn the_arm_plans_with_its_calibration_and_one_of_another_robot_is_refused_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let arm_calibration = folder.path().join("my_robot_calibration.yaml");
        std::fs::write(&arm_calibration, CALIBRATION).unwrap();
        let given = SuctionExecutorParameters {
            arm_calibration: arm_calibration.clone(),
            ..parameters("workcell_ur5e.urdf")
        };
        let (arm, nominal) = (
            load(&given).unwrap().arm,
            load(&parameters("workcell_ur5e.urdf")).unwrap().arm,
        );
        assert!(!arm.is_nominal());
        let tip = Arm::tip_down(&Isometry2::new(Vector2::new(0.5, 0.2), 0.3), 0.05);
        let joints = arm.solve(&tip, &arm.ready).unwrap();
        let off_m =
            |arm: &Arm| (arm.tip(&joints).translation.vector - tip.translation.vector).norm();
        assert!(off_m(&arm) < 1e-6, "{} m", off_m(&arm));
        assert!(off_m(&nominal) > 1e-4, "{} m", off_m(&nominal));

        let of_another = SuctionExecutorParameters {
            arm_calibration,
            ..parameters("workcell_ur10e.urdf")
        };
        // The calibration of the cameras is another file.
        let of_cameras = SuctionExecutorParameters {
            arm_calibration: Path::new(env!("CARGO_MANIFEST_DIR"))
                .join("../../config/calibration.yaml"),
            ..parameters("workcell_ur5e.urdf")
        };
        for (given, expected) in [
            (
                of_another,
                ["my_robot_calibration.yaml", "another robot", "ur5e"],
            ),
            (
                of_cameras,
                ["config/calibration.yaml", "kinematics", "ur_calibration"],
            ),
        ] {
            let error = format!("{:#}", load(&given).unwrap_err());
            for expected in ["parameter arm_calibration"].iter().chain(&expected) {
                assert!(error.contains(expected), "{error}");
            }
        }
    }

    #[test]
    fn limits_of_the_joints_are_those_of_the_arm_and_without_sense_they_are_refused_by_name() {
        let with = |joints| SuctionExecutorParameters {
            joints,
            ..SuctionExecutorParameters::default()
        };
        let arm = load(&with(JointLimits {
            acceleration_rad_s2: 5.0,
            jerk_rad_s3: 50.0,
            hose_turn_rad: 3.5,
        }))
        .unwrap()
        .arm;
        assert_eq!(arm.max_acceleration_rad_s2, Joints::repeat(5.0));
        assert_eq!(arm.max_jerk_rad_s3, Joints::repeat(50.0));
        let (lower, upper) = arm.limits_rad;
        let home = arm.home[5];
        assert_eq!((lower[5], upper[5]), (home - 3.5, home + 3.5));
        for (joints, expected) in [
            (
                JointLimits {
                    hose_turn_rad: 1.0,
                    ..JointLimits::default()
                },
                ["joints.hose_turn_rad", "3.1416 or more"],
            ),
            (
                JointLimits {
                    acceleration_rad_s2: 0.0,
                    ..JointLimits::default()
                },
                ["joints.acceleration_rad_s2", "more than 0"],
            ),
        ] {
            let error = format!("{:#}", load(&with(joints)).unwrap_err());
            for expected in expected {
                assert!(error.contains(expected), "{error}");
            }
        }
    }
}
