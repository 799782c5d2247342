//! Candidates for the pick: peaks of the pick map, each compared, window by window, with what stands at the place.
//!
//! The pick map compares single vectors, which see some centimetres: blocks that differ in their size only look alike to it. A
//! window sees the whole object.

use nalgebra::Point2;
use tch::{Kind, Tensor};

use crate::correlation::rotated_windows;
use crate::input::Label;
use crate::network::{Features, FirstPlace, Fit, Grid};
use crate::policy::values;
use crate::{Error, NetworkConfig};

/// Candidates are more than so many cells apart, 25 mm at half resolution: as objects are, with room for the gripper between them.
const APART_CELLS: f64 = 4.0;
/// A window is looked for in so many cells around the place: a candidate need not be the very point of the object that was shown.
const SHIFT_CELLS: i64 = 3;
/// What appeared has risen by more than this (of 40 mm), or its colour has changed by more than that (of 128, over three channels)
/// and it has not sunk.
const RISEN: f64 = 0.1;
const RECOLORED: f64 = 0.5;
/// Every so manyth rotation is tried.
const TURN_STRIDE: usize = 2;

/// Whether two cells are too near for two candidates.
fn are_near(grid: &Grid, one: usize, other: usize) -> bool {
    let point = |cell: usize| Point2::new((cell % grid.cols) as f64, (cell / grid.cols) as f64);
    (point(one) - point(other)).norm() <= APART_CELLS
}

/// The cells of the highest logits that are not near one another, at most `count`, the highest first. Cells of minus infinity are
/// none.
fn peaks(grid: &Grid, logits: &[f32], count: usize) -> Vec<usize> {
    let mut order: Vec<usize> = (0..logits.len())
        .filter(|cell| logits[*cell] > f32::NEG_INFINITY)
        .collect();
    order.sort_unstable_by(|one, other| {
        logits[*other].total_cmp(&logits[*one]).then(one.cmp(other))
    });
    let mut peaks: Vec<usize> = Vec::with_capacity(count);
    for cell in order {
        if peaks.len() == count {
            break;
        }
        if !peaks.iter().any(|peak| are_near(grid, *peak, cell)) {
            peaks.push(cell);
        }
    }
    peaks
}

/// The part of the key around a place that windows are looked for in: its first row and column, and its edge length.
struct Crop {
    row: i64,
    col: i64,
    edge: i64,
}

impl Crop {
    fn new(grid: &Grid, place: usize) -> Self {
        let edge = grid.window as i64 + 2 * SHIFT_CELLS;
        let begin = |cell: usize, len: usize| {
            let len = len as i64 + 2 * grid.margin as i64;
            (cell as i64 - SHIFT_CELLS).clamp(0, len - edge)
        };
        Self {
            row: begin(place / grid.cols, grid.rows),
            col: begin(place % grid.cols, grid.cols),
            edge,
        }
    }

    /// Of a key with its margin.
    fn of(&self, key: &Tensor) -> Tensor {
        key.narrow(2, self.row, self.edge)
            .narrow(3, self.col, self.edge)
    }

    /// Cells that windows are compared at, along each edge.
    fn places(grid: &Grid, edge: i64) -> i64 {
        edge - grid.window as i64 + 1
    }
}

fn correlate(key: &Tensor, windows: &Tensor) -> Tensor {
    key.conv2d(windows, None::<&Tensor>, [1, 1], [0, 0], [1, 1], 1)
        .squeeze_dim(0)
}

/// Windows of one sample's query (1 x C x rows x cols) at points of the grid, each at all these turns: (points turns) x C x k x k.
fn windows(
    grid: &Grid,
    query: &Tensor,
    points: &[Point2<f64>],
    turns: &[usize],
    rotations: usize,
) -> Tensor {
    let size = query.size();
    let query = query.expand([points.len() as i64, size[1], size[2], size[3]], false);
    let turns = vec![turns.to_vec(); points.len()];
    let (margin, sampling) = (grid.query_margin, grid.sampling);
    rotated_windows(&query, margin, grid, sampling, points, &turns, rotations).flatten(0, 1)
}

/// Minus half the mean squared difference between the cells at a pick, at each turn, and those that appeared at the place:
/// turns x places x places. Of the only sample.
fn shape_difference(model: &Compared<'_>, crop: &Crop, pick: Point2<f64>) -> Tensor {
    let (grid, [seen, before, shown]) = (model.grid, &model.fit.cells);
    let sum = |x: &Tensor| x.sum_dim_intlist([1].as_slice(), true, None::<Kind>);
    let change = shown - before;
    let rise = change.narrow(1, 3, 1);
    let recolored = sum(&change.narrow(1, 0, 3).abs()).gt(RECOLORED);
    let appeared = rise
        .gt(RISEN)
        .logical_or(&recolored.logical_and(&rise.gt(-RISEN)))
        .to_kind(seen.kind());
    // With its surroundings, so that it is told from a larger thing.
    let mask = appeared.max_pool2d([5, 5], [1, 1], [2, 2], [1, 1], false);
    let query = Tensor::cat(&[seen, &sum(&seen.square()), &mask.ones_like()], 1);
    let key = Tensor::cat(
        &[
            &mask * shown,
            &mask * -0.5,
            &mask * sum(&shown.square()) * -0.5,
            mask.shallow_clone(),
            -&mask * shown.narrow(1, 3, 1),
        ],
        1,
    );
    let key = crop.of(&key.constant_pad_nd([grid.margin as i64; 4]));
    let turns: Vec<usize> = (0..model.rotations).collect();
    let windows = windows(grid, &query, &[pick], &turns, model.rotations);
    let squares = correlate(&key.narrow(1, 0, 6), &windows);
    // What all heights differ by does not count: an object may stand on another one.
    let heights = Tensor::cat(&[windows.narrow(1, 3, 1), windows.narrow(1, 5, 1)], 1);
    let heights = correlate(&key.narrow(1, 6, 2), &heights);
    let mask = key.narrow(1, 6, 1);
    let area =
        correlate(&mask, &windows.narrow(0, 0, 1).narrow(1, 5, 1).ones_like()).clamp_min(1.0);
    squares / &area + (heights / area).square() * 0.5
}

/// How well what stands at each candidate, turned and shifted as it fits best, fits what stands at the place: logits.
fn fits(model: &Compared<'_>, sample: i64, candidates: &[usize], place: usize) -> Tensor {
    let Compared { grid, fit, .. } = *model;
    let turns: Vec<usize> = (0..model.rotations).step_by(TURN_STRIDE).collect();
    let points: Vec<_> = candidates
        .iter()
        .map(|cell| Point2::new((cell % grid.cols) as f64, (cell / grid.cols) as f64))
        .collect();
    let crop = Crop::new(grid, place);
    let query = fit.query.narrow(0, sample, 1);
    let windows = windows(grid, &query, &points, &turns, model.rotations);
    let logits = correlate(&crop.of(&fit.key.narrow(0, sample, 1)), &windows) * model.scale;
    let count = candidates.len() as i64;
    logits.view([count, -1]).amax([1].as_slice(), false)
}

/// What a network says that compares candidates, and how.
struct Compared<'a> {
    grid: &'a Grid,
    first: &'a FirstPlace,
    fit: &'a Fit,
    scale: &'a Tensor,
    rotations: usize,
    shape_weight: f64,
}

impl<'a> Compared<'a> {
    fn new(grid: &'a Grid, features: &'a Features, config: &NetworkConfig) -> Option<Self> {
        let first = features.first.as_ref()?;
        Some(Self {
            grid,
            first,
            fit: first.fit.as_ref()?,
            scale: &features.scale,
            rotations: config.rotations,
            shape_weight: config.shape_weight(),
        })
    }

    /// The cell of the highest place logit of the only sample.
    fn place(&self) -> usize {
        self.first.place.argmax(None, false).int64_value(&[]) as usize
    }
}

/// Adds to a pick map (row-major logits) how well its highest peaks fit what is to be placed; cells around a peak share its fit, all
/// others have the worst.
pub(crate) fn add_fits(
    grid: &Grid,
    features: &Features,
    config: &NetworkConfig,
    logits: &mut [f32],
) -> Result<(), Error> {
    let Some(model) = Compared::new(grid, features, config) else {
        return Ok(());
    };
    let peaks = peaks(grid, logits, config.candidates());
    if peaks.is_empty() {
        return Ok(());
    }
    let fits = fits(&model, 0, &peaks, model.place());
    let fits = values(&fits, "the fits of the candidates")?;
    let worst = fits.iter().copied().fold(f32::INFINITY, f32::min);
    for (cell, logit) in logits.iter_mut().enumerate() {
        let peak = peaks.iter().position(|peak| are_near(grid, *peak, cell));
        *logit += peak.map_or(worst, |peak| fits[peak]);
    }
    Ok(())
}

/// Adds to place logits (1 x rotations x rows x cols) how well the cells at the pick, turned and shifted, fit what appeared at the
/// place; places further off have the worst.
pub(crate) fn add_shape(
    grid: &Grid,
    features: &Features,
    config: &NetworkConfig,
    pick_px: Point2<f64>,
    logits: &Tensor,
) {
    let model = Compared::new(grid, features, config).filter(|model| model.shape_weight > 0.0);
    let Some(model) = model else { return };
    let pick = pick_px.map(|coordinate_px| grid.index(coordinate_px));
    let crop = Crop::new(grid, model.place());
    let shape = shape_difference(&model, &crop, pick);
    let shape = shape * model.shape_weight;
    let worst = shape.min();
    // Places count from the margin's corner. Those beyond the last row or column are none.
    let places = Crop::places(grid, crop.edge);
    let rows = places.min(grid.rows as i64 - crop.row);
    let cols = places.min(grid.cols as i64 - crop.col);
    let _ = logits
        .narrow(2, crop.row, rows)
        .narrow(3, crop.col, cols)
        .g_add_(
            &(shape - worst)
                .narrow(1, 0, rows)
                .narrow(2, 0, cols)
                .unsqueeze(0),
        );
}

/// Mean loss of the choice among candidates: cross entropy of the true pick's, or of the pick itself where none is near it.
pub(crate) fn candidate_loss(
    grid: &Grid,
    features: &Features,
    config: &NetworkConfig,
    labels: &[Label],
) -> Tensor {
    let Some(model) = Compared::new(grid, features, config) else {
        return features.nothing();
    };
    let count = config.candidates();
    let cell_of = |point_px: Point2<f64>| {
        let nearest = |coordinate_px: f64, len: usize| {
            let index = (grid.index(coordinate_px) + 0.5).floor();
            index.clamp(0.0, (len - 1) as f64) as usize
        };
        nearest(point_px.y, grid.rows) * grid.cols + nearest(point_px.x, grid.cols)
    };
    let losses: Vec<Tensor> = labels
        .iter()
        .enumerate()
        .map(|(sample, label)| {
            let sample = sample as i64;
            let pick = features.pick.detach().get(sample).flatten(0, -1);
            let logits = Vec::<f32>::try_from(&pick.to_kind(Kind::Float)).unwrap_or_default();
            let (right, place) = (cell_of(label.pick_px), cell_of(label.place_px));
            let mut candidates = peaks(grid, &logits, count);
            let known = candidates
                .iter()
                .position(|peak| are_near(grid, *peak, right));
            let target = known.unwrap_or_else(|| {
                candidates.truncate(count - 1);
                candidates.push(right);
                candidates.len() - 1
            });
            let fits = fits(&model, sample, &candidates, place);
            let cells: Vec<i64> = candidates.iter().map(|cell| *cell as i64).collect();
            let cells = Tensor::from_slice(&cells).to_device(pick.device());
            let logits = fits + pick.index_select(0, &cells);
            logits.logsumexp([0].as_slice(), false) - logits.get(target as i64)
        })
        .collect();
    Tensor::stack(&losses, 0).mean(None::<Kind>)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Interpolation, Matching, Network};

    const GRID: Grid = Grid {
        rows: 60,
        cols: 40,
        stride: 2,
        window: 13,
        margin: 6,
        query_margin: 0,
        sampling: Interpolation::Bilinear,
        subcell: true,
    };

    /// An image of squares, each with its middle and edge length in cells.
    fn squares(squares: &[(usize, usize, usize)]) -> Tensor {
        let mut values = vec![0.0_f32; GRID.rows * GRID.cols];
        for &(row, col, edge) in squares {
            for row in row - edge / 2..=row + edge / 2 {
                values[row * GRID.cols + col - edge / 2..=row * GRID.cols + col + edge / 2]
                    .fill(1.0);
            }
        }
        Tensor::from_slice(&values).view([1, 1, GRID.rows as i64, GRID.cols as i64])
    }

    /// What a network would say whose features are the image itself, of squares that are seen and one that was shown at its place.
    fn features(seen: &[(usize, usize, usize)], shown: (usize, usize, usize)) -> Features {
        let (pick, seen, shown_image) = (squares(seen), squares(seen), squares(&[shown]));
        let place = Tensor::zeros_like(&pick).squeeze_dim(1);
        let _ = place
            .get(0)
            .get(shown.0 as i64)
            .get(shown.1 as i64)
            .fill_(5.0);
        let gate = shown_image.ones_like();
        let key = Tensor::cat(
            &[
                &gate * &shown_image,
                -&gate,
                -&gate * shown_image.square() * 0.5,
            ],
            1,
        );
        Features {
            pick: pick.squeeze_dim(1),
            query: seen.shallow_clone(),
            key: shown_image.constant_pad_nd([GRID.margin as i64; 4]),
            scale: Tensor::ones([1], (Kind::Float, tch::Device::Cpu)),
            first: Some(FirstPlace {
                place,
                fit: Some(Fit {
                    query: Tensor::cat(&[&seen, &(seen.square() * 0.5), &gate], 1),
                    key: key.constant_pad_nd([GRID.margin as i64; 4]),
                    cells: [&seen, &seen.zeros_like(), &shown_image]
                        .map(|image| image.expand([1, 4, -1, -1], false)),
                }),
                done: Tensor::zeros([1], (Kind::Float, tch::Device::Cpu)),
            }),
        }
    }

    fn config(candidates: usize, shape_weight: f64) -> NetworkConfig {
        NetworkConfig::new(Network::Matching(Matching {
            candidates,
            shape_weight,
            ..Matching::default()
        }))
    }

    fn picked(features: &Features) -> (usize, usize) {
        let mut logits = values(&features.pick, "the pick map").unwrap();
        add_fits(&GRID, features, &config(6, 0.0), &mut logits).unwrap();
        let best = (0..logits.len()).max_by(|one, other| logits[*one].total_cmp(&logits[*other]));
        let best = best.unwrap();
        (best / GRID.cols, best % GRID.cols)
    }

    #[test]
    fn peaks_are_the_highest_first_and_not_near_one_another() {
        let mut logits = vec![f32::NEG_INFINITY; GRID.rows * GRID.cols];
        for (row, col, logit) in [(3, 3, 1.0), (3, 4, 2.0), (30, 20, 3.0), (50, 9, 0.5)] {
            logits[row * GRID.cols + col] = logit;
        }
        let cells: Vec<_> = peaks(&GRID, &logits, 4);
        let cell = |row, col| row * GRID.cols + col;
        assert_eq!(cells, [cell(30, 20), cell(3, 4), cell(50, 9)]);
        assert_eq!(peaks(&GRID, &logits, 1), [cell(30, 20)]);
    }

    #[test]
    fn of_squares_that_look_alike_the_one_of_the_shown_size_is_picked() {
        let seen = [(10, 10, 3), (10, 28, 7), (30, 10, 5)];
        for right in seen {
            let (row, col) = picked(&features(&seen, (45, 22, right.2)));
            let away = row.abs_diff(right.0).max(col.abs_diff(right.1));
            assert!(away <= right.2 / 2, "{right:?}: picked {row}, {col}");
        }
    }

    #[test]
    fn a_place_in_the_corner_is_compared_too() {
        let seen = [(20, 10, 3), (40, 28, 5)];
        let (row, col) = picked(&features(&seen, (2, 2, 5)));
        assert!(
            row.abs_diff(40).max(col.abs_diff(28)) <= 2,
            "picked {row}, {col}"
        );
    }

    #[test]
    fn the_cells_themselves_say_how_an_oblong_was_turned() {
        let oblong = |rows: std::ops::RangeInclusive<usize>,
                      cols: std::ops::RangeInclusive<usize>| {
            let mut values = vec![0.0_f32; GRID.rows * GRID.cols];
            for row in rows {
                values[row * GRID.cols + cols.start()..=row * GRID.cols + cols.end()].fill(1.0);
            }
            Tensor::from_slice(&values).view([1, 1, GRID.rows as i64, GRID.cols as i64])
        };
        let (lying, standing) = (oblong(9..=11, 6..=14), oblong(41..=49, 21..=23));
        let mut features = features(&[(10, 10, 3)], (45, 22, 3));
        let fit = features.first.as_mut().and_then(|first| first.fit.as_mut());
        fit.unwrap().cells = [&lying, &lying.zeros_like(), &standing]
            .map(|image| image.expand([1, 4, -1, -1], false));
        let logits = Tensor::zeros([1, 36, 60, 40], (Kind::Float, tch::Device::Cpu));
        let pick_px = Point2::new(GRID.coordinate_px(10.0), GRID.coordinate_px(10.0));
        add_shape(&GRID, &features, &config(4, 20.0), pick_px, &logits);
        let best = logits.argmax(None, false).int64_value(&[]) as usize;
        let (turn, row, col) = (best / 2400, best / 40 % 60, best % 40);
        assert!(turn == 9 || turn == 27, "turn {turn}");
        assert_eq!((row, col), (45, 22));
    }

    #[test]
    fn the_loss_is_small_where_the_right_one_fits_best_and_large_where_another_does() {
        let label = |row: usize, col: usize| Label {
            pick_px: Point2::new(
                GRID.coordinate_px(col as f64),
                GRID.coordinate_px(row as f64),
            ),
            place_px: Point2::new(GRID.coordinate_px(22.0), GRID.coordinate_px(45.0)),
            rotation: 0,
            done: false,
        };
        let features = features(&[(10, 10, 3), (10, 28, 7)], (45, 22, 7));
        let loss = |row, col| {
            let loss = candidate_loss(&GRID, &features, &config(4, 0.0), &[label(row, col)]);
            loss.double_value(&[])
        };
        // Several candidates are on the large square.
        assert!(loss(10, 28) < 2.0, "{}", loss(10, 28));
        assert!(loss(10, 10) > 8.0, "{}", loss(10, 10));
    }
}
