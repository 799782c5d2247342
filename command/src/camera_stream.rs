//! `sctn bench camera_stream`: three cameras of 1 MB images at 30 Hz into camera_fusion, a process of its own.

use crate::root::Root;
use anyhow::{Context as _, Result, bail, ensure};
use cell_emulation::cameras::camera_transforms;
use heightmap::{Camera, Intrinsics};
use msgs::convert;
use msgs::diagnostic_msgs::DiagnosticArray;
use msgs::sctn_msgs::Heightmap;
use msgs::sensor_msgs::{CameraInfo, Image};
use msgs::tf2_msgs::TFMessage;
use node_kit::{Context, Network, NoParameters, Publisher, Qos, RosArguments, Subscription, when};
use serde::Serialize;
use std::collections::BTreeMap;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use tokio::time::sleep_until;

const RATE_HZ: f64 = 30.0;
/// Its colour image has 1.04 MB, its depth image of 16UC1 0.69 MB.
const INTRINSICS: Intrinsics = Intrinsics {
    width: 720,
    cx_px: 360.0,
    ..Intrinsics::RAVENS
};
const DISCOVERY: Duration = Duration::from_secs(30);
/// Ticks of `/proc/PID/stat` in a second, on every Linux that Rust runs on.
const TICKS_PER_S: f64 = 100.0;

/// What was measured.
#[derive(Debug, Serialize)]
pub struct Figures {
    pub seconds: f64,
    /// Sets of images that a heightmap is the median of.
    pub frames: usize,
    pub mb_s: f64,
    /// Sets of six images.
    pub sets: u64,
    pub heightmaps: u64,
    /// Images that the fusion missed, by its own count.
    pub images_lost: u64,
    /// Processor time of the fusion, in cores.
    pub fusion_cores: f64,
    /// From the last image of a set, sent, to its heightmap, received in another process than the fusion.
    pub latency_median_s: f64,
    pub latency_p99_s: f64,
    pub latency_max_s: f64,
}

/// Killed when it is dropped.
struct Fusion(Child);

impl Drop for Fusion {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Fusion {
    fn start(root: &Root, domain_id: u16, frames: usize) -> Result<Self> {
        let program = std::env::current_exe().context("path of the program")?;
        let executable = program.with_file_name("camera_fusion");
        let child = Command::new(&executable)
            .args(["--ros-args", "--params-file"])
            .arg(root.join("config/camera_fusion.yaml"))
            .args(["-p", &format!("frames:={frames}")])
            .env("ROS_DOMAIN_ID", domain_id.to_string())
            .env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .spawn()
            .with_context(|| format!("{}: build the workspace first", executable.display()))?;
        Ok(Self(child))
    }

    /// Processor time so far.
    fn cpu_s(&self) -> Result<f64> {
        let path = format!("/proc/{}/stat", self.0.id());
        let text = std::fs::read_to_string(&path).context(path)?;
        // Behind the name, which may hold anything: fields 14 and 15 are times in user and kernel mode.
        let fields = text.rsplit_once(')').context("/proc/PID/stat")?.1;
        let ticks: Vec<f64> = fields
            .split_whitespace()
            .skip(11)
            .take(2)
            .map(str::parse)
            .collect::<Result<_, _>>()?;
        Ok(ticks.iter().sum::<f64>() / TICKS_PER_S)
    }
}

/// Where the images of one camera go, and the images.
struct Source {
    color: (Publisher<Image>, Image),
    depth: (Publisher<Image>, Image),
    info: (Publisher<CameraInfo>, CameraInfo),
}

impl Source {
    fn publish(&self, stamp: Duration) -> Result<()> {
        let stamp = convert::time_to_msg(stamp)?;
        let mut info = self.info.1.clone();
        info.header.stamp = stamp;
        self.info.0.publish(info);
        for (publisher, image) in [&self.color, &self.depth] {
            let mut image = image.clone();
            image.header.stamp = stamp;
            publisher.publish(image);
        }
        Ok(())
    }
}

/// Runs the benchmark for so many seconds; a heightmap is the median of so many sets of images.
pub fn measure(root: &Root, seconds: f64, frames: usize) -> Result<Figures> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()?;
    let figures = runtime.block_on(run(root, seconds, frames));
    runtime.shutdown_timeout(Duration::from_millis(500));
    figures
}

async fn run(root: &Root, seconds: f64, frames: usize) -> Result<Figures> {
    let network = Network::unused()?;
    let mut fusion = Fusion::start(root, network.domain_id, frames)?;
    let context = Context::new(network);
    let (node, _) = context.node::<NoParameters>("cameras", &RosArguments::default())?;
    let cameras = Camera::ravens().map(|camera| Camera {
        intrinsics: INTRINSICS,
        ..camera
    });
    let tf_static = node.publisher::<TFMessage>("/tf_static", Qos::Latched)?;
    let transforms = camera_transforms(&cameras, "world", Duration::ZERO)?;
    let mut sources = Vec::new();
    let mut bytes = 0;
    for (camera, transform) in cameras.iter().zip(&transforms.transforms) {
        let name = &camera.name;
        let header = convert::header(Duration::ZERO, &transform.child_frame_id)?;
        let rgb = (0..3 * INTRINSICS.len()).map(|index| (index % 251) as u8);
        let color = convert::color_to_msg(header.clone(), &INTRINSICS, rgb.collect())?;
        let depth =
            convert::depth_to_msg_mm(header.clone(), &INTRINSICS, &vec![0.9; INTRINSICS.len()])?;
        bytes += color.data.len() + depth.data.len();
        sources.push(Source {
            color: (
                node.publisher(&format!("{name}/color/image_raw"), Qos::Image)?,
                color,
            ),
            depth: (
                node.publisher(&format!("{name}/depth/image_rect_raw"), Qos::Image)?,
                depth,
            ),
            info: (
                node.publisher(&format!("{name}/color/camera_info"), Qos::Image)?,
                convert::intrinsics_to_msg(header, &INTRINSICS),
            ),
        });
    }
    tf_static.publish(transforms);
    let mut heightmaps = node.subscription::<Heightmap>("heightmap", Qos::Latched)?;
    let mut diagnostics = node.subscription::<DiagnosticArray>("/diagnostics", Qos::Event)?;
    for source in &sources {
        for topic in [
            source.color.0.topic(),
            source.depth.0.topic(),
            source.info.0.topic(),
        ] {
            let heard = node.graph().wait_for_subscription(topic, DISCOVERY).await;
            ensure!(heard, "nobody subscribes to {topic} within {DISCOVERY:?}");
        }
    }
    // Both ends know each other a little later.
    tokio::time::sleep(Duration::from_secs(1)).await;

    let mut stamp = Duration::from_secs(1000);
    let period = Duration::from_secs_f64(1.0 / RATE_HZ);
    // Until it works, and has all its memory.
    for _ in 0..60 {
        stamp += period;
        sources
            .iter()
            .try_for_each(|source| source.publish(stamp))?;
        tokio::time::sleep(period).await;
    }
    tokio::time::sleep(Duration::from_secs(1)).await;
    ensure!(
        heightmaps.try_recv().is_some(),
        "the fusion makes no heightmaps of the first 60 sets"
    );
    while heightmaps.try_recv().is_some() {}
    let lost_before = images_lost(&mut diagnostics).await?;

    let cpu_before_s = fusion.cpu_s()?;
    let begin = Instant::now();
    let mut ticks = tokio::time::interval(period);
    let sets = (seconds * RATE_HZ).round() as u64;
    let mut sent: BTreeMap<Duration, Instant> = BTreeMap::new();
    let mut latencies_s = Vec::new();
    let mut left = sets;
    let mut end = None;
    loop {
        tokio::select! {
            heightmap = heightmaps.recv() => {
                let stamp = convert::time_from_msg(&heightmap.header.stamp)?;
                ensure!(heightmap.views == 3, "a heightmap of {} views", heightmap.views);
                if let Some(at) = sent.remove(&stamp) {
                    latencies_s.push(at.elapsed().as_secs_f64());
                }
            }
            _ = ticks.tick(), if left > 0 => {
                stamp += period;
                // The last one of the set counts.
                sources.iter().try_for_each(|source| source.publish(stamp))?;
                sent.insert(stamp, Instant::now());
                left -= 1;
                if left == 0 {
                    end = Some(Instant::now() + Duration::from_secs(2));
                }
            }
            () = when(end.map(|end: Instant| sleep_until(end.into()))) => break,
        }
        if latencies_s.len() as u64 == sets {
            break;
        }
    }
    let took_s = begin.elapsed().as_secs_f64();
    let cpu_s = fusion.cpu_s()? - cpu_before_s;
    if let Some(status) = fusion.0.try_wait()? {
        bail!("camera_fusion ended: {status}");
    }
    let images_lost = images_lost(&mut diagnostics).await? - lost_before;
    context.shutdown();
    latencies_s.sort_by(f64::total_cmp);
    let quantile = |share: f64| {
        let last = latencies_s.len().saturating_sub(1);
        latencies_s
            .get((share * last as f64).round() as usize)
            .copied()
            .unwrap_or(f64::NAN)
    };
    Ok(Figures {
        seconds,
        frames,
        mb_s: bytes as f64 * RATE_HZ / 1e6,
        sets,
        heightmaps: latencies_s.len() as u64,
        images_lost,
        fusion_cores: cpu_s / took_s,
        latency_median_s: quantile(0.5),
        latency_p99_s: quantile(0.99),
        latency_max_s: quantile(1.0),
    })
}

/// What the fusion says of its image topics in its next diagnostics.
async fn images_lost(diagnostics: &mut Subscription<DiagnosticArray>) -> Result<u64> {
    while diagnostics.try_recv().is_some() {}
    let report = tokio::time::timeout(Duration::from_secs(10), async {
        loop {
            let array = diagnostics.recv().await;
            let mut statuses = array.status.into_iter();
            if let Some(status) = statuses.find(|status| status.name == "/camera_fusion: topics") {
                return status;
            }
        }
    });
    let report = report.await.context("no diagnostics of camera_fusion")?;
    let of_images = report.values.iter().filter(|value| {
        value.key.ends_with("/image_raw") || value.key.ends_with("/image_rect_raw")
    });
    let mut lost = 0;
    for value in of_images {
        let dropped = value
            .value
            .split_whitespace()
            .find_map(|word| word.strip_prefix("dropped="));
        lost += dropped
            .with_context(|| format!("no `dropped=` in {:?}", value.value))?
            .parse::<u64>()?;
    }
    Ok(lost)
}
