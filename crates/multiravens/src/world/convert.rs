//! The border between nalgebra (f64, public) and the engine's glam (f32).

use nalgebra::{Isometry3, Point3, Quaternion, Translation3, UnitQuaternion, Vector3};
use rapier3d::math::{Pose, Rotation, Vector};

pub(super) fn to_vector(v: &Vector3<f64>) -> Vector {
    Vector::new(v.x as f32, v.y as f32, v.z as f32)
}

pub(super) fn to_pose(pose: &Isometry3<f64>) -> Pose {
    let q = pose.rotation.coords;
    Pose::from_parts(
        to_vector(&pose.translation.vector),
        Rotation::from_xyzw(q.x as f32, q.y as f32, q.z as f32, q.w as f32).normalize(),
    )
}

pub(super) fn from_vector(v: Vector) -> Vector3<f64> {
    Vector3::new(v.x.into(), v.y.into(), v.z.into())
}

pub(super) fn from_point(v: Vector) -> Point3<f64> {
    from_vector(v).into()
}

pub(super) fn from_pose(pose: &Pose) -> Isometry3<f64> {
    let q = pose.rotation;
    let q = Quaternion::new(q.w.into(), q.x.into(), q.y.into(), q.z.into());
    Isometry3::from_parts(
        Translation3::from(from_vector(pose.translation)),
        UnitQuaternion::new_normalize(q),
    )
}
