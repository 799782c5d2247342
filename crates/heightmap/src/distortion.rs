//! Lens distortion.

use nalgebra::{Matrix2, Vector2};
use serde::{Deserialize, Serialize};

/// What a lens does to the image: one of the models of `sensor_msgs/CameraInfo`, `plumb_bob`, `rational_polynomial` or `equidistant`
/// (a fisheye), as OpenCV has them. Coefficients are of normalised image points (x / z, y / z).
///
/// ```
/// # use heightmap::Distortion;
/// # use nalgebra::Vector2;
/// let fisheye = Distortion::from_model("equidistant", &[0.1, -0.02, 0.0, 0.0]).unwrap();
/// let seen = fisheye.distort(&Vector2::new(1.5, 0.0)).unwrap();
/// assert!((fisheye.undistort(&seen).unwrap().x - 1.5).abs() < 1e-9);
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Description", into = "Description")]
pub struct Distortion {
    radial: Radial,
    /// Tangential, vertical.
    p1: f64,
    /// Tangential, horizontal.
    p2: f64,
    /// Square of the radius of ideal points up to which what is further out is shown further out. No lens folds the image back over
    /// itself: what the model says beyond is not seen.
    fold: f64,
}

impl Default for Distortion {
    fn default() -> Self {
        Self::NONE
    }
}

/// How the distance from the axis changes.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Radial {
    /// By the factor (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3) of the squared radius s.
    Rational([f64; 6]),
    /// The angle t from the axis becomes the radius t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8).
    Equidistant([f64; 4]),
}

/// Why a lens model cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{field} is {actual}, expected {expected}")]
pub struct LensError {
    /// As `CameraInfo` calls it: `distortion_model` or `d`.
    pub field: &'static str,
    /// What it is.
    pub actual: String,
    /// What it may be.
    pub expected: &'static str,
}

/// Lens models that project like a pinhole where all coefficients are 0; librealsense's names besides ROS's own.
const PINHOLE_MODELS: [&str; 7] = [
    "",
    "none",
    "rational_polynomial",
    "thin_prism",
    "brown_conrady",
    "inverse_brown_conrady",
    "modified_brown_conrady",
];

/// Newton's method gains so many digits with each step that it needs five or six.
const MAX_STEPS: usize = 50;
/// Far below a pixel, far above rounding.
const TOLERANCE: f64 = 1e-12;
/// Square of the radius of ideal points behind which no lens of these models is asked for anything: 89.4 degrees from the axis.
const WIDEST: f64 = 1e4;

impl Distortion {
    /// A pinhole.
    pub const NONE: Self = Self {
        radial: Radial::Rational([0.0; 6]),
        p1: 0.0,
        p2: 0.0,
        fold: f64::INFINITY,
    };

    /// Radial and tangential distortion after Brown and Conrady: ROS calls it `plumb_bob`.
    pub fn plumb_bob([k1, k2, p1, p2, k3]: [f64; 5]) -> Self {
        Self::rational([k1, k2, p1, p2, k3, 0.0, 0.0, 0.0])
    }

    /// The same with a polynomial in the denominator: `rational_polynomial`.
    pub fn rational([k1, k2, p1, p2, k3, k4, k5, k6]: [f64; 8]) -> Self {
        Self::new(Radial::Rational([k1, k2, k3, k4, k5, k6]), p1, p2)
    }

    /// A fisheye after Kannala and Brandt: `equidistant`.
    pub fn equidistant(k: [f64; 4]) -> Self {
        Self::new(Radial::Equidistant(k), 0.0, 0.0)
    }

    fn new(radial: Radial, p1: f64, p2: f64) -> Self {
        let mut lens = Self {
            radial,
            p1,
            p2,
            fold: f64::INFINITY,
        };
        if lens != Self::NONE {
            // A lens of numbers that are none shows nothing.
            lens.fold = match lens.is_finite() {
                true => radial.fold(),
                false => 0.0,
            };
        }
        lens
    }

    /// The lens of a calibration: the name of its model, in ROS, OpenCV or librealsense, and the coefficients in the order of `CameraInfo.d`.
    ///
    /// # Errors
    /// An unknown model, or coefficients that it does not have.
    pub fn from_model(model: &str, d: &[f64]) -> Result<Self, LensError> {
        // librealsense writes "Inverse Brown Conrady".
        let name = model.to_lowercase().replace([' ', '-'], "_");
        let without = d.iter().all(|coefficient| *coefficient == 0.0);
        if without && PINHOLE_MODELS.contains(&name.as_str()) {
            return Ok(Self::NONE);
        }
        let wrong = |expected| LensError {
            field: "d",
            actual: format!("{d:?}"),
            expected,
        };
        match name.as_str() {
            "plumb_bob" | "brown_conrady" => match *d {
                [] => Ok(Self::NONE),
                [k1, k2, p1, p2] => Ok(Self::plumb_bob([k1, k2, p1, p2, 0.0])),
                [k1, k2, p1, p2, k3] => Ok(Self::plumb_bob([k1, k2, p1, p2, k3])),
                _ => Err(wrong("k1, k2, p1, p2 and k3 of plumb_bob")),
            },
            "rational_polynomial" => match d {
                // Some drivers append the coefficients of thin prisms and of a tilted sensor.
                &[k1, k2, p1, p2, k3, k4, k5, k6, ref rest @ ..]
                    if rest.iter().all(|coefficient| *coefficient == 0.0) =>
                {
                    Ok(Self::rational([k1, k2, p1, p2, k3, k4, k5, k6]))
                }
                _ => Err(wrong(
                    "k1, k2, p1, p2, k3, k4, k5 and k6 of rational_polynomial, and zeros behind them",
                )),
            },
            "equidistant" | "fisheye" | "kannala_brandt4" => match *d {
                [k1, k2, k3, k4] => Ok(Self::equidistant([k1, k2, k3, k4])),
                _ => Err(wrong("k1, k2, k3 and k4 of equidistant")),
            },
            _ => Err(LensError {
                field: "distortion_model",
                actual: format!("{model:?} with d {d:?}"),
                expected: "\"plumb_bob\", \"rational_polynomial\", \"equidistant\", or a pinhole model with d of zeros",
            }),
        }
    }

    /// Name of the model in ROS.
    pub fn model(&self) -> &'static str {
        match self.radial {
            Radial::Rational([_, _, _, k4, k5, k6]) if [k4, k5, k6] == [0.0; 3] => "plumb_bob",
            Radial::Rational(_) => "rational_polynomial",
            Radial::Equidistant(_) => "equidistant",
        }
    }

    /// Coefficients in the order of `CameraInfo.d`: 5 of `plumb_bob`, 8 of `rational_polynomial`, 4 of `equidistant`.
    pub fn coefficients(&self) -> Vec<f64> {
        let Self { p1, p2, .. } = *self;
        match self.radial {
            Radial::Rational([k1, k2, k3, k4, k5, k6]) => {
                let mut d = vec![k1, k2, p1, p2, k3, k4, k5, k6];
                if self.model() == "plumb_bob" {
                    d.truncate(5);
                }
                d
            }
            Radial::Equidistant(k) => k.into(),
        }
    }

    /// Whether the lens is a pinhole.
    pub fn is_none(&self) -> bool {
        *self == Self::NONE
    }

    /// Whether every coefficient is a number.
    pub(crate) fn is_finite(&self) -> bool {
        self.coefficients().iter().all(|part| part.is_finite())
    }

    /// Where the lens shows an ideal point. None where the model folds the image back over itself: no
    /// lens does that, and what is out there is not seen.
    pub fn distort(&self, ideal: &Vector2<f64>) -> Option<Vector2<f64>> {
        (ideal.norm_squared() < self.fold).then(|| self.shift(ideal))
    }

    /// The ideal point that the lens shows there. None if there is no such point.
    pub fn undistort(&self, seen: &Vector2<f64>) -> Option<Vector2<f64>> {
        if self.is_none() {
            return Some(*seen);
        }
        self.refine(seen, *seen)
            .or_else(|| self.refine(seen, self.near(seen)?))
    }

    /// Newton's method from a point on.
    fn refine(&self, seen: &Vector2<f64>, from: Vector2<f64>) -> Option<Vector2<f64>> {
        let mut ideal = from;
        for _ in 0..MAX_STEPS {
            let rest = seen - self.shift(&ideal);
            if rest.amax() <= TOLERANCE * (1.0 + seen.amax()) {
                let good =
                    self.slope(&ideal).determinant() > 0.0 && ideal.norm_squared() < self.fold;
                return good.then_some(ideal);
            }
            ideal += self.slope(&ideal).try_inverse()? * rest;
        }
        None
    }

    /// The ideal point but for the tangential part: the shown radius grows with the ideal one up to the fold, so that halving finds it.
    fn near(&self, seen: &Vector2<f64>) -> Option<Vector2<f64>> {
        let shown = seen.norm();
        let excess = |radius: f64| radius * self.radial.factor(radius * radius).0 - shown;
        let radius = crossing(excess, 0.0, self.fold.min(WIDEST).sqrt())?;
        Some(seen * (radius / shown))
    }

    fn shift(&self, ideal: &Vector2<f64>) -> Vector2<f64> {
        let Self { p1, p2, .. } = *self;
        let (x, y, square) = (ideal.x, ideal.y, ideal.norm_squared());
        let (factor, _) = self.radial.factor(square);
        Vector2::new(
            x * factor + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x),
            y * factor + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y,
        )
    }

    /// Derivative of [`Self::shift`].
    fn slope(&self, ideal: &Vector2<f64>) -> Matrix2<f64> {
        let Self { p1, p2, .. } = *self;
        let (x, y) = (ideal.x, ideal.y);
        let (factor, growth) = self.radial.factor(ideal.norm_squared());
        let mixed = 2.0 * (x * y * growth + p1 * x + p2 * y);
        Matrix2::new(
            factor + 2.0 * x * x * growth + 2.0 * p1 * y + 6.0 * p2 * x,
            mixed,
            mixed,
            factor + 2.0 * y * y * growth + 6.0 * p1 * y + 2.0 * p2 * x,
        )
    }
}

impl Radial {
    /// By what the squared radius's point is scaled, and the derivative by the squared radius.
    fn factor(&self, square: f64) -> (f64, f64) {
        match *self {
            Self::Rational([k1, k2, k3, k4, k5, k6]) => {
                let above = 1.0 + square * (k1 + square * (k2 + square * k3));
                let growth = k1 + square * (2.0 * k2 + square * 3.0 * k3);
                if [k4, k5, k6] == [0.0; 3] {
                    return (above, growth);
                }
                let below = 1.0 + square * (k4 + square * (k5 + square * k6));
                let below_growth = k4 + square * (2.0 * k5 + square * 3.0 * k6);
                let factor = above / below;
                (factor, (growth - factor * below_growth) / below)
            }
            Self::Equidistant([k1, k2, k3, k4]) => {
                // On the axis the quotients below are 0 / 0.
                if square < 1e-12 {
                    return (1.0 + square * (k1 - 1.0 / 3.0), k1 - 1.0 / 3.0);
                }
                let radius = square.sqrt();
                let angle = radius.atan();
                let a = angle * angle;
                let shown = angle * (1.0 + a * (k1 + a * (k2 + a * (k3 + a * k4))));
                let slope = 1.0 + a * (3.0 * k1 + a * (5.0 * k2 + a * (7.0 * k3 + a * 9.0 * k4)));
                let factor = shown / radius;
                (factor, (slope / (1.0 + square) - factor) / (2.0 * square))
            }
        }
    }

    /// Square of the radius where the shown radius stops to grow, at most [`WIDEST`].
    fn fold(&self) -> f64 {
        match *self {
            Self::Rational([k1, k2, k3, k4, k5, k6]) => {
                let (above, below) = ([1.0, k1, k2, k3], [1.0, k4, k5, k6]);
                // Of r a(s) / b(s) with s = r^2 the derivative by r, times b^2: a b + 2 s (a' b - a b').
                let mut slope = [0.0; 7];
                for (i, a) in above.iter().enumerate() {
                    for (j, b) in below.iter().enumerate() {
                        slope[i + j] += a * b * (1.0 + 2.0 * (i as f64 - j as f64));
                    }
                }
                let first = |polynomial: &[f64]| roots(polynomial, WIDEST).first().copied();
                let fold = first(&slope).unwrap_or(WIDEST);
                // The factor has no value where the denominator is 0: just before it, it has.
                first(&below).map_or(fold, |pole| fold.min(pole * (1.0 - 1e-9)))
            }
            Self::Equidistant([k1, k2, k3, k4]) => {
                let slope = [1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3, 9.0 * k4];
                let widest = WIDEST.sqrt().atan().powi(2);
                let angle_square = roots(&slope, widest).first().copied().unwrap_or(widest);
                angle_square.sqrt().tan().powi(2)
            }
        }
    }
}

/// Roots of a polynomial (its constant first) between 0 and `end`, ascending: between two roots of its derivative there is one at most.
fn roots(polynomial: &[f64], end: f64) -> Vec<f64> {
    if polynomial.len() < 2 {
        return Vec::new();
    }
    let powers = polynomial.iter().enumerate().skip(1);
    let slope: Vec<f64> = powers.map(|(power, k)| power as f64 * k).collect();
    let value = |x: f64| polynomial.iter().rev().fold(0.0, |sum, k| sum * x + k);
    let mut ends = vec![0.0];
    ends.extend(roots(&slope, end));
    ends.push(end);
    let between = ends.windows(2);
    between
        .filter_map(|pair| crossing(value, pair[0], pair[1]))
        .collect()
}

/// Where a function changes its sign, by halving; none where it has the same at both ends.
fn crossing(value: impl Fn(f64) -> f64, mut low: f64, mut high: f64) -> Option<f64> {
    let positive = value(low) > 0.0;
    if (value(high) > 0.0) == positive {
        return None;
    }
    loop {
        let middle = 0.5 * (low + high);
        if middle <= low || middle >= high {
            return Some(low);
        }
        match (value(middle) > 0.0) == positive {
            true => low = middle,
            false => high = middle,
        }
    }
}

/// A lens in a file. Without `model` it is `plumb_bob`, or `rational_polynomial` where k4, k5 or k6 is given.
#[derive(Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Description {
    #[serde(skip_serializing_if = "Option::is_none")]
    model: Option<String>,
    k1: f64,
    k2: f64,
    p1: f64,
    p2: f64,
    k3: f64,
    k4: f64,
    k5: f64,
    k6: f64,
}

impl TryFrom<Description> for Distortion {
    type Error = LensError;

    fn try_from(file: Description) -> Result<Self, LensError> {
        let Description {
            model,
            k1,
            k2,
            p1,
            p2,
            k3,
            k4,
            k5,
            k6,
        } = file;
        match model.as_deref() {
            None => Ok(Self::rational([k1, k2, p1, p2, k3, k4, k5, k6])),
            Some("equidistant") if [p1, p2, k5, k6] == [0.0; 4] => {
                Ok(Self::equidistant([k1, k2, k3, k4]))
            }
            Some("equidistant") => Err(LensError {
                field: "distortion",
                actual: format!("p1 {p1}, p2 {p2}, k5 {k5}, k6 {k6}"),
                expected: "k1, k2, k3 and k4 of equidistant",
            }),
            Some("plumb_bob") if [k4, k5, k6] != [0.0; 3] => Err(LensError {
                field: "distortion",
                actual: format!("k4 {k4}, k5 {k5}, k6 {k6}"),
                expected: "k1, k2, p1, p2 and k3 of plumb_bob",
            }),
            Some("plumb_bob" | "rational_polynomial") => {
                Ok(Self::rational([k1, k2, p1, p2, k3, k4, k5, k6]))
            }
            Some(other) => Err(LensError {
                field: "distortion.model",
                actual: format!("{other:?}"),
                expected: "plumb_bob, rational_polynomial or equidistant",
            }),
        }
    }
}

impl From<Distortion> for Description {
    fn from(lens: Distortion) -> Self {
        let Distortion { p1, p2, .. } = lens;
        match lens.radial {
            Radial::Rational([k1, k2, k3, k4, k5, k6]) => Self {
                model: None,
                k1,
                k2,
                p1,
                p2,
                k3,
                k4,
                k5,
                k6,
            },
            Radial::Equidistant([k1, k2, k3, k4]) => Self {
                model: Some("equidistant".to_owned()),
                k1,
                k2,
                k3,
                k4,
                ..Self::default()
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Of the size that calibrations of RGB-D cameras and wide lenses have.
    fn lens() -> impl Strategy<Value = Distortion> {
        let brown = (-0.3..0.3, -0.1..0.1, -0.01..0.01, -0.01..0.01, -0.03..0.03)
            .prop_map(|(k1, k2, p1, p2, k3)| [k1, k2, p1, p2, k3]);
        let below = (-0.3..0.3, -0.1..0.1, -0.03..0.03);
        let rational = (brown.clone(), below).prop_map(|([k1, k2, p1, p2, k3], (k4, k5, k6))| {
            Distortion::rational([k1, k2, p1, p2, k3, k4, k5, k6])
        });
        let fisheye = prop::array::uniform4(-0.05..0.05).prop_map(Distortion::equidistant);
        prop_oneof![brown.prop_map(Distortion::plumb_bob), rational, fisheye]
    }

    proptest! {
        #[test]
        fn undoing_a_distortion_gives_the_ideal_point(
            lens in lens(), x in -0.8..0.8, y in -0.6..0.6,
        ) {
            let ideal = Vector2::new(x, y);
            // Where the image is not folded, with a margin for the tangential part.
            prop_assume!(2.0 * ideal.norm_squared() < lens.fold);
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

        #[test]
        fn up_to_the_fold_what_is_further_out_is_shown_further_out(
            lens in lens(), share in 0.0f64..0.999, further in 1.0001f64..1.5,
        ) {
            let end = lens.fold.min(WIDEST).sqrt();
            let shown = |radius: f64| radius * lens.radial.factor(radius * radius).0;
            let radius = share * end;
            prop_assert!(shown((radius * further).min(end)) >= shown(radius) - 1e-12);
            // And not a bit further.
            if lens.fold < WIDEST {
                prop_assert!(shown(end * 1.001) < shown(end) + 1e-9 || shown(end * 1.001).is_sign_negative());
            }
        }

        #[test]
        fn a_lens_in_a_file_is_read_back(lens in lens()) {
            let text = serde_yaml_ng::to_string(&lens).unwrap();
            prop_assert_eq!(serde_yaml_ng::from_str::<Distortion>(&text).unwrap(), lens);
            prop_assert_eq!(Distortion::from_model(lens.model(), &lens.coefficients()).unwrap(), lens);
        }
    }

    #[test]
    fn the_published_model_is_kept_to() {
        // By hand: r^2 = 0.05, radial 1 + 0.005 - 0.00025 + 0.00000625.
        let k = [0.1, -0.1, 0.01, -0.02, 0.05];
        let seen = Distortion::plumb_bob(k).distort(&Vector2::new(0.2, 0.1));
        let radial = 1.004_756_25;
        let tangential = Vector2::new(
            2.0 * 0.01 * 0.02 - 0.02 * (0.05 + 0.08),
            0.01 * (0.05 + 0.02) - 2.0 * 0.02 * 0.02,
        );
        let expected = Vector2::new(0.2, 0.1) * radial + tangential;
        assert!((seen.unwrap() - expected).amax() < 1e-15);
        // Divided by 1 + 0.015 - 0.0005 + 0.00000125.
        let [k1, k2, p1, p2, k3] = k;
        let lens = Distortion::rational([k1, k2, p1, p2, k3, 0.3, -0.2, 0.01]);
        let seen = lens.distort(&Vector2::new(0.2, 0.1)).unwrap();
        let expected = Vector2::new(0.2, 0.1) * radial / 1.014_501_25 + tangential;
        assert!((seen - expected).amax() < 1e-15, "{seen}");
        // 45 degrees from the axis, t = pi / 4.
        let t = std::f64::consts::FRAC_PI_4;
        let lens = Distortion::equidistant([0.1, -0.05, 0.02, -0.01]);
        let seen = lens.distort(&Vector2::new(0.6, 0.8)).unwrap();
        let shown =
            t * (1.0 + 0.1 * t.powi(2) - 0.05 * t.powi(4) + 0.02 * t.powi(6) - 0.01 * t.powi(8));
        assert!(
            (seen - shown * Vector2::new(0.6, 0.8)).amax() < 1e-15,
            "{seen}"
        );
    }

    #[test]
    fn beyond_the_fold_of_a_barrel_nothing_is_seen() {
        let barrel = Distortion::plumb_bob([-0.3, 0.0, 0.0, 0.0, 0.0]);
        // 1 - 0.9 r^2 = 0 at r = 1.054, where the distorted radius is greatest: 0.703.
        assert!(barrel.distort(&Vector2::new(1.05, 0.0)).is_some());
        assert_eq!(barrel.distort(&Vector2::new(1.06, 0.0)), None);
        assert!(barrel.undistort(&Vector2::new(0.70, 0.0)).is_some());
        assert_eq!(barrel.undistort(&Vector2::new(0.71, 0.0)), None);
        assert_eq!(barrel.undistort(&Vector2::new(f64::NAN, 0.0)), None);
    }

    #[test]
    fn a_denominator_of_zero_and_numbers_that_are_none_show_nothing() {
        // 1 - 0.5 r^2 = 0 at r = 1.414.
        let lens = Distortion::rational([0.0, 0.0, 0.0, 0.0, 0.0, -0.5, 0.0, 0.0]);
        assert!(lens.distort(&Vector2::new(1.41, 0.0)).is_some());
        assert_eq!(lens.distort(&Vector2::new(1.42, 0.0)), None);
        for lens in [
            Distortion::plumb_bob([0.1, f64::NAN, 0.0, 0.0, 0.0]),
            Distortion::rational([0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, f64::NAN]),
            Distortion::equidistant([0.0, 0.0, f64::NAN, 0.0]),
        ] {
            assert!(!lens.is_finite() && !lens.is_none());
            assert_eq!(lens.distort(&Vector2::new(0.1, 0.0)), None);
            assert_eq!(lens.undistort(&Vector2::new(0.1, 0.0)), None);
        }
    }

    #[test]
    fn names_of_other_libraries_are_known_and_other_models_refused_by_name() {
        let fisheye = [0.1, -0.02, 0.003, 0.0];
        for name in ["equidistant", "fisheye", "Kannala Brandt4"] {
            let lens = Distortion::from_model(name, &fisheye).unwrap();
            assert_eq!(lens, Distortion::equidistant(fisheye));
            // A fisheye is no pinhole where its coefficients are 0.
            assert!(!Distortion::from_model(name, &[0.0; 4]).unwrap().is_none());
        }
        let k = [0.4, -2.6, 0.0005, -0.0001, 1.4, 0.3, -2.4, 1.3];
        let longer: Vec<f64> = k.iter().copied().chain([0.0; 6]).collect();
        let lens = Distortion::from_model("rational_polynomial", &longer).unwrap();
        assert_eq!(lens, Distortion::rational(k));
        let refusal = |name, d: &[f64]| Distortion::from_model(name, d).unwrap_err().to_string();
        let error = refusal("rational_polynomial", &k[..5]);
        assert!(error.starts_with("d is") && error.contains("k6"), "{error}");
        let mut prism = longer.clone();
        prism[9] = 1e-3;
        assert!(refusal("rational_polynomial", &prism).starts_with("d is"));
        assert!(refusal("equidistant", &k).contains("k4 of equidistant"));
        for name in ["ftheta", "inverse_brown_conrady", "thin_prism", ""] {
            let error = refusal(name, &k);
            assert!(
                error.starts_with(&format!("distortion_model is {name:?}")),
                "{error}"
            );
        }
    }

    #[test]
    fn a_file_without_a_model_is_read_as_before_and_bad_ones_are_refused_by_field() {
        let read = |text: &str| serde_yaml_ng::from_str::<Distortion>(text);
        let brown = read(r#"{"k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4, "k3": 0.5}"#).unwrap();
        assert_eq!(brown, Distortion::plumb_bob([0.1, 0.2, 0.3, 0.4, 0.5]));
        for (text, part) in [
            (r#"{"model": "equidistant", "p1": 0.1}"#, "p1 0.1"),
            (r#"{"model": "plumb_bob", "k4": 0.1}"#, "k4 0.1"),
            (r#"{"model": "omni"}"#, "distortion.model is \"omni\""),
            (r#"{"k7": 0.1}"#, "k7"),
        ] {
            let error = read(text).unwrap_err().to_string();
            assert!(error.contains(part), "{error}");
        }
    }
}
