//! Random rigid motions and colours of a sample (Zeng et al., CoRL 2020, section "Data augmentation").
//!
//! Image coordinates here are continuous: x runs along columns, y along rows, and cell (row, col) covers
//! [col, col + 1) x [row, row + 1). A rotation turns x towards y, as yaw does in the world.

use nalgebra::{
    Isometry2, Matrix3, Point2, Rotation3, Translation2, UnitComplex, UnitVector3, Vector3,
};
use rand::{Rng, RngExt};
use rand_distr::StandardNormal;

use crate::{Augmentation, Interpolation, SensorNoise};

/// What is done to the images of a sample, and to its labels.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Warp {
    /// Where a point of the image goes, in continuous image coordinates.
    pub motion_px: Isometry2<f64>,
    /// Whether the image is mirrored, columns in reverse, before it is moved.
    pub mirrored: bool,
    /// Applied to RGB in 0..255; `None` for no change.
    pub color: Option<Matrix3<f32>>,
    /// Sensor noise of each image, in the order in which a network reads them; empty without noise.
    pub sensors: Vec<Sensor>,
    /// How the images are sampled.
    pub interpolation: Interpolation,
}

impl Warp {
    /// Leaves everything as it is.
    pub fn identity() -> Self {
        Self {
            motion_px: Isometry2::identity(),
            mirrored: false,
            color: None,
            sensors: Vec::new(),
            interpolation: Interpolation::Nearest,
        }
    }

    /// Draws until both labels stay inside the image. The labels must be inside to begin with. `images` is the number of
    /// images of a sample.
    pub fn draw(
        augmentation: &Augmentation,
        rows: usize,
        cols: usize,
        images: usize,
        labels_px: [Point2<f64>; 2],
        rng: &mut impl Rng,
    ) -> Self {
        // Far more than ever needed; a label inside can always stay where it is.
        const ATTEMPTS: usize = 1000;
        let center = Translation2::new(cols as f64 / 2.0, rows as f64 / 2.0);
        let inside = |point: Point2<f64>| {
            (0.0..cols as f64).contains(&point.x) && (0.0..rows as f64).contains(&point.y)
        };
        // A lever that is off draws nothing, so that trainings from before there was one are repeated bit for bit.
        let chance = |share: f64, rng: &mut dyn Rng| share > 0.0 && rng.random::<f64>() < share;
        let mirrored = chance(augmentation.mirror_probability, rng);
        let mirror = |point: Point2<f64>| match mirrored {
            true => Point2::new(cols as f64 - point.x, point.y),
            false => point,
        };
        let labels_px = labels_px.map(mirror);
        let motion_px = (0..ATTEMPTS)
            .map(|_| {
                let mut normal = || rng.sample::<f64, _>(StandardNormal);
                let turn =
                    UnitComplex::new(augmentation.rotation_sigma_deg.to_radians() * normal());
                let shift = Translation2::new(
                    augmentation.translation_sigma_px * normal(),
                    augmentation.translation_sigma_px * normal(),
                );
                shift * center * turn * center.inverse()
            })
            .find(|motion| labels_px.iter().all(|label| inside(motion * label)))
            .unwrap_or_else(Isometry2::identity);
        let mut color = color(augmentation, rng);
        if chance(augmentation.permutation_probability, rng) {
            let order = PERMUTATIONS[rng.random_range(0..PERMUTATIONS.len())];
            let permutation = Matrix3::from_fn(|row, col| f32::from(u8::from(order[row] == col)));
            color = Some(permutation * color.unwrap_or_else(Matrix3::identity));
        }
        let sensor = &augmentation.sensor;
        let sensors = match *sensor == SensorNoise::NONE {
            true => Vec::new(),
            false => (0..images).map(|_| Sensor::draw(sensor, rng)).collect(),
        };
        Self {
            motion_px,
            mirrored,
            color,
            sensors,
            interpolation: augmentation.interpolation,
        }
    }

    /// Where a point of an image with so many columns goes.
    pub fn moved(&self, point_px: Point2<f64>, cols: usize) -> Point2<f64> {
        self.motion_px
            * match self.mirrored {
                true => Point2::new(cols as f64 - point_px.x, point_px.y),
                false => point_px,
            }
    }
}

/// The orders of three colour channels but the one that changes nothing.
const PERMUTATIONS: [[usize; 3]; 5] = [[0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];

/// One exposure: what it does to the cells of one image.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Sensor {
    /// Factors of red, green and blue.
    pub gains: [f32; 3],
    /// Added to all heights that are not missing.
    pub height_offset_m: f32,
    /// Largest error of a colour and of a height.
    pub color_noise: f32,
    pub height_noise_m: f32,
    /// A cell whose random number of 16 bits is below this has no height.
    pub holes_below: u32,
    /// Seed of the noise of cells.
    pub seed: u64,
}

impl Sensor {
    fn draw(noise: &SensorNoise, rng: &mut impl Rng) -> Self {
        let mut normal = |sigma: f64| sigma * rng.sample::<f64, _>(StandardNormal);
        let gain = normal(noise.gain_sigma);
        let gains = [(); 3].map(|()| (gain + normal(noise.tint_sigma)).exp() as f32);
        let height_offset_m = normal(noise.height_offset_sigma_m) as f32;
        Self {
            gains,
            height_offset_m,
            color_noise: noise.color_noise as f32,
            height_noise_m: noise.height_noise_m as f32,
            holes_below: (noise.hole_share * 65536.0) as u32,
            seed: rng.random(),
        }
    }

    /// What the sensor reads of a cell (RGB in 0..255, height in m) of this index.
    #[inline(always)]
    pub fn read(&self, index: usize, cell: [f32; 4]) -> [f32; 4] {
        // SplitMix64 (Steele, Lea and Flood, 2014), whose state is the cell's index: one number for each cell.
        let mut bits = self
            .seed
            .wrapping_add((index as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15));
        bits = (bits ^ (bits >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        bits ^= bits >> 31;
        let share = |part: u32| (((bits >> (16 * part)) & 0xffff) as f32) * (2.0 / 65535.0) - 1.0;
        // Bits of two colours once more: a hole may well go with their noise.
        let hole = ((bits >> 24) as u32 & 0xffff) < self.holes_below;
        let height_m = match hole {
            true => 0.0,
            false => cell[3] + self.height_offset_m + self.height_noise_m * share(3),
        };
        let color = |channel: usize| {
            let noise = self.color_noise * share(channel as u32);
            (cell[channel] * self.gains[channel] + noise).clamp(0.0, 255.0)
        };
        [color(0), color(1), color(2), height_m]
    }
}

/// A turn about the grey axis, so that a grey table stays grey, and a gain on each channel.
fn color(augmentation: &Augmentation, rng: &mut impl Rng) -> Option<Matrix3<f32>> {
    // Draws in any case, so that a lever does not change what the others draw.
    let turned = rng.random::<f64>() < augmentation.hue_probability;
    let angle = rng.random_range(0.0..std::f64::consts::TAU);
    let gains = Vector3::from_fn(|_, _| {
        (augmentation.gain_sigma * rng.sample::<f64, _>(StandardNormal)).exp()
    });
    if !turned && augmentation.gain_sigma == 0.0 {
        return None;
    }
    let grey = UnitVector3::new_normalize(Vector3::repeat(1.0));
    let hue = Rotation3::from_axis_angle(&grey, if turned { angle } else { 0.0 });
    Some((Matrix3::from_diagonal(&gains) * hue.matrix()).cast())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

    proptest! {
        #[test]
        fn labels_stay_inside(seed: u64, labels in [[0.0..160.0, 0.0..320.0], [0.0..160.0, 0.0..320.0]]) {
            let labels = labels.map(Point2::from);
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let warp = Warp::draw(&Augmentation::default(), 320, 160, 2, labels, &mut rng);
            for label in labels {
                let label = warp.motion_px * label;
                prop_assert!((0.0..160.0).contains(&label.x) && (0.0..320.0).contains(&label.y));
            }
        }
    }

    #[test]
    fn draws_have_the_published_spread() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let middle = [Point2::new(80.0, 160.0); 2];
        let draws = 20_000;
        let mut squares = [0.0, 0.0];
        for _ in 0..draws {
            let warp = Warp::draw(&Augmentation::default(), 320, 160, 2, middle, &mut rng);
            squares[0] += (warp.motion_px * middle[0] - middle[0]).y.powi(2);
            // The angle is seen modulo a turn: its cosine has mean exp(-sigma^2 / 2).
            squares[1] += warp.motion_px.rotation.cos_angle();
        }
        let sigma_px = (squares[0] / draws as f64).sqrt();
        let cosine = squares[1] / draws as f64;
        let expected = (-60f64.to_radians().powi(2) / 2.0).exp();
        assert!((sigma_px - 26.67).abs() < 0.5, "{sigma_px}");
        assert!((cosine - expected).abs() < 0.02, "{cosine} {expected}");
    }

    #[test]
    fn a_mirrored_label_stays_inside_and_on_its_thing() {
        let augmentation = Augmentation {
            mirror_probability: 1.0,
            ..Augmentation::NONE
        };
        let label = Point2::new(10.0, 20.0);
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let warp = Warp::draw(&augmentation, 320, 160, 3, [label; 2], &mut rng);
        assert!(warp.mirrored && warp.sensors.is_empty());
        assert_eq!(warp.moved(label, 160), Point2::new(150.0, 20.0));
    }

    #[test]
    fn a_permutation_keeps_the_set_of_colors() {
        let augmentation = Augmentation {
            permutation_probability: 1.0,
            ..Augmentation::NONE
        };
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let mut seen = std::collections::BTreeSet::new();
        for _ in 0..100 {
            let middle = [Point2::new(80.0, 160.0); 2];
            let warp = Warp::draw(&augmentation, 320, 160, 3, middle, &mut rng);
            let color = warp.color.unwrap() * Vector3::new(1.0, 2.0, 3.0);
            assert_eq!(color.sum(), 6.0);
            seen.insert(color.iter().map(|c| *c as u8).collect::<Vec<_>>());
        }
        assert_eq!(
            seen.len(),
            5,
            "every order but the one that changes nothing"
        );
    }

    #[test]
    fn each_image_has_a_sensor_of_its_own_within_the_bounds() {
        let augmentation = Augmentation {
            sensor: SensorNoise {
                tint_sigma: 0.1,
                color_noise: 3.0,
                height_noise_m: 0.002,
                hole_share: 0.1,
                ..SensorNoise::NONE
            },
            ..Augmentation::NONE
        };
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let middle = [Point2::new(80.0, 160.0); 2];
        let warp = Warp::draw(&augmentation, 320, 160, 3, middle, &mut rng);
        assert_eq!(warp.sensors.len(), 3);
        assert_ne!(warp.sensors[0].gains, warp.sensors[1].gains);
        let sensor = &warp.sensors[2];
        let (mut holes, mut least, mut most) = (0, f32::MAX, f32::MIN);
        const CELLS: usize = 20_000;
        for index in 0..CELLS {
            let [red, _, _, height] = sensor.read(index, [100.0, 50.0, 20.0, 0.04]);
            assert!((red - 100.0 * sensor.gains[0]).abs() <= 3.001);
            if height == 0.0 {
                holes += 1;
            } else {
                (least, most) = (least.min(height), most.max(height));
            }
        }
        assert!((1800..2200).contains(&holes), "{holes}");
        assert!((0.038..0.0382).contains(&least) && (0.0418..=0.042001).contains(&most));
    }

    #[test]
    fn a_hue_turn_leaves_grey_alone() {
        let augmentation = Augmentation {
            hue_probability: 1.0,
            ..Augmentation::NONE
        };
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let turn = color(&augmentation, &mut rng).unwrap();
        let grey = Vector3::repeat(100.0);
        assert!((turn * grey - grey).norm() < 1e-3);
        let red = Vector3::new(200.0, 0.0, 0.0);
        assert!((turn * red - red).norm() > 1.0);
    }
}
