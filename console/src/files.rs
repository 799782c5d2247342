//! What the page reads from disk and writes to it on behalf of the graph. All of it blocks.

use std::path::Path;

use bags::Demonstration;
use tracing::{info, warn};

use crate::history::RunEvent;
use crate::server::Page;
use crate::state::{Answer, PolicyState};

impl Page {
    /// Shows the demonstration that the goal oracle begins with, where its path is not empty, and takes up the run that was under way.
    pub fn begin(&self, demonstration: &Path) {
        if demonstration != Path::new("") {
            self.show_demonstration(demonstration);
        }
        self.resume_run();
    }

    /// Takes up the run that was under way when the console ended.
    fn resume_run(&self) {
        if let Some(run) = self.libraries.history.open_run() {
            self.console.change(|state, _| state.resume_run(run));
        }
    }

    /// Shows the images of a demonstration before they are latched. Returns its name in the goals; nothing where it cannot be read.
    pub fn show_demonstration(&self, path: &Path) -> Option<String> {
        match Demonstration::read(path) {
            Ok(demonstration) => {
                let name = demonstration.name();
                let images = demonstration.goals().into_iter().cloned().collect();
                let shown = name.clone();
                self.console
                    .change(|state, now| state.run.on_demonstration(shown, images, now));
                Some(name)
            }
            Err(error) => {
                warn!("demonstration {}: {error}", path.display());
                None
            }
        }
    }

    /// The policy has answered whether it uses the checkpoint at `path` from now on: what is trained begins with it.
    pub fn on_checkpoint_answer(&self, path: &Path, answer: Answer<PolicyState>) {
        if let Ok(policy) = &answer {
            self.trainings.begin_with(&policy.checkpoint);
        }
        self.console
            .change(|state, now| state.on_checkpoint_answer(path, answer, now));
    }

    /// Writes down how a run goes.
    pub fn record(&self, event: RunEvent) {
        let added = self.libraries.history.add(event);
        self.written("how a run went", added.map_err(|error| error.to_string()));
    }

    /// Keeps a correction that the operator has confirmed.
    pub fn keep(&self, name: &str, correction: &Demonstration) {
        info!("correction {name}");
        let saved = self.libraries.corrections.save(name, correction);
        self.written("a correction", saved.map_err(|refusal| refusal.reason));
    }

    fn written(&self, what: &str, written: Result<(), String>) {
        if let Err(error) = &written {
            warn!("{what} was not kept: {error}");
        }
        self.console
            .change(|state, now| state.on_written(what, written, now));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::server::tests::page;
    use crate::state::tests::{demonstration, proposed};

    fn notices(page: &Page) -> Vec<String> {
        let json = page.console.snapshot(None).unwrap();
        let json: serde_json::Value = serde_json::from_str(&json).unwrap();
        let notices = json["notices"].as_array().unwrap().iter();
        notices.map(|notice| notice["reason"].to_string()).collect()
    }

    #[test]
    fn what_cannot_be_kept_is_said_with_its_reason() {
        let folder = tempfile::tempdir().unwrap();
        // Where the library should be.
        std::fs::write(folder.path().join("library"), "").unwrap();
        let page = page(proposed().0, folder.path());
        page.record(RunEvent::Completed { run: 7 });
        page.keep("stacking-1-7", &demonstration("stacking"));
        let said = notices(&page);
        assert_eq!(said.len(), 2, "{said:?}");
        assert!(said[0].contains("how a run went") && said[1].contains("a correction"));
    }

    #[test]
    fn a_correction_is_kept_and_can_be_shown_and_what_cannot_be_read_is_not() {
        let folder = tempfile::tempdir().unwrap();
        let page = page(proposed().0, folder.path());
        assert_eq!(page.show_demonstration(&folder.path().join("none")), None);
        page.keep("stacking-1-7", &demonstration("stacking"));
        assert!(notices(&page).is_empty());
        let kept = folder.path().join("library/.corrections/stacking-1-7");
        let name = page.show_demonstration(&kept).unwrap();
        assert!(name.starts_with("stacking"), "{name}");
    }
}
