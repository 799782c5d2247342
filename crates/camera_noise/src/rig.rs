//! A perturbation drawn from a seed, for the cameras of a cell.

use crate::image::{self, Patches, StereoCamera};
use crate::{Depth, Edges, Perturbation};
use heightmap::{Camera, Intrinsics, Workspace};
use nalgebra::{Isometry3, Translation3, Unit, UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use std::f64::consts::TAU;

/// A box on the table that is no part of the task.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClutterItem {
    /// Edge lengths.
    pub size_m: Vector3<f64>,
    /// Pose of its middle in the world, upright on the table at z = 0.
    pub pose: Isometry3<f64>,
    /// Colour.
    pub rgb: [u8; 3],
}

/// What stays the same from image to image, and the model that the rest is drawn from.
///
/// Two rigs of the same model, cameras, seed and session are equal, and give equal images.
#[derive(Clone, Debug)]
pub struct Rig {
    model: Perturbation,
    cameras: Vec<DrawnCamera>,
    light_turn: UnitQuaternion<f64>,
    clutter: Vec<ClutterItem>,
    missing: Option<usize>,
    seed: u64,
    session: u64,
}

/// Where the depths of an image have steps: the same in all images of a camera while nothing moves.
#[derive(Clone, Debug, Default)]
pub struct DepthSteps(Vec<(usize, f32, f32)>);

#[derive(Clone, Debug)]
struct DrawnCamera {
    /// By how much the calibration is wrong, in the camera's own frame.
    camera_from_believed: Isometry3<f64>,
    /// Factors of red, green and blue.
    gains: [f32; 3],
}

/// Streams of random numbers of a seed; images have the ones above.
const OF_THE_SEED: u64 = 0;
const OF_THE_SESSION: u64 = 1;
const FIRST_IMAGE: u64 = 2;

fn stream(seed: u64, session: u64, stream: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ session.wrapping_mul(0x9e37_79b9_7f4a_7c15));
    rng.set_stream(stream);
    rng
}

fn normal(rng: &mut ChaCha8Rng) -> f64 {
    rng.sample(StandardNormal)
}

impl Rig {
    /// Draws for the cameras of a cell. The errors of the calibration and the missing camera are those of the seed, alike in all of its
    /// sessions; light, colours, clutter and noise are those of the session.
    pub fn draw(model: &Perturbation, cameras: &[Camera], seed: u64, session: u64) -> Self {
        let mut rng = stream(seed, 0, OF_THE_SEED);
        let mut errors = Vec::new();
        for _ in cameras {
            let mut vector = |scale: f64| Vector3::from_fn(|_, _| scale * normal(&mut rng));
            let shift = vector(model.extrinsics.shift_m);
            let turn = vector(model.extrinsics.turn_rad);
            errors.push(Isometry3::new(shift, turn));
        }
        let missing = (cameras.len() > 1 && rng.random_bool(model.missing_camera_chance))
            .then(|| rng.random_range(0..cameras.len()));
        let mut rng = stream(seed, session, OF_THE_SESSION);
        let cameras = errors
            .into_iter()
            .map(|camera_from_believed| {
                let mut factor = |spread: f64| 1.0 + rng.random_range(-1.0..=1.0) * spread;
                let gain = factor(model.color.gain);
                DrawnCamera {
                    camera_from_believed,
                    gains: [(); 3].map(|()| (gain * factor(model.color.tint)) as f32),
                }
            })
            .collect();
        let axis = Unit::new_normalize({
            let angle = rng.random_range(0.0..TAU);
            Vector3::new(angle.cos(), angle.sin(), 0.0)
        });
        let turn_rad = rng.random_range(0.0..=1.0) * model.light.turn_rad;
        let count = rng.random_range(0..=model.clutter.max_count);
        let clutter = (0..count).map(|_| item(model, &mut rng)).collect();
        Self {
            model: model.clone(),
            cameras,
            light_turn: UnitQuaternion::from_axis_angle(&axis, turn_rad),
            clutter,
            missing,
            seed,
            session,
        }
    }

    /// The model that it was drawn from.
    pub fn model(&self) -> &Perturbation {
        &self.model
    }

    /// Whether nothing comes from a camera.
    pub fn is_missing(&self, camera: usize) -> bool {
        self.missing == Some(camera)
    }

    /// A camera as the fusion believes it to stand.
    pub fn believed(&self, index: usize, camera: &Camera) -> Camera {
        Camera {
            world_from_camera: camera.world_from_camera * self.cameras[index].camera_from_believed,
            ..camera.clone()
        }
    }

    /// The direction that light comes from, of the one that it usually comes from.
    pub fn light(&self, usual: &Vector3<f64>) -> Vector3<f64> {
        self.light_turn * usual
    }

    /// Boxes on the table. They may overlap objects of the task: the renderer leaves those out.
    pub fn clutter(&self) -> &[ClutterItem] {
        &self.clutter
    }

    /// Changes an image of a camera as it takes it. `frame` counts the images of the session; each has noise of its own. `rgb` and
    /// `depth_m` (along the optical axis; 0 where nothing was measured) are row-major and of the camera's size.
    pub fn apply(
        &self,
        camera: usize,
        intrinsics: &Intrinsics,
        frame: u64,
        rgb: &mut [u8],
        depth_m: &mut [f32],
    ) {
        let steps = self.depth_steps(intrinsics, depth_m);
        self.apply_with_steps(camera, intrinsics, frame, &steps, rgb, depth_m);
    }

    /// The steps of an image that was not changed yet.
    pub fn depth_steps(&self, intrinsics: &Intrinsics, depth_m: &[f32]) -> DepthSteps {
        let (width, height) = (intrinsics.width, intrinsics.height);
        DepthSteps(image::steps(&self.model.edges, width, height, depth_m))
    }

    /// As [`Self::apply`], where the steps of the image are known.
    pub fn apply_with_steps(
        &self,
        camera: usize,
        intrinsics: &Intrinsics,
        frame: u64,
        steps: &DepthSteps,
        rgb: &mut [u8],
        depth_m: &mut [f32],
    ) {
        let (width, height) = (intrinsics.width, intrinsics.height);
        let of = |index: u64| {
            let image = index * self.cameras.len() as u64 + camera as u64;
            stream(self.seed, self.session, FIRST_IMAGE + image)
        };
        let mut rng = of(1 + frame);
        let stereo = StereoCamera::new(&self.model.depth);
        if self.model.depth.disparity_noise_px > 0.0 {
            let Depth {
                patch_px,
                constant_share,
                ..
            } = self.model.depth;
            let mut constant = Patches::draw(&mut of(0), width, height, patch_px);
            let mut new = Patches::draw(&mut rng, width, height, patch_px);
            let old_part = constant_share.sqrt() as f32;
            let new_part = (1.0 - constant_share).sqrt() as f32;
            for (v, row) in depth_m.chunks_exact_mut(width).enumerate() {
                let errors = constant.row(v).zip(new.row(v));
                for (depth_m, (old, new)) in row.iter_mut().zip(errors) {
                    *depth_m = stereo.measured(*depth_m, old_part * old + new_part * new);
                }
            }
        } else {
            for depth_m in depth_m.iter_mut() {
                *depth_m = stereo.measured(*depth_m, 0.0);
            }
        }
        let Edges {
            flying_share,
            hole_share,
            ..
        } = self.model.edges;
        for &(index, near_m, far_m) in &steps.0 {
            let chance: f64 = rng.random_range(0.0..1.0);
            let between: f32 = rng.random_range(0.0..1.0);
            if chance < hole_share {
                depth_m[index] = 0.0;
            } else if chance < hole_share + flying_share && depth_m[index] > 0.0 {
                depth_m[index] = near_m + between * (far_m - near_m);
            }
        }
        self.punch_holes(&mut rng, width, height, depth_m);
        let noise = self.model.color.noise as f32;
        image::color(self.cameras[camera].gains, noise, &mut rng, rgb);
    }

    fn punch_holes(&self, rng: &mut ChaCha8Rng, width: usize, height: usize, depth_m: &mut [f32]) {
        let size = self.model.holes.size_px;
        let expected = self.model.holes.share * (width * height) as f64 / (size * size) as f64;
        // The part behind the point is a chance.
        let count = (expected + rng.random_range(0.0..1.0)) as usize;
        for _ in 0..count {
            let (left, top) = (rng.random_range(0..width), rng.random_range(0..height));
            for v in top..(top + size).min(height) {
                depth_m[v * width + left..v * width + (left + size).min(width)].fill(0.0);
            }
        }
    }
}

/// A box somewhere on the table of the workspace.
fn item(model: &Perturbation, rng: &mut ChaCha8Rng) -> ClutterItem {
    let workspace = Workspace::RAVENS;
    let (from, to) = (model.clutter.min_size_m, model.clutter.max_size_m);
    let size_m = Vector3::from_fn(|_, _| rng.random_range(from..=to));
    let mut along = |origin_m: f64, cells: usize| {
        origin_m + rng.random_range(0.0..cells as f64) * workspace.pixel_size_m
    };
    let x = along(workspace.origin_m.x, workspace.cols);
    let y = along(workspace.origin_m.y, workspace.rows);
    let yaw_rad = rng.random_range(0.0..TAU);
    ClutterItem {
        size_m,
        pose: Isometry3::from_parts(
            Translation3::new(x, y, 0.5 * size_m.z),
            UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw_rad),
        ),
        rgb: [(); 3].map(|()| rng.random_range(20..=255)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const REALSENSE: &str = include_str!("../../../config/perturbations/realsense.yaml");

    fn realsense() -> Perturbation {
        Perturbation::parse("realsense.yaml", REALSENSE).unwrap()
    }

    /// Nothing but what a test adds.
    fn nothing() -> Perturbation {
        let mut model = realsense();
        model.depth.disparity_noise_px = 0.0;
        model.depth.disparity_step_px = 0.0;
        model.depth.unit_m = 0.0;
        (model.edges.flying_share, model.edges.hole_share) = (0.0, 0.0);
        model.holes.share = 0.0;
        (model.color.noise, model.color.gain, model.color.tint) = (0.0, 0.0, 0.0);
        model.light.turn_rad = 0.0;
        (model.extrinsics.shift_m, model.extrinsics.turn_rad) = (0.0, 0.0);
        model.missing_camera_chance = 0.0;
        model.clutter.max_count = 0;
        model
    }

    fn rig(model: &Perturbation, seed: u64, session: u64) -> Rig {
        Rig::draw(model, &Camera::ravens(), seed, session)
    }

    /// An image of a plane at a depth, with a square 10 cm nearer in the middle.
    fn image(depth_m: f32) -> (Vec<u8>, Vec<f32>) {
        let square = |index: usize| {
            let (u, v) = (index % 640, index / 640);
            (280..360).contains(&u) && (200..280).contains(&v)
        };
        let depth = |index| {
            if square(index) {
                depth_m - 0.1
            } else {
                depth_m
            }
        };
        (
            vec![100; 3 * 640 * 480],
            (0..640 * 480).map(depth).collect(),
        )
    }

    fn applied(rig: &Rig, frame: u64, depth_m: f32) -> (Vec<u8>, Vec<f32>) {
        let (mut rgb, mut depth_m) = image(depth_m);
        rig.apply(1, &Intrinsics::RAVENS, frame, &mut rgb, &mut depth_m);
        (rgb, depth_m)
    }

    fn deviation(values: impl Iterator<Item = f64> + Clone) -> f64 {
        let count = values.clone().count() as f64;
        let mean = values.clone().sum::<f64>() / count;
        (values.map(|value| (value - mean).powi(2)).sum::<f64>() / count).sqrt()
    }

    /// Depths of the lower rows, where nothing stands.
    fn plain(depth_m: &[f32]) -> impl Iterator<Item = f64> + Clone {
        depth_m[300 * 640..].iter().copied().map(f64::from)
    }

    #[test]
    fn a_model_of_nothing_changes_nothing() {
        let rig = rig(&nothing(), 3, 1);
        let (rgb, depth_m) = applied(&rig, 7, 1.0);
        let (clean_rgb, clean_m) = image(1.0);
        assert_eq!(rgb, clean_rgb);
        let apart = depth_m.iter().zip(&clean_m).map(|(a, b)| (a - b).abs());
        assert!(apart.fold(0.0, f32::max) < 1e-6);
        let camera = &Camera::ravens()[1];
        assert_eq!(rig.believed(1, camera), *camera);
        assert!(rig.clutter().is_empty() && !(0..3).any(|camera| rig.is_missing(camera)));
        let up = Vector3::new(0.0, 0.0, 1.0);
        assert!((rig.light(&up) - up).norm() < 1e-12);
    }

    #[test]
    fn the_same_seed_gives_the_same_bits_and_another_frame_session_or_seed_others() {
        let model = realsense();
        let first = applied(&rig(&model, 10_000, 0), 4, 1.0);
        assert_eq!(first, applied(&rig(&model, 10_000, 0), 4, 1.0));
        for (seed, session, frame) in [(10_000, 0, 5), (10_000, 1, 4), (10_002, 0, 4)] {
            assert_ne!(first, applied(&rig(&model, seed, session), frame, 1.0));
        }
        // The calibration is that of the cell, whatever the session.
        let camera = &Camera::ravens()[2];
        let believed = |seed, session| rig(&model, seed, session).believed(2, camera);
        assert_eq!(believed(10_000, 0), believed(10_000, 1));
        assert_ne!(believed(10_000, 0), believed(10_002, 0));
    }

    #[test]
    fn depth_noise_is_that_of_the_formula_and_grows_with_the_square_of_the_distance() {
        let mut model = nothing();
        model.depth.disparity_noise_px = 0.08;
        let expected_m = |z: f64| z * z * 0.08 / (model.depth.focal_px * model.depth.baseline_m);
        for z in [0.5, 1.0, 2.0] {
            let (_, depth_m) = applied(&rig(&model, 2, 0), 0, z as f32);
            let found_m = deviation(plain(&depth_m));
            let ratio = found_m / expected_m(z);
            assert!((0.9..1.1).contains(&ratio), "{z} m: {ratio}");
        }
    }

    #[test]
    fn a_constant_share_of_the_noise_stays_from_frame_to_frame() {
        let mut model = nothing();
        model.depth.disparity_noise_px = 0.05;
        let between_frames = |share: f64| {
            let mut model = model.clone();
            model.depth.constant_share = share;
            let rig = rig(&model, 5, 0);
            let [one, two] = [0, 1].map(|frame| applied(&rig, frame, 1.0).1);
            let pairs: Vec<f64> = plain(&one).zip(plain(&two)).map(|(a, b)| a - b).collect();
            deviation(pairs.into_iter())
        };
        let all_new = between_frames(0.0);
        assert!((between_frames(0.75) / all_new - 0.5).abs() < 0.05);
        assert_eq!(between_frames(1.0), 0.0);
    }

    #[test]
    fn depth_is_quantised_in_disparity_and_in_units() {
        let mut model = nothing();
        (model.depth.disparity_step_px, model.depth.unit_m) = (1.0 / 32.0, 0.001);
        model.depth.disparity_noise_px = 0.05;
        let (_, depth_m) = applied(&rig(&model, 5, 0), 0, 1.0);
        let mut levels: Vec<i64> = plain(&depth_m).map(|z| (z * 1e6).round() as i64).collect();
        levels.sort_unstable();
        levels.dedup();
        // A disparity step at 1 m is 1.5 mm, rounded to whole millimetres.
        assert!(levels.len() < 20, "{levels:?}");
        assert!(
            levels
                .iter()
                .all(|level| level % 1000 < 2 || level % 1000 > 998),
            "{levels:?}"
        );
    }

    #[test]
    fn holes_and_flying_pixels_have_their_shares() {
        let mut model = nothing();
        (model.holes.share, model.holes.size_px) = (0.02, 3);
        let (_, depth_m) = applied(&rig(&model, 5, 0), 0, 1.0);
        let share = depth_m.iter().filter(|depth| **depth == 0.0).count() as f64 / 307_200.0;
        assert!((share - 0.02).abs() < 0.002, "{share}");
        let mut model = nothing();
        (
            model.edges.width_px,
            model.edges.hole_share,
            model.edges.flying_share,
        ) = (2, 0.5, 0.25);
        let (_, depth_m) = applied(&rig(&model, 5, 0), 0, 1.0);
        let at_edge: Vec<f32> = (0..depth_m.len())
            .filter(|index| {
                let (u, v) = ((index % 640) as i64, (index / 640) as i64);
                let near = |at: i64, from: i64, to: i64| (from - 2..to + 2).contains(&at);
                let inner = |at: i64, from: i64, to: i64| (from + 2..to - 2).contains(&at);
                near(u, 280, 360)
                    && near(v, 200, 280)
                    && !(inner(u, 280, 360) && inner(v, 200, 280))
            })
            .map(|index| depth_m[index])
            .collect();
        let share = |of: &dyn Fn(f32) -> bool| {
            at_edge.iter().filter(|depth| of(**depth)).count() as f64 / at_edge.len() as f64
        };
        assert!((share(&|depth| depth == 0.0) - 0.5).abs() < 0.06);
        let flying = share(&|depth| (0.902..0.998).contains(&depth));
        assert!((flying - 0.25).abs() < 0.06, "{flying}");
        // Elsewhere nothing happens.
        assert!(plain(&depth_m).all(|depth| (depth - 1.0).abs() < 1e-6));
    }

    #[test]
    fn too_near_and_too_far_is_not_measured() {
        let mut model = nothing();
        (model.depth.min_m, model.depth.max_m) = (0.95, 3.0);
        let (_, depth_m) = applied(&rig(&model, 5, 0), 0, 1.0);
        assert_eq!(depth_m[240 * 640 + 320], 0.0);
        let (_, depth_m) = applied(&rig(&model, 5, 0), 0, 3.05);
        assert_eq!(depth_m[0], 0.0);
        assert!(depth_m[240 * 640 + 320] > 0.0);
    }

    #[test]
    fn colors_calibration_light_and_clutter_stay_within_the_model() {
        let mut model = nothing();
        (model.color.gain, model.color.tint, model.color.noise) = (0.2, 0.1, 3.0);
        (model.extrinsics.shift_m, model.extrinsics.turn_rad) = (0.002, 0.003);
        (model.light.turn_rad, model.missing_camera_chance) = (0.5, 0.25);
        model.clutter.max_count = 4;
        let cameras = Camera::ravens();
        let (mut shifts, mut missing, mut items) = (Vec::new(), 0, 0);
        for seed in 0..300 {
            let rig = rig(&model, seed, 0);
            for (index, camera) in cameras.iter().enumerate() {
                let error = camera
                    .world_from_camera
                    .inv_mul(&rig.believed(index, camera).world_from_camera);
                shifts.extend(error.translation.vector.iter().copied());
                assert!(error.rotation.angle() < 0.02);
            }
            missing += (0..3).filter(|camera| rig.is_missing(*camera)).count();
            let usual = Vector3::new(0.3, 0.2, 0.93);
            assert!(rig.light(&usual).angle(&usual) <= 0.5 + 1e-9);
            items += rig.clutter().len();
            for item in rig.clutter() {
                assert!(
                    Workspace::RAVENS
                        .pixel(&item.pose.translation.vector.xy().into())
                        .is_some()
                );
                assert!((item.pose.translation.z - 0.5 * item.size_m.z).abs() < 1e-12);
            }
        }
        assert!((deviation(shifts.into_iter()) / 0.002 - 1.0).abs() < 0.1);
        assert!((45..=105).contains(&missing), "{missing}");
        assert!((450..=750).contains(&items), "{items}");
        let (rgb, _) = applied(&rig(&model, 1, 0), 0, 1.0);
        let reds = rgb.iter().step_by(3).map(|red| f64::from(*red));
        assert!((deviation(reds.clone()) - 3.0).abs() < 0.2);
        let mean = reds.sum::<f64>() / 307_200.0;
        assert!(
            (mean - 100.0).abs() <= 32.5 && (mean - 100.0).abs() > 0.5,
            "{mean}"
        );
    }
}
