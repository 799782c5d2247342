//! Reads a data set in LeRobot's layout as demonstrations.

use crate::extra::{self, Extra};
use crate::{ACTION, GOAL_HEIGHT, GOAL_IMAGE, HEIGHT, IMAGE};
use bags::{Demonstration, DemonstrationStep};
use heightmap::{Heightmap, Workspace};
use image::ImageFormat;
use parquet::errors::ParquetError;
use parquet::file::reader::{FileReader as _, SerializedFileReader};
use parquet::record::{Field, Row};
use pick_place::{Outcome, PickPlace, PrimitiveSettings};
use serde_json::Value;
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::path::{Path, PathBuf};

/// The layouts that are read.
const VERSION: &str = "v3.0";

/// A data set that cannot be read.
#[derive(Debug, thiserror::Error)]
#[allow(
    missing_docs,
    reason = "the message of each variant explains its fields"
)]
pub enum ImportError {
    /// The system refused.
    #[error("{}: {source}", path.display())]
    Io {
        path: PathBuf,
        source: std::io::Error,
    },
    /// A file of `meta/` is not JSON, or has not the fields that are expected.
    #[error("{}: {source}", path.display())]
    Json {
        path: PathBuf,
        source: serde_json::Error,
    },
    /// A table cannot be read.
    #[error("{}: {source}", path.display())]
    Table { path: PathBuf, source: ParquetError },
    /// A field is missing or something else.
    #[error("{}: {field}: {actual}, expected {expected}", path.display())]
    Field {
        path: PathBuf,
        field: String,
        actual: String,
        expected: String,
    },
}

type Result<T, E = ImportError> = std::result::Result<T, E>;

/// A data set that is there, its pictures and tables not read yet.
pub struct Import {
    files: Vec<PathBuf>,
    tasks: BTreeMap<i64, String>,
    extra: Option<Extra>,
    extra_path: PathBuf,
    shape: (usize, usize),
}

/// A row of a data file.
struct Frame {
    episode: i64,
    task: i64,
    seen: Heightmap,
    goal: Heightmap,
    action: [f64; 6],
    reward: f64,
}

impl Import {
    /// Opens a data set as `sctn bag export` writes it: pictures and heights of the workspace before and after each step, and the
    /// six numbers of the action.
    ///
    /// # Errors
    /// Another version, columns that are missing or of another type, files that cannot be read.
    pub fn open(folder: &Path) -> Result<Self> {
        let path = folder.join("meta/info.json");
        let info: Value = json(&path)?;
        let fail = |field: &str, actual: &Value, expected: String| ImportError::Field {
            path: path.clone(),
            field: field.to_owned(),
            actual: actual.to_string(),
            expected,
        };
        if info["codebase_version"] != VERSION {
            let actual = &info["codebase_version"];
            return Err(fail("codebase_version", actual, format!("{VERSION:?}")));
        }
        let features = &info["features"];
        for (name, dtype) in [
            (IMAGE, "image"),
            (GOAL_IMAGE, "image"),
            (HEIGHT, "float32"),
            (GOAL_HEIGHT, "float32"),
            ("action", "float32"),
            ("next.reward", "float32"),
        ] {
            let actual = &features[name]["dtype"];
            if actual != dtype {
                let field = format!("features.{name}.dtype");
                return Err(fail(&field, actual, format!("{dtype:?}")));
            }
        }
        let names = &features["action"]["names"];
        if *names != serde_json::json!(ACTION) {
            return Err(fail("features.action.names", names, format!("{ACTION:?}")));
        }
        let size = &features[HEIGHT]["shape"];
        let side = |index: usize| size[index].as_u64().map(|side| side as usize);
        let (Some(rows), Some(cols)) = (side(0), side(1)) else {
            let field = format!("features.{HEIGHT}.shape");
            return Err(fail(&field, size, "rows and columns".to_owned()));
        };
        let mut files = Vec::new();
        let data = folder.join("data");
        for chunk in entries(&data)? {
            files.extend(entries(&chunk)?);
        }
        files.retain(|file| file.extension().is_some_and(|end| end == "parquet"));
        let extra_path = folder.join(extra::FILE);
        let extra = extra_path.exists().then(|| json(&extra_path)).transpose()?;
        Ok(Self {
            files,
            tasks: tasks(&folder.join("meta/tasks.parquet"))?,
            extra,
            extra_path,
            shape: (rows, cols),
        })
    }

    /// Gives each episode to `take`, in the order of the files.
    ///
    /// Where `meta/sctn.json` is missing, as in sets that others have made, the seed is the episode's number, the workspace that of Ravens, the
    /// module the task, every action was placed, and with the settings for rigid objects.
    ///
    /// # Errors
    /// What is wrong in a file, by its column; the first error of `take`.
    pub fn read<E: From<ImportError>>(
        &self,
        mut take: impl FnMut(Demonstration) -> Result<(), E>,
    ) -> Result<(), E> {
        let mut frames: Vec<Frame> = Vec::new();
        for path in &self.files {
            let table = |source| ImportError::Table {
                path: path.clone(),
                source,
            };
            let file = File::open(path).map_err(|source| io(path, source))?;
            let reader = SerializedFileReader::new(file).map_err(table)?;
            for row in reader.get_row_iter(None).map_err(table)? {
                let frame = self.frame(path, &row.map_err(table)?)?;
                if frames
                    .last()
                    .is_some_and(|last| last.episode != frame.episode)
                {
                    take(self.demonstration(std::mem::take(&mut frames))?)?;
                }
                frames.push(frame);
            }
        }
        if !frames.is_empty() {
            take(self.demonstration(frames)?)?;
        }
        Ok(())
    }

    fn frame(&self, path: &Path, row: &Row) -> Result<Frame> {
        let columns: BTreeMap<&str, &Field> = row
            .get_column_iter()
            .map(|(name, field)| (name.as_str(), field))
            .collect();
        let fail = |name: &str, expected: &str| ImportError::Field {
            path: path.to_owned(),
            field: name.to_owned(),
            actual: match columns.get(name) {
                None => "missing".to_owned(),
                Some(Field::Null) => "null".to_owned(),
                Some(_) => "another type or size".to_owned(),
            },
            expected: expected.to_owned(),
        };
        let whole = |name: &str| match columns.get(name) {
            Some(Field::Long(value)) => Ok(*value),
            _ => Err(fail(name, "an int64")),
        };
        let (rows, cols) = self.shape;
        let heightmap = |image: &str, height: &str| -> Result<Heightmap> {
            let png = columns.get(image).and_then(|field| picture(field));
            let png = png.ok_or_else(|| fail(image, "the bytes of a PNG"))?;
            let pixels = image::load_from_memory_with_format(png, ImageFormat::Png);
            let pixels = pixels.map_err(|_| fail(image, "a PNG"))?.into_rgb8();
            if (pixels.height() as usize, pixels.width() as usize) != self.shape {
                return Err(fail(image, &format!("{rows} x {cols} pixels")));
            }
            let expected = format!("{rows} x {cols} finite heights");
            let height_m = columns.get(height).and_then(|field| numbers(field));
            let height_m = height_m.ok_or_else(|| fail(height, &expected))?;
            if height_m.len() != rows * cols || !height_m.iter().all(|z| z.is_finite()) {
                return Err(fail(height, &expected));
            }
            Ok(Heightmap {
                workspace: Workspace {
                    rows,
                    cols,
                    ..Workspace::RAVENS
                },
                rgb: pixels.into_raw(),
                height_m,
            })
        };
        let action = columns.get("action").and_then(|field| numbers(field));
        let action: Option<[f32; 6]> = action.and_then(|action| action.try_into().ok());
        let action = action.filter(|action| action.iter().all(|part| part.is_finite()));
        let action = action.ok_or_else(|| fail("action", "six finite numbers"))?;
        let reward = match columns.get("next.reward") {
            Some(Field::Float(reward)) if reward.is_finite() => f64::from(*reward),
            _ => return Err(fail("next.reward", "a finite float32")),
        };
        Ok(Frame {
            episode: whole("episode_index")?,
            task: whole("task_index")?,
            seen: heightmap(IMAGE, HEIGHT)?,
            goal: heightmap(GOAL_IMAGE, GOAL_HEIGHT)?,
            action: action.map(f64::from),
            reward,
        })
    }

    /// The frames of one episode, at least one.
    fn demonstration(&self, frames: Vec<Frame>) -> Result<Demonstration> {
        let first = &frames[0];
        let (number, task) = (first.episode, first.task);
        let problem = self.tasks.get(&task).ok_or_else(|| ImportError::Field {
            path: self.extra_path.with_file_name("tasks.parquet"),
            field: "task_index".to_owned(),
            actual: format!("no {task}"),
            expected: format!("the task of episode {number}"),
        })?;
        let known = match &self.extra {
            None => None,
            Some(extra) => {
                let episode = usize::try_from(number).ok();
                let episode = episode.and_then(|number| extra.episodes.get(number));
                let episode = episode.filter(|episode| episode.steps.len() == frames.len());
                Some(episode.ok_or_else(|| ImportError::Field {
                    path: self.extra_path.clone(),
                    field: format!("episodes[{number}].steps"),
                    actual: "missing, or of another length".to_owned(),
                    expected: format!("{} steps as in the data", frames.len()),
                })?)
            }
        };
        let workspace = known.map_or(frames[0].seen.workspace, |known| known.workspace);
        if (workspace.rows, workspace.cols) != self.shape {
            return Err(ImportError::Field {
                path: self.extra_path.clone(),
                field: format!("episodes[{number}].workspace"),
                actual: format!("{} x {} cells", workspace.rows, workspace.cols),
                expected: format!("{} x {} as in the data", self.shape.0, self.shape.1),
            });
        }
        let mut last = frames[frames.len() - 1].goal.clone();
        last.workspace = workspace;
        let steps = frames.into_iter().enumerate().map(|(index, frame)| {
            let known = known.map(|known| &known.steps[index]);
            let mut observation = frame.seen;
            observation.workspace = workspace;
            DemonstrationStep {
                observation,
                action: PickPlace::from_array(known.map_or(frame.action, |known| known.action)),
                settings: known.map_or(PrimitiveSettings::RIGID, |known| known.settings),
                module: known.map_or_else(|| problem.clone(), |known| known.module.clone()),
                delta_reward: known.map_or(frame.reward, |known| known.delta_reward),
                outcome: known.map_or(Outcome::Placed, |known| known.outcome),
            }
        });
        let steps = steps.collect();
        let seed = number.unsigned_abs();
        Ok(Demonstration {
            problem: problem.clone(),
            seed: known.map_or(seed, |known| known.seed),
            start_seed: known.map_or(seed, |known| known.start_seed),
            steps,
            last,
        })
    }
}

fn io(path: &Path, source: std::io::Error) -> ImportError {
    ImportError::Io {
        path: path.to_owned(),
        source,
    }
}

fn json<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T> {
    let text = fs::read_to_string(path).map_err(|source| io(path, source))?;
    serde_json::from_str(&text).map_err(|source| ImportError::Json {
        path: path.to_owned(),
        source,
    })
}

/// What a folder holds, by name.
fn entries(folder: &Path) -> Result<Vec<PathBuf>> {
    let found = fs::read_dir(folder).map_err(|source| io(folder, source))?;
    let paths = found.map(|entry| Ok(entry?.path()));
    let mut paths = paths
        .collect::<std::io::Result<Vec<_>>>()
        .map_err(|source| io(folder, source))?;
    paths.sort();
    Ok(paths)
}

/// The text of each task by its number. pandas calls the column of the text as its index is called.
fn tasks(path: &Path) -> Result<BTreeMap<i64, String>> {
    let table = |source| ImportError::Table {
        path: path.to_owned(),
        source,
    };
    let file = File::open(path).map_err(|source| io(path, source))?;
    let reader = SerializedFileReader::new(file).map_err(table)?;
    let mut tasks = BTreeMap::new();
    for row in reader.get_row_iter(None).map_err(table)? {
        let row = row.map_err(table)?;
        let (mut number, mut text) = (None, None);
        for (name, field) in row.get_column_iter() {
            match (name.as_str(), field) {
                ("task_index", Field::Long(value)) => number = Some(*value),
                (_, Field::Str(value)) => text = Some(value.clone()),
                _ => {}
            }
        }
        let (Some(number), Some(text)) = (number, text) else {
            return Err(ImportError::Field {
                path: path.to_owned(),
                field: "task_index".to_owned(),
                actual: "missing, or without a text".to_owned(),
                expected: "an int64 and the text of the task".to_owned(),
            });
        };
        tasks.insert(number, text);
    }
    Ok(tasks)
}

/// The bytes of a picture.
fn picture(field: &Field) -> Option<&[u8]> {
    let Field::Group(parts) = field else {
        return None;
    };
    parts.get_column_iter().find_map(|(name, part)| match part {
        Field::Bytes(bytes) if name == "bytes" => Some(bytes.data()),
        _ => None,
    })
}

/// The numbers of a list, or of a list of lists, one after the other.
fn numbers(field: &Field) -> Option<Vec<f32>> {
    fn add(field: &Field, all: &mut Vec<f32>) -> Option<()> {
        match field {
            Field::Float(number) => all.push(*number),
            Field::ListInternal(list) => {
                for element in list.elements() {
                    add(element, all)?;
                }
            }
            _ => return None,
        }
        Some(())
    }
    let mut all = Vec::new();
    add(field, &mut all)?;
    Some(all)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::DataSet;

    /// Two steps on a table of 4 x 3 cells.
    fn demonstration(seed: u64) -> Demonstration {
        let workspace = Workspace {
            rows: 4,
            cols: 3,
            ..Workspace::RAVENS
        };
        let image = |mark: u8| Heightmap {
            workspace,
            rgb: (0..36).map(|index| mark.wrapping_mul(index)).collect(),
            height_m: (0..12u8)
                .map(|index| f32::from(mark) * 0.1 + f32::from(index))
                .collect(),
        };
        let step = |mark: u8, module: &str, outcome, settings| DemonstrationStep {
            observation: image(mark),
            action: PickPlace::from_array([0.3, 0.1 / 3.0, 0.7, 0.5, -0.2, -3.0]),
            settings,
            module: module.to_owned(),
            delta_reward: if outcome == Outcome::Placed {
                1.0 / 3.0
            } else {
                0.0
            },
            outcome,
        };
        Demonstration {
            problem: "stacking_routing".to_owned(),
            seed,
            start_seed: seed + 2,
            steps: vec![
                step(
                    1,
                    "stacking",
                    Outcome::GraspFailed,
                    PrimitiveSettings::RIGID,
                ),
                step(2, "routing", Outcome::Placed, PrimitiveSettings::BEADS),
            ],
            last: image(3),
        }
    }

    fn exported(folder: &Path) -> PathBuf {
        let set = folder.join("set");
        let mut data = DataSet::create(&set).unwrap();
        data.add(&demonstration(4)).unwrap();
        data.add(&demonstration(8)).unwrap();
        data.finish().unwrap();
        set
    }

    fn read(set: &Path) -> Result<Vec<Demonstration>> {
        let mut found = Vec::new();
        Import::open(set)?.read(|demonstration| {
            found.push(demonstration);
            Ok::<_, ImportError>(())
        })?;
        Ok(found)
    }

    #[test]
    fn what_is_exported_comes_back() {
        let folder = tempfile::tempdir().unwrap();
        let found = read(&exported(folder.path())).unwrap();
        assert_eq!(found.len(), 2);
        for (found, seed) in found.iter().zip([4, 8]) {
            let expected = demonstration(seed);
            assert_eq!((found.seed, found.start_seed), (seed, seed + 2));
            assert_eq!(
                (&found.problem, &found.last),
                (&expected.problem, &expected.last)
            );
            assert_eq!(found.steps.len(), 2);
            for (found, expected) in found.steps.iter().zip(&expected.steps) {
                assert_eq!(found.observation, expected.observation);
                assert_eq!(
                    (&found.module, found.outcome),
                    (&expected.module, expected.outcome)
                );
                assert_eq!(found.settings, expected.settings);
                let numbers = [found, expected].map(|step| step.action.to_array());
                for (a, b) in numbers[0].iter().zip(numbers[1]) {
                    assert!((a - b).abs() < 1e-14, "{a} {b}");
                }
                assert!((found.delta_reward - expected.delta_reward).abs() < 1e-14);
            }
        }
    }

    #[test]
    fn without_our_file_the_columns_are_enough() {
        let folder = tempfile::tempdir().unwrap();
        let set = exported(folder.path());
        fs::remove_file(set.join(extra::FILE)).unwrap();
        let found = read(&set).unwrap();
        assert_eq!((found[1].seed, found[1].start_seed), (1, 1));
        let (step, expected) = (&found[1].steps[1], &demonstration(8).steps[1]);
        assert_eq!(step.observation, expected.observation);
        assert_eq!(
            (step.module.as_str(), step.outcome),
            ("stacking_routing", Outcome::Placed)
        );
        assert_eq!(step.settings, PrimitiveSettings::RIGID);
        assert!((step.action.pick.translation.y - 0.1 / 3.0).abs() < 1e-7);
        assert!((step.delta_reward - 1.0 / 3.0).abs() < 1e-6);
    }

    #[test]
    fn another_data_set_is_refused_by_field() {
        let folder = tempfile::tempdir().unwrap();
        let set = exported(folder.path());
        let info = set.join("meta/info.json");
        let text = fs::read_to_string(&info).unwrap();
        for (from, to, expected) in [
            (
                "v3.0",
                "v2.1",
                "codebase_version: \"v2.1\", expected \"v3.0\"",
            ),
            (
                "\"image\"",
                "\"video\"",
                "dtype: \"video\", expected \"image\"",
            ),
            ("pick_yaw_rad", "gripper", "features.action.names: "),
            (
                "observation.height_m",
                "depth",
                "features.observation.height_m.dtype: null, expected",
            ),
        ] {
            fs::write(&info, text.replace(from, to)).unwrap();
            let error = read(&set).unwrap_err().to_string();
            assert!(
                error.contains("info.json") && error.contains(expected),
                "{error}"
            );
        }
        fs::write(&info, &text).unwrap();
        let extra = set.join(extra::FILE);
        let text = fs::read_to_string(&extra).unwrap();
        fs::write(&extra, text.replace("\"rows\":4", "\"rows\":5")).unwrap();
        let error = read(&set).unwrap_err().to_string();
        assert!(
            error.contains("episodes[0].workspace: 5 x 3 cells, expected 4 x 3"),
            "{error}"
        );
        fs::write(&extra, "{\"episodes\": []}").unwrap();
        let error = read(&set).unwrap_err().to_string();
        assert!(error.contains("episodes[0].steps: missing"), "{error}");
        fs::write(set.join("data/chunk-000/file-000.parquet"), b"no table").unwrap();
        let error = read(&set).unwrap_err().to_string();
        assert!(error.contains("file-000.parquet"), "{error}");
        let error = read(&folder.path().join("none")).unwrap_err().to_string();
        assert!(error.contains("none/meta/info.json"), "{error}");
    }
}
