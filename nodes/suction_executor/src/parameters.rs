//! Parameters; `config/suction_executor.yaml` explains each.

use std::path::PathBuf;

use node_kit::{InvalidParameter, Parameters};
use pick_place::PrimitiveSettings;
use serde::{Deserialize, Serialize};

/// Parameters of the node.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SuctionExecutorParameters {
    /// Whether every motion needs an operator's approval.
    pub require_approval: bool,
    /// Frame of proposals.
    pub world_frame: String,
    /// URDF of the work cell; empty for the one that was compiled in.
    pub urdf: PathBuf,
    /// Largest heights and speeds of a proposal.
    pub limits: Limits,
    /// A cell of the heightmap has changed when its height differs by more.
    pub observation_tolerance_m: f64,
    /// The observation has changed when more than this share of its cells has.
    pub observation_changed_fraction: f64,
    /// Wall seconds that a confirmation waits for its proposal and heightmap.
    pub confirmation_grace_s: f64,
    /// The driver and its wiring.
    pub driver: Driver,
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
            require_approval: true,
            world_frame: "world".into(),
            urdf: PathBuf::new(),
            limits: Limits::default(),
            observation_tolerance_m: 0.005,
            observation_changed_fraction: 0.001,
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

impl Parameters for SuctionExecutorParameters {
    fn validate(&self) -> Result<(), InvalidParameter> {
        let Limits {
            clearance_m,
            lift_m,
            travel_m_s,
            carry_m_s,
            descend_m_s,
            acceleration_m_s2,
        } = self.limits;
        let driver = &self.driver;
        for (name, value) in [
            ("limits.clearance_m", clearance_m),
            ("limits.lift_m", lift_m),
            ("limits.travel_m_s", travel_m_s),
            ("limits.carry_m_s", carry_m_s),
            ("limits.descend_m_s", descend_m_s),
            ("limits.acceleration_m_s2", acceleration_m_s2),
            ("observation_tolerance_m", self.observation_tolerance_m),
            ("driver.rest_speed_rad_s", driver.rest_speed_rad_s),
            ("driver.path_tolerance_rad", driver.path_tolerance_rad),
            ("driver.goal_tolerance_rad", driver.goal_tolerance_rad),
            ("driver.motion_time_factor", driver.motion_time_factor),
        ] {
            InvalidParameter::unless_positive(name, value)?;
        }
        for (name, value) in [
            ("confirmation_grace_s", self.confirmation_grace_s),
            ("driver.status_max_age_s", driver.status_max_age_s),
            ("driver.reading_timeout_s", driver.reading_timeout_s),
            ("driver.rest_time_s", driver.rest_time_s),
            ("driver.motion_time_margin_s", driver.motion_time_margin_s),
            ("driver.call_timeout_s", driver.call_timeout_s),
        ] {
            // Not a number is in no range.
            if !(0.001..=3600.0).contains(&value) {
                let reason = format!("must be 0.001 to 3600, is {value}");
                return Err(InvalidParameter::new(name, reason));
            }
        }
        if !(0.0..=1.0).contains(&self.observation_changed_fraction) {
            let reason = format!("must be 0 to 1, is {}", self.observation_changed_fraction);
            return Err(InvalidParameter::new(
                "observation_changed_fraction",
                reason,
            ));
        }
        for (name, pin) in [
            ("driver.suction_pin", driver.suction_pin),
            ("driver.vacuum_pin", driver.vacuum_pin),
        ] {
            if pin > 17 {
                let reason = format!("must be 0 to 17, is {pin}");
                return Err(InvalidParameter::new(name, reason));
            }
        }
        if !(1..=100).contains(&driver.call_attempts) {
            let reason = format!("must be 1 to 100, is {}", driver.call_attempts);
            return Err(InvalidParameter::new("driver.call_attempts", reason));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lines(prefix: &str, value: &serde_yaml_ng::Value, out: &mut Vec<String>) {
        for (name, value) in value.as_mapping().unwrap() {
            out.push(format!("{prefix}{}:", name.as_str().unwrap()));
            if value.is_mapping() {
                lines(&format!("{prefix}  "), value, out);
            }
        }
    }

    #[test]
    fn the_configuration_file_shows_the_defaults() {
        let file = include_str!("../../../config/suction_executor.yaml");
        let read: SuctionExecutorParameters =
            node_kit::load_text("config/suction_executor.yaml", file, "/suction_executor").unwrap();
        assert_eq!(read, SuctionExecutorParameters::default());
        // And all of them.
        let mut names = Vec::new();
        lines("    ", &serde_yaml_ng::to_value(&read).unwrap(), &mut names);
        for name in names {
            assert!(file.contains(&name), "{name} is missing");
        }
    }

    #[test]
    fn approval_is_required_unless_switched_off() {
        assert!(SuctionExecutorParameters::default().require_approval);
    }

    #[test]
    fn values_out_of_range_are_refused_by_name() {
        for (line, name) in [
            ("limits: {carry_m_s: 0.0}", "limits.carry_m_s"),
            (
                "observation_changed_fraction: 1.5",
                "observation_changed_fraction",
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
