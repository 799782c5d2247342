//! Workspace and pixel conventions, camera model, and fusion of RGB-D views into a heightmap.
