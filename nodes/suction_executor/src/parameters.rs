//! Parameters; `config/suction_executor.yaml` explains each.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use collision::CollisionChecker;
use node_kit::{ChangeParameters, Parameters, Range, Ranges};
use pick_place::{ContactSettings, PrimitiveSettings};
use rehearsal::RehearsalRules;
use serde::{Deserialize, Serialize};
use step_protocol::{GateRules, RequireApproval};
use ur_driver::DriverParameters;
use ur5::Arm;

/// Parameters of the node.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SuctionExecutorParameters {
    /// Which motions need an operator's approval.
    pub require_approval: Approval,
    /// With `unsure`: proposals of at least this probability of success move unasked.
    pub sure_probability: f64,
    /// Names of those whose approvals and rejections count; empty for everybody's.
    pub operators: Vec<String>,
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
    /// The arm's factory calibration; empty for an arm as drawn.
    pub arm_calibration: PathBuf,
    /// Largest heights and speeds of a proposal.
    pub limits: Limits,
    /// What the joints may do in planned motions.
    pub joints: JointLimits,
    /// When the observation has changed.
    #[serde(flatten)]
    pub changes: ChangeParameters,
    /// Seconds of ROS time; an approval needs a heightmap that is not older.
    pub observation_max_age_s: f64,
    /// Whether heightmaps count only where the arm was at home and at rest when they were taken.
    pub observation_needs_home: bool,
    /// Distance that the arm keeps from the cell and from what was seen (m).
    pub collision_margin_m: f64,
    /// Wall seconds that a confirmation waits for its proposal and heightmap.
    pub confirmation_grace_s: f64,
    /// How the tip comes down.
    pub contact: ContactSettings,
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

/// What the joints may do in planned motions.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct JointLimits {
    /// Largest acceleration of each joint.
    pub acceleration_rad_s2: f64,
    /// Largest jerk of each joint.
    pub jerk_rad_s3: f64,
    /// So far from its place at home wrist 3 may turn, both ways, for a hose along the arm; 0: as far as the URDF says.
    pub hose_turn_rad: f64,
}

impl Default for SuctionExecutorParameters {
    fn default() -> Self {
        Self {
            require_approval: Approval::Always,
            sure_probability: 0.99,
            operators: Vec::new(),
            require_presence: false,
            stop_file: PathBuf::new(),
            presence_timeout_s: 1.0,
            world_frame: "world".into(),
            urdf: PathBuf::new(),
            arm_calibration: PathBuf::new(),
            limits: Limits::default(),
            joints: JointLimits::default(),
            changes: ChangeParameters::default(),
            observation_max_age_s: 5.0,
            observation_needs_home: false,
            collision_margin_m: 0.01,
            confirmation_grace_s: 0.5,
            contact: ContactSettings::default(),
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

impl Default for JointLimits {
    fn default() -> Self {
        Self {
            acceleration_rad_s2: Arm::DEFAULT_ACCELERATION_RAD_S2,
            jerk_rad_s3: Arm::DEFAULT_JERK_RAD_S3,
            hose_turn_rad: 0.0,
        }
    }
}

impl Limits {
    fn settings(&self) -> PrimitiveSettings {
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

impl SuctionExecutorParameters {
    /// What the gate goes by.
    pub(crate) fn gate_rules(&self) -> GateRules {
        GateRules {
            frame: self.world_frame.clone(),
            limits: self.limits.settings(),
            changes: self.changes.rules(),
            confirmation_grace: Duration::from_secs_f64(self.confirmation_grace_s),
            require_approval: self.require_approval(),
            operators: self.operators.clone(),
        }
    }

    /// What rehearsals go by.
    pub(crate) fn rehearsal_rules(&self, arm: Arm, checker: CollisionChecker) -> RehearsalRules {
        RehearsalRules {
            arm,
            checker: Arc::new(checker),
            needs_home: self.observation_needs_home,
            observation_max_age: Duration::from_secs_f64(self.observation_max_age_s),
            contact: self.contact,
            sign: self.driver.contact,
            changes: self.changes.rules(),
        }
    }

    fn require_approval(&self) -> RequireApproval {
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
    const RANGES: Ranges = &[
        ("limits.clearance_m", Range::POSITIVE),
        ("limits.lift_m", Range::POSITIVE),
        ("limits.travel_m_s", Range::POSITIVE),
        ("limits.carry_m_s", Range::POSITIVE),
        ("limits.descend_m_s", Range::POSITIVE),
        ("limits.acceleration_m_s2", Range::POSITIVE),
        ("joints.acceleration_rad_s2", Range::POSITIVE),
        ("joints.jerk_rad_s3", Range::POSITIVE),
        ("joints.hose_turn_rad", Range::NOT_NEGATIVE),
        ("collision_margin_m", Range::Float(0.0, 0.2)),
        ("sure_probability", Range::SHARE),
        ("presence_timeout_s", Range::POSITIVE),
        ("observation_max_age_s", Range::DURATION_S),
        ("confirmation_grace_s", Range::DURATION_S),
        ("contact.slow_from_m", Range::Float(0.0, 0.2)),
        ("contact.slow_m_s", Range::Float(0.005, 0.5)),
        ("contact.window_m", Range::Float(0.001, 0.1)),
        ("contact.press_m", Range::Float(0.0, 0.01)),
    ];
    const GROUPS: &'static [(&'static str, Ranges)] = &[
        ("", ChangeParameters::RANGES),
        ("driver.", DriverParameters::RANGES),
    ];
    // What may move, on which view and on whose word, how fast, and what stops it: not for the network to change, whether or not the node is
    // configured. The test below says of each other parameter why it may be set.
    const FIXED: &'static [&'static str] = &[
        "require_approval",
        "sure_probability",
        "operators",
        "require_presence",
        "presence_timeout_s",
        "stop_file",
        "urdf",
        "arm_calibration",
        "limits.clearance_m",
        "limits.lift_m",
        "limits.travel_m_s",
        "limits.carry_m_s",
        "limits.descend_m_s",
        "limits.acceleration_m_s2",
        "joints.acceleration_rad_s2",
        "joints.jerk_rad_s3",
        "joints.hose_turn_rad",
        ChangeParameters::NAMES[0],
        ChangeParameters::NAMES[1],
        "observation_max_age_s",
        "observation_needs_home",
        "collision_margin_m",
        "confirmation_grace_s",
        "contact.slow_from_m",
        "contact.slow_m_s",
        "contact.window_m",
        "contact.press_m",
        "driver.enable_pin",
        "driver.status_max_age_s",
        "driver.rest_speed_rad_s",
        "driver.rest_time_s",
        "driver.path_tolerance_rad",
        "driver.goal_tolerance_rad",
        "driver.motion_time_factor",
        "driver.motion_time_margin_s",
        "driver.lag_rule",
        "driver.contact",
        "driver.check_controllers",
        "driver.stop_timeout_s",
    ];
}

#[cfg(test)]
mod tests {
    use std::path::Path;

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

    /// What may be set while the node is unconfigured, and nothing moves: names of others' interfaces, wiring, and how long answers of
    /// others are waited for, after which nothing moves.
    const WIRING: &[&str] = &[
        "world_frame",
        "driver.follow_action",
        "driver.until_action",
        "driver.io_and_status",
        "driver.suction_pin",
        "driver.vacuum_pin",
        "driver.blow_off_pin",
        "driver.controller_manager",
        "driver.reading_timeout_s",
        "driver.grasp_wait_s",
        "driver.release_wait_s",
        "driver.answer_timeout_s",
        "driver.call_timeout_s",
        "driver.call_attempts",
    ];

    /// Dotted names of all parameters.
    fn names(value: &serde_yaml_ng::Value, prefix: &str) -> Vec<String> {
        let Some(mapping) = value.as_mapping() else {
            return vec![prefix.to_owned()];
        };
        let name = |key: &serde_yaml_ng::Value| {
            let dot = if prefix.is_empty() { "" } else { "." };
            format!("{prefix}{dot}{}", key.as_str().unwrap())
        };
        let pairs = mapping.iter();
        pairs
            .flat_map(|(key, value)| names(value, &name(key)))
            .collect()
    }

    #[test]
    fn what_weakens_approval_or_safety_cannot_be_set_while_the_process_runs() {
        type Given = SuctionExecutorParameters;
        let all = names(&serde_yaml_ng::to_value(Given::default()).unwrap(), "");
        let mut decided: Vec<&str> = Given::FIXED.iter().chain(WIRING).copied().collect();
        for name in &all {
            assert!(
                decided.contains(&name.as_str()),
                "{name}: is it fixed, or wiring?"
            );
        }
        decided.sort_unstable();
        decided.dedup();
        assert_eq!(decided.len(), all.len());
        assert_eq!(Given::CHANGEABLE, [""; 0]);
    }

    #[test]
    fn the_parameters_of_a_real_cell_are_valid_and_stricter_than_the_defaults() {
        let text = std::fs::read_to_string(
            Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/real_cell.yaml"),
        )
        .unwrap();
        let read: SuctionExecutorParameters =
            node_kit::load_text("real_cell.yaml", &text, "/suction_executor").unwrap();
        let default = SuctionExecutorParameters::default();
        assert!(read.observation_needs_home);
        assert!(read.observation_max_age_s < default.observation_max_age_s);
        assert!(read.driver.status_max_age_s < default.driver.status_max_age_s);
        assert!(read.joints.acceleration_rad_s2 < default.joints.acceleration_rad_s2);
        assert!(read.joints.jerk_rad_s3 < default.joints.jerk_rad_s3);
        assert!(read.joints.hose_turn_rad > 0.0);
        assert!(read.contact.slow_from_m > 0.0);
        assert_eq!(read.require_approval, Approval::Always);
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
