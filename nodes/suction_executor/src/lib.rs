//! Node that executes approved proposals through the UR driver interface.

mod gate;
mod status;
