//! `sctn calibrate`: where the cameras stand, from images of a board at the tool.

use crate::root::Root;
use anyhow::{Context, Result, bail, ensure};
use bags::BagReader;
use calibration::{
    Board, BoardView, Calibration, CameraViews, GrayImage, View, board_pose, check_swapped, detect,
    gray_pixels, solve, table,
};
use clap::Args;
use heightmap::Intrinsics;
use heightmap::picture::{self, RgbImage};
use msgs::{CameraPreset, convert, sensor_msgs};
use nalgebra::{Isometry3, Point2};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;
use ur5::{Arm, ArmCalibration, DhLengths, Joints, WorkCell};

/// Arguments of `sctn calibrate`.
///
/// A folder holds `session.yaml` and the images that it names:
///
///   board: {rows: 2, cols: 3, tag_m: 0.08, gap_m: 0.02}
///   cameras:
///     front: {width: 640, height: 480, fx_px: 615.0, fy_px: 615.0, cx_px: 320.0, cy_px: 240.0}
///   views:
///   - joints_rad: [0.0, -1.6, 1.5, -1.4, -1.57, 0.0]
///     images: {front: front_00.png}
///   - on_table: true
///     images: {front: front_table.png}
#[derive(Args)]
#[command(verbatim_doc_comment)]
pub struct Calibrate {
    /// Folder with session.yaml and images, or a bag with colour images, camera_info and joint_states
    #[arg(required_unless_present = "draw_board")]
    recording: Option<PathBuf>,
    /// Write a board for the printer (SVG, true size) and end: the one of --board, or 2 x 3 tags of 80 mm
    #[arg(long, value_name = "FILE")]
    draw_board: Option<PathBuf>,
    /// YAML file with the fields of `board`, for bags and for --draw-board
    #[arg(long, value_name = "FILE")]
    board: Option<PathBuf>,
    /// Names of the cameras in a bag, with which the names of their topics begin
    #[arg(long, value_delimiter = ',', default_values_t = ["front".to_owned(), "left".to_owned(), "right".to_owned()])]
    cameras: Vec<String>,
    /// Driver of the cameras, as the parameter camera_preset of camera_fusion: simulated, realsense, realsense_aligned, orbbec, zed or zed_5_0
    #[arg(long, default_value_t = CameraPreset::Simulated)]
    camera_preset: CameraPreset,
    /// The cell [default: urdf/workcell.urdf]
    #[arg(long, value_name = "FILE")]
    urdf: Option<PathBuf>,
    /// Factory calibration of the arm, as the UR driver's ur_calibration writes it
    #[arg(long, value_name = "FILE")]
    arm_calibration: Option<PathBuf>,
    /// Calibration file to write, for the parameter `calibration` of camera_fusion
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// PNG to write: an image of each camera with the corners found (green) and their residuals, 20 times as long (red)
    #[arg(long, value_name = "FILE")]
    picture: Option<PathBuf>,
    /// Largest tilt of the table against the robot's base, in degrees
    #[arg(long, default_value_t = 0.5)]
    max_tilt_deg: f64,
    /// Print a JSON object last
    #[arg(long)]
    json: bool,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SessionFile {
    board: Board,
    cameras: BTreeMap<String, Intrinsics>,
    views: Vec<ViewEntry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ViewEntry {
    joints_rad: Option<[f64; 6]>,
    #[serde(default)]
    on_table: bool,
    images: BTreeMap<String, PathBuf>,
}

/// What was recorded, tags found.
struct Session {
    board: Board,
    cameras: Vec<(String, Intrinsics)>,
    /// Joint positions with the board at the tool.
    joints: Vec<Joints>,
    /// By camera.
    views: Vec<Vec<View>>,
    /// By camera: the board on the table.
    on_table: Vec<Vec<BoardView>>,
    /// By camera: its first image that shows the board, and which of its views that is.
    shown: Vec<Option<(usize, RgbImage)>>,
}

impl Session {
    fn new(board: Board, cameras: Vec<(String, Intrinsics)>) -> Result<Self> {
        board.check()?;
        let count = cameras.len();
        Ok(Self {
            board,
            cameras,
            joints: Vec::new(),
            views: vec![Vec::new(); count],
            on_table: vec![Vec::new(); count],
            shown: vec![None; count],
        })
    }

    /// Takes an image; `pose` is the index of the joint position, or none for a board on the table.
    fn take(&mut self, camera: usize, pose: Option<usize>, rgb: &[u8]) {
        let intrinsics = self.cameras[camera].1;
        let gray = gray_pixels(rgb);
        let (width, height) = (intrinsics.width, intrinsics.height);
        let tags = detect(&GrayImage {
            width,
            height,
            pixels: &gray,
        });
        let Some(board) = board_pose(&self.board, &intrinsics, &tags) else {
            return;
        };
        match pose {
            None => self.on_table[camera].push(board),
            Some(pose) => {
                if self.shown[camera].is_none() {
                    self.shown[camera] = Some((
                        self.views[camera].len(),
                        picture::camera(width, height, rgb),
                    ));
                }
                self.views[camera].push(View { pose, board });
            }
        }
    }

    fn of_folder(folder: &Path) -> Result<Self> {
        let path = folder.join("session.yaml");
        let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
        let file: SessionFile =
            serde_yaml_ng::from_str(&text).with_context(|| path.display().to_string())?;
        let cameras: Vec<_> = file.cameras.into_iter().collect();
        let mut session =
            Self::new(file.board, cameras).with_context(|| path.display().to_string())?;
        for (index, view) in file.views.iter().enumerate() {
            let named = || format!("{}: views[{index}]", path.display());
            let pose = match (view.joints_rad, view.on_table) {
                (Some(joints), false) => {
                    ensure!(
                        joints.iter().all(|q| q.is_finite()),
                        "{}.joints_rad is not finite",
                        named()
                    );
                    session.joints.push(Joints::from(joints));
                    Some(session.joints.len() - 1)
                }
                (None, true) => None,
                _ => bail!("{}: expected either joints_rad or on_table: true", named()),
            };
            for (name, file) in &view.images {
                let camera = session.cameras.iter().position(|(other, _)| other == name);
                let camera = camera.with_context(|| {
                    format!(
                        "{}.images names {name}, expected one of the cameras",
                        named()
                    )
                })?;
                let file = folder.join(file);
                let image = image::open(&file)
                    .with_context(|| file.display().to_string())?
                    .into_rgb8();
                let Intrinsics { width, height, .. } = session.cameras[camera].1;
                ensure!(
                    (image.width() as usize, image.height() as usize) == (width, height),
                    "{}: {} x {} pixels, expected {width} x {height} of camera {name}",
                    file.display(),
                    image.width(),
                    image.height()
                );
                session.take(camera, pose, image.as_raw());
            }
        }
        Ok(session)
    }

    /// From a bag: the first image of each camera in each span of time in which the arm rests.
    fn of_bag(
        path: &Path,
        board: Board,
        names: &[String],
        preset: CameraPreset,
        cell: &WorkCell,
    ) -> Result<Self> {
        let bag = BagReader::open(path)?;
        let topic = |name: &str| format!("/{name}");
        let mut cameras = Vec::new();
        for name in names {
            let info = topic(&preset.topics(name).color_info);
            let last = bag.last_before(&info, Duration::MAX)?;
            let message =
                last.with_context(|| format!("{}: no message on {info}", path.display()))?;
            let intrinsics =
                convert::intrinsics_from_msg(&message.decode::<sensor_msgs::CameraInfo>()?)
                    .with_context(|| format!("{}: {info}", path.display()))?;
            cameras.push((name.clone(), intrinsics));
        }
        let mut session = Self::new(board, cameras)?;
        let images: Vec<String> = names
            .iter()
            .map(|name| topic(&preset.topics(name).color))
            .collect();
        let mut topics: Vec<&str> = images.iter().map(String::as_str).collect();
        topics.push("/joint_states");
        let mut rest: Option<(Duration, Joints)> = None;
        let mut taken: Option<(usize, Vec<bool>)> = None;
        let mut rgb = Vec::new();
        for message in bag.messages_between(&topics, Duration::ZERO, Duration::MAX) {
            let message = message?;
            let Some(camera) = images.iter().position(|image| *image == message.topic.name) else {
                let state = message.decode::<sensor_msgs::JointState>()?;
                let joints = convert::joints_from_msg(&state, &cell.joint_names)
                    .with_context(|| format!("{}: /joint_states", path.display()))?;
                if !rest.is_some_and(|(_, at)| (at - joints).amax() < RESTING_RAD) {
                    rest = Some((message.log_time, joints));
                    taken = None;
                }
                continue;
            };
            let Some((_, joints)) = rest.filter(|(since, _)| message.log_time >= *since + RESTING)
            else {
                continue;
            };
            let (pose, done) = taken.get_or_insert_with(|| {
                session.joints.push(joints);
                (session.joints.len() - 1, vec![false; names.len()])
            });
            if std::mem::replace(&mut done[camera], true) {
                continue;
            }
            let image = message.decode::<sensor_msgs::Image>()?;
            convert::color_from_msg(&image, &session.cameras[camera].1, &mut rgb)
                .with_context(|| format!("{}: {}", path.display(), message.topic.name))?;
            let pose = *pose;
            session.take(camera, Some(pose), &rgb);
        }
        Ok(session)
    }
}

/// The arm rests while no joint is further from where it was when it came to rest.
const RESTING_RAD: f64 = 1e-3;
/// Images count from so long after that on.
const RESTING: Duration = Duration::from_millis(500);

#[derive(Serialize)]
struct Report {
    cameras: Vec<CameraReport>,
    /// Where the board is in the frame of the suction tip.
    board_translation_m: [f64; 3],
    table: Option<TableReport>,
    out: Option<PathBuf>,
}

#[derive(Serialize)]
struct CameraReport {
    name: String,
    views: usize,
    /// Poses of the tool, counted from 0, whose images did not fit.
    left_out: Vec<usize>,
    rms_px: f64,
    rms_mm: f64,
    position_sigma_mm: f64,
    rotation_sigma_deg: f64,
    /// From where the URDF has the camera.
    moved_mm: Option<f64>,
    turned_deg: Option<f64>,
    translation_m: [f64; 3],
    rotation_xyzw: [f64; 4],
}

#[derive(Serialize)]
struct TableReport {
    tilt_deg: f64,
    height_mm: f64,
}

impl Calibrate {
    pub fn run(self, root: &Root) -> Result<()> {
        let board = match &self.board {
            None => Board::A4,
            Some(path) => {
                let text =
                    std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
                let board: Board =
                    serde_yaml_ng::from_str(&text).with_context(|| path.display().to_string())?;
                board.check().with_context(|| path.display().to_string())?;
                board
            }
        };
        if let Some(path) = &self.draw_board {
            std::fs::write(path, board.svg()).with_context(|| path.display().to_string())?;
            println!("{}", path.display());
            return Ok(());
        }
        let recording = self.recording.as_deref().context("no recording")?;
        let cell = match &self.urdf {
            None => root.work_cell()?,
            Some(path) => WorkCell::load(path)?,
        };
        let cell = match &self.arm_calibration {
            None => cell,
            Some(path) => cell.with_calibration(&ArmCalibration::load(path)?)?,
        };
        let session = if recording.join("session.yaml").exists() {
            Session::of_folder(recording)?
        } else {
            Session::of_bag(recording, board, &self.cameras, self.camera_preset, &cell)
                .with_context(|| {
                    format!(
                        "{}: expected a folder with session.yaml, or a bag",
                        recording.display()
                    )
                })?
        };
        let calibration = self.solve(&session, &cell)?;
        let report = self.report(&session, &calibration, &cell)?;
        if let Some(path) = &self.picture {
            let pictures = pictures(&session, &calibration, &cell.arm);
            ensure!(!pictures.is_empty(), "no image to draw");
            picture::write(path, &picture::side_by_side(&pictures))?;
        }
        if let Some(path) = &self.out {
            std::fs::write(path, file_text(&report)).with_context(|| path.display().to_string())?;
        }
        show(&report);
        if self.json {
            println!("{}", serde_json::to_string(&report)?);
        }
        Ok(())
    }

    fn solve(&self, session: &Session, cell: &WorkCell) -> Result<Calibration> {
        let cameras: Vec<CameraViews> = session
            .cameras
            .iter()
            .zip(&session.views)
            .map(|((name, intrinsics), views)| CameraViews {
                name: name.clone(),
                intrinsics: *intrinsics,
                views: views.clone(),
            })
            .collect();
        let with = |arm: &Arm| {
            let poses: Vec<Isometry3<f64>> = session
                .joints
                .iter()
                .map(|joints| arm.tip(joints))
                .collect();
            solve(&cameras, &poses)
        };
        match with(&cell.arm) {
            Ok(calibration) => {
                check_swapped(&calibration, &cell.cameras)?;
                Ok(calibration)
            }
            Err(error @ calibration::CalibrationError::DoesNotFit { .. }) => {
                // Another model may fit.
                let own = cell.arm.lengths.model();
                let fits = DhLengths::MODELS.into_iter().find(|(name, lengths)| {
                    Some(*name) != own && with(&cell.arm.with_lengths(*lengths)).is_ok()
                });
                match fits {
                    Some((name, _)) => Err(error).context(format!(
                        "the joint positions are those of a {name}, expected the {} of the URDF: give its --urdf",
                        own.unwrap_or("arm")
                    )),
                    None => Err(error.into()),
                }
            }
            Err(error) => Err(error.into()),
        }
    }

    fn report(
        &self,
        session: &Session,
        calibration: &Calibration,
        cell: &WorkCell,
    ) -> Result<Report> {
        let mut on_table = Vec::new();
        for (camera, views) in calibration.cameras.iter().zip(&session.on_table) {
            on_table.extend(views.iter().map(|view| (camera.world_from_camera, view)));
        }
        let table = table(&on_table, self.max_tilt_deg.to_radians())?;
        let cameras = calibration.cameras.iter().map(|camera| {
            let known = cell.cameras.iter().find(|(name, _)| *name == camera.name);
            let off = known.map(|(_, pose)| pose.inv_mul(&camera.world_from_camera));
            let rotation = camera.world_from_camera.rotation.coords;
            CameraReport {
                name: camera.name.clone(),
                views: camera.views,
                left_out: camera.left_out.clone(),
                rms_px: camera.rms_px,
                rms_mm: 1e3 * camera.rms_m,
                position_sigma_mm: 1e3 * camera.position_sigma_m,
                rotation_sigma_deg: camera.rotation_sigma_rad.to_degrees(),
                moved_mm: off.map(|off| 1e3 * off.translation.vector.norm()),
                turned_deg: off.map(|off| off.rotation.angle().to_degrees()),
                translation_m: camera.world_from_camera.translation.vector.into(),
                rotation_xyzw: [rotation.x, rotation.y, rotation.z, rotation.w],
            }
        });
        Ok(Report {
            cameras: cameras.collect(),
            board_translation_m: calibration.tool_from_board.translation.vector.into(),
            table: table.map(|table| TableReport {
                tilt_deg: table.tilt_rad.to_degrees(),
                height_mm: 1e3 * table.height_m,
            }),
            out: self.out.clone(),
        })
    }
}

fn show(report: &Report) {
    for camera in &report.cameras {
        println!(
            "camera {}: {} views, residual {:.2} px, {:.2} mm; known to {:.2} mm, {:.3} degrees",
            camera.name,
            camera.views,
            camera.rms_px,
            camera.rms_mm,
            camera.position_sigma_mm,
            camera.rotation_sigma_deg
        );
        if !camera.left_out.is_empty() {
            println!("  left out: poses {:?}", camera.left_out);
        }
        if let (Some(moved_mm), Some(turned_deg)) = (camera.moved_mm, camera.turned_deg) {
            println!("  {moved_mm:.1} mm and {turned_deg:.2} degrees from the URDF");
        }
        let ([x, y, z], [qx, qy, qz, qw]) = (camera.translation_m, camera.rotation_xyzw);
        println!(
            "  ros2 run tf2_ros static_transform_publisher --x {x:.6} --y {y:.6} --z {z:.6} --qx {qx:.9} --qy {qy:.9} --qz {qz:.9} --qw {qw:.9} \
             --frame-id world --child-frame-id {}_camera_optical_frame",
            camera.name
        );
    }
    if let Some(table) = &report.table {
        println!(
            "table: tilted by {:.2} degrees, {:.1} mm high",
            table.tilt_deg, table.height_mm
        );
    }
}

/// As `config/calibration.yaml`.
fn file_text(report: &Report) -> String {
    let mut text = "# Where the cameras stand, by sctn calibrate: a calibration for the parameter `calibration` of camera_fusion.\ncameras:\n".to_owned();
    for camera in &report.cameras {
        let list = |values: &[f64]| {
            let values: Vec<String> = values.iter().map(|value| format!("{value:.12}")).collect();
            values.join(", ")
        };
        text += &format!(
            "  # residual {:.2} mm, {} views\n  {}:\n    translation_m: [{}]\n    rotation_xyzw: [{}]\n",
            camera.rms_mm,
            camera.views,
            camera.name,
            list(&camera.translation_m),
            list(&camera.rotation_xyzw)
        );
    }
    text
}

/// Residuals in the picture, times their length.
const MAGNIFIED: f64 = 20.0;

/// The first image of each camera with corners and residuals.
fn pictures(session: &Session, calibration: &Calibration, arm: &Arm) -> Vec<RgbImage> {
    let mut pictures = Vec::new();
    for (index, shown) in session.shown.iter().enumerate() {
        let Some((view, picture)) = shown else {
            continue;
        };
        let mut picture = picture.clone();
        let view = &session.views[index][*view];
        let camera = heightmap::Camera {
            name: session.cameras[index].0.clone(),
            intrinsics: session.cameras[index].1,
            world_from_camera: calibration.cameras[index].world_from_camera,
        };
        let board = arm.tip(&session.joints[view.pose]) * calibration.tool_from_board;
        for (point, found) in &view.board.corners {
            if let Some((expected, _)) = camera.project(&(board * point)) {
                line(
                    &mut picture,
                    found,
                    &(found + (expected - found) * MAGNIFIED),
                    [255, 40, 40],
                );
            }
            for arm in [(3.0, 0.0), (0.0, 3.0)] {
                let across = nalgebra::Vector2::new(arm.0, arm.1);
                line(
                    &mut picture,
                    &(found - across),
                    &(found + across),
                    [40, 230, 80],
                );
            }
        }
        pictures.push(picture);
    }
    pictures
}

fn line(picture: &mut RgbImage, from: &Point2<f64>, to: &Point2<f64>, rgb: [u8; 3]) {
    let steps = ((to - from).amax().ceil() as usize).clamp(1, 4000);
    for step in 0..=steps {
        let at = from + (to - from) * (step as f64 / steps as f64);
        let (x, y) = (at.x.round(), at.y.round());
        if x >= 0.0 && y >= 0.0 && x < f64::from(picture.width()) && y < f64::from(picture.height())
        {
            picture.put_pixel(x as u32, y as u32, image::Rgb(rgb));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;
    use heightmap::Camera;
    use nalgebra::{Translation3, UnitQuaternion, Vector3};

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        calibrate: Calibrate,
    }

    fn root() -> Root {
        Root::find(Some(concat!(env!("CARGO_MANIFEST_DIR"), "/..").into())).unwrap()
    }

    /// A board at the tool, in front of the cup.
    fn tip_from_board() -> Isometry3<f64> {
        Isometry3::from_parts(
            Translation3::new(-0.14, 0.09, 0.01),
            UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI),
        )
    }

    /// Joint positions that show the board to the cameras.
    fn poses(arm: &Arm) -> Vec<Joints> {
        let mut poses = Vec::new();
        for i in 0..24 {
            let part = |k: usize| ((i * 7 + k * 11) % 13) as f64 / 6.5 - 1.0;
            // The tool points up: the board lies on it and faces the cameras.
            let tilt =
                UnitQuaternion::from_euler_angles(0.3 * part(1), 0.3 * part(2), 0.8 * part(3));
            let tip = Isometry3::from_parts(
                Translation3::new(0.42 + 0.06 * part(4), 0.1 * part(5), 0.32 + 0.05 * part(6)),
                tilt,
            );
            if let Ok(joints) = arm.solve(&tip, &arm.ready) {
                poses.push(joints);
            }
        }
        poses
    }

    /// A folder as an engineer records it; the cameras stand 6 mm from where the URDF has them.
    fn record(folder: &Path, arm: &Arm, edit: impl Fn(String) -> String) -> Vec<Camera> {
        let mut cameras = Camera::ravens().to_vec();
        for camera in &mut cameras {
            camera.world_from_camera.translation.vector += Vector3::new(0.004, -0.004, 0.002);
        }
        let mut text = "board: {rows: 2, cols: 3, tag_m: 0.08, gap_m: 0.02}\ncameras:\n".to_owned();
        for camera in &cameras {
            text += &format!(
                "  {}: {{width: 640, height: 480, fx_px: 450.0, fy_px: 450.0, cx_px: 320.0, cy_px: 240.0}}\n",
                camera.name
            );
        }
        text += "views:\n";
        let mut write = |boards: &Isometry3<f64>, stem: &str, head: String| {
            text += &format!("- {head}\n  images:\n");
            for camera in &cameras {
                let mut rgb = vec![80; 3 * 640 * 480];
                Board::A4.draw(camera, boards, (200.0, 30.0), &mut rgb);
                let file = format!("{}_{stem}.png", camera.name);
                picture::write(&folder.join(&file), &picture::camera(640, 480, &rgb)).unwrap();
                text += &format!("    {}: {file}\n", camera.name);
            }
        };
        for (i, joints) in poses(arm).iter().take(12).enumerate() {
            let list: Vec<String> = joints.iter().map(|q| format!("{q:.7}")).collect();
            write(
                &(arm.tip(joints) * tip_from_board()),
                &format!("{i:02}"),
                format!("joints_rad: [{}]", list.join(", ")),
            );
        }
        let flat = Isometry3::from_parts(
            Translation3::new(0.3, 0.1, 0.001),
            UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI),
        );
        write(&flat, "table", "on_table: true".into());
        std::fs::write(folder.join("session.yaml"), edit(text)).unwrap();
        cameras
    }

    #[test]
    fn a_folder_of_images_gives_a_calibration_file_and_a_picture() {
        let folder = tempfile::tempdir().unwrap();
        let root = root();
        let cell = root.work_cell().unwrap();
        let cameras = record(folder.path(), &cell.arm, |text| text);
        let (out, png) = (
            folder.path().join("out.yaml"),
            folder.path().join("residuals.png"),
        );
        let text = |path: &Path| path.display().to_string();
        let line = [
            "calibrate",
            &text(folder.path()),
            "--out",
            &text(&out),
            "--picture",
            &text(&png),
            "--json",
        ];
        Line::try_parse_from(line)
            .unwrap()
            .calibrate
            .run(&root)
            .unwrap();
        assert_eq!(image::open(&png).unwrap().width() / 640, 3);
        let read = calibration::read_calibration(&out).unwrap();
        for camera in &cameras {
            let off = camera.world_from_camera.inv_mul(&read[&camera.name]);
            assert!(
                off.translation.vector.norm() < 0.5e-3
                    && off.rotation.angle() < 0.05f64.to_radians(),
                "{} {off}",
                camera.name
            );
        }
    }

    #[test]
    fn recordings_of_another_robot_and_bad_sessions_are_refused_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let root = root();
        let cell = root.work_cell().unwrap();
        // Recorded with a UR5e, solved with the URDF of a UR5.
        record(
            folder.path(),
            &cell.arm.with_lengths(DhLengths::UR5E),
            |text| text,
        );
        let run = || {
            let line = ["calibrate".to_owned(), folder.path().display().to_string()];
            let error = Line::try_parse_from(line)
                .unwrap()
                .calibrate
                .run(&root)
                .unwrap_err();
            format!("{error:#}")
        };
        let error = run();
        assert!(
            error.contains("ur5e") && error.contains("another robot"),
            "{error}"
        );
        let path = folder.path().join("session.yaml");
        let text = std::fs::read_to_string(&path).unwrap();
        for (from, to, expected) in [
            ("on_table: true", "on_table: false", "views[12]"),
            ("rows: 2", "rows: 9", "first_id"),
            (
                "front: front_00.png",
                "back: front_00.png",
                "views[0].images names back",
            ),
            ("front: front_00.png", "front: none.png", "none.png"),
            (
                "width: 640, height: 480",
                "width: 320, height: 240",
                "expected 320 x 240",
            ),
            (
                "joints_rad: [",
                "joints_rad: [.nan, 0, 0, 0, 0, 0] # [",
                "views[0].joints_rad",
            ),
        ] {
            assert!(text.contains(from), "{from}");
            std::fs::write(&path, text.replacen(from, to, 1)).unwrap();
            let error = run();
            assert!(error.contains(expected), "{error} does not name {expected}");
        }
    }
}
