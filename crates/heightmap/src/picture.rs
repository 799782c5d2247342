//! Pictures of heightmaps as PNG.
//!
//! Pictures show cells as they lie in memory: to the right is +x, away from the robot; down is +y, its
//! left. Yaw turns clockwise on the picture. A cell is [`SCALE`] pixels wide.

use crate::{Heightmap, Workspace};
use image::Rgb;
pub use image::RgbImage;
use nalgebra::{Isometry2, Point2, Vector2};
use std::path::{Path, PathBuf};

/// Edge length of a cell in a picture.
pub const SCALE: usize = 3;
/// Height drawn in the brightest colour.
const BRIGHTEST_M: f32 = 0.12;
/// Length of a pose's arrow.
const ARROW_M: f64 = 0.03;
const PICK: Rgb<u8> = Rgb([255, 40, 40]);
const PLACE: Rgb<u8> = Rgb([60, 255, 60]);

/// A picture that could not be written.
#[derive(Debug, thiserror::Error)]
#[error("{}: {source}", path.display())]
pub struct PictureError {
    /// The file.
    path: PathBuf,
    /// The reason.
    source: image::ImageError,
}

/// Colours of the cells.
pub fn colors(heightmap: &Heightmap) -> RgbImage {
    draw(&heightmap.workspace, |index| {
        Rgb([0, 1, 2].map(|channel| heightmap.rgb[3 * index + channel]))
    })
}

/// Heights of the cells, from dark blue at the table to yellow at 12 cm.
pub fn heights(heightmap: &Heightmap) -> RgbImage {
    draw(&heightmap.workspace, |index| {
        color_of(heightmap.height_m[index] / BRIGHTEST_M)
    })
}

/// Scores over the colours of the heightmap, brightest at the highest score. The grid of the scores may
/// be coarser than the heightmap's.
pub fn scores(heightmap: &Heightmap, rows: usize, cols: usize, scores: &[f32]) -> RgbImage {
    let highest = scores.iter().copied().fold(f32::MIN_POSITIVE, f32::max);
    let workspace = &heightmap.workspace;
    draw(workspace, |index| {
        let row = index / workspace.cols * rows / workspace.rows;
        let col = index % workspace.cols * cols / workspace.cols;
        // The square root shows also what is merely possible.
        let share = scores
            .get(row * cols + col)
            .map_or(0.0, |score| (score / highest).clamp(0.0, 1.0).sqrt());
        let hot = color_of(share);
        Rgb([0, 1, 2].map(|channel| {
            let cold = f32::from(heightmap.rgb[3 * index + channel]) * 0.6;
            (cold * (1.0 - share) + f32::from(hot[channel]) * share) as u8
        }))
    })
}

/// Draws a pick (red) and a place (green) as arrows along the yaw, with a line in between.
pub fn mark(
    picture: &mut RgbImage,
    workspace: &Workspace,
    pick: &Isometry2<f64>,
    place: &Isometry2<f64>,
) {
    let center = |pose: &Isometry2<f64>| Point2::from(pose.translation.vector);
    line(
        picture,
        workspace,
        center(pick),
        center(place),
        Rgb([255, 255, 255]),
    );
    for (pose, color) in [(pick, PICK), (place, PLACE)] {
        let tip = pose * Point2::new(ARROW_M, 0.0);
        line(picture, workspace, center(pose), tip, color);
        for barb in [-0.5, 0.5] {
            let barb = pose.rotation * Vector2::new(-ARROW_M / 3.0, barb * ARROW_M / 1.5);
            line(picture, workspace, tip, tip + barb, color);
        }
        for corner in 0..12 {
            let on_circle = |corner: i32| {
                let angle = f64::from(corner) * std::f64::consts::TAU / 12.0;
                center(pose) + Vector2::new(angle.cos(), angle.sin()) * (ARROW_M / 4.0)
            };
            line(
                picture,
                workspace,
                on_circle(corner),
                on_circle(corner + 1),
                color,
            );
        }
    }
}

/// Pictures next to each other, on a dark ground.
pub fn side_by_side(pictures: &[RgbImage]) -> RgbImage {
    const GAP: u32 = 6;
    let width = pictures
        .iter()
        .map(|picture| picture.width() + GAP)
        .sum::<u32>()
        .saturating_sub(GAP);
    let height = pictures.iter().map(RgbImage::height).max().unwrap_or(0);
    let mut all = RgbImage::from_pixel(width, height, Rgb([24, 24, 24]));
    let mut left = 0;
    for picture in pictures {
        image::imageops::replace(&mut all, picture, i64::from(left), 0);
        left += picture.width() + GAP;
    }
    all
}

/// Pictures below each other, on a dark ground.
pub fn stacked(pictures: &[RgbImage]) -> RgbImage {
    let turned: Vec<_> = pictures
        .iter()
        .map(image::imageops::rotate90)
        .rev()
        .collect();
    image::imageops::rotate270(&side_by_side(&turned))
}

/// Half as wide and high.
pub fn halved(picture: &RgbImage) -> RgbImage {
    image::imageops::thumbnail(picture, picture.width() / 2, picture.height() / 2)
}

/// An image of a camera: row-major, three bytes a pixel.
pub fn camera(width: usize, height: usize, rgb: &[u8]) -> RgbImage {
    RgbImage::from_fn(width as u32, height as u32, |u, v| {
        let index = 3 * (v as usize * width + u as usize);
        Rgb([0, 1, 2].map(|channel| rgb.get(index + channel).copied().unwrap_or_default()))
    })
}

/// Writes a picture as PNG.
pub fn write(path: &Path, picture: &RgbImage) -> Result<(), PictureError> {
    picture
        .save_with_format(path, image::ImageFormat::Png)
        .map_err(|source| PictureError {
            path: path.to_owned(),
            source,
        })
}

/// Writes colours and heights side by side, with an action marked if there is one.
pub fn write_heightmap(
    path: &Path,
    heightmap: &Heightmap,
    action: Option<(&Isometry2<f64>, &Isometry2<f64>)>,
) -> Result<(), PictureError> {
    let mut pictures = [colors(heightmap), heights(heightmap)];
    if let Some((pick, place)) = action {
        for picture in &mut pictures {
            mark(picture, &heightmap.workspace, pick, place);
        }
    }
    write(path, &side_by_side(&pictures))
}

fn draw(workspace: &Workspace, color: impl Fn(usize) -> Rgb<u8>) -> RgbImage {
    let size = |cells: usize| (cells * SCALE) as u32;
    RgbImage::from_fn(size(workspace.cols), size(workspace.rows), |u, v| {
        color(v as usize / SCALE * workspace.cols + u as usize / SCALE)
    })
}

/// Dark blue over green to yellow for 0 to 1: after matplotlib's viridis.
fn color_of(share: f32) -> Rgb<u8> {
    const STOPS: [[f32; 3]; 5] = [
        [68.0, 1.0, 84.0],
        [59.0, 82.0, 139.0],
        [33.0, 145.0, 140.0],
        [94.0, 201.0, 98.0],
        [253.0, 231.0, 37.0],
    ];
    // NaN becomes black.
    let place = share.clamp(0.0, 1.0) * 4.0;
    let below = (place as usize).min(3);
    let part = place - below as f32;
    Rgb([0, 1, 2].map(|channel| {
        (STOPS[below][channel] * (1.0 - part) + STOPS[below + 1][channel] * part) as u8
    }))
}

fn line(
    picture: &mut RgbImage,
    workspace: &Workspace,
    from: Point2<f64>,
    to: Point2<f64>,
    color: Rgb<u8>,
) {
    let scale = SCALE as f64 / workspace.pixel_size_m;
    let (from, to) = (
        (from - workspace.origin_m) * scale,
        (to - workspace.origin_m) * scale,
    );
    // A line off the picture, or one that is not finite, is not drawn, and not walked along either.
    let reach = f64::from(picture.width() + picture.height());
    if !(from.amax() <= reach && to.amax() <= reach) {
        return;
    }
    let steps = (to - from).amax().ceil().max(1.0) as u32;
    for step in 0..=steps {
        let at = from + (to - from) * (f64::from(step) / f64::from(steps));
        for (du, dv) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)] {
            let (u, v) = (at.x + du, at.y + dv);
            if u >= 0.0
                && v >= 0.0
                && u < f64::from(picture.width())
                && v < f64::from(picture.height())
            {
                picture.put_pixel(u as u32, v as u32, color);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Pixel;

    #[test]
    fn plus_x_is_to_the_right_and_plus_y_is_down() {
        let mut heightmap = Heightmap::new(Workspace::RAVENS);
        let pixel = Pixel { row: 300, col: 10 };
        let index = pixel.row * heightmap.workspace.cols + pixel.col;
        heightmap.rgb[3 * index] = 255;
        let picture = colors(&heightmap);
        assert_eq!((picture.width(), picture.height()), (480, 960));
        assert_eq!(picture.get_pixel(31, 901), &Rgb([255, 0, 0]));
        let pose = heightmap.workspace.pose(pixel, std::f64::consts::FRAC_PI_2);
        let mut picture = colors(&Heightmap::new(Workspace::RAVENS));
        mark(&mut picture, &heightmap.workspace, &pose, &pose);
        // The arrow of a quarter turn points down; 5 cells further on it is still there.
        assert_eq!(picture.get_pixel(31, 901 + 15), &PLACE);
        assert_ne!(picture.get_pixel(31, 901 - 15), &PLACE);
    }

    #[test]
    fn the_highest_score_is_the_brightest_on_a_coarser_grid_too() {
        let heightmap = Heightmap::new(Workspace::RAVENS);
        let mut map = vec![0.0; 80 * 40];
        map[20 * 40 + 30] = 0.7;
        map[60 * 40 + 10] = 0.1;
        let picture = scores(&heightmap, 80, 40, &map);
        let scale = SCALE as u32;
        let at = |row: u32, col: u32| *picture.get_pixel(scale * col + 1, scale * row + 1);
        assert_eq!(at(80, 120), Rgb([253, 231, 37]));
        assert_eq!(at(83, 123), Rgb([253, 231, 37]));
        assert_eq!(at(84, 124), Rgb([0, 0, 0]));
        // Merely possible, and still to be seen.
        assert!(at(240, 40)[1] > 30 && at(240, 40)[1] < at(80, 120)[1]);
    }

    #[test]
    fn a_picture_is_read_back_and_one_that_cannot_be_written_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("heightmap.png");
        let pose = Workspace::RAVENS.pose(Pixel { row: 10, col: 20 }, 0.3);
        let heightmap = Heightmap::new(Workspace::RAVENS);
        write_heightmap(&path, &heightmap, Some((&pose, &pose))).unwrap();
        let picture = image::open(&path).unwrap().into_rgb8();
        assert_eq!((picture.width(), picture.height()), (2 * 480 + 6, 960));
        let nowhere = folder.path().join("no/such/folder.png");
        let refusal = write_heightmap(&nowhere, &heightmap, None).unwrap_err();
        assert!(
            refusal.to_string().contains("no/such/folder.png"),
            "{refusal}"
        );
    }

    #[test]
    fn a_pose_that_is_not_finite_is_not_drawn() {
        let workspace = Workspace::RAVENS;
        let mut picture = colors(&Heightmap::new(workspace));
        let (nan, far) = (
            Isometry2::translation(f64::NAN, 0.0),
            Isometry2::translation(1e300, 0.0),
        );
        mark(&mut picture, &workspace, &nan, &far);
        assert!(picture.pixels().all(|pixel| *pixel == Rgb([0, 0, 0])));
    }
}
