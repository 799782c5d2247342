//! What is inside a bag.

use crate::{BagError, BagReader, Qos};
use msgs::Interface;
use msgs::sctn_msgs::{Reward, StepConfirmation, StepResult};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;
use step_protocol::{OperatorDecision, StepOutcome};

/// A bag at a glance. Reads indices, and of the messages only those that say how the steps went.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct BagInfo {
    /// Where it lies.
    pub path: PathBuf,
    /// Its files.
    pub files: Vec<FileInfo>,
    /// Bytes of all files.
    pub bytes: u64,
    /// Messages in all.
    pub messages: u64,
    /// Log time of the first message, since the clock's zero, in seconds.
    pub start_s: f64,
    /// From the first message to the last, in seconds.
    pub duration_s: f64,
    /// Its topics, by name.
    pub topics: Vec<TopicInfo>,
    /// How its steps went, if it holds any.
    pub run: Option<RunInfo>,
    /// `custom_data` of `metadata.yaml`.
    pub notes: BTreeMap<String, String>,
}

/// A file of a bag.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FileInfo {
    /// Its name.
    pub name: String,
    /// `mcap` or `sqlite3`.
    pub storage: &'static str,
    /// Its size.
    pub bytes: u64,
    /// Its messages.
    pub messages: u64,
    /// Its chunks.
    pub chunks: usize,
}

/// A topic of a bag.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TopicInfo {
    /// Its name.
    pub name: String,
    /// Its type.
    #[serde(rename = "type")]
    pub type_name: String,
    /// Its messages.
    pub messages: u64,
    /// Messages a second over the whole bag.
    pub rate_hz: f64,
    /// Whether the bag holds the definition of its type.
    pub has_definition: bool,
    /// What its publishers offered.
    pub offered: Vec<Qos>,
}

/// The steps of a run or of a demonstration.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct RunInfo {
    /// Step results by outcome.
    pub results: BTreeMap<&'static str, u64>,
    /// The operator's decisions.
    pub decisions: BTreeMap<&'static str, u64>,
    /// Sum of the rewards, as the last one says; none if nothing measured them.
    pub reward: Option<f64>,
    /// Whether the last reward says that nothing is left to do.
    pub complete: bool,
}

/// An outcome of a step in words.
pub fn outcome_name(outcome: u8) -> &'static str {
    StepOutcome::from_repr(outcome).map_or("unknown outcome", StepOutcome::name)
}

fn decision_name(decision: u8) -> &'static str {
    OperatorDecision::from_repr(decision).map_or("unknown decision", OperatorDecision::name)
}

impl BagInfo {
    /// Looks into a bag.
    pub fn read(path: &Path) -> Result<Self, BagError> {
        let bag = BagReader::open(path)?;
        let mut files = Vec::new();
        for file in bag.files() {
            let size =
                std::fs::metadata(file.path).map_err(|error| BagError::io(file.path, error))?;
            files.push(FileInfo {
                name: file
                    .path
                    .file_name()
                    .unwrap_or_default()
                    .to_string_lossy()
                    .into_owned(),
                storage: file.storage,
                bytes: size.len(),
                messages: file.message_count,
                chunks: file.chunk_count,
            });
        }
        let (start, end) = bag.span().unwrap_or_default();
        let duration_s = (end.saturating_sub(start)).as_secs_f64();
        let topics = bag.topics().iter().map(|topic| TopicInfo {
            name: topic.name.clone(),
            type_name: topic.type_name.clone(),
            messages: topic.message_count,
            rate_hz: if duration_s > 0.0 {
                topic.message_count as f64 / duration_s
            } else {
                0.0
            },
            has_definition: !topic.definition.is_empty(),
            offered: topic.offered.clone(),
        });
        Ok(Self {
            path: path.to_owned(),
            bytes: files.iter().map(|file| file.bytes).sum(),
            messages: files.iter().map(|file| file.messages).sum(),
            files,
            start_s: start.as_secs_f64(),
            duration_s,
            topics: topics.collect(),
            run: run_info(&bag)?,
            notes: bag.notes().clone(),
        })
    }
}

fn run_info(bag: &BagReader) -> Result<Option<RunInfo>, BagError> {
    let of_type = |type_name: &str| {
        let topics = bag.topics().iter();
        topics
            .filter(|topic| topic.type_name == type_name && topic.message_count > 0)
            .map(|topic| topic.name.as_str())
            .collect::<Vec<_>>()
    };
    let results = of_type(StepResult::TYPE_NAME);
    let confirmations = of_type(StepConfirmation::TYPE_NAME);
    let rewards = of_type(Reward::TYPE_NAME);
    let all = [results, confirmations, rewards].concat();
    if all.is_empty() {
        return Ok(None);
    }
    let mut run = RunInfo::default();
    for message in bag.messages_between(&all, Duration::ZERO, Duration::MAX) {
        let message = message?;
        match message.topic.type_name.as_str() {
            StepResult::TYPE_NAME => {
                let result: StepResult = message.decode()?;
                *run.results.entry(outcome_name(result.outcome)).or_default() += 1;
            }
            StepConfirmation::TYPE_NAME => {
                let confirmation: StepConfirmation = message.decode()?;
                let name = decision_name(confirmation.decision);
                *run.decisions.entry(name).or_default() += 1;
            }
            _ => {
                let reward: Reward = message.decode()?;
                run.reward = Some(reward.total);
                run.complete = reward.complete;
            }
        }
    }
    Ok(Some(run))
}
