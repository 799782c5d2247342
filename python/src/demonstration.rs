//! Demonstrations: made here, or read from bags.

use crate::arrays;
use crate::episode::outcome_name;
use crate::problems::{problem, value_error};
use bags::{Demonstration, DemonstrationStep};
use heightmap::Heightmap;
use multiravens::{Environment, EnvironmentError, EpisodeSeed};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use std::path::PathBuf;
use ur5::WorkCell;

/// Begins the episode of a seed and lets the demonstrator act until it is over or it knows no action: what `sctn demos` records.
pub fn record(
    environment: &mut Environment,
    seed: EpisodeSeed,
) -> Result<Demonstration, EnvironmentError> {
    environment.reset(seed)?;
    let mut steps = Vec::new();
    let mut observation = environment.observe()?.clone();
    while !environment.is_done() {
        let (Some(settings), Some(action)) = (environment.settings(), environment.demonstrate())
        else {
            break;
        };
        let report = environment.step(&action)?;
        let next = environment.observe()?.clone();
        steps.push(DemonstrationStep {
            observation: std::mem::replace(&mut observation, next),
            action,
            settings,
            module: report.module.to_owned(),
            delta_reward: report.delta_reward,
            outcome: report.outcome,
        });
    }
    Ok(Demonstration {
        problem: environment.problem().name().to_owned(),
        seed: seed.scene,
        start_seed: seed.start,
        steps,
        last: observation,
    })
}

/// A sequence of steps that solves a problem.
#[pyclass(frozen, name = "Demonstration", module = "multiravens")]
pub struct PyDemonstration {
    demonstration: Demonstration,
}

/// Lets the simulator's demonstrator solve a scene of a problem: the episode that `sctn demos` records for this seed.
#[pyfunction]
#[pyo3(signature = (problem, seed, start=None))]
pub fn demonstrate(
    py: Python<'_>,
    problem: &str,
    seed: u64,
    start: Option<u64>,
) -> PyResult<PyDemonstration> {
    let problem = self::problem(problem)?;
    let seed = EpisodeSeed {
        scene: seed,
        start: start.unwrap_or(seed),
    };
    py.detach(|| {
        let work_cell = WorkCell::builtin().map_err(value_error)?;
        let mut environment = Environment::new(&problem, &work_cell);
        let demonstration = record(&mut environment, seed)
            .map_err(|error| PyRuntimeError::new_err(error.to_string()))?;
        Ok(PyDemonstration { demonstration })
    })
}

/// Reads the bag of a demonstration, or of a run that an operator approved.
#[pyfunction]
pub fn read_demonstration(py: Python<'_>, path: PathBuf) -> PyResult<PyDemonstration> {
    let demonstration = py.detach(|| Demonstration::read(&path).map_err(value_error))?;
    Ok(PyDemonstration { demonstration })
}

#[pymethods]
impl PyDemonstration {
    /// Name of the problem.
    #[getter]
    fn problem(&self) -> &str {
        &self.demonstration.problem
    }

    /// Seed of the scene: fixtures, objects and goal.
    #[getter]
    fn seed(&self) -> u64 {
        self.demonstration.seed
    }

    /// Seed of the start: where the loose objects lay.
    #[getter]
    fn start_seed(&self) -> u64 {
        self.demonstration.start_seed
    }

    /// Colours before each step and after the last one: uint8, (steps + 1, rows, cols, 3).
    #[getter]
    fn colors<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let shape = [&self.shape()[..], &[3]].concat();
        let values = self.images().flat_map(|image| image.rgb.iter().copied());
        Ok(arrays::array(py, &shape, values.collect())?.into_any())
    }

    /// Heights (m) before each step and after the last one: float32, (steps + 1, rows, cols).
    #[getter]
    fn heights<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let values = self
            .images()
            .flat_map(|image| image.height_m.iter().copied());
        Ok(arrays::array(py, &self.shape(), values.collect())?.into_any())
    }

    /// Actions, float64, (steps, 6): x (m), y (m), yaw (rad) of the pick, then of the place.
    #[getter]
    fn actions<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let steps = &self.demonstration.steps;
        let values = steps.iter().flat_map(|step| step.action.to_array());
        Ok(arrays::array(py, &[steps.len(), 6], values.collect())?.into_any())
    }

    /// Change of the reward by each step: float64, (steps,).
    #[getter]
    fn rewards<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let rewards: Vec<f64> = self.rewards_of_steps().collect();
        Ok(arrays::array(py, &[rewards.len()], rewards)?.into_any())
    }

    /// The task module of each step.
    #[getter]
    fn modules(&self) -> Vec<&str> {
        let steps = self.demonstration.steps.iter();
        steps.map(|step| step.module.as_str()).collect()
    }

    /// How each step ended: placed, no_contact, grasp_failed, dropped or lag_aborted.
    #[getter]
    fn outcomes(&self) -> Vec<&'static str> {
        let steps = self.demonstration.steps.iter();
        steps.map(|step| outcome_name(step.outcome)).collect()
    }

    /// Indices, in `colors` and `heights`, of the images after each positive reward: v_1 to v_D of the paper.
    #[getter]
    fn goals(&self) -> Vec<usize> {
        let rewards = self.rewards_of_steps().enumerate();
        let gains = rewards.filter(|(_, reward)| *reward > 0.0);
        gains.map(|(index, _)| index + 1).collect()
    }

    /// Whether every goal was reached.
    #[getter]
    fn complete(&self) -> bool {
        self.rewards_of_steps().sum::<f64>() > 1.0 - 1e-6
    }

    fn __len__(&self) -> usize {
        self.demonstration.steps.len()
    }

    fn __repr__(&self) -> String {
        let steps = self.demonstration.steps.len();
        format!(
            "<Demonstration {}, {steps} steps>",
            self.demonstration.name()
        )
    }

    /// Writes it as a bag: a folder, which must not exist.
    fn write(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        py.detach(|| self.demonstration.write(&path).map_err(value_error))
    }
}

impl PyDemonstration {
    fn images(&self) -> impl Iterator<Item = &Heightmap> {
        (0..=self.demonstration.steps.len()).map(|index| self.demonstration.observation(index))
    }

    fn shape(&self) -> [usize; 3] {
        let workspace = self.demonstration.last.workspace;
        let count = self.demonstration.steps.len() + 1;
        [count, workspace.rows, workspace.cols]
    }

    fn rewards_of_steps(&self) -> impl Iterator<Item = f64> {
        self.demonstration
            .steps
            .iter()
            .map(|step| step.delta_reward)
    }
}
