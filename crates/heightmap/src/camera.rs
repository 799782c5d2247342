//! Camera model: a pinhole, behind a lens.

use crate::Distortion;
use nalgebra::{Isometry3, Point2, Point3, Translation3, UnitQuaternion, Vector2, Vector3};
use serde::{Deserialize, Serialize};

/// Pinhole intrinsics and lens distortion. Image point (u, v) runs right and down; pixel centres have
/// whole coordinates, as in ROS.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Intrinsics {
    /// Image width.
    pub width: usize,
    /// Image height.
    pub height: usize,
    /// Focal length along x.
    pub fx_px: f64,
    /// Focal length along y.
    pub fy_px: f64,
    /// Principal point, x.
    pub cx_px: f64,
    /// Principal point, y.
    pub cy_px: f64,
    /// What the lens does to the image.
    #[serde(default)]
    pub distortion: Distortion,
}

impl Intrinsics {
    /// The cameras of Ravens.
    pub const RAVENS: Self = Self {
        width: 640,
        height: 480,
        fx_px: 450.0,
        fy_px: 450.0,
        cx_px: 320.0,
        cy_px: 240.0,
        distortion: Distortion::NONE,
    };

    /// Number of pixels.
    #[allow(
        clippy::len_without_is_empty,
        reason = "an image without pixels is none"
    )]
    pub const fn len(&self) -> usize {
        self.width * self.height
    }

    /// The ray through an image point, in the optical frame: 1 long along the optical axis. Not a number
    /// where the lens shows nothing.
    pub fn ray(&self, image: &Point2<f64>) -> Vector3<f64> {
        let seen = Vector2::new(
            (image.x - self.cx_px) / self.fx_px,
            (image.y - self.cy_px) / self.fy_px,
        );
        let nothing = Vector2::repeat(f64::NAN);
        self.distortion
            .undistort(&seen)
            .unwrap_or(nothing)
            .push(1.0)
    }

    /// Where a point of the optical frame, which is before the camera, is shown. None where the lens does not show it.
    pub fn image(&self, point: &Point3<f64>) -> Option<Point2<f64>> {
        let Self {
            fx_px,
            fy_px,
            cx_px,
            cy_px,
            distortion,
            ..
        } = *self;
        if distortion.is_none() {
            return Some(Point2::new(
                fx_px * point.x / point.z + cx_px,
                fy_px * point.y / point.z + cy_px,
            ));
        }
        let seen = distortion.distort(&(point.xy().coords / point.z))?;
        Some(Point2::new(fx_px * seen.x + cx_px, fy_px * seen.y + cy_px))
    }
}

/// A calibrated camera.
#[derive(Clone, Debug, PartialEq)]
pub struct Camera {
    /// Name of the camera, as in topics and frames.
    pub name: String,
    /// Intrinsics.
    pub intrinsics: Intrinsics,
    /// Pose of the optical frame (x right, y down, z forward) in the world.
    pub world_from_camera: Isometry3<f64>,
}

/// A camera that cannot take pictures.
#[derive(Debug, thiserror::Error, PartialEq)]
#[allow(missing_docs, reason = "each message names its fields")]
pub enum CameraError {
    /// An intrinsic parameter makes no sense.
    #[error("camera {camera}: {what} is {actual}, expected {expected}")]
    Intrinsics {
        camera: String,
        what: &'static str,
        actual: f64,
        expected: &'static str,
    },
    /// The distortion leaves a part of the image without rays.
    #[error(
        "camera {camera}: the distortion {model} {coefficients:?} cannot be undone at pixel ({u_px}, {v_px}): \
         expected one that shows what is further out further out, less than 90 degrees from the axis"
    )]
    Distortion {
        camera: String,
        model: &'static str,
        coefficients: Vec<f64>,
        u_px: f64,
        v_px: f64,
    },
    /// The pose has a part that is not finite.
    #[error("camera {camera}: the pose in the world is not finite")]
    Pose { camera: String },
}

impl Camera {
    /// Front, left and right camera of Ravens (Zeng et al., CoRL 2020), in the frame of the robot base.
    pub fn ravens() -> [Self; 3] {
        use std::f64::consts::PI;
        let camera = |name: &str, position: [f64; 3], [roll, pitch, yaw]: [f64; 3]| Self {
            name: name.into(),
            intrinsics: Intrinsics::RAVENS,
            world_from_camera: Isometry3::from_parts(
                Translation3::from(position),
                UnitQuaternion::from_euler_angles(roll, pitch, yaw),
            ),
        };
        [
            camera("front", [1.0, 0.0, 0.75], [PI / 4.0, PI, -PI / 2.0]),
            camera("left", [0.0, 0.5, 0.75], [PI / 4.5, PI, PI / 4.0]),
            camera("right", [0.0, -0.5, 0.75], [PI / 4.5, PI, 3.0 * PI / 4.0]),
        ]
    }

    /// Checks that sizes, focal lengths, principal point and pose make sense.
    pub fn check(&self) -> Result<(), CameraError> {
        let Intrinsics {
            width,
            height,
            fx_px,
            fy_px,
            cx_px,
            cy_px,
            distortion,
        } = self.intrinsics;
        // 1 to 2^16: any real camera, and products that cannot overflow.
        let size = |size: usize| (1..=1 << 16).contains(&size);
        let focal = |length: f64| length.is_finite() && length > 0.0;
        let checks = [
            ("the width", width as f64, size(width), "1 to 65536"),
            ("the height", height as f64, size(height), "1 to 65536"),
            ("fx", fx_px, focal(fx_px), "a positive number"),
            ("fy", fy_px, focal(fy_px), "a positive number"),
            ("cx", cx_px, cx_px.is_finite(), "a finite number"),
            ("cy", cy_px, cy_px.is_finite(), "a finite number"),
        ];
        for (what, actual, good, expected) in checks {
            if !good {
                return Err(CameraError::Intrinsics {
                    camera: self.name.clone(),
                    what,
                    actual,
                    expected,
                });
            }
        }
        if !distortion.is_none() {
            let (right, bottom) = ((width - 1) as f64, (height - 1) as f64);
            for (u_px, v_px) in [0.0, 0.5, 1.0]
                .into_iter()
                .flat_map(|u| [0.0, 0.5, 1.0].map(|v| (u * right, v * bottom)))
            {
                let ray = self.intrinsics.ray(&Point2::new(u_px, v_px));
                if !(distortion.is_finite() && ray.iter().all(|part| part.is_finite())) {
                    return Err(CameraError::Distortion {
                        camera: self.name.clone(),
                        model: distortion.model(),
                        coefficients: distortion.coefficients(),
                        u_px,
                        v_px,
                    });
                }
            }
        }
        let pose = &self.world_from_camera;
        let translation = pose.translation.vector.iter();
        let mut parts = translation.chain(pose.rotation.coords.iter());
        if !parts.all(|part| part.is_finite()) {
            return Err(CameraError::Pose {
                camera: self.name.clone(),
            });
        }
        Ok(())
    }

    /// The world point at an image point and a depth along the optical axis.
    pub fn back_project(&self, image: &Point2<f64>, depth_m: f64) -> Point3<f64> {
        self.world_from_camera * Point3::from(self.intrinsics.ray(image) * depth_m)
    }

    /// Image point and depth of a world point, if it is before the camera and the lens shows it.
    pub fn project(&self, point: &Point3<f64>) -> Option<(Point2<f64>, f64)> {
        let point = self.world_from_camera.inverse_transform_point(point);
        if point.z <= 0.0 {
            return None;
        }
        Some((self.intrinsics.image(&point)?, point.z))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_optical_axes_of_ravens_meet_the_table_where_published() {
        let hits = [(0.25, 0.0), (0.445, 0.055), (0.445, -0.055)];
        let quaternions = [
            [0.65328, 0.65328, -0.2706, -0.2706],
            [-0.3596, 0.86816, -0.31599, 0.13089],
            [-0.86816, 0.3596, -0.13089, 0.31599],
        ];
        for ((camera, (x_m, y_m)), xyzw) in Camera::ravens().iter().zip(hits).zip(quaternions) {
            let center = Point2::new(320.0, 240.0);
            let (eye, ahead) = (
                camera.back_project(&center, 0.0),
                camera.back_project(&center, 1.0),
            );
            let hit = eye + (ahead - eye) * (eye.z / (eye.z - ahead.z));
            let expected = Point3::new(x_m, y_m, 0.0);
            assert!((hit - expected).amax() < 5e-4, "{}: {hit}", camera.name);
            // The lower edge of the image is nearer than the upper one: the camera is not upside down.
            let below = camera.back_project(&Point2::new(320.0, 480.0), 1.0);
            assert!(below.z < ahead.z, "{}", camera.name);
            let published = UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(
                xyzw[3], xyzw[0], xyzw[1], xyzw[2],
            ));
            let angle_rad = camera.world_from_camera.rotation.angle_to(&published);
            assert!(angle_rad < 1e-4, "{}: {angle_rad}", camera.name);
        }
    }

    #[test]
    fn a_camera_without_sense_is_refused_by_name_and_parameter() {
        let good = Camera::ravens()[0].clone();
        assert_eq!(good.check(), Ok(()));
        let with = |change: fn(&mut Camera)| {
            let mut camera = good.clone();
            change(&mut camera);
            camera.check().unwrap_err().to_string()
        };
        let refusals = [
            (with(|c| c.intrinsics.width = 0), "the width is 0"),
            (with(|c| c.intrinsics.height = 1 << 20), "the height is"),
            (with(|c| c.intrinsics.fx_px = f64::NAN), "fx is NaN"),
            (with(|c| c.intrinsics.fy_px = -1.0), "fy is -1"),
            (with(|c| c.intrinsics.cx_px = f64::INFINITY), "cx is inf"),
            (with(|c| c.intrinsics.cy_px = f64::NAN), "cy is NaN"),
            (
                with(|c| c.world_from_camera.translation.x = f64::NAN),
                "the pose",
            ),
        ];
        for (refusal, part) in refusals {
            assert!(
                refusal.contains("front") && refusal.contains(part),
                "{refusal}"
            );
        }
    }

    /// A consumer RGB-D camera, calibrated.
    fn lens() -> Distortion {
        Distortion::plumb_bob([0.12, -0.24, 0.0011, -0.0007, 0.09])
    }

    /// Cameras as their makers calibrate them: width, height, fx, fy, cx, cy, lens.
    fn real_cameras() -> Vec<(&'static str, Intrinsics)> {
        let camera = |name, (width, height), [fx_px, fy_px, cx_px, cy_px]: [f64; 4], distortion| {
            let intrinsics = Intrinsics {
                width,
                height,
                fx_px,
                fy_px,
                cx_px,
                cy_px,
                distortion,
            };
            (name, intrinsics)
        };
        vec![
            camera(
                "RealSense D435, colour",
                (1280, 720),
                [918.3, 918.1, 642.7, 361.2],
                Distortion::plumb_bob([0.157, -0.499, -0.0008, 0.0006, 0.459]),
            ),
            camera(
                "RealSense D405",
                (848, 480),
                [434.2, 433.5, 421.9, 239.6],
                Distortion::plumb_bob([-0.0547, 0.0602, 0.0005, 0.0011, -0.0194]),
            ),
            camera(
                "Orbbec Femto Mega, colour",
                (1280, 720),
                [745.6, 745.2, 640.3, 361.9],
                Distortion::rational([
                    0.0746, -0.1057, -0.0003, -0.0002, 0.0434, 0.0021, -0.0033, 0.0011,
                ]),
            ),
            camera(
                "Orbbec Femto Bolt and Azure Kinect, colour: a strong denominator",
                (1280, 720),
                [605.9, 605.7, 638.4, 366.5],
                Distortion::rational([
                    0.5179, -2.5816, 0.0007, -0.0002, 1.4943, 0.3954, -2.4092, 1.4233,
                ]),
            ),
            camera(
                "Azure Kinect, depth, narrow field of view",
                (640, 576),
                [504.4, 504.5, 320.3, 333.0],
                Distortion::rational([
                    5.2613, 3.4961, 0.00001, -0.00006, 0.1788, 5.5938, 5.2337, 0.9184,
                ]),
            ),
            camera(
                "ZED 2i, left, raw",
                (1280, 720),
                [528.9, 528.5, 645.1, 362.4],
                Distortion::rational([
                    -0.0396, 0.0089, 0.0002, -0.0001, -0.0046, 0.0012, -0.0008, 0.0003,
                ]),
            ),
            camera(
                "RealSense T265, a fisheye, the middle of its image",
                (560, 420),
                [285.7, 286.5, 280.7, 208.4],
                Distortion::equidistant([-0.0079, 0.0447, -0.0418, 0.0076]),
            ),
            camera(
                "a fisheye of 150 degrees across",
                (1280, 960),
                [600.0, 600.0, 640.0, 480.0],
                Distortion::equidistant([0.021, -0.008, 0.003, -0.0007]),
            ),
        ]
    }

    #[test]
    fn a_fisheye_that_sees_90_degrees_from_its_axis_in_a_corner_is_refused_with_the_pixel() {
        let mut camera = Camera::ravens()[0].clone();
        // The corners are 2.6 rad from the axis.
        camera.intrinsics.fx_px = 150.0;
        camera.intrinsics.fy_px = 150.0;
        camera.intrinsics.distortion = Distortion::equidistant([0.0; 4]);
        let error = camera.check().unwrap_err().to_string();
        assert!(
            error.contains("camera front")
                && error.contains("equidistant")
                && error.contains("pixel (0, 0)"),
            "{error}"
        );
    }

    #[test]
    fn a_distortion_that_cannot_be_undone_in_the_image_is_refused_with_a_pixel() {
        let mut camera = Camera::ravens()[0].clone();
        camera.intrinsics.distortion = lens();
        assert_eq!(camera.check(), Ok(()));
        for distortion in [
            Distortion::plumb_bob([-0.9, 0.0, 0.0, 0.0, 0.0]),
            Distortion::plumb_bob([0.0, 0.0, f64::NAN, 0.0, 0.0]),
            Distortion::rational([0.0, 0.0, 0.0, 0.0, 0.0, 3.0, 0.0, 0.0]),
            Distortion::rational([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, f64::NAN, 0.0]),
            Distortion::equidistant([-0.6, 0.0, 0.0, 0.0]),
            Distortion::equidistant([0.0, 0.0, 0.0, f64::NAN]),
        ] {
            camera.intrinsics.distortion = distortion;
            let error = camera.check().unwrap_err().to_string();
            assert!(
                error.contains("camera front") && error.contains("pixel (0, 0)"),
                "{error}"
            );
        }
    }

    proptest! {
        #[test]
        fn any_pixel_of_a_real_camera_is_where_its_ray_is_shown(
            u in 0.0..1.0, v in 0.0..1.0, depth_m in 0.1..10.0,
        ) {
            for (name, intrinsics) in real_cameras() {
                let camera = Camera {
                    name: name.into(),
                    intrinsics,
                    world_from_camera: Camera::ravens()[1].world_from_camera,
                };
                prop_assert_eq!(camera.check(), Ok(()));
                let (right, bottom) = ((intrinsics.width - 1) as f64, (intrinsics.height - 1) as f64);
                // The edges too.
                for image in [Point2::new(u * right, v * bottom), Point2::new(u * right, 0.0), Point2::new(right, v * bottom)] {
                    let point = camera.back_project(&image, depth_m);
                    let Some((again, again_m)) = camera.project(&point) else {
                        return Err(TestCaseError::fail(format!("{name}: nothing at {image}")));
                    };
                    prop_assert!((again - image).amax() < 1e-4, "{name}: {again} {image}");
                    prop_assert!((again_m - depth_m).abs() < 1e-9 * depth_m.max(1.0) , "{name}");
                }
            }
        }

        #[test]
        fn behind_a_lens_projection_undoes_back_projection_too(
            u_px in 0.0..639.0, v_px in 0.0..479.0, depth_m in 0.01..10.0, which in 0usize..3,
        ) {
            let mut camera = Camera::ravens()[which].clone();
            camera.intrinsics.distortion = lens();
            let image = Point2::new(u_px, v_px);
            let point = camera.back_project(&image, depth_m);
            let (again, depth_again_m) = camera.project(&point).unwrap();
            prop_assert!((again - image).amax() < 1e-8);
            prop_assert!((depth_again_m - depth_m).abs() < 1e-10);
            // And the lens matters.
            let mut pinhole = camera.clone();
            pinhole.intrinsics.distortion = Distortion::NONE;
            let (straight, _) = pinhole.project(&point).unwrap();
            let from_axis = (image - Point2::new(320.0, 240.0)).norm();
            prop_assert!((straight - image).norm() > 0.2 || !(120.0..=300.0).contains(&from_axis));
        }

        #[test]
        fn projection_undoes_back_projection(
            u_px in 0.0..640.0, v_px in 0.0..480.0, depth_m in 0.01..10.0, which in 0usize..3,
        ) {
            let camera = &Camera::ravens()[which];
            let image = Point2::new(u_px, v_px);
            let (again, depth_again_m) = camera.project(&camera.back_project(&image, depth_m)).unwrap();
            prop_assert!((again - image).amax() < 1e-8);
            prop_assert!((depth_again_m - depth_m).abs() < 1e-10);
            prop_assert_eq!(camera.project(&camera.back_project(&image, -depth_m)), None);
        }
    }
}
