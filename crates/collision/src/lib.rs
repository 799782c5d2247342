#![doc = include_str!("../README.md")]

mod checker;
mod lift_out;
mod rehearsal;
mod terrain;

pub use checker::{
    Carried, Clearance, Collision, CollisionChecker, Contact, Margins, MarginsError, Scene,
};
pub use lift_out::lift_out;
pub use rehearsal::{RehearsalError, Situation, rehearse, rehearse_home, rehearse_put_down};
pub use terrain::Terrain;
