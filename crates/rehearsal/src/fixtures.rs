//! Set-up that the tests share.

use std::sync::Arc;
use std::time::Duration;

use collision::{CollisionChecker, Margins};
use heightmap::ChangeRules;
use nalgebra::{Isometry2, Vector2};
use pick_place::{ContactSettings, ContactSign, PickPlace, PrimitiveSettings};
use step_protocol::{Proposal, ProposalId};
use ur5::WorkCell;

use crate::{Reading, RehearsalRules, Rehearsals};

/// Nothing was seen yet. Calls are numbers.
pub(crate) fn rehearsals() -> Rehearsals<u32> {
    let cell = WorkCell::builtin().unwrap();
    let checker = CollisionChecker::new(&cell, Margins::default()).unwrap();
    Rehearsals::new(RehearsalRules {
        arm: cell.arm,
        checker: Arc::new(checker),
        needs_home: false,
        observation_max_age: Duration::from_secs(10),
        contact: ContactSettings::default(),
        sign: ContactSign::UntilAction,
        changes: ChangeRules::default(),
    })
}

/// Of an arm at home that holds nothing.
pub(crate) fn reading() -> Reading {
    Reading {
        joints_rad: Some(WorkCell::builtin().unwrap().arm.home),
        holds: Some(false),
        publishers: 1,
        ..Reading::default()
    }
}

/// Picks at (0.5, 0.1) and places at (0.5, -0.1).
pub(crate) fn proposal(id: ProposalId) -> Proposal {
    Proposal {
        id,
        ..proposal_at(0.5)
    }
}

/// The same at another x.
pub(crate) fn proposal_at(x_m: f64) -> Proposal {
    let pose = |y_m| Isometry2::new(Vector2::new(x_m, y_m), 0.0);
    Proposal {
        id: ProposalId(1),
        frame: "world".into(),
        stamp: Duration::ZERO,
        problem: "placing".into(),
        step: 1,
        attempt: 0,
        module: "placing".into(),
        action: PickPlace {
            pick: pose(0.1),
            place: pose(-0.1),
        },
        settings: PrimitiveSettings::RIGID,
        pick_score: 1.0,
        place_score: 1.0,
        success_probability: None,
        done_probability: None,
        checkpoint: String::new(),
        author: "test".into(),
    }
}
