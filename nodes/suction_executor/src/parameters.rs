//! Parameters; `config/suction_executor.yaml` explains each.

use std::path::PathBuf;

use node_kit::{Parameters, Range};
use pick_place::PrimitiveSettings;
use serde::{Deserialize, Serialize};
use step_protocol::RequireApproval;
use ur_driver::DriverParameters;

/// Parameters of the node.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SuctionExecutorParameters {
    /// Which motions need an operator's approval.
    pub require_approval: Approval,
    /// With `unsure`: proposals of at least this probability of success move unasked.
    pub sure_probability: f64,
    /// Whether nothing moves while no operator is present.
    pub require_presence: bool,
    /// File that remembers a stop or fault over a restart; empty for none.
    pub stop_file: PathBuf,
    /// Wall seconds after which an operator who has shown no sign is not present.
    pub presence_timeout_s: f64,
    /// Frame of proposals.
    pub world_frame: String,
    /// URDF of the work cell; empty for the one that was compiled in.
    pub urdf: PathBuf,
    /// Largest heights and speeds of a proposal.
    pub limits: Limits,
    /// A cell of the heightmap has changed when its height differs by more.
    pub observation_tolerance_m: f64,
    /// The observation has changed where so many mm^2 of connected cells have.
    pub observation_changed_area_mm2: f64,
    /// Seconds of ROS time; an approval needs a heightmap that is not older.
    pub observation_max_age_s: f64,
    /// Whether heightmaps count only where the arm was at home and at rest when they were taken.
    pub observation_needs_home: bool,
    /// Distance that the way home keeps from the cell and from what was seen (m).
    pub collision_margin_m: f64,
    /// Wall seconds that a confirmation waits for its proposal and heightmap.
    pub confirmation_grace_s: f64,
    /// How the tip comes down.
    pub contact: Contact,
    /// The driver and its wiring.
    pub driver: DriverParameters,
}

/// Which motions need an operator's approval.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Approval {
    /// Every one.
    #[default]
    Always,
    /// Those of proposals that are not sure to succeed.
    Unsure,
    /// None, until a stop or a fault.
    Never,
}

/// Largest heights and speeds that a proposal may ask for.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
#[allow(missing_docs)]
pub struct Limits {
    pub clearance_m: f64,
    pub lift_m: f64,
    pub travel_m_s: f64,
    pub carry_m_s: f64,
    pub descend_m_s: f64,
    pub acceleration_m_s2: f64,
}

/// How the tip comes down on surfaces that were seen.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Contact {
    /// So far above the surface the tip slows down (m); 0: descents are fast to their end.
    pub slow_from_m: f64,
    /// Speed of the tip from there on (m/s).
    pub slow_m_s: f64,
    /// Contact higher than expected by more is a fault, and a descent ends so far below the surface (m).
    pub window_m: f64,
    /// The cup is pressed on by so much after contact (m).
    pub press_m: f64,
}

impl Default for Contact {
    fn default() -> Self {
        Self {
            slow_from_m: 0.0,
            slow_m_s: 0.05,
            window_m: 0.015,
            press_m: 0.0,
        }
    }
}

impl Default for SuctionExecutorParameters {
    fn default() -> Self {
        Self {
            require_approval: Approval::Always,
            sure_probability: 0.99,
            require_presence: false,
            stop_file: PathBuf::new(),
            presence_timeout_s: 1.0,
            world_frame: "world".into(),
            urdf: PathBuf::new(),
            limits: Limits::default(),
            observation_tolerance_m: 0.005,
            observation_changed_area_mm2: 75.0,
            observation_max_age_s: 5.0,
            observation_needs_home: false,
            collision_margin_m: 0.01,
            confirmation_grace_s: 0.5,
            contact: Contact::default(),
            driver: DriverParameters::default(),
        }
    }
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            clearance_m: 0.5,
            lift_m: 0.5,
            travel_m_s: 1.5,
            carry_m_s: 1.5,
            descend_m_s: 0.5,
            acceleration_m_s2: 10.0,
        }
    }
}

impl Limits {
    pub(crate) fn settings(&self) -> PrimitiveSettings {
        PrimitiveSettings {
            clearance_m: self.clearance_m,
            lift_m: self.lift_m,
            travel_m_s: self.travel_m_s,
            carry_m_s: self.carry_m_s,
            descend_m_s: self.descend_m_s,
            acceleration_m_s2: self.acceleration_m_s2,
        }
    }
}

/// Times of the wall clock, in s.
const TIME: Range = Range::Float(0.001, 3600.0);
/// Pins of the control box and the tool.
const PIN: Range = Range::Integer(0, 17);

impl SuctionExecutorParameters {
    pub(crate) fn require_approval(&self) -> RequireApproval {
        match self.require_approval {
            Approval::Always => RequireApproval::Always,
            Approval::Unsure => RequireApproval::Unsure {
                threshold: self.sure_probability as f32,
            },
            Approval::Never => RequireApproval::Never,
        }
    }
}

impl Parameters for SuctionExecutorParameters {
    const DOCUMENTATION: &'static str = include_str!("../../../config/suction_executor.yaml");
    const RANGES: &'static [(&'static str, Range)] = &[
        ("limits.clearance_m", Range::POSITIVE),
        ("limits.lift_m", Range::POSITIVE),
        ("limits.travel_m_s", Range::POSITIVE),
        ("limits.carry_m_s", Range::POSITIVE),
        ("limits.descend_m_s", Range::POSITIVE),
        ("limits.acceleration_m_s2", Range::POSITIVE),
        ("observation_tolerance_m", Range::POSITIVE),
        ("observation_changed_area_mm2", Range::POSITIVE),
        ("collision_margin_m", Range::Float(0.0, 0.2)),
        ("sure_probability", Range::SHARE),
        ("presence_timeout_s", Range::POSITIVE),
        ("observation_max_age_s", TIME),
        ("confirmation_grace_s", TIME),
        ("contact.slow_from_m", Range::Float(0.0, 0.2)),
        ("contact.slow_m_s", Range::Float(0.005, 0.5)),
        ("contact.window_m", Range::Float(0.001, 0.1)),
        ("contact.press_m", Range::Float(0.0, 0.01)),
        ("driver.suction_pin", PIN),
        ("driver.vacuum_pin", PIN),
        ("driver.status_max_age_s", TIME),
        ("driver.reading_timeout_s", TIME),
        ("driver.rest_speed_rad_s", Range::POSITIVE),
        ("driver.rest_time_s", TIME),
        ("driver.path_tolerance_rad", Range::POSITIVE),
        ("driver.goal_tolerance_rad", Range::POSITIVE),
        ("driver.motion_time_factor", Range::POSITIVE),
        ("driver.motion_time_margin_s", TIME),
        ("driver.grasp_wait_s", Range::Float(0.0, 60.0)),
        ("driver.release_wait_s", Range::Float(0.0, 60.0)),
        ("driver.blow_off_pin", Range::Integer(-1, 17)),
        ("driver.answer_timeout_s", TIME),
        ("driver.stop_timeout_s", TIME),
        ("driver.call_timeout_s", TIME),
        ("driver.call_attempts", Range::Integer(1, 100)),
    ];
    // What protects people is not for the network to change, whether or not the node is configured.
    const FIXED: &'static [&'static str] = &["require_approval", "require_presence", "stop_file"];
    const CHANGEABLE: &'static [&'static str] = &[
        "limits.clearance_m",
        "limits.lift_m",
        "limits.travel_m_s",
        "limits.carry_m_s",
        "limits.descend_m_s",
        "limits.acceleration_m_s2",
        "observation_tolerance_m",
        "observation_changed_area_mm2",
        "confirmation_grace_s",
    ];
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_configuration_file_explains_every_parameter_and_shows_its_default() {
        let mistakes =
            node_kit::mistakes_in_documentation::<SuctionExecutorParameters>("suction_executor");
        assert_eq!(mistakes, [""; 0]);
    }

    #[test]
    fn approval_is_required_unless_switched_off() {
        let parameters = SuctionExecutorParameters::default();
        assert_eq!(parameters.require_approval(), RequireApproval::Always);
    }

    #[test]
    fn values_out_of_range_are_refused_by_name() {
        for (line, name) in [
            ("limits: {carry_m_s: 0.0}", "limits.carry_m_s"),
            (
                "observation_changed_area_mm2: -1.0",
                "observation_changed_area_mm2",
            ),
            ("driver: {vacuum_pin: 40}", "driver.vacuum_pin"),
            (
                "driver: {status_max_age_s: .inf}",
                "driver.status_max_age_s",
            ),
            ("driver: {call_attempts: 0}", "driver.call_attempts"),
            ("requires_approval: false", "requires_approval"),
        ] {
            let text = format!("/**:\n  ros__parameters:\n    {line}\n");
            let error = node_kit::load_text::<SuctionExecutorParameters>(
                "f.yaml",
                &text,
                "/suction_executor",
            )
            .unwrap_err()
            .to_string();
            assert!(error.contains(name) && error.contains("f.yaml"), "{error}");
        }
    }
}
