//! UR5 kinematics, trajectories and the work cell read from its URDF.
