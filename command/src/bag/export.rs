//! `sctn bag export`: demonstrations for people outside ROS.

use anyhow::{Context as _, Result};
use bags::Demonstration;
use clap::Args;
use heightmap::Heightmap;
use parquet::basic::Compression;
use parquet::data_type::{BoolType, ByteArray, ByteArrayType, DataType, FloatType, Int64Type};
use parquet::file::metadata::KeyValue;
use parquet::file::properties::WriterProperties;
use parquet::file::writer::{SerializedFileWriter, SerializedRowGroupWriter};
use parquet::schema::parser::parse_message_type;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::fs::{self, File};
use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;

const IMAGE: &str = "observation.images.workspace";
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

/// Arguments of `sctn bag export`.
#[derive(Args)]
pub struct Export {
    /// Bags of demonstrations or of recorded runs
    #[arg(required = true)]
    bags: Vec<PathBuf>,
    /// Folder for the data set; it must not exist
    #[arg(long)]
    out: PathBuf,
    /// Print a JSON object last
    #[arg(long)]
    json: bool,
}

impl Export {
    pub fn run(self) -> Result<ExitCode> {
        fs::create_dir(&self.out).with_context(|| self.out.display().to_string())?;
        let mut set = DataSet::new(&self.out)?;
        for bag in &self.bags {
            let demonstration = Demonstration::read(bag)?;
            set.add(&demonstration)
                .with_context(|| format!("export {}", bag.display()))?;
        }
        let (episodes, frames) = (set.episodes.len(), set.frames);
        set.finish()?;
        if self.json {
            println!(
                "{}",
                json!({"out": self.out, "episodes": episodes, "frames": frames})
            );
        } else {
            println!(
                "{}: {episodes} episodes, {frames} frames",
                self.out.display()
            );
        }
        Ok(ExitCode::SUCCESS)
    }
}

/// A data set in LeRobot's layout (version 3.0), with every step as pictures and arrays beside it.
struct DataSet<'a> {
    folder: &'a Path,
    /// Task and place of each episode.
    episodes: Vec<Place>,
    frames: usize,
    /// Problems in the order of their first episode.
    tasks: Vec<String>,
    shape: Option<(usize, usize)>,
    statistics: BTreeMap<&'static str, Vec<Moments>>,
}

impl<'a> DataSet<'a> {
    fn new(folder: &'a Path) -> Result<Self> {
        fs::create_dir(folder.join("meta"))?;
        Ok(Self {
            folder,
            episodes: Vec::new(),
            frames: 0,
            tasks: Vec::new(),
            shape: None,
            statistics: BTreeMap::new(),
        })
    }

    fn add(&mut self, demonstration: &Demonstration) -> Result<()> {
        let workspace = demonstration.last.workspace;
        let shape = *self.shape.get_or_insert((workspace.rows, workspace.cols));
        anyhow::ensure!(
            shape == (workspace.rows, workspace.cols),
            "heightmaps of {} x {}, expected {} x {} as in the first bag",
            workspace.rows,
            workspace.cols,
            shape.0,
            shape.1
        );
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
        fs::create_dir_all(&steps)?;
        let count = demonstration.steps.len();
        let mut columns = Columns::default();
        for (index, step) in demonstration.steps.iter().enumerate() {
            let picture = png(&step.observation)?;
            let action = [step.action.pick, step.action.place].map(|pose| {
                let position = pose.translation.vector;
                [position.x, position.y, pose.rotation.angle()].map(|value| value as f32)
            });
            let action = action.concat();
            let name = steps.join(format!("step_{index:03}"));
            let path = |ending: &str| PathBuf::from(format!("{}_{ending}", name.display()));
            fs::write(path("observation.png"), &picture)?;
            write_npy(&path("height_m.npy"), &step.observation)?;
            fs::write(
                path("action.json"),
                serde_json::to_string_pretty(&json!({
                    "action": ACTION.iter().zip(&action).collect::<BTreeMap<_, _>>(),
                    "module": step.module,
                    "delta_reward": step.delta_reward,
                }))?,
            )?;
            columns.pictures.push(picture);
            columns
                .names
                .push(format!("episode_{episode:06}_frame_{index:06}.png"));
            columns.actions.push(action);
            columns.rewards.push(step.delta_reward as f32);
        }
        fs::write(
            steps.join("last_observation.png"),
            png(&demonstration.last)?,
        )?;
        write_npy(&steps.join("last_height_m.npy"), &demonstration.last)?;
        let place = Place {
            episode,
            task,
            first: self.frames,
            count,
        };
        let data = self.folder.join(format!("data/chunk-{:03}", place.chunk()));
        fs::create_dir_all(&data)?;
        columns.write(
            &data.join(format!("file-{:03}.parquet", place.file())),
            &place,
            &features(shape),
        )?;
        for (name, moments) in columns.statistics(&place)? {
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
        self.frames += count;
        self.episodes.push(place);
        Ok(())
    }

    /// Where each episode is.
    fn write_episodes(&self) -> Result<()> {
        let folder = self.folder.join("meta/episodes/chunk-000");
        fs::create_dir_all(&folder)?;
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

    fn finish(self) -> Result<()> {
        self.write_tasks()?;
        self.write_episodes()?;
        let statistics = self.statistics.iter().map(|(name, moments)| {
            let of = |value: &dyn Fn(&Moments) -> f64| -> Value {
                let values = moments.iter().map(value);
                // Channels of a picture come first, with a row and a column of one.
                match *name {
                    IMAGE => values.map(|value| json!([[value]])).collect(),
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
            fs::write(&path, serde_json::to_string_pretty(&value)?)
                .with_context(|| path.display().to_string())?;
        }
        Ok(())
    }
}

/// What LeRobot wants to know of each column.
fn features((rows, cols): (usize, usize)) -> Value {
    let scalar = |dtype: &str| json!({"dtype": dtype, "shape": [1], "names": null});
    json!({
        IMAGE: {"dtype": "image", "shape": [rows, cols, 3], "names": ["height", "width", "channels"]},
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
fn hugging_face() -> Value {
    let value = |dtype: &str| json!({"dtype": dtype, "_type": "Value"});
    json!({"info": {"features": {
        IMAGE: {"_type": "Image"},
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

/// An episode by columns.
#[derive(Default)]
struct Columns {
    pictures: Vec<Vec<u8>>,
    names: Vec<String>,
    actions: Vec<Vec<f32>>,
    rewards: Vec<f32>,
}

impl Columns {
    fn write(&self, path: &Path, place: &Place, features: &Value) -> Result<()> {
        let metadata = vec![
            KeyValue::new("huggingface".to_owned(), hugging_face().to_string()),
            KeyValue::new("lerobot_features".to_owned(), features.to_string()),
        ];
        let count = self.rewards.len();
        let bytes = |bytes: &[u8]| ByteArray::from(bytes.to_vec());
        let pictures: Vec<_> = self.pictures.iter().map(|picture| bytes(picture)).collect();
        let names: Vec<_> = self.names.iter().map(|name| text(name)).collect();
        // A list begins at repetition level 0 and goes on at 1.
        let repetition = (0..count * ACTION.len()).map(|index| i16::from(index % ACTION.len() > 0));
        let repetition: Vec<i16> = repetition.collect();
        let numbers = |first: usize, step: usize| -> Vec<i64> {
            (0..count)
                .map(|index| (first + step * index) as i64)
                .collect()
        };
        let done: Vec<bool> = (1..=count).map(|number| number == count).collect();
        write_table(path, SCHEMA, metadata, |group| {
            column::<ByteArrayType>(group, &pictures, None)?;
            column::<ByteArrayType>(group, &names, None)?;
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

    /// Moments of every column: of a picture by channel, of an action by axis.
    fn statistics(&self, place: &Place) -> Result<BTreeMap<&'static str, Vec<Moments>>> {
        let count = self.rewards.len();
        let one = |value: &dyn Fn(usize) -> f64| {
            let values: Vec<f64> = (0..count).map(value).collect();
            Moments::of(&values)
        };
        let mut channels: [Vec<f64>; 3] = Default::default();
        for picture in &self.pictures {
            let picture = image::load_from_memory(picture)?.to_rgb8();
            for pixel in picture.pixels() {
                for (channel, value) in channels.iter_mut().zip(pixel.0) {
                    channel.push(f64::from(value) / 255.0);
                }
            }
        }
        let channels = channels.iter().map(|channel| Moments::of(channel));
        let actions =
            (0..ACTION.len()).map(|axis| one(&|index| f64::from(self.actions[index][axis])));
        let last = count.saturating_sub(1);
        let second = |index: usize| index as f64 / f64::from(FRAMES_PER_SECOND);
        Ok(BTreeMap::from([
            (IMAGE, channels.collect()),
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
        ]))
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

/// Writes a file of Parquet, all in one group of rows.
fn write_table(
    path: &Path,
    schema: &str,
    metadata: Vec<KeyValue>,
    write: impl FnOnce(&mut SerializedRowGroupWriter<'_, File>) -> Result<()>,
) -> Result<()> {
    let schema = Arc::new(parse_message_type(schema)?);
    let properties = WriterProperties::builder()
        .set_compression(Compression::SNAPPY)
        .set_key_value_metadata(Some(metadata))
        .build();
    let file = File::create_new(path).with_context(|| path.display().to_string())?;
    let mut file = SerializedFileWriter::new(file, schema, Arc::new(properties))?;
    let mut group = file.next_row_group()?;
    write(&mut group)?;
    group.close()?;
    file.close()?;
    Ok(())
}

fn column<T: DataType>(
    group: &mut SerializedRowGroupWriter<'_, File>,
    values: &[T::T],
    repetition: Option<&[i16]>,
) -> Result<()> {
    let mut writer = group
        .next_column()?
        .context("the schema has fewer columns")?;
    let writer_of = writer.typed::<T>();
    // Everything is there, down to the innermost level.
    let level = writer_of.get_descriptor().max_def_level();
    writer_of.write_batch(values, Some(&vec![level; values.len()]), repetition)?;
    writer.close()?;
    Ok(())
}

/// Colours as a picture: row 0, the smallest y, on top.
fn png(heightmap: &Heightmap) -> Result<Vec<u8>> {
    let workspace = heightmap.workspace;
    let picture = image::RgbImage::from_raw(
        workspace.cols as u32,
        workspace.rows as u32,
        heightmap.rgb.clone(),
    );
    let mut bytes = Cursor::new(Vec::new());
    picture
        .context("a heightmap of another size than its grid")?
        .write_to(&mut bytes, image::ImageFormat::Png)?;
    Ok(bytes.into_inner())
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
    fs::write(path, bytes).with_context(|| path.display().to_string())
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
