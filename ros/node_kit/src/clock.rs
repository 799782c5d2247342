//! ROS time: the system's, or the simulator's from `/clock`.

use std::{
    sync::{
        Arc,
        atomic::{AtomicI64, Ordering::Relaxed},
    },
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use msgs::builtin_interfaces;

const NANOSECONDS: i64 = 1_000_000_000;

/// The time as a node sees it.
#[derive(Clone, Debug)]
pub struct Clock {
    /// Simulated nanoseconds where `use_sim_time` is set.
    simulated_ns: Option<Arc<AtomicI64>>,
}

impl Clock {
    pub(crate) fn new(use_sim_time: bool) -> Self {
        Self {
            simulated_ns: use_sim_time.then(Arc::default),
        }
    }

    /// Whether time comes from `/clock`.
    pub fn is_simulated(&self) -> bool {
        self.simulated_ns.is_some()
    }

    /// Nanoseconds since the epoch; 0 in simulated time before the first `/clock`.
    pub fn now_ns(&self) -> i64 {
        match &self.simulated_ns {
            Some(simulated) => simulated.load(Relaxed),
            None => SystemTime::now()
                .duration_since(UNIX_EPOCH)
                .map_or(0, |since| since.as_nanos() as i64),
        }
    }

    /// Time since the epoch; zero before it, and in simulated time before the first `/clock`.
    pub fn time(&self) -> Duration {
        Duration::from_nanos(self.now_ns().max(0) as u64)
    }

    /// The time as a message stamp.
    pub fn now(&self) -> builtin_interfaces::Time {
        stamp_from_ns(self.now_ns())
    }

    pub(crate) fn ros_time(&self) -> ros2_client::builtin_interfaces::Time {
        ros2_client::builtin_interfaces::Time::from_nanos(self.now_ns())
    }

    pub(crate) fn set(&self, time: &builtin_interfaces::Time) {
        if let Some(simulated) = &self.simulated_ns {
            simulated.store(ns_from_stamp(time), Relaxed);
        }
    }
}

/// Nanoseconds since the epoch of a message stamp.
pub fn ns_from_stamp(stamp: &builtin_interfaces::Time) -> i64 {
    i64::from(stamp.sec) * NANOSECONDS + i64::from(stamp.nanosec)
}

/// A message stamp of nanoseconds since the epoch; saturates in 2038, as the message does.
pub fn stamp_from_ns(nanoseconds: i64) -> builtin_interfaces::Time {
    let seconds = nanoseconds.div_euclid(NANOSECONDS);
    builtin_interfaces::Time {
        sec: seconds.clamp(i32::MIN.into(), i32::MAX.into()) as i32,
        nanosec: nanoseconds.rem_euclid(NANOSECONDS) as u32,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn stamps_round_trip(ns in i64::from(i32::MIN) * NANOSECONDS..=i64::from(i32::MAX) * NANOSECONDS) {
            let stamp = stamp_from_ns(ns);
            prop_assert!(stamp.nanosec < 1_000_000_000);
            prop_assert_eq!(ns_from_stamp(&stamp), ns);
        }
    }

    #[test]
    fn simulated_time_stands_still_between_clock_messages() {
        let clock = Clock::new(true);
        assert_eq!(clock.now_ns(), 0);
        clock.set(&stamp_from_ns(1_500_000_000));
        assert_eq!(clock.now_ns(), 1_500_000_000);
        assert_eq!(clock.now_ns(), 1_500_000_000);
    }
}
