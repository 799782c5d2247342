//! Lens distortion.

use nalgebra::{Matrix2, Vector2};
use serde::{Deserialize, Serialize};

/// Radial and tangential distortion after Brown and Conrady, as OpenCV has it and ROS calls it
/// `plumb_bob`; coefficients are of normalised image points (x / z, y / z).
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Distortion {
    /// Radial, second power of the radius.
    pub k1: f64,
    /// Radial, fourth power.
    pub k2: f64,
    /// Tangential, vertical.
    pub p1: f64,
    /// Tangential, horizontal.
    pub p2: f64,
    /// Radial, sixth power.
    pub k3: f64,
}

/// Newton's method gains so many digits with each step that it needs five or six.
const MAX_STEPS: usize = 50;
/// Far below a pixel, far above rounding.
const TOLERANCE: f64 = 1e-12;

impl Distortion {
    /// A pinhole.
    pub const NONE: Self = Self {
        k1: 0.0,
        k2: 0.0,
        p1: 0.0,
        p2: 0.0,
        k3: 0.0,
    };

    /// Whether the lens is a pinhole.
    pub fn is_none(&self) -> bool {
        *self == Self::NONE
    }

    /// Whether every coefficient is a number.
    pub(crate) fn is_finite(&self) -> bool {
        let Self { k1, k2, p1, p2, k3 } = *self;
        [k1, k2, p1, p2, k3].iter().all(|part| part.is_finite())
    }

    /// Where the lens shows an ideal point. None where the model folds the image back over itself: no
    /// lens does that, and what is out there is not seen.
    pub fn distort(&self, ideal: &Vector2<f64>) -> Option<Vector2<f64>> {
        self.grows_up_to(ideal.norm_squared())
            .then(|| self.shift(ideal))
    }

    /// The ideal point that the lens shows there. None if there is no such point.
    pub fn undistort(&self, seen: &Vector2<f64>) -> Option<Vector2<f64>> {
        if self.is_none() {
            return Some(*seen);
        }
        let mut ideal = *seen;
        for _ in 0..MAX_STEPS {
            let rest = seen - self.shift(&ideal);
            if rest.amax() <= TOLERANCE * (1.0 + seen.amax()) {
                let good = self.slope(&ideal).determinant() > 0.0
                    && self.grows_up_to(ideal.norm_squared());
                return good.then_some(ideal);
            }
            ideal += self.slope(&ideal).try_inverse()? * rest;
        }
        None
    }

    fn shift(&self, ideal: &Vector2<f64>) -> Vector2<f64> {
        let Self { k1, k2, p1, p2, k3 } = *self;
        let (x, y, square) = (ideal.x, ideal.y, ideal.norm_squared());
        let radial = 1.0 + square * (k1 + square * (k2 + square * k3));
        Vector2::new(
            x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x),
            y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y,
        )
    }

    /// Derivative of [`Self::shift`].
    fn slope(&self, ideal: &Vector2<f64>) -> Matrix2<f64> {
        let Self { k1, k2, p1, p2, k3 } = *self;
        let (x, y, square) = (ideal.x, ideal.y, ideal.norm_squared());
        let radial = 1.0 + square * (k1 + square * (k2 + square * k3));
        let growth = k1 + square * (2.0 * k2 + square * 3.0 * k3);
        let mixed = 2.0 * (x * y * growth + p1 * x + p2 * y);
        Matrix2::new(
            radial + 2.0 * x * x * growth + 2.0 * p1 * y + 6.0 * p2 * x,
            mixed,
            mixed,
            radial + 2.0 * y * y * growth + 6.0 * p1 * y + 2.0 * p2 * x,
        )
    }

    /// Whether points further out are shown further out, all the way to a squared radius.
    fn grows_up_to(&self, square: f64) -> bool {
        let Self { k1, k2, k3, .. } = *self;
        // Derivative of the distorted radius, a cubic of the squared radius.
        let slope = |s: f64| 1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * 7.0 * k3));
        // It is least at the end or where its own derivative is 0: 3 k1 + 10 k2 s + 21 k3 s^2.
        let (a, b, c) = (21.0 * k3, 10.0 * k2, 3.0 * k1);
        let root = (b * b - 4.0 * a * c).max(0.0).sqrt();
        // The form without cancellation; a division by 0 gives no place between.
        let q = -0.5 * (b + root.copysign(b));
        let places = [square, q / a, c / q];
        places
            .iter()
            .filter(|place| (0.0..=square).contains(*place))
            .all(|place| slope(*place) > 0.0)
            && square.is_finite()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Of the size that calibrations of RGB-D cameras and wide lenses have.
    fn lens() -> impl Strategy<Value = Distortion> {
        (-0.3..0.3, -0.1..0.1, -0.01..0.01, -0.01..0.01, -0.03..0.03)
            .prop_map(|(k1, k2, p1, p2, k3)| Distortion { k1, k2, p1, p2, k3 })
    }

    proptest! {
        #[test]
        fn undoing_a_distortion_gives_the_ideal_point(
            lens in lens(), x in -0.8..0.8, y in -0.6..0.6,
        ) {
            let ideal = Vector2::new(x, y);
            // Where the image is not folded, with a margin for the tangential part.
            prop_assume!(lens.grows_up_to(2.0 * ideal.norm_squared()));
            let seen = lens.distort(&ideal).unwrap();
            let again = lens.undistort(&seen).unwrap();
            prop_assert!((again - ideal).amax() < 1e-9, "{again} {ideal}");
        }

        #[test]
        fn a_point_is_undone_rightly_or_not_at_all(
            lens in lens(), x in -3.0..3.0, y in -3.0..3.0,
        ) {
            let seen = Vector2::new(x, y);
            if let Some(ideal) = lens.undistort(&seen) {
                let again = lens.distort(&ideal).unwrap();
                prop_assert!((again - seen).amax() < 1e-9);
            }
        }
    }

    #[test]
    fn the_published_model_is_kept_to() {
        // By hand: r^2 = 0.05, radial 1 + 0.005 - 0.00025 + 0.00000625.
        let lens = Distortion {
            k1: 0.1,
            k2: -0.1,
            p1: 0.01,
            p2: -0.02,
            k3: 0.05,
        };
        let seen = lens.distort(&Vector2::new(0.2, 0.1)).unwrap();
        let radial = 1.004_756_25;
        let x = 0.2 * radial + 2.0 * 0.01 * 0.02 - 0.02 * (0.05 + 0.08);
        let y = 0.1 * radial + 0.01 * (0.05 + 0.02) - 2.0 * 0.02 * 0.02;
        assert!((seen - Vector2::new(x, y)).amax() < 1e-15, "{seen}");
    }

    #[test]
    fn beyond_the_fold_of_a_barrel_nothing_is_seen() {
        let barrel = Distortion {
            k1: -0.3,
            ..Distortion::NONE
        };
        // 1 - 0.9 r^2 = 0 at r = 1.054, where the distorted radius is greatest: 0.703.
        assert!(barrel.distort(&Vector2::new(1.05, 0.0)).is_some());
        assert_eq!(barrel.distort(&Vector2::new(1.06, 0.0)), None);
        assert!(barrel.undistort(&Vector2::new(0.70, 0.0)).is_some());
        assert_eq!(barrel.undistort(&Vector2::new(0.71, 0.0)), None);
        assert_eq!(barrel.undistort(&Vector2::new(f64::NAN, 0.0)), None);
    }
}
