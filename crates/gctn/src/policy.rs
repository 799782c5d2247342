//! Decisions.

use heightmap::{Disk, Heightmap, Workspace};
use nalgebra::{Isometry2, Point2};
use std::path::Path;
use tch::{Kind, Tensor};

use crate::augment::Warp;
use crate::candidates::{add_fits, add_shape};
use crate::input::{check_goal, check_heightmap, encode, tensor, to_world};
use crate::losses::place_logits;
use crate::network::{Builder, Features, Model};
use crate::{
    Calibration, Device, Error, Evidence, Goal, ModelCard, NetworkConfig, Precision, checkpoint,
};

/// A trained network that decides.
#[derive(Debug)]
pub struct Policy {
    model: Model,
    card: ModelCard,
    calibration: Option<Calibration>,
    device: tch::Device,
}

/// Probabilities over a grid that covers the heightmap.
#[derive(Clone, Debug, PartialEq)]
pub struct ScoreMap {
    /// Rows (along +y).
    pub rows: usize,
    /// Columns (along +x).
    pub cols: usize,
    /// Row-major probabilities.
    pub scores: Vec<f32>,
}

/// Where to pick and where to place.
#[derive(Clone, Debug, PartialEq)]
pub struct Decision {
    /// Where to pick, in the world; yaw 0.
    pub pick: Isometry2<f64>,
    /// Where to place, in the world; the object is to be turned by its yaw, in (-pi, pi].
    pub place: Isometry2<f64>,
    /// Probability of the picked cell.
    pub pick_score: f64,
    /// Probability of the placed cell and rotation.
    pub place_score: f64,
    /// Probability that the step is done already, of a network that says so.
    pub done: Option<f64>,
    /// What the network says of this decision in numbers that can be weighed.
    pub evidence: Evidence,
    /// Probability that the step earns its reward, of a checkpoint with a calibration.
    pub success: Option<f64>,
    /// Probabilities of pick cells; excluded ones have 0.
    pub pick_map: ScoreMap,
    /// Probabilities of place cells at the rotation decided on. They sum to less than 1: the rest is with
    /// the other rotations.
    pub place_map: ScoreMap,
}

impl Policy {
    /// Loads a checkpoint for the processor in 32-bit floats.
    pub fn load(path: &Path) -> Result<Self, Error> {
        Self::load_for(path, Device::Cpu, Precision::F32)
    }

    /// Loads a checkpoint. Refuses another version, missing, further or misshapen tensors, numbers that
    /// are not finite and truncated files.
    pub fn load_for(path: &Path, device: Device, precision: Precision) -> Result<Self, Error> {
        let precision = precision.on(device);
        let device = device.open()?;
        let (file, config, card) = checkpoint::open(path)?;
        let model = Model::new(&config, Builder::empty(device), precision);
        file.fill(&model.parameters.entries)?;
        Ok(Self {
            calibration: file.calibration()?,
            ..Self::new(model, card, device)
        })
    }

    /// How likely its decisions are to earn their steps, where the checkpoint says so.
    pub fn calibration(&self) -> Option<&Calibration> {
        self.calibration.as_ref()
    }

    pub(crate) fn new(model: Model, card: ModelCard, device: tch::Device) -> Self {
        model.prepare();
        Self {
            model,
            card,
            calibration: None,
            device,
        }
    }

    /// The network's configuration.
    pub fn config(&self) -> &NetworkConfig {
        &self.model.config
    }

    /// What its maker wrote about it.
    pub fn card(&self) -> &ModelCard {
        &self.card
    }

    /// Decides where to pick and where to place, given what is seen and what it should become (the goals that
    /// the network is [conditioned](crate::GoalConditioning) on: for `sequence` [`Goal::step`]). Nothing is picked within an excluded disk (world). The same input and number of threads give the same bits.
    pub fn decide<'a>(
        &self,
        observation: &Heightmap,
        goal: impl Into<Goal<'a>>,
        exclude: &[Disk],
    ) -> Result<Decision, Error> {
        let config = &self.model.config;
        let workspace = &observation.workspace;
        tch::no_grad(|| {
            let features = self.features(observation, goal.into())?;
            let (pick_px, pick_score, pick_map) = self.pick(&features, workspace, exclude)?;
            let turns = [(0..config.rotations).collect()];
            let grid = &self.model.grid;
            let logits = place_logits(grid, &features, &[pick_px], &turns, config.rotations);
            add_shape(grid, &features, config, pick_px, &logits);
            let (place_px, turn, place_score, place_map) = self.place(&logits.squeeze_dim(0))?;

            let mut yaw_rad = std::f64::consts::TAU * turn / config.rotations as f64;
            if yaw_rad > std::f64::consts::PI {
                yaw_rad -= std::f64::consts::TAU;
            }
            let done = done(&features)?;
            let stride = self.model.grid.stride;
            let evidence = Evidence::new(
                (&pick_map, [pick_px.x, pick_px.y]),
                (&place_map, [place_px.x, place_px.y]),
                stride,
                done,
            );
            let calibration = self.calibration.as_ref();
            Ok(Decision {
                done,
                evidence,
                success: calibration.map(|calibration| calibration.probability(&evidence)),
                pick: to_world(workspace, pick_px, 0.0),
                place: to_world(workspace, place_px, yaw_rad),
                pick_score,
                place_score,
                pick_map,
                place_map,
            })
        })
    }

    /// Probability that a step is done already: that the observation shows what the goal shows, also from another start. `None`
    /// of a network that does not say so.
    pub fn done<'a>(
        &self,
        observation: &Heightmap,
        goal: impl Into<Goal<'a>>,
    ) -> Result<Option<f64>, Error> {
        tch::no_grad(|| done(&self.features(observation, goal.into())?))
    }

    /// What the network says, after its inputs are checked.
    fn features(&self, observation: &Heightmap, goal: Goal<'_>) -> Result<Features, Error> {
        crate::apply_threads();
        let config = &self.model.config;
        check_heightmap(config, "observation", observation)?;
        check_goal(config, goal)?;
        let encoding = self.model.encoding();
        let mut encoded = vec![0.0; encoding.channels() * observation.workspace.len()];
        encode(encoding, observation, goal, &Warp::identity(), &mut encoded);
        let input = tensor(encoding, [config.rows, config.cols], &encoded);
        Ok(self.model.forward(&input.to_device(self.device)))
    }

    fn map(&self, scores: Vec<f32>) -> ScoreMap {
        let grid = &self.model.grid;
        ScoreMap {
            rows: grid.rows,
            cols: grid.cols,
            scores,
        }
    }

    fn pick(
        &self,
        features: &Features,
        workspace: &Workspace,
        exclude: &[Disk],
    ) -> Result<(Point2<f64>, f64, ScoreMap), Error> {
        let (grid, config) = (&self.model.grid, &self.model.config);
        let learned = values(&features.pick, "the pick map")?;
        let mut logits = learned.clone();
        let center_px = |index: usize| {
            let (row, col) = (index / grid.cols, index % grid.cols);
            Point2::new(
                grid.coordinate_px(col as f64),
                grid.coordinate_px(row as f64),
            )
        };
        let is_within = |disk: &Disk, point_px: &Point2<f64>| {
            let disk_px = workspace.point_px(&disk.center_m);
            (disk_px - point_px).norm() <= disk.radius_m / config.pixel_size_m
        };
        for disk in exclude {
            for (index, logit) in logits.iter_mut().enumerate() {
                if is_within(disk, &center_px(index)) {
                    *logit = f32::NEG_INFINITY;
                }
            }
        }
        match config.candidates() {
            0 => {}
            _ => add_fits(grid, features, config, &mut logits)?,
        }
        let best = argmax(&logits);
        let top = logits[best];
        if top == f32::NEG_INFINITY {
            return Err(Error::NothingToPick {
                count: exclude.len(),
            });
        }
        let shares: Vec<f64> = logits
            .iter()
            .map(|logit| f64::from(logit - top).exp())
            .collect();
        let sum: f64 = shares.iter().sum();
        let scores = shares.iter().map(|share| (share / sum) as f32).collect();
        // Of the other networks picks are in the middle of a cell: that is how their checkpoints were measured.
        let between = features.first.as_ref().map(|_| {
            let (row, col) = (best / grid.cols, best % grid.cols);
            let [right, down] = subcell(&learned, grid.rows, grid.cols, row, col);
            Point2::new(
                grid.coordinate_px(col as f64 + right),
                grid.coordinate_px(row as f64 + down),
            )
        });
        let between =
            between.filter(|pick_px| !exclude.iter().any(|disk| is_within(disk, pick_px)));
        let pick_px = between.unwrap_or_else(|| center_px(best));
        Ok((pick_px, sum.recip(), self.map(scores)))
    }

    /// Where to place, by which turn (in rotations of the network), the score of that and the scores at the nearest rotation.
    fn place(&self, logits: &Tensor) -> Result<(Point2<f64>, f64, f64, ScoreMap), Error> {
        let (grid, config) = (&self.model.grid, &self.model.config);
        // Turns by fine cells are known to a few degrees, less than from one rotation to the next.
        let turns: &[i64] = match config.has_fine_shapes() {
            true => &[0, -1, 1],
            false => &[0],
        };
        let cells = grid.rows * grid.cols;
        // Found where the maps were computed: of all turns only one map is copied, or that and its neighbours, and there is one wait.
        let logits = logits.reshape([-1, cells as i64]);
        let best = logits.argmax(None, false);
        let rotation = best.divide_scalar_mode(cells as i64, "floor");
        let (low, top) = (logits.min(), logits.max());
        let sum = (&logits - &top)
            .to_kind(Kind::Double)
            .exp()
            .sum(Kind::Double);
        let found = [best, low, top, sum].map(|number| number.to_kind(Kind::Double).view([1]));
        let turns = Tensor::from_slice(turns).to_device(logits.device());
        let turns = (rotation.view([1]) + turns).remainder(config.rotations as i64);
        let maps = logits.index_select(0, &turns).view([-1]);
        let [best, low, top, sum] = &found;
        let read = Tensor::cat(&[best, low, top, sum, &maps.to_kind(Kind::Double)], 0);
        let mut numbers = vec![0.0f64; read.numel()];
        read.to_device(tch::Device::Cpu)
            .f_copy_data(&mut numbers, read.numel())?;
        let ([best, low, top, sum], maps) = match numbers.split_first_chunk() {
            Some((found, map)) => (*found, map),
            None => ([f64::NAN; 4], &[][..]),
        };
        if !(low.is_finite() && top.is_finite() && sum.is_finite()) {
            let what = "the place map";
            return Err(Error::NotFinite { what, step: None });
        }
        let maps: Vec<f32> = maps.iter().map(|logit| *logit as f32).collect();
        let (map, beside) = maps.split_at(cells);
        let log_sum = top + sum.ln();
        let (rotation, cell) = (best as usize / cells, best as usize % cells);
        let (row, col) = (cell / grid.cols, cell % grid.cols);
        let offset = if grid.subcell {
            subcell(map, grid.rows, grid.cols, row, col)
        } else {
            [0.0; 2]
        };
        let place_px = Point2::new(
            grid.coordinate_px(col as f64 + offset[0]),
            grid.coordinate_px(row as f64 + offset[1]),
        );
        let score = |logit: f32| (f64::from(logit) - log_sum).exp().min(1.0);
        let scores = map.iter().map(|logit| score(*logit) as f32).collect();
        // An object that is turned by a little more or less may fit best a cell beside.
        let top = |map: &[f32]| {
            let near = |at: usize, len: usize| at.saturating_sub(1)..(at + 2).min(len);
            let rows = near(row, grid.rows);
            let cells = rows.flat_map(|row| near(col, grid.cols).map(move |col| (row, col)));
            let logits = cells.map(|(row, col)| map[row * grid.cols + col]);
            logits.fold(f32::NEG_INFINITY, f32::max)
        };
        let between = match beside.is_empty() {
            true => 0.0,
            false => {
                let (before, after) = beside.split_at(cells);
                vertex([top(before), map[cell], top(after)])
            }
        };
        let turn = rotation as f64 + between;
        Ok((place_px, turn, score(map[cell]), self.map(scores)))
    }
}

fn done(features: &Features) -> Result<Option<f64>, Error> {
    let first = features.first.as_ref();
    let done = first.map(|first| values(&first.done.sigmoid(), "whether the step is done"));
    Ok(done.transpose()?.map(|done| f64::from(done[0])))
}

/// The numbers of a tensor, all finite.
pub(crate) fn values(tensor: &Tensor, what: &'static str) -> Result<Vec<f32>, Error> {
    let tensor = tensor
        .to_device(tch::Device::Cpu)
        .to_kind(Kind::Float)
        .contiguous();
    let mut values = vec![0.0; tensor.numel()];
    tensor.f_copy_data(&mut values, tensor.numel())?;
    // In parts, each without a branch for every number.
    const PART: usize = 256;
    let finite = |part: &[f32]| part.iter().fold(true, |all, one| all & one.is_finite());
    if values.chunks(PART).all(finite) {
        Ok(values)
    } else {
        Err(Error::NotFinite { what, step: None })
    }
}

/// Index of the first of the largest.
fn argmax(values: &[f32]) -> usize {
    // Sixteen at a time: the largest number does not depend on the order.
    const LANES: usize = 16;
    let larger = |one: f32, other: f32| if other > one { other } else { one };
    let (parts, rest) = values.as_chunks::<LANES>();
    let mut tops = [f32::NEG_INFINITY; LANES];
    for part in parts {
        for (top, value) in tops.iter_mut().zip(part) {
            *top = larger(*top, *value);
        }
    }
    let top = tops
        .iter()
        .chain(rest)
        .copied()
        .fold(f32::NEG_INFINITY, larger);
    values.iter().position(|value| *value == top).unwrap_or(0)
}

/// Where between cells the maximum lies, as offset along columns and rows: labels are Gaussians, so
/// logarithms of probabilities are parabolas.
fn subcell(map: &[f32], rows: usize, cols: usize, row: usize, col: usize) -> [f64; 2] {
    let offset = |index: usize, len: usize, at: &dyn Fn(usize) -> f32| {
        if index == 0 || index + 1 == len {
            return 0.0;
        }
        vertex([at(index - 1), at(index), at(index + 1)])
    };
    [
        offset(col, cols, &|col| map[row * cols + col]),
        offset(row, rows, &|row| map[row * cols + col]),
    ]
}

/// Where the parabola through values at -1, 0 and 1 has its maximum, at most half a step from 0.
fn vertex(values: [f32; 3]) -> f64 {
    let [before, here, after] = values.map(f64::from);
    let curvature = before - 2.0 * here + after;
    if curvature < 0.0 {
        (0.5 * (before - after) / curvature).clamp(-0.5, 0.5)
    } else {
        0.0
    }
}
