//! Whether the arm is out of the cameras' view.

use std::time::Duration;

use crate::Joints;

/// Since when the arm has been at home and at rest, by the stamps of its joint readings. Only a heightmap of that time is sure not to show
/// the arm.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct AtHome {
    since: Option<Duration>,
}

impl AtHome {
    /// The arm is at home when no joint is further from there (rad).
    pub const TOLERANCE_RAD: f64 = 1e-2;
    /// The arm is at rest when no joint is faster (rad/s).
    pub const REST_RAD_S: f64 = 1e-2;

    /// Takes the next reading: its stamp, positions (rad) and velocities (rad/s); `home`: the joints at home (rad).
    pub fn read(
        &mut self,
        stamp: Duration,
        positions: &Joints,
        velocities: &Joints,
        home: &Joints,
    ) {
        let is_home = (positions - home).amax() <= Self::TOLERANCE_RAD
            && velocities.amax() <= Self::REST_RAD_S;
        self.since = is_home.then(|| self.since.unwrap_or(stamp));
    }

    /// Whether the arm may be seen in a heightmap of that stamp.
    pub fn may_be_in_view(&self, stamp: Duration) -> bool {
        self.since.is_none_or(|since| stamp < since)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_time_since_the_arm_came_to_rest_at_home_is_sure() {
        let second = Duration::from_secs;
        let home = Joints::repeat(0.5);
        let mut at_home = AtHome::default();
        assert!(at_home.may_be_in_view(second(9)));
        let mut read = |stamp, offset_rad, speed_rad_s| {
            let positions = home.add_scalar(offset_rad);
            at_home.read(
                second(stamp),
                &positions,
                &Joints::repeat(speed_rad_s),
                &home,
            );
            at_home
        };
        // Elsewhere at rest, on its way through home, and there.
        assert!(read(1, 0.1, 0.0).may_be_in_view(second(9)));
        assert!(read(2, 0.001, 0.5).may_be_in_view(second(9)));
        assert!(!read(3, 0.001, 0.0).may_be_in_view(second(3)));
        assert!(read(4, -0.001, 0.0).may_be_in_view(second(2)));
        assert!(!read(5, 0.0, 0.0).may_be_in_view(second(4)));
        // Away again.
        assert!(read(6, -0.1, 0.0).may_be_in_view(second(5)));
    }
}
