//! `sctn bag record`.

use super::{CompressionName, DAMAGED, bytes, seconds};
use anyhow::{Context as _, Result, bail};
use bag_transport::{Progress, Recorder, RecorderOptions, Selection};
use bags::WriteOptions;
use clap::Args;
use node_kit::{plain_node, wait_for_end, when};
use regex::RegexSet;
use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};
use tokio::time::sleep;

/// How often progress is shown: to a person, and in a log.
const SHOW_EVERY: Duration = Duration::from_secs(1);
const LOG_EVERY: Duration = Duration::from_secs(10);

/// Arguments of `sctn bag record`.
#[derive(Args)]
pub struct Record {
    /// Topics to record, by name
    topics: Vec<String>,
    /// Record every topic, but the hidden ones
    #[arg(long)]
    all: bool,
    /// Record also topics whose name matches this regular expression; may be repeated
    #[arg(long, value_name = "PATTERN")]
    regex: Vec<String>,
    /// Leave out topics whose name matches; may be repeated
    #[arg(long, value_name = "PATTERN")]
    exclude: Vec<String>,
    /// --all and --regex mean hidden topics too (a part of the name begins with an underscore)
    #[arg(long)]
    hidden: bool,
    /// Folder for the bag; it must not exist
    #[arg(long)]
    out: PathBuf,
    /// Compression
    #[arg(long, value_enum, default_value = "zstd")]
    compression: CompressionName,
    /// Begin a new file after this many megabytes
    #[arg(long, value_name = "MB")]
    split_size: Option<u64>,
    /// Begin a new file after this many seconds
    #[arg(long, value_name = "SECONDS")]
    split_duration: Option<f64>,
    /// End after this many seconds
    #[arg(long, value_name = "SECONDS")]
    duration: Option<f64>,
    /// Megabytes that may wait for the disk; what comes beyond is lost and counted
    #[arg(long, value_name = "MB", default_value_t = 192)]
    queue: usize,
    /// End when less room than this is left on the disk
    #[arg(long, value_name = "MB", default_value_t = 64)]
    min_free: u64,
    /// Log times from /clock
    #[arg(long)]
    use_sim_time: bool,
    /// Print a JSON object last
    #[arg(long)]
    json: bool,
}

impl Record {
    /// Records these topics for so many seconds.
    pub fn of_topics(topics: Vec<String>, out: &Path, seconds: f64, use_sim_time: bool) -> Self {
        Self {
            topics,
            all: false,
            regex: Vec::new(),
            exclude: Vec::new(),
            hidden: false,
            out: out.to_owned(),
            compression: CompressionName::None,
            split_size: None,
            split_duration: None,
            duration: Some(seconds),
            queue: 192,
            min_free: 64,
            use_sim_time,
            json: false,
        }
    }

    pub fn run(self) -> Result<ExitCode> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .enable_all()
            .build()
            .context("tokio runtime")?;
        let result = runtime.block_on(self.session());
        runtime.shutdown_timeout(Duration::from_millis(500));
        result
    }

    async fn session(&self) -> Result<ExitCode> {
        let sim_time = format!("use_sim_time:={}", self.use_sim_time);
        let (context, node) = plain_node("rosbag2_recorder", &["-p".to_owned(), sim_time])?;
        let selection = Selection {
            all: self.all,
            names: self.topics.iter().map(|name| node.resolve(name)).collect(),
            patterns: RegexSet::new(&self.regex).context("--regex")?,
            exclude: RegexSet::new(&self.exclude).context("--exclude")?,
            hidden: self.hidden,
        };
        if !self.all && self.topics.is_empty() && self.regex.is_empty() {
            bail!("nothing to record: name topics, or give --regex or --all");
        }
        let options = RecorderOptions {
            write: WriteOptions {
                compression: self.compression.into(),
                split_bytes: self.split_size.map(|size| size * 1_000_000),
                split_duration: self
                    .split_duration
                    .map(seconds)
                    .transpose()
                    .context("--split-duration")?,
            },
            queue_bytes: self.queue << 20,
            min_free_bytes: self.min_free * 1_000_000,
            use_sim_time: self.use_sim_time,
        };
        let limit = self
            .duration
            .map(seconds)
            .transpose()
            .context("--duration")?;
        let mut recorder = Recorder::start(&node, &self.out, options)?;
        tracing::info!("recording into {}; end it with Ctrl+C", self.out.display());
        let started = Instant::now();
        let mut show = Display::default();
        let end = wait_for_end();
        tokio::pin!(end);
        // In turns: looking for topics borrows the recorder.
        loop {
            tokio::select! {
                followed = tokio::time::timeout(SHOW_EVERY, recorder.follow(&selection)) => match followed {
                    Ok(ended) => {
                        ended?;
                        break;
                    }
                    Err(_) => show.progress(&recorder.progress(), started.elapsed()),
                },
                ended = &mut end => {
                    ended?;
                    break;
                }
                () = when(limit.map(|limit| sleep(limit.saturating_sub(started.elapsed())))) => break,
            }
        }
        show.clear();
        let seconds = started.elapsed().as_secs_f64();
        let recording = recorder.finish().await;
        context.shutdown();
        let recording = recording?;
        for (topic, count) in &recording.topics {
            if count.lost_in_transport + count.lost_in_queue > 0 {
                tracing::warn!(
                    "{topic}: {} messages lost in the transport, {} for want of room in the queue",
                    count.lost_in_transport,
                    count.lost_in_queue
                );
            }
        }
        if self.json {
            let mut object = serde_json::to_value(&recording)?;
            object["seconds"] = seconds.into();
            println!("{object}");
        } else {
            println!(
                "{}: {} messages on {} topics, {}, {seconds:.1} s",
                recording.bag.display(),
                recording.messages,
                recording.topics.len(),
                bytes(recording.bytes)
            );
        }
        let shortcoming = recording.shortcoming();
        if let Some(shortcoming) = &shortcoming {
            tracing::error!("{}: {shortcoming}", recording.bag.display());
        }
        Ok(if shortcoming.is_none() {
            ExitCode::SUCCESS
        } else {
            ExitCode::from(DAMAGED)
        })
    }
}

/// Shows rate and size: one line that changes, or a line of the log now and then.
#[derive(Default)]
struct Display {
    last: Option<(Duration, u64)>,
    logged: Duration,
}

impl Display {
    fn progress(&mut self, progress: &Progress, elapsed: Duration) {
        let (then, before) = self.last.unwrap_or_default();
        let rate = (progress.bytes - before) as f64 / (elapsed - then).as_secs_f64().max(1e-3);
        self.last = Some((elapsed, progress.bytes));
        let line = format!(
            "{:.0} s, {} messages, {}, {:.1} MB/s, lost: {} in the transport, {} in the queue",
            elapsed.as_secs_f64(),
            progress.messages,
            bytes(progress.bytes),
            rate / 1e6,
            progress.lost_in_transport,
            progress.lost_in_queue
        );
        if std::io::stderr().is_terminal() {
            eprint!("\r\x1b[2K{line}");
            let _ = std::io::stderr().flush();
        } else if elapsed - self.logged >= LOG_EVERY {
            self.logged = elapsed;
            tracing::info!("{line}");
        }
    }

    fn clear(&self) {
        if self.last.is_some() && std::io::stderr().is_terminal() {
            eprint!("\r\x1b[2K");
        }
    }
}
