//! Pictures of heightmaps as PNG.
