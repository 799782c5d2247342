//! Messages that only the console reads, as the library has them.

use console::{InvalidPlan, Motion, NodeReport, Plan, Point, ScoreMaps};
use msgs::convert::{self, ConvertError};
use msgs::diagnostic_msgs::DiagnosticStatus;
use msgs::sctn_msgs::PlannedMotion;
use msgs::sensor_msgs::{Image, JointState};
use msgs::ur_msgs::Digital;
use step_protocol::ProposalId;

/// Most joints that are read.
const MOST_JOINTS: usize = 64;

/// A message that makes no sense: which field, and what was expected.
#[derive(Debug, thiserror::Error)]
pub enum Invalid {
    /// A part of it.
    #[error("{field}.{source}")]
    Part {
        /// The field.
        field: String,
        /// The reason.
        source: ConvertError,
    },
    /// A plan.
    #[error(transparent)]
    Plan(#[from] InvalidPlan),
    /// Score maps.
    #[error(
        "{height} x {width} pixels as {encoding:?} in {bytes} bytes with step {step}, expected two maps side by side as rgb8 without padding"
    )]
    Scores {
        /// Rows.
        height: u32,
        /// Columns.
        width: u32,
        /// Encoding.
        encoding: String,
        /// Length of the data.
        bytes: usize,
        /// Bytes of a row.
        step: u32,
    },
    /// Joints.
    #[error(
        "{names} names and {positions} positions, expected as many of each, at most {MOST_JOINTS}"
    )]
    Joints {
        /// Number of names.
        names: usize,
        /// Number of positions.
        positions: usize,
    },
}

/// What is wrong with a part of a message.
fn part(field: impl Into<String>) -> impl FnOnce(ConvertError) -> Invalid {
    |source| Invalid::Part {
        field: field.into(),
        source,
    }
}

/// A planned motion, as the page shows it.
pub fn motion_from_msg(message: PlannedMotion) -> Result<Motion, Invalid> {
    let points = message.trajectory.points.into_iter().enumerate();
    let points = points.map(|(index, point)| {
        let time = convert::duration_from_msg(&point.time_from_start);
        let field = || format!("trajectory.points[{index}].time_from_start");
        Ok(Point {
            time: time.map_err(|error| part(field())(error))?,
            positions_rad: point.positions,
        })
    });
    let plan = Plan {
        proposal_id: ProposalId(message.proposal_id),
        points: points.collect::<Result<_, Invalid>>()?,
        joint_names: message.trajectory.joint_names,
        suction_on: convert::duration_from_msg(&message.suction_on).map_err(part("suction_on"))?,
        suction_off: convert::duration_from_msg(&message.suction_off)
            .map_err(part("suction_off"))?,
        reason: message.reason,
    };
    Ok(Motion::try_from(plan)?)
}

/// Score maps of pick and place, side by side.
pub fn scores_from_msg(image: Image) -> Result<ScoreMaps, Invalid> {
    let stamp = convert::time_from_msg(&image.header.stamp).map_err(part("header"))?;
    let row = 3 * u64::from(image.width);
    let expected = row.checked_mul(u64::from(image.height));
    if image.encoding != "rgb8"
        || image.width == 0
        || !image.width.is_multiple_of(2)
        || u64::from(image.step) != row
        || Some(image.data.len() as u64) != expected
    {
        return Err(Invalid::Scores {
            height: image.height,
            width: image.width,
            encoding: image.encoding,
            bytes: image.data.len(),
            step: image.step,
        });
    }
    Ok(ScoreMaps {
        stamp,
        rows: image.height as usize,
        cols: image.width as usize,
        rgb: image.data.into_vec(),
    })
}

/// What a node says of a part of itself; `None` where the status has no `NODE: PART` as its name.
pub fn report_from_msg(status: DiagnosticStatus) -> Option<NodeReport> {
    let (node, state) = status.name.split_once(": ")?;
    let values = status.values.into_iter();
    Some(NodeReport {
        node: node.to_owned(),
        state: state.to_owned(),
        level: status.level,
        message: status.message,
        values: values.map(|value| (value.key, value.value)).collect(),
    })
}

/// Names and positions (rad) of the joints.
pub fn joints_from_msg(message: JointState) -> Result<(Vec<String>, Vec<f64>), Invalid> {
    let JointState { name, position, .. } = message;
    if name.len() != position.len() || name.len() > MOST_JOINTS {
        return Err(Invalid::Joints {
            names: name.len(),
            positions: position.len(),
        });
    }
    Ok((name, position))
}

/// Level of a digital pin, where it is told.
pub fn level(states: &[Digital], pin: u8) -> Option<bool> {
    let mut states = states.iter();
    states
        .find(|state| state.pin == pin)
        .map(|state| state.state)
}

#[cfg(test)]
mod tests {
    use super::*;
    use msgs::trajectory_msgs::JointTrajectoryPoint;

    #[test]
    fn a_planned_motion_with_a_negative_time_is_refused_by_its_field() {
        let mut message = PlannedMotion::default();
        let mut point = JointTrajectoryPoint::default();
        point.time_from_start.sec = -1;
        message.trajectory.points = vec![JointTrajectoryPoint::default(), point];
        let error = motion_from_msg(message).unwrap_err().to_string();
        assert!(
            error.starts_with("trajectory.points[1].time_from_start."),
            "{error}"
        );
    }

    #[test]
    fn score_maps_of_a_size_that_does_not_fit_are_refused() {
        let mut image = Image {
            height: 2,
            width: 4,
            step: 12,
            encoding: "rgb8".into(),
            data: vec![0; 24].into(),
            ..Default::default()
        };
        let scores = scores_from_msg(image.clone()).unwrap();
        assert_eq!((scores.rows, scores.cols, scores.rgb.len()), (2, 4, 24));
        image.data.pop();
        let error = scores_from_msg(image).unwrap_err().to_string();
        assert!(error.contains("23 bytes"), "{error}");
    }

    #[test]
    fn joints_without_positions_are_refused() {
        let message = JointState {
            name: vec!["elbow_joint".into()],
            ..Default::default()
        };
        let error = joints_from_msg(message).unwrap_err().to_string();
        assert!(error.starts_with("1 names and 0 positions"), "{error}");
    }

    #[test]
    fn a_status_without_a_node_in_its_name_is_left_out() {
        let named = |name: &str| {
            report_from_msg(DiagnosticStatus {
                name: name.into(),
                ..Default::default()
            })
        };
        assert_eq!(named("motors"), None);
        let report = named("/camera_fusion: topics").unwrap();
        assert_eq!(
            (&*report.node, &*report.state),
            ("/camera_fusion", "topics")
        );
    }
}
