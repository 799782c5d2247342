//! RGB-D images of the work cell, drawn on one core without a GPU.
//!
//! ```
//! use heightmap::{Camera, Fusion, Heightmap, Workspace};
//! use multiravens::render::{Mesh, Rasteriser, RgbdImage, Scene};
//! use nalgebra::{Isometry3, Vector3};
//!
//! let mut scene = Scene::new([0, 0, 0]);
//! let cube = scene.add_mesh(Mesh::cuboid(Vector3::new(0.04, 0.04, 0.04)));
//! scene.add(cube, Isometry3::translation(0.5, 0.0, 0.02), [255, 87, 89]);
//! let camera = &Camera::ravens()[0];
//! let mut image = RgbdImage::new(&camera.intrinsics);
//! Rasteriser::new().render(&scene, camera, &mut image.rgb, &mut image.depth_m)?;
//! let mut heightmap = Heightmap::new(Workspace::RAVENS);
//! Fusion::default().fuse(&[image.view(camera)], &mut heightmap)?;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod mesh;
mod raster;
mod scene;
mod workload;

pub use mesh::{Mesh, MeshError};
pub use raster::{FAR_M, NEAR_M, Rasteriser, RenderError, RgbdImage};
pub use scene::{Instance, LIGHT, MeshId, Scene};
pub use workload::crowded_table;
