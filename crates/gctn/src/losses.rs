//! Cross entropies of pick and place.

use nalgebra::Point2;
use rand::{Rng, RngExt};
use tch::{Kind, Tensor};

use crate::correlation::{correlate, rotated_windows};
use crate::input::Label;
use crate::network::{Features, Grid};
use crate::{Interpolation, PlaceLoss};

/// Continuous index on the grid of a point of the image.
fn index(grid: &Grid, point_px: Point2<f64>) -> Point2<f64> {
    point_px.map(|coordinate| grid.index(coordinate))
}

/// Where the true points are, as distributions over the grid: N x rows x cols.
pub(crate) fn targets(
    grid: &Grid,
    sigma_cells: f64,
    points_px: &[Point2<f64>],
    like: &Tensor,
) -> Tensor {
    let (rows, cols) = (grid.rows, grid.cols);
    let mut values = vec![0.0; points_px.len() * rows * cols];
    for (point, values) in points_px.iter().zip(values.chunks_exact_mut(rows * cols)) {
        let point = index(grid, *point);
        // Rounds to the cell that holds the point; the last edge belongs to the last cell.
        let nearest =
            |value: f64, len: usize| (value + 0.5).floor().clamp(0.0, (len - 1) as f64) as usize;
        let (row, col) = (nearest(point.y, rows), nearest(point.x, cols));
        if sigma_cells == 0.0 {
            values[row * cols + col] = 1.0;
            continue;
        }
        let reach = (4.0 * sigma_cells).ceil() as usize;
        let around =
            |center: usize, len: usize| center.saturating_sub(reach)..(center + reach + 1).min(len);
        let mut sum = 0.0;
        for row in around(row, rows) {
            for col in around(col, cols) {
                let distance = (Point2::new(col as f64, row as f64) - point).norm_squared();
                let value = (-distance / (2.0 * sigma_cells * sigma_cells)).exp();
                values[row * cols + col] = value;
                sum += value;
            }
        }
        // A narrow Gaussian between cells may vanish everywhere but at the nearest.
        if sum > f64::MIN_POSITIVE {
            values.iter_mut().for_each(|value| *value /= sum);
        } else {
            values[row * cols + col] = 1.0;
        }
    }
    Tensor::from_slice(&values)
        .view([-1, rows as i64, cols as i64])
        .to_kind(like.kind())
        .to_device(like.device())
}

/// Mean over samples of the cross entropy between `target` (N x ...) and the softmax over all of `logits`
/// (N x ...), of which `target` covers the part `covered` (N x ...).
fn cross_entropy(logits: &Tensor, covered: &Tensor, target: &Tensor) -> Tensor {
    let total = logits.flatten(1, -1).logsumexp([1].as_slice(), false);
    let right =
        (covered * target)
            .flatten(1, -1)
            .sum_dim_intlist([1].as_slice(), false, None::<Kind>);
    (total - right).mean(None::<Kind>)
}

/// Mean pick loss of a batch.
pub(crate) fn pick_loss(
    grid: &Grid,
    sigma_cells: f64,
    features: &Features,
    labels: &[Label],
) -> Tensor {
    let points: Vec<_> = labels.iter().map(|label| label.pick_px).collect();
    let target = targets(grid, sigma_cells, &points, &features.pick);
    cross_entropy(&features.pick, &features.pick, &target)
}

/// Logits of the given rotations (as many for each sample): N x rotations x rows x cols.
pub(crate) fn place_logits(
    grid: &Grid,
    features: &Features,
    picks_px: &[Point2<f64>],
    turns: &[Vec<usize>],
    rotations: usize,
) -> Tensor {
    let windows = query_windows(grid, features, picks_px, turns, rotations);
    correlate(&features.key, &windows, grid) * &features.scale
}

pub(crate) fn query_windows(
    grid: &Grid,
    features: &Features,
    picks_px: &[Point2<f64>],
    turns: &[Vec<usize>],
    rotations: usize,
) -> Tensor {
    let centers: Vec<_> = picks_px.iter().map(|pick| index(grid, *pick)).collect();
    let (query, margin) = (&features.query, grid.query_margin);
    rotated_windows(
        query,
        margin,
        grid,
        grid.sampling,
        &centers,
        turns,
        rotations,
    )
}

/// Mean place loss of a batch.
pub(crate) fn place_loss(
    grid: &Grid,
    loss: PlaceLoss,
    sigma_cells: f64,
    rotations: usize,
    features: &Features,
    labels: &[Label],
    rng: &mut impl Rng,
) -> Tensor {
    let picks: Vec<_> = labels.iter().map(|label| label.pick_px).collect();
    let places: Vec<_> = labels.iter().map(|label| label.place_px).collect();
    let target = targets(grid, sigma_cells, &places, &features.key);
    let all: Vec<Vec<usize>> = labels.iter().map(|_| (0..rotations).collect()).collect();
    let right: Vec<_> = labels.iter().map(|label| label.rotation as i64).collect();
    let right = Tensor::from_slice(&right).to_device(features.key.device());
    match loss {
        PlaceLoss::AllRotations => {
            let logits = place_logits(grid, features, &picks, &all, rotations);
            let size = [labels.len() as i64, 1, grid.rows as i64, grid.cols as i64];
            let covered = logits.gather(1, &right.view([-1, 1, 1, 1]).expand(size, false), false);
            cross_entropy(&logits, &covered.squeeze_dim(1), &target)
        }
        PlaceLoss::RightAndOneWrong => {
            let windows = query_windows(grid, features, &picks, &all, rotations);
            // All rotations at the true place: the key's own window there, unturned.
            let centers: Vec<_> = places.iter().map(|place| index(grid, *place)).collect();
            let unturned = vec![vec![0]; labels.len()];
            let sampling = Interpolation::Bilinear;
            let (key, margin) = (&features.key, grid.margin);
            let there =
                rotated_windows(key, margin, grid, sampling, &centers, &unturned, rotations);
            let dots = windows
                .flatten(2, -1)
                .matmul(&there.flatten(2, -1).transpose(1, 2));
            let dots = dots.squeeze_dim(2) * &features.scale;
            let turn_loss =
                dots.cross_entropy_loss(&right, None::<&Tensor>, tch::Reduction::Mean, -100, 0.0);
            if rotations == 1 {
                let logits = correlate(key, &windows, grid) * &features.scale;
                return turn_loss + cross_entropy(&logits, &logits.squeeze_dim(1), &target);
            }
            let chosen: Vec<i64> = labels
                .iter()
                .flat_map(|label| {
                    let wrong = (label.rotation + rng.random_range(1..rotations)) % rotations;
                    [label.rotation as i64, wrong as i64]
                })
                .collect();
            let size = windows.size();
            let chosen = Tensor::from_slice(&chosen).to_device(key.device());
            let chosen = chosen
                .view([-1, 2, 1, 1, 1])
                .expand([size[0], 2, size[2], size[3], size[4]], false);
            let logits = correlate(key, &windows.gather(1, &chosen, false), grid) * &features.scale;
            turn_loss + cross_entropy(&logits, &logits.select(1, 0), &target)
        }
    }
}
