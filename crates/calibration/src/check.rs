//! What is to be said of the cameras of a cell from frames of its empty, still table, with or without a board on it.

use crate::{Board, GrayImage, board_pose, detect, gray_pixels};
use heightmap::{
    Camera, ChangeRules, Fusion, FusionError, Heightmap, OtherWorkspace, StillFusion,
    StillSettings, View, Workspace, largest_change,
};
use nalgebra::{Isometry3, Matrix3, Vector3};

/// Colour and registered depth of one camera at one time.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Three bytes a pixel.
    pub rgb: Vec<u8>,
    /// Along the optical axis; 0 where nothing was measured.
    pub depth_m: Vec<f32>,
}

/// What a measure may be at most, or at least.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Limit {
    /// The measure must not be larger.
    AtMost(f64),
    /// The measure must not be smaller.
    AtLeast(f64),
}

/// One row of the table.
#[derive(Clone, Debug, PartialEq)]
pub struct Measure {
    /// What was measured, in one word.
    pub name: &'static str,
    /// Of which camera, pair or corner.
    pub subject: String,
    /// The value; not a number where it could not be measured.
    pub value: f64,
    /// Its unit.
    pub unit: &'static str,
    /// What it may be.
    pub limit: Limit,
}

impl Measure {
    /// Whether the value keeps its limit; one that is not a number does not.
    pub fn is_good(&self) -> bool {
        match self.limit {
            Limit::AtMost(limit) => self.value <= limit,
            Limit::AtLeast(limit) => self.value >= limit,
        }
    }
}

/// Limits of a cell that is in order.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CheckLimits {
    /// Tilt of the table as a camera sees it.
    pub tilt_deg: f64,
    /// Height of the table in the middle of the workspace as a camera sees it, up or down.
    pub height_mm: f64,
    /// Median difference of the heights that two cameras see.
    pub offset_mm: f64,
    /// Distance of the middles of the board as two cameras see it.
    pub board_mm: f64,
    /// Angle between the boards that two cameras see.
    pub board_deg: f64,
    /// Share of the cells that are seen.
    pub fill: f64,
    /// Heights of 99.9 % of the cells that change between two heightmaps of the same scene: what the gate takes for noise.
    pub noise_mm: f64,
}

impl Default for CheckLimits {
    fn default() -> Self {
        Self {
            tilt_deg: 0.4,
            height_mm: 4.0,
            offset_mm: 3.0,
            board_mm: 3.0,
            board_deg: 0.35,
            fill: 0.98,
            noise_mm: 1e3 * ChangeRules::default().near.height_m,
        }
    }
}

/// Why nothing can be measured.
#[derive(Debug, thiserror::Error)]
pub enum CheckError {
    /// Too few frames.
    #[error("{frames} frames of camera {camera}, expected {expected} or more")]
    Frames {
        /// The camera.
        camera: String,
        /// Frames there are.
        frames: usize,
        /// Frames needed.
        expected: usize,
    },
    /// Frames that do not fit their camera.
    #[error(transparent)]
    Fusion(#[from] FusionError),
    /// Cannot happen: heightmaps of one workspace.
    #[error(transparent)]
    Workspace(#[from] OtherWorkspace),
}

/// Cells within this of z = 0 are the table's.
const TABLE_M: f32 = 0.03;
/// The workspace of the check reaches down this far, so that a table that is too low is seen.
const DOWN_M: f64 = -0.04;

/// Measures plane, offsets, fill rate and noise. `frames` are by camera, at least twice as many as the fusion takes for a heightmap; the arm must
/// be out of sight and the table mostly empty. `still` is how the fusion takes the median, nothing where each set of images is a heightmap.
/// Where two cameras see the board, lying anywhere, they are compared by it: an empty table looks the same to a camera that stands too far aside.
///
/// # Errors
/// When a camera has too few frames, or frames of another size.
pub fn check_cameras(
    cameras: &[Camera],
    frames: &[Vec<Frame>],
    workspace: &Workspace,
    still: Option<&StillSettings>,
    board: &Board,
    limits: &CheckLimits,
) -> Result<Vec<Measure>, CheckError> {
    let count = still.map_or(1, |settings| settings.frames);
    let expected = 2 * count;
    for (camera, frames) in cameras.iter().zip(frames) {
        if frames.len() < expected {
            return Err(CheckError::Frames {
                camera: camera.name.clone(),
                frames: frames.len(),
                expected,
            });
        }
    }
    let deep = Workspace {
        z_min_m: DOWN_M,
        ..*workspace
    };
    let mut measures = Vec::new();
    let mut alone = Vec::new();
    for (camera, frames) in cameras.iter().zip(frames) {
        let heightmap = fuse(
            std::slice::from_ref(camera),
            &[&frames[..count]],
            &deep,
            still,
        )?;
        let (tilt_deg, height_mm) =
            plane(&heightmap).map_or((f64::NAN, f64::NAN), |(normal, height_m)| {
                (
                    normal.z.clamp(-1.0, 1.0).acos().to_degrees(),
                    1e3 * height_m,
                )
            });
        measures.push(Measure {
            name: "tilt",
            subject: camera.name.clone(),
            value: tilt_deg,
            unit: "degrees",
            limit: Limit::AtMost(limits.tilt_deg),
        });
        measures.push(Measure {
            name: "height",
            subject: camera.name.clone(),
            value: height_mm.abs(),
            unit: "mm",
            limit: Limit::AtMost(limits.height_mm),
        });
        alone.push(heightmap);
    }
    for (i, a) in alone.iter().enumerate() {
        for (j, b) in alone.iter().enumerate().skip(i + 1) {
            let mut differences: Vec<f64> = (0..workspace.len())
                .filter(|index| a.is_seen(*index) && b.is_seen(*index))
                .map(|index| 1e3 * f64::from(a.height_m[index] - b.height_m[index]))
                .collect();
            measures.push(Measure {
                name: "offset",
                subject: format!("{} and {}", cameras[i].name, cameras[j].name),
                value: percentile(&mut differences, 0.5).abs(),
                unit: "mm",
                limit: Limit::AtMost(limits.offset_mm),
            });
        }
    }
    measures.extend(compare_boards(cameras, frames, board, limits));
    let part = |from: usize| -> Vec<&[Frame]> {
        let parts = frames.iter().map(|frames| &frames[from..from + count]);
        parts.collect()
    };
    let first = fuse(cameras, &part(0), workspace, still)?;
    let second = fuse(cameras, &part(count), workspace, still)?;
    let seen = (0..workspace.len())
        .filter(|index| first.is_seen(*index))
        .count();
    measures.push(Measure {
        name: "fill",
        subject: "all cameras".into(),
        value: seen as f64 / workspace.len() as f64,
        unit: "of the cells",
        limit: Limit::AtLeast(limits.fill),
    });
    let mut differences: Vec<f64> = (0..workspace.len())
        .filter(|index| first.is_seen(*index) && second.is_seen(*index))
        .map(|index| 1e3 * f64::from((first.height_m[index] - second.height_m[index]).abs()))
        .collect();
    measures.push(Measure {
        name: "noise",
        subject: "all cameras".into(),
        value: percentile(&mut differences, 0.999),
        unit: "mm",
        limit: Limit::AtMost(limits.noise_mm),
    });
    // As strict as beside a pick or a place, everywhere.
    let strict = ChangeRules {
        far: ChangeRules::default().near,
        ..ChangeRules::default()
    };
    let change = largest_change(&first, &second, &strict, &[])?;
    measures.push(Measure {
        name: "change",
        subject: "all cameras".into(),
        value: change.map_or(0.0, |change| 1e6 * change.area_m2),
        unit: "mm2",
        limit: Limit::AtMost(0.0),
    });
    Ok(measures)
}

/// As the fusion does.
fn fuse(
    cameras: &[Camera],
    frames: &[&[Frame]],
    workspace: &Workspace,
    still: Option<&StillSettings>,
) -> Result<Heightmap, FusionError> {
    let views = |index: usize| -> Vec<View<'_>> {
        let views = cameras.iter().zip(frames).map(|(camera, frames)| View {
            camera,
            rgb: &frames[index].rgb,
            depth_m: &frames[index].depth_m,
        });
        views.collect()
    };
    let mut heightmap = Heightmap::new(*workspace);
    match still {
        None => {
            Fusion::default().fuse(&views(0), &mut heightmap)?;
        }
        Some(settings) => {
            let mut fusion = StillFusion::new(*settings);
            for index in 0..settings.frames {
                fusion.push(&views(index), workspace)?;
            }
            fusion.median(&mut heightmap);
        }
    }
    Ok(heightmap)
}

/// How far apart each two cameras see the board; nothing where they do not.
fn compare_boards(
    cameras: &[Camera],
    frames: &[Vec<Frame>],
    board: &Board,
    limits: &CheckLimits,
) -> Vec<Measure> {
    let seen = cameras.iter().zip(frames).filter_map(|(camera, frames)| {
        let pose = world_from_board(camera, frames, board)?;
        Some((camera.name.as_str(), pose))
    });
    let seen: Vec<(&str, Isometry3<f64>)> = seen.collect();
    let mut measures = Vec::new();
    for (i, (first, a)) in seen.iter().enumerate() {
        for (second, b) in &seen[i + 1..] {
            let middle = board.middle();
            let mut measure = |name, value, unit, limit| {
                measures.push(Measure {
                    name,
                    subject: format!("{first} and {second}"),
                    value,
                    unit,
                    limit: Limit::AtMost(limit),
                });
            };
            let apart_mm = 1e3 * (a * middle - b * middle).norm();
            measure("board", apart_mm, "mm", limits.board_mm);
            let turned_deg = a.rotation.angle_to(&b.rotation).to_degrees();
            measure("turn", turned_deg, "degrees", limits.board_deg);
        }
    }
    measures
}

/// Where the board lies, by all frames of one camera together.
fn world_from_board(camera: &Camera, frames: &[Frame], board: &Board) -> Option<Isometry3<f64>> {
    let mut tags = Vec::new();
    for frame in frames {
        let pixels = gray_pixels(&frame.rgb);
        tags.extend(detect(&GrayImage {
            width: camera.intrinsics.width,
            height: camera.intrinsics.height,
            pixels: &pixels,
        }));
    }
    let view = board_pose(board, &camera.intrinsics, &tags)?;
    Some(camera.world_from_camera * view.camera_from_board)
}

/// Normal of the table (z up) and its height in the middle of the workspace, by least squares over its cells, those far off left out three times.
/// None where too few cells are seen.
fn plane(heightmap: &Heightmap) -> Option<(Vector3<f64>, f64)> {
    let workspace = &heightmap.workspace;
    let middle = workspace.point_m(&nalgebra::Point2::new(
        0.5 * workspace.cols as f64,
        0.5 * workspace.rows as f64,
    ));
    let mut points: Vec<Vector3<f64>> = (0..workspace.len())
        .filter(|index| heightmap.is_seen(*index) && heightmap.height_m[*index].abs() < TABLE_M)
        .map(|index| {
            let center = workspace.center(heightmap::Pixel {
                row: index / workspace.cols,
                col: index % workspace.cols,
            });
            let across = center - middle;
            Vector3::new(across.x, across.y, f64::from(heightmap.height_m[index]))
        })
        .collect();
    let mut fitted = None;
    for _ in 0..4 {
        if points.len() < 100 {
            return None;
        }
        let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
        for point in &points {
            let row = Vector3::new(point.x, point.y, 1.0);
            normal += row * row.transpose();
            right += row * point.z;
        }
        let slope = normal.try_inverse()? * right;
        let off = |point: &Vector3<f64>| {
            (point.z - slope.x * point.x - slope.y * point.y - slope.z).abs()
        };
        let mut offs: Vec<f64> = points.iter().map(off).collect();
        let limit = (3.0 * percentile(&mut offs, 0.5)).max(1e-3);
        points.retain(|point| off(point) <= limit);
        fitted = Some((Vector3::new(-slope.x, -slope.y, 1.0).normalize(), slope.z));
    }
    fitted
}

/// Not a number of no values.
fn percentile(values: &mut [f64], share: f64) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    let last = values.len().saturating_sub(1);
    values
        .get((share * last as f64).round() as usize)
        .copied()
        .unwrap_or(f64::NAN)
}

#[cfg(test)]
mod tests {
    use super::*;
    use camera_noise::{Perturbation, Rig};
    use nalgebra::{Translation3, UnitQuaternion};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// The board on the table, in the middle of the workspace, as the cameras of Ravens all see it.
    fn on_table() -> Isometry3<f64> {
        Isometry3::from_parts(
            Translation3::new(0.3, 0.1, 0.001),
            UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI),
        )
    }

    /// Frames of a table, taken by cameras that may stand elsewhere than they are believed to.
    fn frames(
        real: &[Camera],
        noise: Option<&Rig>,
        count: usize,
        with_board: bool,
    ) -> Vec<Vec<Frame>> {
        let clean = |camera: &Camera| {
            let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
            let mut rgb = vec![110; 3 * width * height];
            if with_board {
                Board::A4.draw(camera, &on_table(), (200.0, 30.0), &mut rgb);
            }
            let depth_m = (0..width * height)
                .map(|i| {
                    let ray = camera.intrinsics.ray(&nalgebra::Point2::new(
                        (i % width) as f64,
                        (i / width) as f64,
                    ));
                    let down = (camera.world_from_camera.rotation * ray).z;
                    (camera.world_from_camera.translation.z / -down) as f32
                })
                .map(|depth_m| {
                    if depth_m > 0.0 && depth_m < 3.0 {
                        depth_m
                    } else {
                        0.0
                    }
                })
                .collect();
            Frame { rgb, depth_m }
        };
        let taken = |(index, camera): (usize, &Camera)| {
            let clean = clean(camera);
            let frame = |number: usize| {
                let mut frame = clean.clone();
                let Frame { rgb, depth_m } = &mut frame;
                if let Some(noise) = noise {
                    noise.apply(index, &camera.intrinsics, number as u64, rgb, depth_m);
                }
                frame
            };
            (0..count).map(frame).collect()
        };
        real.iter().enumerate().map(taken).collect()
    }

    fn realsense(real: &[Camera], seed: u64) -> Rig {
        let path = concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/../../config/perturbations/realsense.yaml"
        );
        Rig::draw(&Perturbation::load(path.as_ref()).unwrap(), real, seed, 0)
    }

    fn measures(believed: &[Camera], frames: &[Vec<Frame>]) -> Vec<Measure> {
        check_cameras(
            believed,
            frames,
            &Workspace::RAVENS,
            Some(&StillSettings::default()),
            &Board::A4,
            &CheckLimits::default(),
        )
        .unwrap()
    }

    fn faults(believed: &[Camera], frames: &[Vec<Frame>]) -> Vec<String> {
        let measures = measures(believed, frames);
        for measure in &measures {
            println!(
                "{} {}: {:.3} {}",
                measure.name, measure.subject, measure.value, measure.unit
            );
        }
        let bad = measures.iter().filter(|measure| !measure.is_good());
        bad.map(|measure| format!("{} {}", measure.name, measure.subject))
            .collect()
    }

    /// Faults of cameras and pairs of them: where one is off, noise of the whole may be red too.
    fn of_cameras(mut faults: Vec<String>) -> Vec<String> {
        faults.retain(|fault| !fault.ends_with("all cameras"));
        faults
    }

    #[test]
    fn a_cell_in_order_is_green_and_a_moved_camera_red() {
        let cameras = Camera::ravens();
        let frames = frames(&cameras, Some(&realsense(&cameras, 4)), 10, false);
        assert_eq!(faults(&cameras, &frames), Vec::<String>::new());
        // Believed 8 mm too low.
        let mut moved = cameras.clone();
        moved[1].world_from_camera.translation.z -= 0.008;
        let found = faults(&moved, &frames);
        assert!(
            found.contains(&"height left".to_owned())
                && found.contains(&"offset front and left".to_owned()),
            "{found:?}"
        );
        assert!(!found.contains(&"height right".to_owned()), "{found:?}");
        // By a degree about an axis of the table.
        let mut turned = cameras.clone();
        let turn = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), 1f64.to_radians());
        let pose = &mut turned[2].world_from_camera;
        pose.rotation = turn * pose.rotation;
        let found = faults(&turned, &frames);
        assert!(found.contains(&"tilt right".to_owned()), "{found:?}");
    }

    /// A camera that stands and looks elsewhere, in a direction drawn.
    fn off(camera: &Camera, shift_m: f64, turn_rad: f64, rng: &mut ChaCha8Rng) -> Camera {
        let mut direction = |size: f64| {
            let mut part = || rng.random_range(-1.0..1.0f64);
            Vector3::new(part(), part(), part()).normalize() * size
        };
        let shift = direction(shift_m);
        let turn = UnitQuaternion::from_scaled_axis(direction(turn_rad));
        let pose = camera.world_from_camera;
        Camera {
            world_from_camera: Isometry3::from_parts(
                Translation3::from(pose.translation.vector + shift),
                turn * pose.rotation,
            ),
            ..camera.clone()
        }
    }

    /// With a board on the table, at the noise of three RealSense D435: any direction, any camera.
    #[test]
    fn a_calibration_wrong_by_5_mm_and_half_a_degree_is_red_and_a_right_one_green() {
        let cameras = Camera::ravens();
        let mut rng = ChaCha8Rng::seed_from_u64(17);
        for seed in 0..4 {
            let frames = frames(&cameras, Some(&realsense(&cameras, seed)), 10, true);
            assert_eq!(faults(&cameras, &frames), Vec::<String>::new(), "{seed}");
            // What sctn calibrate leaves at that noise.
            let right = cameras
                .each_ref()
                .map(|camera| off(camera, 0.5e-3, 0.05f64.to_radians(), &mut rng));
            assert_eq!(faults(&right, &frames), Vec::<String>::new(), "{seed}");
            for index in 0..cameras.len() {
                for _ in 0..3 {
                    let mut wrong = cameras.clone();
                    wrong[index] = off(&cameras[index], 5e-3, 0.5f64.to_radians(), &mut rng);
                    let found = of_cameras(faults(&wrong, &frames));
                    let name = &cameras[index].name;
                    assert!(!found.is_empty(), "{seed} {name}");
                    // Nobody else is blamed.
                    let is_named = |fault: &String| fault.contains(name.as_str());
                    assert!(found.iter().all(is_named), "{seed} {name}: {found:?}");
                }
            }
        }
    }

    #[test]
    fn a_camera_that_stands_aside_is_found_by_the_board_alone() {
        let cameras = Camera::ravens();
        let mut aside = cameras.clone();
        aside[0].world_from_camera.translation.y += 0.005;
        let noise = realsense(&cameras, 2);
        let without = frames(&cameras, Some(&noise), 10, false);
        assert_eq!(of_cameras(faults(&aside, &without)), Vec::<String>::new());
        let with = frames(&cameras, Some(&noise), 10, true);
        let found = of_cameras(faults(&aside, &with));
        assert_eq!(found, ["board front and left", "board front and right"]);
    }

    #[test]
    fn a_cell_without_median_is_measured_from_single_sets_of_images() {
        let cameras = Camera::ravens();
        let frames = frames(&cameras, None, 2, false);
        let measures = check_cameras(
            &cameras,
            &frames,
            &Workspace::RAVENS,
            None,
            &Board::A4,
            &CheckLimits::default(),
        );
        assert!(measures.unwrap().iter().all(Measure::is_good));
    }

    #[test]
    fn too_few_frames_are_an_error_and_what_cannot_be_measured_is_red() {
        let cameras = Camera::ravens();
        let none = vec![Vec::new(); 3];
        let refusal = check_cameras(
            &cameras,
            &none,
            &Workspace::RAVENS,
            None,
            &Board::A4,
            &CheckLimits::default(),
        );
        assert!(refusal.unwrap_err().to_string().contains("camera front"));
        let blind = Frame {
            rgb: vec![0; 3 * 640 * 480],
            depth_m: vec![0.0; 640 * 480],
        };
        let measures = measures(&cameras, &vec![vec![blind; 10]; 3]);
        let bad: Vec<_> = measures
            .iter()
            .filter(|measure| !measure.is_good())
            .map(|measure| measure.name)
            .collect();
        assert!(
            ["tilt", "height", "offset", "fill", "noise"]
                .iter()
                .all(|name| bad.contains(name)),
            "{bad:?}"
        );
    }
}
