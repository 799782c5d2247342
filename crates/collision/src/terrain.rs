//! A heightmap as solid columns.

use heightmap::Heightmap;
use nalgebra::Point2;

/// Cells along an edge of a column.
const BLOCK: usize = 2;

/// What stands on the table, as seen from above: solid columns of 2 x 2 cells, as high as the highest of them.
#[derive(Clone, Debug, PartialEq)]
pub struct Terrain {
    origin_m: Point2<f64>,
    columns: Grid,
    cells: Grid,
    highest_m: f32,
}

/// Squares side by side, each with a height.
#[derive(Clone, Debug, PartialEq)]
struct Grid {
    size_m: f64,
    rows: usize,
    cols: usize,
    height_m: Vec<f32>,
}

/// A solid column.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Column {
    /// Middle of its square.
    pub at: Point2<f64>,
    /// Edge of its square.
    pub size_m: f64,
    pub height_m: f64,
}

impl Terrain {
    /// The columns of a heightmap. A cell that was not seen is as high as the highest seen one beside it, cells further from any seen one
    /// as high as those.
    pub fn new(heightmap: &Heightmap) -> Self {
        let heights_m = filled(heightmap);
        let workspace = &heightmap.workspace;
        let cells = Grid {
            size_m: workspace.pixel_size_m,
            rows: workspace.rows,
            cols: workspace.cols,
            height_m: heights_m,
        };
        let (rows, cols) = (cells.rows.div_ceil(BLOCK), cells.cols.div_ceil(BLOCK));
        let mut height_m = vec![0.0f32; rows * cols];
        for row in 0..cells.rows {
            for col in 0..cells.cols {
                let block = &mut height_m[row / BLOCK * cols + col / BLOCK];
                *block = block.max(cells.height_m[row * cells.cols + col]);
            }
        }
        Self {
            origin_m: workspace.origin_m,
            highest_m: height_m.iter().copied().fold(0.0, f32::max),
            columns: Grid {
                size_m: BLOCK as f64 * workspace.pixel_size_m,
                rows,
                cols,
                height_m,
            },
            cells,
        }
    }

    /// Height of the highest column.
    pub fn highest_m(&self) -> f64 {
        f64::from(self.highest_m)
    }

    /// The columns that reach into a rectangle.
    pub(crate) fn columns(
        &self,
        low: Point2<f64>,
        high: Point2<f64>,
    ) -> impl Iterator<Item = Column> {
        self.columns.within(self.origin_m, low, high)
    }

    /// The cells that reach into a rectangle, as high as seen.
    pub(crate) fn cells(
        &self,
        low: Point2<f64>,
        high: Point2<f64>,
    ) -> impl Iterator<Item = Column> {
        self.cells.within(self.origin_m, low, high)
    }
}

impl Grid {
    fn within(
        &self,
        origin_m: Point2<f64>,
        low: Point2<f64>,
        high: Point2<f64>,
    ) -> impl Iterator<Item = Column> {
        let size_m = self.size_m;
        let range = |from: f64, to: f64, count: usize| {
            // Casts clamp, and take what is not a number for 0.
            let first = (from / size_m).floor().max(0.0) as usize;
            let last = (to / size_m).floor() + 1.0;
            first..(last.max(0.0) as usize).min(count)
        };
        let (low, high) = (low - origin_m, high - origin_m);
        let cols = range(low.x, high.x, self.cols);
        range(low.y, high.y, self.rows).flat_map(move |row| {
            cols.clone().map(move |col| {
                let at = nalgebra::Vector2::new(col as f64 + 0.5, row as f64 + 0.5) * size_m;
                let height_m = f64::from(self.height_m[row * self.cols + col]);
                Column {
                    at: origin_m + at,
                    size_m,
                    height_m,
                }
            })
        })
    }
}

/// Heights with those of cells that were not seen filled in from the seen ones around them, ring by ring.
fn filled(heightmap: &Heightmap) -> Vec<f32> {
    let (rows, cols) = (heightmap.workspace.rows, heightmap.workspace.cols);
    let mut heights_m = heightmap.height_m.clone();
    let mut known: Vec<bool> = (0..heights_m.len())
        .map(|index| heightmap.is_seen(index))
        .collect();
    if !known.contains(&true) {
        return heights_m;
    }
    let mut open: Vec<usize> = (0..known.len()).filter(|index| !known[*index]).collect();
    while !open.is_empty() {
        let ring: Vec<(usize, f32)> = open
            .iter()
            .filter_map(|index| {
                let (row, col) = (index / cols, index % cols);
                let near = (row.saturating_sub(1)..(row + 2).min(rows)).flat_map(|row| {
                    (col.saturating_sub(1)..(col + 2).min(cols)).map(move |col| row * cols + col)
                });
                let seen = near.filter(|near| known[*near]);
                let highest = seen.map(|near| heights_m[near]).max_by(f32::total_cmp);
                highest.map(|height_m| (*index, height_m))
            })
            .collect();
        for (index, height_m) in ring {
            heights_m[index] = height_m;
            known[index] = true;
        }
        open.retain(|index| !known[*index]);
    }
    heights_m
}

#[cfg(test)]
mod tests {
    use super::*;
    use heightmap::Workspace;

    #[test]
    fn columns_are_as_high_as_their_highest_cell_and_unseen_cells_as_their_neighbours() {
        let mut heightmap = Heightmap::new(Workspace::RAVENS);
        heightmap.rgb.fill(100);
        let index = |row: usize, col: usize| row * 160 + col;
        heightmap.height_m[index(10, 20)] = 0.05;
        // A shadow of 3 x 3 cells beside it.
        for row in 10..13 {
            for col in 21..24 {
                heightmap.rgb[3 * index(row, col)..][..3].fill(0);
            }
        }
        let terrain = Terrain::new(&heightmap);
        assert_eq!(terrain.highest_m(), f64::from(0.05f32));
        // A cell is no wider than it is.
        let cell = |row: usize, col: usize| {
            let at = heightmap.workspace.center(heightmap::Pixel { row, col });
            terrain.cells(at, at).next().unwrap().height_m as f32
        };
        assert_eq!((cell(10, 20), cell(10, 19), cell(11, 20)), (0.05, 0.0, 0.0));
        let height = |row: usize, col: usize| {
            let at = heightmap.workspace.center(heightmap::Pixel { row, col });
            terrain.columns(at, at).next().unwrap().height_m as f32
        };
        assert_eq!(height(11, 21), 0.05);
        // The far corner of the shadow lies beside the bare table.
        assert_eq!(height(12, 22), 0.0);
        assert_eq!(height(40, 40), 0.0);
        let nothing = Terrain::new(&Heightmap::new(Workspace::RAVENS));
        assert_eq!(nothing.highest_m(), 0.0);
        let far = Point2::new(5.0, 5.0);
        assert_eq!(terrain.columns(far, far).count(), 0);
        let everything = terrain.columns(Point2::new(-9.0, -9.0), Point2::new(9.0, 9.0));
        assert_eq!(everything.count(), 160 * 80);
    }
}
