//! Faults of the executor and of its way to the driver, planted on purpose: `cargo xtask campaign --planted` shows that the monitor of the fault campaign catches each of them. They are
//! compiled into the executable `suction_executor_planted` only, by the feature `planted_faults`; everywhere else they are constants.

/// A fault of the executor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Planted {
    /// A proposal moves without an approval.
    MovesUnapproved,
    /// The approval of any proposal moves the newest one.
    AnyApproval,
    /// The approval of somebody who does not decide counts.
    AnyOperator,
    /// A superseded proposal can still be approved.
    ApprovesSuperseded,
    /// A proposal can still be approved after it was carried out or stopped.
    ApprovesTwice,
    /// A stop does not stop the motion.
    IgnoresStop,
    /// A stop counts only where it names the proposal that moves.
    IgnoresStopOfAnother,
    /// A stop is answered, and the trajectory is not cancelled.
    AnswersWithoutCancel,
    /// A motion that was stopped begins again.
    GoesOnAfterStop,
    /// A motion that failed begins again when the robot is ready.
    GoesOnAfterFault,
    /// A stop switches suction off.
    DropsOnStop,
    /// A call for the way home moves the arm.
    HomeUnasked,
    /// The watchdog is not told of motions.
    NoHeartbeat,
    /// A second executor becomes active.
    SecondExecutor,
}

/// Names the fault; as [`Planted`] spells it.
const VARIABLE: &str = "SCTN_PLANTED_FAULT";

/// The environment names no fault, where one has to be planted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{VARIABLE} names no fault, expected a variant of Planted, such as IgnoresStop")]
pub struct NoFault;

#[cfg(not(feature = "planted_faults"))]
mod none {
    use super::{NoFault, Planted};

    /// Whether the fault is planted: never.
    pub const fn is_planted(_: Planted) -> bool {
        false
    }

    /// Nothing is planted.
    ///
    /// # Errors
    /// None.
    pub const fn check() -> Result<(), NoFault> {
        Ok(())
    }
}

#[cfg(not(feature = "planted_faults"))]
pub use self::none::{check, is_planted};

#[cfg(feature = "planted_faults")]
mod some {
    use super::{NoFault, Planted};
    use std::sync::LazyLock;

    const ALL: [Planted; 14] = [
        Planted::MovesUnapproved,
        Planted::AnyApproval,
        Planted::AnyOperator,
        Planted::ApprovesSuperseded,
        Planted::ApprovesTwice,
        Planted::IgnoresStop,
        Planted::IgnoresStopOfAnother,
        Planted::AnswersWithoutCancel,
        Planted::GoesOnAfterStop,
        Planted::GoesOnAfterFault,
        Planted::DropsOnStop,
        Planted::HomeUnasked,
        Planted::NoHeartbeat,
        Planted::SecondExecutor,
    ];

    static PLANTED: LazyLock<Option<Planted>> = LazyLock::new(|| {
        let name = std::env::var(super::VARIABLE).ok()?;
        ALL.into_iter().find(|fault| format!("{fault:?}") == name)
    });

    /// Whether the fault is planted.
    pub fn is_planted(fault: Planted) -> bool {
        *PLANTED == Some(fault)
    }

    /// Whether the environment names a fault.
    ///
    /// # Errors
    /// No fault is named.
    pub fn check() -> Result<(), NoFault> {
        PLANTED.map(drop).ok_or(NoFault)
    }
}

#[cfg(feature = "planted_faults")]
pub use self::some::{check, is_planted};
