//! The one documented place for SE(2) <-> pixel.

use nalgebra::{Isometry2, Point2, Vector2};
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

/// A cell of a heightmap.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Pixel {
    /// Index along +y.
    pub row: usize,
    /// Index along +x.
    pub col: usize,
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

    /// Number of cells.
    pub const fn len(&self) -> usize {
        self.rows * self.cols
    }

    /// The cell that holds a point, if the point is on the grid.
    pub fn pixel(&self, point: &Point2<f64>) -> Option<Pixel> {
        let cell = (point - self.origin_m) / self.pixel_size_m;
        let (col, row) = (cell.x.floor(), cell.y.floor());
        // NaN fails both comparisons.
        let inside = col >= 0.0 && row >= 0.0 && col < self.cols as f64 && row < self.rows as f64;
        inside.then_some(Pixel {
            row: row as usize,
            col: col as usize,
        })
    }

    /// World position of a cell's centre.
    pub fn center(&self, pixel: Pixel) -> Point2<f64> {
        let cell = Vector2::new(pixel.col as f64 + 0.5, pixel.row as f64 + 0.5);
        self.origin_m + cell * self.pixel_size_m
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

    /// Share of cells whose height differs by more than `tolerance_m`: how much the scene changed.
    pub fn changed_fraction(&self, other: &Self, tolerance_m: f32) -> f64 {
        let changed = self
            .height_m
            .iter()
            .zip(&other.height_m)
            .filter(|(a, b)| (*a - *b).abs() > tolerance_m);
        changed.count() as f64 / self.workspace.len() as f64
    }
}
