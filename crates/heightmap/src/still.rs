//! Fusion for cameras with noise: the median of several frames of a still scene.

use crate::fusion::{LensRays, from_ordered, ordered};
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
        for (top, count) in self.top.iter().zip(&self.counts) {
            let count = usize::from(*count);
            if count == 0 {
                frame.height_m.push(f32::NAN);
                frame.rgb.extend([0; 3]);
                continue;
            }
            let rank = (from_top * (count - 1) as f64).round() as usize;
            let rank = rank.min(KEPT - 1);
            frame.height_m.push(from_ordered((top[rank] >> 32) as u32));
            let mut sums = [0; 3];
            for key in &top[..=rank] {
                let [_, rgb @ ..] = (*key as u32).to_be_bytes().map(u32::from);
                sums = [0, 1, 2].map(|channel| sums[channel] + rgb[channel]);
            }
            let kept = rank as u32 + 1;
            frame
                .rgb
                .extend(sums.map(|sum| ((sum + kept / 2) / kept) as u8));
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
        self.frames.clear();
    }

    /// The last frame alone, to see whether something moves.
    pub fn last(&self, out: &mut Heightmap) {
        let newest = self.frames.len().saturating_sub(1);
        self.write(newest, out);
    }

    /// The median of the frames. Overwrites `out`.
    pub fn median(&self, out: &mut Heightmap) -> FusionReport {
        self.write(0, out)
    }

    /// The median of the frames from one on.
    fn write(&self, first: usize, out: &mut Heightmap) -> FusionReport {
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
        let frames = self.frames.iter().skip(first);
        let needed = frames.clone().count().div_ceil(2);
        let (mut heights, mut seen) = ([0.0f32; MAX_FRAMES], 0);
        for cell in 0..len {
            let (mut count, mut sums) = (0, [0u32; 3]);
            for frame in frames.clone() {
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
            let heights = &mut heights[..count];
            heights.sort_unstable_by(f32::total_cmp);
            out.height_m.push(heights[(count - 1) / 2]);
            let count = count as u32;
            let rgb = sums.map(|sum| ((sum + count / 2) / count) as u8);
            // Black at height 0 stands for what is not seen.
            out.rgb.extend(if rgb == [0; 3] { [1; 3] } else { rgb });
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
        for v in 0..height {
            let row = &view.depth_m[v * width..][..width];
            let above = (v > 0).then(|| &view.depth_m[(v - 1) * width..][..width]);
            let below = (v + 1 < height).then(|| &view.depth_m[(v + 1) * width..][..width]);
            for u in 0..width {
                let depth_m = row[u];
                // Infinity is outside, below.
                if depth_m.is_nan() || depth_m <= 0.0 {
                    continue;
                }
                let [ray_x, ray_y] = rays[v * width + u];
                let ray = right * ray_x + down * ray_y + ahead;
                let point = ray * depth_m + origin;
                let inside = (point.x >= 0.0)
                    & (point.x < cols)
                    & (point.y >= 0.0)
                    & (point.y < rows)
                    & (point.z >= z_min_m - BELOW_M)
                    & (point.z <= z_max_m);
                if !inside {
                    continue;
                }
                let jumps = |other: f32| other > 0.0 && (other - depth_m).abs() > step_m;
                let at_edge = (u > 0 && jumps(row[u - 1]))
                    || (u + 1 < width && jumps(row[u + 1]))
                    || above.is_some_and(|above| jumps(above[u]))
                    || below.is_some_and(|below| jumps(below[u]));
                if at_edge {
                    continue;
                }
                let cell = point.y as usize * workspace.cols + point.x as usize;
                let color = &view.rgb[3 * (v * width + u)..][..3];
                let color = u32::from_be_bytes([0, color[0], color[1], color[2]]);
                let key = (u64::from(ordered(point.z.max(z_min_m))) << 32) | u64::from(color);
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
    fn the_median_over_frames_forgets_outliers_and_the_mean_of_colours_is_taken() {
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
