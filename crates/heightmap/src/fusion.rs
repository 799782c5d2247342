//! Fusion of RGB-D views into a heightmap.

use crate::{Camera, CameraError, Heightmap, Intrinsics, Workspace, WorkspaceError};
use nalgebra::{Point2, Point3, Vector2, Vector3};
use std::ops::Range;

/// More views would overflow the sums of colours.
const MAX_VIEWS: usize = 128;

/// One RGB-D image and the camera that took it.
#[derive(Clone, Copy, Debug)]
pub struct View<'a> {
    /// The camera.
    pub camera: &'a Camera,
    /// Row-major, three bytes a pixel.
    pub rgb: &'a [u8],
    /// Row-major distance along the optical axis; 0 or not finite where nothing was measured.
    pub depth_m: &'a [f32],
}

/// What a fusion has used.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FusionReport {
    /// Number of views.
    pub views: usize,
    /// Share of cells that at least one view saw.
    pub coverage: f64,
}

/// Why views cannot be fused.
#[derive(Debug, thiserror::Error, PartialEq)]
#[allow(missing_docs, reason = "each message names its fields")]
pub enum FusionError {
    /// A camera cannot have taken the view.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// The heightmap to be filled covers nothing.
    #[error(transparent)]
    Workspace(#[from] WorkspaceError),
    /// An image has another size than its camera's.
    #[error("camera {camera}: {what} has {actual} elements, expected {expected}")]
    Size {
        camera: String,
        what: &'static str,
        actual: usize,
        expected: usize,
    },
    /// More views than can be summed.
    #[error("{actual} views, expected at most 128")]
    Views { actual: usize },
}

/// Fuses views; owns the scratch memory so that a fusion allocates nothing.
#[derive(Debug, Default)]
pub struct Fusion {
    /// View after view, the highest point of each cell, packed so that the maximum is one comparison:
    /// ordered bits of the height above, colour below. 0 where the view saw nothing.
    highest: Vec<u64>,
    /// Cell of each pixel of an image row, or [`OUTSIDE`].
    cells: Vec<u32>,
    /// Ordered bits of the height of each pixel of an image row.
    heights: Vec<u32>,
    /// 0, 1, 2, ...
    columns: Vec<f32>,
    /// By view, the rays of the last camera behind a lens.
    lenses: Vec<LensRays>,
}

/// Rays of the pixels of a camera, without distortion.
#[derive(Debug)]
pub(crate) struct LensRays {
    pub(crate) of: Intrinsics,
    /// x and y where z is 1, row-major; not a number where the lens shows nothing.
    pub(crate) rays: Vec<[f32; 2]>,
}

impl LensRays {
    pub(crate) fn new(of: Intrinsics) -> Self {
        let ray = |index: usize| {
            let image = Point2::new((index % of.width) as f64, (index / of.width) as f64);
            let ray = of.ray(&image);
            [ray.x as f32, ray.y as f32]
        };
        Self {
            of,
            rays: (0..of.len()).map(ray).collect(),
        }
    }
}

/// The cell of points off the grid.
pub(crate) const OUTSIDE: u32 = u32::MAX;

impl Fusion {
    /// Highest point per cell wins; colour is the mean over the views that saw the cell
    /// (Zeng et al., CoRL 2020). Overwrites `out`, whose workspace says what to cover.
    pub fn fuse(
        &mut self,
        views: &[View<'_>],
        out: &mut Heightmap,
    ) -> Result<FusionReport, FusionError> {
        out.workspace.check()?;
        for view in views {
            view.check()?;
        }
        if views.len() > MAX_VIEWS {
            return Err(FusionError::Views {
                actual: views.len(),
            });
        }
        let Heightmap {
            workspace,
            rgb,
            height_m,
        } = out;
        let len = workspace.len();
        rgb.resize(3 * len, 0);
        height_m.resize(len, 0.0);
        self.highest.clear();
        self.highest.resize(len * views.len(), 0);
        for (index, view) in views.iter().enumerate() {
            self.project(index, view, workspace);
        }
        let (view_count, mut seen) = (views.len(), 0);
        for (cell, (pixel, height_m)) in rgb.chunks_exact_mut(3).zip(height_m).enumerate() {
            let (mut highest, mut sums, mut views) = (0, [0; 3], 0);
            for view in 0..view_count {
                let key = self.highest[view * len + cell];
                highest = key.max(highest);
                let [_, red, green, blue] = (key as u32).to_be_bytes().map(u32::from);
                sums = [sums[0] + red, sums[1] + green, sums[2] + blue];
                views += u32::from(key != 0);
            }
            if views == 0 {
                pixel.fill(0);
                *height_m = 0.0;
                continue;
            }
            seen += 1;
            pixel.copy_from_slice(&mean(sums, views));
            *height_m = from_ordered((highest >> 32) as u32);
        }
        Ok(FusionReport {
            views: view_count,
            coverage: seen as f64 / len as f64,
        })
    }

    /// Finds the highest point of each cell in one view.
    fn project(&mut self, index: usize, view: &View<'_>, workspace: &Workspace) {
        let len = workspace.len();
        let highest = &mut self.highest[index * len..][..len];
        let Intrinsics {
            width,
            height,
            fx_px,
            fy_px,
            cx_px,
            cy_px,
            ..
        } = view.camera.intrinsics;
        self.cells.resize(width, 0);
        self.heights.resize(width, 0);
        self.columns.clear();
        self.columns.extend((0..width).map(|u| u as f32));
        // In units of cells, from the grid's corner; z stays in metres. A pixel (u, v) at depth d lies at
        // d (u per_column + start_of_row(v)) + origin.
        let scale = 1.0 / workspace.pixel_size_m;
        let to_cells = |v: Vector3<f64>| Vector3::new(v.x * scale, v.y * scale, v.z);
        let pose = &view.camera.world_from_camera;
        let corner = Vector3::new(workspace.origin_m.x, workspace.origin_m.y, 0.0);
        let origin = to_cells(pose.translation.vector - corner).cast::<f32>();
        let per_column =
            to_cells(pose.rotation * Vector3::new(1.0 / fx_px, 0.0, 0.0)).cast::<f32>();
        let per_row = to_cells(pose.rotation * Vector3::new(0.0, 1.0, 0.0)).cast::<f32>();
        let ahead = to_cells(pose.rotation * Vector3::new(0.0, 0.0, 1.0)).cast::<f32>();
        let beside = to_cells(pose.rotation * Vector3::new(1.0, 0.0, 0.0)).cast::<f32>();
        let (cols, rows) = (workspace.cols as f32, workspace.rows as f32);
        let (z_min_m, z_max_m) = (workspace.z_min_m as f32, workspace.z_max_m as f32);
        // Cell and ordered height of a point of this depth.
        let place = |depth_m: f32, x: f32, y: f32, z_m: f32| {
            // A depth that is not a number fails every comparison.
            let inside = (depth_m > 0.0)
                & (x >= 0.0)
                & (x < cols)
                & (y >= 0.0)
                & (y < rows)
                & (z_m >= z_min_m)
                & (z_m <= z_max_m);
            let index = whole(floor(y) * cols + floor(x));
            (if inside { index } else { OUTSIDE }, ordered(z_m))
        };
        let lens = lens(&mut self.lenses, index, &view.camera.intrinsics);
        let outline = Outline::new(view.camera, workspace);
        for v in 0..height {
            // Most pixels see only what is beside the workspace.
            let columns = outline.columns(v, width);
            let start = Vector3::new(-cx_px / fx_px, (v as f64 - cy_px) / fy_px, 1.0);
            let start = to_cells(pose.rotation * start).cast::<f32>();
            let pixels = v * width + columns.start..v * width + columns.end;
            let depths = &view.depth_m[pixels.clone()];
            // Two loops, since this one can be done for several pixels at once and the next cannot.
            let row = self.cells.iter_mut().zip(&mut self.heights).zip(depths);
            match lens {
                None => {
                    for (((cell, ordered_z), &depth_m), &u) in row.zip(&self.columns[columns]) {
                        let x = depth_m * (u * per_column.x + start.x) + origin.x;
                        let y = depth_m * (u * per_column.y + start.y) + origin.y;
                        let z_m = depth_m * (u * per_column.z + start.z) + origin.z;
                        (*cell, *ordered_z) = place(depth_m, x, y, z_m);
                    }
                }
                Some(rays) => {
                    for (((cell, ordered_z), &depth_m), [right, down]) in
                        row.zip(&rays[pixels.clone()])
                    {
                        let at = |axis: usize| {
                            let ray = right * beside[axis] + down * per_row[axis] + ahead[axis];
                            depth_m * ray + origin[axis]
                        };
                        (*cell, *ordered_z) = place(depth_m, at(0), at(1), at(2));
                    }
                }
            }
            let colors = view.rgb[3 * pixels.start..3 * pixels.end].chunks_exact(3);
            for ((&cell, &z), color) in self.cells.iter().zip(&self.heights).zip(colors) {
                if let Some(highest) = highest.get_mut(cell as usize) {
                    let color = u32::from_be_bytes([0, color[0], color[1], color[2]]);
                    *highest = ((u64::from(z) << 32) | u64::from(color)).max(*highest);
                }
            }
        }
    }
}

/// The rays of a view's camera if it is behind a lens, computed when its calibration changes.
fn lens<'a>(
    lenses: &'a mut Vec<LensRays>,
    view: usize,
    intrinsics: &Intrinsics,
) -> Option<&'a [[f32; 2]]> {
    if intrinsics.distortion.is_none() {
        return None;
    }
    while lenses.len() <= view {
        lenses.push(LensRays {
            of: Intrinsics::RAVENS,
            rays: Vec::new(),
        });
    }
    let known = &mut lenses[view];
    if known.of != *intrinsics {
        *known = LensRays::new(*intrinsics);
    }
    Some(&known.rays)
}

/// The outline of a workspace on an image without distortion.
pub(crate) struct Outline {
    /// The edges of the box, each from its upper to its lower end; none if a corner is not before the
    /// camera, or behind a lens.
    edges: Option<[(Point2<f64>, Point2<f64>); 12]>,
}

impl Outline {
    /// Far more than the rounding of a point.
    const MARGIN_M: f64 = 1e-3;

    pub(crate) fn new(camera: &Camera, workspace: &Workspace) -> Self {
        // A lens bends the edges.
        if !camera.intrinsics.distortion.is_none() {
            return Self { edges: None };
        }
        let margin = Vector3::repeat(Self::MARGIN_M);
        let size =
            workspace.pixel_size_m * Vector2::new(workspace.cols as f64, workspace.rows as f64);
        let low = workspace.origin_m.coords.push(workspace.z_min_m) - margin;
        let high = (workspace.origin_m.coords + size).push(workspace.z_max_m) + margin;
        let corner = |index: usize| {
            let side = |axis: usize| if index >> axis & 1 == 0 { low } else { high }[axis];
            let (image, depth_m) = camera.project(&Point3::new(side(0), side(1), side(2)))?;
            (depth_m > Self::MARGIN_M).then_some(image)
        };
        let edge = |number: usize| {
            let (axis, others) = (number / 4, number % 4);
            // The two bits of `others` with a 0 between them where the axis is.
            let start = (others >> axis << (axis + 1)) | (others & ((1 << axis) - 1));
            let (a, b) = (corner(start)?, corner(start | 1 << axis)?);
            Some(if a.y <= b.y { (a, b) } else { (b, a) })
        };
        let mut edges = [Default::default(); 12];
        for (number, place) in edges.iter_mut().enumerate() {
            match edge(number) {
                Some(edge) => *place = edge,
                None => return Self { edges: None },
            }
        }
        Self { edges: Some(edges) }
    }

    /// The pixels of an image row that can see the workspace.
    pub(crate) fn columns(&self, row: usize, width: usize) -> Range<usize> {
        let Some(edges) = &self.edges else {
            return 0..width;
        };
        let (v, mut first, mut last) = (row as f64, f64::INFINITY, f64::NEG_INFINITY);
        for (upper, lower) in edges
            .iter()
            .filter(|(upper, lower)| upper.y <= v && v <= lower.y)
        {
            let share = if lower.y > upper.y {
                (v - upper.y) / (lower.y - upper.y)
            } else {
                0.0
            };
            let u = upper.x + share * (lower.x - upper.x);
            // A level edge is met by those that it joins.
            (first, last) = (first.min(u), last.max(u));
        }
        // Casts clamp: what is left of the image becomes 0.
        let end = ((last.floor() + 1.0) as usize).min(width);
        (first.ceil() as usize).min(end)..end
    }
}

/// A float as large as this has no bits left for fractions.
const NO_FRACTION: f32 = (1 << 23) as f32;

/// Rounds down; for numbers from 0 to 2^22. Unlike `f32::floor` and `as` it needs nothing that
/// the oldest x86-64 lacks, so that the compiler can do several at once.
pub(crate) fn floor(x: f32) -> f32 {
    let nearest = (x + NO_FRACTION) - NO_FRACTION;
    nearest - if nearest > x { 1.0 } else { 0.0 }
}

/// A whole number from 0 to 2^22 as an integer.
pub(crate) fn whole(x: f32) -> u32 {
    (x + NO_FRACTION).to_bits() & 0x7f_ffff
}

/// Sums divided by a number of views, rounded. Multiplies by the reciprocal, which is exact for the
/// sums of up to [`MAX_VIEWS`] bytes.
pub(crate) fn mean(sums: [u32; 3], views: u32) -> [u8; 3] {
    const RECIPROCALS: [u64; MAX_VIEWS + 1] = {
        let mut reciprocals = [0; MAX_VIEWS + 1];
        let mut views = 1;
        while views <= MAX_VIEWS {
            reciprocals[views] = (1u64 << 32).div_ceil(views as u64);
            views += 1;
        }
        reciprocals
    };
    let reciprocal = RECIPROCALS[views as usize];
    sums.map(|sum| ((u64::from(sum + views / 2) * reciprocal) >> 32) as u8)
}

/// Bits of a float in the order of its value; never 0 for a finite one.
pub(crate) fn ordered(value: f32) -> u32 {
    let bits = value.to_bits();
    bits ^ (((bits as i32 >> 31) as u32) | 0x8000_0000)
}

/// The float of [`ordered`] bits.
pub(crate) fn from_ordered(bits: u32) -> f32 {
    let flip = if bits & 0x8000_0000 == 0 {
        u32::MAX
    } else {
        0x8000_0000
    };
    f32::from_bits(bits ^ flip)
}

impl View<'_> {
    pub(crate) fn check(&self) -> Result<(), FusionError> {
        self.camera.check()?;
        let Intrinsics { width, height, .. } = self.camera.intrinsics;
        let pixels = width * height;
        for (what, actual, expected) in [
            ("colour image", self.rgb.len(), 3 * pixels),
            ("depth image", self.depth_m.len(), pixels),
        ] {
            if actual != expected {
                let camera = self.camera.name.clone();
                return Err(FusionError::Size {
                    camera,
                    what,
                    actual,
                    expected,
                });
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Distortion, Pixel};
    use nalgebra::{Isometry3, Translation3, UnitQuaternion};
    use proptest::prelude::*;

    const SMALL: Intrinsics = Intrinsics {
        width: 40,
        height: 30,
        fx_px: 40.0,
        fy_px: 40.0,
        cx_px: 20.0,
        cy_px: 15.0,
        distortion: Distortion::NONE,
    };

    /// One of each model.
    fn lenses() -> [Distortion; 3] {
        [
            Distortion::plumb_bob([0.12, -0.24, 0.011, -0.007, 0.09]),
            Distortion::rational([0.52, -2.58, 0.001, -0.002, 1.49, 0.40, -2.41, 1.42]),
            Distortion::equidistant([-0.008, 0.045, -0.042, 0.008]),
        ]
    }

    /// Looks straight down from a metre above a point; the image's x runs along the world's x.
    fn above(x_m: f64, y_m: f64) -> Camera {
        let down = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
        let world_from_camera = Isometry3::from_parts(Translation3::new(x_m, y_m, 1.0), down);
        Camera {
            name: "above".into(),
            intrinsics: SMALL,
            world_from_camera,
        }
    }

    fn images(depth_m: f32, rgb: [u8; 3]) -> (Vec<u8>, Vec<f32>) {
        let pixels = SMALL.width * SMALL.height;
        (rgb.repeat(pixels), vec![depth_m; pixels])
    }

    /// The definition, point by point in double precision.
    fn reference(views: &[View<'_>], workspace: Workspace) -> Heightmap {
        let mut out = Heightmap::new(workspace);
        let mut sums = vec![[0u32; 4]; workspace.len()];
        for view in views {
            let mut highest: Vec<Option<(f64, [u8; 3])>> = vec![None; workspace.len()];
            let width = view.camera.intrinsics.width;
            for (index, &depth_m) in view.depth_m.iter().enumerate() {
                if !(depth_m > 0.0 && depth_m.is_finite()) {
                    continue;
                }
                let image = Point2::new((index % width) as f64, (index / width) as f64);
                let point = view.camera.back_project(&image, f64::from(depth_m));
                let inside = (workspace.z_min_m..=workspace.z_max_m).contains(&point.z);
                let Some(Pixel { row, col }) = workspace.pixel(&point.xy()).filter(|_| inside)
                else {
                    continue;
                };
                let color = [0, 1, 2].map(|channel| view.rgb[3 * index + channel]);
                let cell = &mut highest[row * workspace.cols + col];
                if cell.is_none_or(|(z, _)| point.z > z) {
                    *cell = Some((point.z, color));
                }
            }
            for (index, (z, color)) in highest
                .iter()
                .enumerate()
                .filter_map(|(i, h)| Some((i, (*h)?)))
            {
                let height_m = &mut out.height_m[index];
                *height_m = if sums[index][3] == 0 {
                    z as f32
                } else {
                    height_m.max(z as f32)
                };
                for channel in 0..3 {
                    sums[index][channel] += u32::from(color[channel]);
                }
                sums[index][3] += 1;
            }
        }
        for (index, [red, green, blue, count]) in sums.into_iter().enumerate() {
            for (channel, sum) in [red, green, blue].into_iter().enumerate() {
                out.rgb[3 * index + channel] = sum
                    .checked_div(count)
                    .map_or(0, |_| ((sum + count / 2) / count) as u8);
            }
        }
        out
    }

    #[test]
    fn the_mean_color_and_the_greatest_height_of_the_views_win() {
        let camera = above(0.5, 0.0);
        let (red, low) = images(1.0, [200, 0, 0]);
        let (blue, high) = images(0.9, [0, 0, 101]);
        let views = [
            View {
                camera: &camera,
                rgb: &red,
                depth_m: &low,
            },
            View {
                camera: &camera,
                rgb: &blue,
                depth_m: &high,
            },
        ];
        let mut out = Heightmap::new(Workspace::RAVENS);
        let report = Fusion::default().fuse(&views, &mut out).unwrap();
        assert_eq!(report.views, 2);
        assert!(
            report.coverage > 0.0 && report.coverage < 0.1,
            "{}",
            report.coverage
        );
        // The pixel at the principal point hits (0.5, 0) in both views.
        let pixel = Workspace::RAVENS
            .pixel(&Point2::new(0.5 + 1e-4, 1e-4))
            .unwrap();
        assert!((out.height_at_m(pixel) - 0.1).abs() < 1e-6);
        let index = pixel.row * 160 + pixel.col;
        assert_eq!(out.rgb[3 * index..][..3], [100, 0, 51]);
    }

    #[test]
    fn what_is_no_depth_is_not_seen() {
        let camera = above(0.5, 0.0);
        for depth_m in [0.0, -1.0, f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let (rgb, depth_m) = images(depth_m, [9, 9, 9]);
            let mut out = Heightmap::new(Workspace::RAVENS);
            out.rgb.fill(7);
            let view = View {
                camera: &camera,
                rgb: &rgb,
                depth_m: &depth_m,
            };
            let report = Fusion::default().fuse(&[view], &mut out).unwrap();
            assert_eq!(report.coverage, 0.0);
            assert_eq!(out, Heightmap::new(Workspace::RAVENS));
        }
    }

    #[test]
    fn an_image_of_another_size_is_refused_by_the_cameras_name() {
        let camera = above(0.5, 0.0);
        let (rgb, depth_m) = images(1.0, [0; 3]);
        let mut out = Heightmap::new(Workspace::RAVENS);
        let view = View {
            camera: &camera,
            rgb: &rgb[1..],
            depth_m: &depth_m,
        };
        let error = Fusion::default()
            .fuse(&[view], &mut out)
            .unwrap_err()
            .to_string();
        assert!(error.contains("above") && error.contains("3600"), "{error}");
        let view = View {
            camera: &camera,
            rgb: &rgb,
            depth_m: &depth_m[1..],
        };
        assert!(Fusion::default().fuse(&[view], &mut out).is_err());
    }

    #[test]
    fn ordered_bits_keep_the_order_and_the_value() {
        let values = [
            f32::NEG_INFINITY,
            -1.0,
            -2e-3,
            -1e-30,
            -0.0,
            0.0,
            1e-30,
            0.28,
            f32::INFINITY,
        ];
        for pair in values.windows(2) {
            assert!(ordered(pair[0]) < ordered(pair[1]), "{pair:?}");
        }
        for value in values {
            assert_eq!(from_ordered(ordered(value)).to_bits(), value.to_bits());
            assert_ne!(ordered(value), 0);
        }
    }

    #[test]
    fn the_mean_is_the_rounded_quotient() {
        for views in 1..=MAX_VIEWS as u32 {
            for sum in 0..=255 * views {
                let expected = ((sum + views / 2) / views) as u8;
                assert_eq!(mean([sum; 3], views), [expected; 3], "{sum} / {views}");
            }
        }
    }

    #[test]
    fn whole_numbers_and_fractions_round_down() {
        for x in [0u32, 1, 2, 159, 160, 51_199, (1 << 22) - 1] {
            assert_eq!(whole(floor(x as f32)), x);
        }
        for x in [
            0.25f32,
            0.5,
            0.75,
            0.999_999_94,
            1.5,
            2.5,
            159.999_98,
            319.5,
        ] {
            assert_eq!(floor(x), x.floor(), "{x}");
        }
    }

    #[test]
    fn a_camera_or_a_workspace_without_sense_is_refused() {
        let mut camera = above(0.5, 0.0);
        camera.intrinsics.fx_px = 0.0;
        let (rgb, depth_m) = images(1.0, [1, 2, 3]);
        let mut out = Heightmap::new(Workspace::RAVENS);
        let view = View {
            camera: &camera,
            rgb: &rgb,
            depth_m: &depth_m,
        };
        let refusal = Fusion::default().fuse(&[view], &mut out).unwrap_err();
        assert!(matches!(refusal, FusionError::Camera(_)), "{refusal}");
        out.workspace.pixel_size_m = f64::NAN;
        let refusal = Fusion::default().fuse(&[], &mut out).unwrap_err();
        assert!(matches!(refusal, FusionError::Workspace(_)), "{refusal}");
    }

    #[test]
    fn one_fusion_serves_cameras_and_workspaces_of_any_size_in_turn() {
        let small = above(0.5, 0.0);
        let (rgb, depth_m) = images(1.0, [1, 2, 3]);
        let view = View {
            camera: &small,
            rgb: &rgb,
            depth_m: &depth_m,
        };
        let coarse = Workspace {
            rows: 10,
            cols: 5,
            pixel_size_m: 0.1,
            ..Workspace::RAVENS
        };
        let mut used = Fusion::default();
        let mut bent = small.clone();
        bent.intrinsics.distortion = lenses()[0];
        let through_lens = View {
            camera: &bent,
            ..view
        };
        for (workspace, views) in [
            (Workspace::RAVENS, vec![view; 3]),
            (Workspace::RAVENS, vec![view, through_lens]),
            (coarse, vec![view]),
            (Workspace::RAVENS, vec![]),
            (Workspace::RAVENS, vec![view; 2]),
        ] {
            let (mut out, mut expected) = (Heightmap::new(workspace), Heightmap::new(workspace));
            // Whatever was there before is gone.
            out.height_m.fill(9.0);
            let report = used.fuse(&views, &mut out).unwrap();
            assert_eq!(Fusion::default().fuse(&views, &mut expected), Ok(report));
            assert_eq!(out, expected);
            assert_eq!(report.coverage == 0.0, views.is_empty());
        }
    }

    proptest! {
        #[test]
        fn fusion_agrees_with_its_definition(
            depths in prop::collection::vec(0.85f32..1.05, 1200),
            x_m in 0.3..0.7, y_m in -0.4..0.4, yaw_rad in -3.0..3.0, tilt_rad in -0.5..0.5,
            lens in 0usize..4,
        ) {
            let mut camera = above(x_m, y_m);
            if let Some(lens) = lenses().get(lens) {
                camera.intrinsics.distortion = *lens;
            }
            let turn = UnitQuaternion::from_euler_angles(tilt_rad, 0.0, yaw_rad);
            camera.world_from_camera.rotation = turn * camera.world_from_camera.rotation;
            let rgb: Vec<u8> = (0..3600).map(|i| (i * 7 % 251) as u8).collect();
            let second = Camera { world_from_camera: above(x_m, y_m).world_from_camera, ..camera.clone() };
            let views = [
                View { camera: &camera, rgb: &rgb, depth_m: &depths },
                View { camera: &second, rgb: &rgb, depth_m: &depths },
            ];
            let mut out = Heightmap::new(Workspace::RAVENS);
            Fusion::default().fuse(&views, &mut out).unwrap();
            let expected = reference(&views, Workspace::RAVENS);
            // A point on a cell's edge, or at the same height as another, may go either way in f32.
            let close = |(a, b): (&f32, &f32)| (a - b).abs() < 1e-6;
            let agree = out.height_m.iter().zip(&expected.height_m).filter(|pair| close(*pair)).count();
            prop_assert!(agree >= out.height_m.len() - 4, "{agree}");
            let agree = out.rgb.iter().zip(&expected.rgb).filter(|(a, b)| a == b).count();
            prop_assert!(agree >= out.rgb.len() - 12, "{agree}");
        }

        #[test]
        fn cameras_anywhere_see_what_the_definition_says(
            depths in prop::collection::vec(0.05f32..2.0, 1200),
            position in prop::array::uniform3(-0.6..1.1),
            rotation in prop::array::uniform3(-3.0..3.0),
        ) {
            let camera = Camera {
                world_from_camera: Isometry3::new(position.into(), rotation.into()),
                ..above(0.0, 0.0)
            };
            let rgb = [1, 2, 3].repeat(1200);
            let view = View { camera: &camera, rgb: &rgb, depth_m: &depths };
            let mut out = Heightmap::new(Workspace::RAVENS);
            Fusion::default().fuse(&[view], &mut out).unwrap();
            let expected = reference(&[view], Workspace::RAVENS);
            let differ = out.height_m.iter().zip(&expected.height_m).filter(|(a, b)| (*a - *b).abs() > 2e-6);
            prop_assert!(differ.count() <= 2);
        }

        #[test]
        fn a_point_lands_in_the_cell_that_holds_it(x_m in 0.26..0.74, y_m in -0.49..0.49, z_m in 0.0..0.25) {
            let mut camera = above(x_m, y_m);
            camera.world_from_camera.translation.z = z_m + 1.0;
            let (rgb, mut depth_m) = images(0.0, [1, 2, 3]);
            depth_m[15 * SMALL.width + 20] = 1.0;
            let mut out = Heightmap::new(Workspace::RAVENS);
            Fusion::default().fuse(&[View { camera: &camera, rgb: &rgb, depth_m: &depth_m }], &mut out).unwrap();
            let seen: Vec<_> = (0..out.height_m.len()).filter(|i| out.rgb[3 * i] == 1).collect();
            prop_assert_eq!(seen.len(), 1);
            let pixel = Pixel { row: seen[0] / 160, col: seen[0] % 160 };
            let center = Workspace::RAVENS.center(pixel);
            prop_assert!((center - Point3::new(x_m, y_m, z_m).xy()).amax() < 0.5 * 0.003125 + 1e-6);
            prop_assert!((f64::from(out.height_at_m(pixel)) - z_m).abs() < 1e-6);
        }
    }
}
