//! Vacuum that takes its time.

use std::time::Duration;

use crate::HardwareSettings;

/// What the valves of the tool were told, where they have power.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Valves {
    /// Air is sucked.
    pub suction: bool,
    /// Air is blown: without suction the cup lets go at once.
    pub blow_off: bool,
}

/// The valves, the cup and the sensor of the suction tool.
///
/// The caller says what the valves were told and whether the cup is closed by an object; this says what the sensor shows and
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
    /// Brings the vacuum to a time. `closed`: whether an object is at the cup. Returns whether the object stays at the cup.
    pub fn update(
        &mut self,
        settings: &HardwareSettings,
        now: Duration,
        valves: Valves,
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
        if valves.suction {
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
        let released = after(&mut self.off_since, settings.vacuum_release_s) || valves.blow_off;
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

    const SUCKS: Valves = Valves {
        suction: true,
        blow_off: false,
    };
    const BLOWS: Valves = Valves {
        suction: false,
        blow_off: true,
    };
    const OFF: Valves = Valves {
        suction: false,
        blow_off: false,
    };

    #[test]
    fn an_ideal_vacuum_is_there_and_gone_at_once() {
        let settings = HardwareSettings::default();
        let mut vacuum = Vacuum::default();
        assert!(vacuum.update(&settings, ms(0), SUCKS, true) && vacuum.senses());
        assert!(!vacuum.update(&settings, ms(0), OFF, true) && !vacuum.senses());
        assert!(!vacuum.update(&settings, ms(0), SUCKS, false) && !vacuum.senses());
    }

    #[test]
    fn what_sticks_is_blown_off_once_suction_is_off() {
        let settings = HardwareSettings {
            vacuum_release_s: 60.0,
            ..HardwareSettings::default()
        };
        let mut vacuum = Vacuum::default();
        let both = Valves {
            suction: true,
            blow_off: true,
        };
        assert!(vacuum.update(&settings, ms(0), both, true) && vacuum.senses());
        assert!(vacuum.update(&settings, ms(10_000), OFF, true) && vacuum.senses());
        assert!(!vacuum.update(&settings, ms(10_000), BLOWS, true) && !vacuum.senses());
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
            let valves = if suction { SUCKS } else { OFF };
            let stays = vacuum.update(&settings, ms(time), valves, closed);
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
