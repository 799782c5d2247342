//! Vacuum that takes its time.

use std::time::Duration;

use crate::HardwareSettings;

/// The valve, the cup and the sensor of the suction tool.
///
/// The caller says what the valve was told and whether the cup is closed by an object; this says what the sensor shows and
/// whether the object still hangs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Vacuum {
    /// Since when the cup is closed with suction on.
    closed_since: Option<Duration>,
    /// Since when suction is off with an object still at the cup.
    off_since: Option<Duration>,
    senses: bool,
}

impl Vacuum {
    /// Brings the vacuum to a time. `suction`: whether the valve is open and has power; `closed`: whether an object is at the cup.
    /// Returns whether the object stays at the cup.
    pub fn update(
        &mut self,
        settings: &HardwareSettings,
        now: Duration,
        suction: bool,
        closed: bool,
    ) -> bool {
        let after = |since: &mut Option<Duration>, limit_s: f64| {
            let since = *since.get_or_insert(now);
            now.saturating_sub(since) >= Duration::from_secs_f64(limit_s)
        };
        if !closed {
            *self = Self::default();
            return false;
        }
        if suction {
            self.off_since = None;
            self.senses = after(&mut self.closed_since, settings.vacuum_build_s);
            let leak_s = settings.vacuum_leak_s;
            let lost = leak_s > 0.0 && after(&mut self.closed_since, leak_s);
            if lost {
                *self = Self::default();
            }
            return !lost;
        }
        self.closed_since = None;
        let released = after(&mut self.off_since, settings.vacuum_release_s);
        if released {
            *self = Self::default();
        }
        !released
    }

    /// Whether the sensor says that something is held.
    pub fn senses(&self) -> bool {
        self.senses
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    #[test]
    fn an_ideal_vacuum_is_there_and_gone_at_once() {
        let settings = HardwareSettings::default();
        let mut vacuum = Vacuum::default();
        assert!(vacuum.update(&settings, ms(0), true, true) && vacuum.senses());
        assert!(!vacuum.update(&settings, ms(0), false, true) && !vacuum.senses());
        assert!(!vacuum.update(&settings, ms(0), true, false) && !vacuum.senses());
    }

    #[test]
    fn vacuum_builds_up_leaks_and_outlasts_the_valve() {
        let settings = HardwareSettings {
            vacuum_build_s: 0.2,
            vacuum_release_s: 0.15,
            vacuum_leak_s: 5.0,
            ..HardwareSettings::default()
        };
        let mut vacuum = Vacuum::default();
        let mut at = |time, suction, closed| {
            let stays = vacuum.update(&settings, ms(time), suction, closed);
            (stays, vacuum.senses())
        };
        assert_eq!(at(0, true, false), (false, false));
        assert_eq!(at(1000, true, true), (true, false));
        assert_eq!(at(1199, true, true), (true, false));
        assert_eq!(at(1200, true, true), (true, true));
        assert_eq!(at(2000, false, true), (true, true));
        assert_eq!(at(2149, false, true), (true, true));
        assert_eq!(at(2150, false, true), (false, false));
        assert_eq!(at(3000, true, true), (true, false));
        assert_eq!(at(7999, true, true), (true, true));
        assert_eq!(at(8000, true, true), (false, false));
    }
}
