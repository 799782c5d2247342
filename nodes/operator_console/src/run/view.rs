//! Heightmaps as they came, and how the table has changed since one of them.

use std::sync::Arc;
use std::time::Duration;

use heightmap::{Change, ChangeRules, largest_change};
use msgs::convert;
use msgs::sctn_msgs::{Heightmap, PickPlace};
use nalgebra::Point2;

use super::{InvalidMessage, Run, duration};

/// A heightmap with its number: the n-th that came.
#[derive(Clone, Debug)]
pub struct View {
    /// Counts from 1.
    pub number: u64,
    /// As it came.
    pub heightmap: Arc<Heightmap>,
    /// Capture time.
    pub stamp: Duration,
    pub(super) arrived: Duration,
}

/// How the table differs from the heightmap that a proposal was made from.
#[derive(Clone, Copy, Debug)]
pub(super) enum TableChange {
    /// The largest change.
    Blob(Change),
    /// The heightmap covers another workspace.
    Workspace,
}

impl Run {
    /// What has changed since the heightmap that the newest proposal was made from.
    pub(super) fn compare(&mut self) {
        let (Some(id), Some(newest)) = (self.newest, self.views.back()) else {
            return;
        };
        let rules = &self.watch.changes;
        let Some(offered) = self
            .offered
            .iter_mut()
            .rfind(|known| known.message.id == id)
        else {
            return;
        };
        let source = duration(&offered.message.header.stamp).ok();
        let Some(source) = self.views.iter().rfind(|view| Some(view.stamp) == source) else {
            return;
        };
        let PickPlace { pick, place, .. } = &offered.message;
        let around = [pick, place].map(|pose| Point2::new(pose.x, pose.y));
        offered.change = table_change(source, newest, rules, &around);
    }
}

pub(super) fn check_heightmap(message: &Heightmap) -> Result<(), InvalidMessage> {
    let cells = u64::from(message.rows) * u64::from(message.cols);
    let sizes = [
        ("rgb", message.rgb.len() as u64, cells.checked_mul(3)),
        ("height_m", message.height_m.len() as u64, Some(cells)),
    ];
    for (field, found, expected) in sizes {
        if cells == 0 || Some(found) != expected {
            return Err(format!(
                "{field} has {found} values, expected those of {} x {} cells",
                message.rows, message.cols
            ));
        }
    }
    if !(message.pixel_size_m.is_finite() && message.pixel_size_m > 0.0) {
        return Err(format!(
            "pixel_size_m is {}, expected a positive number",
            message.pixel_size_m
        ));
    }
    for (field, value) in [
        ("origin.x", message.origin.x),
        ("origin.y", message.origin.y),
    ] {
        if !value.is_finite() {
            return Err(format!("{field} is {value}, expected a finite number"));
        }
    }
    Ok(())
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
    // The gate refuses a heightmap that cannot be converted.
    let convert = |view: &View| convert::heightmap_from_msg(Heightmap::clone(&view.heightmap)).ok();
    match largest_change(&convert(source)?, &convert(newest)?, rules, around) {
        Ok(change) => change.map(TableChange::Blob),
        Err(_) => Some(TableChange::Workspace),
    }
}

pub(super) fn contains(heightmap: &Heightmap, x_m: f64, y_m: f64) -> bool {
    let inside = |value: f64, origin: f64, cells: u32| {
        (0.0..f64::from(cells) * heightmap.pixel_size_m).contains(&(value - origin))
    };
    inside(x_m, heightmap.origin.x, heightmap.cols)
        && inside(y_m, heightmap.origin.y, heightmap.rows)
}
