//! How the tip comes down on surfaces that were seen.

use serde::{Deserialize, Serialize};

use crate::SettingsError;

/// What tells that the tool touches something.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ContactSign {
    /// The driver's action `trajectory_until_node`: e-Series only.
    #[default]
    UntilAction,
    /// The vacuum sensor, suction being on while the tip comes down.
    Vacuum,
    /// Nothing: the end of the way down is taken for the contact.
    Height,
}

/// How the tip comes down on surfaces that were seen.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ContactSettings {
    /// So far above the surface the tip slows down (m); 0: descents are fast to their end.
    pub slow_from_m: f64,
    /// Speed of the tip from there on (m/s).
    pub slow_m_s: f64,
    /// Contact higher than expected by more is a fault, and a descent ends so far below the surface (m). What is held is never let go there
    /// without contact, where that is sensed.
    pub window_m: f64,
    /// The cup is pressed on by so much after contact (m).
    pub press_m: f64,
}

impl Default for ContactSettings {
    fn default() -> Self {
        Self {
            slow_from_m: 0.0,
            slow_m_s: 0.05,
            window_m: 0.015,
            press_m: 0.0,
        }
    }
}

/// Heights of the surfaces under pick and place, and how the tip comes down on them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Touchdown {
    /// Height of the object's top at the pick pose (m).
    pub pick_m: f64,
    /// Height of what is lowest beside the object (m): how high the object is, at most, follows from it.
    pub pick_ground_m: f64,
    /// Height of what is highest at the place pose (m).
    pub place_m: f64,
    /// So far above the expected contact the tip slows down (m).
    pub slow_from_m: f64,
    /// Speed of the tip from there on (m/s).
    pub slow_m_s: f64,
    /// Contact higher than expected by more is a fault; a descent ends so far below the surface (m).
    pub window_m: f64,
    /// The cup is pressed on the object by so much after contact (m).
    pub press_m: f64,
    /// Whether the robot senses contact of the empty tool. Where it does not, the expected height is taken for it.
    pub senses_pick: bool,
    /// The same for contact of an object that it holds.
    pub senses_place: bool,
}

impl Touchdown {
    /// Checks every range.
    ///
    /// # Errors
    /// The first value outside its range, not-a-number included.
    pub fn check(&self) -> Result<(), SettingsError> {
        for (name, value, low, high) in [
            ("pick_m", self.pick_m, -0.1, 1.0),
            ("pick_ground_m", self.pick_ground_m, -0.1, 1.0),
            ("place_m", self.place_m, -0.1, 1.0),
            ("slow_from_m", self.slow_from_m, 0.0, 0.2),
            ("slow_m_s", self.slow_m_s, 0.005, 0.5),
            ("window_m", self.window_m, 0.001, 0.1),
            ("press_m", self.press_m, 0.0, 0.01),
        ] {
            if !(low..=high).contains(&value) {
                return Err(SettingsError {
                    name,
                    value,
                    low,
                    high,
                });
            }
        }
        Ok(())
    }
}
