//! What is shown with a proposal beside its poses: the planned motion, and the policy's scores.

use std::time::Duration;

use msgs::convert;
use msgs::sctn_msgs::PlannedMotion;
use msgs::sensor_msgs::Image;
use serde::Serialize;

/// Most points of a motion that are shown: 200 s at 50 a second.
const MOST_POINTS: usize = 10_000;
/// Time between the points that the page gets.
const PERIOD_S: f64 = 0.06;

/// How the executor would carry a proposal out, as the API has it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Motion {
    /// A 64-bit number, which JavaScript's numbers cannot hold.
    #[serde(serialize_with = "as_text")]
    pub proposal_id: u64,
    joint_names: Vec<String>,
    /// From the beginning; increasing.
    times_s: Vec<f64>,
    /// For each time a position of each joint.
    positions_rad: Vec<Vec<f64>>,
    suction_on_s: f64,
    suction_off_s: f64,
    /// Why there is none; empty where there is one.
    pub reason: String,
}

pub(crate) fn as_text<S: serde::Serializer>(
    number: &u64,
    serializer: S,
) -> Result<S::Ok, S::Error> {
    serializer.collect_str(number)
}

impl Motion {
    /// Checks a message. Points that are closer than the page draws them are left out.
    ///
    /// # Errors
    /// Names the field that makes no sense.
    pub fn from_msg(message: PlannedMotion) -> Result<Self, String> {
        let seconds = |field: &str, duration: &msgs::builtin_interfaces::Duration| {
            let duration = convert::duration_from_msg(duration);
            duration
                .map(|duration| duration.as_secs_f64())
                .map_err(|error| format!("{field}.{error}"))
        };
        let joint_names = message.trajectory.joint_names;
        let points = message.trajectory.points;
        if points.len() > MOST_POINTS || joint_names.len() > 64 {
            return Err(format!(
                "trajectory has {} points of {} joints, expected at most {MOST_POINTS} of at most 64",
                points.len(),
                joint_names.len()
            ));
        }
        let mut motion = Self {
            proposal_id: message.proposal_id,
            joint_names,
            times_s: Vec::new(),
            positions_rad: Vec::new(),
            suction_on_s: seconds("suction_on", &message.suction_on)?,
            suction_off_s: seconds("suction_off", &message.suction_off)?,
            reason: message.reason,
        };
        let last = points.len().saturating_sub(1);
        let mut before_s = f64::NEG_INFINITY;
        for (index, point) in points.into_iter().enumerate() {
            let field = format!("trajectory.points[{index}]");
            let time_s = seconds(&format!("{field}.time_from_start"), &point.time_from_start)?;
            if time_s <= before_s {
                return Err(format!(
                    "{field}.time_from_start is {time_s} s, expected more than {before_s} s"
                ));
            }
            before_s = time_s;
            if point.positions.len() != motion.joint_names.len()
                || !point.positions.iter().all(|position| position.is_finite())
            {
                return Err(format!(
                    "{field}.positions: expected {} finite numbers",
                    motion.joint_names.len()
                ));
            }
            let shown_s = motion.times_s.last().copied();
            if index == last || shown_s.is_none_or(|shown_s| time_s >= shown_s + PERIOD_S) {
                motion.times_s.push(time_s);
                motion.positions_rad.push(point.positions);
            }
        }
        Ok(motion)
    }

    /// How long it takes.
    pub fn duration_s(&self) -> f64 {
        self.times_s.last().copied().unwrap_or(0.0)
    }
}

/// The policy's score maps: red, green and blue of each cell, of the pick on the left and of the place on the right.
#[derive(Clone, Debug)]
pub struct Scores {
    /// Counts from 1.
    pub number: u64,
    /// Stamp of the heightmap that they are for.
    pub stamp: Duration,
    /// As it came: `rgb8`, without padding.
    pub image: Image,
}

impl Scores {
    /// Checks a message.
    ///
    /// # Errors
    /// Names the field that makes no sense.
    pub fn from_msg(image: Image, number: u64) -> Result<Self, String> {
        let stamp = convert::time_from_msg(&image.header.stamp);
        let stamp = stamp.map_err(|error| format!("header.{error}"))?;
        let row = 3 * u64::from(image.width);
        let expected = row.checked_mul(u64::from(image.height));
        if image.encoding != "rgb8"
            || image.width == 0
            || !image.width.is_multiple_of(2)
            || u64::from(image.step) != row
            || Some(image.data.len() as u64) != expected
        {
            return Err(format!(
                "{} x {} pixels as {:?} in {} bytes with step {}, expected two maps side by side as rgb8 without padding",
                image.height,
                image.width,
                image.encoding,
                image.data.len(),
                image.step
            ));
        }
        Ok(Self {
            number,
            stamp,
            image,
        })
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use msgs::trajectory_msgs::{JointTrajectory, JointTrajectoryPoint};

    /// A motion of one joint for 1 s.
    pub(crate) fn planned(proposal_id: u64) -> PlannedMotion {
        let point = |index: u32| {
            let mut point = JointTrajectoryPoint {
                positions: vec![0.01 * f64::from(index)],
                ..Default::default()
            };
            point.time_from_start.sec = (index / 50) as i32;
            point.time_from_start.nanosec = index % 50 * 20_000_000;
            point
        };
        PlannedMotion {
            proposal_id,
            trajectory: JointTrajectory {
                joint_names: vec!["elbow_joint".into()],
                points: (0..=50).map(point).collect(),
                ..Default::default()
            },
            ..Default::default()
        }
    }

    #[test]
    fn a_planned_motion_is_thinned_and_keeps_its_ends() {
        let motion = Motion::from_msg(planned(u64::MAX)).unwrap();
        assert_eq!((motion.times_s[0], motion.duration_s()), (0.0, 1.0));
        assert!(motion.times_s.len() < 20, "{:?}", motion.times_s);
        assert_eq!(motion.positions_rad.last().unwrap(), &[0.5]);
        let json = serde_json::to_value(&motion).unwrap();
        assert_eq!(json["proposal_id"], u64::MAX.to_string());
    }

    #[test]
    fn a_motion_or_score_map_that_makes_no_sense_is_refused_by_its_field() {
        let mut short = planned(1);
        short.trajectory.points[3].positions.clear();
        let error = Motion::from_msg(short).unwrap_err();
        assert!(
            error.starts_with("trajectory.points[3].positions"),
            "{error}"
        );
        let mut backwards = planned(1);
        backwards.trajectory.points.swap(1, 2);
        let error = Motion::from_msg(backwards).unwrap_err();
        assert!(error.contains("time_from_start"), "{error}");
        let mut image = Image {
            height: 2,
            width: 4,
            step: 12,
            encoding: "rgb8".into(),
            data: vec![0; 24].into(),
            ..Default::default()
        };
        Scores::from_msg(image.clone(), 1).unwrap();
        image.data.pop();
        assert!(Scores::from_msg(image, 1).unwrap_err().contains("23 bytes"));
    }
}
