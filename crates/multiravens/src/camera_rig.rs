//! What the cameras see: the work cell at a joint position and the bodies of a world.

use crate::colors;
use crate::render::{Mesh, MeshId, Rasteriser, RenderError, RgbdImage, Scene};
use crate::world::World;
use camera_noise::ClutterItem;
use heightmap::{Camera, View};
use nalgebra::Vector3;
use ur5::{Joints, Shape, WorkCell};

/// Edges of what approximates a circle.
const CYLINDER_SEGMENTS: usize = 32;
const BALL_SEGMENTS: usize = 12;

/// The scene, the cameras and their images, kept from frame to frame.
pub(crate) struct CameraRig {
    scene: Scene,
    cameras: Vec<Camera>,
    images: Vec<RgbdImage>,
    rasteriser: Rasteriser,
    meshes: Vec<(Shape, MeshId)>,
    /// Shown and in nobody's way.
    clutter: Vec<ClutterItem>,
}

impl CameraRig {
    pub(crate) fn new(cameras: Vec<Camera>) -> Self {
        let images = cameras.iter().map(|c| RgbdImage::new(&c.intrinsics));
        Self {
            scene: Scene::new(colors::BACKGROUND),
            images: images.collect(),
            cameras,
            rasteriser: Rasteriser::new(),
            meshes: Vec::new(),
            clutter: Vec::new(),
        }
    }

    /// Sets what a perturbation adds to the scene, until it is set again.
    pub(crate) fn perturb(&mut self, light: Vector3<f64>, clutter: Vec<ClutterItem>) {
        self.scene.light = light;
        self.clutter = clutter;
    }

    pub(crate) fn cameras(&self) -> &[Camera] {
        &self.cameras
    }

    pub(crate) fn views(&self) -> impl Iterator<Item = View<'_>> {
        self.images
            .iter()
            .zip(&self.cameras)
            .map(|(i, c)| i.view(c))
    }

    pub(crate) fn render(
        &mut self,
        work_cell: &WorkCell,
        joints: &Joints,
        world: &World,
    ) -> Result<&[RgbdImage], RenderError> {
        self.scene.instances.clear();
        for (body, pose) in work_cell.shapes(joints) {
            let mesh = self.mesh(body.shape);
            self.scene.add(mesh, pose, body.rgb);
        }
        for body in world.bodies() {
            for component in world.components(body) {
                let mesh = self.mesh(component.shape);
                let pose = world.pose(body) * component.pose;
                self.scene.add(mesh, pose, world.rgb(body));
            }
        }
        for item in self.clutter.clone() {
            let mesh = self.mesh(Shape::Cuboid {
                size_m: item.size_m,
            });
            self.scene.add(mesh, item.pose, item.rgb);
        }
        for (camera, image) in self.cameras.iter().zip(&mut self.images) {
            self.rasteriser
                .render(&self.scene, camera, &mut image.rgb, &mut image.depth_m)?;
        }
        Ok(&self.images)
    }

    /// The mesh of a shape; equal shapes share one.
    fn mesh(&mut self, shape: Shape) -> MeshId {
        if let Some((_, mesh)) = self.meshes.iter().find(|(known, _)| *known == shape) {
            return *mesh;
        }
        let mesh = self.scene.add_mesh(match shape {
            Shape::Sphere { radius_m } => Mesh::sphere(radius_m, BALL_SEGMENTS),
            Shape::Cylinder { radius_m, length_m } => {
                Mesh::cylinder(radius_m, length_m, CYLINDER_SEGMENTS)
            }
            Shape::Cuboid { size_m } => Mesh::cuboid(size_m),
        });
        self.meshes.push((shape, mesh));
        mesh
    }
}
