//! Demonstrations as a data set in LeRobot's layout, version 3.0: written, and read back.

mod extra;
mod import;

pub use import::{Import, ImportError};

use bags::Demonstration;
use heightmap::Heightmap;
use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder as _};
use parquet::basic::Compression;
use parquet::data_type::{BoolType, ByteArray, ByteArrayType, DataType, FloatType, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::metadata::KeyValue;
use parquet::file::properties::WriterProperties;
use parquet::file::writer::{SerializedFileWriter, SerializedRowGroupWriter};
use parquet::schema::parser::parse_message_type;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::sync::Arc;

const IMAGE: &str = "observation.images.workspace";
/// The next image of the demonstration: what the step makes of the workspace.
const GOAL_IMAGE: &str = "observation.images.goal";
/// Heights of the cells [m], rows along +y.
const HEIGHT: &str = "observation.height_m";
const GOAL_HEIGHT: &str = "observation.goal_height_m";
const ACTION: [&str; 6] = [
    "pick_x_m",
    "pick_y_m",
    "pick_yaw_rad",
    "place_x_m",
    "place_y_m",
    "place_yaw_rad",
];
/// LeRobot's layout keeps so many files in a folder; here each episode is one.
const CHUNK_FILES: usize = 1000;
/// A demonstration has no clock: its steps are a second apart, as in its bag.
const FRAMES_PER_SECOND: u32 = 1;

/// Nothing is missing, yet everything is optional: only so does the loader see that the columns are those of [`hugging_face`].
const SCHEMA: &str = "message schema {
    OPTIONAL GROUP observation.images.workspace {
        OPTIONAL BYTE_ARRAY bytes;
        OPTIONAL BYTE_ARRAY path (UTF8);
    }
    OPTIONAL GROUP observation.images.goal {
        OPTIONAL BYTE_ARRAY bytes;
        OPTIONAL BYTE_ARRAY path (UTF8);
    }
    OPTIONAL GROUP observation.height_m (LIST) { REPEATED GROUP list { OPTIONAL GROUP element (LIST) {
        REPEATED GROUP list { OPTIONAL FLOAT element; } } } }
    OPTIONAL GROUP observation.goal_height_m (LIST) { REPEATED GROUP list { OPTIONAL GROUP element (LIST) {
        REPEATED GROUP list { OPTIONAL FLOAT element; } } } }
    OPTIONAL GROUP action (LIST) { REPEATED GROUP list { OPTIONAL FLOAT element; } }
    OPTIONAL FLOAT timestamp;
    OPTIONAL INT64 frame_index;
    OPTIONAL INT64 episode_index;
    OPTIONAL INT64 index;
    OPTIONAL INT64 task_index;
    OPTIONAL FLOAT next.reward;
    OPTIONAL BOOLEAN next.done;
}";

const EPISODES_SCHEMA: &str = "message schema {
    OPTIONAL INT64 episode_index;
    OPTIONAL GROUP tasks (LIST) { REPEATED GROUP list { OPTIONAL BYTE_ARRAY element (UTF8); } }
    OPTIONAL INT64 length;
    OPTIONAL INT64 data/chunk_index;
    OPTIONAL INT64 data/file_index;
    OPTIONAL INT64 dataset_from_index;
    OPTIONAL INT64 dataset_to_index;
    OPTIONAL INT64 meta/episodes/chunk_index;
    OPTIONAL INT64 meta/episodes/file_index;
}";

const TASKS_SCHEMA: &str = "message schema {
    OPTIONAL INT64 task_index;
    OPTIONAL BYTE_ARRAY __index_level_0__ (UTF8);
}";

/// A data set that cannot be written.
#[derive(Debug, thiserror::Error)]
#[allow(
    missing_docs,
    reason = "the message of each variant explains its fields"
)]
pub enum ExportError {
    /// The system refused.
    #[error("{}: {source}", path.display())]
    Io {
        path: PathBuf,
        source: std::io::Error,
    },
    /// A table cannot be written.
    #[error("{}: {source}", path.display())]
    Table { path: PathBuf, source: ParquetError },
    /// A picture cannot be made.
    #[error("heightmap as a picture: {0}")]
    Picture(#[from] image::ImageError),
    /// A data set has one size of heightmap.
    #[error(
        "heightmaps of {rows} x {cols} cells, expected {expected_rows} x {expected_cols} as in the first demonstration"
    )]
    Size {
        rows: usize,
        cols: usize,
        expected_rows: usize,
        expected_cols: usize,
    },
}

type Result<T, E = ExportError> = std::result::Result<T, E>;

/// Attaches the path to an error of the system.
trait AtPath<T> {
    fn at(self, path: &Path) -> Result<T>;
}

impl<T> AtPath<T> for std::io::Result<T> {
    fn at(self, path: &Path) -> Result<T> {
        self.map_err(|source| ExportError::Io {
            path: path.to_owned(),
            source,
        })
    }
}

/// A data set that is being written: LeRobot's layout, with every step as pictures and arrays beside it.
pub struct DataSet {
    folder: PathBuf,
    /// Task and place of each episode.
    episodes: Vec<Place>,
    frames: usize,
    /// Problems in the order of their first episode.
    tasks: Vec<String>,
    shape: Option<(usize, usize)>,
    statistics: BTreeMap<&'static str, Vec<Moments>>,
    extra: extra::Extra,
}

impl DataSet {
    /// Begins a data set in a new folder.
    ///
    /// # Errors
    /// The folder exists, or cannot be made.
    pub fn create(folder: &Path) -> Result<Self> {
        fs::create_dir(folder).at(folder)?;
        let meta = folder.join("meta");
        fs::create_dir(&meta).at(&meta)?;
        Ok(Self {
            folder: folder.to_owned(),
            episodes: Vec::new(),
            frames: 0,
            tasks: Vec::new(),
            shape: None,
            statistics: BTreeMap::new(),
            extra: extra::Extra::default(),
        })
    }

    /// Episodes so far.
    pub fn episodes(&self) -> usize {
        self.episodes.len()
    }

    /// Frames of all episodes so far: one for each step.
    pub fn frames(&self) -> usize {
        self.frames
    }

    /// Writes a demonstration as the next episode.
    ///
    /// # Errors
    /// Heightmaps of another size than those of the first demonstration, or a file that cannot be written.
    pub fn add(&mut self, demonstration: &Demonstration) -> Result<()> {
        let workspace = demonstration.last.workspace;
        let shape = *self.shape.get_or_insert((workspace.rows, workspace.cols));
        if shape != (workspace.rows, workspace.cols) {
            return Err(ExportError::Size {
                rows: workspace.rows,
                cols: workspace.cols,
                expected_rows: shape.0,
                expected_cols: shape.1,
            });
        }
        let task = match self
            .tasks
            .iter()
            .position(|task| *task == demonstration.problem)
        {
            Some(task) => task,
            None => {
                self.tasks.push(demonstration.problem.clone());
                self.tasks.len() - 1
            }
        };
        let episode = self.episodes.len();
        let steps = self.folder.join(format!("steps/episode_{episode:06}"));
        fs::create_dir_all(&steps).at(&steps)?;
        let count = demonstration.steps.len();
        let before = demonstration.steps.iter().map(|step| &step.observation);
        let heightmaps: Vec<&Heightmap> = before.chain([&demonstration.last]).collect();
        let mut columns = Columns {
            pictures: heightmaps
                .iter()
                .map(|heightmap| png(heightmap))
                .collect::<Result<_>>()?,
            heightmaps,
            actions: Vec::new(),
            rewards: Vec::new(),
        };
        for (index, step) in demonstration.steps.iter().enumerate() {
            let action = step.action.to_array().map(|value| value as f32);
            let action = action.to_vec();
            let name = steps.join(format!("step_{index:03}"));
            let path = |ending: &str| PathBuf::from(format!("{}_{ending}", name.display()));
            write(&path("observation.png"), &columns.pictures[index])?;
            write_npy(&path("height_m.npy"), &step.observation)?;
            let action_by_name: BTreeMap<_, _> = ACTION.iter().zip(&action).collect();
            let facts = json!({
                "action": action_by_name,
                "module": step.module,
                "delta_reward": step.delta_reward,
            });
            write(&path("action.json"), format!("{facts:#}"))?;
            columns.actions.push(action);
            columns.rewards.push(step.delta_reward as f32);
        }
        write(
            &steps.join("last_observation.png"),
            &columns.pictures[count],
        )?;
        write_npy(&steps.join("last_height_m.npy"), &demonstration.last)?;
        let place = Place {
            episode,
            task,
            first: self.frames,
            count,
        };
        let data = self.folder.join(format!("data/chunk-{:03}", place.chunk()));
        fs::create_dir_all(&data).at(&data)?;
        columns.write(
            &data.join(format!("file-{:03}.parquet", place.file())),
            &place,
            shape,
        )?;
        for (name, moments) in columns.statistics(&place) {
            match self.statistics.entry(name) {
                Entry::Vacant(entry) => {
                    entry.insert(moments);
                }
                Entry::Occupied(mut entry) => {
                    let pairs = entry.get_mut().iter_mut().zip(moments);
                    pairs.for_each(|(all, of_this)| all.merge(&of_this));
                }
            }
        }
        self.extra.episodes.push(demonstration.into());
        self.frames += count;
        self.episodes.push(place);
        Ok(())
    }

    /// Where each episode is.
    fn write_episodes(&self) -> Result<()> {
        let folder = self.folder.join("meta/episodes/chunk-000");
        fs::create_dir_all(&folder).at(&folder)?;
        let numbers = |value: &dyn Fn(&Place) -> usize| -> Vec<i64> {
            self.episodes
                .iter()
                .map(|place| value(place) as i64)
                .collect()
        };
        let tasks = self
            .episodes
            .iter()
            .map(|place| text(&self.tasks[place.task]));
        let tasks: Vec<ByteArray> = tasks.collect();
        let path = folder.join("file-000.parquet");
        write_table(&path, EPISODES_SCHEMA, Vec::new(), |group| {
            column::<Int64Type>(group, &numbers(&|place| place.episode), None)?;
            // One task each: every value begins a list.
            column::<ByteArrayType>(group, &tasks, Some(&vec![0; tasks.len()]))?;
            column::<Int64Type>(group, &numbers(&|place| place.count), None)?;
            column::<Int64Type>(group, &numbers(&Place::chunk), None)?;
            column::<Int64Type>(group, &numbers(&Place::file), None)?;
            column::<Int64Type>(group, &numbers(&|place| place.first), None)?;
            column::<Int64Type>(group, &numbers(&|place| place.first + place.count), None)?;
            column::<Int64Type>(group, &numbers(&|_| 0), None)?;
            column::<Int64Type>(group, &numbers(&|_| 0), None)
        })
    }

    /// The tasks as a table of pandas, whose index is their text.
    fn write_tasks(&self) -> Result<()> {
        let of = |name: Value, field: &str, kind: &str, numpy: &str| json!({"name": name, "field_name": field, "pandas_type": kind, "numpy_type": numpy, "metadata": null});
        let pandas = json!({
            "index_columns": ["__index_level_0__"],
            "column_indexes": [of(Value::Null, "None", "unicode", "object")],
            "columns": [
                of(json!("task_index"), "task_index", "int64", "int64"),
                of(Value::Null, "__index_level_0__", "unicode", "object"),
            ],
            "creator": {"library": "sctn", "version": env!("CARGO_PKG_VERSION")},
            "pandas_version": "2.0.0",
        });
        let metadata = vec![KeyValue::new("pandas".to_owned(), pandas.to_string())];
        let indices: Vec<i64> = (0..self.tasks.len() as i64).collect();
        let tasks: Vec<ByteArray> = self.tasks.iter().map(|task| text(task)).collect();
        let path = self.folder.join("meta/tasks.parquet");
        write_table(&path, TASKS_SCHEMA, metadata, |group| {
            column::<Int64Type>(group, &indices, None)?;
            column::<ByteArrayType>(group, &tasks, None)
        })
    }

    /// Writes the tables of episodes, tasks and statistics: the data set is complete.
    pub fn finish(self) -> Result<()> {
        self.write_tasks()?;
        self.write_episodes()?;
        let statistics = self.statistics.iter().map(|(name, moments)| {
            let of = |value: &dyn Fn(&Moments) -> f64| -> Value {
                let values = moments.iter().map(value);
                // Channels of a picture come first, with a row and a column of one.
                match *name {
                    IMAGE | GOAL_IMAGE => values.map(|value| json!([[value]])).collect(),
                    HEIGHT | GOAL_HEIGHT => json!([values.collect::<Vec<_>>()]),
                    _ => values.map(|value| json!(value)).collect(),
                }
            };
            let fields = json!({
                "min": of(&|moments| moments.least),
                "max": of(&|moments| moments.largest),
                "mean": of(&|moments| moments.mean),
                "std": of(&|moments| moments.variance.sqrt()),
                "count": [self.frames],
            });
            (name.to_string(), fields)
        });
        let statistics: serde_json::Map<String, Value> = statistics.collect();
        let info = json!({
            "codebase_version": "v3.0",
            "robot_type": "ur5_suction",
            "total_episodes": self.episodes.len(),
            "total_frames": self.frames,
            "total_tasks": self.tasks.len(),
            "chunks_size": CHUNK_FILES,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": FRAMES_PER_SECOND,
            "splits": {"train": format!("0:{}", self.episodes.len())},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": null,
            "features": features(self.shape.unwrap_or_default()),
        });
        for (name, value) in [("stats.json", json!(statistics)), ("info.json", info)] {
            let path = self.folder.join("meta").join(name);
            write(&path, format!("{value:#}"))?;
        }
        write(
            &self.folder.join(extra::FILE),
            json!(self.extra).to_string(),
        )
    }
}

/// What LeRobot wants to know of each column.
fn features((rows, cols): (usize, usize)) -> Value {
    let scalar = |dtype: &str| json!({"dtype": dtype, "shape": [1], "names": null});
    let image = json!({"dtype": "image", "shape": [rows, cols, 3], "names": ["height", "width", "channels"]});
    let height = json!({"dtype": "float32", "shape": [rows, cols], "names": ["row", "col"]});
    json!({
        IMAGE: image, GOAL_IMAGE: image, HEIGHT: height, GOAL_HEIGHT: height,
        "action": {"dtype": "float32", "shape": [ACTION.len()], "names": ACTION},
        "timestamp": scalar("float32"),
        "frame_index": scalar("int64"),
        "episode_index": scalar("int64"),
        "index": scalar("int64"),
        "task_index": scalar("int64"),
        "next.reward": scalar("float32"),
        "next.done": scalar("bool"),
    })
}

/// The same for the loader of Hugging Face's data sets, which reads it from the file.
fn hugging_face((rows, cols): (usize, usize)) -> Value {
    let height = json!({"shape": [rows, cols], "dtype": "float32", "_type": "Array2D"});
    let image = json!({"_type": "Image"});
    let value = |dtype: &str| json!({"dtype": dtype, "_type": "Value"});
    json!({"info": {"features": {
        IMAGE: image, GOAL_IMAGE: image, HEIGHT: height, GOAL_HEIGHT: height,
        "action": {"feature": value("float32"), "length": -1, "_type": "Sequence"},
        "timestamp": value("float32"),
        "frame_index": value("int64"),
        "episode_index": value("int64"),
        "index": value("int64"),
        "task_index": value("int64"),
        "next.reward": value("float32"),
        "next.done": value("bool"),
    }}})
}

/// Where an episode stands in the set.
struct Place {
    episode: usize,
    task: usize,
    /// Its first frame.
    first: usize,
    /// How many it has.
    count: usize,
}

impl Place {
    fn chunk(&self) -> usize {
        self.episode / CHUNK_FILES
    }

    fn file(&self) -> usize {
        self.episode % CHUNK_FILES
    }
}

/// An episode by columns. The goal of a step is the heightmap after it.
struct Columns<'a> {
    /// The heightmap before each step, and the one after the last.
    heightmaps: Vec<&'a Heightmap>,
    /// The same as PNG.
    pictures: Vec<Vec<u8>>,
    actions: Vec<Vec<f32>>,
    rewards: Vec<f32>,
}

impl Columns<'_> {
    fn write(&self, path: &Path, place: &Place, shape: (usize, usize)) -> Result<()> {
        let metadata = vec![
            KeyValue::new("huggingface".to_owned(), hugging_face(shape).to_string()),
            KeyValue::new("lerobot_features".to_owned(), features(shape).to_string()),
        ];
        let (rows, cols) = shape;
        let count = self.rewards.len();
        let bytes = |bytes: &[u8]| ByteArray::from(bytes.to_vec());
        let pictures: Vec<_> = self.pictures.iter().map(|picture| bytes(picture)).collect();
        let names =
            (0..count).map(|frame| format!("episode_{:06}_frame_{frame:06}.png", place.episode));
        let names: Vec<_> = names.map(|name| text(&name)).collect();
        let heights = |heightmaps: &[&Heightmap]| -> Vec<f32> {
            heightmaps
                .iter()
                .flat_map(|heightmap| heightmap.height_m.iter().copied())
                .collect()
        };
        // A list begins at repetition level 0 and goes on at 1; in a list of lists a row begins at 1 and goes on at 2.
        let repetition = (0..count * ACTION.len()).map(|index| i16::from(index % ACTION.len() > 0));
        let repetition: Vec<i16> = repetition.collect();
        let cell_repetition = (0..count * rows * cols).map(|index| match index {
            _ if index % (rows * cols) == 0 => 0,
            _ if index % cols == 0 => 1,
            _ => 2,
        });
        let cell_repetition: Vec<i16> = cell_repetition.collect();
        let numbers = |first: usize, step: usize| -> Vec<i64> {
            (0..count)
                .map(|index| (first + step * index) as i64)
                .collect()
        };
        let done: Vec<bool> = (1..=count).map(|number| number == count).collect();
        write_table(path, SCHEMA, metadata, |group| {
            for of_step in [0, 1] {
                column::<ByteArrayType>(group, &pictures[of_step..of_step + count], None)?;
                column::<ByteArrayType>(group, &names, None)?;
            }
            for of_step in [0, 1] {
                let heights = heights(&self.heightmaps[of_step..of_step + count]);
                column::<FloatType>(group, &heights, Some(&cell_repetition))?;
            }
            column::<FloatType>(group, &self.actions.concat(), Some(&repetition))?;
            column::<FloatType>(group, &self.timestamps(), None)?;
            column::<Int64Type>(group, &numbers(0, 1), None)?;
            column::<Int64Type>(group, &numbers(place.episode, 0), None)?;
            column::<Int64Type>(group, &numbers(place.first, 1), None)?;
            column::<Int64Type>(group, &numbers(place.task, 0), None)?;
            column::<FloatType>(group, &self.rewards, None)?;
            column::<BoolType>(group, &done, None)
        })
    }

    fn timestamps(&self) -> Vec<f32> {
        let seconds = |index| index as f32 / FRAMES_PER_SECOND as f32;
        (0..self.rewards.len()).map(seconds).collect()
    }

    /// Moments of every column: of a picture by channel, of an action by axis, of heights over all cells.
    fn statistics(&self, place: &Place) -> BTreeMap<&'static str, Vec<Moments>> {
        let count = self.rewards.len();
        let one = |value: &dyn Fn(usize) -> f64| {
            let values: Vec<f64> = (0..count).map(value).collect();
            Moments::of(&values)
        };
        let colors = |heightmaps: &[&Heightmap]| -> Vec<Moments> {
            let channel = |channel: usize| -> Moments {
                let pixels = heightmaps
                    .iter()
                    .flat_map(|heightmap| heightmap.rgb.chunks_exact(3));
                let values: Vec<f64> = pixels
                    .map(|pixel| f64::from(pixel[channel]) / 255.0)
                    .collect();
                Moments::of(&values)
            };
            (0..3).map(channel).collect()
        };
        let heights = |heightmaps: &[&Heightmap]| -> Vec<Moments> {
            let cells = heightmaps.iter().flat_map(|heightmap| &heightmap.height_m);
            let values: Vec<f64> = cells.map(|&height_m| f64::from(height_m)).collect();
            vec![Moments::of(&values)]
        };
        let (before, after) = (&self.heightmaps[..count], &self.heightmaps[1..]);
        let actions =
            (0..ACTION.len()).map(|axis| one(&|index| f64::from(self.actions[index][axis])));
        let last = count.saturating_sub(1);
        let second = |index: usize| index as f64 / f64::from(FRAMES_PER_SECOND);
        BTreeMap::from([
            (IMAGE, colors(before)),
            (GOAL_IMAGE, colors(after)),
            (HEIGHT, heights(before)),
            (GOAL_HEIGHT, heights(after)),
            ("action", actions.collect()),
            ("timestamp", vec![one(&second)]),
            ("frame_index", vec![one(&|index| index as f64)]),
            ("episode_index", vec![one(&|_| place.episode as f64)]),
            ("index", vec![one(&|index| (place.first + index) as f64)]),
            ("task_index", vec![one(&|_| place.task as f64)]),
            (
                "next.reward",
                vec![one(&|index| f64::from(self.rewards[index]))],
            ),
            (
                "next.done",
                vec![one(&|index| f64::from(u8::from(index == last)))],
            ),
        ])
    }
}

/// Extent, mean and variance of values.
#[derive(Clone, Copy, Debug)]
struct Moments {
    count: f64,
    least: f64,
    largest: f64,
    mean: f64,
    variance: f64,
}

impl Moments {
    fn of(values: &[f64]) -> Self {
        let count = values.len().max(1) as f64;
        let mean = values.iter().sum::<f64>() / count;
        let squares = values.iter().map(|value| (value - mean).powi(2));
        Self {
            count: values.len() as f64,
            least: values.iter().copied().fold(f64::INFINITY, f64::min),
            largest: values.iter().copied().fold(f64::NEG_INFINITY, f64::max),
            mean,
            variance: squares.sum::<f64>() / count,
        }
    }

    /// Adds those of other values.
    fn merge(&mut self, other: &Self) {
        let count = self.count + other.count;
        let (a, b) = (self.count / count.max(1.0), other.count / count.max(1.0));
        let apart = other.mean - self.mean;
        *self = Self {
            count,
            least: self.least.min(other.least),
            largest: self.largest.max(other.largest),
            mean: a * self.mean + b * other.mean,
            variance: a * self.variance + b * other.variance + a * b * apart * apart,
        };
    }
}

fn text(text: &str) -> ByteArray {
    ByteArray::from(text.as_bytes().to_vec())
}

fn write(path: &Path, contents: impl AsRef<[u8]>) -> Result<()> {
    fs::write(path, contents).at(path)
}

/// Writes a Parquet file, all in one row group.
fn write_table(
    path: &Path,
    schema: &str,
    metadata: Vec<KeyValue>,
    write: impl FnOnce(&mut SerializedRowGroupWriter<'_, File>) -> Result<(), ParquetError>,
) -> Result<()> {
    let properties = WriterProperties::builder()
        .set_compression(Compression::SNAPPY)
        .set_key_value_metadata(Some(metadata))
        .build();
    let file = File::create_new(path).at(path)?;
    let written = || -> Result<(), ParquetError> {
        let schema = Arc::new(parse_message_type(schema)?);
        let mut file = SerializedFileWriter::new(file, schema, Arc::new(properties))?;
        let mut group = file.next_row_group()?;
        write(&mut group)?;
        group.close()?;
        file.close()?;
        Ok(())
    };
    written().map_err(|source| ExportError::Table {
        path: path.to_owned(),
        source,
    })
}

fn column<T: DataType>(
    group: &mut SerializedRowGroupWriter<'_, File>,
    values: &[T::T],
    repetition: Option<&[i16]>,
) -> Result<(), ParquetError> {
    let mut writer = group
        .next_column()?
        .ok_or_else(|| ParquetError::General("the schema has fewer columns".to_owned()))?;
    let writer_of = writer.typed::<T>();
    // Everything is there, down to the innermost level.
    let level = writer_of.get_descriptor().max_def_level();
    writer_of.write_batch(values, Some(&vec![level; values.len()]), repetition)?;
    writer.close()
}

/// Colours as a picture: row 0, the smallest y, on top.
fn png(heightmap: &Heightmap) -> Result<Vec<u8>> {
    let workspace = heightmap.workspace;
    let mut bytes = Vec::new();
    PngEncoder::new(&mut bytes).write_image(
        &heightmap.rgb,
        workspace.cols as u32,
        workspace.rows as u32,
        ExtendedColorType::Rgb8,
    )?;
    Ok(bytes)
}

/// Heights as an array of numpy, rows x columns of float32.
fn write_npy(path: &Path, heightmap: &Heightmap) -> Result<()> {
    let workspace = heightmap.workspace;
    let mut header = format!(
        "{{'descr': '<f4', 'fortran_order': False, 'shape': ({}, {}), }}",
        workspace.rows, workspace.cols
    );
    // Magic, version and length take 10 bytes; the data begins at a multiple of 64.
    while (10 + header.len() + 1) % 64 != 0 {
        header.push(' ');
    }
    header.push('\n');
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.as_bytes());
    bytes.extend(
        heightmap
            .height_m
            .iter()
            .flat_map(|height| height.to_le_bytes()),
    );
    write(path, bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_of_parts_are_those_of_the_whole() {
        let values: Vec<f64> = (0..17).map(|index| f64::from(index * index % 11)).collect();
        let mut merged = Moments::of(&values[..3]);
        merged.merge(&Moments::of(&values[3..4]));
        merged.merge(&Moments::of(&values[4..]));
        let whole = Moments::of(&values);
        assert_eq!((merged.least, merged.largest), (whole.least, whole.largest));
        assert!((merged.mean - whole.mean).abs() < 1e-12);
        assert!((merged.variance - whole.variance).abs() < 1e-12);
    }
}
