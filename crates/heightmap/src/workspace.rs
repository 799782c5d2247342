//! The one documented place for SE(2) <-> pixel.

use nalgebra::{Isometry2, Point2};
use serde::{Deserialize, Serialize};

/// The volume above the table that a heightmap covers, and its grid.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Workspace {
    /// World position of the outer corner of cell (0, 0): the smallest x and y.
    pub origin_m: Point2<f64>,
    /// Number of cells along +y.
    pub rows: usize,
    /// Number of cells along +x.
    pub cols: usize,
    /// Edge length of a cell.
    pub pixel_size_m: f64,
    /// Points below are dropped. Slightly below the table, or rounding would empty its cells.
    pub z_min_m: f64,
    /// Points above are dropped.
    pub z_max_m: f64,
}

/// Far beyond any table; every cell's index is a whole `f32`.
const MAX_CELLS: usize = 1 << 22;

/// A workspace that covers nothing.
#[derive(Clone, Debug, thiserror::Error, PartialEq)]
#[error("the workspace {workspace:?} cannot be used, expected {expected}")]
pub struct WorkspaceError {
    /// The workspace.
    workspace: Workspace,
    /// What was expected.
    expected: &'static str,
}

/// A cell of a heightmap.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Pixel {
    /// Index along +y.
    pub row: usize,
    /// Index along +x.
    pub col: usize,
}

/// A disk in the xy-plane of the world, for instance about a pick to be left out.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Disk {
    /// Its centre.
    pub center_m: Point2<f64>,
    /// Its radius.
    pub radius_m: f64,
}

impl Workspace {
    /// The 0.5 x 1 m table of Ravens: 320 x 160 cells of 3.125 mm (Zeng et al., CoRL 2020).
    pub const RAVENS: Self = Self {
        origin_m: Point2::new(0.25, -0.5),
        rows: 320,
        cols: 160,
        pixel_size_m: 0.003125,
        z_min_m: -0.002,
        z_max_m: 0.28,
    };

    /// Checks that the grid has cells, not too many of them, and that all measures make sense.
    pub fn check(&self) -> Result<(), WorkspaceError> {
        let cells = self.rows.checked_mul(self.cols);
        let positive = self.pixel_size_m.is_finite() && self.pixel_size_m > 0.0;
        let origin = self.origin_m.iter().all(|part| part.is_finite());
        let range = self.z_min_m.is_finite() && self.z_max_m.is_finite();
        let checks = [
            (
                cells.is_some_and(|cells| (1..=MAX_CELLS).contains(&cells)),
                "rows * cols between 1 and 4194304",
            ),
            (positive, "a positive pixel_size_m"),
            (origin, "a finite origin_m"),
            (range, "finite z_min_m and z_max_m"),
            (self.z_min_m < self.z_max_m, "z_min_m below z_max_m"),
        ];
        match checks.into_iter().find(|(good, _)| !good) {
            Some((_, expected)) => Err(WorkspaceError {
                workspace: *self,
                expected,
            }),
            None => Ok(()),
        }
    }

    /// Number of cells.
    #[allow(clippy::len_without_is_empty, reason = "a grid without cells is none")]
    pub const fn len(&self) -> usize {
        self.rows * self.cols
    }

    /// The cell that holds a point, if the point is on the grid.
    pub fn pixel(&self, point: &Point2<f64>) -> Option<Pixel> {
        let cell = self.point_px(point);
        let (col, row) = (cell.x.floor(), cell.y.floor());
        // NaN fails both comparisons.
        let inside = col >= 0.0 && row >= 0.0 && col < self.cols as f64 && row < self.rows as f64;
        inside.then_some(Pixel {
            row: row as usize,
            col: col as usize,
        })
    }

    /// Continuous image coordinates of a world position: x along columns, y along rows, in cells from the outer
    /// corner of cell (0, 0). Defined off the grid too.
    pub fn point_px(&self, point: &Point2<f64>) -> Point2<f64> {
        Point2::from((point - self.origin_m) / self.pixel_size_m)
    }

    /// World position of continuous image coordinates, see [`Self::point_px`].
    pub fn point_m(&self, point_px: &Point2<f64>) -> Point2<f64> {
        self.origin_m + point_px.coords * self.pixel_size_m
    }

    /// World position of a cell's centre.
    pub fn center(&self, pixel: Pixel) -> Point2<f64> {
        self.point_m(&Point2::new(pixel.col as f64 + 0.5, pixel.row as f64 + 0.5))
    }

    /// The SE(2) pose at a cell's centre; yaw turns +x towards +y, that is columns towards rows.
    pub fn pose(&self, pixel: Pixel, yaw_rad: f64) -> Isometry2<f64> {
        Isometry2::new(self.center(pixel).coords, yaw_rad)
    }
}

/// Colour and height seen from straight above.
#[derive(Clone, Debug, PartialEq)]
pub struct Heightmap {
    /// The volume covered.
    pub workspace: Workspace,
    /// Row-major, three bytes a cell; black where nothing was seen.
    pub rgb: Vec<u8>,
    /// Row-major height over z = 0; 0 where nothing was seen.
    pub height_m: Vec<f32>,
}

/// A heightmap whose parts do not fit together.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum HeightmapError {
    /// A buffer has another size than the grid asks for.
    #[error("{what} has {actual} elements, expected {expected}")]
    Size {
        /// Which buffer.
        what: &'static str,
        /// Elements found.
        actual: usize,
        /// Elements expected.
        expected: usize,
    },
    /// Heights must be finite.
    #[error("height at index {index} is not finite")]
    NotFinite {
        /// Row-major index of the first such cell.
        index: usize,
    },
}

impl Heightmap {
    /// An empty table.
    pub fn new(workspace: Workspace) -> Self {
        Self {
            workspace,
            rgb: vec![0; 3 * workspace.len()],
            height_m: vec![0.0; workspace.len()],
        }
    }

    /// Height of one cell.
    pub fn height_at_m(&self, pixel: Pixel) -> f32 {
        self.height_m[pixel.row * self.workspace.cols + pixel.col]
    }

    /// Whether a cell (row-major index) was seen: one that was not is black at height 0.
    pub fn is_seen(&self, index: usize) -> bool {
        self.height_m[index] != 0.0 || self.rgb[3 * index..3 * index + 3] != [0; 3]
    }

    /// How different two scenes look: the mean over cells of the colour difference (of the full range) and the
    /// height difference (of 4 cm, and no more than that). Infinite if the heightmaps cover different
    /// workspaces.
    pub fn distance(&self, other: &Self) -> f64 {
        const HEIGHT_M: f32 = 0.04;
        let sizes = |heightmap: &Self| (heightmap.height_m.len(), heightmap.rgb.len());
        if self.workspace != other.workspace || sizes(self) != sizes(other) {
            return f64::INFINITY;
        }
        let color: u64 = self
            .rgb
            .iter()
            .zip(&other.rgb)
            .map(|(a, b)| u64::from(a.abs_diff(*b)))
            .sum();
        // A height that is no number is as far away as can be: `min` takes the other one.
        let height = |(a, b): (&f32, &f32)| f64::from(((a - b).abs() / HEIGHT_M).min(1.0));
        let height: f64 = self.height_m.iter().zip(&other.height_m).map(height).sum();
        (color as f64 / (3.0 * 255.0) + height) / self.workspace.len() as f64
    }

    /// Index of the image that looks most like this one, the first of equals; none of no images.
    pub fn nearest<'a>(&self, images: impl IntoIterator<Item = &'a Self>) -> Option<usize> {
        images
            .into_iter()
            .map(|image| self.distance(image))
            .enumerate()
            .min_by(|(_, a), (_, b)| a.total_cmp(b))
            .map(|(index, _)| index)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn rows_run_along_y_and_columns_along_x() {
        let workspace = Workspace::RAVENS;
        let pixel = |x_m, y_m| workspace.pixel(&Point2::new(x_m, y_m));
        assert_eq!(pixel(0.25, -0.5), Some(Pixel { row: 0, col: 0 }));
        assert_eq!(pixel(0.4999, -0.4999), Some(Pixel { row: 0, col: 79 }));
        assert_eq!(pixel(0.2501, 0.4999), Some(Pixel { row: 319, col: 0 }));
        for (x_m, y_m) in [(0.75, 0.0), (0.5, 0.5), (0.2499, 0.0), (0.5, -0.5001)] {
            assert_eq!(pixel(x_m, y_m), None, "{x_m}, {y_m}");
        }
        assert_eq!(pixel(f64::NAN, 0.0), None);
        assert_eq!(pixel(0.5, f64::INFINITY), None);
        let center = workspace.center(Pixel { row: 0, col: 159 });
        assert!((center - Point2::new(0.7484375, -0.4984375)).amax() < 1e-12);
    }

    #[test]
    fn yaw_turns_columns_towards_rows() {
        let workspace = Workspace::RAVENS;
        let pose = workspace.pose(Pixel { row: 100, col: 50 }, std::f64::consts::FRAC_PI_2);
        let ahead = pose * Point2::new(workspace.pixel_size_m, 0.0);
        assert_eq!(workspace.pixel(&ahead), Some(Pixel { row: 101, col: 50 }));
    }

    #[test]
    fn a_workspace_without_sense_is_refused() {
        let good = Workspace::RAVENS;
        assert_eq!(good.check(), Ok(()));
        let bad = [
            Workspace { rows: 0, ..good },
            Workspace {
                rows: usize::MAX,
                ..good
            },
            Workspace {
                pixel_size_m: 0.0,
                ..good
            },
            Workspace {
                pixel_size_m: f64::NAN,
                ..good
            },
            Workspace {
                origin_m: Point2::new(f64::NAN, 0.0),
                ..good
            },
            Workspace {
                z_max_m: f64::INFINITY,
                ..good
            },
            Workspace {
                z_min_m: 0.3,
                ..good
            },
        ];
        for workspace in bad {
            assert!(workspace.check().is_err(), "{workspace:?}");
        }
    }

    #[test]
    fn the_distance_counts_colors_and_heights_and_the_nearest_is_the_first_of_equals() {
        let before = Heightmap::new(Workspace::RAVENS);
        let mut raised = before.clone();
        raised.height_m[..512].fill(0.02);
        let mut high = before.clone();
        high.height_m[..512].fill(9.0);
        let mut painted = before.clone();
        painted.rgb[..3 * 512].fill(255);
        assert_eq!(before.distance(&before), 0.0);
        assert!((before.distance(&raised) - 0.005).abs() < 1e-9);
        assert!((before.distance(&high) - 0.01).abs() < 1e-9);
        assert!((before.distance(&painted) - 0.01).abs() < 1e-9);
        high.height_m[0] = f32::NAN;
        assert!((before.distance(&high) - 0.01).abs() < 1e-9);
        let elsewhere = Heightmap::new(Workspace {
            z_max_m: 0.5,
            ..Workspace::RAVENS
        });
        assert_eq!(before.distance(&elsewhere), f64::INFINITY);
        assert_eq!(raised.nearest([&painted, &before, &before]), Some(1));
        assert_eq!(raised.nearest([]), None);
    }

    proptest! {
        #[test]
        fn a_cell_holds_its_centre(row in 0usize..320, col in 0usize..160) {
            let pixel = Pixel { row, col };
            prop_assert_eq!(Workspace::RAVENS.pixel(&Workspace::RAVENS.center(pixel)), Some(pixel));
        }
    }
}
