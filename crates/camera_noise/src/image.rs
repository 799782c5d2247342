//! What a camera does to one image, in loops that the compiler can do for several pixels at once. Their bits are those of the plain formulas in
//! the tests below.

use crate::{Depth, Edges};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

/// Noise of standard deviation 1 that is alike in patches: white noise on a coarse grid, interpolated.
pub(crate) struct Patches {
    values: Vec<f32>,
    columns: usize,
    /// Grid cells per pixel.
    scale: f32,
    /// By column of the image, its place among those of the grid.
    places: Vec<(usize, f32)>,
    /// The row of the grid that `upper` holds; `lower` holds the next one.
    row: Option<usize>,
    /// Rows of the grid, interpolated at the columns of the image.
    upper: Vec<f32>,
    lower: Vec<f32>,
}

impl Patches {
    pub(crate) fn draw(rng: &mut ChaCha8Rng, width: usize, height: usize, patch_px: f64) -> Self {
        let scale = (1.0 / patch_px) as f32;
        let cells = |pixels: usize| (pixels as f32 * scale) as usize + 2;
        let (columns, rows) = (cells(width), cells(height));
        // Between four nodes the variance of a bilinear mean is 4/9 on average.
        let gain = if patch_px > 1.0 { 1.5 } else { 1.0 };
        let values = (0..columns * rows).map(|_| gain * rng.sample::<f32, _>(StandardNormal));
        Self {
            values: values.collect(),
            columns,
            scale,
            places: (0..width).map(|u| place(u, scale)).collect(),
            row: None,
            upper: vec![0.0; width],
            lower: vec![0.0; width],
        }
    }

    /// The noise of a row of the image. Cheap for the rows of one patch, and for rows in ascending order.
    pub(crate) fn row(&mut self, v: usize) -> impl Iterator<Item = f32> {
        let (row, down) = place(v, self.scale);
        if self.row != Some(row) {
            if self.row.is_some_and(|known| known + 1 == row) {
                std::mem::swap(&mut self.upper, &mut self.lower);
            } else {
                let nodes = &self.values[row * self.columns..];
                interpolate(nodes, &self.places, &mut self.upper);
            }
            let nodes = &self.values[(row + 1) * self.columns..];
            interpolate(nodes, &self.places, &mut self.lower);
            self.row = Some(row);
        }
        let pairs = self.upper.iter().zip(&self.lower);
        pairs.map(move |(upper, lower)| upper + down * (lower - upper))
    }
}

/// The cell of a grid that a pixel lies in, along one axis, and how far it is into it.
fn place(pixel: usize, scale: f32) -> (usize, f32) {
    let at = pixel as f32 * scale;
    let cell = at as usize;
    (cell, at - cell as f32)
}

/// A row of a grid at the columns of an image.
fn interpolate(nodes: &[f32], places: &[(usize, f32)], line: &mut [f32]) {
    for (value, (column, right)) in line.iter_mut().zip(places) {
        let pair = &nodes[*column..][..2];
        *value = pair[0] + right * (pair[1] - pair[0]);
    }
}

/// The depth of a stereo camera.
pub(crate) struct StereoCamera {
    /// Focal length times baseline.
    scale: f32,
    noise_px: f32,
    step_px: f32,
    unit_m: f32,
    min_m: f32,
    max_m: f32,
}

impl StereoCamera {
    pub(crate) fn new(model: &Depth) -> Self {
        Self {
            scale: (model.focal_px * model.baseline_m) as f32,
            noise_px: model.disparity_noise_px as f32,
            step_px: model.disparity_step_px as f32,
            unit_m: model.unit_m as f32,
            min_m: model.min_m as f32,
            max_m: model.max_m as f32,
        }
    }

    /// What is measured of a depth, its disparity wrong by `error` standard deviations; 0 for nothing.
    #[inline]
    pub(crate) fn measured(&self, depth_m: f32, error: f32) -> f32 {
        // What is not a number fails every comparison.
        let is_within = (depth_m >= self.min_m) & (depth_m <= self.max_m) & (depth_m > 0.0);
        let disparity_px = self.scale / depth_m + self.noise_px * error;
        let disparity_px = to_steps(disparity_px, self.step_px);
        let seen_m = to_steps(self.scale / disparity_px, self.unit_m);
        if is_within & (disparity_px > 0.0) {
            seen_m
        } else {
            0.0
        }
    }
}

/// The nearest multiple of a step; the value itself where the step is 0.
#[inline]
fn to_steps(value: f32, step: f32) -> f32 {
    if step > 0.0 {
        round(value / step) * step
    } else {
        value
    }
}

/// A float as large as this has no bits left for fractions.
const NO_FRACTION: f32 = (1 << 23) as f32;

/// `f32::round` from 0 on; below 0 some number that is not above 0. Unlike that it needs nothing that the oldest x86-64 lacks, so that the
/// compiler can do several at once.
#[inline]
fn round(x: f32) -> f32 {
    let even = (x + NO_FRACTION) - NO_FRACTION;
    // Halves go up, where the sum went to the even neighbour.
    let nearest = even + if x - even == 0.5 { 1.0 } else { 0.0 };
    if x < NO_FRACTION { nearest } else { x }
}

/// Pixels near a step in the depth, with the least and the greatest depth around them.
pub(crate) fn steps(
    model: &Edges,
    width: usize,
    height: usize,
    depth_m: &[f32],
) -> Vec<(usize, f32, f32)> {
    let reach = model.width_px;
    let step_m = model.step_m as f32;
    // Along rows, then along columns: the same square window in two passes.
    let mut row_near = vec![f32::INFINITY; depth_m.len()];
    let mut row_far = vec![0.0; depth_m.len()];
    let rows = row_near.chunks_exact_mut(width);
    let rows = rows.zip(row_far.chunks_exact_mut(width));
    for ((near, far), row) in rows.zip(depth_m.chunks_exact(width)) {
        for shift in 0..(reach + 1).min(width) {
            widen((&mut *near, &mut *far), (&row[shift..], &row[shift..]));
            widen((&mut near[shift..], &mut far[shift..]), (row, row));
        }
    }
    let (mut near, mut far) = (vec![0.0; width], vec![0.0; width]);
    let mut found = Vec::new();
    for v in 0..height {
        near.fill(f32::INFINITY);
        far.fill(0.0);
        for other in v.saturating_sub(reach)..(v + reach + 1).min(height) {
            let row = other * width..(other + 1) * width;
            let others = (&row_near[row.clone()], &row_far[row]);
            widen((&mut near, &mut far), others);
        }
        for (u, (near, far)) in near.iter().zip(&far).enumerate() {
            if *near > 0.0 && far - near > step_m {
                found.push((v * width + u, *near, *far));
            }
        }
    }
    found
}

/// Takes further depths into the least and the greatest ones so far.
fn widen((near, far): (&mut [f32], &mut [f32]), (least, greatest): (&[f32], &[f32])) {
    for (near, least) in near.iter_mut().zip(least) {
        *near = near.min(*least);
    }
    for (far, greatest) in far.iter_mut().zip(greatest) {
        *far = far.max(*greatest);
    }
}

/// Values of colours that are changed at a time, whole pixels.
const AT_A_TIME: usize = 3 * 64;

/// Multiplies the channels by their gains, and gives each value noise of its own.
pub(crate) fn color(gains: [f32; 3], noise: f32, rng: &mut ChaCha8Rng, rgb: &mut [u8]) {
    if gains == [1.0; 3] && noise <= 0.0 {
        return;
    }
    let gains: [f32; AT_A_TIME] = std::array::from_fn(|index| gains[index % 3]);
    let mut errors = [0.0; AT_A_TIME];
    for values in rgb.chunks_mut(AT_A_TIME) {
        if noise > 0.0 {
            for error in &mut errors[..values.len()] {
                *error = rng.sample::<f32, _>(StandardNormal) * noise;
            }
        }
        for ((value, gain), error) in values.iter_mut().zip(&gains).zip(&errors) {
            let changed = f32::from(*value) * gain + error + 0.5;
            *value = changed.clamp(0.0, 255.0) as u8;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Perturbation;
    use rand::SeedableRng;

    fn model() -> Perturbation {
        let realsense = include_str!("../../../config/perturbations/realsense.yaml");
        Perturbation::parse("realsense.yaml", realsense).unwrap()
    }

    fn bits(values: impl IntoIterator<Item = f32>) -> Vec<u32> {
        values.into_iter().map(f32::to_bits).collect()
    }

    #[test]
    fn a_depth_is_measured_as_by_the_plain_formula() {
        let plain = |model: &Depth, depth_m: f32, error: f32| {
            let (min_m, max_m) = (model.min_m as f32, model.max_m as f32);
            if depth_m.is_nan() || depth_m < min_m || depth_m > max_m || depth_m <= 0.0 {
                return 0.0;
            }
            let scale = (model.focal_px * model.baseline_m) as f32;
            let mut disparity_px = scale / depth_m + model.disparity_noise_px as f32 * error;
            let step_px = model.disparity_step_px as f32;
            if step_px > 0.0 {
                disparity_px = (disparity_px / step_px).round() * step_px;
            }
            if disparity_px <= 0.0 {
                return 0.0;
            }
            let (seen_m, unit_m) = (scale / disparity_px, model.unit_m as f32);
            match unit_m > 0.0 {
                true => (seen_m / unit_m).round() * unit_m,
                false => seen_m,
            }
        };
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for (noise_px, step_px, unit_m, min_m) in [
            (0.05, 1.0 / 32.0, 0.001, 0.195),
            (0.05, 0.0, 0.0, 0.195),
            // So far off that disparities go below 0, and depths beyond what has fractions.
            (2.0, 1e-4, 1e-6, 0.0),
        ] {
            let depth = Depth {
                disparity_noise_px: noise_px,
                disparity_step_px: step_px,
                unit_m,
                min_m,
                ..model().depth
            };
            let stereo = StereoCamera::new(&depth);
            let at_the_limits = [f32::NAN, f32::INFINITY, 0.0, -0.0, -1.0, 1e-40, 10.0, 0.195];
            let drawn = (0..20_000).map(|_| rng.random_range(0.0..12.0f32));
            let depths: Vec<f32> = at_the_limits.into_iter().chain(drawn).collect();
            for depth_m in depths {
                let error = rng.sample(StandardNormal);
                let found = stereo.measured(depth_m, error);
                let expected = plain(&depth, depth_m, error);
                assert_eq!(found.to_bits(), expected.to_bits(), "{depth_m} {error}");
            }
        }
    }

    #[test]
    fn halves_are_rounded_up_and_what_is_large_stays() {
        let mut values = vec![0.0, 0.25, 0.499_999_97, 0.5, 0.500_000_06];
        for whole in [1.0, 2.0, 3.0, 4096.0, 4_194_303.0, 4_194_304.0, 8_388_607.0] {
            values.extend([whole - 0.5, whole, whole + 0.5]);
        }
        values.extend([NO_FRACTION, 1e9, f32::INFINITY]);
        let expected = values.iter().copied().map(f32::round);
        assert_eq!(bits(values.iter().copied().map(round)), bits(expected));
        for below in [-0.25, -0.5, -0.75, -1.0, -1e9, f32::NEG_INFINITY] {
            assert!(round(below) <= 0.0, "{below}");
        }
    }

    #[test]
    fn patches_are_interpolated_between_the_nodes_of_their_grid_in_any_order_of_rows() {
        for patch_px in [1.0, 2.7, 4.0, 64.0] {
            let (width, height) = (37, 29);
            let mut rng = ChaCha8Rng::seed_from_u64(7);
            let mut patches = Patches::draw(&mut rng, width, height, patch_px);
            for v in (0..height).chain([5, 0, 28]) {
                let node = |u: usize, right, down| {
                    let (column, row) = (place(u, patches.scale).0, place(v, patches.scale).0);
                    patches.values[(row + down) * patches.columns + column + right]
                };
                let expected = (0..width).map(|u| {
                    let (right, down) = (place(u, patches.scale).1, place(v, patches.scale).1);
                    let along = |row| {
                        let (from, to): (f32, f32) = (node(u, 0, row), node(u, 1, row));
                        from + right * (to - from)
                    };
                    along(0) + down * (along(1) - along(0))
                });
                let expected = bits(expected);
                assert_eq!(bits(patches.row(v)), expected, "{patch_px} {v}");
            }
        }
    }

    #[test]
    fn steps_are_those_within_a_square_window_also_at_the_border() {
        let (width, height) = (23, 17);
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let depth_m: Vec<f32> = (0..width * height)
            .map(|_| match rng.random_range(0..12) {
                0 => 0.0,
                1 => 0.9,
                2 => f32::NAN,
                _ => rng.random_range(1.0..1.01),
            })
            .collect();
        for width_px in [1, 2, 8] {
            let edges = Edges {
                width_px,
                ..model().edges
            };
            let around =
                |at: usize, size: usize| at.saturating_sub(width_px)..(at + width_px + 1).min(size);
            let expected = (0..width * height).filter_map(|index| {
                let (mut near, mut far) = (f32::INFINITY, 0.0f32);
                for v in around(index / width, height) {
                    for u in around(index % width, width) {
                        near = near.min(depth_m[v * width + u]);
                        far = far.max(depth_m[v * width + u]);
                    }
                }
                (near > 0.0 && far - near > edges.step_m as f32).then_some((index, near, far))
            });
            let expected: Vec<_> = expected.collect();
            assert_eq!(steps(&edges, width, height, &depth_m), expected);
        }
    }

    #[test]
    fn each_value_of_a_colour_gets_its_channels_gain_and_the_next_number() {
        let gains = [1.1, 0.9, 1.0];
        // No multiple of what is done at a time.
        let before: Vec<u8> = (0..3 * 150).map(|index| (index * 7 % 256) as u8).collect();
        for noise in [0.0f32, 2.0, 64.0] {
            let (mut rng, mut again) = (ChaCha8Rng::seed_from_u64(9), ChaCha8Rng::seed_from_u64(9));
            let expected = before.iter().enumerate().map(|(index, value)| {
                let error = match noise > 0.0 {
                    true => again.sample::<f32, _>(StandardNormal) * noise,
                    false => 0.0,
                };
                (f32::from(*value) * gains[index % 3] + error + 0.5) as u8
            });
            let expected: Vec<u8> = expected.collect();
            let mut found = before.clone();
            color(gains, noise, &mut rng, &mut found);
            assert_eq!(found, expected);
        }
    }
}
