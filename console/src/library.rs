//! Folders of demonstrations: tasks that can be repeated, and corrections that can be learned from.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::{SystemTime, UNIX_EPOCH};

use bags::Demonstration;
use heightmap::Heightmap;
use serde::Serialize;

use crate::history::{History, RunCount};
use crate::lesson;
use crate::refusal::Refusal;

/// Most demonstrations that are listed.
const MOST: usize = 1000;
/// Longest name of a folder [characters]: that of a correction, which is a problem's name, the number of a step and that of a proposal.
const LONGEST_NAME: usize = lesson::LONGEST_NAME + 28;

/// A demonstration in the library.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Entry {
    /// Name of its folder.
    pub name: String,
    /// Name of its problem.
    pub problem: String,
    /// Number of its steps.
    pub step_count: usize,
    /// When it was saved: seconds since 1970.
    pub saved_at_s: u64,
    /// How its runs went, for each checkpoint.
    pub runs: Vec<RunCount>,
}

/// What a person has taught.
#[derive(Debug)]
pub struct Libraries {
    /// Tasks that can be repeated.
    pub tasks: Library,
    /// Steps that a person has proposed in place of the policy, and that succeeded: each a demonstration of one step.
    pub corrections: Library,
    /// How runs of the tasks went.
    pub history: History,
}

impl Libraries {
    /// Corrections and the history lie in the folder of the tasks.
    pub fn new(folder: &Path) -> Self {
        Self {
            tasks: Library::new(folder.to_owned()),
            // No name of a task: those have no full stop.
            corrections: Library::new(folder.join(".corrections")),
            history: History::new(folder.join("runs.jsonl")),
        }
    }

    /// All tasks, newest first, and how their runs went. Reads files.
    pub fn tasks(&self) -> Vec<Entry> {
        let mut entries = self.tasks.list();
        let mut counts = self.history.counts();
        for entry in &mut entries {
            entry.runs = counts.remove(&entry.name).unwrap_or_default();
        }
        entries
    }

    /// The library with the demonstration of this name; that of the tasks where neither has it.
    pub fn holding(&self, name: &str) -> &Library {
        match self.tasks.has(name) || !self.corrections.has(name) {
            true => &self.tasks,
            false => &self.corrections,
        }
    }
}

/// The demonstrations of a folder.
#[derive(Debug)]
pub struct Library {
    folder: PathBuf,
    /// What was read, and when the folder had been changed then.
    known: Mutex<BTreeMap<String, (SystemTime, Option<Entry>)>>,
}

impl Library {
    /// The folder need not be there yet.
    pub fn new(folder: PathBuf) -> Self {
        Self {
            folder,
            known: Mutex::default(),
        }
    }

    /// Where a demonstration is, or would be.
    ///
    /// # Errors
    /// When the name cannot be that of a demonstration.
    pub fn path(&self, name: &str) -> Result<PathBuf, Refusal> {
        check_folder_name(name)?;
        std::path::absolute(self.folder.join(name)).map_err(|error| {
            Refusal::new(
                format!("{}: {error}.", self.folder.display()),
                "Look at the parameter library.",
            )
        })
    }

    fn has(&self, name: &str) -> bool {
        self.path(name).is_ok_and(|path| path.is_dir())
    }

    /// All demonstrations, newest first. Entries of the folder that are no demonstrations are skipped. Reads files.
    pub fn list(&self) -> Vec<Entry> {
        let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        let Ok(folders) = std::fs::read_dir(&self.folder) else {
            return Vec::new();
        };
        let mut entries = Vec::new();
        for folder in folders.flatten().take(MOST) {
            let name = folder.file_name().to_string_lossy().into_owned();
            let changed = folder.metadata().and_then(|metadata| metadata.modified());
            let (Ok(changed), Ok(())) = (changed, check_folder_name(&name)) else {
                continue;
            };
            let is_known = known.get(&name).is_some_and(|(at, _)| *at == changed);
            if !is_known {
                let entry = read_entry(&folder.path(), &name, changed);
                known.insert(name.clone(), (changed, entry));
            }
            entries.extend(known.get(&name).and_then(|(_, entry)| entry.clone()));
        }
        entries.sort_by(|a, b| (b.saved_at_s, &a.name).cmp(&(a.saved_at_s, &b.name)));
        entries
    }

    /// What was seen before the first step (0) or after a step (from 1). Reads files.
    ///
    /// # Errors
    /// When there is no such demonstration or step.
    pub fn picture(&self, name: &str, step: usize) -> Result<Heightmap, Refusal> {
        let demonstration = self.read(name)?;
        if step > demonstration.steps.len() {
            return Err(Refusal::new(
                format!("{name} has no step {step}."),
                "Ask for a step of the demonstration.",
            ));
        }
        Ok(demonstration.observation(step).clone())
    }

    fn read(&self, name: &str) -> Result<Demonstration, Refusal> {
        Demonstration::read(&self.path(name)?).map_err(|error| {
            Refusal::new(
                format!("The demonstration {name} cannot be read: {error}."),
                "Choose another one.",
            )
        })
    }

    /// Saves a demonstration under a name that is not taken. Writes files.
    ///
    /// # Errors
    /// When the name is taken or cannot be written.
    pub fn save(&self, name: &str, demonstration: &Demonstration) -> Result<(), Refusal> {
        let path = self.path(name)?;
        let failed = |error: String| {
            Refusal::new(
                format!("The demonstration was not saved: {error}."),
                "Look at the parameter library and at the disk, then save again.",
            )
        };
        if path.exists() {
            return Err(Refusal::new(
                format!("There is a demonstration {name} already."),
                "Type another name.",
            ));
        }
        std::fs::create_dir_all(&self.folder)
            .map_err(|error| failed(format!("{}: {error}", self.folder.display())))?;
        demonstration
            .write(&path)
            .map_err(|error| failed(error.to_string()))
    }
}

/// Checks that a name can be that of a demonstration's folder.
///
/// # Errors
/// The name is empty, too long, or has characters other than those allowed.
pub fn check_folder_name(name: &str) -> Result<(), Refusal> {
    lesson::check_name_up_to(name, LONGEST_NAME)
}

fn read_entry(path: &Path, name: &str, changed: SystemTime) -> Option<Entry> {
    let demonstration = Demonstration::read(path).ok()?;
    let saved_at_s = changed
        .duration_since(UNIX_EPOCH)
        .unwrap_or_default()
        .as_secs();
    Some(Entry {
        name: name.to_owned(),
        step_count: demonstration.goals().len(),
        problem: demonstration.problem,
        saved_at_s,
        runs: Vec::new(),
    })
}
