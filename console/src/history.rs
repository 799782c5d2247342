//! How runs of the library's demonstrations went: a file of one JSON object for each line.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{Read as _, Seek as _, SeekFrom, Write as _};
use std::path::PathBuf;
use std::time::{SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};

/// What is written about a run of a demonstration.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum RunEvent {
    /// The policy's first motion was carried out.
    Began {
        /// Names the run: the id of that motion's proposal.
        run: u64,
        /// Name of the demonstration in the library.
        demonstration: String,
        /// Name of the demonstration in the goals.
        goals: String,
        /// The policy's checkpoint.
        checkpoint: String,
    },
    /// All its steps are done.
    Completed {
        /// Names the run.
        run: u64,
    },
}

/// A line of the file.
#[derive(Serialize, Deserialize)]
struct Line {
    /// Seconds since 1970.
    at_s: u64,
    #[serde(flatten)]
    event: RunEvent,
}

/// How many runs of a demonstration with a checkpoint there were, and how many of them were completed.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct RunCount {
    /// Name of the checkpoint.
    pub checkpoint: String,
    /// Runs whose steps were all done.
    pub completed: usize,
    /// Runs in which the policy moved something.
    pub count: usize,
}

/// The file.
#[derive(Debug)]
pub struct History {
    path: PathBuf,
}

impl History {
    /// The file need not be there yet.
    pub fn new(path: PathBuf) -> Self {
        Self { path }
    }

    /// Adds an event. Writes the file.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn add(&self, event: RunEvent) -> std::io::Result<()> {
        if let Some(folder) = self.path.parent() {
            std::fs::create_dir_all(folder)?;
        }
        let now = SystemTime::now().duration_since(UNIX_EPOCH);
        let line = Line {
            at_s: now.unwrap_or_default().as_secs(),
            event,
        };
        let mut text = serde_json::to_string(&line)?;
        text.push('\n');
        let mut options = OpenOptions::new();
        let mut file = options
            .create(true)
            .read(true)
            .append(true)
            .open(&self.path)?;
        if !ends_with_a_line(&mut file)? {
            text.insert(0, '\n');
        }
        file.write_all(text.as_bytes())?;
        file.sync_data()
    }

    /// All events, oldest first; a line that is none, such as one that was half written, is left out. Reads the file.
    fn events(&self) -> Vec<RunEvent> {
        let text = std::fs::read_to_string(&self.path).unwrap_or_default();
        let lines = text.lines();
        lines
            .filter_map(|line| Some(serde_json::from_str::<Line>(line).ok()?.event))
            .collect()
    }

    /// How the runs of each demonstration went, by its name in the library. Reads the file.
    pub fn counts(&self) -> BTreeMap<String, Vec<RunCount>> {
        let mut runs = BTreeMap::new();
        let mut counts: BTreeMap<String, BTreeMap<String, RunCount>> = BTreeMap::new();
        for event in self.events() {
            match event {
                RunEvent::Began {
                    run,
                    demonstration,
                    checkpoint,
                    ..
                } => {
                    let count = counts.entry(demonstration.clone()).or_default();
                    let count = count.entry(checkpoint.clone()).or_insert(RunCount {
                        checkpoint: checkpoint.clone(),
                        completed: 0,
                        count: 0,
                    });
                    count.count += 1;
                    runs.insert(run, (demonstration, checkpoint));
                }
                RunEvent::Completed { run } => {
                    let known = runs.remove(&run);
                    let count = known.and_then(|(demonstration, checkpoint)| {
                        counts.get_mut(&demonstration)?.get_mut(&checkpoint)
                    });
                    if let Some(count) = count {
                        count.completed += 1;
                    }
                }
            }
        }
        let listed = |counts: BTreeMap<_, _>| counts.into_values().collect();
        let counts = counts.into_iter();
        counts
            .map(|(name, counts)| (name, listed(counts)))
            .collect()
    }

    /// The newest run, where it is not completed. Reads the file.
    pub fn open_run(&self) -> Option<RunEvent> {
        let last = self.events().pop();
        last.filter(|event| matches!(event, RunEvent::Began { .. }))
    }
}

/// Whether nothing was half written, for instance because the process was killed.
fn ends_with_a_line(file: &mut File) -> std::io::Result<bool> {
    if file.seek(SeekFrom::End(0))? == 0 {
        return Ok(true);
    }
    file.seek(SeekFrom::End(-1))?;
    let mut last = [0];
    file.read_exact(&mut last)?;
    Ok(last == *b"\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn began(run: u64, demonstration: &str, checkpoint: &str) -> RunEvent {
        RunEvent::Began {
            run,
            demonstration: demonstration.into(),
            goals: format!("{demonstration}/0"),
            checkpoint: checkpoint.into(),
        }
    }

    #[test]
    fn runs_are_counted_with_their_checkpoint_also_after_a_restart_and_a_half_written_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("library/runs.jsonl");
        let history = History::new(path.clone());
        assert_eq!((history.counts().len(), history.open_run()), (0, None));
        history.add(began(u64::MAX, "blocks", "any_start")).unwrap();
        history.add(RunEvent::Completed { run: u64::MAX }).unwrap();
        history.add(began(2, "blocks", "any_start")).unwrap();
        let whole = std::fs::read_to_string(&path).unwrap();
        std::fs::write(&path, whole + r#"{"at_s": 1, "event": "com"#).unwrap();
        let history = History::new(path);
        assert_eq!(history.open_run(), Some(began(2, "blocks", "any_start")));
        history.add(began(3, "blocks", "taught")).unwrap();
        history.add(RunEvent::Completed { run: 3 }).unwrap();
        assert_eq!(history.open_run(), None);
        let count = |checkpoint: &str, completed, count| RunCount {
            checkpoint: checkpoint.into(),
            completed,
            count,
        };
        let expected = vec![count("any_start", 1, 2), count("taught", 1, 1)];
        assert_eq!(
            history.counts(),
            BTreeMap::from([("blocks".into(), expected)])
        );
    }
}
