//! Tags in a grey image.

use crate::tag36h11::{MODULES, decode};
use nalgebra::{Matrix3, Point2, SMatrix, SVector, Vector2, Vector3};

/// A grey image, row-major.
#[derive(Clone, Copy, Debug)]
pub struct GrayImage<'a> {
    /// Pixels along a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `width * height` values.
    pub pixels: &'a [u8],
}

/// Grey values of an image of red, green and blue.
pub fn gray_pixels(rgb: &[u8]) -> Vec<u8> {
    let gray = |rgb: &[u8; 3]| {
        let [red, green, blue] = rgb.map(u32::from);
        ((red * 77 + green * 150 + blue * 29) >> 8) as u8
    };
    rgb.as_chunks::<3>().0.iter().map(gray).collect()
}

/// A tag in an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tag {
    /// Number in the family.
    pub id: usize,
    /// Corners of its black border in pixels (pixel centres have whole coordinates), as printed: upper left, upper right, lower right, lower left.
    pub corners_px: [Point2<f64>; 4],
}

/// Half the edge of the window whose mean decides what is dark, as a share of the image's width.
const WINDOW_SHARE: usize = 24;
/// A pixel is dark if it is so far (of 255) below the mean around it.
const DARKER_BY: i64 = 8;
/// A tag's least edge in pixels: two for each module.
const LEAST_EDGE_PX: f64 = 16.0;
/// Least difference of black and white in a tag, of 255.
const LEAST_CONTRAST: f64 = 25.0;

/// All tags in an image, each once, in the order of their ids.
///
/// # Panics
/// When `pixels` has another size than the image.
pub fn detect(image: &GrayImage<'_>) -> Vec<Tag> {
    assert_eq!(
        image.pixels.len(),
        image.width * image.height,
        "pixels of the image"
    );
    let mut tags: Vec<(f64, Tag)> = Vec::new();
    for hull in dark_hulls(image) {
        let Some(quad) = quad_of(&hull) else {
            continue;
        };
        // The second time the window lies about the edge.
        let Some(quad) = refine(image, &quad).and_then(|quad| refine(image, &quad)) else {
            continue;
        };
        if let Some(tag) = read(image, &quad) {
            let size = area(&quad);
            match tags.iter_mut().find(|(_, other)| other.id == tag.id) {
                Some(known) if known.0 < size => *known = (size, tag),
                Some(_) => (),
                None => tags.push((size, tag)),
            }
        }
    }
    tags.sort_by_key(|(_, tag)| tag.id);
    tags.into_iter().map(|(_, tag)| tag).collect()
}

/// Convex hulls of connected dark pixels, clockwise as seen.
fn dark_hulls(image: &GrayImage<'_>) -> Vec<Vec<Point2<f64>>> {
    let GrayImage { width, height, .. } = *image;
    let mut dark = darks(image);
    let mut hulls = Vec::new();
    let mut stack = Vec::new();
    for start in 0..dark.len() {
        if !std::mem::take(&mut dark[start]) {
            continue;
        }
        stack.push(start);
        // Leftmost and rightmost pixel of each row.
        let first_row = start / width;
        let mut rows: Vec<(usize, usize)> = Vec::new();
        let mut count = 0;
        while let Some(index) = stack.pop() {
            let (u, v) = (index % width, index / width);
            count += 1;
            let row = v - first_row;
            if rows.len() <= row {
                rows.resize(row + 1, (usize::MAX, 0));
            }
            rows[row] = (rows[row].0.min(u), rows[row].1.max(u));
            for v in v.saturating_sub(1).max(first_row)..(v + 2).min(height) {
                for u in u.saturating_sub(1)..(u + 2).min(width) {
                    if std::mem::take(&mut dark[v * width + u]) {
                        stack.push(v * width + u);
                    }
                }
            }
        }
        let wide = rows.iter().map(|row| row.1).max()
            >= rows.iter().map(|row| row.0).min().map(|left| left + 6);
        if rows.len() < 6 || !wide || count < 60 || count > dark.len() / 4 {
            continue;
        }
        let points = rows
            .iter()
            .enumerate()
            .filter(|(_, row)| row.0 != usize::MAX);
        let points = points.flat_map(|(row, (left, right))| {
            let v = (first_row + row) as f64;
            [Point2::new(*left as f64, v), Point2::new(*right as f64, v)]
        });
        hulls.push(hull(points.collect()));
    }
    hulls
}

/// Pixels darker than the mean around them.
fn darks(image: &GrayImage<'_>) -> Vec<bool> {
    let GrayImage {
        width,
        height,
        pixels,
    } = *image;
    let mut sums = vec![0i64; (width + 1) * (height + 1)];
    for v in 0..height {
        let mut row = 0;
        for u in 0..width {
            row += i64::from(pixels[v * width + u]);
            sums[(v + 1) * (width + 1) + u + 1] = sums[v * (width + 1) + u + 1] + row;
        }
    }
    let reach = (width / WINDOW_SHARE).max(8);
    let mut dark = vec![false; width * height];
    for v in 0..height {
        let (top, bottom) = (v.saturating_sub(reach), (v + reach + 1).min(height));
        for u in 0..width {
            let (left, right) = (u.saturating_sub(reach), (u + reach + 1).min(width));
            let sum = |v: usize, u: usize| sums[v * (width + 1) + u];
            let total = sum(bottom, right) - sum(top, right) - sum(bottom, left) + sum(top, left);
            let count = ((bottom - top) * (right - left)) as i64;
            dark[v * width + u] = (i64::from(pixels[v * width + u]) + DARKER_BY) * count < total;
        }
    }
    dark
}

fn cross(a: &Point2<f64>, b: &Point2<f64>, c: &Point2<f64>) -> f64 {
    (b - a).perp(&(c - a))
}

/// Convex hull by monotone chains; clockwise as seen (y down).
fn hull(mut points: Vec<Point2<f64>>) -> Vec<Point2<f64>> {
    points.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    let half = |points: &mut dyn Iterator<Item = Point2<f64>>| {
        let mut chain: Vec<Point2<f64>> = Vec::new();
        for point in points {
            while chain.len() > 1
                && cross(&chain[chain.len() - 2], &chain[chain.len() - 1], &point) <= 0.0
            {
                chain.pop();
            }
            chain.push(point);
        }
        chain.pop();
        chain
    };
    let mut all = half(&mut points.iter().copied());
    all.extend(half(&mut points.iter().rev().copied()));
    all
}

/// Positive for corners that go clockwise as seen (y down).
fn area(corners: &[Point2<f64>]) -> f64 {
    let next = corners.iter().cycle().skip(1);
    0.5 * corners
        .iter()
        .zip(next)
        .map(|(a, b)| a.coords.perp(&b.coords))
        .sum::<f64>()
}

/// The four corners of a hull, if it has four.
fn quad_of(hull: &[Point2<f64>]) -> Option<[Point2<f64>; 4]> {
    if hull.len() < 4 {
        return None;
    }
    let center = hull
        .iter()
        .fold(Vector2::zeros(), |sum, point| sum + point.coords)
        / hull.len() as f64;
    let furthest = |value: &dyn Fn(&Point2<f64>) -> f64| {
        (0..hull.len()).max_by(|a, b| value(&hull[*a]).total_cmp(&value(&hull[*b])))
    };
    let mut a = furthest(&|point| (point.coords - center).norm())?;
    let mut c = furthest(&|point| (point - hull[a]).norm())?;
    let (mut b, mut d) = (a, c);
    // Each pair is as far from the line through the other as can be.
    for _ in 0..3 {
        let (from, to) = (hull[a], hull[c]);
        b = furthest(&|point| -cross(&from, &to, point))?;
        d = furthest(&|point| cross(&from, &to, point))?;
        let (from, to) = (hull[b], hull[d]);
        a = furthest(&|point| cross(&from, &to, point))?;
        c = furthest(&|point| -cross(&from, &to, point))?;
    }
    let mut quad = [a, b, c, d].map(|index| hull[index]);
    if area(&quad) < 0.0 {
        quad.reverse();
    }
    let share = area(hull) / area(&quad);
    let long = (0..4).all(|i| (quad[i] - quad[(i + 1) % 4]).norm() > 0.5 * LEAST_EDGE_PX);
    let convex = (0..4).all(|i| cross(&quad[i], &quad[(i + 1) % 4], &quad[(i + 2) % 4]) > 0.0);
    ((0.9..1.25).contains(&share) && long && convex).then_some(quad)
}

/// Brightness between pixels. None outside the image.
fn bright(image: &GrayImage<'_>, at: &Point2<f64>) -> Option<f64> {
    let (u, v) = (at.x.floor(), at.y.floor());
    if !(u >= 0.0 && v >= 0.0 && u + 1.0 < image.width as f64 && v + 1.0 < image.height as f64) {
        return None;
    }
    let (du, dv) = (at.x - u, at.y - v);
    let pixel = |right: usize, down: usize| {
        f64::from(image.pixels[(v as usize + down) * image.width + u as usize + right])
    };
    let upper = pixel(0, 0) + du * (pixel(1, 0) - pixel(0, 0));
    let lower = pixel(0, 1) + du * (pixel(1, 1) - pixel(0, 1));
    Some(upper + dv * (lower - upper))
}

/// Corners where straight lines through the edges meet, each edge where the brightness changes most.
fn refine(image: &GrayImage<'_>, quad: &[Point2<f64>; 4]) -> Option<[Point2<f64>; 4]> {
    let mut lines = [(Point2::origin(), Vector2::zeros()); 4];
    for (i, line) in lines.iter_mut().enumerate() {
        let (from, to) = (quad[i], quad[(i + 1) % 4]);
        let length = (to - from).norm();
        if length < 0.5 * LEAST_EDGE_PX {
            return None;
        }
        let along = (to - from) / length;
        let outwards = Vector2::new(along.y, -along.x);
        // Inwards, the border is a module wide. How wide that is follows from the edges beside.
        let depth = (quad[(i + 3) % 4] - from)
            .norm()
            .min((quad[(i + 2) % 4] - to).norm());
        let reach = (0.8 * depth / MODULES as f64).clamp(1.0, 3.0);
        let count = (0.8 * length).floor().max(6.0);
        let mut points = Vec::new();
        for step in 0..=count as usize {
            let at = from + along * (length * (0.1 + 0.8 * step as f64 / count));
            if let Some(offset) = edge_offset(image, &at, &outwards, reach) {
                points.push(at + outwards * offset);
            }
        }
        *line = fit_line(points)?;
    }
    let mut corners = [Point2::origin(); 4];
    for (i, corner) in corners.iter_mut().enumerate() {
        *corner = meet(&lines[(i + 3) % 4], &lines[i])?;
        if (*corner - quad[i]).norm() > 4.0 {
            return None;
        }
    }
    Some(corners)
}

/// Where along the normal the brightness rises: middle of the gradient within the reach. None where it hardly does.
fn edge_offset(
    image: &GrayImage<'_>,
    at: &Point2<f64>,
    outwards: &Vector2<f64>,
    reach: f64,
) -> Option<f64> {
    const STEP: f64 = 0.25;
    let steps = (reach / STEP).round() as i32;
    let (mut sum, mut moment) = (0.0, 0.0);
    let mut before = bright(image, &(at - outwards * (f64::from(steps) + 0.5) * STEP))?;
    for step in -steps..=steps {
        let offset = f64::from(step) * STEP;
        let after = bright(image, &(at + outwards * (offset + 0.5 * STEP)))?;
        let rise = (after - before).max(0.0);
        // Noise rises everywhere a little.
        if rise > 1.0 {
            sum += rise;
            moment += rise * offset;
        }
        before = after;
    }
    (sum > 0.5 * LEAST_CONTRAST).then(|| moment / sum)
}

/// The line through points, those far off left out: a point on it and its direction.
fn fit_line(mut points: Vec<Point2<f64>>) -> Option<(Point2<f64>, Vector2<f64>)> {
    let mut line = None;
    for _ in 0..3 {
        if points.len() < 5 {
            return None;
        }
        let count = points.len() as f64;
        let center = points
            .iter()
            .fold(Vector2::zeros(), |sum, point| sum + point.coords)
            / count;
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for point in &points {
            let off = point.coords - center;
            xx += off.x * off.x;
            xy += off.x * off.y;
            yy += off.y * off.y;
        }
        let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
        let direction = Vector2::new(angle.cos(), angle.sin());
        let off = |point: &Point2<f64>| direction.perp(&(point.coords - center)).abs();
        let spread = (points.iter().map(|point| off(point).powi(2)).sum::<f64>() / count).sqrt();
        line = Some((Point2::from(center), direction));
        let before = points.len();
        points.retain(|point| off(point) <= (2.5 * spread).max(0.05));
        if points.len() == before {
            break;
        }
    }
    line
}

fn meet(a: &(Point2<f64>, Vector2<f64>), b: &(Point2<f64>, Vector2<f64>)) -> Option<Point2<f64>> {
    let across = a.1.perp(&b.1);
    (across.abs() > 0.1).then(|| a.0 + a.1 * ((b.0 - a.0).perp(&b.1) / across))
}

/// The tag in a quadrilateral.
fn read(image: &GrayImage<'_>, quad: &[Point2<f64>; 4]) -> Option<Tag> {
    let size = MODULES as f64;
    let unit = [(0.0, 0.0), (size, 0.0), (size, size), (0.0, size)].map(|(x, y)| Point2::new(x, y));
    let homography = homography(&unit, quad)?;
    let at = |x: f64, y: f64| -> Option<f64> {
        let mut sum = 0.0;
        for (dx, dy) in [
            (0.0, 0.0),
            (0.2, 0.2),
            (-0.2, 0.2),
            (0.2, -0.2),
            (-0.2, -0.2),
        ] {
            let image_point = homography * Vector3::new(x + dx, y + dy, 1.0);
            sum += bright(
                image,
                &Point2::new(image_point.x / image_point.z, image_point.y / image_point.z),
            )?;
        }
        Some(sum / 5.0)
    };
    let (mut white, mut black) = (0.0, 0.0);
    let ring = (0..MODULES).map(|i| i as f64 + 0.5);
    for i in ring {
        for (x, y) in [(i, -0.5), (i, size + 0.5), (-0.5, i), (size + 0.5, i)] {
            white += at(x, y)? / (4.0 * size);
        }
        for (x, y) in [(i, 0.5), (i, size - 0.5), (0.5, i), (size - 0.5, i)] {
            black += at(x, y)? / (4.0 * size);
        }
    }
    if white - black < LEAST_CONTRAST {
        return None;
    }
    let middle = 0.5 * (white + black);
    let mut modules = [[false; MODULES]; MODULES];
    let mut wrong = 0;
    for (row, modules) in modules.iter_mut().enumerate() {
        for (col, module) in modules.iter_mut().enumerate() {
            *module = at(col as f64 + 0.5, row as f64 + 0.5)? > middle;
            let border = |index: usize| index == 0 || index == MODULES - 1;
            wrong += usize::from(*module && (border(row) || border(col)));
        }
    }
    if wrong > 2 {
        return None;
    }
    let (id, turns) = decode(|col, row| modules[row][col])?;
    // Turned clockwise by a quarter, the tag's upper left corner is the second of the quadrilateral.
    let corners_px = [0, 1, 2, 3].map(|i| quad[(i + turns) % 4]);
    Some(Tag { id, corners_px })
}

/// The homography that takes four points to four others, bottom right element 1.
fn homography(from: &[Point2<f64>; 4], to: &[Point2<f64>; 4]) -> Option<Matrix3<f64>> {
    let mut matrix = SMatrix::<f64, 8, 8>::zeros();
    let mut right = SVector::<f64, 8>::zeros();
    for (i, (from, to)) in from.iter().zip(to).enumerate() {
        let (x, y) = (from.x, from.y);
        let rows = [
            [x, y, 1.0, 0.0, 0.0, 0.0, -x * to.x, -y * to.x],
            [0.0, 0.0, 0.0, x, y, 1.0, -x * to.y, -y * to.y],
        ];
        for (j, (row, value)) in rows.into_iter().zip([to.x, to.y]).enumerate() {
            matrix.set_row(2 * i + j, &SVector::from(row).transpose());
            right[2 * i + j] = value;
        }
    }
    let h = matrix.lu().solve(&right)?;
    Some(Matrix3::new(
        h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], 1.0,
    ))
}
