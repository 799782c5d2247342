//! Rotated query windows, and their correlation with key features.

use std::cell::RefCell;
use std::thread::LocalKey;

use nalgebra::{Point2, Rotation2, Vector2};
use tch::{Device, Kind, Tensor};

use crate::Interpolation;
use crate::input::rotation_angle;
use crate::network::Grid;

/// Samples square windows of `features` (N x C x rows x cols), turned by the given rotations.
///
/// `centers` are continuous indices (x along columns) on the grid without its margin, one a sample;
/// `turns` the indices of rotations, as many for each sample. What lies at offset w from the centre of the
/// turned window is what lies at R(-angle) w from the centre in the features; outside is 0. Nearest: half
/// way between two cells the even one is taken, whatever the last bits of sine and cosine.
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
    let centers: Vec<_> = centers
        .iter()
        .map(|center| center + Vector2::repeat(margin as f64))
        .collect();
    let window = (grid.window, grid.margin as f64);
    sampled_windows(features, window, sampling, &centers, turns, rotations)
}

/// The same of features without a margin: windows of so many cells along each edge, with their middle at this index of theirs. Of the
/// features of one sample (1 x C x rows x cols) windows at any number of centres.
pub(crate) fn sampled_windows(
    features: &Tensor,
    (window, middle): (usize, f64),
    sampling: Interpolation,
    centers: &[Point2<f64>],
    turns: &[Vec<usize>],
    rotations: usize,
) -> Tensor {
    let size = features.size();
    let [samples, channels, rows, cols] = [size[0], size[1], size[2], size[3]];
    let turn_count = turns[0].len();
    // From the centre to each cell of each window, rows of x and y.
    let offsets = |turns: &[usize]| {
        let cell = |index: usize| Vector2::new((index % window) as f64, (index / window) as f64);
        let turned = |turn: &usize| {
            let inverse = Rotation2::new(-rotation_angle(*turn, rotations));
            (0..window * window).flat_map(move |index| {
                let offset = inverse * cell(index).add_scalar(-middle);
                [offset.x, offset.y]
            })
        };
        let offsets: Vec<f64> = turns.iter().flat_map(turned).collect();
        Tensor::from_slice(&offsets).view([1, -1, 2])
    };
    let device = features.device();
    let are_turned_alike = turns.iter().all(|other| *other == turns[0]);
    let offsets = match are_turned_alike {
        true => {
            let key = (
                window,
                middle.to_bits(),
                rotations,
                turns[0].clone(),
                device,
            );
            kept(&OFFSETS, key, || offsets(&turns[0]).to_device(device))
        }
        false => {
            let each: Vec<Tensor> = turns.iter().map(|turns| offsets(turns)).collect();
            Tensor::cat(&each, 0).to_device(device)
        }
    };
    // Where all windows of all samples lie alike, they are computed once.
    let are_alike = are_turned_alike && centers.iter().all(|other| *other == centers[0]);
    let chosen = match are_alike {
        true => &centers[..1],
        false => centers,
    };
    // Feature index -> [-1, 1] with -1 and 1 at the centres of the outermost cells; in 64 bits, whatever the features are in.
    let normal = [2.0 / (cols - 1) as f64, 2.0 / (rows - 1) as f64];
    let places: Vec<f64> = chosen
        .iter()
        .flat_map(|center| [center.x, center.y])
        .collect();
    let [normal, places] = [&normal[..], &places[..]].map(|numbers| {
        let numbers = Tensor::from_slice(numbers).view([-1, 1, 2]);
        numbers.to_device(device)
    });
    let points = places + offsets;
    let points = match sampling {
        Interpolation::Bilinear => points,
        Interpolation::Nearest => nearest(&points),
    };
    let points = points * normal - 1.0;
    let (turn_count, window) = (turn_count as i64, window as i64);
    let count = centers.len() as i64;
    let points = points
        .to_kind(features.kind())
        .view([chosen.len() as i64, turn_count * window, window, 2])
        .expand([count, -1, -1, -1], false)
        .reshape([samples, -1, window, 2]);
    let mode = match sampling {
        Interpolation::Bilinear => 0,
        Interpolation::Nearest => 1,
    };
    const ZEROS: i64 = 0;
    features
        .contiguous()
        .grid_sampler_2d(&points, mode, ZEROS, true)
        .view([samples, channels, -1, window, window])
        .transpose(1, 2)
        .reshape([count, turn_count, channels, window, window])
}

/// The nearest whole numbers, the even one of two that are equally near. Turns of 60 and 90 degrees meet
/// such ties; sine and cosine miss them by a last bit, one way or the other.
fn nearest(indices: &Tensor) -> Tensor {
    const TIE: f64 = 1e9;
    // Ties go to the even number.
    ((indices * TIE).round() / TIE).round()
}

/// Tables by what they depend on. Each thread has its own, on the devices that it computes on.
type Tables<K> = LocalKey<RefCell<Vec<(K, Tensor)>>>;

/// Window, middle (bits), rotations, turns.
type OffsetsKey = (usize, u64, usize, Vec<usize>, Device);
/// Length of the circle, numbers, which matrix.
type SpectrumKey = (i64, i64, Matrix, (Kind, Device));

thread_local! {
    static OFFSETS: RefCell<Vec<(OffsetsKey, Tensor)>> = const { RefCell::new(Vec::new()) };
    static SPECTRA: RefCell<Vec<(SpectrumKey, Tensor)>> = const { RefCell::new(Vec::new()) };
}

/// The table of this key, made where it is not there. A network needs few.
fn kept<K: PartialEq>(tables: &'static Tables<K>, key: K, make: impl FnOnce() -> Tensor) -> Tensor {
    const MOST: usize = 32;
    tables.with_borrow_mut(|tables| {
        if let Some((_, table)) = tables.iter().find(|(known, _)| *known == key) {
            return table.shallow_clone();
        }
        if tables.len() == MOST {
            drop(tables.remove(0));
        }
        let table = make();
        tables.push((key, table.shallow_clone()));
        table
    })
}

/// Correlates key features (N x C x H x W, margin included) with windows (N x R x C x k x k).
/// Returns N x R x rows x cols: at p the sum over channels and offsets w of key(p + w) window(w), where
/// p + w counts from the margin's corner.
pub(crate) fn correlate(key: &Tensor, windows: &Tensor, grid: &Grid) -> Tensor {
    // Where the transforms of many windows would cost most, only the columns are transformed: measured
    // 9 ms against 50 ms for 36 windows of 8 x 25 x 25, but 31 ms against 6 ms for 4 samples of 2.
    const MANY: i64 = 8;
    if windows.size()[1] < MANY {
        correlate_in_frequencies(key, windows, grid)
    } else {
        correlate_in_column_frequencies(key, windows, grid)
    }
}

/// By FFT over rows and columns.
fn correlate_in_frequencies(key: &Tensor, windows: &Tensor, grid: &Grid) -> Tensor {
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

/// By Fourier transform of the columns and, at each of their frequencies, products of matrices over channels and rows. The
/// transforms are products of matrices too: of so short rows these are faster than a FFT, and nothing is copied between layouts.
fn correlate_in_column_frequencies(key: &Tensor, windows: &Tensor, grid: &Grid) -> Tensor {
    let size = windows.size();
    let [samples, turns, channels, window] = [size[0], size[1], size[2], size[3]];
    let (rows, cols) = (grid.rows as i64, grid.cols as i64);
    let (key_rows, key_cols) = (key.size()[2], key.size()[3]);
    let spectrum = Spectrum::new(key_cols, (key.kind(), key.device()));
    let frequencies = spectrum.frequencies;

    // Real and imaginary parts, samples * frequencies x channels * window x rows.
    let keys = spectrum
        .of(&key.reshape([samples, channels * key_rows, key_cols]))
        .view([samples * frequencies, 2, channels, key_rows])
        .unfold(3, rows, 1)
        .narrow(3, 0, window)
        .reshape([samples * frequencies, 2, channels * window, rows]);
    // What the windows' conjugates take from the real and from the imaginary part of the key, to the real and to the imaginary part of
    // the product: samples * frequencies x 2 * turns x channels * window each. So a key is read once for both.
    let windows = spectrum
        .of_conjugates(&windows.reshape([samples, turns * channels * window, window]))
        .view([samples * frequencies, 2, 2 * turns, channels * window]);
    let [from_real, from_imaginary] = [0, 1].map(|part| windows.select(1, part));
    let product = from_real
        .bmm(&keys.select(1, 0))
        .baddbmm(&from_imaginary, &keys.select(1, 1), 1, 1)
        .view([samples, 2 * frequencies, turns * rows]);
    spectrum
        .back(&product, cols)
        .view([samples, turns, rows, cols])
}

/// Which matrix of a transform.
#[derive(Clone, Copy, PartialEq)]
enum Matrix {
    Forth,
    OfConjugates,
    Back,
}

/// The discrete Fourier transform of real numbers as matrices.
struct Spectrum {
    /// Numbers, the circle on which a correlation wraps.
    len: i64,
    frequencies: i64,
    options: (Kind, Device),
}

impl Spectrum {
    fn new(len: i64, options: (Kind, Device)) -> Self {
        Self {
            len,
            frequencies: len / 2 + 1,
            options,
        }
    }

    /// A matrix of so many rows for each frequency x numbers, of the first numbers. Each row is a factor times the frequency's cosine
    /// and another times its sine.
    fn matrix<const ROWS: usize>(
        &self,
        which: Matrix,
        numbers: i64,
        factors: impl Fn(i64) -> [[f64; 2]; ROWS],
    ) -> Tensor {
        let key = (self.len, numbers, which, self.options);
        kept(&SPECTRA, key, || self.make(numbers, factors))
    }

    fn make<const ROWS: usize>(
        &self,
        numbers: i64,
        factors: impl Fn(i64) -> [[f64; 2]; ROWS],
    ) -> Tensor {
        // One turn of the circle: every angle is one of these.
        let circle: Vec<(f64, f64)> = (0..self.len)
            .map(|at| (std::f64::consts::TAU * at as f64 / self.len as f64).sin_cos())
            .collect();
        let rows = ROWS as i64 * self.frequencies;
        let mut matrix = Vec::with_capacity((rows * numbers) as usize);
        for frequency in 0..self.frequencies {
            for [of_cosine, of_sine] in factors(frequency) {
                matrix.extend((0..numbers).map(|at| {
                    let (sine, cosine) = circle[(frequency * at % self.len) as usize];
                    of_cosine * cosine + of_sine * sine
                }));
            }
        }
        Tensor::from_slice(&matrix)
            .view([rows, numbers])
            .to_kind(self.options.0)
            .to_device(self.options.1)
    }

    /// Real and imaginary parts of the spectra of N x rows x numbers, padded with 0: N x 2 * frequencies x rows.
    fn of(&self, numbers: &Tensor) -> Tensor {
        let matrix = self.matrix(Matrix::Forth, numbers.size()[2], |_| {
            [[1.0, 0.0], [0.0, -1.0]]
        });
        matrix.matmul(&numbers.transpose(1, 2))
    }

    /// Of the same spectra, real a and imaginary b: at each frequency a, -b, b, a, as a product with their conjugates
    /// takes them. N x 4 * frequencies x rows.
    fn of_conjugates(&self, numbers: &Tensor) -> Tensor {
        let real = [1.0, 0.0];
        let rows = |_| [real, [0.0, 1.0], [0.0, -1.0], real];
        let matrix = self.matrix(Matrix::OfConjugates, numbers.size()[2], rows);
        matrix.matmul(&numbers.transpose(1, 2))
    }

    /// The first numbers of spectra N x 2 * frequencies x rows: N x rows x numbers.
    fn back(&self, spectra: &Tensor, numbers: i64) -> Tensor {
        let factors = |frequency: i64| {
            // Every frequency but the lowest and, of an even length, the highest stands for its mirror image too.
            let alone = frequency == 0 || 2 * frequency == self.len;
            let share = if alone { 1.0 } else { 2.0 } / self.len as f64;
            [[share, 0.0], [0.0, -share]]
        };
        let matrix = self.matrix(Matrix::Back, numbers, factors);
        spectra.transpose(1, 2).matmul(&matrix)
    }
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

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    const DOUBLE: (Kind, Device) = (Kind::Double, Device::Cpu);

    fn grid(rows: usize, cols: usize, window: usize) -> Grid {
        Grid {
            rows,
            cols,
            stride: 1,
            window,
            margin: window / 2,
            query_margin: 0,
            sampling: Interpolation::Bilinear,
            subcell: false,
        }
    }

    fn noise(size: &[i64], seed: i64) -> Tensor {
        let len: i64 = size.iter().product();
        (Tensor::arange(len, DOUBLE) * 12.9898 + seed)
            .sin()
            .view(size)
            * 3.0
    }

    #[test]
    fn both_ways_agree_with_the_definition() {
        // An odd window with its margin on both sides, and an even one whose last margin cell is unused.
        for (window, rows, cols) in [(5, 12, 10), (6, 14, 16)] {
            let grid = grid(rows, cols, window);
            let margin = 2 * grid.margin as i64;
            let key = noise(&[2, 3, rows as i64 + margin, cols as i64 + margin], 1);
            let windows = noise(&[2, 4, 3, window as i64, window as i64], 2);
            let direct: Vec<Tensor> = (0..2)
                .map(|sample| {
                    let key = key.narrow(0, sample, 1);
                    key.conv2d(
                        &windows.select(0, sample),
                        None::<&Tensor>,
                        [1, 1],
                        [0, 0],
                        [1, 1],
                        1,
                    )
                })
                .collect();
            let direct =
                Tensor::cat(&direct, 0)
                    .narrow(2, 0, rows as i64)
                    .narrow(3, 0, cols as i64);
            for way in [correlate_in_frequencies, correlate_in_column_frequencies] {
                let error = (way(&key, &windows, &grid) - &direct)
                    .abs()
                    .max()
                    .double_value(&[]);
                assert!(error < 1e-10, "{error}");
            }
        }
    }

    #[test]
    fn both_ways_have_the_same_gradients() {
        let grid = grid(12, 10, 5);
        let weight = noise(&[1, 3, 12, 10], 3);
        let gradients = [correlate_in_frequencies, correlate_in_column_frequencies].map(|way| {
            let key = noise(&[1, 2, 16, 14], 1).set_requires_grad(true);
            let windows = noise(&[1, 3, 2, 5, 5], 2).set_requires_grad(true);
            let loss = (way(&key, &windows, &grid) * &weight).sum(None::<Kind>);
            Tensor::run_backward(&[loss], &[key, windows], false, false)
        });
        let [ours, theirs] = &gradients;
        for (ours, theirs) in ours.iter().zip(theirs) {
            let error = (ours - theirs).abs().max().double_value(&[]);
            assert!(error < 1e-10, "{error}");
        }
    }

    /// An image of an L of six soft dots: asymmetric, so that every wrong turn or mirror shows. Its corner
    /// lies at `corner` (x, y); the long arm points along +x, the short one along +y, both turned by
    /// `angle`.
    fn letter(size: i64, corner: Point2<f64>, angle: f64) -> Tensor {
        let dots = [(0., 0.), (3., 0.), (6., 0.), (9., 0.), (0., 3.), (0., 6.)];
        let dots = dots.map(|(x, y)| corner + Rotation2::new(angle) * Vector2::new(x, y));
        let cells = (0..size * size).map(|index| {
            let cell = Point2::new((index % size) as f64, (index / size) as f64);
            dots.iter()
                .map(|dot| (-(cell - dot).norm_squared() / 2.0).exp())
                .sum()
        });
        Tensor::from_slice(&cells.collect::<Vec<f64>>()).view([1, 1, size, size])
    }

    #[test]
    fn an_l_is_found_where_it_went_and_how_it_was_turned() {
        const SIZE: i64 = 64;
        let mut grid = grid(SIZE as usize, SIZE as usize, 25);
        for sampling in [Interpolation::Nearest, Interpolation::Bilinear] {
            grid.sampling = sampling;
            for rotation in [0, 1, 4, 9, 14, 18, 27, 35] {
                let turn = TAU * rotation as f64 / 36.0;
                // It lies turned already: the wanted turn is relative to that.
                let (first, from) = (0.3, Point2::new(20.0, 22.0));
                let (pick, place) = (from, Point2::new(40.0, 37.0));
                let query = letter(SIZE, from, first);
                let key = letter(SIZE, place, first + turn);
                let turns = [(0..36).collect()];
                let windows = rotated_windows(&query, 0, &grid, sampling, &[pick], &turns, 36);
                let key = key.constant_pad_nd([grid.margin as i64; 4]);
                let scores = correlate(&key, &windows, &grid);
                let best = scores.argmax(None, false).int64_value(&[]);
                let (index, row, col) = (best / (SIZE * SIZE), best / SIZE % SIZE, best % SIZE);
                assert_eq!((index, row, col), (rotation, 37, 40), "{sampling:?}");
            }
        }
    }

    #[test]
    fn quarter_turns_move_whole_cells() {
        // At a quarter turn the window's +x is the image's -y side: R(-90 deg) (1, 0) = (0, -1).
        let features = Tensor::arange(49, DOUBLE).view([1, 1, 7, 7]);
        let grid = grid(7, 7, 3);
        for sampling in [Interpolation::Nearest, Interpolation::Bilinear] {
            let center = [Point2::new(3.0, 3.0)];
            let windows = rotated_windows(&features, 0, &grid, sampling, &center, &[vec![0, 1]], 4);
            let values = |turn: i64| {
                Vec::<f64>::try_from(windows.get(0).get(turn).round().flatten(0, -1)).unwrap()
            };
            assert_eq!(values(0), [16., 17., 18., 23., 24., 25., 30., 31., 32.]);
            assert_eq!(values(1), [30., 23., 16., 31., 24., 17., 32., 25., 18.]);
        }
    }

    #[test]
    fn half_way_between_cells_the_even_one_is_taken() {
        // R(-60 deg) (u, v) = (u / 2 + s v, v / 2 - s u) with s = 0.866: the window's corners and the ends
        // of its axes, by hand. Every other coordinate is a tie.
        let features = Tensor::arange(49, DOUBLE).view([1, 1, 7, 7]);
        let grid = grid(7, 7, 3);
        let sampled = |x: f64, y: f64, turns: usize, kind: Kind| {
            let features = features.to_kind(kind);
            let center = [Point2::new(x, y)];
            let sampling = Interpolation::Nearest;
            let windows =
                rotated_windows(&features, 0, &grid, sampling, &center, &[vec![1]], turns);
            Vec::<f64>::try_from(windows.to_kind(Kind::Double).flatten(0, -1)).unwrap()
        };
        for kind in [Kind::Double, Kind::Float] {
            // About (3, 3), row by row: x 1.63 2.13 2.63 | 2.5 3 3.5 | 3.37 3.87 4.37 and
            // y 3.37 2.5 1.63 | 3.87 3 2.13 | 4.37 3.5 2.63; 2.5 goes to 2, 3.5 to 4.
            let cells = [
                (2, 3),
                (2, 2),
                (3, 2),
                (2, 4),
                (3, 3),
                (4, 2),
                (3, 4),
                (4, 4),
                (4, 3),
            ];
            let expected = cells.map(|(x, y)| f64::from(7 * y + x));
            assert_eq!(sampled(3.0, 3.0, 6, kind), expected, "{kind:?}");
            // A quarter turn about a point between cells: all nine are ties in x, none in y.
            let cells = [2, 2, 2, 4, 4, 4, 4, 4, 4].map(f64::from);
            let columns: Vec<_> = sampled(3.5, 3.0, 4, kind)
                .iter()
                .map(|at| at % 7.0)
                .collect();
            assert_eq!(columns, cells, "{kind:?}");
        }
    }

    #[test]
    fn windows_over_the_edge_are_zero_there() {
        let features = Tensor::ones([1, 1, 6, 6], DOUBLE);
        let grid = grid(6, 6, 3);
        let corner = [Point2::new(0.0, 0.0)];
        let windows = rotated_windows(
            &features,
            0,
            &grid,
            Interpolation::Nearest,
            &corner,
            &[vec![0]],
            36,
        );
        let values = Vec::<f64>::try_from(windows.flatten(0, -1)).unwrap();
        assert_eq!(values, [0., 0., 0., 0., 1., 1., 0., 1., 1.]);
    }

    #[test]
    fn a_margin_shifts_the_centre() {
        let inner = noise(&[1, 2, 9, 8], 5);
        let center = [Point2::new(3.25, 4.5)];
        let turns = [vec![0, 3, 11]];
        let grid = grid(9, 8, 5);
        let sampling = Interpolation::Bilinear;
        let plain = rotated_windows(&inner, 0, &grid, sampling, &center, &turns, 36);
        let padded = inner.constant_pad_nd([4; 4]);
        let shifted = rotated_windows(&padded, 4, &grid, sampling, &center, &turns, 36);
        assert!((plain - shifted).abs().max().double_value(&[]) < 1e-12);
    }

    #[test]
    fn transform_sizes_are_even_and_smooth() {
        assert_eq!(
            [184, 104, 384, 224, 7].map(fast_size),
            [192, 108, 384, 240, 8]
        );
    }
}
