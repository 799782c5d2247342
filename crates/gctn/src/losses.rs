//! Cross entropies of pick and place.

use nalgebra::Point2;
use rand::{Rng, RngExt};
use tch::{Kind, Tensor};

use crate::correlation::{correlate, rotated_windows};
use crate::input::Label;
use crate::network::{Features, FirstPlace, Grid};
use crate::{Interpolation, PlaceLoss, TrainingConfig};

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
    correlated(grid, features, &windows)
}

/// Logits of each place: correlation with the windows, plus the place logits that do not depend on the pick.
fn correlated(grid: &Grid, features: &Features, windows: &Tensor) -> Tensor {
    let logits = correlate(&features.key, &(windows * &features.scale), grid);
    match &features.first {
        Some(first) => logits + first.place.unsqueeze(1),
        None => logits,
    }
}

/// Mean loss of the place that is said before the pick is known: cross entropy. Samples whose step is done count too.
pub(crate) fn first_place_loss(
    grid: &Grid,
    sigma_cells: f64,
    first: &FirstPlace,
    labels: &[Label],
) -> Tensor {
    let points: Vec<_> = labels.iter().map(|label| label.place_px).collect();
    let target = targets(grid, sigma_cells, &points, &first.place);
    cross_entropy(&first.place, &first.place, &target)
}

/// Mean loss of whether the step is done: binary cross entropy.
pub(crate) fn done_loss(first: &FirstPlace, labels: &[Label]) -> Tensor {
    let done: Vec<_> = labels
        .iter()
        .map(|label| f64::from(u8::from(label.done)))
        .collect();
    let done = Tensor::from_slice(&done)
        .to_kind(first.done.kind())
        .to_device(first.done.device());
    first
        .done
        .binary_cross_entropy_with_logits::<Tensor>(&done, None, None, tch::Reduction::Mean)
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

/// Mean place loss of a batch. `shapes` (N x rotations): what is added to the logits of turns where one wrong turn is drawn.
pub(crate) fn place_loss(
    grid: &Grid,
    training: &TrainingConfig,
    rotations: usize,
    features: &Features,
    shapes: Option<&Tensor>,
    labels: &[Label],
    rng: &mut impl Rng,
) -> Tensor {
    let sigma_cells = training.label_sigma_cells;
    let picks: Vec<_> = labels.iter().map(|label| label.pick_px).collect();
    let places: Vec<_> = labels.iter().map(|label| label.place_px).collect();
    let target = targets(grid, sigma_cells, &places, &features.key);
    let all: Vec<Vec<usize>> = labels.iter().map(|_| (0..rotations).collect()).collect();
    let right: Vec<_> = labels.iter().map(|label| label.rotation as i64).collect();
    let right = Tensor::from_slice(&right).to_device(features.key.device());
    match training.place_loss {
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
            let dots = shapes.map_or_else(|| dots.shallow_clone(), |shapes| &dots + shapes);
            let turn_loss =
                dots.cross_entropy_loss(&right, None::<&Tensor>, tch::Reduction::Mean, -100, 0.0);
            if rotations == 1 {
                let logits = correlated(grid, features, &windows);
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
            let logits = correlated(grid, features, &windows.gather(1, &chosen, false));
            turn_loss + cross_entropy(&logits, &logits.select(1, 0), &target)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::input::{rotation_angle, to_px};
    use crate::{NetworkConfig, Sample};
    use heightmap::{Heightmap, Pixel, Workspace};
    use nalgebra::{Isometry2, Vector2};
    use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

    const HALF: Grid = Grid {
        rows: 160,
        cols: 80,
        stride: 2,
        window: 25,
        margin: 12,
        query_margin: 0,
        sampling: Interpolation::Bilinear,
        subcell: true,
    };

    /// A heightmap with a hook of soft dots at a world pose: its long arm points along the pose's +x, the
    /// short one along +y.
    fn hook(pose: &Isometry2<f64>) -> Heightmap {
        let mut heightmap = Heightmap::new(Workspace::RAVENS);
        let workspace = heightmap.workspace;
        let dots = [
            (0., 0.),
            (0.02, 0.),
            (0.04, 0.),
            (0.055, 0.),
            (0., 0.02),
            (0., 0.035),
        ];
        let dots = dots.map(|(x, y)| pose * Point2::new(x, y));
        for row in 0..workspace.rows {
            for col in 0..workspace.cols {
                let center = workspace.center(Pixel { row, col });
                let height = |dot: &Point2<f64>| {
                    (-(center - dot).norm_squared() / (2.0 * 0.006 * 0.006)).exp()
                };
                heightmap.height_m[row * workspace.cols + col] =
                    dots.iter().map(height).sum::<f64>() as f32;
            }
        }
        heightmap
    }

    /// What a perfect network would say: query and key features are the heights seen and wanted.
    fn features(sample: &Sample<'_>) -> Features {
        let image = |heightmap: &Heightmap| {
            let heights = Tensor::from_slice(&heightmap.height_m).view([1, 1, 320, 160]);
            heights.avg_pool2d([2, 2], [2, 2], [0, 0], false, true, None::<i64>)
        };
        Features {
            pick: Tensor::zeros([1, 160, 80], (Kind::Float, tch::Device::Cpu)),
            query: image(sample.observation),
            key: image(sample.goal.image).constant_pad_nd([12; 4]),
            scale: Tensor::ones([1], (Kind::Float, tch::Device::Cpu)),
            first: None,
        }
    }

    #[test]
    fn with_perfect_features_the_place_map_peaks_at_the_label() {
        for (rotation, yaw) in [(0, 0.4), (3, -1.0), (9, 2.0), (20, 0.0), (31, 3.0)] {
            let turn = rotation_angle(rotation, 36);
            let first = Isometry2::new(Vector2::new(0.40, -0.21), yaw);
            let then = Isometry2::new(Vector2::new(0.57, 0.183), yaw + turn);
            let [observation, goal] = [hook(&first), hook(&then)];
            // Not the hook's corner: the object turns about the pick.
            let held = Vector2::new(0.012, 0.007);
            let sample = Sample {
                observation: &observation,
                goal: (&goal).into(),
                pick: Isometry2::new((first * Point2::from(held)).coords, 0.1),
                place: Isometry2::new((then * Point2::from(held)).coords, 0.1 + turn),
                done: false,
            };
            let label = Label::of(&NetworkConfig::compact(), 0, &sample).unwrap();
            assert_eq!(label.rotation, rotation);
            assert_eq!(label.place_px, to_px(&Workspace::RAVENS, &sample.place));
            let turns = [(0..36).collect()];
            let logits = place_logits(&HALF, &features(&sample), &[label.pick_px], &turns, 36);
            let best = logits.argmax(None, false).int64_value(&[]) as usize;
            let (index, row, col) = (best / 12800, best / 80 % 160, best % 80);
            assert_eq!(index, rotation);
            let found = Point2::new(
                HALF.coordinate_px(col as f64),
                HALF.coordinate_px(row as f64),
            );
            assert!(
                (found - label.place_px).amax() <= 1.2,
                "{found} for {}",
                label.place_px
            );

            // The rotation loss looks at the same place the same way: a wrong label costs more.
            let loss = |label: Label| {
                let mut features = features(&sample);
                features.scale = Tensor::from_slice(&[10f32]);
                let mut rng = ChaCha8Rng::seed_from_u64(1);
                let training = TrainingConfig {
                    place_loss: PlaceLoss::RightAndOneWrong,
                    label_sigma_cells: 0.7,
                    ..TrainingConfig::compact()
                };
                let loss = place_loss(&HALF, &training, 36, &features, None, &[label], &mut rng);
                loss.double_value(&[])
            };
            let right = loss(label);
            for wrong in [1, 18, 35].map(|by| (rotation + by) % 36) {
                let wrong = loss(Label {
                    rotation: wrong,
                    ..label
                });
                assert!(right < wrong, "{right} {wrong}");
            }
        }
    }

    #[test]
    fn a_target_sums_to_one_and_has_its_mean_at_the_label() {
        let like = Tensor::zeros([1], (Kind::Double, tch::Device::Cpu));
        let point = Point2::new(41.3, 100.9);
        let target = targets(&HALF, 0.7, &[point], &like).squeeze_dim(0);
        let sum = |tensor: Tensor| tensor.sum(None::<Kind>).double_value(&[]);
        assert!((sum(target.shallow_clone()) - 1.0).abs() < 1e-12);
        let cols = Tensor::arange(80, (Kind::Double, tch::Device::Cpu));
        let rows = Tensor::arange(160, (Kind::Double, tch::Device::Cpu)).unsqueeze(1);
        let mean = Point2::new(sum(&target * cols), sum(&target * rows))
            .map(|index| HALF.coordinate_px(index));
        assert!((mean - point).amax() < 0.01, "{mean}");
    }

    #[test]
    fn a_hard_target_is_the_cell_that_holds_the_label() {
        let like = Tensor::zeros([1], (Kind::Double, tch::Device::Cpu));
        for (point, cell) in [
            ([0.0, 0.0], 0),
            ([1.99, 0.0], 0),
            ([2.0, 2.0], 81),
            ([159.9, 319.9], 12799),
        ] {
            let target = targets(&HALF, 0.0, &[Point2::from(point)], &like);
            assert_eq!(
                target.flatten(0, -1).argmax(None, false).int64_value(&[]),
                cell
            );
            assert_eq!(target.sum(None::<Kind>).double_value(&[]), 1.0);
        }
    }

    #[test]
    fn a_very_narrow_target_is_still_one() {
        let like = Tensor::zeros([1], (Kind::Double, tch::Device::Cpu));
        let target = targets(&HALF, 1e-3, &[Point2::new(40.0, 100.0)], &like);
        assert_eq!(target.sum(None::<Kind>).double_value(&[]), 1.0);
    }
}
