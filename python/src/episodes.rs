//! Episodes side by side, on threads, without Python's lock.

use crate::arrays;
use crate::episode::{Episode, EpisodeError, Frame, GoalKind, Options, outcome_name};
use crate::parallel;
use crate::problems::{problem, value_error};
use multiravens::{EnvironmentError, EpisodeSeed};
use numpy::PyReadonlyArrayDyn;
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use std::sync::{Mutex, MutexGuard};
use ur5::WorkCell;

/// Episodes of one problem, carried out on threads.
#[pyclass(frozen, module = "multiravens")]
pub struct Episodes {
    episodes: Vec<Mutex<Episode>>,
    threads: usize,
    #[pyo3(get)]
    problem: String,
}

/// What one episode is to do.
enum Job {
    Reset(Vec<EpisodeSeed>),
    Step([f64; 6]),
}

#[pymethods]
impl Episodes {
    #[new]
    #[pyo3(signature = (problem, count=1, *, threads=None, goal="next", start="same", cameras=false, demonstrator=true))]
    fn new(
        problem: &str,
        count: usize,
        threads: Option<usize>,
        goal: &str,
        start: &str,
        cameras: bool,
        demonstrator: bool,
    ) -> PyResult<Self> {
        let problem = self::problem(problem)?;
        let one_of = |name: &str, value: &str, expected: &str| {
            PyValueError::new_err(format!("{name}: is {value:?}, expected {expected}"))
        };
        let goal = match goal {
            "none" => GoalKind::None,
            "next" => GoalKind::Next,
            "final" => GoalKind::Final,
            other => return Err(one_of("goal", other, "\"next\", \"final\" or \"none\"")),
        };
        let other_start = match start {
            "same" => false,
            "other" => true,
            other => return Err(one_of("start", other, "\"same\" or \"other\"")),
        };
        let threads = threads.unwrap_or_else(parallel::cores);
        for (name, value) in [("count", count), ("threads", threads)] {
            if value == 0 {
                return Err(one_of(name, "0", "at least 1"));
            }
        }
        let options = Options {
            goal,
            other_start,
            cameras,
            demonstrator,
        };
        let work_cell = WorkCell::builtin().map_err(value_error)?;
        let episode = || Mutex::new(Episode::new(&problem, &work_cell, options));
        Ok(Self {
            episodes: (0..count).map(|_| episode()).collect(),
            threads,
            problem: problem.name().to_owned(),
        })
    }

    fn __len__(&self) -> usize {
        self.episodes.len()
    }

    /// Resets the episodes that have seeds, and lets each other one take a step; all actions are checked before any of them.
    ///
    /// `actions` has the shape (count, 6): x_m, y_m, yaw_rad of the pick, then of the place. `seeds` has for each episode
    /// either nothing or pairs of scene and start, of which the first is taken that the demonstrator completes.
    fn advance<'py>(
        &self,
        py: Python<'py>,
        actions: PyReadonlyArrayDyn<'py, f64>,
        seeds: Vec<Vec<(u64, u64)>>,
    ) -> PyResult<Vec<Bound<'py, PyTuple>>> {
        let count = self.episodes.len();
        arrays::check_shape("actions", &actions, &[count, 6])?;
        if seeds.len() != count {
            return Err(PyValueError::new_err(format!(
                "seeds: has {} elements, expected {count}",
                seeds.len()
            )));
        }
        let actions = actions.as_array();
        let jobs: Vec<Job> = seeds
            .into_iter()
            .enumerate()
            .map(|(index, seeds)| match seeds.is_empty() {
                true => Job::Step(std::array::from_fn(|part| actions[[index, part]])),
                false => Job::Reset(
                    seeds
                        .into_iter()
                        .map(|(scene, start)| EpisodeSeed { scene, start })
                        .collect(),
                ),
            })
            .collect();
        let frames = py.detach(|| {
            for (index, job) in jobs.iter().enumerate() {
                if let Job::Step(action) = job {
                    let checked = self.episode(index)?.check(action);
                    checked.map_err(|error| self.error(index, error))?;
                }
            }
            let frames = parallel::run(self.threads, count, |index| {
                let mut episode = self.episode(index)?;
                let frame = match &jobs[index] {
                    Job::Reset(seeds) => episode.reset(seeds),
                    Job::Step(action) => episode.step(action),
                };
                frame.map_err(|error| self.error(index, error))
            });
            let frames = frames.map_err(|error| PyRuntimeError::new_err(error.to_string()))?;
            frames.into_iter().collect::<PyResult<Vec<Frame>>>()
        })?;
        frames
            .into_iter()
            .map(|frame| to_python(py, frame))
            .collect()
    }

    /// What the first camera saw when the last observation of an episode was made: rows x columns x 3.
    fn picture<'py>(&self, py: Python<'py>, index: usize) -> PyResult<Bound<'py, PyAny>> {
        if index >= self.episodes.len() {
            return Err(PyValueError::new_err(format!(
                "index: is {index}, expected below {}",
                self.episodes.len()
            )));
        }
        let picture = self.episode(index)?.picture();
        let (rows, cols, rgb) = picture.map_err(|error| self.error(index, error))?;
        Ok(arrays::array(py, &[rows, cols, 3], rgb)?.into_any())
    }
}

impl Episodes {
    fn episode(&self, index: usize) -> PyResult<MutexGuard<'_, Episode>> {
        self.episodes[index].lock().map_err(|_| {
            PyRuntimeError::new_err("a step of this episode panicked: expected a new environment")
        })
    }

    fn error(&self, index: usize, error: EpisodeError) -> PyErr {
        let place = match self.episodes.len() {
            1 => String::new(),
            _ => format!("environment {index}: "),
        };
        let message = format!("{place}{error}");
        match &error {
            EpisodeError::NoDemonstration { .. } => PyValueError::new_err(message),
            EpisodeError::Environment(error)
                if matches!(**error, EnvironmentError::Action { .. }) =>
            {
                PyValueError::new_err(message)
            }
            _ => PyRuntimeError::new_err(message),
        }
    }
}

/// Observation, reward, terminated, truncated, info.
fn to_python(py: Python<'_>, frame: Frame) -> PyResult<Bound<'_, PyTuple>> {
    let observation = arrays::heightmap(py, &frame.observation)?;
    for (name, goal) in [
        ("goal", &frame.goal),
        ("previous_goal", &frame.previous_goal),
    ] {
        if let Some(goal) = goal {
            observation.set_item(name, arrays::heightmap(py, goal)?)?;
        }
    }
    if !frame.cameras.is_empty() {
        let cameras = PyDict::new(py);
        for image in frame.cameras {
            let (rows, cols) = (image.rows, image.cols);
            let views = PyDict::new(py);
            views.set_item("color", arrays::array(py, &[rows, cols, 3], image.rgb)?)?;
            views.set_item("depth", arrays::array(py, &[rows, cols], image.depth_m)?)?;
            cameras.set_item(image.name, views)?;
        }
        observation.set_item("cameras", cameras)?;
    }
    let info = PyDict::new(py);
    info.set_item("seed", frame.seed.scene)?;
    info.set_item("start_seed", frame.seed.start)?;
    info.set_item("step", frame.step)?;
    info.set_item("module", frame.module.unwrap_or_default())?;
    info.set_item("total_reward", frame.total_reward)?;
    info.set_item("goals_reached", frame.goals_reached.len())?;
    info.set_item("outcome", frame.outcome.map_or("", outcome_name))?;
    if let Some(action) = frame.demonstrator_action {
        info.set_item(
            "demonstrator_action",
            arrays::array(py, &[6], action.to_vec())?,
        )?;
    }
    (
        observation,
        frame.reward,
        frame.terminated,
        frame.truncated,
        info,
    )
        .into_pyobject(py)
}
