//! The protocol of a step: goal, proposal, approval, motion, result, confirmation.
//!
//! Four state machines, one for each party: [`GoalTracker`] says which goal is next, [`ProposalPlanner`] when to propose,
//! [`ApprovalGate`] what may move, [`Operator`] which question is due. [`Executor`] is what the executor decides around its gate.
//! They know no ROS, no network and no clock: nodes convert messages, call, and publish what comes back.

mod action_goal;
mod executor;
mod gate;
mod goals;
mod motion;
mod mutation;
mod operator;
mod planner;
mod presence;
mod reason;
mod stop_record;
mod tracker;
mod types;

#[cfg(test)]
mod tests;

pub use action_goal::{ActionGoal, GoalEnd};
pub use executor::{Executor, ExecutorAction, ProposedRecovery, Said};
pub use gate::{
    AT_REST_RAD, ApprovalGate, CannotBegin, GateAction, GateRules, InvalidProposal, JointPositions,
    Proposed, RECOVERY_TIMEOUT, Recovery, Refusal, Report, RequireApproval, RobotState, Unasked,
};
pub use goals::{
    FAILED_PICK_RADIUS_M, FailedPicks, GoalSequence, Judgement, NoGoals, ReachedGoals, ShownStep,
    goal_steps, goals_of,
};
pub use motion::{MotionCause, MotionEnd, MotionOrder, MotionTimes, MotionWord, StopCause};
pub use operator::{Operator, Question, RunPhase};
pub use planner::{Job, PlannerRules, Prediction, ProposalPlanner};
pub use presence::{PRESENCE_PERIOD, Presence};
pub use reason::{Obstacle, RefusalReason};
pub use stop_record::StopRecord;
pub use tracker::{
    Capture, CaptureError, Change, ConfirmationRefusal, GoalTracker, NoSuchStep, RefusalKind,
    StepJudge,
};
pub use types::{
    Confirmation, Coverage, Goal, Observation, OperatorDecision, Proposal, ProposalId,
    ProposalStatus, Reward, StepOutcome, StepResult, Verdict, yaw_rad,
};
