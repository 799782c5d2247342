//! Fusion for cameras with noise: the median of several frames of a still scene.

use crate::fusion::{LensRays, OUTSIDE, Outline, floor, from_ordered, mean, ordered, whole};
use crate::{FusionError, FusionReport, Heightmap, View, Workspace};
use nalgebra::Vector3;
use std::collections::VecDeque;

/// How frames are fused.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StillSettings {
    /// Frames that the median is taken of; 1 to 31.
    pub frames: usize,
    /// Which of the points of a cell gives its height, from the lowest (0) to the highest (1). The highest would be the one with the largest
    /// error.
    pub percentile: f64,
    /// A pixel whose depth differs from a neighbour's by more than this is left out: flying pixels, and edges, of which nobody knows what they show.
    pub edge_step_m: f32,
}

impl Default for StillSettings {
    fn default() -> Self {
        Self {
            frames: 5,
            percentile: 0.75,
            edge_step_m: 0.02,
        }
    }
}

/// Highest points of a cell that are kept. The percentile is taken among all points, but no lower than the last of these.
const KEPT: usize = 4;
/// More frames than this are no moment.
const MAX_FRAMES: usize = 31;

/// Fuses frames of a still scene: in each frame the percentile of the points of a cell, over the frames the median. A cell that fewer
/// than half of the frames saw is not seen.
#[derive(Debug, Default)]
pub struct StillFusion {
    settings: StillSettings,
    frames: VecDeque<Frame>,
    /// By view, the rays of its camera.
    rays: Vec<LensRays>,
    /// By cell, the highest points: ordered bits of the height above, colour below.
    top: Vec<[u64; KEPT]>,
    /// By cell, its points.
    counts: Vec<u16>,
    /// Cell of each pixel of an image row, or [`OUTSIDE`].
    cells: Vec<u32>,
    /// Ordered bits of the height of each pixel of an image row.
    heights: Vec<u32>,
    /// The median of the frames, once it was asked for.
    median: Option<(Heightmap, FusionReport)>,
}

/// What one set of views shows.
#[derive(Debug)]
struct Frame {
    workspace: Workspace,
    views: usize,
    /// Not a number where nothing was seen.
    height_m: Vec<f32>,
    rgb: Vec<u8>,
}

impl StillFusion {
    /// A fusion without frames.
    pub fn new(settings: StillSettings) -> Self {
        Self {
            settings,
            ..Self::default()
        }
    }

    /// Takes one set of views. The oldest frames are forgotten when there are more than the settings say, all when the workspace is another.
    pub fn push(&mut self, views: &[View<'_>], workspace: &Workspace) -> Result<(), FusionError> {
        workspace.check()?;
        for view in views {
            view.check()?;
        }
        self.median = None;
        let len = workspace.len();
        self.top.clear();
        self.top.resize(len, [0; KEPT]);
        self.counts.clear();
        self.counts.resize(len, 0);
        for (index, view) in views.iter().enumerate() {
            self.project(index, view, workspace);
        }
        if self
            .frames
            .iter()
            .any(|frame| frame.workspace != *workspace)
        {
            self.frames.clear();
        }
        let limit = self.settings.frames.clamp(1, MAX_FRAMES);
        // The memory of the oldest one is used again.
        let mut frame = match self.frames.len() >= limit {
            true => self.frames.pop_front(),
            false => None,
        }
        .unwrap_or_else(|| Frame {
            workspace: *workspace,
            views: 0,
            height_m: Vec::new(),
            rgb: Vec::new(),
        });
        frame.views = views.len();
        frame.height_m.clear();
        frame.rgb.clear();
        let from_top = 1.0 - self.settings.percentile;
        // Of more points than these the lowest one that is kept.
        let ranks: [usize; 256] = std::array::from_fn(|count| {
            let rank = (from_top * count.saturating_sub(1) as f64).round() as usize;
            rank.min(KEPT - 1)
        });
        for (top, count) in self.top.iter().zip(&self.counts) {
            let count = usize::from(*count);
            if count == 0 {
                frame.height_m.push(f32::NAN);
                frame.rgb.extend([0; 3]);
                continue;
            }
            let rank = ranks[count.min(ranks.len() - 1)];
            frame.height_m.push(from_ordered((top[rank] >> 32) as u32));
            let mut sums = [0; 3];
            for key in &top[..=rank] {
                let [_, rgb @ ..] = (*key as u32).to_be_bytes().map(u32::from);
                sums = [0, 1, 2].map(|channel| sums[channel] + rgb[channel]);
            }
            frame.rgb.extend(mean(sums, rank as u32 + 1));
        }
        self.frames.push_back(frame);
        Ok(())
    }

    /// Frames since the last [`Self::forget`], up to those of the settings.
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// Whether there is no frame.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// Whether there are as many frames as the settings ask for.
    pub fn is_full(&self) -> bool {
        self.frames.len() >= self.settings.frames.clamp(1, MAX_FRAMES)
    }

    /// Forgets all frames: something has moved.
    pub fn forget(&mut self) {
        self.median = None;
        self.frames.clear();
    }

    /// The last frame alone, to see whether something moves.
    pub fn last(&self, out: &mut Heightmap) {
        let Some(newest) = self.frames.back() else {
            *out = Heightmap::new(out.workspace);
            return;
        };
        out.workspace = newest.workspace;
        out.height_m.clear();
        out.rgb.clear();
        for (height_m, rgb) in newest.height_m.iter().zip(newest.rgb.as_chunks::<3>().0) {
            let (height_m, rgb) = match height_m.is_nan() {
                true => (0.0, [0; 3]),
                false => (*height_m, seen_color(*rgb)),
            };
            out.height_m.push(height_m);
            out.rgb.extend(rgb);
        }
    }

    /// The median of the frames. Overwrites `out`. It is computed once for the same frames.
    pub fn median(&mut self, out: &mut Heightmap) -> FusionReport {
        if let Some((median, report)) = &self.median {
            out.clone_from(median);
            return *report;
        }
        let report = self.write(out);
        self.median = Some((out.clone(), report));
        report
    }

    /// The median of the frames.
    fn write(&self, out: &mut Heightmap) -> FusionReport {
        let Some(newest) = self.frames.back() else {
            *out = Heightmap::new(out.workspace);
            return FusionReport {
                views: 0,
                coverage: 0.0,
            };
        };
        out.workspace = newest.workspace;
        let len = newest.workspace.len();
        out.height_m.clear();
        out.rgb.clear();
        let needed = self.frames.len().div_ceil(2);
        let (mut heights, mut seen) = ([0.0f32; MAX_FRAMES], 0);
        for cell in 0..len {
            let (mut count, mut sums) = (0, [0u32; 3]);
            for frame in &self.frames {
                let height_m = frame.height_m[cell];
                if height_m.is_nan() {
                    continue;
                }
                heights[count] = height_m;
                count += 1;
                for (sum, value) in sums.iter_mut().zip(&frame.rgb[3 * cell..]) {
                    *sum += u32::from(*value);
                }
            }
            if count < needed {
                out.height_m.push(0.0);
                out.rgb.extend([0; 3]);
                continue;
            }
            seen += 1;
            out.height_m.push(match &mut heights[..count] {
                &mut [a, b, c, d, e] => median_of_five([a, b, c, d, e]),
                heights => {
                    heights.sort_unstable_by(f32::total_cmp);
                    heights[(count - 1) / 2]
                }
            });
            out.rgb.extend(seen_color(mean(sums, count as u32)));
        }
        FusionReport {
            views: newest.views,
            coverage: seen as f64 / len as f64,
        }
    }

    /// Puts the points of one view into their cells.
    fn project(&mut self, index: usize, view: &View<'_>, workspace: &Workspace) {
        let intrinsics = &view.camera.intrinsics;
        while self.rays.len() <= index {
            self.rays.push(LensRays::new(*intrinsics));
        }
        if self.rays[index].of != *intrinsics {
            self.rays[index] = LensRays::new(*intrinsics);
        }
        let rays = &self.rays[index].rays;
        let (width, height) = (intrinsics.width, intrinsics.height);
        // In units of cells, from the grid's corner; z stays in metres.
        let scale = 1.0 / workspace.pixel_size_m;
        let to_cells = |v: Vector3<f64>| Vector3::new(v.x * scale, v.y * scale, v.z).cast::<f32>();
        let pose = &view.camera.world_from_camera;
        let corner = Vector3::new(workspace.origin_m.x, workspace.origin_m.y, 0.0);
        let origin = to_cells(pose.translation.vector - corner);
        let [right, down, ahead] =
            [Vector3::x(), Vector3::y(), Vector3::z()].map(|axis| to_cells(pose.rotation * axis));
        let (cols, rows) = (workspace.cols as f32, workspace.rows as f32);
        let (z_min_m, z_max_m) = (workspace.z_min_m as f32, workspace.z_max_m as f32);
        let step_m = self.settings.edge_step_m;
        let deep = Workspace {
            z_min_m: workspace.z_min_m - f64::from(BELOW_M),
            ..*workspace
        };
        let outline = Outline::new(view.camera, &deep);
        let z_low_m = z_min_m - BELOW_M;
        self.cells.resize(width, 0);
        self.heights.resize(width, 0);
        for v in 0..height {
            // Most pixels see only what is beside the workspace.
            let columns = outline.columns(v, width);
            let row = &view.depth_m[v * width..][..width];
            // Two loops, since this one can be done for several pixels at once and the next cannot.
            let places = self.cells.iter_mut().zip(&mut self.heights);
            let seen = row[columns.clone()].iter();
            let rays = &rays[v * width..][columns.clone()];
            for (((cell, ordered_z), &depth_m), &[ray_x, ray_y]) in places.zip(seen).zip(rays) {
                let at = |axis: usize| {
                    let ray = right[axis] * ray_x + down[axis] * ray_y + ahead[axis];
                    ray * depth_m + origin[axis]
                };
                let (x, y, z_m) = (at(0), at(1), at(2));
                // A depth that is not a number fails every comparison; infinity is outside.
                let inside = (depth_m > 0.0)
                    & (x >= 0.0)
                    & (x < cols)
                    & (y >= 0.0)
                    & (y < rows)
                    & (z_m >= z_low_m)
                    & (z_m <= z_max_m);
                let index = whole(floor(y) * cols + floor(x));
                *cell = if inside { index } else { OUTSIDE };
                *ordered_z = ordered(z_m.max(z_min_m));
            }
            // A pixel at the border of the image is its own neighbour.
            let neighbor = |v: usize| &view.depth_m[v.min(height - 1) * width..][..width];
            let (above, below) = (neighbor(v.saturating_sub(1)), neighbor(v + 1));
            let places = self.cells.iter().zip(&self.heights);
            for (u, (&cell, &ordered_z)) in columns.zip(places) {
                if cell == OUTSIDE {
                    continue;
                }
                let depth_m = row[u];
                let jumps = |other: f32| (other > 0.0) & ((other - depth_m).abs() > step_m);
                let at_edge = jumps(row[u.saturating_sub(1)])
                    | jumps(row[(u + 1).min(width - 1)])
                    | jumps(above[u])
                    | jumps(below[u]);
                if at_edge {
                    continue;
                }
                let cell = cell as usize;
                let color = &view.rgb[3 * (v * width + u)..][..3];
                let color = u32::from_be_bytes([0, color[0], color[1], color[2]]);
                let key = (u64::from(ordered_z) << 32) | u64::from(color);
                self.counts[cell] = self.counts[cell].saturating_add(1);
                let top = &mut self.top[cell];
                if key > top[KEPT - 1] {
                    top[KEPT - 1] = key;
                    let mut place = KEPT - 1;
                    while place > 0 && top[place] > top[place - 1] {
                        top.swap(place, place - 1);
                        place -= 1;
                    }
                }
            }
        }
    }
}

/// Black at height 0 stands for what is not seen.
fn seen_color(rgb: [u8; 3]) -> [u8; 3] {
    if rgb == [0; 3] { [1; 3] } else { rgb }
}

/// The third of five numbers, without a branch.
fn median_of_five([a, b, c, d, e]: [f32; 5]) -> f32 {
    // The lowest and the highest of two pairs cannot be it.
    let low = a.min(b).max(c.min(d));
    let high = a.max(b).min(c.max(d));
    // The median of these two and the fifth.
    low.min(high).max(low.max(high).min(e))
}

/// Noise puts points of the table below it: up to this far below the workspace they count as its lowest height.
const BELOW_M: f32 = 0.02;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Camera, Distortion, Intrinsics};
    use nalgebra::{Isometry3, Translation3, UnitQuaternion};

    const SMALL: Intrinsics = Intrinsics {
        width: 160,
        height: 120,
        fx_px: 400.0,
        fy_px: 400.0,
        cx_px: 79.5,
        cy_px: 59.5,
        distortion: Distortion::NONE,
    };

    fn above() -> Camera {
        Camera {
            name: "above".into(),
            intrinsics: SMALL,
            world_from_camera: Isometry3::from_parts(
                Translation3::new(0.5, 0.0, 1.0),
                UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI),
            ),
        }
    }

    fn push(fusion: &mut StillFusion, depth_m: &[f32], rgb: u8) {
        let camera = above();
        let rgb = vec![rgb; 3 * SMALL.len()];
        let view = View {
            camera: &camera,
            rgb: &rgb,
            depth_m,
        };
        fusion.push(&[view], &Workspace::RAVENS).unwrap();
    }

    fn middle() -> usize {
        160 * 160 + 80
    }

    fn fusion(frames: usize) -> StillFusion {
        StillFusion::new(StillSettings {
            frames,
            ..StillSettings::default()
        })
    }

    #[test]
    fn the_median_over_frames_forgets_outliers_and_the_mean_of_colors_is_taken() {
        let mut fusion = fusion(3);
        let mut out = Heightmap::new(Workspace::RAVENS);
        for (depth_m, rgb) in [(0.95, 90), (0.75, 100), (0.951, 110)] {
            assert!(!fusion.is_full());
            push(&mut fusion, &vec![depth_m; SMALL.len()], rgb);
        }
        assert!(fusion.is_full());
        let report = fusion.median(&mut out);
        assert_eq!(report.views, 1);
        assert!((out.height_m[middle()] - 0.05).abs() < 1e-5);
        assert_eq!(out.rgb[3 * middle()], 100);
        // The oldest frame goes.
        push(&mut fusion, &vec![0.9; SMALL.len()], 90);
        assert_eq!(fusion.len(), 3);
        fusion.median(&mut out);
        assert!((out.height_m[middle()] - 0.1).abs() < 1e-5);
        fusion.last(&mut out);
        assert!((out.height_m[middle()] - 0.1).abs() < 1e-5);
        fusion.forget();
        assert!(fusion.is_empty());
        assert_eq!(fusion.median(&mut out).coverage, 0.0);
        assert!(!out.is_seen(middle()));
    }

    #[test]
    fn a_cell_that_fewer_than_half_of_the_frames_see_is_not_seen() {
        let mut fusion = fusion(4);
        let hole = vec![0.0; SMALL.len()];
        let table = vec![1.0; SMALL.len()];
        let mut out = Heightmap::new(Workspace::RAVENS);
        for depth_m in [&table, &hole, &hole, &hole] {
            push(&mut fusion, depth_m, 0);
        }
        fusion.median(&mut out);
        assert!(!out.is_seen(middle()));
        push(&mut fusion, &table, 0);
        push(&mut fusion, &table, 0);
        fusion.median(&mut out);
        // Black at height 0, and seen all the same.
        assert!(out.is_seen(middle()), "{:?}", &out.rgb[3 * middle()..][..3]);
        assert_eq!(out.height_m[middle()], 0.0);
    }

    #[test]
    fn flying_pixels_and_edges_are_left_out_and_nothing_else() {
        let mut depth_m = vec![1.0; SMALL.len()];
        let at = |u: usize, v: usize| v * SMALL.width + u;
        // A pixel in mid-air over the middle, and a block.
        depth_m[at(80, 60)] = 0.85;
        for v in 20..40 {
            depth_m[at(20, v)..at(40, v)].fill(0.95);
        }
        let mut fusion = fusion(1);
        push(&mut fusion, &depth_m, 90);
        let mut out = Heightmap::new(Workspace::RAVENS);
        fusion.median(&mut out);
        let heights = out.height_m.iter().copied();
        let between = heights.filter(|height| (0.002..0.048).contains(height) || *height > 0.052);
        assert_eq!(between.count(), 0);
        let block = out
            .height_m
            .iter()
            .filter(|height| **height > 0.048)
            .count();
        // 20 x 20 px of 2.4 mm less a pixel on each side: 13 to 15 cells of 3.125 mm.
        assert!((13 * 13..=15 * 15).contains(&block), "{block}");
    }

    #[test]
    fn one_point_of_many_that_is_too_high_does_not_lift_its_cell() {
        // Half the distance: four points a cell and more.
        let mut camera = above();
        camera.world_from_camera.translation.z = 0.4;
        let mut depth_m = vec![0.4; SMALL.len()];
        for depth in depth_m.iter_mut().step_by(17) {
            *depth -= 0.01;
        }
        let rgb = vec![90; 3 * SMALL.len()];
        let view = View {
            camera: &camera,
            rgb: &rgb,
            depth_m: &depth_m,
        };
        let mut fusion = fusion(1);
        fusion.push(&[view], &Workspace::RAVENS).unwrap();
        let mut out = Heightmap::new(Workspace::RAVENS);
        fusion.median(&mut out);
        let seen = (0..out.height_m.len()).filter(|index| out.is_seen(*index));
        let lifted = seen.clone().filter(|index| out.height_m[*index] > 0.005);
        assert!(
            lifted.clone().count() * 20 < seen.count(),
            "{}",
            lifted.count()
        );
    }

    #[test]
    fn the_median_is_that_of_the_present_frames_however_often_it_is_asked_for() {
        let mut fusion = fusion(3);
        let mut out = Heightmap::new(Workspace::RAVENS);
        for depth_m in [0.95, 0.9, 0.85, 0.8] {
            push(&mut fusion, &vec![depth_m; SMALL.len()], 90);
            let mut fresh = Heightmap::new(Workspace::RAVENS);
            let report = fusion.median(&mut fresh);
            assert_eq!(fusion.median(&mut out), report);
            assert_eq!(out, fresh);
        }
        assert!((out.height_m[middle()] - 0.15).abs() < 1e-5);
        fusion.forget();
        assert_eq!(fusion.median(&mut out).views, 0);
        assert_eq!(out, Heightmap::new(Workspace::RAVENS));
    }

    #[test]
    fn a_pinhole_and_a_lens_that_changes_nothing_give_the_same_cells() {
        // What the outline of the workspace leaves out is beside it: behind a lens every pixel is looked at.
        let mut lens = Intrinsics::RAVENS;
        lens.distortion = Distortion::plumb_bob([1e-12, 0.0, 0.0, 0.0, 0.0]);
        for camera in Camera::ravens() {
            let depth_m: Vec<f32> = (0..Intrinsics::RAVENS.len())
                .map(|index| 0.6 + (index % 640) as f32 * 1e-3)
                .collect();
            let rgb: Vec<u8> = (0..3 * depth_m.len()).map(|i| (i % 251) as u8).collect();
            let fused = |intrinsics| {
                let camera = Camera {
                    intrinsics,
                    ..camera.clone()
                };
                let view = View {
                    camera: &camera,
                    rgb: &rgb,
                    depth_m: &depth_m,
                };
                let mut fusion = fusion(1);
                fusion.push(&[view], &Workspace::RAVENS).unwrap();
                let mut out = Heightmap::new(Workspace::RAVENS);
                fusion.median(&mut out);
                out
            };
            let (pinhole, bent) = (fused(Intrinsics::RAVENS), fused(lens));
            let differ = pinhole.height_m.iter().zip(&bent.height_m);
            let differ = differ.filter(|(a, b)| (*a - *b).abs() > 1e-6).count();
            // A point on a cell's edge may go either way.
            assert!(differ <= 2, "{}: {differ}", camera.name);
            assert!(pinhole.height_m.iter().any(|height| *height > 0.0));
        }
    }

    #[test]
    fn the_median_of_five_is_the_third_in_every_order() {
        let mut orders = vec![Vec::new()];
        for _ in 0..5 {
            let longer = orders.iter().flat_map(|order: &Vec<u8>| {
                let left = (0..5).filter(|number| !order.contains(number));
                left.map(|number| [order.as_slice(), &[number]].concat())
            });
            orders = longer.collect();
        }
        assert_eq!(orders.len(), 120);
        for order in orders {
            let numbers = [0, 1, 2, 3, 4].map(|at: usize| f32::from(order[at]));
            assert_eq!(median_of_five(numbers), 2.0, "{order:?}");
        }
        assert_eq!(median_of_five([0.1, 0.1, 0.3, 0.1, -0.2]), 0.1);
    }

    #[test]
    fn views_that_do_not_fit_are_refused() {
        let camera = above();
        let view = View {
            camera: &camera,
            rgb: &[0; 3],
            depth_m: &[1.0],
        };
        let refusal = fusion(1).push(&[view], &Workspace::RAVENS).unwrap_err();
        assert!(refusal.to_string().contains("above"), "{refusal}");
    }
}
