//! What is wrong with the driver and its robot.

use driver_model::Fault;

/// A fault as it was set last, and whether the driver's process has ended by itself.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Health {
    fault: Fault,
    ended: bool,
}

/// What has come of setting a fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FaultChange {
    /// It was set already.
    Same,
    /// Another one than before.
    Changed,
    /// A dead driver was started again: it knows nothing of what was.
    Restarted,
}

impl Health {
    pub(crate) fn fault(self) -> Fault {
        self.fault
    }

    pub(crate) fn is_dead(self) -> bool {
        self.ended || self.fault == Fault::DriverDead
    }

    /// Nothing brings it back.
    pub(crate) fn end(&mut self) {
        self.ended = true;
    }

    pub(crate) fn set_fault(&mut self, fault: Fault) -> FaultChange {
        let was_dead = self.is_dead();
        if std::mem::replace(&mut self.fault, fault) == fault {
            return FaultChange::Same;
        }
        match was_dead && !self.is_dead() {
            true => FaultChange::Restarted,
            false => FaultChange::Changed,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_driver_whose_fault_is_taken_away_is_started_again_and_one_that_has_ended_is_not() {
        let mut health = Health::default();
        assert_eq!(health.set_fault(Fault::None), FaultChange::Same);
        assert_eq!(
            health.set_fault(Fault::ProtectiveStop),
            FaultChange::Changed
        );
        assert!(!health.is_dead());
        assert_eq!(health.set_fault(Fault::DriverDead), FaultChange::Changed);
        assert!(health.is_dead());
        assert_eq!(health.set_fault(Fault::None), FaultChange::Restarted);
        health.set_fault(Fault::DriverDead);
        health.end();
        assert_eq!(health.set_fault(Fault::None), FaultChange::Changed);
        assert!(health.is_dead());
    }
}
