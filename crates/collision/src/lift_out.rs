//! The object that was picked, as the heightmap before the pick shows it.

use crate::Carried;
use heightmap::Heightmap;
use nalgebra::{Isometry3, Point2, Point3, Translation3, Vector3};
use ur5::Shape;

/// A cell belongs to the object if its height differs by less from that of a neighbour that does.
const STEP_M: f32 = 0.006;
/// It also does where its height differs by less from that of the pick: beads of a cable have gaps.
const LEVEL_M: f32 = 0.008;
/// Parts of something thin that are so many cells away from each other are parts of the same: the shadow of what stands beside it lies between them.
const BRIDGE: isize = 2;
/// Cells further from the pick belong to something else, the table for instance.
const REACH_M: f64 = 0.15;
/// How far from its axis the cup holds a part of something larger.
const AT_THE_CUP_M: f64 = 0.02;
/// What is nowhere wider than twice this is thin.
const THIN_M: f64 = 0.02;

/// The object under a pick and the heightmap without it. `tip` is the pose of the suction tip at the contact: the box is fixed to it. Where it
/// stood the heightmap is as high as the highest of the lower cells around it.
///
/// Of something longer than 0.15 m only what is within 20 mm of the cup is lifted out; where it is thin as well, that counts as a part of a cable, which
/// yields.
///
/// None when the pick lies outside the heightmap.
pub fn lift_out(heightmap: &Heightmap, tip: &Isometry3<f64>) -> Option<(Carried, Heightmap)> {
    let workspace = &heightmap.workspace;
    let pick = Point2::from(tip.translation.vector.xy());
    let start = workspace.pixel(&pick)?;
    let (rows, cols) = (workspace.rows, workspace.cols);
    let start = start.row * cols + start.col;
    let center = |index: usize| {
        workspace.center(heightmap::Pixel {
            row: index / cols,
            col: index % cols,
        })
    };
    // Where the pick stands out, what is as low as the ground is no part of it: the sides of a cable may seem to slope.
    let ground_m = ground_m(heightmap, |index| (center(index) - pick).norm() < REACH_M);
    let stands_out = heightmap.height_m[start] > ground_m + STEP_M;
    let is_ground =
        |index: usize| stands_out && heightmap.height_m[index] < ground_m + 0.5 * STEP_M;
    // Cells without a step between them, and those around them, which are something else. With a bridge, parts so many cells away that are as high as the pick belong to it.
    let grown = |bridge: isize| {
        let mut member = vec![false; workspace.len()];
        member[start] = true;
        let (mut object, mut border, mut next) = (vec![start], Vec::new(), 0);
        while next < object.len() {
            let index = object[next];
            next += 1;
            for side in within((index / cols, index % cols), (rows, cols), bridge) {
                if member[side] || !heightmap.is_seen(side) {
                    continue;
                }
                let step_m = (heightmap.height_m[side] - heightmap.height_m[index]).abs();
                let level_m = (heightmap.height_m[side] - heightmap.height_m[start]).abs();
                let belongs = bridge == 1 && step_m < STEP_M || stands_out && level_m < LEVEL_M;
                if belongs && !is_ground(side) && (center(side) - pick).norm() < REACH_M {
                    member[side] = true;
                    object.push(side);
                } else {
                    border.push(side);
                }
            }
        }
        (object, member, border)
    };
    // No step sets it apart from what is around it: a cable, or something as flat as the table's noise. What hangs at the cup counts.
    let goes_on = |object: &[usize]| {
        let far_m = REACH_M - 2.0 * workspace.pixel_size_m;
        object
            .iter()
            .any(|index| (center(*index) - pick).norm() > far_m)
    };
    let thin_px = THIN_M / workspace.pixel_size_m;
    let is_thin =
        |object: &[usize], member: &[bool]| is_thin(object, member, (rows, cols), thin_px);
    let (mut object, member, mut border) = grown(1);
    let thin = is_thin(&object, &member);
    let mut is_part = goes_on(&object);
    if thin && !is_part {
        // What stands against a cable hides some of it from the cameras.
        let (whole, member, _) = grown(BRIDGE);
        is_part = goes_on(&whole) && is_thin(&whole, &member);
    }
    let yields = is_part && thin;
    if is_part {
        object.retain(|index| (center(*index) - pick).norm() < AT_THE_CUP_M);
        border.clear();
    }
    let height = |index: &usize| heightmap.height_m[*index];
    let lowest_m = object.iter().map(height).fold(f32::INFINITY, f32::min);
    let lower = border
        .iter()
        .map(height)
        .filter(|height_m| *height_m < lowest_m);
    let floor_m = lower.fold(0.0, f32::max);
    let around_m = border.iter().map(height).fold(lowest_m, f32::min);
    let mut rest = heightmap.clone();
    let (mut low, mut high) = (
        Vector3::repeat(f64::INFINITY),
        Vector3::repeat(f64::NEG_INFINITY),
    );
    let half_m = 0.5 * workspace.pixel_size_m;
    for index in object {
        let at = center(index);
        let top_m = f64::from(heightmap.height_m[index]);
        for corner in [
            (-half_m, -half_m),
            (-half_m, half_m),
            (half_m, -half_m),
            (half_m, half_m),
        ] {
            // As deep as it may be: down to the lowest cell around it.
            for z_m in [f64::from(around_m.min(lowest_m)), top_m] {
                let point = Point3::new(at.x + corner.0, at.y + corner.1, z_m);
                let in_tip = tip.inverse_transform_point(&point).coords;
                (low, high) = (low.inf(&in_tip), high.sup(&in_tip));
            }
        }
        rest.height_m[index] = floor_m;
    }
    // Something flat has some thickness.
    let size_m = (high - low).sup(&Vector3::repeat(1e-3));
    let carried = Carried {
        shape: Shape::Cuboid { size_m },
        tip_from_shape: Isometry3::from_parts(
            Translation3::from(0.5 * (low + high)),
            nalgebra::UnitQuaternion::identity(),
        ),
        yields,
    };
    Some((carried, rest))
}

/// The cells around a cell, up to so many away: its sides where that is one.
fn within(
    (row, col): (usize, usize),
    (rows, cols): (usize, usize),
    reach: isize,
) -> impl Iterator<Item = usize> {
    let offsets =
        (-reach..=reach).flat_map(move |down| (-reach..=reach).map(move |right| (down, right)));
    offsets
        .filter(move |(down, right)| reach > 1 || down.abs() + right.abs() == 1)
        .filter_map(move |(down, right)| {
            let (row, col) = (
                row.checked_add_signed(down)?,
                col.checked_add_signed(right)?,
            );
            (row < rows && col < cols).then_some(row * cols + col)
        })
}

/// Height of the ground: most of the seen cells among some are higher than the lowest tenth of them.
fn ground_m(heightmap: &Heightmap, among: impl Fn(usize) -> bool) -> f32 {
    let seen = (0..heightmap.height_m.len()).filter(|index| heightmap.is_seen(*index));
    let mut heights_m: Vec<f32> = seen
        .filter(|index| among(*index))
        .map(|index| heightmap.height_m[index])
        .collect();
    heights_m.sort_by(f32::total_cmp);
    heights_m.get(heights_m.len() / 10).copied().unwrap_or(0.0)
}

/// Whether every cell of an object has a cell beside the object within so many cells.
fn is_thin(object: &[usize], member: &[bool], (rows, cols): (usize, usize), within: f64) -> bool {
    let steps = within.ceil() as isize;
    let offsets: Vec<(isize, isize)> = (-steps..=steps)
        .flat_map(|row| (-steps..=steps).map(move |col| (row, col)))
        .filter(|(row, col)| (*row as f64).hypot(*col as f64) <= within)
        .collect();
    object.iter().all(|index| {
        let (row, col) = (index / cols, index % cols);
        offsets.iter().any(|(down, right)| {
            let near = (
                row.checked_add_signed(*down),
                col.checked_add_signed(*right),
            );
            let (Some(row), Some(col)) = near else {
                return false;
            };
            row < rows && col < cols && !member[row * cols + col]
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use heightmap::Workspace;
    use nalgebra::Isometry2;
    use ur5::Arm;

    #[test]
    fn a_block_is_lifted_out_of_the_heightmap_with_its_size() {
        let mut heightmap = Heightmap::new(Workspace::RAVENS);
        heightmap.rgb.fill(100);
        // 40 x 20 mm and 30 mm high on a stand of 10 mm.
        for row in 90..130 {
            heightmap.height_m[row * 160 + 40..row * 160 + 100].fill(0.01);
        }
        let before = heightmap.clone();
        for row in 100..112 {
            heightmap.height_m[row * 160 + 60..row * 160 + 66].fill(0.04);
        }
        let at = heightmap.workspace.point_m(&Point2::new(63.0, 106.0));
        let tip = Arm::tip_down(&Isometry2::new(at.coords, 0.3), 0.04);
        let (carried, rest) = lift_out(&heightmap, &tip).unwrap();
        assert_eq!(rest, before);
        let Shape::Cuboid { size_m } = carried.shape else {
            panic!("{carried:?}");
        };
        // In the frame of the tip, which is turned by 0.3 rad.
        let (s, c) = 0.3f64.sin_cos();
        let (x_m, y_m) = (6.0 * 0.003125, 12.0 * 0.003125);
        let expected = Vector3::new(x_m * c + y_m * s, x_m * s + y_m * c, 0.03);
        assert!((size_m - expected).amax() < 1e-6, "{size_m} {expected}");
        // Below the tip, whose z points down.
        assert!((carried.tip_from_shape.translation.z - 0.015).abs() < 1e-6);
        assert!(!carried.yields);
        let outside = Arm::tip_down(&Isometry2::translation(2.0, 0.0), 0.0);
        assert!(lift_out(&heightmap, &outside).is_none());
    }
}
