//! What is shown with a proposal beside its poses: the planned motion, and the policy's scores.

use std::time::Duration;

use serde::Serialize;
use step_protocol::ProposalId;

/// Most points of a motion that are shown: 200 s at 50 a second.
const MOST_POINTS: usize = 10_000;
/// Most joints of a robot.
pub(crate) const MOST_JOINTS: usize = 64;
/// Time between the points that the page gets.
const PERIOD_S: f64 = 0.06;

/// A point of a planned motion.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Point {
    /// From the beginning of the motion.
    pub time: Duration,
    /// A position of each joint.
    pub positions_rad: Vec<f64>,
}

/// How the executor would carry a proposal out, as it says it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Plan {
    /// The proposal.
    pub proposal_id: ProposalId,
    /// Names of the joints.
    pub joint_names: Vec<String>,
    /// In the order of time.
    pub points: Vec<Point>,
    /// When suction is switched on.
    pub suction_on: Duration,
    /// When suction is switched off.
    pub suction_off: Duration,
    /// Why there is no motion; empty where there is one.
    pub reason: String,
}

/// A plan that makes no sense.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum InvalidPlan {
    /// It is too long.
    #[error(
        "trajectory has {points} points of {joints} joints, expected at most {MOST_POINTS} of at most {MOST_JOINTS}"
    )]
    Size {
        /// Number of points.
        points: usize,
        /// Number of joints.
        joints: usize,
    },
    /// A point is not later than the one before it.
    #[error(
        "trajectory.points[{index}].time_from_start is {time_s} s, expected more than {before_s} s"
    )]
    Time {
        /// Of the point.
        index: usize,
        /// Its time.
        time_s: f64,
        /// Time of the point before it.
        before_s: f64,
    },
    /// A point has not one finite position for each joint.
    #[error("trajectory.points[{index}].positions: expected {joints} finite numbers")]
    Positions {
        /// Of the point.
        index: usize,
        /// Number of joints.
        joints: usize,
    },
}

/// A planned motion, as the API has it: points that are closer than the page draws them are left out.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Motion {
    /// A 64-bit number, which JavaScript's numbers cannot hold.
    #[serde(serialize_with = "as_text")]
    pub proposal_id: ProposalId,
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
    id: &ProposalId,
    serializer: S,
) -> Result<S::Ok, S::Error> {
    serializer.collect_str(id)
}

impl TryFrom<Plan> for Motion {
    type Error = InvalidPlan;

    fn try_from(plan: Plan) -> Result<Self, InvalidPlan> {
        let Plan {
            proposal_id,
            joint_names,
            points,
            suction_on,
            suction_off,
            reason,
        } = plan;
        let joints = joint_names.len();
        if points.len() > MOST_POINTS || joints > MOST_JOINTS {
            return Err(InvalidPlan::Size {
                points: points.len(),
                joints,
            });
        }
        let mut motion = Self {
            proposal_id,
            joint_names,
            times_s: Vec::new(),
            positions_rad: Vec::new(),
            suction_on_s: suction_on.as_secs_f64(),
            suction_off_s: suction_off.as_secs_f64(),
            reason,
        };
        let last = points.len().saturating_sub(1);
        let mut before_s = f64::NEG_INFINITY;
        for (index, point) in points.into_iter().enumerate() {
            let time_s = point.time.as_secs_f64();
            if time_s <= before_s {
                return Err(InvalidPlan::Time {
                    index,
                    time_s,
                    before_s,
                });
            }
            before_s = time_s;
            let positions_rad = point.positions_rad;
            if positions_rad.len() != joints || !positions_rad.iter().all(|rad| rad.is_finite()) {
                return Err(InvalidPlan::Positions { index, joints });
            }
            let shown_s = motion.times_s.last().copied();
            if index == last || shown_s.is_none_or(|shown_s| time_s >= shown_s + PERIOD_S) {
                motion.times_s.push(time_s);
                motion.positions_rad.push(positions_rad);
            }
        }
        Ok(motion)
    }
}

impl Motion {
    /// How long it takes.
    pub fn duration_s(&self) -> f64 {
        self.times_s.last().copied().unwrap_or(0.0)
    }
}

/// The policy's score maps: red, green and blue of each cell, of the pick on the left and of the place on the right.
#[derive(Clone, Debug, PartialEq)]
pub struct ScoreMaps {
    /// Stamp of the heightmap that they are for.
    pub stamp: Duration,
    /// Rows of the picture.
    pub rows: usize,
    /// Columns of the picture, of both maps together.
    pub cols: usize,
    /// Row-major, three bytes for each cell.
    pub rgb: Vec<u8>,
}

/// A picture that does not hold two score maps.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "{height} x {width} pixels as {encoding:?} in {bytes} bytes with step {step}, expected two maps side by side as rgb8 without padding"
)]
pub struct InvalidScores {
    height: u32,
    width: u32,
    encoding: String,
    bytes: usize,
    step: u32,
}

impl ScoreMaps {
    /// The maps in a picture of two maps side by side, of an `encoding` of ROS and with `step` bytes for each row.
    ///
    /// # Errors
    /// When it is not rgb8, not of two maps of the same width, or its rows are padded.
    pub fn side_by_side(
        stamp: Duration,
        [height, width]: [u32; 2],
        encoding: &str,
        step: u32,
        rgb: Vec<u8>,
    ) -> Result<Self, InvalidScores> {
        let row = 3 * u64::from(width);
        let expected = row.checked_mul(u64::from(height));
        if encoding != "rgb8"
            || width == 0
            || !width.is_multiple_of(2)
            || u64::from(step) != row
            || Some(rgb.len() as u64) != expected
        {
            return Err(InvalidScores {
                height,
                width,
                encoding: encoding.to_owned(),
                bytes: rgb.len(),
                step,
            });
        }
        Ok(Self {
            stamp,
            rows: height as usize,
            cols: width as usize,
            rgb,
        })
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// The plan of a motion of one joint for 1 s.
    fn plan(proposal_id: u64) -> Plan {
        let point = |index: u32| Point {
            time: index * Duration::from_millis(20),
            positions_rad: vec![0.01 * f64::from(index)],
        };
        Plan {
            proposal_id: ProposalId(proposal_id),
            joint_names: vec!["elbow_joint".into()],
            points: (0..=50).map(point).collect(),
            ..Plan::default()
        }
    }

    /// A motion of one joint for 1 s.
    pub(crate) fn planned(proposal_id: u64) -> Motion {
        plan(proposal_id).try_into().unwrap()
    }

    /// What the executor says of a proposal that it cannot plan.
    pub(crate) fn unplanned(proposal_id: u64, reason: &str) -> Motion {
        let plan = Plan {
            proposal_id: ProposalId(proposal_id),
            reason: reason.into(),
            ..Plan::default()
        };
        plan.try_into().unwrap()
    }

    #[test]
    fn a_planned_motion_is_thinned_and_keeps_its_ends() {
        let motion = planned(u64::MAX);
        assert_eq!((motion.times_s[0], motion.duration_s()), (0.0, 1.0));
        assert!(motion.times_s.len() < 20, "{:?}", motion.times_s);
        assert_eq!(motion.positions_rad.last().unwrap(), &[0.5]);
        let json = serde_json::to_value(&motion).unwrap();
        assert_eq!(json["proposal_id"], u64::MAX.to_string());
    }

    #[test]
    fn a_plan_that_makes_no_sense_is_refused_by_its_field() {
        let error = |plan: Plan| Motion::try_from(plan).unwrap_err().to_string();
        let mut short = plan(1);
        short.points[3].positions_rad.clear();
        let expected = "trajectory.points[3].positions: expected 1 finite numbers";
        assert_eq!(error(short), expected);
        let mut backwards = plan(1);
        backwards.points.swap(1, 2);
        let found = error(backwards);
        assert!(found.contains("points[2].time_from_start"), "{found}");
        let mut long = plan(1);
        long.points = vec![Point::default(); MOST_POINTS + 1];
        assert!(error(long).starts_with("trajectory has 10001 points"));
    }

    #[test]
    fn score_maps_of_a_size_that_does_not_fit_are_refused() {
        let maps = |size, encoding: &str, step, bytes| {
            ScoreMaps::side_by_side(Duration::ZERO, size, encoding, step, vec![0; bytes])
        };
        let scores = maps([2, 4], "rgb8", 12, 24).unwrap();
        assert_eq!((scores.rows, scores.cols, scores.rgb.len()), (2, 4, 24));
        let error = maps([2, 4], "rgb8", 12, 23).unwrap_err().to_string();
        assert!(error.contains("23 bytes"), "{error}");
        for (size, encoding, step, bytes) in [
            ([2, 4], "bgr8", 12, 24),
            ([2, 4], "rgb8", 16, 24),
            ([2, 3], "rgb8", 9, 18),
            ([2, 0], "rgb8", 0, 0),
        ] {
            assert!(maps(size, encoding, step, bytes).is_err(), "{size:?}");
        }
    }
}
