//! `sctn bag`: records, plays, looks into, films, checks and repairs bags.

mod bench;
mod export;
mod film;
mod import;
mod play;
mod record;

use anyhow::{Context, Result};
use bags::{BagInfo, Compression, Findings, recover, verify};
use clap::{Args, Subcommand, ValueEnum};
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// The bag is damaged, or something had to be left out. 1 is for what could not be done, 2 for a wrong command line.
const DAMAGED: u8 = 3;
/// Findings that are shown to a person; `--json` has more.
const SHOWN: usize = 20;

/// Record, play, look into, check and repair bags
///
/// Exit codes: 0 done and whole; 1 could not be done; 2 wrong command line; 3 damaged, or something is missing.
#[derive(Args)]
pub struct Bag {
    #[command(subcommand)]
    command: Command,
}

/// Records topics of the running graph for some seconds.
pub fn record_topics(
    topics: Vec<String>,
    out: &std::path::Path,
    seconds: f64,
    use_sim_time: bool,
) -> Result<()> {
    record::Record::of_topics(topics, out, seconds, use_sim_time).run()?;
    Ok(())
}

#[derive(Subcommand)]
enum Command {
    /// Record topics of any type; exit code 3 if messages were lost on the way to the disk, or it was full
    Record(record::Record),
    /// Publish what was recorded, at the recorded pace and quality of service
    Play(play::Play),
    /// Show files, topics, types, counts, steps and rewards
    Info(Info),
    /// Check every byte: framing, checksums, indices, counts; exit code 3 if it is not whole
    Verify(Verify),
    /// Write a repaired copy, also of a bag that was never finished; exit code 3 if something was left out
    Recover(Recover),
    /// Write demonstrations and recorded runs as a data set for LeRobot, and as pictures and arrays
    Export(export::Export),
    /// Write the episodes of such a data set as bags
    Import(import::Import),
    /// Draw a recorded run as an animated GIF: each proposal on the workspace, beside its goal, and its result
    Film(film::Film),
    /// Measure the writer beside the disk, and a recording of three cameras
    Bench(bench::Bench),
}

#[derive(Args)]
struct Info {
    /// Folder of a bag, or a single .mcap or .db3 file
    bag: PathBuf,
    /// Print a JSON object
    #[arg(long)]
    json: bool,
}

#[derive(Args)]
struct Verify {
    /// Folder of a bag, finished or not, or a single .mcap or .db3 file
    bag: PathBuf,
    /// Print a JSON object
    #[arg(long)]
    json: bool,
}

#[derive(Args)]
struct Recover {
    /// Folder of a bag, finished or not, or a single .mcap or .db3 file
    bag: PathBuf,
    /// Folder for the copy; it must not exist
    #[arg(long)]
    out: PathBuf,
    /// Compression of the copy
    #[arg(long, value_enum, default_value = "zstd")]
    compression: CompressionName,
    /// Print a JSON object
    #[arg(long)]
    json: bool,
}

/// How chunks are compressed.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum CompressionName {
    /// Zstandard, level 3
    Zstd,
    /// Not at all
    None,
}

impl From<CompressionName> for Compression {
    fn from(name: CompressionName) -> Self {
        match name {
            CompressionName::Zstd => Self::default(),
            CompressionName::None => Self::None,
        }
    }
}

impl Bag {
    pub fn run(self) -> Result<ExitCode> {
        match self.command {
            Command::Record(record) => record.run(),
            Command::Play(play) => play.run(),
            Command::Info(info) => info.run(),
            Command::Verify(verify) => verify.run(),
            Command::Recover(recover) => recover.run(),
            Command::Export(export) => export.run(),
            Command::Import(import) => import.run(),
            Command::Film(film) => film.run(),
            Command::Bench(bench) => bench.run(),
        }
    }
}

impl Info {
    fn run(self) -> Result<ExitCode> {
        let info = BagInfo::read(&self.bag)?;
        if self.json {
            println!("{}", serde_json::to_string(&info)?);
            return Ok(ExitCode::SUCCESS);
        }
        println!("{}", info.path.display());
        for file in &info.files {
            println!(
                "  {}  {}, {} messages, {}",
                file.name,
                bytes(file.bytes),
                file.messages,
                match file.chunks {
                    0 => file.storage.to_owned(),
                    chunks => format!("{} in {chunks} chunks", file.storage),
                }
            );
        }
        println!(
            "{} messages in {:.3} s from {}",
            info.messages,
            info.duration_s,
            clock_time(info.start_s)
        );
        let width = |text: fn(&bags::TopicInfo) -> &str| {
            info.topics
                .iter()
                .map(|topic| text(topic).len())
                .max()
                .unwrap_or(0)
        };
        let (names, types) = (width(|topic| &topic.name), width(|topic| &topic.type_name));
        for topic in &info.topics {
            let offered: Vec<_> = topic.offered.iter().map(qos).collect();
            println!(
                "  {:names$}  {:types$}  {:>8}  {:>7.2} Hz  {}{}",
                topic.name,
                topic.type_name,
                topic.messages,
                topic.rate_hz,
                offered.join("; "),
                if topic.has_definition {
                    ""
                } else {
                    "  (no definition)"
                }
            );
        }
        if let Some(run) = &info.run {
            let list = |counts: &std::collections::BTreeMap<&str, u64>| {
                let counts: Vec<_> = counts
                    .iter()
                    .map(|(name, count)| format!("{count} {name}"))
                    .collect();
                counts.join(", ")
            };
            println!("steps: {}", list(&run.results));
            println!("operator: {}", list(&run.decisions));
            if let Some(reward) = run.reward {
                let complete = if run.complete { ", complete" } else { "" };
                println!("reward: {reward:.3}{complete}");
            }
        }
        for (key, value) in &info.notes {
            println!("{key}: {value}");
        }
        Ok(ExitCode::SUCCESS)
    }
}

impl Verify {
    fn run(self) -> Result<ExitCode> {
        let verification = verify(&self.bag)?;
        if self.json {
            println!("{}", serde_json::to_string(&verification)?);
        } else {
            for file in &verification.files {
                println!(
                    "{}: {}, {} messages, {} chunks of at most {}",
                    file.name,
                    bytes(file.bytes),
                    file.messages,
                    file.chunks,
                    bytes(file.largest_chunk_bytes)
                );
                if file.unchecked_chunks > 0 {
                    println!(
                        "  {} chunks have no checksum: damage of their data would go unnoticed",
                        file.unchecked_chunks
                    );
                }
            }
            for topic in &verification.topics {
                println!(
                    "  {}: {} messages, {} missing, longest gap {:.3} s from {:.3} s",
                    topic.name,
                    topic.messages,
                    topic.missing,
                    topic.longest_gap_s,
                    topic.longest_gap_at_s
                );
            }
            show(&verification.findings);
            for remark in &verification.remarks {
                println!("  {remark}");
            }
            println!(
                "{}",
                if verification.whole {
                    "whole"
                } else {
                    "not whole"
                }
            );
        }
        Ok(exit_code(verification.whole))
    }
}

impl Recover {
    fn run(self) -> Result<ExitCode> {
        let recovery = recover(&self.bag, &self.out, Compression::from(self.compression))
            .with_context(|| format!("recover {}", self.bag.display()))?;
        if self.json {
            println!("{}", serde_json::to_string(&recovery)?);
        } else {
            for (topic, count) in &recovery.topics {
                println!("  {topic}: {count} messages");
            }
            show(&recovery.lost);
            println!(
                "{}: {} messages of {} intact chunks{}",
                recovery.path.display(),
                recovery.messages,
                recovery.chunks,
                if recovery.complete {
                    ", nothing left out"
                } else {
                    ""
                }
            );
        }
        Ok(exit_code(recovery.complete))
    }
}

/// Seconds of the command line.
fn seconds(value: f64) -> Result<Duration> {
    Duration::try_from_secs_f64(value)
        .with_context(|| format!("{value}: expected seconds, 0 or more"))
}

fn exit_code(whole: bool) -> ExitCode {
    if whole {
        ExitCode::SUCCESS
    } else {
        ExitCode::from(DAMAGED)
    }
}

fn show(findings: &Findings) {
    for finding in findings.first.iter().take(SHOWN) {
        let at = finding
            .offset
            .map(|offset| format!(", byte {offset}"))
            .unwrap_or_default();
        let lost = match finding.length {
            0 => String::new(),
            length => format!(" ({} unusable)", bytes(length)),
        };
        println!("{}{at}: {}{lost}", finding.file, finding.reason);
    }
    if findings.count > SHOWN as u64 {
        println!("... and {} more", findings.count - SHOWN as u64);
    }
}

fn qos(offered: &bags::Qos) -> String {
    format!(
        "{}, {}, depth {}",
        if offered.reliable {
            "reliable"
        } else {
            "best effort"
        },
        if offered.transient_local {
            "transient local"
        } else {
            "volatile"
        },
        offered.depth
    )
}

/// A size for a person.
fn bytes(count: u64) -> String {
    match count {
        0..10_000 => format!("{count} B"),
        10_000..10_000_000 => format!("{:.1} kB", count as f64 / 1e3),
        10_000_000..10_000_000_000 => format!("{:.1} MB", count as f64 / 1e6),
        _ => format!("{:.1} GB", count as f64 / 1e9),
    }
}

/// A time since the clock's zero; how long ago, if the clock is the wall's.
fn clock_time(seconds: f64) -> String {
    let now = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .unwrap_or_default();
    let ago = now.as_secs_f64() - seconds;
    // A clock that began this century is the wall's.
    if seconds > 946_684_800.0 && ago > 0.0 {
        let ago = Duration::from_secs(ago as u64);
        let (days, hours, minutes) = (
            ago.as_secs() / 86_400,
            ago.as_secs() / 3600 % 24,
            ago.as_secs() / 60 % 60,
        );
        return format!("{seconds:.3} s ({days} d {hours} h {minutes} min ago)");
    }
    format!("{seconds:.3} s")
}
