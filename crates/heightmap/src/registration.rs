//! Depth images of another size or another camera, brought to the pixels of the colour image.

use crate::{Camera, Intrinsics};
use nalgebra::{Point2, Vector3};

/// A depth pixel covers at most this many pixels of the colour image along each side; more is no pair of cameras on one mast.
const MAX_FOOTPRINT_PX: i64 = 16;

/// Whether an image of this size shows the same as one of `camera`, in more or fewer pixels.
pub fn has_shape_of(camera: &Intrinsics, width: usize, height: usize) -> bool {
    let (a, b) = (width * camera.height, height * camera.width);
    width > 0 && height > 0 && a.abs_diff(b) <= camera.width.max(camera.height)
}

/// Scales a row-major depth image of `width` times `height` pixels to the size of `camera`: each pixel gets the nearest depth, nothing is
/// interpolated, since between two depths nothing is. `out_m` is overwritten.
pub fn scale_depth(
    depth_m: &[f32],
    (width, height): (usize, usize),
    camera: &Intrinsics,
    out_m: &mut Vec<f32>,
) {
    let nearest = |at: usize, from: usize, to: usize| (2 * at + 1) * from / (2 * to);
    out_m.clear();
    out_m.reserve(camera.len());
    for v in 0..camera.height {
        let row = &depth_m[nearest(v, height, camera.height) * width..][..width];
        out_m.extend((0..camera.width).map(|u| row[nearest(u, width, camera.width)]));
    }
}

/// Registers depth images of one camera to the colour images of another. The rays of the depth image are computed once for each calibration.
///
/// ```
/// use heightmap::{Camera, DepthRegistration};
/// use nalgebra::Isometry3;
///
/// let [color, ..] = Camera::ravens();
/// let mut depth = color.clone();
/// depth.world_from_camera *= Isometry3::translation(-0.05, 0.0, 0.0);
/// let mut registered_m = Vec::new();
/// DepthRegistration::default().register(&vec![0.9; 640 * 480], &depth, &color, &mut registered_m);
/// assert!((registered_m[240 * 640 + 320] - 0.9).abs() < 1e-6);
/// ```
#[derive(Debug, Default)]
pub struct DepthRegistration {
    of: Option<Intrinsics>,
    /// x and y, where z is 1, of the rays through the corners of the depth image's pixels, row by row, one more than pixels in each; not a
    /// number where the lens shows nothing.
    corners: Vec<[f64; 2]>,
}

impl DepthRegistration {
    /// Registers a row-major depth image of the camera `depth` to the image of the camera `color`, both posed in one frame: what `color`
    /// would have measured, in metres along its optical axis, 0 where it sees nothing of what `depth` has measured.
    ///
    /// Each depth pixel fills the pixels of the colour image that its own area covers there, and the nearest surface wins, as
    /// librealsense's `align` does. `out_m` is overwritten.
    pub fn register(
        &mut self,
        depth_m: &[f32],
        depth: &Camera,
        color: &Camera,
        out_m: &mut Vec<f32>,
    ) {
        self.calibrate(&depth.intrinsics);
        let (width, height) = (
            color.intrinsics.width as i64,
            color.intrinsics.height as i64,
        );
        out_m.clear();
        out_m.resize(color.intrinsics.len(), 0.0);
        let color_from_depth = color.world_from_camera.inv_mul(&depth.world_from_camera);
        let (turn, shift) = (
            color_from_depth.rotation.to_rotation_matrix(),
            color_from_depth.translation.vector,
        );
        let (columns, rows) = (depth.intrinsics.width, depth.intrinsics.height);
        for (index, &measured_m) in depth_m.iter().enumerate().take(columns * rows) {
            if !(measured_m > 0.0 && measured_m.is_finite()) {
                continue;
            }
            let (u, v) = (index % columns, index / columns);
            let corner = |u: usize, v: usize| {
                let [x, y] = self.corners[v * (columns + 1) + u];
                let point = turn * Vector3::new(x, y, 1.0) * f64::from(measured_m) + shift;
                // A ray that is none fails the comparison.
                let image = (point.z > 0.0).then(|| color.intrinsics.image(&point.into()))??;
                Some((image, point.z))
            };
            let (Some((first, first_m)), Some((last, last_m))) =
                (corner(u, v), corner(u + 1, v + 1))
            else {
                continue;
            };
            let span = |a: f64, b: f64, size: i64| {
                // The pixels whose centres lie between; at least the nearest one. Casts clamp.
                let (low, high) = (a.min(b), a.max(b));
                let from = (low.ceil() as i64).min(((low + high) / 2.0).round() as i64);
                let to = (high.ceil() as i64 - 1).max(from);
                (to - from < MAX_FOOTPRINT_PX && to >= 0 && from < size)
                    .then(|| from.max(0)..=to.min(size - 1))
            };
            let (Some(us), Some(vs)) =
                (span(first.x, last.x, width), span(first.y, last.y, height))
            else {
                continue;
            };
            let seen_m = (0.5 * (first_m + last_m)) as f32;
            for v in vs {
                for u in us.clone() {
                    let out = &mut out_m[(v * width + u) as usize];
                    if *out == 0.0 || seen_m < *out {
                        *out = seen_m;
                    }
                }
            }
        }
    }

    fn calibrate(&mut self, depth: &Intrinsics) {
        if self.of == Some(*depth) {
            return;
        }
        self.of = Some(*depth);
        self.corners.clear();
        for v in 0..=depth.height {
            self.corners.extend((0..=depth.width).map(|u| {
                let ray = depth.ray(&Point2::new(u as f64 - 0.5, v as f64 - 0.5));
                [ray.x, ray.y]
            }));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Distortion;
    use nalgebra::{Isometry3, Point3};

    const SMALL: Intrinsics = Intrinsics {
        width: 64,
        height: 48,
        fx_px: 60.0,
        fy_px: 60.0,
        cx_px: 31.5,
        cy_px: 23.5,
        distortion: Distortion::NONE,
    };

    fn camera(intrinsics: Intrinsics, pose: Isometry3<f64>) -> Camera {
        Camera {
            name: "test".into(),
            intrinsics,
            world_from_camera: pose,
        }
    }

    /// Depth of a plane 1 m ahead with a square of 0.2 m, 0.7 m ahead, in the frame of reference.
    fn see(camera: &Camera) -> Vec<f32> {
        let ray = |index: usize| {
            let at = Point2::new(
                (index % camera.intrinsics.width) as f64,
                (index / camera.intrinsics.width) as f64,
            );
            let eye = camera.back_project(&at, 0.0);
            let ahead = camera.back_project(&at, 1.0) - eye;
            let hit = |z: f64| (z - eye.z) / ahead.z;
            let near: Point3<f64> = eye + ahead * hit(0.7);
            let on_square = near.x.abs() < 0.1 && near.y.abs() < 0.1;
            hit(if on_square { 0.7 } else { 1.0 }) as f32
        };
        (0..camera.intrinsics.len()).map(ray).collect()
    }

    #[test]
    fn depth_of_half_the_size_is_spread_over_the_pixels_that_it_covers() {
        let half = Intrinsics {
            width: 4,
            height: 2,
            ..SMALL
        };
        let whole = Intrinsics {
            width: 8,
            height: 4,
            ..SMALL
        };
        let depth_m: Vec<f32> = (1..=8).map(|depth| depth as f32).collect();
        let mut out_m = vec![9.0];
        scale_depth(&depth_m, (4, 2), &whole, &mut out_m);
        assert_eq!(out_m[..8], [1.0, 1.0, 2.0, 2.0, 3.0, 3.0, 4.0, 4.0]);
        assert_eq!(out_m[..8], out_m[8..16]);
        assert_eq!(out_m[24..], [5.0, 5.0, 6.0, 6.0, 7.0, 7.0, 8.0, 8.0]);
        // And back, where every second pixel is taken.
        let large = out_m.clone();
        scale_depth(&large, (8, 4), &half, &mut out_m);
        assert_eq!(out_m, depth_m);
        assert!(has_shape_of(&whole, 4, 2) && has_shape_of(&half, 8, 4));
        assert!(!has_shape_of(&Intrinsics::RAVENS, 848, 480));
        assert!(!has_shape_of(&Intrinsics::RAVENS, 0, 0));
    }

    #[test]
    fn one_registration_serves_cameras_behind_any_lens_in_turn() {
        let lenses = [
            Distortion::NONE,
            Distortion::plumb_bob([0.1, -0.05, 0.001, -0.002, 0.0]),
            Distortion::rational([0.5, -0.2, 0.001, 0.0, 0.1, 0.4, -0.1, 0.05]),
            Distortion::equidistant([-0.01, 0.03, 0.0, 0.0]),
        ];
        let beside = Isometry3::translation(-0.02, 0.0, 0.0);
        let mut registration = DepthRegistration::default();
        for depth_lens in lenses {
            for color_lens in lenses {
                let behind = |distortion, pose| {
                    camera(
                        Intrinsics {
                            distortion,
                            ..SMALL
                        },
                        pose,
                    )
                };
                let depth = behind(depth_lens, beside);
                let color = behind(color_lens, Isometry3::identity());
                let (mut out_m, mut alone_m) = (Vec::new(), Vec::new());
                let measured_m = see(&depth);
                registration.register(&measured_m, &depth, &color, &mut out_m);
                DepthRegistration::default().register(&measured_m, &depth, &color, &mut alone_m);
                assert_eq!(out_m, alone_m);
                let expected = see(&color);
                let inside = (0..out_m.len()).filter(|index| {
                    let (u, v) = (index % 64, index / 64);
                    (8..56).contains(&u) && (6..42).contains(&v)
                });
                let good = inside
                    .clone()
                    .filter(|index| (out_m[*index] - expected[*index]).abs() < 2e-3);
                let share = good.count() as f64 / inside.count() as f64;
                assert!(share > 0.9, "{depth_lens:?} {color_lens:?}: {share}");
            }
        }
    }

    #[test]
    fn registered_depth_is_what_the_color_camera_would_have_measured() {
        // The imagers of a stereo depth camera are some centimetres beside the colour camera, and turned by a little.
        let color = camera(SMALL, Isometry3::identity());
        let beside = Isometry3::new(
            Vector3::new(-0.05, 0.01, 0.002),
            Vector3::new(0.0, 0.02, 0.01),
        );
        for intrinsics in [
            SMALL,
            Intrinsics {
                width: 128,
                height: 96,
                fx_px: 90.0,
                fy_px: 90.0,
                cx_px: 63.5,
                cy_px: 47.5,
                ..SMALL
            },
        ] {
            let depth = camera(intrinsics, beside);
            let mut out_m = Vec::new();
            DepthRegistration::default().register(&see(&depth), &depth, &color, &mut out_m);
            let expected = see(&color);
            let inside = |index: &usize| {
                let (u, v) = (index % 64, index / 64);
                (8..56).contains(&u) && (6..42).contains(&v)
            };
            let seen: Vec<usize> = (0..out_m.len()).filter(inside).collect();
            let good = seen
                .iter()
                .filter(|index| (out_m[**index] - expected[**index]).abs() < 2e-3);
            // All but the edges of the square and the strip beside it that only one of them sees.
            let share = good.count() as f64 / seen.len() as f64;
            assert!(share > 0.9, "{share}");
            // On the square nothing shines through from behind.
            let middle = out_m[24 * 64 + 32];
            assert!((middle - 0.7).abs() < 2e-3, "{middle}");
        }
    }

    #[test]
    fn the_same_camera_keeps_its_depth_and_holes_stay_holes() {
        let one = camera(SMALL, Isometry3::translation(0.3, 0.1, 0.0));
        let mut depth_m = vec![0.8; SMALL.len()];
        for (index, hole) in [0.0, f32::NAN, -1.0, f32::INFINITY].into_iter().enumerate() {
            depth_m[200 + index] = hole;
        }
        let mut out_m = Vec::new();
        DepthRegistration::default().register(&depth_m, &one, &one, &mut out_m);
        for (index, &out) in out_m.iter().enumerate() {
            let expected = if (200..204).contains(&index) {
                0.0
            } else {
                0.8
            };
            assert!((out - expected).abs() < 1e-6, "{index}: {out}");
        }
    }

    #[test]
    fn cameras_that_look_away_from_each_other_share_nothing() {
        let color = camera(SMALL, Isometry3::identity());
        let depth = camera(
            SMALL,
            Isometry3::rotation(Vector3::y() * std::f64::consts::PI),
        );
        let mut out_m = Vec::new();
        DepthRegistration::default().register(&see(&color), &depth, &color, &mut out_m);
        assert!(out_m.iter().all(|depth| *depth == 0.0));
    }
}
