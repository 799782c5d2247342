//! Poses, proposals, joints and trajectories.

use super::error::{all_finite, finite, positive, size, unexpected};
use super::{ConvertError, duration_from_msg, duration_to_msg, time_from_msg};
use crate::{geometry_msgs, sctn_msgs, sensor_msgs, std_msgs, trajectory_msgs, ur_msgs};
use ::pick_place::{Outcome, Phase, PickPlace, PrimitiveSettings};
use nalgebra::{Isometry2, Isometry3, Quaternion, Translation3, Unit, UnitQuaternion};
use std::f64::consts::TAU;
use std::time::Duration;
use step_protocol::StepOutcome;
use ur5::{JointTrajectory, Joints, TrajectoryPoint};

/// A pose in the plane with finite position and a yaw of at most one turn.
pub fn pose2d_from_msg(pose: &geometry_msgs::Pose2D) -> Result<Isometry2<f64>, ConvertError> {
    let yaw_rad = finite("theta", pose.theta)?;
    if yaw_rad.abs() > TAU {
        return Err(unexpected("theta", yaw_rad, "-2 pi to 2 pi"));
    }
    let position = nalgebra::Vector2::new(finite("x", pose.x)?, finite("y", pose.y)?);
    Ok(Isometry2::new(position, yaw_rad))
}

/// A pose in the plane. A rotation made from a yaw of at most one turn passes bit for bit, so that a proposal
/// moves the robot the same way whether or not it went through a message.
pub fn pose2d_to_msg(pose: &Isometry2<f64>) -> geometry_msgs::Pose2D {
    geometry_msgs::Pose2D {
        x: pose.translation.x,
        y: pose.translation.y,
        theta: step_protocol::yaw_rad(&pose.rotation),
    }
}

/// The poses of a proposal.
pub fn pick_place_from_msg(msg: &sctn_msgs::PickPlace) -> Result<PickPlace, ConvertError> {
    let pose = |field, pose| {
        pose2d_from_msg(pose).map_err(|source| ConvertError::Part {
            field,
            source: Box::new(source),
        })
    };
    Ok(PickPlace {
        pick: pose("pick", &msg.pick)?,
        place: pose("place", &msg.place)?,
    })
}

/// Heights and speeds, all of which must be positive.
pub fn settings_from_msg(
    msg: &sctn_msgs::PrimitiveSettings,
) -> Result<PrimitiveSettings, ConvertError> {
    Ok(PrimitiveSettings {
        clearance_m: positive("clearance_m", msg.clearance_m)?,
        lift_m: positive("lift_m", msg.lift_m)?,
        travel_m_s: positive("travel_m_s", msg.travel_m_s)?,
        carry_m_s: positive("carry_m_s", msg.carry_m_s)?,
        descend_m_s: positive("descend_m_s", msg.descend_m_s)?,
        acceleration_m_s2: positive("acceleration_m_s2", msg.acceleration_m_s2)?,
    })
}

/// Heights and speeds.
pub fn settings_to_msg(settings: &PrimitiveSettings) -> sctn_msgs::PrimitiveSettings {
    sctn_msgs::PrimitiveSettings {
        clearance_m: settings.clearance_m,
        lift_m: settings.lift_m,
        travel_m_s: settings.travel_m_s,
        carry_m_s: settings.carry_m_s,
        descend_m_s: settings.descend_m_s,
        acceleration_m_s2: settings.acceleration_m_s2,
    }
}

/// A constant of `StepResult`.
pub fn outcome_to_msg(outcome: Outcome) -> u8 {
    StepOutcome::from(outcome).code()
}

/// A constant of the feedback of `ExecutePickPlace`.
pub fn phase_to_msg(phase: Phase) -> u8 {
    use sctn_msgs::ExecutePickPlaceFeedback as Feedback;
    match phase {
        Phase::Approach => Feedback::APPROACH,
        Phase::DescendToPick => Feedback::DESCEND_TO_PICK,
        Phase::Grasp => Feedback::GRASP,
        Phase::Lift => Feedback::LIFT,
        Phase::CheckGrasp => Feedback::CHECK_GRASP,
        Phase::Transfer => Feedback::TRANSFER,
        Phase::DescendToPlace => Feedback::DESCEND_TO_PLACE,
        Phase::Release => Feedback::RELEASE,
        Phase::Retreat => Feedback::RETREAT,
        Phase::Home => Feedback::HOME,
    }
}

/// The outcome of a motion that was carried out; refused, rejected and failed ones have none.
pub fn outcome_from_msg(outcome: u8) -> Result<Outcome, ConvertError> {
    let motion = StepOutcome::from_repr(outcome).and_then(StepOutcome::motion);
    motion.ok_or_else(|| unexpected("outcome", outcome, "that of a motion, 1 to 5"))
}

/// How far the norm of a quaternion may be from 1, as tf2 has it.
const QUATERNION_TOLERANCE: f64 = 1e-3;

/// A pose; the quaternion must have length 1.
pub fn isometry_from_msg(
    transform: &geometry_msgs::Transform,
) -> Result<Isometry3<f64>, ConvertError> {
    let geometry_msgs::Transform {
        translation: t,
        rotation: q,
    } = transform;
    all_finite("translation", &[t.x, t.y, t.z])?;
    all_finite("rotation", &[q.x, q.y, q.z, q.w])?;
    let quaternion = Quaternion::new(q.w, q.x, q.y, q.z);
    let norm = quaternion.norm();
    if (norm - 1.0).abs() > QUATERNION_TOLERANCE {
        return Err(unexpected(
            "rotation",
            format!("of length {norm}"),
            "length 1",
        ));
    }
    // What is exact up to rounding stays as it is.
    let rotation: UnitQuaternion<f64> = if (norm - 1.0).abs() < 1e-12 {
        Unit::new_unchecked(quaternion)
    } else {
        Unit::new_normalize(quaternion)
    };
    Ok(Isometry3::from_parts(
        Translation3::new(t.x, t.y, t.z),
        rotation,
    ))
}

/// A pose.
pub fn isometry_to_msg(pose: &Isometry3<f64>) -> geometry_msgs::Transform {
    let (t, q) = (&pose.translation, &pose.rotation);
    geometry_msgs::Transform {
        translation: geometry_msgs::Vector3 {
            x: t.x,
            y: t.y,
            z: t.z,
        },
        rotation: geometry_msgs::Quaternion {
            x: q.i,
            y: q.j,
            z: q.k,
            w: q.w,
        },
    }
}

/// Joint positions in the order of `names`; the message may have them in any order, and others beside.
pub fn joints_from_msg(
    state: &sensor_msgs::JointState,
    names: &[impl AsRef<str>; 6],
) -> Result<Joints, ConvertError> {
    size("position", state.position.len(), state.name.len())?;
    let mut joints = Joints::zeros();
    for (joint, name) in joints.iter_mut().zip(names) {
        let name = name.as_ref();
        let index = state.name.iter().position(|other| other == name);
        let index = index.ok_or_else(|| {
            unexpected(
                "name",
                format!("{:?}", state.name),
                format!("{name} among them"),
            )
        })?;
        *joint = finite("position", state.position[index])?;
    }
    Ok(joints)
}

/// Positions and velocities of the joints at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointReading {
    /// Capture time.
    pub stamp: Duration,
    /// Positions.
    pub positions_rad: Joints,
    /// Velocities; zero where the message has none.
    pub velocities_rad_s: Joints,
}

/// Positions and velocities in the order of `names`; the message may have them in any order, and others beside.
pub fn joint_reading_from_msg(
    state: &sensor_msgs::JointState,
    names: &[impl AsRef<str>; 6],
) -> Result<JointReading, ConvertError> {
    let velocities_rad_s = if state.velocity.is_empty() {
        Joints::zeros()
    } else {
        let speeds = sensor_msgs::JointState {
            name: state.name.clone(),
            position: state.velocity.clone(),
            ..Default::default()
        };
        joints_from_msg(&speeds, names)?
    };
    Ok(JointReading {
        stamp: time_from_msg(&state.header.stamp)?,
        positions_rad: joints_from_msg(state, names)?,
        velocities_rad_s,
    })
}

/// The level of a digital pin, where the message says it.
pub fn pin_level(states: &[ur_msgs::Digital], pin: u8) -> Option<bool> {
    let found = states.iter().find(|state| state.pin == pin);
    found.map(|state| state.state)
}

/// Positions and velocities of the joints.
pub fn joint_state_to_msg(
    header: std_msgs::Header,
    names: &[impl AsRef<str>; 6],
    positions_rad: &Joints,
    velocities_rad_s: &Joints,
) -> sensor_msgs::JointState {
    sensor_msgs::JointState {
        header,
        name: names.iter().map(|name| name.as_ref().to_owned()).collect(),
        position: positions_rad.iter().copied().collect(),
        velocity: velocities_rad_s.iter().copied().collect(),
        effort: Vec::new(),
    }
}

/// A trajectory whose joints are `names` in this order, with positions and velocities at each point;
/// accelerations may be given and are not used.
pub fn joint_trajectory_from_msg(
    msg: &trajectory_msgs::JointTrajectory,
    names: &[impl AsRef<str>; 6],
) -> Result<JointTrajectory, ConvertError> {
    if !msg
        .joint_names
        .iter()
        .map(String::as_str)
        .eq(names.iter().map(AsRef::as_ref))
    {
        let expected: Vec<&str> = names.iter().map(AsRef::as_ref).collect();
        return Err(unexpected(
            "joint_names",
            format!("{:?}", msg.joint_names),
            format!("{expected:?}"),
        ));
    }
    let joints = |field, values: &[f64]| {
        size(field, values.len(), 6)?;
        all_finite(field, values)?;
        Ok::<_, ConvertError>(Joints::from_column_slice(values))
    };
    let point = |point: &trajectory_msgs::JointTrajectoryPoint| {
        for (field, values) in [
            ("points.accelerations", &point.accelerations),
            ("points.effort", &point.effort),
        ] {
            if !values.is_empty() {
                joints(field, values)?;
            }
        }
        Ok::<_, ConvertError>(TrajectoryPoint {
            time: duration_from_msg(&point.time_from_start)?,
            positions_rad: joints("points.positions", &point.positions)?,
            velocities_rad_s: joints("points.velocities", &point.velocities)?,
        })
    };
    let points = msg.points.iter().map(point).collect::<Result<_, _>>()?;
    Ok(JointTrajectory::new(points)?)
}

/// A trajectory to start at once.
pub fn joint_trajectory_to_msg(
    trajectory: &JointTrajectory,
    names: &[impl AsRef<str>; 6],
) -> Result<trajectory_msgs::JointTrajectory, ConvertError> {
    trajectory_points_to_msg(trajectory.points(), names)
}

/// Points that need not make a trajectory, none for instance.
pub fn trajectory_points_to_msg(
    points: &[TrajectoryPoint],
    names: &[impl AsRef<str>; 6],
) -> Result<trajectory_msgs::JointTrajectory, ConvertError> {
    let point = |point: &TrajectoryPoint| {
        Ok::<_, ConvertError>(trajectory_msgs::JointTrajectoryPoint {
            positions: point.positions_rad.iter().copied().collect(),
            velocities: point.velocities_rad_s.iter().copied().collect(),
            time_from_start: duration_to_msg(point.time)?,
            ..Default::default()
        })
    };
    Ok(trajectory_msgs::JointTrajectory {
        joint_names: names.iter().map(|name| name.as_ref().to_owned()).collect(),
        points: points.iter().map(point).collect::<Result<_, _>>()?,
        ..Default::default()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const NAMES: [&str; 6] = ["a", "b", "c", "d", "e", "f"];

    #[test]
    fn the_level_of_a_pin_is_found_by_its_number_and_not_made_up() {
        let digital = |pin, state| ur_msgs::Digital { pin, state };
        let states = [digital(16, true), digital(3, false)];
        assert_eq!(pin_level(&states, 16), Some(true));
        assert_eq!(pin_level(&states, 3), Some(false));
        assert_eq!(pin_level(&states, 0), None);
    }

    fn trajectory() -> JointTrajectory {
        let point = |millis: u32, value: f64| TrajectoryPoint {
            time: Duration::new(0, millis * 1_000_000 + 1),
            positions_rad: Joints::repeat(value),
            velocities_rad_s: Joints::repeat(-value),
        };
        JointTrajectory::new(vec![point(0, 0.0), point(20, 0.1), point(40, 1.0 / 3.0)]).unwrap()
    }

    #[test]
    fn joints_are_read_by_name() {
        let mut message = sensor_msgs::JointState {
            name: ["gripper", "f", "e", "d", "c", "b", "a"]
                .map(String::from)
                .to_vec(),
            position: vec![9.0, 6.0, 5.0, 4.0, 3.0, 2.0, 1.0],
            velocity: vec![0.9, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1],
            ..Default::default()
        };
        let reading = joint_reading_from_msg(&message, &NAMES).unwrap();
        assert_eq!(
            reading.positions_rad,
            Joints::new(1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
        );
        assert_eq!(
            reading.velocities_rad_s,
            Joints::new(0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
        );
        message.velocity.clear();
        let reading = joint_reading_from_msg(&message, &NAMES).unwrap();
        assert_eq!(reading.velocities_rad_s, Joints::zeros());
        message.name.pop();
        assert!(joint_reading_from_msg(&message, &NAMES).is_err());
    }

    proptest! {
        #[test]
        fn poses_in_the_plane_pass_bit_for_bit(x in -1.0..1.0, y in -1.0..1.0, yaw in -TAU..TAU) {
            let pose = Isometry2::new(nalgebra::Vector2::new(x, y), yaw);
            prop_assert_eq!(pose2d_from_msg(&pose2d_to_msg(&pose)).unwrap(), pose);
        }

        #[test]
        fn poses_in_space_pass_bit_for_bit(t: [i16; 3], axis in prop::array::uniform3(-3.0..3.0)) {
            let translation = Translation3::new(f64::from(t[0]) / 7.0, f64::from(t[1]) / 3.0, f64::from(t[2]));
            let rotation = UnitQuaternion::from_scaled_axis(nalgebra::Vector3::from(axis));
            let pose = Isometry3::from_parts(translation, rotation);
            prop_assert_eq!(isometry_from_msg(&isometry_to_msg(&pose)).unwrap(), pose);
        }
    }

    #[test]
    fn the_36_rotations_of_a_policy_pass_bit_for_bit() {
        for index in 0..36 {
            let pose = Isometry2::rotation(f64::from(index) * TAU / 36.0);
            assert_eq!(pose2d_from_msg(&pose2d_to_msg(&pose)).unwrap(), pose);
        }
    }

    #[test]
    fn poses_that_are_none_are_refused() {
        let refusal = |x, y, theta| {
            pose2d_from_msg(&geometry_msgs::Pose2D { x, y, theta })
                .unwrap_err()
                .to_string()
        };
        assert_eq!(
            refusal(f64::NAN, 0.0, 0.0),
            "x is not finite, expected a finite number"
        );
        assert!(refusal(0.0, 0.0, 7.0).starts_with("theta is 7"));
        let mut transform = geometry_msgs::Transform::default();
        assert!(isometry_from_msg(&transform).is_ok());
        transform.rotation.w = 0.9;
        assert!(isometry_from_msg(&transform).is_err());
        transform.rotation.w = f64::NAN;
        assert!(isometry_from_msg(&transform).is_err());
    }

    #[test]
    fn trajectories_pass_unchanged() {
        let trajectory = trajectory();
        let msg = joint_trajectory_to_msg(&trajectory, &NAMES).unwrap();
        assert_eq!(joint_trajectory_from_msg(&msg, &NAMES).unwrap(), trajectory);
    }

    #[test]
    fn trajectories_of_other_joints_or_lengths_are_refused() {
        let good = joint_trajectory_to_msg(&trajectory(), &NAMES).unwrap();
        let refusal = |spoil: fn(&mut trajectory_msgs::JointTrajectory)| {
            let mut msg = good.clone();
            spoil(&mut msg);
            joint_trajectory_from_msg(&msg, &NAMES)
                .unwrap_err()
                .to_string()
        };
        assert!(refusal(|msg| msg.joint_names.swap(0, 1)).starts_with("joint_names is"));
        assert!(refusal(|msg| msg.joint_names.truncate(5)).starts_with("joint_names is"));
        assert_eq!(
            refusal(|msg| msg.points[1].velocities.clear()),
            "points.velocities has 0 elements, expected 6"
        );
        assert!(
            refusal(|msg| msg.points[1].positions[2] = f64::NAN)
                .starts_with("points.positions[2] is not finite")
        );
        assert!(
            refusal(|msg| msg.points[1].time_from_start.sec = -1).starts_with("duration is -1 s")
        );
        assert!(refusal(|msg| msg.points.reverse()).starts_with("trajectory points:"));
        assert!(refusal(|msg| msg.points.clear()).starts_with("trajectory points:"));
    }

    #[test]
    fn joint_states_may_come_in_any_order() {
        let position = vec![9.0, 6.0, 5.0, 4.0, 3.0, 2.0, 1.0];
        let name = ["other", "f", "e", "d", "c", "b", "a"]
            .map(str::to_owned)
            .to_vec();
        let mut state = sensor_msgs::JointState {
            name,
            position,
            ..Default::default()
        };
        let joints = joints_from_msg(&state, &NAMES).unwrap();
        assert_eq!(joints.as_slice(), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        state.name[3] = "other".into();
        assert!(
            joints_from_msg(&state, &NAMES)
                .unwrap_err()
                .to_string()
                .contains("expected d among them")
        );
    }

    #[test]
    fn settings_must_be_positive() {
        let settings = PrimitiveSettings {
            clearance_m: 0.3,
            lift_m: 0.1,
            travel_m_s: 1.0,
            carry_m_s: 0.5,
            descend_m_s: 0.2,
            acceleration_m_s2: 4.0,
        };
        let mut msg = settings_to_msg(&settings);
        assert_eq!(settings_from_msg(&msg).unwrap(), settings);
        msg.descend_m_s = 0.0;
        assert_eq!(
            settings_from_msg(&msg).unwrap_err().to_string(),
            "descend_m_s is 0, expected a positive number"
        );
    }

    #[test]
    fn only_outcomes_of_motions_are_outcomes() {
        for code in 0..=u8::MAX {
            match outcome_from_msg(code) {
                Ok(outcome) => assert_eq!(outcome_to_msg(outcome), code),
                Err(_) => assert!(!(1..=5).contains(&code)),
            }
        }
    }
}
