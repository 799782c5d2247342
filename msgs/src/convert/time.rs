//! Stamps and durations. Library time is the `Duration` since the clock's zero.

use super::ConvertError;
use super::error::unexpected;
use crate::builtin_interfaces;
use std::time::Duration;

const NANOS: u32 = 1_000_000_000;

fn from_parts(field: &'static str, sec: i32, nanosec: u32) -> Result<Duration, ConvertError> {
    let secs =
        u64::try_from(sec).map_err(|_| unexpected(field, format!("{sec} s"), "0 s or more"))?;
    if nanosec >= NANOS {
        return Err(unexpected(
            field,
            format!("{nanosec} ns"),
            "less than 1000000000 ns",
        ));
    }
    Ok(Duration::new(secs, nanosec))
}

fn seconds(field: &'static str, duration: Duration) -> Result<i32, ConvertError> {
    let secs = duration.as_secs();
    i32::try_from(secs).map_err(|_| unexpected(field, format!("{secs} s"), "at most 2147483647 s"))
}

/// A stamp as time since the clock's zero; negative ones and nanoseconds of a second or more are refused.
pub fn time_from_msg(stamp: &builtin_interfaces::Time) -> Result<Duration, ConvertError> {
    from_parts("stamp", stamp.sec, stamp.nanosec)
}

/// Time since the clock's zero as a stamp; refuses what 32-bit seconds cannot hold.
pub fn time_to_msg(time: Duration) -> Result<builtin_interfaces::Time, ConvertError> {
    Ok(builtin_interfaces::Time {
        sec: seconds("stamp", time)?,
        nanosec: time.subsec_nanos(),
    })
}

/// A duration; negative ones and nanoseconds of a second or more are refused.
pub fn duration_from_msg(
    duration: &builtin_interfaces::Duration,
) -> Result<Duration, ConvertError> {
    from_parts("duration", duration.sec, duration.nanosec)
}

/// A duration; refuses what 32-bit seconds cannot hold.
pub fn duration_to_msg(duration: Duration) -> Result<builtin_interfaces::Duration, ConvertError> {
    Ok(builtin_interfaces::Duration {
        sec: seconds("duration", duration)?,
        nanosec: duration.subsec_nanos(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn stamps_and_durations_pass_unchanged(sec in 0u64..1 << 31, nanosec in 0u32..NANOS) {
            let time = Duration::new(sec, nanosec);
            prop_assert_eq!(time_from_msg(&time_to_msg(time).unwrap()).unwrap(), time);
            prop_assert_eq!(duration_from_msg(&duration_to_msg(time).unwrap()).unwrap(), time);
        }
    }

    #[test]
    fn impossible_stamps_are_refused() {
        let negative = time_from_msg(&builtin_interfaces::Time {
            sec: -1,
            nanosec: 0,
        })
        .unwrap_err();
        assert_eq!(negative.to_string(), "stamp is -1 s, expected 0 s or more");
        assert!(
            time_from_msg(&builtin_interfaces::Time {
                sec: 0,
                nanosec: NANOS
            })
            .is_err()
        );
        assert!(time_to_msg(Duration::from_secs(1 << 31)).is_err());
    }
}
