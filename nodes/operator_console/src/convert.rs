//! Messages that only the console reads, as the library has them.

use console::{InvalidPlan, InvalidScores, Motion, NodeReport, Plan, Point, ScoreMaps};
use msgs::convert::{self, ConvertError};
use msgs::diagnostic_msgs::DiagnosticStatus;
use msgs::sctn_msgs::PlannedMotion;
use msgs::sensor_msgs::Image;
use step_protocol::ProposalId;

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
    #[error(transparent)]
    Scores(#[from] InvalidScores),
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
    let size = [image.height, image.width];
    let rgb = image.data.into_vec();
    Ok(ScoreMaps::side_by_side(
        stamp,
        size,
        &image.encoding,
        image.step,
        rgb,
    )?)
}

/// What a node says of a part of itself; `None` where the status does not name one.
pub fn report_from_msg(status: DiagnosticStatus) -> Option<NodeReport> {
    let values = status.values.into_iter();
    let values = values.map(|value| (value.key, value.value));
    NodeReport::of_status(&status.name, status.level, status.message, values)
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
}
