//! Whether two heightmaps show the same: the test of the gate and of the policy.

use crate::{Heightmap, Workspace};
use nalgebra::Point2;

/// What counts as a change. A blob is a set of connected cells that differ; smaller blobs are noise of the cameras.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChangeRules {
    /// Within [`Self::near_m`] of a pick or a place.
    pub near: BlobRule,
    /// Elsewhere.
    pub far: BlobRule,
    /// Radius about picks and places within which the rule `near` holds.
    pub near_m: f64,
    /// Least area of a blob of cells that were seen and are not seen any more, as something dark or shiny hides them.
    pub hidden_area_m2: f64,
}

/// Least size of a blob that counts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BlobRule {
    /// A cell differs if its height is above the highest or below the lowest of the nine cells about it before, by more than this.
    pub height_m: f64,
    /// Area of the blob.
    pub area_m2: f64,
}

impl Default for ChangeRules {
    /// Finds an object of 15 x 15 x 10 mm, anywhere, at the noise of three D435 and the median of five frames
    /// (`config/perturbations/realsense.yaml`). Measured there on 200 untouched scenes: at 5 mm the largest blob of noise has 29 mm^2 near a pick or place
    /// and 39 mm^2 elsewhere; of 95 such objects the smallest blob has 186 mm^2. The limits lie between, the near one lower.
    fn default() -> Self {
        Self::new(0.005, 75e-6)
    }
}

impl ChangeRules {
    /// A blob counts from an area on, near picks and places; elsewhere from half as much more, as there is more room for noise there.
    pub fn new(height_m: f64, area_m2: f64) -> Self {
        let blob = |area_m2| BlobRule { height_m, area_m2 };
        Self {
            near: blob(area_m2),
            far: blob(1.5 * area_m2),
            near_m: 0.06,
            hidden_area_m2: 400e-6,
        }
    }
}

/// A blob that has changed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Change {
    /// Middle of its cells in the world.
    pub center_m: Point2<f64>,
    /// Its area.
    pub area_m2: f64,
    /// Greatest change of the height in it, positive upwards; `None` where its cells are not seen any more.
    pub height_m: Option<f64>,
    /// Whether a part of it lies near a pick or a place.
    pub near: bool,
}

/// Heightmaps of different grids.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error(
    "one heightmap covers {source_workspace:?}, the other {latest_workspace:?}, expected the same workspace"
)]
pub struct OtherWorkspace {
    source_workspace: Workspace,
    latest_workspace: Workspace,
}

/// How a cell differs.
#[derive(Clone, Copy, PartialEq)]
enum Difference {
    None,
    Height(f32),
    Hidden,
}

/// The largest blob by which `latest` differs from `source`, if there is one by the rules; `around` are the positions of the pick and the
/// place on the table.
///
/// Cells that one of the heightmaps did not see are not compared: no data is not height 0. A height is compared with the nine cells about it,
/// so that an edge may move by a cell.
pub fn largest_change(
    source: &Heightmap,
    latest: &Heightmap,
    rules: &ChangeRules,
    around: &[Point2<f64>],
) -> Result<Option<Change>, OtherWorkspace> {
    if source.workspace != latest.workspace {
        return Err(OtherWorkspace {
            source_workspace: source.workspace,
            latest_workspace: latest.workspace,
        });
    }
    let workspace = &source.workspace;
    let is_near = |index: usize| {
        let center = center_of(workspace, index);
        around
            .iter()
            .any(|point| (center - point).norm() <= rules.near_m)
    };
    let near: Vec<bool> = (0..workspace.len()).map(is_near).collect();
    let differences: Vec<Difference> = (0..workspace.len())
        .map(|index| {
            let rule = if near[index] { &rules.near } else { &rules.far };
            difference(source, latest, index, rule.height_m as f32)
        })
        .collect();
    let cell_m2 = workspace.pixel_size_m * workspace.pixel_size_m;
    let mut largest: Option<Change> = None;
    for hidden in [false, true] {
        let belongs = |index: usize| match differences[index] {
            Difference::None => false,
            Difference::Height(_) => !hidden,
            Difference::Hidden => hidden,
        };
        for blob in blobs(workspace, belongs) {
            let near = blob.iter().any(|index| near[*index]);
            let area_m2 = blob.len() as f64 * cell_m2;
            let least_m2 = match (hidden, near) {
                (true, _) => rules.hidden_area_m2,
                (false, true) => rules.near.area_m2,
                (false, false) => rules.far.area_m2,
            };
            if area_m2 < least_m2 || largest.is_some_and(|known| known.area_m2 >= area_m2) {
                continue;
            }
            let centers = blob.iter().map(|index| center_of(workspace, *index).coords);
            let sum = centers.fold(nalgebra::Vector2::zeros(), |sum, center| sum + center);
            let heights = blob.iter().filter_map(|index| match differences[*index] {
                Difference::Height(height_m) => Some(f64::from(height_m)),
                _ => None,
            });
            largest = Some(Change {
                center_m: Point2::from(sum / blob.len() as f64),
                area_m2,
                height_m: heights.max_by(|a, b| a.abs().total_cmp(&b.abs())),
                near,
            });
        }
    }
    Ok(largest)
}

fn center_of(workspace: &Workspace, index: usize) -> Point2<f64> {
    workspace.center(crate::Pixel {
        row: index / workspace.cols,
        col: index % workspace.cols,
    })
}

/// The cells about a cell, itself included.
fn neighbours(workspace: &Workspace, index: usize) -> impl Iterator<Item = usize> + use<> {
    let (rows, cols) = (workspace.rows, workspace.cols);
    let (row, col) = (index / cols, index % cols);
    let rows = row.saturating_sub(1)..(row + 2).min(rows);
    rows.flat_map(move |row| {
        (col.saturating_sub(1)..(col + 2).min(cols)).map(move |col| row * cols + col)
    })
}

fn difference(
    source: &Heightmap,
    latest: &Heightmap,
    index: usize,
    tolerance_m: f32,
) -> Difference {
    let before = latest_range(source, index);
    let Some((lowest_m, highest_m, all_seen)) = before else {
        return Difference::None;
    };
    if !latest.is_seen(index) {
        return if all_seen {
            Difference::Hidden
        } else {
            Difference::None
        };
    }
    let now_m = latest.height_m[index];
    if now_m > highest_m + tolerance_m {
        Difference::Height(now_m - highest_m)
    } else if now_m < lowest_m - tolerance_m {
        Difference::Height(now_m - lowest_m)
    } else {
        Difference::None
    }
}

/// Lowest and highest of the seen cells about a cell, and whether all of them were seen. None where none was.
fn latest_range(heightmap: &Heightmap, index: usize) -> Option<(f32, f32, bool)> {
    let (mut lowest_m, mut highest_m, mut all_seen) = (f32::INFINITY, f32::NEG_INFINITY, true);
    for neighbour in neighbours(&heightmap.workspace, index) {
        if heightmap.is_seen(neighbour) {
            lowest_m = lowest_m.min(heightmap.height_m[neighbour]);
            highest_m = highest_m.max(heightmap.height_m[neighbour]);
        } else {
            all_seen = false;
        }
    }
    (lowest_m <= highest_m).then_some((lowest_m, highest_m, all_seen))
}

/// Sets of cells that belong and share edges.
fn blobs(workspace: &Workspace, belongs: impl Fn(usize) -> bool) -> Vec<Vec<usize>> {
    let (rows, cols) = (workspace.rows, workspace.cols);
    let mut left: Vec<bool> = (0..workspace.len()).map(belongs).collect();
    let mut blobs = Vec::new();
    for start in 0..left.len() {
        if !left[start] {
            continue;
        }
        left[start] = false;
        let (mut blob, mut next) = (vec![start], 0);
        while next < blob.len() {
            let (row, col) = (blob[next] / cols, blob[next] % cols);
            next += 1;
            let sides = [
                (row > 0).then(|| blob[next - 1] - cols),
                (row + 1 < rows).then(|| blob[next - 1] + cols),
                (col > 0).then(|| blob[next - 1] - 1),
                (col + 1 < cols).then(|| blob[next - 1] + 1),
            ];
            for side in sides.into_iter().flatten() {
                if std::mem::take(&mut left[side]) {
                    blob.push(side);
                }
            }
        }
        blobs.push(blob);
    }
    blobs
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A table of grey with a block of 40 mm.
    fn scene() -> Heightmap {
        let mut heightmap = Heightmap::new(Workspace::RAVENS);
        heightmap.rgb.fill(120);
        put(&mut heightmap, 100, 60, 13, 13, 0.04);
        heightmap
    }

    fn put(heightmap: &mut Heightmap, row: usize, col: usize, rows: usize, cols: usize, m: f32) {
        for row in row..row + rows {
            heightmap.height_m[row * 160 + col..row * 160 + col + cols].fill(m);
        }
    }

    fn change(source: &Heightmap, latest: &Heightmap, around: &[Point2<f64>]) -> Option<Change> {
        largest_change(source, latest, &ChangeRules::default(), around).unwrap()
    }

    #[test]
    fn the_same_scene_has_not_changed() {
        assert_eq!(change(&scene(), &scene(), &[]), None);
    }

    #[test]
    fn a_small_object_is_noticed_near_a_pose_and_says_where_it_is() {
        let place = Point2::new(0.5, 0.1);
        let mut latest = scene();
        // 15 x 15 x 10 mm, 20 mm from the place.
        put(&mut latest, 192, 84, 5, 5, 0.01);
        let found = change(&scene(), &latest, &[place]).unwrap();
        assert!(found.near);
        assert!((found.area_m2 - 25.0 * 0.003125f64.powi(2)).abs() < 1e-9);
        assert!((found.height_m.unwrap() - 0.01).abs() < 1e-6);
        let middle = Workspace::RAVENS.center(crate::Pixel { row: 194, col: 86 });
        assert!((found.center_m - middle).norm() < 1e-9);
        // Taken away again it is a change too.
        let gone = change(&latest, &scene(), &[place]).unwrap();
        assert!((gone.height_m.unwrap() + 0.01).abs() < 1e-6);
    }

    #[test]
    fn specks_and_edges_that_move_by_a_cell_are_no_change() {
        let mut latest = Heightmap::new(Workspace::RAVENS);
        latest.rgb.fill(120);
        // The block a cell further, and single cells that are wrong by much.
        put(&mut latest, 101, 61, 13, 13, 0.04);
        for index in (3..51_200).step_by(701) {
            latest.height_m[index] += 0.05;
        }
        let block = Workspace::RAVENS.center(crate::Pixel { row: 106, col: 66 });
        assert_eq!(change(&scene(), &latest, &[block]), None);
        // Three cells further it has moved.
        let mut latest = Heightmap::new(Workspace::RAVENS);
        latest.rgb.fill(120);
        put(&mut latest, 104, 60, 13, 13, 0.04);
        assert!(change(&scene(), &latest, &[block]).is_some());
    }

    #[test]
    fn far_from_picks_and_places_only_larger_changes_count() {
        let mut latest = scene();
        put(&mut latest, 200, 80, 3, 3, 0.01);
        let here = Workspace::RAVENS.center(crate::Pixel { row: 205, col: 80 });
        let far = Point2::new(0.3, -0.4);
        assert_eq!(change(&scene(), &latest, &[far]), None);
        assert!(change(&scene(), &latest, &[far, here]).is_some());
        // A finger.
        put(&mut latest, 200, 80, 20, 5, 0.015);
        assert!(!change(&scene(), &latest, &[far]).unwrap().near);
    }

    #[test]
    fn what_is_not_seen_is_not_at_height_0_and_a_large_shadow_is_a_change() {
        let hide = |heightmap: &mut Heightmap, row: usize, size: usize| {
            for row in row..row + size {
                for index in row * 160 + 60..row * 160 + 60 + size {
                    heightmap.height_m[index] = 0.0;
                    heightmap.rgb[3 * index..3 * index + 3].fill(0);
                }
            }
        };
        // Holes in the block, 40 mm above what they would be taken for.
        let mut latest = scene();
        hide(&mut latest, 103, 5);
        assert_eq!(change(&scene(), &latest, &[]), None);
        assert_eq!(change(&latest, &scene(), &[]), None);
        hide(&mut latest, 180, 12);
        let found = change(&scene(), &latest, &[]).unwrap();
        assert_eq!(found.height_m, None);
    }

    #[test]
    fn heightmaps_of_other_workspaces_are_refused() {
        let other = Heightmap::new(Workspace {
            rows: 300,
            ..Workspace::RAVENS
        });
        let rules = ChangeRules::default();
        let refusal = largest_change(&scene(), &other, &rules, &[]).unwrap_err();
        assert!(refusal.to_string().contains("300"), "{refusal}");
    }
}
