//! Candidates for the pick: peaks of the pick map, each compared, window by window, with what stands at the place.
//!
//! The pick map compares single vectors, which see some centimetres: blocks that differ in their size only look alike to it. A
//! window sees the whole object.

use nalgebra::{Point2, Vector2};
use tch::{Kind, Tensor};

use crate::correlation::{rotated_windows, sampled_windows};
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
/// The cells themselves take at most so much from the logit of a candidate, and of a turn: they decide between those that look alike
/// otherwise.
const MOST_TAKEN: f64 = 2.0;
const MOST_TAKEN_OF_TURNS: f64 = 4.0;
/// What fine cells may say of turns.
struct SayOfTurns {
    /// Factor of the shape weight.
    weight: f64,
    /// They take at most so much from a logit.
    most_taken: f64,
    /// They take nothing where the best turn differs by more than this.
    unlike: f64,
}

/// Cables differ by 0.15 to 0.57, things that keep their shape by at most 0.17, and seen by cameras with noise by at most 0.24.
const BESIDE_SURE_FEATURES: SayOfTurns = SayOfTurns {
    weight: 1.0,
    most_taken: 8.0,
    unlike: 0.2,
};
const BESIDE_UNSURE_FEATURES: SayOfTurns = SayOfTurns {
    weight: 2.0,
    most_taken: 12.0,
    unlike: 0.3,
};
/// The learned features are sure of a turn whose logit is so much above the mean over turns: of cables by 9 to 37, of things that keep
/// their shape by 2 to 9, and seldom up to 11.
const SURE_OF_TURN: f64 = 9.0;
/// They take nothing from candidates where the best one differs by more than this: what is moved has no shape of its own, or hides.
const UNLIKE: f64 = 0.1;
/// A candidate stands on the lowest of what is so many cells around it, 62 mm.
const AROUND_CELLS: usize = 10;
/// Heights count down to this below what is compared, and up to this above it (of 40 mm).
const DEEPEST: f64 = 0.5;
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
    /// The cell of the place.
    place: usize,
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
            place,
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
    strided(key, windows, 1)
}

fn strided(key: &Tensor, windows: &Tensor, stride: i64) -> Tensor {
    key.conv2d(windows, None::<&Tensor>, [stride; 2], [0, 0], [1, 1], 1)
        .squeeze_dim(0)
}

/// By which cells shapes are compared.
#[derive(Clone, Copy, PartialEq)]
enum Fineness {
    /// Those of the grid.
    Grid,
    /// Those of the heightmap, two for each of the grid along rows and columns.
    Heightmap,
}

/// Cells of the heightmap for one of the grid, along each edge.
const FINE: i64 = 2;

impl Fineness {
    /// Cells for one of the grid, along each edge.
    fn factor(self) -> i64 {
        match self {
            Self::Grid => 1,
            Self::Heightmap => FINE,
        }
    }

    /// Of an image (N x C x rows x cols, as many of the heightmap as cells of this fineness need).
    fn of(self, image: &Tensor) -> Tensor {
        match self {
            Self::Grid => image.avg_pool2d([FINE; 2], [FINE; 2], [0, 0], false, true, None::<i64>),
            Self::Heightmap => image.shallow_clone(),
        }
    }

    /// A square of an image (1 x 4 x rows x cols of the heightmap), in cells of this fineness from this row and column on, so many along
    /// each edge: colour and height, then 1. Outside the image all are 0.
    fn square(self, image: &Tensor, [row, col]: [i64; 2], edge: i64) -> Tensor {
        let size = image.size();
        let factor = FINE / self.factor();
        let within = |first: i64, len: i64| {
            let [first, end] = [first, first + edge].map(|at| (factor * at).clamp(0, len));
            (first, end - first)
        };
        let ((first_row, rows), (first_col, cols)) = (within(row, size[2]), within(col, size[3]));
        let inside = image.narrow(2, first_row, rows).narrow(3, first_col, cols);
        let inside = self.of(&inside);
        let one = inside.narrow(1, 0, 1).ones_like();
        let [before_row, before_col] = [first_row / factor - row, first_col / factor - col];
        let [after_row, after_col] = [
            edge - before_row - rows / factor,
            edge - before_col - cols / factor,
        ];
        Tensor::cat(&[inside, one], 1)
            .constant_pad_nd([before_col, after_col, before_row, after_row])
    }
}

/// Windows of one sample's query (1 x C x rows x cols) at points of the grid, each at all these turns: (points turns) x C x k x k.
fn windows(
    grid: &Grid,
    query: &Tensor,
    points: &[Point2<f64>],
    turns: &[usize],
    rotations: usize,
) -> Tensor {
    let turns = vec![turns.to_vec(); points.len()];
    let (margin, sampling) = (grid.query_margin, grid.sampling);
    rotated_windows(query, margin, grid, sampling, points, &turns, rotations).flatten(0, 1)
}

/// Over channels, which stay.
fn sum(x: &Tensor) -> Tensor {
    x.sum_dim_intlist([1].as_slice(), true, None::<Kind>)
}

/// Heights within so many cells of the grid of this cell, by cells of this fineness. `image` is that of one sample.
fn heights_around(
    image: &Tensor,
    grid: &Grid,
    (row, col): (usize, usize),
    reach: usize,
    fineness: Fineness,
) -> Tensor {
    let around = |at: usize, len: usize| {
        let (first, end) = (at.saturating_sub(reach), (at + reach + 1).min(len));
        (FINE * first as i64, FINE * (end - first) as i64)
    };
    let ((row, rows), (col, cols)) = (around(row, grid.rows), around(col, grid.cols));
    let heights = image
        .narrow(1, 3, 1)
        .narrow(2, row, rows)
        .narrow(3, col, cols);
    fineness.of(&heights)
}

/// The highest height within a cell of the grid of this cell, by cells of this fineness. `image` is that of one sample.
fn top_height(image: &Tensor, grid: &Grid, cell: (usize, usize), fineness: Fineness) -> Tensor {
    heights_around(image, grid, cell, 1, fineness).max()
}

/// Colours, heights above `top` and where a square is inside its image; what is outside is 0.
fn relative(square: &Tensor, top: &Tensor) -> [Tensor; 3] {
    let inside = square.narrow(1, 4, 1);
    let height = (square.narrow(1, 3, 1) - top).clamp(-DEEPEST, DEEPEST) * &inside;
    [square.narrow(1, 0, 3), height, inside]
}

/// What queries are compared with: 1 x 8 x edge x edge, of which the last channel is where something appeared.
fn shape_key(model: &Compared<'_>, sample: i64, crop: &Crop, fineness: Fineness) -> Tensor {
    let (grid, factor) = (model.grid, fineness.factor());
    let [_, before, shown] = model.cells(sample);
    // What appeared is looked at with 12 mm around it, so that it is told from a larger thing.
    let reach = 2 * factor;
    let first = [crop.row, crop.col].map(|at| factor * (at - grid.margin as i64) - reach);
    let edge = factor * crop.edge;
    let square = |image: &Tensor| fineness.square(image, first, edge + 2 * reach);
    let (before, shown_square) = (square(&before), square(&shown));
    let change = &shown_square - before;
    let rise = change.narrow(1, 3, 1);
    let recolored = sum(&change.narrow(1, 0, 3).abs()).gt(RECOLORED);
    let appeared = rise
        .gt(RISEN)
        .logical_or(&recolored.logical_and(&rise.gt(-RISEN)))
        .to_kind(shown.kind());
    let around = appeared.max_pool2d([2 * reach + 1; 2], [1, 1], [0, 0], [1, 1], false);
    let inner = |x: &Tensor| x.narrow(2, reach, edge).narrow(3, reach, edge);
    let top = top_height(&shown, grid, grid.row_and_col(crop.place), fineness);
    let [color, height, inside] = relative(&inner(&shown_square), &top);
    let (appeared, around) = (inner(&appeared), around * inside);
    let squares = &appeared * sum(&color.square()) + &around * height.square();
    let key = [
        &appeared * color,
        &appeared * -0.5,
        &around * height,
        &around * -0.5,
        squares * -0.5,
        appeared,
    ];
    Tensor::cat(&key, 1)
}

/// What stands at each point, at each of these turns: (points turns) x 7 x k x k.
fn shape_windows(
    model: &Compared<'_>,
    sample: i64,
    (points, turns): (&[Point2<f64>], &[usize]),
    fineness: Fineness,
) -> Tensor {
    let (grid, factor) = (model.grid, fineness.factor());
    let [seen, ..] = model.cells(sample);
    // The middle of a cell of the grid is between cells of the heightmap.
    let (scale, shift) = (factor as f64, 0.5 * (factor - 1) as f64);
    let window = factor as usize * grid.window;
    let middle = scale * grid.margin as f64 + shift;
    // As far as the corner of a turned window reaches, and the next cell.
    let reach = (middle * std::f64::consts::SQRT_2).ceil() as i64 + 1;
    let squares = points.iter().map(|point| {
        let center = point * scale + Vector2::repeat(shift);
        let first = center.map(|at| at.floor() as i64 - reach);
        let square = fineness.square(&seen, [first.y, first.x], 2 * (reach + 1));
        let nearest = |at: f64, len: usize| at.round().clamp(0.0, (len - 1) as f64) as usize;
        let cell = (nearest(point.y, grid.rows), nearest(point.x, grid.cols));
        let top = top_height(&seen, grid, cell, fineness);
        (square, top, center - first.map(|at| at as f64).coords)
    });
    let (mut seen, mut tops, mut centers) = (Vec::new(), Vec::new(), Vec::new());
    for (square, top, center) in squares {
        seen.push(square);
        tops.push(top);
        centers.push(center);
    }
    let top = Tensor::stack(&tops, 0).view([-1, 1, 1, 1]);
    let [color, height, one] = relative(&Tensor::cat(&seen, 0), &top);
    let color_squares = sum(&color.square());
    let query = Tensor::cat(
        &[&color, &color_squares, &height, &height.square(), &one],
        1,
    );
    let turns = vec![turns.to_vec(); points.len()];
    let (size, rotations) = ((window, middle), model.rotations);
    sampled_windows(&query, size, grid.sampling, &centers, &turns, rotations).flatten(0, 1)
}

/// Minus half the squared difference between the cells at each point, at each of these turns, and those of v_k at the place: of colours
/// where something appeared, and of heights there and around it; a mean over the cells where something appeared. Heights are relative
/// to the point's and the place's own: an object may stand on another one. (points turns) x places x places.
fn shape_difference(
    model: &Compared<'_>,
    sample: i64,
    crop: &Crop,
    at: (&[Point2<f64>], &[usize]),
    fineness: Fineness,
) -> Tensor {
    let factor = fineness.factor();
    let key = shape_key(model, sample, crop, fineness);
    let windows = shape_windows(model, sample, at, fineness);
    let edge = factor * model.grid.window as i64;
    let all = Tensor::ones([1, 1, edge, edge], (key.kind(), key.device()));
    let area = strided(&key.narrow(1, 7, 1), &all, factor).clamp_min(1.0);
    strided(&key.narrow(1, 0, 7), &windows, factor) / area
}

/// Minus half the squared difference (of 40 mm each) between how high each candidate stands above the lowest cell around it and how high
/// v_k has risen at the place: one a candidate. The cells that shapes are compared by end 20 mm below the top of a thing.
fn height_difference(
    model: &Compared<'_>,
    sample: i64,
    candidates: &[usize],
    place: usize,
) -> Tensor {
    let (grid, [seen, before, shown]) = (model.grid, model.cells(sample));
    let top = |image: &Tensor, cell: usize| {
        top_height(image, grid, grid.row_and_col(cell), Fineness::Grid)
    };
    let stand = |cell: &usize| {
        let around = grid.row_and_col(*cell);
        let around = heights_around(&seen, grid, around, AROUND_CELLS, Fineness::Grid);
        top(&seen, *cell) - around.min()
    };
    let stand: Vec<Tensor> = candidates.iter().map(stand).collect();
    let risen = top(&shown, place) - top(&before, place);
    (Tensor::stack(&stand, 0) - risen).square() * -0.5
}

/// What differences of cells take from logits: weighted, and beyond that of what fits best.
fn taken(differences: &Tensor, weight: f64, at_most: f64) -> Tensor {
    ((differences - differences.max()) * weight).clamp_min(-at_most)
}

/// The highest of what is said of each candidate, over turns and places.
fn best_of_each(said: &Tensor, candidates: &[usize]) -> Tensor {
    let said = said.view([candidates.len() as i64, -1]);
    said.amax([1].as_slice(), false)
}

/// How well what stands at each candidate, turned and shifted as it fits best, fits what stands at the place: logits.
fn fits(model: &Compared<'_>, sample: i64, candidates: &[usize], place: usize) -> Tensor {
    let Compared { grid, fit, .. } = *model;
    let (points, turns) = (model.points(candidates), model.some_turns());
    let crop = Crop::new(grid, place);
    let query = fit.query.narrow(0, sample, 1);
    let windows = windows(grid, &query, &points, &turns, model.rotations);
    let logits = correlate(&crop.of(&fit.key.narrow(0, sample, 1)), &windows) * model.scale;
    let learned = best_of_each(&logits, candidates);
    if model.pick_shape_weight == 0.0 {
        return learned;
    }
    let at = (&*points, &*turns);
    let differences = shape_difference(model, sample, &crop, at, Fineness::Grid);
    let differences = best_of_each(&differences, candidates);
    // A cable has another shape wherever it lies.
    let is_like = differences.max().gt(-UNLIKE).to_kind(learned.kind());
    let mut shapes = taken(&differences, model.pick_shape_weight, MOST_TAKEN);
    if model.pick_height_weight > 0.0 {
        let differences = height_difference(model, sample, candidates, place);
        shapes += taken(&differences, model.pick_height_weight, MOST_TAKEN);
    }
    learned + shapes * is_like
}

/// What a network says that compares candidates, and how.
struct Compared<'a> {
    grid: &'a Grid,
    first: &'a FirstPlace,
    fit: &'a Fit,
    scale: &'a Tensor,
    rotations: usize,
    shape_weight: f64,
    pick_shape_weight: f64,
    pick_height_weight: f64,
    fine_shapes: bool,
}

impl<'a> Compared<'a> {
    fn new(grid: &'a Grid, features: &'a Features, config: &NetworkConfig) -> Option<Self> {
        let first = features.first.as_ref()?;
        let [shape_weight, pick_shape_weight, pick_height_weight] = config.shape_weights();
        let fine_shapes = config.has_fine_shapes();
        Some(Self {
            grid,
            first,
            fit: first.fit.as_ref()?,
            scale: &features.scale,
            rotations: config.rotations,
            shape_weight,
            pick_shape_weight,
            pick_height_weight,
            fine_shapes,
        })
    }

    /// Colour and height of a sample's observation, of v_{k-1} and of v_k, each 1 x 4 x rows x cols of the heightmap.
    fn cells(&self, sample: i64) -> [Tensor; 3] {
        let cells = self.fit.cells.each_ref();
        cells.map(|cells| cells.narrow(0, sample, 1))
    }

    /// Where cells are on the grid.
    fn points(&self, cells: &[usize]) -> Vec<Point2<f64>> {
        let cols = self.grid.cols;
        let point = |cell: &usize| Point2::new((cell % cols) as f64, (cell / cols) as f64);
        cells.iter().map(point).collect()
    }

    /// What the cells add to the logits of turns and places in the crop, against all other places: turns x places x places. `learned`
    /// are the logits there that they are added to; without them the features count as sure.
    fn turns_added(
        &self,
        sample: i64,
        crop: &Crop,
        pick: Point2<f64>,
        learned: Option<&Tensor>,
    ) -> Tensor {
        let turns: Vec<usize> = (0..self.rotations).collect();
        let fineness = match self.fine_shapes {
            false => Fineness::Grid,
            true => Fineness::Heightmap,
        };
        let shape = shape_difference(self, sample, crop, (&[pick], &turns), fineness);
        if !self.fine_shapes {
            return taken(&shape, self.shape_weight, MOST_TAKEN_OF_TURNS) + MOST_TAKEN_OF_TURNS;
        }
        let say = |say: SayOfTurns| {
            let added = taken(&shape, say.weight * self.shape_weight, say.most_taken);
            (added + say.most_taken) * shape.max().gt(-say.unlike).to_kind(shape.kind())
        };
        let beside_sure = say(BESIDE_SURE_FEATURES);
        let Some(learned) = learned else {
            return beside_sure;
        };
        let tops = learned.amax([1, 2].as_slice(), false);
        let is_sure = (tops.max() - tops.mean(None::<Kind>)).ge(SURE_OF_TURN);
        beside_sure.where_self(&is_sure, &say(BESIDE_UNSURE_FEATURES))
    }

    /// Turns that candidates are compared at.
    fn some_turns(&self) -> Vec<usize> {
        (0..self.rotations).step_by(TURN_STRIDE).collect()
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
/// place; places further off have the least.
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
    // Places count from the margin's corner. Those beyond the last row or column are none.
    let places = Crop::places(grid, crop.edge);
    let rows = places.min(grid.rows as i64 - crop.row);
    let cols = places.min(grid.cols as i64 - crop.col);
    let mut logits = logits
        .squeeze_dim(0)
        .narrow(1, crop.row, rows)
        .narrow(2, crop.col, cols);
    let added = model.turns_added(0, &crop, pick, Some(&logits));
    let _ = logits.g_add_(&added.narrow(1, 0, rows).narrow(2, 0, cols));
}

/// What [`add_shape`] adds to the turns of the true picks at the true places: N x rotations, `None` where it adds nothing. Not learned.
pub(crate) fn turn_shapes(
    grid: &Grid,
    features: &Features,
    config: &NetworkConfig,
    labels: &[Label],
) -> Option<Tensor> {
    let model = Compared::new(grid, features, config).filter(|model| model.shape_weight > 0.0)?;
    let shapes: Vec<Tensor> = labels
        .iter()
        .enumerate()
        .map(|(sample, label)| {
            let pick = label.pick_px.map(|coordinate_px| grid.index(coordinate_px));
            let place = cell_of(grid, label.place_px);
            let crop = Crop::new(grid, place);
            let added = model.turns_added(sample as i64, &crop, pick, None);
            // The object may have been held a cell beside the point that was labelled.
            let within = |at: usize, begin: i64| {
                (at as i64 - begin - 1).clamp(0, Crop::places(grid, crop.edge) - 3)
            };
            let (row, col) = grid.row_and_col(place);
            let around =
                added
                    .narrow(1, within(row, crop.row), 3)
                    .narrow(2, within(col, crop.col), 3);
            around.amax([1, 2].as_slice(), false)
        })
        .collect();
    Some(Tensor::stack(&shapes, 0))
}

/// The cell that holds a point of the image; the last edge belongs to the last cell.
fn cell_of(grid: &Grid, point_px: Point2<f64>) -> usize {
    let nearest = |coordinate_px: f64, len: usize| {
        let index = (grid.index(coordinate_px) + 0.5).floor();
        index.clamp(0.0, (len - 1) as f64) as usize
    };
    nearest(point_px.y, grid.rows) * grid.cols + nearest(point_px.x, grid.cols)
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
    let losses: Vec<Tensor> = labels
        .iter()
        .enumerate()
        .map(|(sample, label)| {
            let sample = sample as i64;
            let pick = features.pick.detach().get(sample).flatten(0, -1);
            let logits = Vec::<f32>::try_from(&pick.to_kind(Kind::Float)).unwrap_or_default();
            let (right, place) = (cell_of(grid, label.pick_px), cell_of(grid, label.place_px));
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
    use crate::input::rotation_angle;
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

    /// The same by cells of half the size, in four channels.
    fn doubled(image: &Tensor) -> Tensor {
        let size = [2 * GRID.rows as i64, 2 * GRID.cols as i64];
        image
            .upsample_nearest2d(size, None, None)
            .expand([1, 4, -1, -1], false)
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
                    cells: [&seen, &seen.zeros_like(), &shown_image].map(doubled),
                }),
                done: Tensor::zeros([1], (Kind::Float, tch::Device::Cpu)),
            }),
        }
    }

    fn config(candidates: usize, [shape_weight, pick_shape_weight]: [f64; 2]) -> NetworkConfig {
        NetworkConfig::new(Network::Matching(Matching {
            candidates,
            shape_weight,
            pick_shape_weight,
            ..Matching::default()
        }))
    }

    fn picked(features: &Features) -> (usize, usize) {
        let mut logits = values(&features.pick, "the pick map").unwrap();
        add_fits(&GRID, features, &config(6, [0.0; 2]), &mut logits).unwrap();
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

    /// Features that say nothing of three squares of one colour, but for this much at the second one, where the first one was shown.
    fn looking_alike(said: f64) -> Features {
        let seen = [(10, 10, 7), (10, 28, 3), (30, 10, 3)];
        let mut features = features(&seen, (45, 22, 7));
        features.pick *= 0.1;
        let mut second = features.pick.get(0).get(10).get(28);
        let _ = second.g_add_scalar_(said);
        let fit = features.first.as_mut().and_then(|first| first.fit.as_mut());
        let fit = fit.unwrap();
        fit.key = fit.key.zeros_like();
        features
    }

    #[test]
    fn where_features_say_nothing_the_cells_themselves_tell_sizes_apart() {
        let picked = |said: f64, weight: f64| {
            let features = looking_alike(said);
            let mut logits = values(&features.pick, "the pick map").unwrap();
            add_fits(&GRID, &features, &config(6, [0.0, weight]), &mut logits).unwrap();
            let best =
                (0..logits.len()).max_by(|one, other| logits[*one].total_cmp(&logits[*other]));
            let best = best.unwrap();
            best / GRID.cols < 20 && best % GRID.cols < 20
        };
        assert!(!picked(1.0, 0.0), "the features' say");
        assert!(picked(1.0, 20.0), "the cells' say");
        // More than the cells may take.
        assert!(!picked(2.0 * MOST_TAKEN, 1000.0));
    }

    #[test]
    fn of_squares_of_one_size_the_one_of_the_shown_height_is_picked() {
        // Cuboids of 58 and 50 mm: the shapes end 20 mm below their tops.
        let high = |height: f64, square| doubled(&(squares(&[square]) * height));
        let seen = high(1.25, (10, 10, 5)) + high(1.45, (10, 28, 5));
        let picked = |shown: f64, weight: f64| {
            let mut features = features(&[(10, 10, 5), (10, 28, 5)], (45, 22, 5));
            let fit = features.first.as_mut().and_then(|first| first.fit.as_mut());
            let fit = fit.unwrap();
            let shown = high(shown, (45, 22, 5));
            // Only heights: the cells have no colour.
            let heights = |image: Tensor| {
                Tensor::cat(
                    &[image.narrow(1, 0, 3).zeros_like(), image.narrow(1, 3, 1)],
                    1,
                )
            };
            fit.cells = [seen.shallow_clone(), seen.zeros_like(), shown].map(heights);
            fit.key = fit.key.zeros_like();
            features.pick *= 0.1;
            let mut second = features.pick.get(0).get(10).get(28);
            let _ = second.g_add_scalar_(0.5);
            let mut config = config(6, [0.0, 20.0]);
            if let Network::Matching(matching) = &mut config.network {
                matching.pick_height_weight = weight;
            }
            let mut logits = values(&features.pick, "the pick map").unwrap();
            add_fits(&GRID, &features, &config, &mut logits).unwrap();
            let best =
                (0..logits.len()).max_by(|one, other| logits[*one].total_cmp(&logits[*other]));
            best.unwrap() % GRID.cols
        };
        assert!(picked(1.25, 0.0) > 20, "the pick map's say");
        assert!(picked(1.25, 100.0) < 20, "the heights' say");
        assert!(picked(1.45, 100.0) > 20);
    }

    /// A square of so many cells of the heightmap along its edge, turned about a point of the grid: 1 x 4 x rows x cols of the heightmap.
    fn turned_square(edge: f64, (row, col): (f64, f64), turn: usize) -> Tensor {
        let (rows, cols) = (2 * GRID.rows, 2 * GRID.cols);
        let angle = -rotation_angle(turn, 36);
        // Each cell as the mean of 8 x 8 points.
        let points = || (0..8).map(|point| (f64::from(point) - 3.5) / 8.0);
        let is_in = |row: f64, col: f64| {
            let (sin, cos) = angle.sin_cos();
            let (u, v) = (cos * col - sin * row, sin * col + cos * row);
            u.abs().max(v.abs()) <= edge / 2.0
        };
        let mean = |at_row: usize, at_col: usize| {
            let count = points()
                .flat_map(|v| points().map(move |u| (v, u)))
                .filter(|(v, u)| {
                    is_in(
                        at_row as f64 + v - 2.0 * row - 0.5,
                        at_col as f64 + u - 2.0 * col - 0.5,
                    )
                })
                .count();
            count as f32 / 64.0
        };
        let cells: Vec<f32> = (0..rows * cols)
            .map(|cell| mean(cell / cols, cell % cols))
            .collect();
        Tensor::from_slice(&cells)
            .view([1, 1, rows as i64, cols as i64])
            .expand([1, 4, -1, -1], false)
    }

    /// Logits of places where a small square at 10, 10 was shown at 45, 22 as `shown` has it, and the learned features prefer the turn of
    /// index 5 by `learned`.
    fn logits_of_a_square(shown: &Tensor, learned: f64) -> Tensor {
        let pick_px = Point2::new(GRID.coordinate_px(10.0), GRID.coordinate_px(10.0));
        let seen = turned_square(8.3, (10.0, 10.0), 0);
        let mut features = features(&[(10, 10, 3)], (45, 22, 3));
        let fit = features.first.as_mut().and_then(|first| first.fit.as_mut());
        fit.unwrap().cells = [&seen, &seen.zeros_like(), shown].map(Tensor::shallow_clone);
        let logits = Tensor::zeros([1, 36, 60, 40], (Kind::Float, tch::Device::Cpu));
        let _ = logits.narrow(1, 5, 1).fill_(learned);
        let mut config = config(4, [80.0, 0.0]);
        if let Network::Matching(matching) = &mut config.network {
            matching.fine_shapes = true;
        }
        add_shape(&GRID, &features, &config, pick_px, &logits);
        logits
    }

    /// Turn, of a square that looks alike after nine, row and column of the highest logit.
    fn best_of(logits: &Tensor) -> (usize, usize, usize) {
        let best = logits.argmax(None, false).int64_value(&[]) as usize;
        (best / 2400 % 9, best / 40 % 60, best % 40)
    }

    #[test]
    fn a_small_square_shows_its_turn_by_the_cells_of_the_heightmap() {
        for turn in [0, 2, 4, 7] {
            let logits = logits_of_a_square(&turned_square(8.3, (45.0, 22.0), turn), 0.0);
            assert_eq!(best_of(&logits), (turn, 45, 22));
        }
        // What keeps no shape says nothing.
        let other = turned_square(20.0, (45.0, 22.0), 0);
        let logits = logits_of_a_square(&other, 0.0);
        assert_eq!(logits.abs().max().double_value(&[]), 0.0);
    }

    #[test]
    fn cells_turn_what_the_features_are_unsure_of_and_leave_what_they_are_sure_of() {
        let shown = turned_square(8.3, (45.0, 22.0), 2);
        assert_eq!(best_of(&logits_of_a_square(&shown, 9.0)), (2, 45, 22));
        assert_eq!(best_of(&logits_of_a_square(&shown, 9.5)).0, 5);
    }

    #[test]
    fn the_turn_that_the_cells_say_is_what_the_loss_adds() {
        let features = turned_oblong();
        let label = Label {
            pick_px: Point2::new(GRID.coordinate_px(10.0), GRID.coordinate_px(10.0)),
            place_px: Point2::new(GRID.coordinate_px(22.0), GRID.coordinate_px(45.0)),
            rotation: 9,
            done: false,
        };
        let shapes = |weight| turn_shapes(&GRID, &features, &config(4, [weight, 0.0]), &[label]);
        assert!(shapes(0.0).is_none());
        let shapes = shapes(20.0).unwrap();
        assert_eq!(shapes.size(), [1, 36]);
        let best = shapes.argmax(None, false).int64_value(&[]);
        assert!(best == 9 || best == 27, "turn {best}");
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

    /// An oblong that lies at 10, 10 and was shown standing at 45, 22.
    fn turned_oblong() -> Features {
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
        let (fit, images) = (fit.unwrap(), [&lying, &lying.zeros_like(), &standing]);
        fit.cells = images.map(doubled);
        features
    }

    #[test]
    fn the_cells_themselves_say_how_an_oblong_was_turned() {
        let features = turned_oblong();
        let logits = Tensor::zeros([1, 36, 60, 40], (Kind::Float, tch::Device::Cpu));
        let pick_px = Point2::new(GRID.coordinate_px(10.0), GRID.coordinate_px(10.0));
        add_shape(&GRID, &features, &config(4, [20.0, 0.0]), pick_px, &logits);
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
            let loss = candidate_loss(&GRID, &features, &config(4, [0.0; 2]), &[label(row, col)]);
            loss.double_value(&[])
        };
        // Several candidates are on the large square.
        assert!(loss(10, 28) < 2.0, "{}", loss(10, 28));
        assert!(loss(10, 10) > 8.0, "{}", loss(10, 10));
    }
}
