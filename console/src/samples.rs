//! Messages for the tests of this crate.

use std::sync::Arc;
use std::time::Duration;

use heightmap::{ChangeRules, Heightmap, Workspace};
use nalgebra::{Isometry2, Point2};
use pick_place::{PickPlace, PrimitiveSettings};
use step_protocol::{Coverage, Goal, Observation, Proposal, ProposalId, StepOutcome, StepResult};

use crate::run::{Joints, Watch};

/// What is heard of these nodes is stale after 3 s.
pub(crate) fn watch(nodes: &[&str]) -> Watch {
    Watch {
        nodes: nodes.iter().map(|&node| node.to_owned()).collect(),
        executor: "/suction_executor".into(),
        image_topics: vec!["color/image_raw".into(), "depth/depth_registered".into()],
        stale_after: Duration::from_secs(3),
        changes: ChangeRules::default(),
    }
}

/// A robot of one joint.
pub(crate) fn joint(name: &str, position_rad: f64) -> Joints {
    Joints::new(vec![name.to_owned()], vec![position_rad]).unwrap()
}

/// A table in a corner of the world.
pub(crate) const fn workspace(rows: usize, cols: usize, pixel_size_m: f64) -> Workspace {
    Workspace {
        origin_m: Point2::new(0.0, 0.0),
        rows,
        cols,
        pixel_size_m,
        z_min_m: 0.0,
        z_max_m: 1.0,
    }
}

/// All of the table is as high.
pub(crate) fn image(workspace: Workspace, height_m: f32) -> Heightmap {
    let cells = workspace.rows * workspace.cols;
    Heightmap {
        rgb: vec![100; 3 * cells],
        height_m: vec![height_m; cells],
        workspace,
    }
}

/// The table was seen like this.
pub(crate) fn observation(image: Heightmap, stamp_s: u64) -> Observation {
    Observation {
        stamp: Duration::from_secs(stamp_s),
        frame: "world".into(),
        heightmap: Arc::new(image),
        coverage: Coverage::default(),
    }
}

/// The only step of a demonstration without a name.
pub(crate) fn goal(image: Heightmap) -> Goal {
    Goal {
        stamp: Duration::ZERO,
        problem: String::new(),
        demonstration: String::new(),
        step: 1,
        step_count: 1,
        attempt: 0,
        complete: false,
        module: String::new(),
        settings: PrimitiveSettings::RIGID,
        image: Arc::new(image),
        coverage: Coverage::default(),
        previous: None,
    }
}

/// For [`goal`]: from the corner of the table to where it was.
pub(crate) fn proposal(id: u64) -> Proposal {
    Proposal {
        id: ProposalId(id),
        frame: "world".into(),
        stamp: Duration::ZERO,
        problem: String::new(),
        step: 1,
        attempt: 0,
        module: String::new(),
        action: PickPlace {
            pick: Isometry2::identity(),
            place: Isometry2::identity(),
        },
        settings: PrimitiveSettings::RIGID,
        pick_score: 0.5,
        place_score: 0.5,
        success_probability: None,
        done_probability: None,
        checkpoint: String::new(),
        author: String::new(),
    }
}

/// What became of a proposal.
pub(crate) fn result(proposal: ProposalId, outcome: StepOutcome, stamp_s: u64) -> StepResult {
    let duration_s = if outcome.arm_moved() { 5 } else { 0 };
    StepResult {
        stamp: Duration::from_secs(stamp_s),
        proposal_id: proposal,
        outcome,
        reason: "for a reason".into(),
        duration: Duration::from_secs(duration_s),
        status: None,
    }
}
