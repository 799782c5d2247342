//! Rotated query windows, and their correlation with key features.

use nalgebra::{Point2, Rotation2, Vector2};
use tch::{Kind, Tensor};

use crate::Interpolation;
use crate::input::rotation_angle;
use crate::network::Grid;

/// Samples square windows of `features` (N x C x rows x cols), turned by the given rotations.
///
/// `centers` are continuous indices (x along columns) on the grid without its margin, one a sample;
/// `turns` the indices of rotations, as many for each sample. What lies at offset w from the centre of the
/// turned window is what lies at R(-angle) w from the centre in the features; outside is 0.
/// Returns N x rotations x C x window x window.
pub(crate) fn rotated_windows(
    features: &Tensor,
    margin: usize,
    grid: &Grid,
    sampling: Interpolation,
    centers: &[Point2<f64>],
    turns: &[Vec<usize>],
    rotations: usize,
) -> Tensor {
    let size = features.size();
    let [samples, channels, rows, cols] = [size[0], size[1], size[2], size[3]];
    let (window, turn_count) = (grid.window, turns[0].len());
    // Feature index -> [-1, 1] with -1 and 1 at the centres of the outermost cells.
    let normal = Vector2::new(2.0 / (cols - 1) as f64, 2.0 / (rows - 1) as f64);
    let mut points: Vec<f64> = Vec::with_capacity(2 * centers.len() * turn_count * window * window);
    for (center, turns) in centers.iter().zip(turns) {
        let center = center.coords.add_scalar(margin as f64);
        for turn in turns {
            let inverse = Rotation2::new(-rotation_angle(*turn, rotations));
            for row in 0..window {
                for col in 0..window {
                    let offset =
                        Vector2::new(col as f64, row as f64).add_scalar(-(grid.margin as f64));
                    let point = center + inverse * offset;
                    points.extend((point.component_mul(&normal)).add_scalar(-1.0).iter());
                }
            }
        }
    }
    let (turn_count, window) = (turn_count as i64, window as i64);
    let points = Tensor::from_slice(&points)
        .view([samples, turn_count * window, window, 2])
        .to_kind(features.kind())
        .to_device(features.device());
    let mode = match sampling {
        Interpolation::Bilinear => 0,
        Interpolation::Nearest => 1,
    };
    const ZEROS: i64 = 0;
    features
        .contiguous()
        .grid_sampler_2d(&points, mode, ZEROS, true)
        .view([samples, channels, turn_count, window, window])
        .transpose(1, 2)
}

/// Correlates key features (N x C x H x W, margin included) with windows (N x R x C x k x k), by FFT.
/// Returns N x R x rows x cols: at p the sum over channels and offsets w of key(p + w) window(w), where
/// p + w counts from the margin's corner.
pub(crate) fn correlate(key: &Tensor, windows: &Tensor, grid: &Grid) -> Tensor {
    let size = key.size();
    // Circular wrap reaches only places that are cut off below.
    let fft_size = [size[2], size[3]].map(fast_size);
    let key = key.fft_rfft2(fft_size.as_slice(), [-2, -1], "backward");
    let windows = windows.fft_rfft2(fft_size.as_slice(), [-2, -1], "backward");
    let product =
        (key.unsqueeze(1) * windows.conj()).sum_dim_intlist([2].as_slice(), false, None::<Kind>);
    product
        .fft_irfft2(fft_size.as_slice(), [-2, -1], "backward")
        .narrow(2, 0, grid.rows as i64)
        .narrow(3, 0, grid.cols as i64)
}

/// The smallest size from `least` up that is even and has no prime factor above 5.
fn fast_size(least: i64) -> i64 {
    let fast = |size: &i64| {
        let mut rest = *size;
        for prime in [2, 3, 5] {
            while rest % prime == 0 {
                rest /= prime;
            }
        }
        rest == 1 && size % 2 == 0
    };
    (least..).find(fast).unwrap_or(least)
}
