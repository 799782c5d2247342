//! `sctn check`: whether a cell is in order, from a bag or a running graph.

use crate::bag::record_topics;
use crate::root::Root;
use anyhow::{Context, Result, ensure};
use bags::BagReader;
use calibration::{Board, CheckLimits, Frame, Limit, Measure, check_cameras, read_calibration};
use camera_fusion::{CameraFusionParameters, ImageMessage};
use clap::Args;
use frame_synchronizer::{Calibration, ColorImage, DepthReader, Image as _};
use heightmap::{Camera, Transforms, Workspace};
use msgs::{CameraPreset, CameraTopicNames, convert, sensor_msgs, tf2_msgs};
use nalgebra::{Isometry2, Point2};
use node_kit::{ParameterSource, Parameters as _, RosArguments, load_parameters, plain_node};
use serde::Serialize;
use std::collections::{BTreeMap, VecDeque};
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;
use suction_executor::SuctionExecutorParameters;
use ur_driver::{DriverParameters, driver_obstacle};
use ur5::{Arm, WorkCell};

/// Arguments of `sctn check`: the arm out of sight, the table empty but for the board of `sctn calibrate`, which may lie there.
///
/// It measures as camera_fusion does: with its parameters of config/camera_fusion.yaml, and those given behind `--` as to the nodes:
///
///   sctn check --calibration calibration.yaml -- -p camera_fusion:frames:=5 -p suction_executor:driver.contact:=vacuum -r __ns:=/cell
#[derive(Args)]
#[command(verbatim_doc_comment)]
pub struct Check {
    /// Bag to check [default: a recording of the running graph, and the driver's controllers]
    #[arg(long, value_name = "BAG")]
    bag: Option<PathBuf>,
    /// Seconds of the running graph to record
    #[arg(long, default_value_t = 5.0)]
    seconds: f64,
    /// Record with the time of /clock, beside sim_workcell
    #[arg(long)]
    use_sim_time: bool,
    /// Names of the cameras [default: the parameter of camera_fusion]
    #[arg(long, value_delimiter = ',')]
    cameras: Option<Vec<String>>,
    /// Driver of the cameras: simulated, realsense, realsense_aligned, orbbec, zed or zed_5_0 [default: the parameter of camera_fusion]
    #[arg(long)]
    camera_preset: Option<CameraPreset>,
    /// Calibration file of camera_fusion [default: the parameter of camera_fusion; where that is empty, poses of /tf_static]
    #[arg(long, value_name = "FILE")]
    calibration: Option<PathBuf>,
    /// Frame of the workspace [default: the parameter of camera_fusion]
    #[arg(long)]
    world_frame: Option<String>,
    /// YAML file with the fields of the board that lies on the table [default: 2 x 3 tags of 80 mm]
    #[arg(long, value_name = "FILE")]
    board: Option<PathBuf>,
    /// Red where no two cameras see the board: without it a camera that stands aside is not found
    #[arg(long)]
    require_board: bool,
    /// The cell [default: urdf/workcell.urdf]
    #[arg(long, value_name = "FILE")]
    urdf: Option<PathBuf>,
    /// Factory calibration of the arm, as the UR driver's ur_calibration writes it [default: the parameter of suction_executor]
    #[arg(long, value_name = "FILE")]
    arm_calibration: Option<PathBuf>,
    /// Print a JSON object last
    #[arg(long)]
    json: bool,
    /// ROS arguments: --params-file FILE, -p camera_fusion:frames:=5, -r __ns:=/cell
    #[arg(last = true)]
    ros: Vec<String>,
}

/// Between a stamp and the arrival at the recorder, at most (ms).
const SKEW_MS: f64 = 100.0;
/// Frames of a camera in a second, at least.
const RATE_HZ: f64 = 2.0;
/// Over each corner the arm must be able to rise so high (mm).
const RISE_MM: f64 = 55.0;
/// Joint states must arrive so often.
const JOINTS_HZ: f64 = 50.0;
/// Images of a stream among which those of the same time are looked for.
const WAITING_IMAGES: usize = 8;
/// How long the driver may take to say what it has.
const DRIVER_PATIENCE: Duration = Duration::from_secs(10);

#[derive(Serialize)]
struct Report {
    good: bool,
    measures: Vec<Row>,
}

/// A row of the table.
#[derive(Serialize)]
struct Row {
    name: &'static str,
    subject: String,
    value: Option<f64>,
    unit: &'static str,
    at_most: Option<f64>,
    at_least: Option<f64>,
    good: bool,
    /// What is missing, where the number does not say so.
    reason: Option<String>,
}

impl From<&Measure> for Row {
    fn from(measure: &Measure) -> Self {
        let (at_most, at_least) = match measure.limit {
            Limit::AtMost(limit) => (Some(limit), None),
            Limit::AtLeast(limit) => (None, Some(limit)),
        };
        Self {
            name: measure.name,
            subject: measure.subject.clone(),
            value: measure.value.is_finite().then_some(measure.value),
            unit: measure.unit,
            at_most,
            at_least,
            good: measure.is_good(),
            reason: None,
        }
    }
}

/// What the nodes of the cell are set to.
struct Settings {
    fusion: CameraFusionParameters,
    driver: DriverParameters,
    /// Factory calibration of the arm; empty for none.
    arm_calibration: PathBuf,
    /// Of the topics; empty or /cell.
    namespace: String,
}

impl Settings {
    fn topic(&self, relative: &str) -> String {
        format!("{}/{relative}", self.namespace)
    }

    fn joints(&self) -> String {
        self.topic("joint_states")
    }

    /// Of each camera, with their whole names.
    fn cameras(&self) -> Vec<CameraTopicNames> {
        let whole = |name: &String| {
            let topics = self.fusion.camera_preset.topics(name);
            CameraTopicNames {
                color: self.topic(&topics.color),
                depth: self.topic(&topics.depth),
                color_info: self.topic(&topics.color_info),
                depth_info: self.topic(&topics.depth_info),
            }
        };
        self.fusion.cameras.iter().map(whole).collect()
    }

    /// Everything that is looked at.
    fn topics(&self) -> Vec<String> {
        let mut topics = vec![self.joints(), "/tf_static".to_owned()];
        for camera in self.cameras() {
            topics.extend([
                camera.color,
                camera.depth,
                camera.color_info,
                camera.depth_info,
            ]);
        }
        topics
    }
}

/// One camera in the bag.
#[derive(Default)]
struct Recorded {
    /// Stamp and arrival of each colour image.
    color_times: Vec<(Duration, Duration)>,
    /// Depth images, for the message that none fits.
    depth_count: usize,
    /// Without a partner yet.
    color: VecDeque<(Duration, ImageMessage)>,
    depth: VecDeque<(Duration, ImageMessage)>,
    /// Colour and depth of the same time, as many as are needed.
    sets: Vec<(ImageMessage, ImageMessage)>,
    color_info: Option<sensor_msgs::CameraInfo>,
    depth_info: Option<sensor_msgs::CameraInfo>,
}

impl Recorded {
    /// Pairs the images that wait.
    fn pair(&mut self, tolerance: Duration, needed: usize) {
        for waiting in [&mut self.color, &mut self.depth] {
            if waiting.len() > WAITING_IMAGES {
                waiting.pop_front();
            }
        }
        let found = self.color.iter().enumerate().find_map(|(color, (at, _))| {
            let apart = |(_, (stamp, _)): &(usize, &(Duration, _))| stamp.abs_diff(*at);
            let (depth, (stamp, _)) = self.depth.iter().enumerate().min_by_key(apart)?;
            (stamp.abs_diff(*at) <= tolerance).then_some((color, depth))
        });
        let Some((color, depth)) = found else { return };
        let pair = (self.color.remove(color), self.depth.remove(depth));
        if let (Some((_, color)), Some((_, depth))) = pair
            && self.sets.len() < needed
        {
            self.sets.push((color, depth));
        }
    }
}

impl Check {
    pub fn run(self, root: &Root) -> Result<ExitCode> {
        let cell = match &self.urdf {
            None => root.work_cell()?,
            Some(path) => WorkCell::load(path)?,
        };
        let settings = self.settings(root)?;
        let arm_calibration = self.arm_calibration.as_ref();
        let cell =
            cell.with_calibration_file(arm_calibration.unwrap_or(&settings.arm_calibration))?;
        let mut of_driver = None;
        let measures = match &self.bag {
            Some(path) => self.measure(path, &cell, &settings)?,
            None => {
                let folder = tempfile::tempdir().context("folder for the recording")?;
                let path = folder.path().join("check");
                ensure!(
                    self.seconds.is_finite() && (1.0..=60.0).contains(&self.seconds),
                    "--seconds {}: expected 1 to 60",
                    self.seconds
                );
                record_topics(settings.topics(), &path, self.seconds, self.use_sim_time)?;
                of_driver = Some(controllers(&settings)?);
                self.measure(&path, &cell, &settings)?
            }
        };
        let rows = measures.iter().map(Row::from).chain(of_driver);
        let rows: Vec<Row> = rows.collect();
        let good = rows.iter().all(|row| row.good);
        rows.iter().for_each(show);
        if !rows.iter().any(|row| row.name == "board") {
            println!(
                "no board in view of two cameras: a camera that stands aside is not found (--require-board)"
            );
        }
        if self.json {
            let report = Report {
                good,
                measures: rows,
            };
            println!("{}", serde_json::to_string(&report)?);
        }
        Ok(if good {
            ExitCode::SUCCESS
        } else {
            ExitCode::FAILURE
        })
    }

    /// The parameters of the nodes, as they read them, with what the command line says last.
    fn settings(&self, root: &Root) -> Result<Settings> {
        let arguments = std::iter::once("--ros-args".to_owned()).chain(self.ros.iter().cloned());
        let (ros, _) = RosArguments::parse(arguments)?;
        let namespace = ros.namespace("camera_fusion").trim_matches('/').to_owned();
        let namespace = match namespace.is_empty() {
            true => namespace,
            false => format!("/{namespace}"),
        };
        let sources = |node: &str| {
            let file = ParameterSource::File(root.join(format!("config/{node}.yaml")));
            let sources = std::iter::once(file).chain(ros.parameters.iter().cloned());
            sources.collect::<Vec<_>>()
        };
        let full = |node: &str| format!("{namespace}/{node}");
        let node = "camera_fusion";
        let loaded = load_parameters::<CameraFusionParameters>(&sources(node), node, &full(node));
        let mut fusion = loaded.context(node)?.parameters;
        if let Some(cameras) = &self.cameras {
            fusion.cameras.clone_from(cameras);
        }
        if let Some(preset) = self.camera_preset {
            fusion.camera_preset = preset;
        }
        if let Some(calibration) = &self.calibration {
            fusion.calibration.clone_from(calibration);
        }
        if let Some(frame) = &self.world_frame {
            fusion.world_frame.clone_from(frame);
        }
        fusion.check().context(node)?;
        let node = "suction_executor";
        let executor =
            load_parameters::<SuctionExecutorParameters>(&sources(node), node, &full(node));
        let executor = executor.context(node)?.parameters;
        Ok(Settings {
            fusion,
            driver: executor.driver,
            arm_calibration: executor.arm_calibration,
            namespace,
        })
    }

    fn measure(&self, path: &Path, cell: &WorkCell, settings: &Settings) -> Result<Vec<Measure>> {
        let shown = path.display();
        let fusion = &settings.fusion;
        let still = fusion.still();
        let needed = 2 * still.map_or(1, |still| still.frames);
        let bag = BagReader::open(path)?;
        let mut transforms = Transforms::default();
        let topics = settings.cameras();
        let mut recorded: Vec<Recorded> = topics.iter().map(|_| Recorded::default()).collect();
        let mut joint_times = Vec::new();
        let all = settings.topics();
        let wanted: Vec<&str> = all.iter().map(String::as_str).collect();
        for message in bag.messages_between(&wanted, Duration::ZERO, Duration::MAX) {
            let message = message?;
            let name = message.topic.name.as_str();
            if name == settings.joints() {
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
            for (camera, topics) in recorded.iter_mut().zip(&topics) {
                if name == topics.color_info {
                    camera.color_info = Some(message.decode()?);
                } else if name == topics.depth_info {
                    camera.depth_info = Some(message.decode()?);
                } else if name == topics.color || name == topics.depth {
                    let image: sensor_msgs::Image = message.decode()?;
                    let stamp = convert::time_from_msg(&image.header.stamp)
                        .with_context(|| format!("{shown}: {name}"))?;
                    let waiting = match name == topics.color {
                        true => {
                            camera.color_times.push((stamp, message.log_time));
                            &mut camera.color
                        }
                        false => {
                            camera.depth_count += 1;
                            &mut camera.depth
                        }
                    };
                    waiting.push_back((stamp, ImageMessage(image)));
                    camera.pair(fusion.tolerance(), needed);
                }
            }
        }
        let poses = match fusion.calibration.as_path() {
            path if path == Path::new("") => BTreeMap::new(),
            path => read_calibration(path)?,
        };
        let (mut cameras, mut frames) = (Vec::new(), Vec::new());
        let mut measures = Vec::new();
        for ((name, recorded), topics) in fusion.cameras.iter().zip(&recorded).zip(&topics) {
            let read = |topic: &str, info: &sensor_msgs::CameraInfo| {
                let read = convert::intrinsics_from_msg(info);
                read.with_context(|| format!("{shown}: {topic}"))
            };
            let info = &topics.color_info;
            let info_msg = recorded
                .color_info
                .as_ref()
                .with_context(|| format!("{shown}: no message on {info}"))?;
            let pose = match poses.get(name) {
                Some(pose) => *pose,
                None => transforms
                    .world_from(&info_msg.header.frame_id, &fusion.world_frame)
                    .with_context(|| format!("{shown}: camera {name}"))?,
            };
            let camera = Camera {
                name: name.clone(),
                intrinsics: read(info, info_msg)?,
                world_from_camera: pose,
            };
            camera.check()?;
            let depth_info: Calibration = recorded
                .depth_info
                .as_ref()
                .map(|info| convert::intrinsics_from_msg(info).map_err(|error| error.to_string()));
            let sets = frames_of(&camera, recorded, &depth_info, &transforms)
                .with_context(|| format!("{shown}: camera {name}: {}", topics.depth))?;
            ensure!(
                sets.len() >= needed,
                "{shown}: camera {name}: {} sets of images whose stamps are within {:?}, expected {needed} or more: {} images on {}, {} on {}",
                sets.len(),
                fusion.tolerance(),
                recorded.color_times.len(),
                topics.color,
                recorded.depth_count,
                topics.depth
            );
            frames.push(sets);
            cameras.push(camera);
            measures.extend(times(name, recorded));
        }
        for (index, name) in fusion.cameras.iter().enumerate().skip(1) {
            measures.push(Measure {
                name: "sync",
                subject: format!("{} and {name}", fusion.cameras[0]),
                value: apart_ms(&recorded[0], &recorded[index]),
                unit: "ms",
                limit: Limit::AtMost(1e3 * fusion.tolerance_s),
            });
        }
        let workspace = fusion.workspace.workspace();
        let board = self.board()?;
        let limits = CheckLimits::default();
        let of_cameras = check_cameras(
            &cameras,
            &frames,
            &workspace,
            still.as_ref(),
            &board,
            &limits,
        )?;
        if self.require_board && !of_cameras.iter().any(|measure| measure.name == "board") {
            measures.push(Measure {
                name: "board",
                subject: "seen by no two cameras".into(),
                value: f64::NAN,
                unit: "mm",
                limit: Limit::AtMost(limits.board_mm),
            });
        }
        measures.extend(of_cameras);
        measures.push(Measure {
            name: "rate",
            subject: "joint_states".into(),
            value: rate_hz(&joint_times),
            unit: "Hz",
            limit: Limit::AtLeast(JOINTS_HZ),
        });
        measures.extend(reach(&cell.arm, &workspace));
        Ok(measures)
    }

    fn board(&self) -> Result<Board> {
        let Some(path) = &self.board else {
            return Ok(Board::A4);
        };
        let shown = || path.display().to_string();
        let text = std::fs::read_to_string(path).with_context(shown)?;
        let board: Board = serde_yaml_ng::from_str(&text).with_context(shown)?;
        board.check().with_context(shown)?;
        Ok(board)
    }
}

/// Whether the running driver has what the executor needs.
fn controllers(settings: &Settings) -> Result<Row> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .context("tokio runtime")?;
    let obstacle = runtime.block_on(async {
        let namespace = format!("__ns:={}", settings.namespace);
        let arguments = match settings.namespace.is_empty() {
            true => Vec::new(),
            false => vec!["-r".to_owned(), namespace],
        };
        let (context, node) = plain_node("sctn_check", &arguments)?;
        let obstacle = driver_obstacle(&node, &settings.driver, DRIVER_PATIENCE).await?;
        context.shutdown();
        anyhow::Ok(obstacle)
    })?;
    runtime.shutdown_timeout(Duration::from_millis(500));
    let measure = Measure {
        name: "controllers",
        subject: "the UR driver".into(),
        value: f64::from(u8::from(obstacle.is_some())),
        unit: "missing",
        limit: Limit::AtMost(0.0),
    };
    Ok(Row {
        reason: obstacle,
        ..Row::from(&measure)
    })
}

/// Colour with depth of the same time, registered to it as camera_fusion does.
fn frames_of(
    camera: &Camera,
    recorded: &Recorded,
    depth_info: &Calibration,
    transforms: &Transforms,
) -> Result<Vec<Frame>> {
    let mut reader = DepthReader::default();
    let mut frames = Vec::new();
    for (color, depth) in &recorded.sets {
        let mut frame = Frame {
            rgb: Vec::new(),
            depth_m: Vec::new(),
        };
        color
            .read_color(&camera.intrinsics, &mut frame.rgb)
            .context("colour")?;
        let image = ColorImage {
            index: 0,
            camera,
            frame: color.frame(),
        };
        reader
            .read(depth, depth_info, &image, transforms, &mut frame.depth_m)
            .map_err(|error| anyhow::anyhow!(error.reason))?;
        frames.push(frame);
    }
    Ok(frames)
}

/// Clock and rate of one camera.
fn times(name: &str, recorded: &Recorded) -> [Measure; 2] {
    let times = recorded.color_times.iter();
    let mut skews: Vec<f64> = times
        .clone()
        .map(|(stamp, arrival)| 1e3 * (arrival.as_secs_f64() - stamp.as_secs_f64()))
        .collect();
    let arrivals: Vec<Duration> = times.map(|(_, arrival)| *arrival).collect();
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
        .color_times
        .iter()
        .map(|(stamp, _)| {
            let others = b
                .color_times
                .iter()
                .map(|(other, _)| 1e3 * stamp.abs_diff(*other).as_secs_f64());
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

fn show(row: &Row) {
    let word = match (row.good, std::io::stdout().is_terminal()) {
        (true, true) => "\x1b[32mgreen\x1b[0m",
        (false, true) => "\x1b[31mred  \x1b[0m",
        (true, false) => "green",
        (false, false) => "red  ",
    };
    let limit = match (row.at_most, row.at_least) {
        (Some(limit), _) => format!("at most {limit}"),
        (_, limit) => format!("at least {}", limit.unwrap_or(f64::NAN)),
    };
    println!(
        "{word} {:<11} {:<24} {:>9.3} {:<12} {limit}",
        row.name,
        row.subject,
        row.value.unwrap_or(f64::NAN),
        row.unit
    );
    if let Some(reason) = &row.reason {
        println!("      {reason}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        check: Check,
    }

    fn settings(words: &[&str]) -> Result<Settings> {
        let root = Root::find(Some(concat!(env!("CARGO_MANIFEST_DIR"), "/..").into())).unwrap();
        let words = std::iter::once("check").chain(words.iter().copied());
        Line::try_parse_from(words).unwrap().check.settings(&root)
    }

    #[test]
    fn it_measures_with_the_parameters_of_the_nodes_and_what_the_command_line_says_wins() {
        let plain = settings(&[]).unwrap();
        assert_eq!(plain.fusion, CameraFusionParameters::default());
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("cell.yaml");
        let text = "/**/camera_fusion: {ros__parameters: {cameras: [a, b], frames: 7, camera_preset: orbbec, \
                    workspace: {rows: 100}}}\n/**/suction_executor: {ros__parameters: {driver: {contact: height}}}\n";
        std::fs::write(&file, text).unwrap();
        let file = file.display().to_string();
        let words = [
            "--camera-preset",
            "zed",
            "--",
            "--params-file",
            &file,
            "-p",
            "camera_fusion:percentile:=0.5",
            "-r",
            "__ns:=/cell",
        ];
        let settings = settings(&words).unwrap();
        assert_eq!(settings.fusion.cameras, ["a", "b"]);
        assert_eq!(settings.fusion.still().unwrap().frames, 7);
        assert_eq!(settings.fusion.percentile, 0.5);
        assert_eq!(settings.fusion.workspace.workspace().rows, 100);
        assert_eq!(settings.driver.contact, pick_place::ContactSign::Height);
        let topics = settings.topics();
        assert_eq!(topics[..2], ["/cell/joint_states", "/tf_static"]);
        assert!(topics.contains(&"/cell/b/zed_node/depth/depth_registered".to_owned()));
    }

    #[test]
    fn parameters_that_the_nodes_would_refuse_are_refused_by_name() {
        for (words, part) in [
            (["--", "-p", "camera_fusion:frames:=0"], "frames"),
            (
                ["--", "-p", "camera_fusion:camera_preset:=kinect"],
                "kinect",
            ),
            (
                ["--", "-p", "suction_executor:driver.contact:=luck"],
                "contact",
            ),
            (["--cameras", "front,front", "--"], "cameras"),
        ] {
            let error = format!("{:#}", settings(&words).err().unwrap());
            assert!(error.contains(part), "{error}");
        }
    }
}
