//! What a process that is started again has to know of the one before: a stop or a fault, or a motion in whose middle that ended.

/// What has stopped the executor and what it moves. Its text is kept outside the process.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct StopRecord {
    /// What has stopped the executor, until the next approval.
    stopped: Option<String>,
    /// The motion under way.
    motion: Option<String>,
}

impl StopRecord {
    /// `stopped`: what the process before has left.
    pub fn new(stopped: Option<String>) -> Self {
        Self {
            stopped,
            motion: None,
        }
    }

    /// A stop or a fault has come.
    pub fn stop(&mut self, reason: impl Into<String>) {
        self.stopped = Some(reason.into());
    }

    /// A motion begins. `lets_go_on`: it was approved, and what has stopped the executor before is over.
    pub fn begin(&mut self, motion: impl Into<String>, lets_go_on: bool) {
        if lets_go_on {
            self.stopped = None;
        }
        self.motion = Some(motion.into());
    }

    /// The motion has ended.
    pub fn end(&mut self) {
        self.motion = None;
    }

    /// What the next process has to know; nothing where it may go on. Where the process ends in the middle of a motion, that is a stop too.
    pub fn text(&self) -> Option<String> {
        let motion = self.motion.as_ref();
        let motion = motion.map(|motion| format!("the process ended in the middle of {motion}"));
        self.stopped.clone().or(motion)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STOP: &str = "stop of proposal 7";

    #[test]
    fn a_stop_is_recorded_until_a_motion_is_approved() {
        let mut record = StopRecord::new(None);
        assert_eq!(record.text(), None);
        record.stop(STOP);
        record.end();
        assert_eq!(record.text().as_deref(), Some(STOP));
        // Another process.
        let mut record = StopRecord::new(record.text());
        assert_eq!(record.text().as_deref(), Some(STOP));
        // The way home lets nothing go on.
        record.begin("the way home", false);
        assert_eq!(record.text().as_deref(), Some(STOP));
        record.end();
        assert_eq!(record.text().as_deref(), Some(STOP));
        record.begin("the motion of proposal 7", true);
        record.end();
        assert_eq!(record.text(), None);
    }

    #[test]
    fn a_process_that_ends_in_the_middle_of_a_motion_was_stopped() {
        for motion in ["the motion of proposal 7", "the way home"] {
            let mut record = StopRecord::default();
            record.begin(motion, motion != "the way home");
            assert!(record.text().is_some_and(|text| text.ends_with(motion)));
            record.end();
            assert_eq!(record.text(), None);
        }
        let mut record = StopRecord::default();
        record.begin("the motion of proposal 8", true);
        record.stop("proposal 8: PROTECTIVE_STOP");
        record.end();
        let text = record.text();
        assert!(text.is_some_and(|text| text.contains("PROTECTIVE_STOP")));
    }
}
