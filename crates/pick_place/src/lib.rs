//! The suction pick-and-place primitive as a state machine over a small robot trait.
