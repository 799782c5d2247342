//! Heights and speeds of the primitive.

use serde::{Deserialize, Serialize};

/// Heights and speeds of the primitive; they change with the task module (Ravens).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PrimitiveSettings {
    /// Height of approach and retreat over the table.
    pub clearance_m: f64,
    /// Height over the contact at which a held object travels.
    pub lift_m: f64,
    /// Tip speed in free motion.
    pub travel_m_s: f64,
    /// Tip speed while it holds something.
    pub carry_m_s: f64,
    /// Tip speed while it descends to contact.
    pub descend_m_s: f64,
    /// Tip acceleration.
    pub acceleration_m_s2: f64,
}

/// A setting outside its range.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{name} is {value}, expected {low} to {high}")]
pub struct SettingsError {
    /// Name of the setting.
    pub name: &'static str,
    /// What it was.
    pub value: f64,
    /// Smallest allowed.
    pub low: f64,
    /// Largest allowed.
    pub high: f64,
}

impl PrimitiveSettings {
    /// For rigid objects: high and fast.
    pub const RIGID: Self = Self {
        clearance_m: 0.24,
        lift_m: 0.2,
        travel_m_s: 1.5,
        carry_m_s: 0.8,
        descend_m_s: 0.35,
        acceleration_m_s2: 4.0,
    };

    /// For chains of beads: low and slow, or joints open and beads jump over pegs.
    pub const BEADS: Self = Self {
        clearance_m: 0.16,
        lift_m: 0.06,
        travel_m_s: 0.8,
        carry_m_s: 0.15,
        descend_m_s: 0.15,
        acceleration_m_s2: 1.0,
    };

    /// Smallest and largest value of each setting, by its name.
    pub const RANGES: [(&'static str, f64, f64); 6] = [
        ("clearance_m", 0.05, 0.5),
        ("lift_m", 0.005, 0.5),
        ("travel_m_s", 0.01, 1.5),
        ("carry_m_s", 0.01, 1.5),
        ("descend_m_s", 0.005, 0.5),
        ("acceleration_m_s2", 0.1, 10.0),
    ];

    /// Checks every range.
    ///
    /// # Errors
    /// The first setting outside its range, not-a-number included.
    pub fn check(&self) -> Result<(), SettingsError> {
        let values = [
            self.clearance_m,
            self.lift_m,
            self.travel_m_s,
            self.carry_m_s,
            self.descend_m_s,
            self.acceleration_m_s2,
        ];
        for ((name, low, high), value) in Self::RANGES.into_iter().zip(values) {
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
