//! Pose of the board before one camera.

use crate::{Board, Tag};
use heightmap::Intrinsics;
use nalgebra::{
    DMatrix, DVector, Isometry3, Matrix3, Point2, Point3, Rotation3, Translation3, UnitQuaternion,
    Vector3,
};

/// What one image shows of the board.
#[derive(Clone, Debug, PartialEq)]
pub struct BoardView {
    /// Corners in the frame of the board, and where the image shows them.
    pub corners: Vec<(Point3<f64>, Point2<f64>)>,
    /// Pose of the board in the optical frame of the camera.
    pub camera_from_board: Isometry3<f64>,
    /// Root mean square of the reprojection errors.
    pub rms_px: f64,
}

/// Where the lens shows a point of the optical frame.
pub(crate) fn project(intrinsics: &Intrinsics, point: &Point3<f64>) -> Option<Point2<f64>> {
    if point.z <= 1e-6 {
        return None;
    }
    intrinsics.image(point)
}

/// A pose moved a little: by the first three numbers (m), and turned about its own origin by the last three (rad), both along the axes of the frame
/// that it is given in.
pub(crate) fn moved(pose: &Isometry3<f64>, step: &[f64]) -> Isometry3<f64> {
    let turn = UnitQuaternion::from_scaled_axis(Vector3::new(step[3], step[4], step[5]));
    let shift = Vector3::new(step[0], step[1], step[2]);
    Isometry3::from_parts(
        Translation3::from(pose.translation.vector + shift),
        turn * pose.rotation,
    )
}

/// Pose of the board from the tags seen. None where fewer than two tags of the board are seen, or they fit no pose.
pub fn board_pose(board: &Board, intrinsics: &Intrinsics, tags: &[Tag]) -> Option<BoardView> {
    let mut corners = Vec::new();
    for tag in tags {
        if let Some(points) = board.corners(tag.id) {
            corners.extend(points.into_iter().zip(tag.corners_px));
        }
    }
    let least = if board.rows * board.cols > 1 { 8 } else { 4 };
    if corners.len() < least {
        return None;
    }
    let first = pose_of_homography(intrinsics, &corners)?;
    // A board seen from afar looks much the same tilted the other way.
    let normal = first.rotation * Vector3::z();
    let sight = first.translation.vector.normalize();
    let mirrored = 2.0 * normal.dot(&sight) * sight - normal;
    let other = UnitQuaternion::rotation_between(&normal, &mirrored)
        .map(|turn| Isometry3::from_parts(first.translation, turn * first.rotation));
    [Some(first), other]
        .into_iter()
        .flatten()
        .filter_map(|pose| refine(intrinsics, &corners, pose))
        .min_by(|a, b| a.1.total_cmp(&b.1))
        .map(|(camera_from_board, rms_px)| BoardView {
            corners,
            camera_from_board,
            rms_px,
        })
}

/// From the homography between the board's plane and the ideal image.
fn pose_of_homography(
    intrinsics: &Intrinsics,
    corners: &[(Point3<f64>, Point2<f64>)],
) -> Option<Isometry3<f64>> {
    let count = corners.len() as f64;
    let center = corners
        .iter()
        .fold(Vector3::zeros(), |sum, (point, _)| sum + point.coords)
        / count;
    let size = corners
        .iter()
        .map(|(point, _)| (point.coords - center).norm())
        .fold(0.0, f64::max);
    let mut matrix = DMatrix::<f64>::zeros(2 * corners.len(), 9);
    for (i, (point, image)) in corners.iter().enumerate() {
        let ray = intrinsics.ray(image);
        if !(ray.x.is_finite() && ray.y.is_finite()) {
            return None;
        }
        let (x, y) = ((point.x - center.x) / size, (point.y - center.y) / size);
        let rows = [
            [x, y, 1.0, 0.0, 0.0, 0.0, -ray.x * x, -ray.x * y, -ray.x],
            [0.0, 0.0, 0.0, x, y, 1.0, -ray.y * x, -ray.y * y, -ray.y],
        ];
        for (j, row) in rows.iter().enumerate() {
            for (k, value) in row.iter().enumerate() {
                matrix[(2 * i + j, k)] = *value;
            }
        }
    }
    let normal = matrix.transpose() * &matrix;
    let eigen = normal.symmetric_eigen();
    let least = eigen.eigenvalues.imin();
    let h = eigen.eigenvectors.column(least);
    let mut h = Matrix3::new(h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], h[8]);
    // Before the camera.
    if h[(2, 2)] < 0.0 {
        h = -h;
    }
    let scale = 0.5 * (h.column(0).norm() + h.column(1).norm());
    let (x, y) = (h.column(0) / scale, h.column(1) / scale);
    let rotation = Matrix3::from_columns(&[x, y, x.cross(&y)]);
    let svd = rotation.svd(true, true);
    let rotation = svd.u? * svd.v_t?;
    if rotation.determinant() < 0.0 {
        return None;
    }
    let rotation =
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    let middle = h.column(2) / scale * size;
    let shift = middle - rotation * center;
    Some(Isometry3::from_parts(Translation3::from(shift), rotation))
}

/// Least squares of the reprojection errors; the pose and their root mean square.
fn refine(
    intrinsics: &Intrinsics,
    corners: &[(Point3<f64>, Point2<f64>)],
    mut pose: Isometry3<f64>,
) -> Option<(Isometry3<f64>, f64)> {
    let errors = |pose: &Isometry3<f64>| {
        let mut errors = DVector::zeros(2 * corners.len());
        for (i, (point, image)) in corners.iter().enumerate() {
            let off = project(intrinsics, &(pose * point))? - image;
            (errors[2 * i], errors[2 * i + 1]) = (off.x, off.y);
        }
        Some(errors)
    };
    let mut off = errors(&pose)?;
    let mut damping = 1e-3;
    for _ in 0..50 {
        let mut jacobian = DMatrix::zeros(off.len(), 6);
        for k in 0..6 {
            let mut step = [0.0; 6];
            step[k] = 1e-6;
            let more = errors(&moved(&pose, &step))?;
            jacobian.set_column(k, &((more - &off) / 1e-6));
        }
        let normal = jacobian.transpose() * &jacobian;
        let right = -(jacobian.transpose() * &off);
        let damped = &normal + DMatrix::from_diagonal(&(normal.diagonal() * damping));
        let step = damped.cholesky()?.solve(&right);
        let next = moved(&pose, step.as_slice());
        match errors(&next) {
            Some(next_off) if next_off.norm() < off.norm() => {
                let gain = off.norm() - next_off.norm();
                (pose, off) = (next, next_off);
                damping = (damping * 0.1).max(1e-12);
                if gain < 1e-9 * off.norm() {
                    break;
                }
            }
            _ => {
                damping *= 10.0;
                if damping > 1e6 {
                    break;
                }
            }
        }
    }
    Some((pose, off.norm() / (corners.len() as f64).sqrt()))
}
