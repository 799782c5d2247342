//! Meshes of convex faces.

use nalgebra::{Point3, Vector3};

/// A closed or open surface of flat convex faces, in metres in its own frame. Faces are seen from
/// their outer side only, the side from which their corners run counter-clockwise.
///
/// A face may have any number of corners: the cap of a cylinder is one face, not a fan of triangles.
#[derive(Clone, Debug)]
pub struct Mesh {
    pub(super) vertices: Vec<Point3<f64>>,
    pub(super) faces: Vec<Face>,
    /// Indices into `vertices`, face after face.
    pub(super) corners: Vec<u32>,
    /// Radius of the sphere about the frame's origin that holds every vertex.
    pub(super) radius_m: f64,
}

/// A flat convex polygon.
#[derive(Clone, Debug)]
pub(super) struct Face {
    /// Outward unit normal.
    pub normal: Vector3<f64>,
    /// Distance of the plane from the origin, along the normal.
    pub offset_m: f64,
    /// Where in `Mesh::corners` the face begins.
    pub first: usize,
    /// Number of corners.
    pub count: usize,
}

/// Why vertices and faces do not make a mesh.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum MeshError {
    /// A face names a vertex that does not exist.
    #[error("face {face} names vertex {vertex}, but there are {vertices} vertices")]
    Index {
        /// Index of the face.
        face: usize,
        /// The vertex it names.
        vertex: usize,
        /// Number of vertices.
        vertices: usize,
    },
    /// A face is no flat convex polygon with an area.
    #[error("face {face} is not {expected}")]
    Face {
        /// Index of the face.
        face: usize,
        /// What was expected.
        expected: &'static str,
    },
    /// A vertex has a coordinate that is not finite.
    #[error("vertex {vertex} is not finite")]
    NotFinite {
        /// Index of the vertex.
        vertex: usize,
    },
}

impl Mesh {
    /// Makes a mesh from vertices and from faces that list their corners counter-clockwise as seen
    /// from outside.
    pub fn new<F: AsRef<[usize]>>(
        vertices: Vec<Point3<f64>>,
        faces: impl IntoIterator<Item = F>,
    ) -> Result<Self, MeshError> {
        if let Some(vertex) = vertices
            .iter()
            .position(|v| !v.iter().all(|c| c.is_finite()))
        {
            return Err(MeshError::NotFinite { vertex });
        }
        let radius_m = vertices.iter().map(|v| v.coords.norm()).fold(0.0, f64::max);
        let mut mesh = Self {
            vertices,
            faces: Vec::new(),
            corners: Vec::new(),
            radius_m,
        };
        for face in faces {
            mesh.push(face.as_ref())?;
        }
        Ok(mesh)
    }

    fn push(&mut self, corners: &[usize]) -> Result<(), MeshError> {
        let face = self.faces.len();
        let vertices = self.vertices.len();
        if let Some(&vertex) = corners.iter().find(|&&vertex| vertex >= vertices) {
            return Err(MeshError::Index {
                face,
                vertex,
                vertices,
            });
        }
        let count = corners.len();
        let at = |corner: usize| self.vertices[corners[corner % count]].coords;
        // Newell's sum: twice the area along the normal.
        let area = (0..count).fold(Vector3::zeros(), |sum, i| sum + at(i).cross(&at(i + 1)));
        let Some(normal) = area.try_normalize(0.0) else {
            let expected = "a polygon with an area";
            return Err(MeshError::Face { face, expected });
        };
        let offset_m = (0..count).map(|i| at(i).dot(&normal)).sum::<f64>() / count as f64;
        let tolerance_m = 1e-9 * self.radius_m;
        if (0..count).any(|i| (at(i).dot(&normal) - offset_m).abs() > tolerance_m) {
            let expected = "flat";
            return Err(MeshError::Face { face, expected });
        }
        let turns_left = |i: usize| {
            let (before, after) = (at(i + 1) - at(i), at(i + 2) - at(i + 1));
            before.cross(&after).dot(&normal) > 0.0
        };
        if !(0..count).all(turns_left) {
            let expected = "convex";
            return Err(MeshError::Face { face, expected });
        }
        self.faces.push(Face {
            normal,
            offset_m,
            first: self.corners.len(),
            count,
        });
        self.corners
            .extend(corners.iter().map(|&corner| corner as u32));
        Ok(())
    }

    /// For the shapes below, whose faces are right by construction.
    fn built(vertices: Vec<Point3<f64>>, faces: Vec<Vec<usize>>) -> Self {
        Self::new(vertices, faces).expect("sizes are finite and positive")
    }

    /// A box about the origin with the given edge lengths, all positive.
    pub fn cuboid(size_m: Vector3<f64>) -> Self {
        let half = size_m / 2.0;
        let corner = |i: usize| {
            let side = |bit: usize| if i >> bit & 1 == 1 { 1.0 } else { -1.0 };
            Point3::new(half.x * side(0), half.y * side(1), half.z * side(2))
        };
        let faces = [
            [0, 4, 6, 2],
            [1, 3, 7, 5],
            [0, 1, 5, 4],
            [2, 6, 7, 3],
            [0, 2, 3, 1],
            [4, 5, 7, 6],
        ];
        Self::built(
            (0..8).map(corner).collect(),
            faces.iter().map(|face| face.to_vec()).collect(),
        )
    }

    /// A cylinder about the origin whose axis is z, as a prism of at least three sides.
    pub fn cylinder(radius_m: f64, height_m: f64, segments: usize) -> Self {
        let profile = [(radius_m, -height_m / 2.0), (radius_m, height_m / 2.0)];
        Self::revolve(&profile, segments)
    }

    /// A sphere about the origin: `segments` around z, half as many from pole to pole.
    pub fn sphere(radius_m: f64, segments: usize) -> Self {
        Self::capsule(radius_m, 0.0, segments)
    }

    /// All points within `radius_m` of a piece of the z axis, `length_m` long about the origin.
    pub fn capsule(radius_m: f64, length_m: f64, segments: usize) -> Self {
        // An even number of rings, so that the equator is one and a sphere is as wide as it should be.
        let rings = (segments / 4).max(1) * 2;
        let ring = |i: usize, middle_m: f64| {
            let angle = std::f64::consts::PI * (i as f64 / rings as f64 - 0.5);
            let ring_m = if i == 0 || i == rings {
                0.0
            } else {
                radius_m * angle.cos()
            };
            (ring_m, middle_m + radius_m * angle.sin())
        };
        let lower = (0..=rings / 2).map(|i| ring(i, -length_m / 2.0));
        let upper = (rings / 2..=rings).map(|i| ring(i, length_m / 2.0));
        let mut profile: Vec<_> = lower.chain(upper).collect();
        profile.dedup();
        Self::revolve(&profile, segments)
    }

    /// Turns a profile of (radius, z), z rising, about the z axis. Radius 0 is allowed at the ends,
    /// where it makes a tip; otherwise the ends are closed by caps.
    pub fn revolve(profile_m: &[(f64, f64)], segments: usize) -> Self {
        let mut vertices = Vec::new();
        // First vertex and number of vertices of each ring.
        let mut rings = Vec::new();
        for &(radius_m, z_m) in profile_m {
            let count = if radius_m == 0.0 { 1 } else { segments };
            rings.push((vertices.len(), count));
            vertices.extend((0..count).map(|i| {
                let angle = std::f64::consts::TAU * i as f64 / count as f64;
                Point3::new(radius_m * angle.cos(), radius_m * angle.sin(), z_m)
            }));
        }
        let mut faces = Vec::new();
        for pair in rings.windows(2) {
            let ((low, low_count), (high, high_count)) = (pair[0], pair[1]);
            for i in 0..segments {
                let next = (i + 1) % segments;
                let mut face = vec![low + i % low_count];
                if low_count > 1 {
                    face.push(low + next);
                }
                if high_count > 1 {
                    face.push(high + next);
                }
                face.push(high + i % high_count);
                faces.push(face);
            }
        }
        if let (Some(&(low, low_count)), Some(&(high, high_count))) = (rings.first(), rings.last())
        {
            if low_count > 1 {
                faces.push((low..low + low_count).rev().collect());
            }
            if high_count > 1 {
                faces.push((high..high + high_count).collect());
            }
        }
        Self::built(vertices, faces)
    }

    /// Number of triangles that the faces would make.
    pub fn triangle_count(&self) -> usize {
        self.faces.iter().map(|face| face.count - 2).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;
    use std::f64::consts::PI;

    /// Six times the volume is the sum over the triangles of the faces.
    fn volume_m3(mesh: &Mesh) -> f64 {
        let volume = |face: &Face| {
            let corner = |i: usize| mesh.vertices[mesh.corners[face.first + i] as usize].coords;
            let triangles =
                (1..face.count - 1).map(|i| corner(0).dot(&corner(i).cross(&corner(i + 1))));
            triangles.sum::<f64>()
        };
        mesh.faces.iter().map(volume).sum::<f64>() / 6.0
    }

    /// Each edge is walked once in either direction.
    fn is_closed(mesh: &Mesh) -> bool {
        let mut edges = BTreeMap::new();
        for face in &mesh.faces {
            let corners = &mesh.corners[face.first..][..face.count];
            for (i, &from) in corners.iter().enumerate() {
                *edges
                    .entry((from, corners[(i + 1) % face.count]))
                    .or_insert(0) += 1;
            }
        }
        edges
            .iter()
            .all(|(&(a, b), &count)| count == 1 && edges.get(&(b, a)) == Some(&1))
    }

    #[test]
    fn shapes_are_closed_and_as_large_as_they_should_be() {
        let (r, h) = (0.03, 0.08);
        let ball = 4.0 / 3.0 * PI * r * r * r;
        let rod = PI * r * r * h;
        let shapes = [
            (Mesh::cuboid(Vector3::new(0.1, 0.2, 0.3)), 0.006, 8),
            (Mesh::cylinder(r, h, 200), rod, 400),
            (Mesh::sphere(r, 200), ball, 2 + 99 * 200),
            (Mesh::capsule(r, h, 200), ball + rod, 2 + 100 * 200),
        ];
        for (mesh, expected_m3, vertices) in shapes {
            assert!(is_closed(&mesh));
            let volume_m3 = volume_m3(&mesh);
            assert!(
                (volume_m3 / expected_m3 - 1.0).abs() < 1e-3,
                "{volume_m3}, {expected_m3}"
            );
            assert_eq!(mesh.vertices.len(), vertices);
        }
    }

    #[test]
    fn coarse_shapes_are_as_wide_and_as_high_as_fine_ones() {
        for segments in [3, 4, 5, 6, 7, 8, 12, 13] {
            for (mesh, half_m) in [
                (Mesh::sphere(0.1, segments), 0.1),
                (Mesh::capsule(0.1, 0.2, segments), 0.2),
                (Mesh::cylinder(0.1, 0.3, segments), 0.15),
            ] {
                assert!(is_closed(&mesh), "{segments}");
                let reach = |part: fn(&Point3<f64>) -> f64| {
                    mesh.vertices.iter().map(part).fold(0.0, f64::max)
                };
                assert!((reach(|v| v.x) - 0.1).abs() < 1e-12, "{segments}");
                assert!((reach(|v| v.z) - half_m).abs() < 1e-12, "{segments}");
            }
        }
    }
}
