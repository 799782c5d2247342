//! From heightmaps to the tensors that networks read.

use heightmap::{Heightmap, HeightmapError, Workspace};
use nalgebra::{Isometry2, Point2, Vector3};
use tch::Tensor;

use crate::augment::Warp;
use crate::{Error, Goal, GoalConditioning, Interpolation, NetworkConfig, Sample};

/// Colour (0..255) and height (m) of a cell.
type Cell = [f32; 4];

/// What a network reads of each cell: of the observation, then of each goal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Encoding {
    pub reading: Reading,
    /// Number of goal images.
    pub goals: usize,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Reading {
    /// RGB in 0..255 and height in metres.
    Raw,
    /// RGB and height, scaled. With each goal its difference from the observation, the mean absolute colour
    /// difference and the absolute height difference.
    Difference,
    /// RGB and height, scaled, of the observation o_t, of v_{k-1} and of v_k; then v_k - v_{k-1} and v_k - o_t, and of both
    /// the mean absolute colour difference and the absolute height difference. For exactly two goals: v_k, v_{k-1}.
    Sequence,
}

/// Channels of [`Reading::Sequence`]: where those of an image begin, four each.
pub(crate) mod sequence {
    pub const OBSERVATION: i64 = 0;
    pub const PREVIOUS: i64 = 4;
    pub const IMAGE: i64 = 8;
    pub const CHANNELS: usize = 24;
}

impl Reading {
    /// Channels of the observation and of so many goals.
    const fn channels(self, goals: usize) -> usize {
        match self {
            Self::Raw => 4 + 4 * goals,
            Self::Difference => 4 + 10 * goals,
            Self::Sequence => sequence::CHANNELS,
        }
    }

    #[inline(always)]
    fn write(self, observation: Cell, mut goals: impl Iterator<Item = Cell>, out: &mut [f32]) {
        // Heights of 40 mm, the edge of a block, count as much as half the range of a colour.
        let scaled = |cell: Cell| -> Cell {
            std::array::from_fn(|i| match (self, i) {
                (Self::Raw, _) => cell[i],
                (_, 3) => cell[3] * (1.0 / 0.04),
                (_, _) => cell[i] * (1.0 / 128.0) - 1.1,
            })
        };
        let difference = |a: Cell, b: Cell| -> Cell { std::array::from_fn(|i| a[i] - b[i]) };
        let sizes = |difference: Cell| {
            let color = difference[0].abs() + difference[1].abs() + difference[2].abs();
            [color * (1.0 / 3.0), difference[3].abs()]
        };
        let observation = scaled(observation);
        let (first, rest) = out.split_at_mut(4);
        first.copy_from_slice(&observation);
        match self {
            Self::Raw => {
                for (goal, out) in goals.zip(rest.chunks_exact_mut(4)) {
                    out.copy_from_slice(&goal);
                }
            }
            Self::Difference => {
                for (goal, out) in goals.zip(rest.chunks_exact_mut(10)) {
                    let goal = scaled(goal);
                    let difference = difference(goal, observation);
                    out[..4].copy_from_slice(&goal);
                    out[4..8].copy_from_slice(&difference);
                    out[8..].copy_from_slice(&sizes(difference));
                }
            }
            Self::Sequence => {
                let mut next = || goals.next().map(scaled).unwrap_or_default();
                let (image, previous) = (next(), next());
                let changes = [difference(image, previous), difference(image, observation)];
                rest[..4].copy_from_slice(&previous);
                rest[4..8].copy_from_slice(&image);
                for (index, change) in changes.into_iter().enumerate() {
                    rest[8 + 4 * index..12 + 4 * index].copy_from_slice(&change);
                    rest[16 + 2 * index..18 + 2 * index].copy_from_slice(&sizes(change));
                }
            }
        }
    }
}

impl Encoding {
    /// Number of channels.
    pub const fn channels(self) -> usize {
        self.reading.channels(self.goals)
    }
}

/// A heightmap as rows of cells, zero outside.
struct Image<'a> {
    rows: usize,
    cols: usize,
    rgb: &'a [u8],
    height_m: &'a [f32],
}

impl<'a> Image<'a> {
    fn new(heightmap: &'a Heightmap) -> Self {
        Self {
            rows: heightmap.workspace.rows,
            cols: heightmap.workspace.cols,
            rgb: &heightmap.rgb,
            height_m: &heightmap.height_m,
        }
    }

    #[inline(always)]
    fn cell(&self, row: i32, col: i32) -> Cell {
        // Negative indices wrap to huge ones.
        if row as u32 >= self.rows as u32 || col as u32 >= self.cols as u32 {
            return [0.0; 4];
        }
        self.at(row as usize * self.cols + col as usize)
    }

    #[inline(always)]
    fn at(&self, index: usize) -> Cell {
        let rgb = &self.rgb[3 * index..3 * index + 3];
        [
            rgb[0] as f32,
            rgb[1] as f32,
            rgb[2] as f32,
            self.height_m[index],
        ]
    }

    #[inline(always)]
    fn sample(&self, x: f32, y: f32, interpolation: Interpolation) -> Cell {
        match interpolation {
            Interpolation::Nearest => self.cell(y.floor() as i32, x.floor() as i32),
            Interpolation::Bilinear => {
                let (x, y) = (x - 0.5, y - 0.5);
                let (left, top) = (x.floor(), y.floor());
                let (right_share, bottom_share) = (x - left, y - top);
                let (row, col) = (top as i32, left as i32);
                let corners =
                    [(0, 0), (0, 1), (1, 0), (1, 1)].map(|(i, j)| self.cell(row + i, col + j));
                std::array::from_fn(|i| {
                    let top = corners[0][i] + right_share * (corners[1][i] - corners[0][i]);
                    let bottom = corners[2][i] + right_share * (corners[3][i] - corners[2][i]);
                    top + bottom_share * (bottom - top)
                })
            }
        }
    }
}

/// Writes what a network reads, cell after cell, rows first, into `out`. There are as many goals as the
/// encoding says.
pub(crate) fn encode(
    encoding: Encoding,
    observation: &Heightmap,
    goal: Goal<'_>,
    warp: &Warp,
    out: &mut [f32],
) {
    let observation = Image::new(observation);
    match (goal.last.or(goal.previous), encoding.goals) {
        (Some(second), 2) => {
            let goals = [goal.image, second].map(Image::new);
            encode_goals(encoding, &observation, goals, warp, out);
        }
        _ => encode_goals(encoding, &observation, [Image::new(goal.image)], warp, out),
    }
}

/// The same of an observation alone: of an encoding without goals.
pub(crate) fn encode_alone(
    encoding: Encoding,
    observation: &Heightmap,
    warp: &Warp,
    out: &mut [f32],
) {
    encode_goals(encoding, &Image::new(observation), [], warp, out);
}

fn encode_goals<const GOALS: usize>(
    encoding: Encoding,
    observation: &Image<'_>,
    goals: [Image<'_>; GOALS],
    warp: &Warp,
    out: &mut [f32],
) {
    use Interpolation::{Bilinear, Nearest};
    use Reading::{Difference, Raw, Sequence};
    // Constants, so that the inner loop has no branches.
    match (encoding.reading, warp.interpolation) {
        (Raw, Nearest) => encode_as(Raw, Nearest, observation, goals, warp, out),
        (Raw, Bilinear) => encode_as(Raw, Bilinear, observation, goals, warp, out),
        (Difference, Nearest) => encode_as(Difference, Nearest, observation, goals, warp, out),
        (Difference, Bilinear) => encode_as(Difference, Bilinear, observation, goals, warp, out),
        (Sequence, Nearest) => encode_as(Sequence, Nearest, observation, goals, warp, out),
        (Sequence, Bilinear) => encode_as(Sequence, Bilinear, observation, goals, warp, out),
    }
}

#[inline(always)]
fn encode_as<const GOALS: usize>(
    reading: Reading,
    interpolation: Interpolation,
    observation: &Image<'_>,
    goals: [Image<'_>; GOALS],
    warp: &Warp,
    out: &mut [f32],
) {
    let inverse = warp.motion_px.inverse();
    let (cos, sin) = (inverse.rotation.re, inverse.rotation.im);
    let offset = inverse.translation.vector;
    let color = |cell: Cell| match &warp.color {
        None => cell,
        Some(matrix) => {
            let rgb = matrix * Vector3::new(cell[0], cell[1], cell[2]);
            let rgb = rgb.map(|channel| channel.clamp(0.0, 255.0));
            [rgb.x, rgb.y, rgb.z, cell[3]]
        }
    };
    let last_col = observation.cols as f32;
    if *warp == Warp::identity() {
        let cells = out.chunks_exact_mut(reading.channels(GOALS));
        for (index, out) in cells.enumerate() {
            let goals = goals.iter().map(|goal| goal.at(index));
            reading.write(observation.at(index), goals, out);
        }
        return;
    }
    let cells = out.chunks_exact_mut(reading.channels(GOALS));
    for (index, out) in cells.enumerate() {
        let (row, col) = (index / observation.cols, index % observation.cols);
        let (x, y) = (col as f64 + 0.5, row as f64 + 0.5);
        let x_source = (cos * x - sin * y + offset.x) as f32;
        let y_source = (sin * x + cos * y + offset.y) as f32;
        let x_source = if warp.mirrored {
            last_col - x_source
        } else {
            x_source
        };
        let at = |number: usize, image: &Image<'_>| {
            let cell = color(image.sample(x_source, y_source, interpolation));
            match warp.sensors.get(number) {
                None => cell,
                Some(sensor) => sensor.read(index, cell),
            }
        };
        let seen = at(0, observation);
        let goals = goals.iter().enumerate();
        reading.write(seen, goals.map(|(number, goal)| at(number + 1, goal)), out);
    }
}

/// Makes a tensor N x channels x rows x cols, channels last in memory, of encoded images.
pub(crate) fn tensor(encoding: Encoding, [rows, cols]: [usize; 2], encoded: &[f32]) -> Tensor {
    let (rows, cols) = (rows as i64, cols as i64);
    Tensor::from_slice(encoded)
        .view([-1, rows, cols, encoding.channels() as i64])
        .permute([0, 3, 1, 2])
}

/// Refuses goals that are not those that the network is conditioned on. An image before the goal that it does not look at may
/// be there.
pub(crate) fn check_goal(config: &NetworkConfig, goal: Goal<'_>) -> Result<(), Error> {
    let conditioning = config.conditioning;
    let (last, previous) = match conditioning {
        GoalConditioning::NextStep | GoalConditioning::Final => (false, false),
        GoalConditioning::Both => (true, false),
        GoalConditioning::Sequence => (false, true),
    };
    for (what, expected, image) in [
        ("the final goal", last, goal.last),
        ("the image before the goal", previous, goal.previous),
    ] {
        if expected && image.is_none() {
            return Err(Error::GoalMissing { what, conditioning });
        }
    }
    if !last && goal.last.is_some() {
        return Err(Error::GoalTooMany { conditioning });
    }
    let images = [
        ("goal", Some(goal.image)),
        ("final goal", goal.last),
        ("image before the goal", goal.previous.filter(|_| previous)),
    ];
    images.into_iter().try_for_each(|(what, image)| {
        image.map_or(Ok(()), |image| check_heightmap(config, what, image))
    })
}

/// Refuses a heightmap that does not fit the network or itself.
pub(crate) fn check_heightmap(
    config: &NetworkConfig,
    what: &'static str,
    heightmap: &Heightmap,
) -> Result<(), Error> {
    config.check_workspace(&heightmap.workspace)?;
    check_cells(what, heightmap)
}

/// Refuses a heightmap that does not fit itself, or is not finite.
pub(crate) fn check_cells(what: &'static str, heightmap: &Heightmap) -> Result<(), Error> {
    let cells = heightmap.workspace.len();
    for (buffer, actual, expected) in [
        ("rgb", heightmap.rgb.len(), 3 * cells),
        ("height_m", heightmap.height_m.len(), cells),
    ] {
        if actual != expected {
            let source = HeightmapError::Size {
                what: buffer,
                actual,
                expected,
            };
            return Err(Error::Heightmap { what, source });
        }
    }
    match heightmap
        .height_m
        .iter()
        .position(|height| !height.is_finite())
    {
        Some(index) => {
            let source = HeightmapError::NotFinite { index };
            Err(Error::Heightmap { what, source })
        }
        None => Ok(()),
    }
}

/// Continuous image coordinates of a pose's position.
pub(crate) fn to_px(workspace: &Workspace, pose: &Isometry2<f64>) -> Point2<f64> {
    workspace.point_px(&pose.translation.vector.into())
}

/// World pose at continuous image coordinates.
pub(crate) fn to_world(
    workspace: &Workspace,
    point_px: Point2<f64>,
    yaw_rad: f64,
) -> Isometry2<f64> {
    Isometry2::new(workspace.point_m(&point_px).coords, yaw_rad)
}

/// What a sample teaches, in image coordinates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Label {
    /// Where to pick.
    pub pick_px: Point2<f64>,
    /// Where to place.
    pub place_px: Point2<f64>,
    /// Index of the rotation nearest to the object's turn.
    pub rotation: usize,
    /// Whether the step is done already: nothing is picked.
    pub done: bool,
}

impl Label {
    /// Checks the sample, and reads its label.
    pub fn of(config: &NetworkConfig, index: usize, sample: &Sample<'_>) -> Result<Self, Error> {
        check_heightmap(config, "observation", sample.observation)?;
        check_goal(config, sample.goal)?;
        let workspace = &sample.observation.workspace;
        for (what, pose) in [("pick", &sample.pick), ("place", &sample.place)] {
            let position = to_px(workspace, pose);
            let inside = (0.0..config.cols as f64).contains(&position.x)
                && (0.0..config.rows as f64).contains(&position.y);
            if !inside || !pose.rotation.angle().is_finite() {
                return Err(Error::Label {
                    index,
                    what,
                    x_m: pose.translation.x,
                    y_m: pose.translation.y,
                    yaw_rad: pose.rotation.angle(),
                });
            }
        }
        let turn = sample.pick.rotation.angle_to(&sample.place.rotation);
        Ok(Self {
            pick_px: to_px(workspace, &sample.pick),
            place_px: to_px(workspace, &sample.place),
            rotation: rotation_index(turn, config.rotations),
            done: sample.done,
        })
    }

    /// The label after a warp of images with so many columns. The object's turn stays, since both poses turn alike; mirrored, it
    /// goes the other way.
    pub fn warped(self, warp: &Warp, config: &NetworkConfig) -> Self {
        let rotation = match warp.mirrored {
            true => (config.rotations - self.rotation) % config.rotations,
            false => self.rotation,
        };
        Self {
            pick_px: warp.moved(self.pick_px, config.cols),
            place_px: warp.moved(self.place_px, config.cols),
            rotation,
            ..self
        }
    }
}

/// Index of the rotation nearest to an angle.
pub(crate) fn rotation_index(angle_rad: f64, rotations: usize) -> usize {
    let share = (angle_rad / std::f64::consts::TAU).rem_euclid(1.0);
    (share * rotations as f64).round() as usize % rotations
}

/// Angle of a rotation, in [0, 2 pi).
pub(crate) fn rotation_angle(index: usize, rotations: usize) -> f64 {
    std::f64::consts::TAU * index as f64 / rotations as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector2;
    use proptest::prelude::*;

    const RAW: Encoding = Encoding {
        reading: Reading::Raw,
        goals: 1,
    };

    #[test]
    fn each_goal_has_its_own_difference() {
        let [observation, next, last] = [1.0, 3.0, 6.0].map(|height_m: f32| {
            let mut heightmap = Heightmap::new(Workspace::RAVENS);
            heightmap.height_m.fill(0.04 * height_m);
            heightmap.rgb.fill(height_m as u8);
            heightmap
        });
        let reading = Reading::Difference;
        let encoding = Encoding { reading, goals: 2 };
        assert_eq!(encoding.channels(), 24);
        let mut out = vec![0.0; 24 * observation.workspace.len()];
        let goal = Goal {
            image: &next,
            last: Some(&last),
            previous: None,
        };
        encode(encoding, &observation, goal, &Warp::identity(), &mut out);
        let close = |index: usize, value: f32| (out[index] - value).abs() < 1e-6;
        // Height of the observation; height, its difference and absolute difference of each goal.
        for (index, value) in [
            (3, 1.0),
            (7, 3.0),
            (11, 2.0),
            (13, 2.0),
            (17, 6.0),
            (21, 5.0),
            (23, 5.0),
        ] {
            assert!(close(index, value), "channel {index} is {}", out[index]);
        }
        assert!(close(12, 2.0 / 128.0) && close(22, 5.0 / 128.0));
    }

    #[test]
    fn a_sequence_is_read_with_what_it_changed_and_what_is_left_to_change() {
        let [observation, previous, image] = [1.0, 3.0, 6.0].map(|height_m: f32| {
            let mut heightmap = Heightmap::new(Workspace::RAVENS);
            heightmap.height_m.fill(0.04 * height_m);
            heightmap.rgb.fill(height_m as u8);
            heightmap
        });
        let encoding = Encoding {
            reading: Reading::Sequence,
            goals: 2,
        };
        assert_eq!(encoding.channels(), sequence::CHANNELS);
        let mut out = vec![0.0; encoding.channels() * observation.workspace.len()];
        let goal = Goal::step(&previous, &image);
        encode(encoding, &observation, goal, &Warp::identity(), &mut out);
        // Heights: o, v_{k-1}, v_k, v_k - v_{k-1}, v_k - o, and both once more without a sign.
        let heights = [3, 7, 11, 15, 19, 21, 23].map(|channel| out[channel].round());
        assert_eq!(heights, [1.0, 3.0, 6.0, 3.0, 5.0, 3.0, 5.0]);
        assert!((out[20] - 3.0 / 128.0).abs() < 1e-6 && (out[22] - 5.0 / 128.0).abs() < 1e-6);
    }

    #[test]
    fn a_mirrored_label_lies_on_the_mirrored_object() {
        let heightmap = numbered();
        let warp = Warp {
            mirrored: true,
            motion_px: Isometry2::translation(3.0, 5.0),
            ..Warp::identity()
        };
        let label = Label {
            pick_px: Point2::new(20.5, 30.5),
            place_px: Point2::new(80.0, 160.0),
            rotation: 3,
            done: false,
        };
        let warped = label.warped(&warp, &NetworkConfig::compact());
        assert_eq!(warped.rotation, 33);
        let (row, col) = (warped.pick_px.y as usize, warped.pick_px.x as usize);
        assert_eq!(
            heights(&warp)[row * 160 + col],
            heightmap.height_m[30 * 160 + 20]
        );
    }

    fn numbered() -> Heightmap {
        let mut heightmap = Heightmap::new(Workspace::RAVENS);
        for (index, height) in heightmap.height_m.iter_mut().enumerate() {
            *height = index as f32;
        }
        heightmap
    }

    fn heights(warp: &Warp) -> Vec<f32> {
        let heightmap = numbered();
        let mut out = vec![0.0; 8 * heightmap.workspace.len()];
        encode(RAW, &heightmap, (&heightmap).into(), warp, &mut out);
        out.iter().skip(3).step_by(8).copied().collect()
    }

    #[test]
    fn no_warp_changes_nothing() {
        for interpolation in [Interpolation::Nearest, Interpolation::Bilinear] {
            let warp = Warp {
                interpolation,
                ..Warp::identity()
            };
            assert_eq!(heights(&warp), numbered().height_m);
        }
    }

    #[test]
    fn a_quarter_turn_takes_columns_to_rows() {
        // (x, y) -> (-y, x) about (80, 160): a point 10 to the right of the middle goes 10 below it.
        let middle = Vector2::new(80.0, 160.0);
        let motion_px = Isometry2::new(middle, 0.0)
            * Isometry2::rotation(std::f64::consts::FRAC_PI_2)
            * Isometry2::new(-middle, 0.0);
        let warp = Warp {
            motion_px,
            ..Warp::identity()
        };
        let heights = heights(&warp);
        let source = 160 * 160 + 90;
        // Cell centre (90.5, 160.5) goes to (79.5, 170.5).
        assert_eq!(heights[170 * 160 + 79], source as f32);
    }

    #[test]
    fn what_comes_from_outside_is_zero() {
        let warp = Warp {
            motion_px: Isometry2::translation(0.0, 5.0),
            ..Warp::identity()
        };
        let heights = heights(&warp);
        assert!(heights[..5 * 160].iter().all(|height| *height == 0.0));
        assert_eq!(heights[5 * 160 + 7], 7.0);
    }

    #[test]
    fn bilinear_samples_lie_between_cells() {
        let warp = Warp {
            motion_px: Isometry2::translation(0.25, 0.0),
            interpolation: Interpolation::Bilinear,
            ..Warp::identity()
        };
        assert_eq!(heights(&warp)[160 * 10 + 20], 160.0 * 10.0 + 20.0 - 0.25);
    }

    proptest! {
        #[test]
        fn a_warped_label_lies_on_the_warped_object(
            row in 60usize..260, col in 30usize..130, x in -20.0..20.0, y in -40.0..40.0, turn in -3.0..3.0f64,
        ) {
            let mut heightmap = Heightmap::new(Workspace::RAVENS);
            // 3 x 3 cells, so that nearest sampling cannot miss it.
            for row in row - 1..=row + 1 {
                for col in col - 1..=col + 1 {
                    heightmap.height_m[row * 160 + col] = 1.0;
                }
            }
            let middle = Vector2::new(80.0, 160.0);
            let motion_px = Isometry2::new(middle + Vector2::new(x, y), 0.0)
                * Isometry2::rotation(turn) * Isometry2::new(-middle, 0.0);
            let warp = Warp { motion_px, ..Warp::identity() };
            let label = motion_px * Point2::new(col as f64 + 0.5, row as f64 + 0.5);
            prop_assume!((1.0..159.0).contains(&label.x) && (1.0..319.0).contains(&label.y));
            let mut out = vec![0.0; 8 * heightmap.workspace.len()];
            encode(RAW, &heightmap, (&heightmap).into(), &warp, &mut out);
            let index = label.y.floor() as usize * 160 + label.x.floor() as usize;
            prop_assert_eq!(out[8 * index + 3], 1.0);
        }

        #[test]
        fn image_coordinates_come_back(x in 0.3..0.7, y in -0.4..0.4, yaw in -3.0..3.0f64) {
            let pose = Isometry2::new(Vector2::new(x, y), yaw);
            let point = to_px(&Workspace::RAVENS, &pose);
            let back = to_world(&Workspace::RAVENS, point, yaw);
            prop_assert!((back.translation.vector - pose.translation.vector).norm() < 1e-12);
            let pixel = Workspace::RAVENS.pixel(&Point2::new(x, y)).unwrap();
            prop_assert_eq!((pixel.col, pixel.row), (point.x as usize, point.y as usize));
        }

        #[test]
        fn rotations_round_to_the_nearest(index in 0usize..36, off in -0.08..0.08f64, turns in -2i32..3) {
            let angle = rotation_angle(index, 36) + off + f64::from(turns) * std::f64::consts::TAU;
            prop_assert_eq!(rotation_index(angle, 36), index);
        }
    }

    #[test]
    fn a_label_off_the_table_is_named() {
        let heightmap = numbered();
        let sample = Sample {
            observation: &heightmap,
            goal: (&heightmap).into(),
            pick: Isometry2::new(Vector2::new(0.5, 0.0), 0.0),
            place: Isometry2::new(Vector2::new(0.5, f64::NAN), 0.0),
            done: false,
        };
        let error = Label::of(&NetworkConfig::compact(), 3, &sample).unwrap_err();
        assert!(
            error.to_string().starts_with("sample 3: the place pose"),
            "{error}"
        );
    }
}
