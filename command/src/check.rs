//! `sctn check`: whether a cell is in order, from a bag or a running graph.

use crate::bag::record_topics;
use crate::root::Root;
use anyhow::{Context, Result, ensure};
use bags::BagReader;
use calibration::{CheckLimits, Frame, Limit, Measure, check_cameras, read_calibration};
use clap::Args;
use heightmap::{Camera, StillSettings, Transforms, Workspace, has_shape_of, scale_depth};
use msgs::{convert, sensor_msgs, tf2_msgs};
use nalgebra::{Isometry2, Point2};
use serde::Serialize;
use std::collections::BTreeMap;
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;
use ur5::{Arm, ArmCalibration, WorkCell};

/// Arguments of `sctn check`: the arm out of sight, the table empty
#[derive(Args)]
pub struct Check {
    /// Bag to check [default: a recording of the running graph]
    #[arg(long, value_name = "BAG")]
    bag: Option<PathBuf>,
    /// Seconds of the running graph to record
    #[arg(long, default_value_t = 5.0)]
    seconds: f64,
    /// Record with the time of /clock, beside sim_workcell
    #[arg(long)]
    use_sim_time: bool,
    /// Names of the cameras: topics NAME/color/image_raw, NAME/depth/image_rect_raw and NAME/color/camera_info
    #[arg(long, value_delimiter = ',', default_values_t = ["front".to_owned(), "left".to_owned(), "right".to_owned()])]
    cameras: Vec<String>,
    /// Calibration file of camera_fusion [default: poses of /tf_static]
    #[arg(long, value_name = "FILE")]
    calibration: Option<PathBuf>,
    /// Frame of the workspace
    #[arg(long, default_value = "world")]
    world_frame: String,
    /// The cell [default: urdf/workcell.urdf]
    #[arg(long, value_name = "FILE")]
    urdf: Option<PathBuf>,
    /// Factory calibration of the arm, as the UR driver's ur_calibration writes it
    #[arg(long, value_name = "FILE")]
    arm_calibration: Option<PathBuf>,
    /// Print a JSON object last
    #[arg(long)]
    json: bool,
}

/// Between a stamp and the arrival at the recorder, at most (ms).
const SKEW_MS: f64 = 100.0;
/// Between the stamps of cameras that belong together, at most (ms): the fusion's tolerance.
const SYNC_MS: f64 = 20.0;
/// Frames of a camera in a second, at least.
const RATE_HZ: f64 = 2.0;
/// Over each corner the arm must be able to rise so high (mm).
const RISE_MM: f64 = 55.0;
/// Joint states must arrive so often.
const JOINTS_HZ: f64 = 50.0;

#[derive(Serialize)]
struct Report {
    good: bool,
    measures: Vec<Row>,
}

#[derive(Serialize)]
struct Row {
    name: &'static str,
    subject: String,
    value: Option<f64>,
    unit: &'static str,
    at_most: Option<f64>,
    at_least: Option<f64>,
    good: bool,
}

/// One camera in the bag.
#[derive(Default)]
struct Recorded {
    /// Stamp and arrival of colour images.
    color: Vec<(Duration, Duration, sensor_msgs::Image)>,
    /// By stamp in ns.
    depth: BTreeMap<u128, sensor_msgs::Image>,
}

impl Check {
    pub fn run(self, root: &Root) -> Result<ExitCode> {
        let cell = match &self.urdf {
            None => root.work_cell()?,
            Some(path) => WorkCell::load(path)?,
        };
        let cell = match &self.arm_calibration {
            None => cell,
            Some(path) => cell.with_calibration(&ArmCalibration::load(path)?)?,
        };
        let measures = match &self.bag {
            Some(path) => self.measure(path, &cell)?,
            None => {
                let folder = tempfile::tempdir().context("folder for the recording")?;
                let path = folder.path().join("check");
                ensure!(
                    self.seconds.is_finite() && (1.0..=60.0).contains(&self.seconds),
                    "--seconds {}: expected 1 to 60",
                    self.seconds
                );
                record_topics(self.topics(), &path, self.seconds, self.use_sim_time)?;
                self.measure(&path, &cell)?
            }
        };
        let good = measures.iter().all(Measure::is_good);
        show(&measures);
        if self.json {
            let measures = measures.iter().map(row).collect();
            println!("{}", serde_json::to_string(&Report { good, measures })?);
        }
        Ok(if good {
            ExitCode::SUCCESS
        } else {
            ExitCode::FAILURE
        })
    }

    fn topics(&self) -> Vec<String> {
        let mut topics = vec!["/joint_states".to_owned(), "/tf_static".to_owned()];
        for name in &self.cameras {
            for topic in [
                "color/image_raw",
                "depth/image_rect_raw",
                "color/camera_info",
            ] {
                topics.push(format!("/{name}/{topic}"));
            }
        }
        topics
    }

    fn measure(&self, path: &Path, cell: &WorkCell) -> Result<Vec<Measure>> {
        let shown = path.display();
        let bag = BagReader::open(path)?;
        let mut transforms = Transforms::default();
        let mut recorded: Vec<Recorded> =
            self.cameras.iter().map(|_| Recorded::default()).collect();
        let mut infos: Vec<Option<sensor_msgs::CameraInfo>> = vec![None; self.cameras.len()];
        let mut joint_times = Vec::new();
        let topics = self.topics();
        let wanted: Vec<&str> = topics.iter().map(String::as_str).collect();
        for message in bag.messages_between(&wanted, Duration::ZERO, Duration::MAX) {
            let message = message?;
            let name = message.topic.name.clone();
            if name == "/joint_states" {
                joint_times.push(message.log_time);
                continue;
            }
            if name == "/tf_static" {
                let message = message.decode::<tf2_msgs::TFMessage>()?;
                let insert =
                    |parent: &str, child: &str, pose| transforms.insert(parent, child, pose);
                let invalid = convert::transforms_from_msg(&message, insert);
                ensure!(invalid.is_empty(), "{shown}: /tf_static: {}", invalid[0]);
                continue;
            }
            let index = self
                .cameras
                .iter()
                .position(|camera| name.starts_with(&format!("/{camera}/")));
            let index = index.with_context(|| format!("{shown}: unexpected topic {name}"))?;
            if name.ends_with("camera_info") {
                infos[index] = Some(message.decode()?);
                continue;
            }
            let image: sensor_msgs::Image = message.decode()?;
            let stamp = convert::time_from_msg(&image.header.stamp)
                .with_context(|| format!("{shown}: {name}"))?;
            match name.ends_with("depth/image_rect_raw") {
                true => drop(recorded[index].depth.insert(stamp.as_nanos(), image)),
                false => recorded[index].color.push((stamp, message.log_time, image)),
            }
        }
        let poses = match &self.calibration {
            Some(path) => read_calibration(path)?,
            None => BTreeMap::new(),
        };
        let (mut cameras, mut frames) = (Vec::new(), Vec::new());
        let mut measures = Vec::new();
        for ((name, recorded), info) in self.cameras.iter().zip(&recorded).zip(&infos) {
            let info = info
                .as_ref()
                .with_context(|| format!("{shown}: no message on /{name}/color/camera_info"))?;
            let intrinsics = convert::intrinsics_from_msg(info)
                .with_context(|| format!("{shown}: /{name}/color/camera_info"))?;
            let pose = match poses.get(name) {
                Some(pose) => *pose,
                None => transforms
                    .world_from(&info.header.frame_id, &self.world_frame)
                    .with_context(|| format!("{shown}: camera {name}"))?,
            };
            let camera = Camera {
                name: name.clone(),
                intrinsics,
                world_from_camera: pose,
            };
            camera.check()?;
            frames.push(
                frames_of(&camera, recorded).with_context(|| format!("{shown}: camera {name}"))?,
            );
            cameras.push(camera);
            measures.extend(times(name, recorded));
        }
        for (index, name) in self.cameras.iter().enumerate().skip(1) {
            measures.push(Measure {
                name: "sync",
                subject: format!("{} and {name}", self.cameras[0]),
                value: apart_ms(&recorded[0], &recorded[index]),
                unit: "ms",
                limit: Limit::AtMost(SYNC_MS),
            });
        }
        measures.extend(check_cameras(
            &cameras,
            &frames,
            &Workspace::RAVENS,
            &StillSettings::default(),
            &CheckLimits::default(),
        )?);
        measures.push(Measure {
            name: "rate",
            subject: "joint_states".into(),
            value: rate_hz(&joint_times),
            unit: "Hz",
            limit: Limit::AtLeast(JOINTS_HZ),
        });
        measures.extend(reach(&cell.arm, &Workspace::RAVENS));
        Ok(measures)
    }
}

/// Colour with registered depth of the same stamp.
fn frames_of(camera: &Camera, recorded: &Recorded) -> Result<Vec<Frame>> {
    let mut frames = Vec::new();
    let mut measured_m = Vec::new();
    for (stamp, _, color) in &recorded.color {
        let Some(depth) = recorded.depth.get(&stamp.as_nanos()) else {
            continue;
        };
        ensure!(
            depth.header.frame_id == color.header.frame_id,
            "depth is of frame {:?} and colour of {:?}: expected depth that is registered to colour (RealSense: align_depth.enable)",
            depth.header.frame_id,
            color.header.frame_id
        );
        let mut frame = Frame {
            rgb: Vec::new(),
            depth_m: Vec::new(),
        };
        convert::color_from_msg(color, &camera.intrinsics, &mut frame.rgb).context("colour")?;
        convert::depth_from_msg(depth, &mut measured_m).context("depth")?;
        let (width, height) = (depth.width as usize, depth.height as usize);
        ensure!(
            has_shape_of(&camera.intrinsics, width, height),
            "depth has {width} x {height} pixels, expected the shape of {} x {}",
            camera.intrinsics.width,
            camera.intrinsics.height
        );
        scale_depth(
            &measured_m,
            (width, height),
            &camera.intrinsics,
            &mut frame.depth_m,
        );
        frames.push(frame);
    }
    Ok(frames)
}

/// Clock and rate of one camera.
fn times(name: &str, recorded: &Recorded) -> [Measure; 2] {
    let mut skews: Vec<f64> = recorded
        .color
        .iter()
        .map(|(stamp, arrival, _)| 1e3 * (arrival.as_secs_f64() - stamp.as_secs_f64()))
        .collect();
    let arrivals: Vec<Duration> = recorded
        .color
        .iter()
        .map(|(_, arrival, _)| *arrival)
        .collect();
    [
        Measure {
            name: "clock",
            subject: name.into(),
            value: median(&mut skews).abs(),
            unit: "ms",
            limit: Limit::AtMost(SKEW_MS),
        },
        Measure {
            name: "rate",
            subject: name.into(),
            value: rate_hz(&arrivals),
            unit: "Hz",
            limit: Limit::AtLeast(RATE_HZ),
        },
    ]
}

fn rate_hz(times: &[Duration]) -> f64 {
    match times {
        [first, .., last] if last > first => {
            (times.len() - 1) as f64 / (*last - *first).as_secs_f64()
        }
        _ => 0.0,
    }
}

/// Median distance of the stamps of one camera from the nearest of the other's.
fn apart_ms(a: &Recorded, b: &Recorded) -> f64 {
    let mut apart: Vec<f64> = a
        .color
        .iter()
        .map(|(stamp, ..)| {
            let others = b
                .color
                .iter()
                .map(|(other, ..)| 1e3 * stamp.abs_diff(*other).as_secs_f64());
            others.fold(f64::INFINITY, f64::min)
        })
        .collect();
    median(&mut apart)
}

/// Not a number of no values.
fn median(values: &mut [f64]) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

/// How high the arm rises over each corner of the workspace with the tool down, at least.
fn reach(arm: &Arm, workspace: &Workspace) -> Vec<Measure> {
    let mut measures = Vec::new();
    for (col, row) in [(0.5, 0.5), (0.5, -0.5), (-0.5, 0.5), (-0.5, -0.5)] {
        let from_end = |value: f64, size: usize| {
            if value < 0.0 {
                size as f64 + value
            } else {
                value
            }
        };
        let at = workspace.point_m(&Point2::new(
            from_end(col, workspace.cols),
            from_end(row, workspace.rows),
        ));
        let reaches = |height_mm: f64| {
            let pose = Isometry2::new(at.coords, 0.0);
            arm.solve(&Arm::tip_down(&pose, 1e-3 * height_mm), &arm.ready)
                .is_ok()
        };
        let heights = (-2..=60).map(|step| 5.0 * f64::from(step));
        let reached = heights.take_while(|height_mm| reaches(*height_mm)).last();
        measures.push(Measure {
            name: "reach",
            subject: format!("corner ({:.2}, {:.2})", at.x, at.y),
            value: reached.unwrap_or(f64::NAN),
            unit: "mm up",
            limit: Limit::AtLeast(RISE_MM),
        });
    }
    measures
}

fn row(measure: &Measure) -> Row {
    let (at_most, at_least) = match measure.limit {
        Limit::AtMost(limit) => (Some(limit), None),
        Limit::AtLeast(limit) => (None, Some(limit)),
    };
    Row {
        name: measure.name,
        subject: measure.subject.clone(),
        value: measure.value.is_finite().then_some(measure.value),
        unit: measure.unit,
        at_most,
        at_least,
        good: measure.is_good(),
    }
}

fn show(measures: &[Measure]) {
    let colored = std::io::stdout().is_terminal();
    for measure in measures {
        let word = match (measure.is_good(), colored) {
            (true, true) => "\x1b[32mgreen\x1b[0m",
            (false, true) => "\x1b[31mred  \x1b[0m",
            (true, false) => "green",
            (false, false) => "red  ",
        };
        let limit = match measure.limit {
            Limit::AtMost(limit) => format!("at most {limit}"),
            Limit::AtLeast(limit) => format!("at least {limit}"),
        };
        println!(
            "{word} {:<7} {:<24} {:>9.3} {:<12} {limit}",
            measure.name, measure.subject, measure.value, measure.unit
        );
    }
}
