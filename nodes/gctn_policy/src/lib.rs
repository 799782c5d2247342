//! Node that proposes pick and place poses.
