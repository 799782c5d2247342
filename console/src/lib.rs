//! The operator's console without ROS: what a person sees and decides, who decides, teaching, the library of what was
//! taught, training, and the page with its API. The node `operator_console` feeds it and carries its [`Command`]s out.
//!
//! [`Run`] is the run as it was heard, [`Sessions`] are the people; neither has a clock: time is given with what was
//! heard. [`Console`] holds both behind one lock, and [`router`] serves them.
//!
//! ```
//! use std::time::Duration;
//! use console::{Run, Watch};
//! use step_protocol::RunPhase;
//!
//! let run = Run::new(Watch {
//!     nodes: vec!["/suction_executor".into()],
//!     executor: "/suction_executor".into(),
//!     image_topics: vec!["color/image_raw".into(), "depth/image_rect_raw".into()],
//!     stale_after: Duration::from_secs(3),
//!     changes: heightmap::ChangeRules::default(),
//! });
//! assert_eq!(run.phase(), RunPhase::NoGoal);
//! ```

mod cameras;
mod checkpoints;
mod files;
mod history;
mod lesson;
mod library;
mod listener;
mod preview;
mod refusal;
mod run;
#[cfg(test)]
mod samples;
mod server;
mod session;
mod state;
mod training;

pub use cameras::{CameraState, Cameras};
pub use checkpoints::{Checkpoint, Checkpoints};
pub use history::{History, RunCount, RunEvent};
pub use library::{Entry, Libraries, Library};
pub use listener::{Listener, Stream, TlsError, tls_acceptor};
pub use preview::{InvalidPlan, InvalidScores, Motion, Plan, Point, ScoreMaps};
pub use refusal::Refusal;
pub use run::{
    Decision, InvalidJoints, InvalidMessage, Joints, NodeReport, Pose, Run, View, Watch,
};
pub use server::{
    Access, AddressFileError, InvalidServer, InvalidToken, ListenError, Listening, Page,
    PageSettings, Server, ServerSettings, TlsFiles, router,
};
pub use session::{Sessions, ViewerId};
pub use state::{Answer, Command, Console, PolicyState, State};
pub use tokio_rustls::TlsAcceptor;
pub use training::Trainings;

/// A secret of 256 random bits, for tokens and sessions.
pub fn secret() -> String {
    let bytes: [u8; 32] = rand::random();
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// The examples of the README are run as tests.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
