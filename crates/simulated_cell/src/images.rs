//! What the cell's cameras take of a still scene.

use std::time::Duration;

use camera_noise::Rig;
use heightmap::Camera;
use multiravens::render::{RenderError, RgbdImage};

use crate::SimulatedCell;

/// Period of noisy cameras: 30 Hz.
pub const NOISY_PERIOD: Duration = Duration::from_nanos(33_333_333);
/// They run free: each takes its images this much after the one before it, so that the first and the last of three are 14 ms apart.
const NOISY_OFFSET: Duration = Duration::from_millis(7);

/// One image of one camera.
#[derive(Clone, Copy, Debug)]
pub struct Shot<'a> {
    /// Which set of images it belongs to, from 0.
    pub set: usize,
    /// The camera's place among the cell's cameras.
    pub index: usize,
    /// The camera, as it truly stands.
    pub camera: &'a Camera,
    /// What it has taken.
    pub image: &'a RgbdImage,
    /// Simulated time of the image.
    pub time: Duration,
}

/// A still scene before the cameras: rendered once, taken any number of times, on any thread.
#[derive(Clone, Debug)]
pub struct StillScene {
    cameras: Vec<Camera>,
    images: Vec<RgbdImage>,
    rig: Option<Rig>,
}

impl StillScene {
    /// The cameras, as they truly stand.
    pub fn cameras(&self) -> &[Camera] {
        &self.cameras
    }

    /// What a camera takes of it in a set of images, with noise of that set; nothing where the camera is missing.
    pub fn take(&self, index: usize, set: u64) -> Option<RgbdImage> {
        let mut image = self.images[index].clone();
        if let Some(rig) = &self.rig {
            if rig.is_missing(index) {
                return None;
            }
            let intrinsics = &self.cameras[index].intrinsics;
            rig.apply(index, intrinsics, set, &mut image.rgb, &mut image.depth_m);
        }
        Some(image)
    }

    /// When a camera takes its image of a set that begins at a time: noisy cameras run free.
    pub fn time_of(&self, index: usize, begin: Duration) -> Duration {
        match &self.rig {
            Some(_) => begin + index as u32 * NOISY_OFFSET,
            None => begin,
        }
    }
}

impl SimulatedCell {
    /// What is before the cameras now.
    ///
    /// # Errors
    /// When the scene cannot be rendered.
    pub fn still(&mut self) -> Result<StillScene, RenderError> {
        let rig = self.environment.rig().cloned();
        let cell = self.environment.cell_mut();
        Ok(StillScene {
            cameras: cell.cameras().to_vec(),
            images: cell.render()?.to_vec(),
            rig,
        })
    }

    /// The number of the next set of images that noisy cameras take.
    pub fn count_set(&mut self) -> u64 {
        let set = self.sets_taken;
        self.sets_taken += 1;
        set
    }

    /// Takes images with all cameras: one set with perfect ones; with noisy ones as many as their model says, one after the other, each image with
    /// noise of its own, and without those of a missing camera.
    ///
    /// # Errors
    /// When the scene cannot be rendered, or what `each` says.
    pub fn take_images<E: From<RenderError>>(
        &mut self,
        mut each: impl FnMut(Shot<'_>) -> Result<(), E>,
    ) -> Result<(), E> {
        let time = self.time();
        let Some(rig) = self.environment.rig() else {
            let cell = self.environment.cell_mut();
            let cameras = cell.cameras().to_vec();
            for (index, (camera, image)) in cameras.iter().zip(cell.render()?).enumerate() {
                each(Shot {
                    set: 0,
                    index,
                    camera,
                    image,
                    time,
                })?;
            }
            return Ok(());
        };
        let sets = rig.model().frames;
        let still = self.still()?;
        for set in 0..sets {
            let number = self.count_set();
            let begin = time + set as u32 * NOISY_PERIOD;
            for (index, camera) in still.cameras().iter().enumerate() {
                let Some(image) = still.take(index, number) else {
                    continue;
                };
                each(Shot {
                    set,
                    index,
                    camera,
                    image: &image,
                    time: still.time_of(index, begin),
                })?;
            }
        }
        Ok(())
    }

    /// Where the cameras stand as their calibration has it: wrong by what their model says.
    pub fn calibrated_cameras(&self) -> Vec<Camera> {
        let cameras = self.environment.cell().cameras().iter().enumerate();
        let believed = cameras.map(|(index, camera)| match self.environment.rig() {
            Some(rig) => rig.believed(index, camera),
            None => camera.clone(),
        });
        believed.collect()
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::Wiring;
    use camera_noise::Perturbation;
    use driver_model::HardwareSettings;
    use multiravens::Problem;
    use ur5::WorkCell;

    /// A cell whose cameras see as a file of config/perturbations says.
    pub(crate) fn cell(perturbation: Option<&str>) -> SimulatedCell {
        let problem = include_str!("../../../config/problems/placing.yaml");
        let problem = Problem::parse("placing", problem).unwrap();
        let perturbation = perturbation.map(|text| Perturbation::parse("p.yaml", text).unwrap());
        let wiring = Wiring {
            suction_pin: 16,
            vacuum_pin: 17,
        };
        let hardware = HardwareSettings::default();
        let work_cell = WorkCell::builtin().unwrap();
        SimulatedCell::new(&problem, &work_cell, 10_000, wiring, perturbation, hardware).unwrap()
    }

    fn shots(perturbation: Option<&str>) -> Vec<(usize, usize, Duration, Vec<u8>)> {
        let (mut cell, mut shots) = (cell(perturbation), Vec::new());
        cell.take_images(|shot| {
            shots.push((shot.set, shot.index, shot.time, shot.image.rgb.clone()));
            Ok::<_, RenderError>(())
        })
        .unwrap();
        shots
    }

    #[test]
    fn perfect_cameras_take_one_image_each_at_one_time() {
        let taken = shots(None);
        let order: Vec<_> = taken.iter().map(|shot| (shot.0, shot.1)).collect();
        assert_eq!(order, [(0, 0), (0, 1), (0, 2)]);
        assert!(taken.iter().all(|shot| shot.2 == taken[0].2));
    }

    #[test]
    fn noisy_cameras_take_as_many_sets_as_their_model_says_each_image_with_noise_of_its_own() {
        let model = include_str!("../../../config/perturbations/realsense.yaml");
        let taken = shots(Some(model));
        assert!(
            taken.len() > 3 && taken.len().is_multiple_of(3),
            "{}",
            taken.len()
        );
        for (count, shot) in taken.iter().enumerate() {
            assert_eq!((shot.0, shot.1), (count / 3, count % 3));
            let since = shot.2 - taken[0].2;
            assert_eq!(
                since,
                (count / 3) as u32 * NOISY_PERIOD + (count % 3) as u32 * NOISY_OFFSET
            );
            assert!(taken[..count].iter().all(|earlier| earlier.3 != shot.3));
        }
    }
}
