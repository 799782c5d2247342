//! Heightmaps as they came, and how the table has changed since one of them.

use std::sync::Arc;
use std::time::Duration;

use heightmap::{Change, ChangeRules, Heightmap, largest_change};
use nalgebra::Point2;
use step_protocol::{Coverage, Observation, ProposalId};

use super::Run;

/// A heightmap with its number: the n-th that came.
#[derive(Clone, Debug)]
pub struct View {
    /// Counts from 1.
    pub number: u64,
    /// What was seen.
    pub heightmap: Arc<Heightmap>,
    /// Capture time.
    pub stamp: Duration,
    /// Frame of the heightmap: the world.
    pub(super) frame: String,
    pub(super) coverage: Coverage,
    pub(super) arrived: Duration,
}

impl View {
    pub(super) fn new(number: u64, seen: Observation, arrived: Duration) -> Self {
        Self {
            number,
            heightmap: seen.heightmap,
            stamp: seen.stamp,
            frame: seen.frame,
            coverage: seen.coverage,
            arrived,
        }
    }

    /// An image of a demonstration.
    pub(super) fn of_goal(
        number: u64,
        image: Arc<Heightmap>,
        coverage: Coverage,
        stamp: Duration,
        arrived: Duration,
    ) -> Self {
        Self {
            number,
            heightmap: image,
            stamp,
            frame: String::new(),
            coverage,
            arrived,
        }
    }
}

/// How the table differs from the heightmap that a proposal was made from.
#[derive(Clone, Copy, Debug)]
pub(super) enum TableChange {
    /// The largest change.
    Blob(Change),
    /// The heightmap covers another workspace.
    Workspace,
}

/// How the table differed from the heightmap that a proposal was made from, when it was looked at last.
#[derive(Clone, Copy, Debug)]
pub(super) struct Compared {
    proposal_id: ProposalId,
    /// Number of the heightmap that it was compared with.
    view: u64,
    pub(super) change: Option<TableChange>,
}

impl Run {
    /// What has changed since the heightmap that the present proposal was made from. Where that one is not known any more, the
    /// change is the one that was found last.
    pub(super) fn compare(&mut self) {
        let (Some(proposal), Some(newest)) = (self.operator.current(), self.views.back()) else {
            return;
        };
        let before = self
            .compared
            .filter(|known| known.proposal_id == proposal.id);
        if before.is_some_and(|known| known.view == newest.number) {
            return;
        }
        let mut views = self.views.iter();
        let change = match views.rfind(|view| view.stamp == proposal.stamp) {
            Some(source) => {
                let action = &proposal.action;
                let around =
                    [&action.pick, &action.place].map(|pose| Point2::from(pose.translation.vector));
                table_change(source, newest, &self.watch.changes, &around)
            }
            None => before.and_then(|known| known.change),
        };
        self.compared = Some(Compared {
            proposal_id: proposal.id,
            view: newest.number,
            change,
        });
    }

    /// How the table differs from what the present proposal was made from.
    pub(super) fn present_change(&self) -> Option<TableChange> {
        let id = self.current_id()?;
        self.compared
            .filter(|known| known.proposal_id == id)?
            .change
    }
}

/// How the newest heightmap differs from the one that a proposal was made from, as the executor's gate has it.
fn table_change(
    source: &View,
    newest: &View,
    rules: &ChangeRules,
    around: &[Point2<f64>],
) -> Option<TableChange> {
    if source.stamp == newest.stamp {
        return None;
    }
    match largest_change(&source.heightmap, &newest.heightmap, rules, around) {
        Ok(change) => change.map(TableChange::Blob),
        Err(_) => Some(TableChange::Workspace),
    }
}
