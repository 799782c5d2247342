//! Random rigid motions and colours of a sample (Zeng et al., CoRL 2020, section "Data augmentation").
//!
//! Image coordinates here are continuous: x runs along columns, y along rows, and cell (row, col) covers
//! [col, col + 1) x [row, row + 1). A rotation turns x towards y, as yaw does in the world.

use nalgebra::{
    Isometry2, Matrix3, Point2, Rotation3, Translation2, UnitComplex, UnitVector3, Vector3,
};
use rand::{Rng, RngExt};
use rand_distr::StandardNormal;

use crate::{Augmentation, Interpolation};

/// What is done to the images of a sample, and to its labels.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Warp {
    /// Where a point of the image goes, in continuous image coordinates.
    pub motion_px: Isometry2<f64>,
    /// Applied to RGB in 0..255; none where it changes nothing.
    pub colour: Option<Matrix3<f32>>,
    /// How the images are sampled.
    pub interpolation: Interpolation,
}

impl Warp {
    /// Leaves everything as it is.
    pub fn identity() -> Self {
        Self {
            motion_px: Isometry2::identity(),
            colour: None,
            interpolation: Interpolation::Nearest,
        }
    }

    /// Draws until both labels stay inside the image. The labels must be inside to begin with.
    pub fn draw(
        augmentation: &Augmentation,
        rows: usize,
        cols: usize,
        labels_px: [Point2<f64>; 2],
        rng: &mut impl Rng,
    ) -> Self {
        // Far more than ever needed; a label inside can always stay where it is.
        const ATTEMPTS: usize = 1000;
        let center = Translation2::new(cols as f64 / 2.0, rows as f64 / 2.0);
        let inside = |point: Point2<f64>| {
            (0.0..cols as f64).contains(&point.x) && (0.0..rows as f64).contains(&point.y)
        };
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
        Self {
            motion_px,
            colour: colour(augmentation, rng),
            interpolation: augmentation.interpolation,
        }
    }
}

/// A turn about the grey axis, so that a grey table stays grey, and a gain on each channel.
fn colour(augmentation: &Augmentation, rng: &mut impl Rng) -> Option<Matrix3<f32>> {
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
            let warp = Warp::draw(&Augmentation::default(), 320, 160, labels, &mut rng);
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
            let warp = Warp::draw(&Augmentation::default(), 320, 160, middle, &mut rng);
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
    fn a_hue_turn_leaves_grey_alone() {
        let augmentation = Augmentation {
            hue_probability: 1.0,
            ..Augmentation::NONE
        };
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let turn = colour(&augmentation, &mut rng).unwrap();
        let grey = Vector3::repeat(100.0);
        assert!((turn * grey - grey).norm() < 1e-3);
        let red = Vector3::new(200.0, 0.0, 0.0);
        assert!((turn * red - red).norm() > 1.0);
    }
}
