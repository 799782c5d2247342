//! The rasteriser.

use super::{Mesh, Scene};
use heightmap::{Camera, CameraError, Intrinsics, View};
use nalgebra::{Isometry3, Matrix3, Point3, Vector3};

/// Nearer than this nothing is drawn, as in Ravens.
pub const NEAR_M: f64 = 0.01;
/// Farther than this nothing is drawn, as in Ravens.
pub const FAR_M: f64 = 10.0;

const AMBIENT: f64 = 0.74;
const DIFFUSE: f64 = 0.3;

/// Why a scene was not drawn.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum RenderError {
    /// A buffer has another size than the camera's image.
    #[error("camera {camera}: the {what} buffer has {actual} elements, expected {expected}")]
    Size {
        /// Name of the camera.
        camera: String,
        /// Which buffer.
        what: &'static str,
        /// Elements found.
        actual: usize,
        /// Elements expected.
        expected: usize,
    },
    /// The camera cannot take pictures.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// Pictures are rendered through a pinhole.
    #[error("camera {camera} has a lens with distortion, expected a pinhole")]
    Lens {
        /// Name of the camera.
        camera: String,
    },
    /// An instance shows a mesh of another scene.
    #[error("instance {instance} shows a mesh that the scene does not have")]
    Mesh {
        /// Index of the instance.
        instance: usize,
    },
    /// An instance is nowhere.
    #[error("the pose of instance {instance} is not finite")]
    Pose {
        /// Index of the instance.
        instance: usize,
    },
}

/// One RGB-D image.
#[derive(Clone, Debug, PartialEq)]
pub struct RgbdImage {
    /// Row-major, three bytes a pixel.
    pub rgb: Vec<u8>,
    /// Row-major distance along the optical axis; 0 where nothing was hit.
    pub depth_m: Vec<f32>,
}

impl RgbdImage {
    /// A black image without depth, of the size that the intrinsics say.
    pub fn new(intrinsics: &Intrinsics) -> Self {
        let len = intrinsics.width * intrinsics.height;
        Self {
            rgb: vec![0; 3 * len],
            depth_m: vec![0.0; len],
        }
    }

    /// The image as a view for fusion.
    pub fn view<'a>(&'a self, camera: &'a Camera) -> View<'a> {
        View {
            camera,
            rgb: &self.rgb,
            depth_m: &self.depth_m,
        }
    }
}

/// Draws scenes face by face in horizontal spans with a depth buffer. Owns its scratch memory, so
/// that a frame allocates nothing once the largest has been drawn.
///
/// Pixel (u, v) shows what the ray through image point (u, v) hits, as in ROS: pixel centres have
/// whole coordinates. Plain IEEE operations in a fixed order: the same bits in every build.
#[derive(Clone, Debug, Default)]
pub struct Rasteriser {
    /// Colour of each pixel, 0x00bbggrr.
    color: Vec<u32>,
    /// 0, 1, 2, ...
    ramp: Vec<f32>,
    vertices: Vec<Vertex>,
    /// The face at hand on the image, clipped.
    outline: Vec<Image>,
    spans: Spans,
}

/// A vertex before the camera.
#[derive(Clone, Copy, Debug)]
struct Vertex {
    /// In the optical frame.
    position: Point3<f64>,
    /// On the image; meaningless unless the vertex is beyond the near plane.
    image: Image,
}

/// A point on the image.
#[derive(Clone, Copy, Debug)]
struct Image {
    u_px: f64,
    v_px: f64,
}

impl Vertex {
    fn new(position: Point3<f64>, intrinsics: &Intrinsics) -> Self {
        let image = Image {
            u_px: intrinsics.fx_px * position.x / position.z + intrinsics.cx_px,
            v_px: intrinsics.fy_px * position.y / position.z + intrinsics.cy_px,
        };
        Self { position, image }
    }
}

/// Inverse depth as a linear function of the image point: exact for a plane.
#[derive(Clone, Copy, Debug)]
struct InverseDepth {
    per_u: f64,
    per_v: f64,
    at_origin: f64,
}

impl InverseDepth {
    /// Of the plane `normal . p = offset_m` in the optical frame.
    fn of_plane(normal: &Vector3<f64>, offset_m: f64, intrinsics: &Intrinsics) -> Self {
        let per_u = normal.x / (intrinsics.fx_px * offset_m);
        let per_v = normal.y / (intrinsics.fy_px * offset_m);
        let at_origin = normal.z / offset_m - per_u * intrinsics.cx_px - per_v * intrinsics.cy_px;
        Self {
            per_u,
            per_v,
            at_origin,
        }
    }
}

/// The pixels inside a convex polygon: for each row of the image the first and the one past the last.
#[derive(Clone, Debug, Default)]
struct Spans {
    left: Vec<i32>,
    right: Vec<i32>,
    width: f64,
    height: f64,
}

/// The first whole number that is not less than `x`; quicker than a call of ceil, for `x` from -1.
fn ceil(x: f64) -> i32 {
    let whole = x as i32;
    whole + i32::from(x > f64::from(whole))
}

impl Spans {
    fn resize(&mut self, width: usize, height: usize) {
        // Cleared, so that no span of a wider image is left.
        for side in [&mut self.left, &mut self.right] {
            side.clear();
            side.resize(height, 0);
        }
        self.width = width as f64;
        self.height = height as f64;
    }

    /// Where the line from `high` to `low` crosses each row of pixel centres: `side[v]` becomes the
    /// first pixel to the right of it. Faces that share an edge agree on it bit for bit, so that
    /// between them no pixel is left out or drawn twice.
    fn cross(side: &mut [i32], high: Image, low: Image, width: f64, height: f64) {
        let first = ceil(high.v_px.clamp(0.0, height));
        let end = ceil(low.v_px.clamp(0.0, height));
        if first >= end {
            return;
        }
        let slope = (low.u_px - high.u_px) / (low.v_px - high.v_px);
        for (v, pixel) in (first..end).zip(&mut side[first as usize..end as usize]) {
            let u = high.u_px + (f64::from(v) - high.v_px) * slope;
            *pixel = ceil(u.clamp(0.0, width));
        }
    }

    /// Adds an edge of a polygon that runs counter-clockwise on the screen: down on its left.
    fn edge(&mut self, from: Image, to: Image) {
        if from.v_px < to.v_px {
            Self::cross(&mut self.left, from, to, self.width, self.height);
        } else {
            Self::cross(&mut self.right, to, from, self.width, self.height);
        }
    }

    /// The rows that a range of image points covers.
    fn rows(&self, top_px: f64, bottom_px: f64) -> std::ops::Range<usize> {
        let row = |v_px: f64| ceil(v_px.clamp(0.0, self.height)) as usize;
        row(top_px)..row(bottom_px)
    }
}

impl Rasteriser {
    /// A rasteriser for images of any size.
    pub fn new() -> Self {
        Self::default()
    }

    /// Draws `scene` as `camera` sees it. `rgb` takes three bytes a pixel, `depth_m` the distance
    /// along the optical axis, 0 where nothing was hit; both row-major, of the camera's size.
    pub fn render(
        &mut self,
        scene: &Scene,
        camera: &Camera,
        rgb: &mut [u8],
        depth_m: &mut [f32],
    ) -> Result<(), RenderError> {
        camera.check()?;
        let intrinsics = &camera.intrinsics;
        if !intrinsics.distortion.is_none() {
            return Err(RenderError::Lens {
                camera: camera.name.clone(),
            });
        }
        let (width, height) = (intrinsics.width, intrinsics.height);
        let len = width * height;
        for (what, actual, expected) in [
            ("colour", rgb.len(), 3 * len),
            ("depth", depth_m.len(), len),
        ] {
            if actual != expected {
                return Err(RenderError::Size {
                    camera: camera.name.clone(),
                    what,
                    actual,
                    expected,
                });
            }
        }
        self.color.clear();
        self.color.resize(len, pack(scene.background_rgb));
        self.ramp.clear();
        self.ramp.extend((0..width).map(|u| u as f32));
        self.spans.resize(width, height);

        // While drawing the depth image holds inverse depths. Beginning at the far plane's, it
        // clips there.
        let inverse_far = (1.0 / FAR_M) as f32;
        depth_m.fill(inverse_far);
        let camera_from_world = camera.world_from_camera.inverse();
        for (index, instance) in scene.instances.iter().enumerate() {
            let mesh = scene
                .mesh(instance.mesh)
                .ok_or(RenderError::Mesh { instance: index })?;
            let pose = &instance.world_from_mesh;
            let finite = pose.translation.vector.iter().all(|c| c.is_finite())
                && pose.rotation.coords.iter().all(|c| c.is_finite());
            if !finite {
                return Err(RenderError::Pose { instance: index });
            }
            let camera_from_mesh = camera_from_world * pose;
            let light = pose.rotation.inverse() * scene.light;
            self.draw(
                mesh,
                &camera_from_mesh,
                intrinsics,
                &Paint {
                    rgb: instance.rgb,
                    light,
                },
                depth_m,
            );
        }

        for depth in depth_m.iter_mut() {
            *depth = if *depth > inverse_far {
                1.0 / *depth
            } else {
                0.0
            };
        }
        for (rgb, color) in rgb.chunks_exact_mut(3).zip(&self.color) {
            rgb.copy_from_slice(&color.to_le_bytes()[..3]);
        }
        Ok(())
    }

    fn draw(
        &mut self,
        mesh: &Mesh,
        camera_from_mesh: &Isometry3<f64>,
        intrinsics: &Intrinsics,
        paint: &Paint,
        inverse_depth: &mut [f32],
    ) {
        let rotation: Matrix3<f64> = camera_from_mesh.rotation.to_rotation_matrix().into_inner();
        let translation = camera_from_mesh.translation.vector;
        if translation.z + mesh.radius_m < NEAR_M {
            return;
        }
        let eye = -(rotation.transpose() * translation);
        self.vertices.clear();
        self.vertices.extend(mesh.vertices.iter().map(|vertex| {
            let position = Point3::from(rotation * vertex.coords + translation);
            Vertex::new(position, intrinsics)
        }));
        for face in &mesh.faces {
            // How far the eye is before the face.
            let before_m = face.normal.dot(&eye) - face.offset_m;
            if before_m < 1e-9 {
                continue;
            }
            let corners = &mesh.corners[face.first..face.first + face.count];
            let normal = rotation * face.normal;
            let plane = InverseDepth::of_plane(&normal, -before_m, intrinsics);
            let color = paint.of_face(&face.normal);
            self.fill(corners, &plane, color, intrinsics, inverse_depth);
        }
    }

    /// Draws one face: the polygon of `self.vertices` that `corners` names.
    fn fill(
        &mut self,
        corners: &[u32],
        plane: &InverseDepth,
        color: u32,
        intrinsics: &Intrinsics,
        inverse_depth: &mut [f32],
    ) {
        // Sutherland and Hodgman's clipping, at the near plane only.
        self.outline.clear();
        let mut tail = &self.vertices[corners[corners.len() - 1] as usize];
        for &corner in corners {
            let head = &self.vertices[corner as usize];
            let (inside, was_inside) = (head.position.z >= NEAR_M, tail.position.z >= NEAR_M);
            if inside != was_inside {
                // From the same end whichever face asks.
                let (near, far) = if inside { (tail, head) } else { (head, tail) };
                let (near, far) = (near.position, far.position);
                let share = (NEAR_M - near.z) / (far.z - near.z);
                let mut cut = near + (far - near) * share;
                cut.z = NEAR_M;
                self.outline.push(Vertex::new(cut, intrinsics).image);
            }
            if inside {
                self.outline.push(head.image);
            }
            tail = head;
        }
        let Some(&last) = self.outline.last() else {
            return;
        };
        let (mut top_px, mut bottom_px) = (last.v_px, last.v_px);
        let mut from = last;
        for &to in &self.outline {
            top_px = top_px.min(to.v_px);
            bottom_px = bottom_px.max(to.v_px);
            self.spans.edge(from, to);
            from = to;
        }

        let width = intrinsics.width;
        let rows = self.spans.rows(top_px, bottom_px);
        for row in rows {
            let (left, right) = (self.spans.left[row], self.spans.right[row]);
            if left >= right {
                continue;
            }
            let (left, right) = (left as usize, right as usize);
            let start = plane.per_u * left as f64 + (plane.per_v * row as f64 + plane.at_origin);
            let pixels = row * width + left..row * width + right;
            fill_span(
                &mut inverse_depth[pixels.clone()],
                &mut self.color[pixels],
                &self.ramp,
                start as f32,
                plane.per_u as f32,
                color,
            );
        }
    }
}

/// Draws a span where it is nearer than what was there.
fn fill_span(
    inverse_depth: &mut [f32],
    colors: &mut [u32],
    ramp: &[f32],
    start: f32,
    per_u: f32,
    color: u32,
) {
    for ((old, old_color), &i) in inverse_depth.iter_mut().zip(colors).zip(ramp) {
        let new = start + per_u * i;
        let nearer = new > *old;
        *old = if nearer { new } else { *old };
        *old_color = if nearer { color } else { *old_color };
    }
}

/// What gives a face its colour.
struct Paint {
    rgb: [u8; 3],
    /// Direction to the light, in the frame of the mesh.
    light: Vector3<f64>,
}

impl Paint {
    /// A face that looks up, or nearly so, has exactly the instance's colour.
    fn of_face(&self, normal: &Vector3<f64>) -> u32 {
        let shade = (AMBIENT + DIFFUSE * normal.dot(&self.light)).min(1.0);
        pack(
            self.rgb
                .map(|channel| (f64::from(channel) * shade + 0.5) as u8),
        )
    }
}

fn pack(rgb: [u8; 3]) -> u32 {
    u32::from_le_bytes([rgb[0], rgb[1], rgb[2], 0])
}
