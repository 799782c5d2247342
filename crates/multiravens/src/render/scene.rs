//! What there is to see.

use super::Mesh;
use nalgebra::{Isometry3, Vector3};

/// Where the light usually comes from, in the world.
pub const LIGHT: Vector3<f64> = Vector3::new(0.3, 0.2, 0.93);

/// A mesh of a [`Scene`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct MeshId(pub(super) usize);

/// A mesh at a place, in one colour.
#[derive(Clone, Debug, PartialEq)]
pub struct Instance {
    /// Which shape.
    pub mesh: MeshId,
    /// Where it is.
    pub world_from_mesh: Isometry3<f64>,
    /// Colour of faces that look up; the others are a little darker.
    pub rgb: [u8; 3],
}

/// Meshes, shared between the instances that show them. Change `instances` freely between frames.
#[derive(Clone, Debug)]
pub struct Scene {
    meshes: Vec<Mesh>,
    /// What is shown. Of two faces at the very same depth the earlier instance is seen.
    pub instances: Vec<Instance>,
    /// Colour where nothing is hit.
    pub background_rgb: [u8; 3],
    /// Direction to the light, in the world.
    pub light: Vector3<f64>,
}

impl Scene {
    /// Nothing before the given background.
    pub fn new(background_rgb: [u8; 3]) -> Self {
        Self {
            meshes: Vec::new(),
            instances: Vec::new(),
            background_rgb,
            light: LIGHT,
        }
    }

    /// Adds a shape that instances can show.
    pub fn add_mesh(&mut self, mesh: Mesh) -> MeshId {
        self.meshes.push(mesh);
        MeshId(self.meshes.len() - 1)
    }

    /// Adds an instance; returns its index in `instances`.
    pub fn add(&mut self, mesh: MeshId, world_from_mesh: Isometry3<f64>, rgb: [u8; 3]) -> usize {
        self.instances.push(Instance {
            mesh,
            world_from_mesh,
            rgb,
        });
        self.instances.len() - 1
    }

    /// The shape behind an identifier, if it is of this scene.
    pub fn mesh(&self, id: MeshId) -> Option<&Mesh> {
        self.meshes.get(id.0)
    }

    /// Number of triangles that the faces of all instances would make.
    pub fn triangle_count(&self) -> usize {
        let meshes = self.instances.iter().filter_map(|i| self.mesh(i.mesh));
        meshes.map(Mesh::triangle_count).sum()
    }
}
