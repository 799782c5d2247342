//! Node that executes approved proposals through the UR driver interface.
