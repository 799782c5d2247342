//! Node that fuses camera views into heightmaps.
