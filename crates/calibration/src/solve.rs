//! Poses of the cameras from many views of the board.

use crate::BoardView;
use crate::planar::{moved, project};
use heightmap::Intrinsics;
use nalgebra::{
    DMatrix, DVector, Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3,
};

/// One image of the board at the tool.
#[derive(Clone, Debug)]
pub struct View {
    /// Which of the tool's poses it was taken at.
    pub pose: usize,
    /// What it shows.
    pub board: BoardView,
}

/// The images of one camera.
#[derive(Clone, Debug)]
pub struct CameraViews {
    /// Name of the camera.
    pub name: String,
    /// Its intrinsics.
    pub intrinsics: Intrinsics,
    /// Images that show the board.
    pub views: Vec<View>,
}

/// Where a camera stands.
#[derive(Clone, Debug)]
pub struct CalibratedCamera {
    /// Name of the camera.
    pub name: String,
    /// Pose of its optical frame in the world.
    pub world_from_camera: Isometry3<f64>,
    /// Root mean square of its reprojection errors.
    pub rms_px: f64,
    /// The same at the distance of the board.
    pub rms_m: f64,
    /// Standard deviation of its position, from the residuals.
    pub position_sigma_m: f64,
    /// Standard deviation of its orientation, from the residuals.
    pub rotation_sigma_rad: f64,
    /// Views used.
    pub views: usize,
    /// Poses of the tool whose view did not fit.
    pub left_out: Vec<usize>,
}

/// What the views say.
#[derive(Clone, Debug)]
pub struct Calibration {
    /// The cameras, in the order given.
    pub cameras: Vec<CalibratedCamera>,
    /// Pose of the board in the frame of the tool.
    pub tool_from_board: Isometry3<f64>,
}

/// Why there is no calibration.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[allow(missing_docs, reason = "each message names its fields")]
pub enum CalibrationError {
    /// Some cameras see too little.
    #[error(
        "the board is seen by {} only: {} of the poses for camera {camera}, expected {LEAST_VIEWS} or more for each camera",
        seen_by.join(", "), views
    )]
    NotSeen {
        camera: String,
        views: usize,
        seen_by: Vec<String>,
    },
    /// The tool only turned about one axis.
    #[error(
        "the poses of the tool turn the board by {turn_deg:.1} degrees about a second axis, expected {LEAST_TURN_DEG} or more: tilt it in two directions"
    )]
    OneAxis { turn_deg: f64 },
    /// Images and poses contradict each other.
    #[error(
        "the images of camera {camera} and the poses of the tool differ by {rms_mm:.1} mm, expected {MOST_MM} mm or less: joint positions or kinematics of \
         another robot, another board, or a board that slipped"
    )]
    DoesNotFit { camera: String, rms_mm: f64 },
    /// Cameras stand where others should.
    #[error(
        "cameras {first} and {second} are swapped: {first} stands {apart_mm:.0} mm from where {second} was, and {off_mm:.0} mm from its own place; \
         expected each topic to come from its own camera"
    )]
    Swapped {
        first: String,
        second: String,
        apart_mm: f64,
        off_mm: f64,
    },
    /// The board on the table is not level.
    #[error(
        "the table is tilted by {tilt_deg:.2} degrees against the robot's base, expected {most_deg} or less: level it, or turn the cell's frames"
    )]
    TiltedTable { tilt_deg: f64, most_deg: f64 },
}

/// Views that each camera needs.
const LEAST_VIEWS: usize = 6;
/// Turn about the axis least turned about but one, root mean square over pairs of poses.
const LEAST_TURN_DEG: f64 = 6.0;
/// Largest residual, in mm at the board.
const MOST_MM: f64 = 2.0;
/// Share of a camera's views that may be left out.
const MOST_LEFT_OUT: f64 = 0.4;

/// Poses of cameras and board. `world_from_tool` holds the poses that views refer to.
///
/// # Errors
/// When views are too few, too much alike or contradict the poses; the message names the camera.
pub fn solve(
    cameras: &[CameraViews],
    world_from_tool: &[Isometry3<f64>],
) -> Result<Calibration, CalibrationError> {
    for camera in cameras {
        if camera.views.len() < LEAST_VIEWS {
            let seen = cameras
                .iter()
                .filter(|other| other.views.len() >= LEAST_VIEWS);
            let mut seen_by: Vec<String> = seen.map(|other| other.name.clone()).collect();
            if seen_by.is_empty() {
                seen_by.push("none".into());
            }
            return Err(CalibrationError::NotSeen {
                camera: camera.name.clone(),
                views: camera.views.len(),
                seen_by,
            });
        }
    }
    let pairs = pairs(cameras, world_from_tool);
    let turn_deg = second_turn(&pairs).to_degrees();
    if turn_deg < LEAST_TURN_DEG {
        return Err(CalibrationError::OneAxis { turn_deg });
    }
    let mut bundle = Bundle::start(cameras, world_from_tool, hand_eye(&pairs));
    // A view that does not fit is left out, and all is solved anew.
    for _ in 0..5 {
        bundle.minimise();
        if !bundle.leave_out() {
            break;
        }
    }
    bundle.calibration()
}

/// A motion of the tool from one pose to another, and the motion of the board that a camera saw then.
struct Pair {
    tool: Isometry3<f64>,
    board: Isometry3<f64>,
}

fn pairs(cameras: &[CameraViews], world_from_tool: &[Isometry3<f64>]) -> Vec<Pair> {
    let mut pairs = Vec::new();
    for camera in cameras {
        for (i, a) in camera.views.iter().enumerate() {
            for b in &camera.views[..i] {
                pairs.push(Pair {
                    tool: world_from_tool[a.pose].inv_mul(&world_from_tool[b.pose]),
                    board: a
                        .board
                        .camera_from_board
                        .inv_mul(&b.board.camera_from_board),
                });
            }
        }
    }
    pairs
}

/// How much the tool turned about the second of the axes that it turned about: the second root of the mean square of turns.
fn second_turn(pairs: &[Pair]) -> f64 {
    let mut spread = Matrix3::zeros();
    for pair in pairs {
        let turn = pair.tool.rotation.scaled_axis();
        spread += turn * turn.transpose() / pairs.len() as f64;
    }
    let mut values: Vec<f64> = spread.symmetric_eigenvalues().iter().copied().collect();
    values.sort_by(f64::total_cmp);
    values[1].max(0.0).sqrt()
}

/// Pose X of the board on the tool with tool * X = X * board for all pairs: rotation first (Park and Martin), then translation, pairs that do not fit
/// counting less and less.
fn hand_eye(pairs: &[Pair]) -> Isometry3<f64> {
    let mut weights = vec![1.0; pairs.len()];
    let mut rotation = UnitQuaternion::identity();
    let weigh = |weights: &mut [f64], errors: &[f64]| {
        let mut sorted = errors.to_vec();
        sorted.sort_by(f64::total_cmp);
        let scale = (2.0 * sorted[sorted.len() / 2]).max(1e-9);
        for (weight, error) in weights.iter_mut().zip(errors) {
            *weight = 1.0 / (1.0 + (error / scale).powi(4));
        }
    };
    for _ in 0..8 {
        let mut sum = Matrix3::zeros();
        for (pair, weight) in pairs.iter().zip(&weights) {
            sum += pair.tool.rotation.scaled_axis()
                * pair.board.rotation.scaled_axis().transpose()
                * *weight;
        }
        let svd = sum.svd(true, true);
        if let (Some(u), Some(v_t)) = (svd.u, svd.v_t) {
            let sign = (u * v_t).determinant().signum();
            let fixed = u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * v_t;
            rotation =
                UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(fixed));
        }
        let errors: Vec<f64> = pairs
            .iter()
            .map(|pair| {
                (pair.tool.rotation.scaled_axis() - rotation * pair.board.rotation.scaled_axis())
                    .norm()
            })
            .collect();
        weigh(&mut weights, &errors);
    }
    let mut shift = Vector3::zeros();
    weights.fill(1.0);
    for _ in 0..8 {
        // (R_tool - 1) t = R t_board - t_tool.
        let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
        let equation = |pair: &Pair| {
            let matrix = pair.tool.rotation.to_rotation_matrix().into_inner() - Matrix3::identity();
            (
                matrix,
                rotation * pair.board.translation.vector - pair.tool.translation.vector,
            )
        };
        for (pair, weight) in pairs.iter().zip(&weights) {
            let (matrix, value) = equation(pair);
            normal += matrix.transpose() * matrix * *weight;
            right += matrix.transpose() * value * *weight;
        }
        if let Some(solved) = normal.try_inverse() {
            shift = solved * right;
        }
        let errors: Vec<f64> = pairs
            .iter()
            .map(|pair| {
                let (matrix, value) = equation(pair);
                (matrix * shift - value).norm()
            })
            .collect();
        weigh(&mut weights, &errors);
    }
    Isometry3::from_parts(Translation3::from(shift), rotation)
}

/// All reprojection errors together.
struct Bundle<'a> {
    cameras: &'a [CameraViews],
    world_from_tool: &'a [Isometry3<f64>],
    tool_from_board: Isometry3<f64>,
    world_from_camera: Vec<Isometry3<f64>>,
    /// By camera and view.
    used: Vec<Vec<bool>>,
}

/// Errors beyond this count linearly only (Huber).
const HUBER_PX: f64 = 1.0;

impl<'a> Bundle<'a> {
    fn start(
        cameras: &'a [CameraViews],
        world_from_tool: &'a [Isometry3<f64>],
        tool_from_board: Isometry3<f64>,
    ) -> Self {
        let world_from_camera = cameras
            .iter()
            .map(|camera| {
                let poses: Vec<Isometry3<f64>> = camera
                    .views
                    .iter()
                    .map(|view| {
                        world_from_tool[view.pose]
                            * tool_from_board
                            * view.board.camera_from_board.inverse()
                    })
                    .collect();
                // The one that the others are nearest to.
                let far = |a: &Isometry3<f64>, b: &Isometry3<f64>| {
                    (a.translation.vector - b.translation.vector)
                        .norm()
                        .min(1.0)
                        + a.rotation.angle_to(&b.rotation).min(1.0)
                };
                let sum =
                    |pose: &Isometry3<f64>| poses.iter().map(|other| far(pose, other)).sum::<f64>();
                let best = poses.iter().min_by(|a, b| sum(a).total_cmp(&sum(b)));
                best.copied().unwrap_or_else(Isometry3::identity)
            })
            .collect();
        let used = cameras.iter().map(|camera| vec![true; camera.views.len()]);
        Self {
            cameras,
            world_from_tool,
            tool_from_board,
            world_from_camera,
            used: used.collect(),
        }
    }

    /// Reprojection errors of one view; large where a corner is behind the camera.
    fn errors(
        &self,
        camera: usize,
        view: &View,
        world_from_camera: &Isometry3<f64>,
        tool_from_board: &Isometry3<f64>,
    ) -> Vec<[f64; 2]> {
        let pose = world_from_camera.inv_mul(&(self.world_from_tool[view.pose] * tool_from_board));
        let corners = view.board.corners.iter();
        corners
            .map(|(point, image)| {
                match project(&self.cameras[camera].intrinsics, &(pose * point)) {
                    Some(seen) => [seen.x - image.x, seen.y - image.y],
                    None => [1e3, 1e3],
                }
            })
            .collect()
    }

    fn used_views(&self) -> impl Iterator<Item = (usize, &'a View)> {
        let cameras: &'a [CameraViews] = self.cameras;
        cameras.iter().enumerate().flat_map(move |(camera, views)| {
            let used = &self.used[camera];
            let pairs = views.views.iter().zip(used);
            pairs
                .filter(|(_, used)| **used)
                .map(move |(view, _)| (camera, view))
        })
    }

    /// Normal equations with Huber's weights, and the cost.
    fn equations(&self) -> (DMatrix<f64>, DVector<f64>, f64) {
        const STEP: f64 = 1e-6;
        let count = 6 * (1 + self.cameras.len());
        let (mut normal, mut right, mut cost) =
            (DMatrix::zeros(count, count), DVector::zeros(count), 0.0);
        for (camera, view) in self.used_views() {
            let (at, board) = (&self.world_from_camera[camera], &self.tool_from_board);
            let errors = self.errors(camera, view, at, board);
            let slopes: Vec<Vec<[f64; 2]>> = (0..12)
                .map(|k| {
                    let difference = |sign: f64| {
                        let mut step = [0.0; 6];
                        step[k % 6] = sign * STEP;
                        match k < 6 {
                            true => self.errors(camera, view, at, &moved(board, &step)),
                            false => self.errors(camera, view, &moved(at, &step), board),
                        }
                    };
                    let (more, less) = (difference(1.0), difference(-1.0));
                    let pairs = more.iter().zip(&less);
                    pairs
                        .map(|(a, b)| [0, 1].map(|i| (a[i] - b[i]) / (2.0 * STEP)))
                        .collect()
                })
                .collect();
            // Board first, then the camera's.
            let column = |k: usize| if k < 6 { k } else { 6 * (1 + camera) + k - 6 };
            for (i, error) in errors.iter().enumerate() {
                let size = error[0].hypot(error[1]);
                let weight = if size > HUBER_PX {
                    HUBER_PX / size
                } else {
                    1.0
                };
                cost += if size > HUBER_PX {
                    HUBER_PX * (2.0 * size - HUBER_PX)
                } else {
                    size * size
                };
                for axis in 0..2 {
                    for k in 0..12 {
                        let slope = slopes[k][i][axis];
                        right[column(k)] -= weight * slope * error[axis];
                        for l in 0..12 {
                            normal[(column(k), column(l))] += weight * slope * slopes[l][i][axis];
                        }
                    }
                }
            }
        }
        (normal, right, cost)
    }

    fn cost(&self) -> f64 {
        self.used_views()
            .map(|(camera, view)| {
                let errors = self.errors(
                    camera,
                    view,
                    &self.world_from_camera[camera],
                    &self.tool_from_board,
                );
                let size = errors.iter().map(|error| error[0].hypot(error[1]));
                size.map(|size| {
                    if size > HUBER_PX {
                        HUBER_PX * (2.0 * size - HUBER_PX)
                    } else {
                        size * size
                    }
                })
                .sum::<f64>()
            })
            .sum()
    }

    /// Levenberg-Marquardt.
    fn minimise(&mut self) {
        let mut damping = 1e-4;
        let (mut normal, mut right, mut cost) = self.equations();
        for _ in 0..60 {
            let damped = &normal + DMatrix::from_diagonal(&(normal.diagonal() * damping));
            let Some(step) = damped.cholesky().map(|factors| factors.solve(&right)) else {
                damping *= 10.0;
                continue;
            };
            let before = (self.tool_from_board, self.world_from_camera.clone());
            self.tool_from_board = moved(&self.tool_from_board, &step.as_slice()[..6]);
            for (camera, pose) in self.world_from_camera.iter_mut().enumerate() {
                *pose = moved(pose, &step.as_slice()[6 * (camera + 1)..]);
            }
            let next = self.cost();
            if next < cost {
                let done = cost - next < 1e-9 * cost;
                damping = (damping * 0.1).max(1e-12);
                (normal, right, cost) = self.equations();
                if done {
                    break;
                }
            } else {
                (self.tool_from_board, self.world_from_camera) = before;
                damping *= 10.0;
                if damping > 1e9 {
                    break;
                }
            }
        }
    }

    /// Root mean square of a view's errors, in pixels.
    fn view_rms(&self, camera: usize, view: &View) -> f64 {
        let errors = self.errors(
            camera,
            view,
            &self.world_from_camera[camera],
            &self.tool_from_board,
        );
        let sum: f64 = errors
            .iter()
            .map(|error| error[0] * error[0] + error[1] * error[1])
            .sum();
        (sum / errors.len() as f64).sqrt()
    }

    /// Leaves out views far worse than the median; whether the choice has changed.
    fn leave_out(&mut self) -> bool {
        let rms: Vec<Vec<f64>> = (0..self.cameras.len())
            .map(|camera| {
                self.cameras[camera]
                    .views
                    .iter()
                    .map(|view| self.view_rms(camera, view))
                    .collect()
            })
            .collect();
        let mut all: Vec<f64> = rms.iter().flatten().copied().collect();
        all.sort_by(f64::total_cmp);
        let limit = (3.0 * all[all.len() / 2]).max(0.3);
        let used: Vec<Vec<bool>> = rms
            .iter()
            .map(|views| views.iter().map(|rms| *rms <= limit).collect())
            .collect();
        let changed = used != self.used;
        self.used = used;
        changed
    }

    fn calibration(&self) -> Result<Calibration, CalibrationError> {
        let (normal, _, _) = self.equations();
        let inverse = normal.try_inverse();
        let mut squares = 0.0;
        let mut count = 0usize;
        for (camera, view) in self.used_views() {
            squares += self.view_rms(camera, view).powi(2) * view.board.corners.len() as f64;
            count += view.board.corners.len();
        }
        // Per coordinate.
        let freedom = (2 * count)
            .saturating_sub(6 * (1 + self.cameras.len()))
            .max(1);
        let variance = squares / freedom as f64;
        let mut cameras = Vec::new();
        for (index, camera) in self.cameras.iter().enumerate() {
            let (mut squares, mut squares_m, mut corners, mut views) = (0.0, 0.0, 0usize, 0usize);
            let mut left_out = Vec::new();
            // Of all views: a robot that fits none of them must not pass by the few that it fits by chance.
            let mut all_m = Vec::new();
            for (view, used) in camera.views.iter().zip(&self.used[index]) {
                let rms_px = self.view_rms(index, view);
                let distance_m = view.board.camera_from_board.translation.vector.norm();
                let rms_m = rms_px * distance_m / camera.intrinsics.fx_px;
                all_m.push(rms_m);
                if !used {
                    left_out.push(view.pose);
                    continue;
                }
                let weight = view.board.corners.len();
                squares += rms_px.powi(2) * weight as f64;
                squares_m += rms_m.powi(2) * weight as f64;
                corners += weight;
                views += 1;
            }
            let rms_m = (squares_m / corners.max(1) as f64).sqrt();
            let too_few = (left_out.len() as f64) > MOST_LEFT_OUT * camera.views.len() as f64;
            if too_few || 1e3 * rms_m > MOST_MM {
                all_m.sort_by(f64::total_cmp);
                let rms_mm = 1e3 * rms_m.max(all_m[(all_m.len() * 3) / 4]);
                return Err(CalibrationError::DoesNotFit {
                    camera: camera.name.clone(),
                    rms_mm,
                });
            }
            let sigma = |from: usize| {
                inverse.as_ref().map_or(f64::INFINITY, |inverse| {
                    let sum: f64 = (from..from + 3).map(|k| inverse[(k, k)]).sum();
                    (variance * sum).sqrt()
                })
            };
            cameras.push(CalibratedCamera {
                name: camera.name.clone(),
                world_from_camera: self.world_from_camera[index],
                rms_px: (squares / corners.max(1) as f64).sqrt(),
                rms_m,
                position_sigma_m: sigma(6 * (1 + index)),
                rotation_sigma_rad: sigma(6 * (1 + index) + 3),
                views,
                left_out,
            });
        }
        Ok(Calibration {
            cameras,
            tool_from_board: self.tool_from_board,
        })
    }
}

/// Refuses cameras that stand nearer to the place that another was known to have than to their own. `known` are poses by camera name, of the URDF
/// for instance.
///
/// # Errors
/// Names both cameras.
pub fn check_swapped(
    calibration: &Calibration,
    known: &[(String, Isometry3<f64>)],
) -> Result<(), CalibrationError> {
    let place = |name: &str| known.iter().find(|(other, _)| other == name);
    for camera in &calibration.cameras {
        let Some((_, own)) = place(&camera.name) else {
            continue;
        };
        let far = |pose: &Isometry3<f64>| {
            (pose.translation.vector - camera.world_from_camera.translation.vector).norm()
        };
        let others = known.iter().filter(|(name, _)| *name != camera.name);
        let nearest = others.min_by(|a, b| far(&a.1).total_cmp(&far(&b.1)));
        if let Some((other, pose)) = nearest
            && far(pose) < 0.5 * far(own)
        {
            return Err(CalibrationError::Swapped {
                first: camera.name.clone(),
                second: other.clone(),
                apart_mm: 1e3 * far(pose),
                off_mm: 1e3 * far(own),
            });
        }
    }
    Ok(())
}

/// How a board lies that lies on the table.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Table {
    /// Angle of its normal and the world's z.
    pub tilt_rad: f64,
    /// Height of its middle.
    pub height_m: f64,
}

/// The table from views of a board on it, by calibrated cameras: poses in the world and what each shows, of the same board.
///
/// # Errors
/// When it is tilted by more than `most_rad`.
pub fn table(
    views: &[(Isometry3<f64>, &BoardView)],
    most_rad: f64,
) -> Result<Option<Table>, CalibrationError> {
    let mut normals = Vector3::zeros();
    let mut heights = Vec::new();
    for (world_from_camera, view) in views {
        let pose = world_from_camera * view.camera_from_board;
        // z points into the board.
        normals -= pose.rotation * Vector3::z();
        let middle = view
            .corners
            .iter()
            .fold(Vector3::zeros(), |sum, (point, _)| sum + point.coords)
            / view.corners.len() as f64;
        heights.push((pose * nalgebra::Point3::from(middle)).z);
    }
    if heights.is_empty() {
        return Ok(None);
    }
    let tilt_rad = normals.normalize().z.clamp(-1.0, 1.0).acos();
    if tilt_rad > most_rad {
        return Err(CalibrationError::TiltedTable {
            tilt_deg: tilt_rad.to_degrees(),
            most_deg: most_rad.to_degrees(),
        });
    }
    let height_m = heights.iter().sum::<f64>() / heights.len() as f64;
    Ok(Some(Table { tilt_rad, height_m }))
}
