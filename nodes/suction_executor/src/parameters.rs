//! Parameters; `config/suction_executor.yaml` explains each.

use std::path::PathBuf;

use node_kit::{Parameters, Range};
use pick_place::PrimitiveSettings;
use serde::{Deserialize, Serialize};
use step_protocol::RequireApproval;

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
    /// Wall seconds that a confirmation waits for its proposal and heightmap.
    pub confirmation_grace_s: f64,
    /// The driver and its wiring.
    pub driver: Driver,
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

/// The driver and its wiring.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Driver {
    /// Action that follows a trajectory.
    pub follow_action: String,
    /// Action that follows a trajectory until the tool touches something.
    pub until_action: String,
    /// Namespace of `set_io`, `io_states`, `robot_mode`, `safety_mode`, `robot_program_running`.
    pub io_and_status: String,
    /// Digital output that switches suction.
    pub suction_pin: u8,
    /// Digital input of the vacuum sensor.
    pub vacuum_pin: u8,
    /// Wall seconds; nothing moves when joint or pin states are older.
    pub status_max_age_s: f64,
    /// Wall seconds to wait for a fresh state of the joints or pins.
    pub reading_timeout_s: f64,
    /// Joints slower than this stand still.
    pub rest_speed_rad_s: f64,
    /// Wall seconds that joints have to stand still to count as at rest; ten times that in simulated
    /// time that does not stand still with them.
    pub rest_time_s: f64,
    /// Largest deviation on the way that is asked of the controller.
    pub path_tolerance_rad: f64,
    /// Largest deviation at the end that is asked of the controller.
    pub goal_tolerance_rad: f64,
    /// A motion may take this many times its planned duration, ...
    pub motion_time_factor: f64,
    /// ... and this much more, in seconds of ROS time.
    pub motion_time_margin_s: f64,
    /// Wall seconds for each attempt of a call.
    pub call_timeout_s: f64,
    /// Attempts of each call.
    pub call_attempts: u32,
}

impl Default for SuctionExecutorParameters {
    fn default() -> Self {
        Self {
            require_approval: Approval::Always,
            sure_probability: 0.99,
            require_presence: false,
            presence_timeout_s: 1.0,
            world_frame: "world".into(),
            urdf: PathBuf::new(),
            limits: Limits::default(),
            observation_tolerance_m: 0.005,
            observation_changed_area_mm2: 75.0,
            confirmation_grace_s: 0.5,
            driver: Driver::default(),
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

impl Default for Driver {
    fn default() -> Self {
        Self {
            follow_action: "scaled_joint_trajectory_controller/follow_joint_trajectory".into(),
            until_action: "trajectory_until_node/execute".into(),
            io_and_status: "io_and_status_controller".into(),
            suction_pin: 16,
            vacuum_pin: 16,
            status_max_age_s: 2.0,
            reading_timeout_s: 5.0,
            rest_speed_rad_s: 1e-3,
            rest_time_s: 0.1,
            path_tolerance_rad: 0.05,
            goal_tolerance_rad: 0.01,
            motion_time_factor: 3.0,
            motion_time_margin_s: 15.0,
            call_timeout_s: 1.0,
            call_attempts: 5,
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
        ("sure_probability", Range::SHARE),
        ("presence_timeout_s", Range::POSITIVE),
        ("confirmation_grace_s", TIME),
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
        ("driver.call_timeout_s", TIME),
        ("driver.call_attempts", Range::Integer(1, 100)),
    ];
    // What needs an approval is not for the network to change while the arm may move.
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
