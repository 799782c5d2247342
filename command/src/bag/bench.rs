//! `sctn bag bench`: the writer beside the disk, and a recording of three cameras.

use super::DAMAGED;
use anyhow::{Context as _, Result, bail};
use bags::{BagReader, BagWriter, Compression, Qos};
use clap::Args;
use msgs::sensor_msgs::Image;
use msgs::{ByteBuf, Interface, to_cdr};
use node_kit::RawQos;
use node_kit::plain_node;
use serde_json::{Value, json};
use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitCode, Stdio};
use std::time::{Duration, Instant};

/// Messages of the writer's benchmark.
const MESSAGE_BYTES: usize = 1_000_000;
/// Longer than any window of the compression: no message repeats one that it remembers.
const NOISE_BYTES: usize = 16 * MESSAGE_BYTES;
const WRITTEN_BYTES: usize = 2_000_000_000;
const CAMERAS: [&str; 3] = ["front", "left", "right"];
const RATE_HZ: f64 = 30.0;
/// Width, height; bytes of a pixel of colour and of depth.
const SIZE: (u32, u32) = (640, 480);
const COLOR: (&str, u32) = ("rgb8", 3);
const DEPTH: (&str, u32) = ("16UC1", 2);
/// How long the two ends may take to find each other.
const DISCOVERY: Duration = Duration::from_secs(20);
/// rosbag2's own figures for 1 MiB messages into its MCAP storage: on a RAM disk, NUC i5-7260U.
const ROSBAG2_MB_S: f64 = 2236.0;
const ROSBAG2_ZSTD_MB_S: f64 = 335.0;

/// Arguments of `sctn bag bench`.
#[derive(Args)]
pub struct Bench {
    /// Folder on the disk to be measured; takes 2 GB, and 140 MB a second of recording, removed afterwards
    #[arg(long, default_value = ".")]
    dir: PathBuf,
    /// Seconds that three cameras are recorded; 0: not at all
    #[arg(long, default_value_t = 60)]
    seconds: u64,
    /// Gigabytes of a bag that is listed and played from the middle; 0: none
    #[arg(long, value_name = "GB", default_value_t = 0)]
    large: u64,
    /// Print a JSON object last
    #[arg(long)]
    json: bool,
    /// Be the cameras, for so many seconds
    #[arg(long, hide = true)]
    publish: Option<u64>,
}

impl Bench {
    pub fn run(self) -> Result<ExitCode> {
        if let Some(seconds) = self.publish {
            return publish(Duration::from_secs(seconds));
        }
        let folder = tempfile::tempdir_in(&self.dir).context("--dir")?;
        let data = noise(NOISE_BYTES);
        let disk = disk(folder.path(), &data)?;
        println!("the disk alone: {disk:.0} MB/s (sequential, 1 MB at a time, synced)");
        let mut writer = json!({"disk_mb_s": disk});
        for (name, compression, rosbag2) in [
            ("none", Compression::None, ROSBAG2_MB_S),
            ("zstd", Compression::default(), ROSBAG2_ZSTD_MB_S),
        ] {
            let rate = bag(folder.path(), &data, compression)?;
            println!(
                "the writer, 1 MB messages, compression {name}: {rate:.0} MB/s, {:.2} of the disk (rosbag2, RAM disk, NUC \
                 i5: {rosbag2:.0} MB/s)",
                rate / disk
            );
            writer[format!("writer_{name}_mb_s")] = rate.into();
        }
        let mut report = json!({"writer": writer});
        let mut complete = true;
        if self.large > 0 {
            report["large"] = large(folder.path(), &data, self.large)?;
        }
        if self.seconds > 0 {
            let recording = record(folder.path(), self.seconds)?;
            complete = recording["lost"] == 0;
            println!(
                "three cameras for {} s: {} of {} messages recorded, {:.0} MB/s, peak memory {:.0} MB",
                self.seconds,
                recording["messages"],
                recording["sent"],
                recording["mb_s"].as_f64().unwrap_or(0.0),
                recording["peak_mb"].as_f64().unwrap_or(0.0)
            );
            if let Some(dropped) = recording["socket_drops"]
                .as_u64()
                .filter(|count| *count > 0)
            {
                println!(
                    "  {dropped} datagrams found a full socket buffer meanwhile: the images are best effort, and the recorder did not get \
                     the processor in time; net.core.rmem_max allows a larger buffer"
                );
            }
            println!(
                "that bag, {:.1} GB: listed in {:.3} s; the first message from the middle after {:.3} s; this process has had \
                 at most {:.0} MB",
                recording["gb"].as_f64().unwrap_or(0.0),
                recording["listed_s"].as_f64().unwrap_or(0.0),
                recording["middle_s"].as_f64().unwrap_or(0.0),
                recording["reader_peak_mb"].as_f64().unwrap_or(0.0)
            );
            report["recording"] = recording;
        }
        if self.json {
            println!("{report}");
        }
        Ok(if complete {
            ExitCode::SUCCESS
        } else {
            ExitCode::from(DAMAGED)
        })
    }
}

/// Bytes that do not compress, the same every time.
fn noise(count: usize) -> Vec<u8> {
    let mut state = 1u64;
    let byte = |_| {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1);
        (state >> 56) as u8
    };
    (0..count).map(byte).collect()
}

fn messages(noise: &[u8]) -> impl Iterator<Item = &[u8]> {
    let all = noise.chunks_exact(MESSAGE_BYTES).cycle();
    all.take(WRITTEN_BYTES / MESSAGE_BYTES)
}

fn disk(folder: &Path, data: &[u8]) -> Result<f64> {
    let path = folder.join("disk");
    let started = Instant::now();
    let mut file = File::create_new(&path)?;
    for message in messages(data) {
        file.write_all(message)?;
    }
    file.sync_all()?;
    let rate = WRITTEN_BYTES as f64 / 1e6 / started.elapsed().as_secs_f64();
    std::fs::remove_file(path)?;
    Ok(rate)
}

fn bag(folder: &Path, data: &[u8], compression: Compression) -> Result<f64> {
    let path = folder.join("bag");
    let started = Instant::now();
    let mut bag = BagWriter::create(&path, compression)?;
    let topic = bag.add::<Image>("/image", Qos::BEST_EFFORT)?;
    for (index, message) in messages(data).enumerate() {
        let time = Duration::from_millis(index as u64);
        bag.write_cdr(topic, time, time, message)?;
    }
    bag.finish()?;
    let rate = WRITTEN_BYTES as f64 / 1e6 / started.elapsed().as_secs_f64();
    std::fs::remove_dir_all(path)?;
    Ok(rate)
}

/// The three cameras: colour and depth, for so long.
fn publish(time: Duration) -> Result<ExitCode> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()?;
    runtime.block_on(async {
        let (context, node) = plain_node("cameras", &[])?;
        let qos = RawQos {
            reliable: false,
            transient_local: false,
            depth: 8,
        };
        let mut topics = Vec::new();
        for camera in CAMERAS {
            for (name, (encoding, bytes)) in [("color", COLOR), ("depth", DEPTH)] {
                let topic = format!("/{camera}/{name}/image_raw");
                let image = Image {
                    width: SIZE.0,
                    height: SIZE.1,
                    encoding: encoding.into(),
                    step: SIZE.0 * bytes,
                    data: ByteBuf::from(noise((SIZE.0 * SIZE.1 * bytes) as usize)),
                    ..Image::default()
                };
                let publisher = node.raw_publisher(&topic, Image::TYPE_NAME, qos)?;
                topics.push((publisher, to_cdr(&image)?));
            }
        }
        let names: Vec<String> = topics
            .iter()
            .map(|(topic, _)| topic.topic().to_owned())
            .collect();
        let unheard = node.graph().wait_for_subscriptions(&names, DISCOVERY).await;
        if !unheard.is_empty() {
            bail!("nobody records {}", unheard.join(", "));
        }
        // Both ends know each other a little later.
        tokio::time::sleep(Duration::from_secs(1)).await;
        let mut ticks = tokio::time::interval(Duration::from_secs_f64(1.0 / RATE_HZ));
        let frames = (time.as_secs_f64() * RATE_HZ) as u64;
        let mut sent = 0u64;
        for _ in 0..frames {
            ticks.tick().await;
            for (topic, image) in &topics {
                sent += u64::from(topic.publish(image.clone()));
            }
        }
        tokio::time::sleep(Duration::from_secs(1)).await;
        context.shutdown();
        println!("{}", json!({"sent": sent}));
        Ok(ExitCode::SUCCESS)
    })
}

/// Killed when it is dropped.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn start(arguments: &[&str], out: &Path) -> Result<Running> {
    let program = std::env::current_exe().context("path of the program")?;
    let child = Command::new(program)
        .args(["bag"])
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(File::create(out)?)
        .spawn()?;
    Ok(Running(child))
}

fn last_json(out: &Path) -> Result<Value> {
    let text = std::fs::read_to_string(out)?;
    let line = text.lines().last().context("no report")?;
    Ok(serde_json::from_str(line)?)
}

/// Most memory that a process has had [MB].
fn peak_mb(process: &str) -> Option<f64> {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).ok()?;
    let line = status
        .lines()
        .find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kilobytes: f64 = line.trim().strip_suffix(" kB")?.parse().ok()?;
    Some(kilobytes * 1024.0 / 1e6)
}

/// Runs `sctn bag`; how long it took, and the most memory that it has had.
fn measured(arguments: &[&str], out: &Path) -> Result<(f64, f64)> {
    let started = Instant::now();
    let mut child = start(arguments, out)?;
    let id = child.0.id().to_string();
    let mut peak = 0.0f64;
    let status = loop {
        if let Some(status) = child.0.try_wait()? {
            break status;
        }
        peak = peak.max(peak_mb(&id).unwrap_or(0.0));
        std::thread::sleep(Duration::from_millis(2));
    };
    if !status.success() {
        bail!("sctn bag {}: {status}", arguments.join(" "));
    }
    Ok((started.elapsed().as_secs_f64(), peak))
}

/// Lists a large bag, and plays two seconds from its middle.
fn large(folder: &Path, data: &[u8], gigabytes: u64) -> Result<Value> {
    let (path, out) = (folder.join("large"), folder.join("large.out"));
    let mut bag = BagWriter::create(&path, Compression::None)?;
    let topic = bag.add::<Image>("/image", Qos::RELIABLE)?;
    let count = gigabytes * 1000;
    // Messages that a player takes: they begin as CDR does.
    let mut message = vec![0; MESSAGE_BYTES];
    for (index, noise) in (0..count).zip(data.chunks_exact(MESSAGE_BYTES).cycle()) {
        message.copy_from_slice(noise);
        message[..4].copy_from_slice(&[0, 1, 0, 0]);
        let time = Duration::from_millis(10 * index);
        bag.write_cdr(topic, time, time, &message)?;
    }
    bag.finish()?;
    let name = path.display().to_string();
    let (info_s, info_mb) = measured(&["info", &name], &out)?;
    let start = (count / 200).to_string();
    let (play_s, play_mb) = measured(
        &[
            "play",
            &name,
            "--start",
            &start,
            "--duration",
            "2",
            "--json",
        ],
        &out,
    )?;
    let played = last_json(&out)?["messages"].as_u64().context("messages")?;
    std::fs::remove_dir_all(&path)?;
    println!(
        "a bag of {gigabytes} GB: listed in {info_s:.2} s with at most {info_mb:.0} MB of memory; two seconds played from the \
         middle, {played} messages in {play_s:.1} s with at most {play_mb:.0} MB"
    );
    Ok(json!({
        "gb": gigabytes,
        "info_s": info_s,
        "info_peak_mb": info_mb,
        "play_s": play_s,
        "play_messages": played,
        "play_peak_mb": play_mb,
    }))
}

/// Datagrams for which this machine's kernel found no room in a socket's buffer.
fn socket_drops() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/net/snmp").ok()?;
    let mut lines = text.lines().filter_map(|line| line.strip_prefix("Udp: "));
    let (names, values) = lines.next().zip(lines.next())?;
    let column = names
        .split_whitespace()
        .position(|name| name == "RcvbufErrors")?;
    values.split_whitespace().nth(column)?.parse().ok()
}

fn record(folder: &Path, seconds: u64) -> Result<Value> {
    let path = folder.join("recording");
    let (out, cameras_out) = (folder.join("record.out"), folder.join("cameras.out"));
    let bag = path.display().to_string();
    let arguments = [
        "record",
        "--regex",
        "/image_raw$",
        "--compression",
        "none",
        "--out",
        &bag,
        "--json",
    ];
    let dropped_before = socket_drops();
    let mut recorder = start(&arguments, &out)?;
    let seconds_text = seconds.to_string();
    let mut cameras = start(&["bench", "--publish", &seconds_text], &cameras_out)?;
    let mut peak = 0.0f64;
    let cameras_ended = loop {
        if let Some(status) = cameras.0.try_wait()? {
            break status;
        }
        if let Some(status) = recorder.0.try_wait()? {
            bail!("the recorder ended early: {status}");
        }
        peak = peak.max(peak_mb(&recorder.0.id().to_string()).unwrap_or(0.0));
        std::thread::sleep(Duration::from_millis(100));
    };
    if !cameras_ended.success() {
        bail!("the cameras failed: {cameras_ended}");
    }
    let pid = rustix::process::Pid::from_child(&recorder.0);
    rustix::process::kill_process(pid, rustix::process::Signal::INT)?;
    while recorder.0.try_wait()?.is_none() {
        peak = peak.max(peak_mb(&recorder.0.id().to_string()).unwrap_or(0.0));
        std::thread::sleep(Duration::from_millis(20));
    }
    let dropped = socket_drops()
        .zip(dropped_before)
        .map(|(after, before)| after - before);
    let recorded = last_json(&out)?;
    let sent = last_json(&cameras_out)?["sent"].as_u64().context("sent")?;
    let messages = recorded["messages"].as_u64().context("messages")?;
    let bytes = recorded["bytes"].as_f64().context("bytes")?;

    let started = Instant::now();
    let reader = BagReader::open(&path)?;
    let (first, last) = reader.span().context("an empty recording")?;
    let listed_s = started.elapsed().as_secs_f64();
    let started = Instant::now();
    let middle = first + (last - first) / 2;
    reader
        .messages_between(&[], middle, Duration::MAX)
        .next()
        .context("nothing from the middle on")??;
    let middle_s = started.elapsed().as_secs_f64();
    Ok(json!({
        "seconds": seconds,
        "sent": sent,
        "messages": messages,
        "lost": sent.saturating_sub(messages),
        "socket_drops": dropped,
        "mb_s": bytes / 1e6 / (last - first).as_secs_f64(),
        "peak_mb": peak,
        "gb": bytes / 1e9,
        "listed_s": listed_s,
        "middle_s": middle_s,
        "reader_peak_mb": peak_mb("self"),
    }))
}
