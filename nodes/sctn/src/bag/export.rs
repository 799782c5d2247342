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
use std::fs::{self, File};
use std::io::{Cursor, Write};
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
/// LeRobot's layout keeps so many episodes in a folder.
const CHUNK_EPISODES: usize = 1000;
/// A demonstration has no clock: its steps are a second apart, as in its bag.
const FRAMES_PER_SECOND: u32 = 1;

const SCHEMA: &str = "message schema {
    REQUIRED GROUP observation.images.workspace {
        REQUIRED BYTE_ARRAY bytes;
        REQUIRED BYTE_ARRAY path (UTF8);
    }
    REQUIRED GROUP action (LIST) { REPEATED GROUP list { REQUIRED FLOAT element; } }
    REQUIRED FLOAT timestamp;
    REQUIRED INT64 frame_index;
    REQUIRED INT64 episode_index;
    REQUIRED INT64 index;
    REQUIRED INT64 task_index;
    REQUIRED FLOAT next.reward;
    REQUIRED BOOLEAN next.done;
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
        let (episodes, frames) = (set.episodes, set.frames);
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

/// A data set in LeRobot's layout (version 2.1), with every step as pictures and arrays beside it.
struct DataSet<'a> {
    folder: &'a Path,
    episodes: usize,
    frames: usize,
    /// Problems in the order of their first episode.
    tasks: Vec<String>,
    shape: Option<(usize, usize)>,
    episode_lines: File,
    stats_lines: File,
}

impl<'a> DataSet<'a> {
    fn new(folder: &'a Path) -> Result<Self> {
        fs::create_dir(folder.join("meta"))?;
        Ok(Self {
            folder,
            episodes: 0,
            frames: 0,
            tasks: Vec::new(),
            shape: None,
            episode_lines: File::create_new(folder.join("meta/episodes.jsonl"))?,
            stats_lines: File::create_new(folder.join("meta/episodes_stats.jsonl"))?,
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
        let episode = self.episodes;
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
        let chunk = episode / CHUNK_EPISODES;
        let data = self.folder.join(format!("data/chunk-{chunk:03}"));
        fs::create_dir_all(&data)?;
        let place = Place {
            episode,
            task,
            first: self.frames,
        };
        columns.write(
            &data.join(format!("episode_{episode:06}.parquet")),
            &place,
            &features(shape),
        )?;
        let line =
            json!({"episode_index": episode, "tasks": [demonstration.problem], "length": count});
        writeln!(self.episode_lines, "{line}")?;
        let stats = json!({"episode_index": episode, "stats": columns.statistics(&place)?});
        writeln!(self.stats_lines, "{stats}")?;
        self.episodes += 1;
        self.frames += count;
        Ok(())
    }

    fn finish(self) -> Result<()> {
        let mut tasks = File::create_new(self.folder.join("meta/tasks.jsonl"))?;
        for (index, task) in self.tasks.iter().enumerate() {
            writeln!(tasks, "{}", json!({"task_index": index, "task": task}))?;
        }
        let info = json!({
            "codebase_version": "v2.1",
            "robot_type": "ur5_suction",
            "total_episodes": self.episodes,
            "total_frames": self.frames,
            "total_tasks": self.tasks.len(),
            "total_videos": 0,
            "total_chunks": self.episodes.div_ceil(CHUNK_EPISODES),
            "chunks_size": CHUNK_EPISODES,
            "fps": FRAMES_PER_SECOND,
            "splits": {"train": format!("0:{}", self.episodes)},
            "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
            "video_path": null,
            "features": features(self.shape.unwrap_or_default()),
        });
        let path = self.folder.join("meta/info.json");
        fs::write(&path, serde_json::to_string_pretty(&info)?)
            .with_context(|| path.display().to_string())
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
        "action": {"feature": value("float32"), "length": ACTION.len(), "_type": "Sequence"},
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
        let schema = Arc::new(parse_message_type(SCHEMA)?);
        let metadata = vec![
            KeyValue::new("huggingface".to_owned(), hugging_face().to_string()),
            KeyValue::new("lerobot_features".to_owned(), features.to_string()),
        ];
        let properties = WriterProperties::builder()
            .set_compression(Compression::SNAPPY)
            .set_key_value_metadata(Some(metadata))
            .build();
        let file = File::create_new(path).with_context(|| path.display().to_string())?;
        let mut file = SerializedFileWriter::new(file, schema, Arc::new(properties))?;
        let mut group = file.next_row_group()?;
        let count = self.rewards.len();
        let bytes = |bytes: &[u8]| ByteArray::from(bytes.to_vec());
        let pictures: Vec<_> = self.pictures.iter().map(|picture| bytes(picture)).collect();
        let names: Vec<_> = self
            .names
            .iter()
            .map(|name| bytes(name.as_bytes()))
            .collect();
        column::<ByteArrayType>(&mut group, &pictures, None)?;
        column::<ByteArrayType>(&mut group, &names, None)?;
        // A list begins at repetition level 0 and goes on at 1.
        let repetition = (0..count * ACTION.len()).map(|index| i16::from(index % ACTION.len() > 0));
        let repetition: Vec<i16> = repetition.collect();
        column::<FloatType>(&mut group, &self.actions.concat(), Some(&repetition))?;
        column::<FloatType>(&mut group, &self.timestamps(), None)?;
        let numbers = |first: usize, step: usize| -> Vec<i64> {
            (0..count)
                .map(|index| (first + step * index) as i64)
                .collect()
        };
        column::<Int64Type>(&mut group, &numbers(0, 1), None)?;
        column::<Int64Type>(&mut group, &numbers(place.episode, 0), None)?;
        column::<Int64Type>(&mut group, &numbers(place.first, 1), None)?;
        column::<Int64Type>(&mut group, &numbers(place.task, 0), None)?;
        column::<FloatType>(&mut group, &self.rewards, None)?;
        let done: Vec<bool> = (1..=count).map(|number| number == count).collect();
        column::<BoolType>(&mut group, &done, None)?;
        group.close()?;
        file.close()?;
        Ok(())
    }

    fn timestamps(&self) -> Vec<f32> {
        let seconds = |index| index as f32 / FRAMES_PER_SECOND as f32;
        (0..self.rewards.len()).map(seconds).collect()
    }

    /// Least, largest, mean and deviation of every column, as LeRobot keeps them by episode.
    fn statistics(&self, place: &Place) -> Result<Value> {
        let count = self.rewards.len();
        let one = |value: &dyn Fn(usize) -> f64| {
            let values: Vec<f64> = (0..count).map(value).collect();
            moments(&values)
        };
        let of = |columns: Vec<[f64; 4]>, wrap: &dyn Fn(f64) -> Value| {
            let field = |index: usize| {
                columns
                    .iter()
                    .map(|moments| wrap(moments[index]))
                    .collect::<Vec<_>>()
            };
            json!({"min": field(0), "max": field(1), "mean": field(2), "std": field(3), "count": [count]})
        };
        let plain = |value: f64| json!(value);
        let mut channels: [Vec<f64>; 3] = Default::default();
        for picture in &self.pictures {
            let picture = image::load_from_memory(picture)?.to_rgb8();
            for pixel in picture.pixels() {
                for (channel, value) in channels.iter_mut().zip(pixel.0) {
                    channel.push(f64::from(value) / 255.0);
                }
            }
        }
        // Channels first, with a row and a column of one.
        let picture = of(
            channels.iter().map(|channel| moments(channel)).collect(),
            &|value| json!([[value]]),
        );
        let actions =
            (0..ACTION.len()).map(|axis| one(&|index| f64::from(self.actions[index][axis])));
        let last = count.saturating_sub(1);
        Ok(json!({
            IMAGE: picture,
            "action": of(actions.collect(), &plain),
            "timestamp": of(vec![one(&|index| index as f64 / f64::from(FRAMES_PER_SECOND))], &plain),
            "frame_index": of(vec![one(&|index| index as f64)], &plain),
            "episode_index": of(vec![one(&|_| place.episode as f64)], &plain),
            "index": of(vec![one(&|index| (place.first + index) as f64)], &plain),
            "task_index": of(vec![one(&|_| place.task as f64)], &plain),
            "next.reward": of(vec![one(&|index| f64::from(self.rewards[index]))], &plain),
            "next.done": of(vec![one(&|index| f64::from(u8::from(index == last)))], &plain),
        }))
    }
}

/// Least, largest, mean, standard deviation.
fn moments(values: &[f64]) -> [f64; 4] {
    let count = values.len().max(1) as f64;
    let mean = values.iter().sum::<f64>() / count;
    let variance = values
        .iter()
        .map(|value| (value - mean).powi(2))
        .sum::<f64>()
        / count;
    let least = values.iter().copied().fold(f64::INFINITY, f64::min);
    let largest = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    [least, largest, mean, variance.sqrt()]
}

fn column<T: DataType>(
    group: &mut SerializedRowGroupWriter<'_, File>,
    values: &[T::T],
    repetition: Option<&[i16]>,
) -> Result<()> {
    let mut writer = group
        .next_column()?
        .context("the schema has fewer columns")?;
    // Every element of a list is there.
    let definition = repetition.map(|repetition| vec![1; repetition.len()]);
    writer
        .typed::<T>()
        .write_batch(values, definition.as_deref(), repetition)?;
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
