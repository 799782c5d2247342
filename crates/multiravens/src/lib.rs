//! MultiRavens on Rapier: simulated work cell, rendering, task modules, problems, demonstrators.
