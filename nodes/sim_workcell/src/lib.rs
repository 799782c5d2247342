//! Node that poses as the UR driver and the cameras, backed by Rapier.
