//! The board.

use crate::tag36h11::{CODES, MODULES, is_white};
use heightmap::Camera;
use nalgebra::{Isometry3, Point2, Point3};
use serde::{Deserialize, Serialize};

/// A flat board of tags in rows and columns, ids counted along the rows. Its frame: origin at the upper left corner of the first tag's black
/// border, x along the rows, y down, z into the board.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Board {
    /// Rows of tags.
    pub rows: usize,
    /// Columns of tags.
    pub cols: usize,
    /// Edge length of a tag's black border.
    pub tag_m: f64,
    /// White between two tags.
    pub gap_m: f64,
    /// Id of the upper left tag.
    #[serde(default)]
    pub first_id: usize,
}

/// A dimension of the board is out of range.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("board.{field} is {value}, expected {expected}")]
pub struct BoardError {
    field: &'static str,
    value: f64,
    expected: &'static str,
}

impl Board {
    /// Two rows of three tags of 80 mm: 280 x 180 mm, for a sheet of A4, and large enough for cameras of 640 x 480 pixels at 1.2 m.
    pub const A4: Self = Self {
        rows: 2,
        cols: 3,
        tag_m: 0.08,
        gap_m: 0.02,
        first_id: 0,
    };

    /// Checks that all tags are of the family and lengths are lengths.
    ///
    /// # Errors
    /// Names the field.
    pub fn check(&self) -> Result<(), BoardError> {
        let count = self.rows.saturating_mul(self.cols);
        let length = |value: f64| value > 0.0 && value < 2.0;
        let tags = count.saturating_add(self.first_id);
        for (field, value, good, expected) in [
            ("rows", self.rows as f64, self.rows > 0, "1 or more"),
            ("cols", self.cols as f64, self.cols > 0, "1 or more"),
            (
                "first_id",
                self.first_id as f64,
                tags <= CODES.len(),
                "ids up to 23 on the board",
            ),
            ("tag_m", self.tag_m, length(self.tag_m), "a length in m"),
            ("gap_m", self.gap_m, length(self.gap_m), "a length in m"),
            (
                "gap_m",
                self.gap_m,
                self.gap_m >= 0.15 * self.tag_m,
                "a tag's module (an eighth of tag_m) and some more",
            ),
        ] {
            if !good {
                return Err(BoardError {
                    field,
                    value,
                    expected,
                });
            }
        }
        Ok(())
    }

    /// Corners of a tag's black border in the frame of the board: upper left, upper right, lower right, lower left. None for tags of other boards.
    pub fn corners(&self, id: usize) -> Option<[Point3<f64>; 4]> {
        let index = id.checked_sub(self.first_id)?;
        if index >= self.rows * self.cols {
            return None;
        }
        let pitch_m = self.tag_m + self.gap_m;
        let (x_m, y_m) = (
            (index % self.cols) as f64 * pitch_m,
            (index / self.cols) as f64 * pitch_m,
        );
        let t = self.tag_m;
        Some(
            [(0.0, 0.0), (t, 0.0), (t, t), (0.0, t)]
                .map(|(dx, dy)| Point3::new(x_m + dx, y_m + dy, 0.0)),
        )
    }

    /// The middle of the board in its frame.
    pub fn middle(&self) -> Point3<f64> {
        let half = |count: usize| 0.5 * (count as f64 * (self.tag_m + self.gap_m) - self.gap_m);
        Point3::new(half(self.cols), half(self.rows), 0.0)
    }

    /// Whether the board is white at a point of its plane. None beyond its edge, half a gap (and at least a module) around the tags.
    pub fn is_white(&self, x_m: f64, y_m: f64) -> Option<bool> {
        let pitch_m = self.tag_m + self.gap_m;
        let edge_m = self.gap_m.max(self.tag_m / MODULES as f64);
        let (width_m, height_m) = (
            self.cols as f64 * pitch_m - self.gap_m,
            self.rows as f64 * pitch_m - self.gap_m,
        );
        let inside = |value: f64, size_m: f64| value >= -edge_m && value < size_m + edge_m;
        if !(inside(x_m, width_m) && inside(y_m, height_m)) {
            return None;
        }
        let (col, row) = ((x_m / pitch_m).floor(), (y_m / pitch_m).floor());
        let (in_x, in_y) = (x_m - col * pitch_m, y_m - row * pitch_m);
        let tag = col >= 0.0
            && row >= 0.0
            && (col as usize) < self.cols
            && (row as usize) < self.rows
            && in_x < self.tag_m
            && in_y < self.tag_m;
        if !tag {
            return Some(true);
        }
        let module = |value: f64| ((value / self.tag_m * MODULES as f64) as usize).min(MODULES - 1);
        let id = self.first_id + row as usize * self.cols + col as usize;
        Some(is_white(id, module(in_x), module(in_y)))
    }

    /// Draws the board into a colour image as a camera would see it, in front of everything there: each pixel the mean over its area. `white` and
    /// `black` are its grey values.
    pub fn draw(
        &self,
        camera: &Camera,
        world_from_board: &Isometry3<f64>,
        (white, black): (f64, f64),
        rgb: &mut [u8],
    ) {
        const SUB: usize = 4;
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let board_from_camera = world_from_board.inverse() * camera.world_from_camera;
        let eye = board_from_camera.translation.vector;
        // From behind there is nothing to see; z points into the board.
        if eye.z >= 0.0 {
            return;
        }
        let pitch_m = self.tag_m + self.gap_m;
        let edge_m = self.gap_m.max(self.tag_m / MODULES as f64);
        let ends = |count: usize| [-edge_m, count as f64 * pitch_m - self.gap_m + edge_m];
        let corners = ends(self.cols)
            .into_iter()
            .flat_map(|x| ends(self.rows).map(|y| (x, y)));
        let seen: Option<Vec<Point2<f64>>> = corners
            .map(|(x, y)| {
                camera
                    .project(&(world_from_board * Point3::new(x, y, 0.0)))
                    .map(|(point, _)| point)
            })
            .collect();
        // Partly behind the camera it may be anywhere.
        let range = |axis: usize, size: usize| match &seen {
            None => 0..size,
            Some(seen) => {
                let low = seen
                    .iter()
                    .map(|point| point[axis])
                    .fold(f64::INFINITY, f64::min);
                let high = seen.iter().map(|point| point[axis]).fold(0.0, f64::max);
                (low - 4.0).max(0.0) as usize..((high + 5.0) as usize).min(size)
            }
        };
        for v in range(1, height) {
            for u in range(0, width) {
                let pixel = &mut rgb[3 * (v * width + u)..][..3];
                let mut sums = [0.0; 3];
                for sub in 0..SUB * SUB {
                    let part = |k: usize| (k as f64 + 0.5) / SUB as f64 - 0.5;
                    let point = Point2::new(u as f64 + part(sub % SUB), v as f64 + part(sub / SUB));
                    let ray = board_from_camera.rotation * camera.intrinsics.ray(&point);
                    let hit = eye - ray * (eye.z / ray.z);
                    let color = match self.is_white(hit.x, hit.y) {
                        Some(true) => [white; 3],
                        Some(false) => [black; 3],
                        None => [
                            f64::from(pixel[0]),
                            f64::from(pixel[1]),
                            f64::from(pixel[2]),
                        ],
                    };
                    sums = [0, 1, 2].map(|channel| sums[channel] + color[channel]);
                }
                for (value, sum) in pixel.iter_mut().zip(sums) {
                    *value = (sum / (SUB * SUB) as f64).round() as u8;
                }
            }
        }
    }

    /// A drawing for the printer, to be printed at its true size: an SVG file.
    pub fn svg(&self) -> String {
        let pitch_m = self.tag_m + self.gap_m;
        let edge_m = self.gap_m.max(self.tag_m / MODULES as f64);
        let module_m = self.tag_m / MODULES as f64;
        let mm = |metres: f64| (metres * 1e6).round() / 1e3;
        let size = |count: usize| mm(count as f64 * pitch_m - self.gap_m + 2.0 * edge_m);
        let (width, height) = (size(self.cols), size(self.rows));
        let mut text = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}mm\" height=\"{height}mm\" viewBox=\"0 0 {width} {height}\">\n\
             <rect width=\"{width}\" height=\"{height}\" fill=\"white\"/>\n"
        );
        for tag in 0..self.rows * self.cols {
            let left_m = (tag % self.cols) as f64 * pitch_m;
            let top_m = (tag / self.cols) as f64 * pitch_m;
            for module in 0..MODULES * MODULES {
                let (x_m, y_m) = (
                    left_m + (module % MODULES) as f64 * module_m,
                    top_m + (module / MODULES) as f64 * module_m,
                );
                if self.is_white(x_m + 0.5 * module_m, y_m + 0.5 * module_m) == Some(false) {
                    text += &format!(
                        "<rect x=\"{}\" y=\"{}\" width=\"{}\" height=\"{}\"/>\n",
                        mm(x_m + edge_m),
                        mm(y_m + edge_m),
                        mm(module_m),
                        mm(module_m),
                    );
                }
            }
        }
        text + "</svg>\n"
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boards_without_sense_are_refused_by_field() {
        let good = Board::A4;
        assert_eq!(good.check(), Ok(()));
        for (board, field) in [
            (Board { rows: 0, ..good }, "rows"),
            (
                Board {
                    rows: 5,
                    cols: 5,
                    ..good
                },
                "first_id",
            ),
            (
                Board {
                    tag_m: f64::NAN,
                    ..good
                },
                "tag_m",
            ),
            (
                Board {
                    gap_m: 0.001,
                    ..good
                },
                "gap_m",
            ),
            (
                Board {
                    rows: usize::MAX,
                    ..good
                },
                "first_id",
            ),
        ] {
            let error = board.check().unwrap_err().to_string();
            assert!(error.contains(field), "{error}");
        }
    }

    #[test]
    fn corners_lie_where_black_begins() {
        let board = Board::A4;
        for id in 0..6 {
            let corners = board.corners(id).unwrap();
            let middle = (corners[0] + corners[2].coords) / 2.0;
            for corner in corners {
                let inwards = (middle - corner) * 0.02;
                let (inside, outside) = (corner + inwards, corner - inwards);
                assert_eq!(board.is_white(inside.x, inside.y), Some(false));
                assert_eq!(board.is_white(outside.x, outside.y), Some(true));
            }
        }
        assert_eq!(board.corners(6), None);
        assert_eq!(board.is_white(-0.03, 0.0), None);
        let svg = board.svg();
        assert!(svg.contains("width=\"320mm\" height=\"220mm\""), "{svg}");
        // 28 modules of each border, and those of the codes.
        assert!(svg.matches("<rect").count() > 6 * 28 + 6);
    }
}
