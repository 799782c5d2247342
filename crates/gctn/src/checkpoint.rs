//! Checkpoints: one safetensors file with the weights, and in its metadata the configuration and what its
//! maker says about it. Nothing is ever unpickled.

use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, TensorView};
use std::collections::{BTreeMap, HashMap};
use std::io::Write;
use std::path::{Path, PathBuf};
use tch::{Kind, Tensor};

use crate::network::{Builder, Model, Parameters};
use crate::{Calibration, Error, NetworkConfig, Precision};

/// What the maker of a checkpoint says about it: title to text.
pub type ModelCard = BTreeMap<String, String>;

/// How weights are stored on disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Storage {
    /// As they are.
    F32,
    /// Rounded to 16-bit floats: half the size.
    F16,
}

const FORMAT: &str = "gctn-checkpoint";
const VERSION: &str = "1";

const CALIBRATION: &str = "calibration";

/// A file of this crate, read into memory.
pub(crate) struct File {
    path: PathBuf,
    bytes: Vec<u8>,
    head: BTreeMap<String, String>,
}

/// The one key of a file's metadata, whose value is a JSON object of texts: the order of several keys
/// would differ from file to file.
const HEAD: &str = "gctn";

impl File {
    /// Reads a file and checks that it is a whole one of the given format and version.
    pub fn read(path: &Path, format: &str, version: &str) -> Result<Self, Error> {
        let bytes = std::fs::read(path).map_err(|source| Error::Io {
            path: path.into(),
            source,
        })?;
        let file = Self {
            path: path.into(),
            head: BTreeMap::new(),
            bytes,
        };
        let (_, header) = SafeTensors::read_metadata(&file.bytes).map_err(|error| {
            file.error(format!("no safetensors file, or a truncated one: {error}"))
        })?;
        SafeTensors::deserialize(&file.bytes)
            .map_err(|error| file.error(format!("a truncated safetensors file: {error}")))?;
        let head = header
            .metadata()
            .as_ref()
            .and_then(|metadata| metadata.get(HEAD));
        let head = head.ok_or_else(|| {
            file.error(format!("no {HEAD:?} in its metadata: not of this program"))
        })?;
        let head = serde_json::from_str(head)
            .map_err(|error| file.error(format!("{HEAD:?} in its metadata: {error}")))?;
        let file = Self { head, ..file };
        for (key, expected) in [("format", format), ("version", version)] {
            let actual = file.text(key)?;
            if actual != expected {
                return Err(file.error(format!("{key} is {actual:?}, expected {expected:?}")));
            }
        }
        Ok(file)
    }

    pub fn error(&self, problem: String) -> Error {
        Error::Checkpoint {
            path: self.path.clone(),
            problem,
        }
    }

    fn tensor_error(&self, tensor: &str, problem: String) -> Error {
        Error::CheckpointTensor {
            path: self.path.clone(),
            tensor: tensor.into(),
            problem,
        }
    }

    /// A text of the head.
    pub fn text(&self, key: &str) -> Result<&str, Error> {
        let text = self.head.get(key).map(String::as_str);
        text.ok_or_else(|| self.error(format!("no {key:?} in its head")))
    }

    /// The calibration of a network's file, if it has one.
    pub fn calibration(&self) -> Result<Option<Calibration>, Error> {
        match self.head.contains_key(CALIBRATION) {
            true => self.json(CALIBRATION).map(Some),
            false => Ok(None),
        }
    }

    /// A value of the head that is JSON.
    pub fn json<T: serde::de::DeserializeOwned>(&self, key: &str) -> Result<T, Error> {
        serde_json::from_str(self.text(key)?)
            .map_err(|error| self.error(format!("{key:?} in its head: {error}")))
    }

    /// Fills tensors from those of the same names. Refuses missing, further and misshapen ones, and
    /// numbers that are not finite.
    pub fn fill(&self, entries: &[(String, Tensor)]) -> Result<(), Error> {
        let tensors =
            SafeTensors::deserialize(&self.bytes).map_err(|error| self.error(error.to_string()))?;
        let mut names = tensors.names();
        names.sort_unstable();
        if let Some(name) = names
            .iter()
            .find(|name| !entries.iter().any(|(known, _)| known == *name))
        {
            return Err(self.tensor_error(name, "the configured network has no such tensor".into()));
        }
        for (name, target) in entries {
            let view = tensors.tensor(name).map_err(|_| {
                self.tensor_error(name, "missing, though the configured network has it".into())
            })?;
            let shape: Vec<i64> = view.shape().iter().map(|size| *size as i64).collect();
            if shape != target.size() {
                let problem = format!("shape {shape:?}, expected {:?}", target.size());
                return Err(self.tensor_error(name, problem));
            }
            let kind = match view.dtype() {
                Dtype::F16 => Kind::Half,
                Dtype::F32 => Kind::Float,
                other => {
                    return Err(
                        self.tensor_error(name, format!("type {other:?}, expected F32 or F16"))
                    );
                }
            };
            let source =
                Tensor::f_from_data_size(view.data(), &shape, kind)?.to_kind(target.kind());
            if source.isfinite().all().int64_value(&[]) == 0 {
                return Err(self.tensor_error(name, "has numbers that are not finite".into()));
            }
            tch::no_grad(|| target.shallow_clone().f_copy_(&source))?;
        }
        Ok(())
    }
}

/// Writes tensors and head, so that the file appears whole or not at all.
pub(crate) fn write(
    path: &Path,
    storage: Storage,
    entries: &[(String, Tensor)],
    head: &BTreeMap<&str, String>,
) -> Result<(), Error> {
    let (kind, dtype) = match storage {
        Storage::F32 => (Kind::Float, Dtype::F32),
        Storage::F16 => (Kind::Half, Dtype::F16),
    };
    let mut data = Vec::new();
    for (name, tensor) in entries {
        let tensor = tensor
            .detach()
            .to_kind(kind)
            .to_device(tch::Device::Cpu)
            .contiguous();
        if tensor.isfinite().all().int64_value(&[]) == 0 {
            return Err(Error::CheckpointTensor {
                path: path.into(),
                tensor: name.clone(),
                problem: format!("not written: it has numbers that are not finite in {dtype:?}"),
            });
        }
        let mut bytes = vec![0; tensor.numel() * kind.elt_size_in_bytes()];
        tensor.f_copy_data_u8(&mut bytes, tensor.numel())?;
        let shape: Vec<usize> = tensor.size().iter().map(|size| *size as usize).collect();
        data.push((name.as_str(), shape, bytes));
    }
    let problem = |error: safetensors::SafeTensorError| Error::Checkpoint {
        path: path.into(),
        problem: error.to_string(),
    };
    let views: Vec<_> = data
        .iter()
        .map(|(name, shape, bytes)| Ok((*name, TensorView::new(dtype, shape.clone(), bytes)?)))
        .collect::<Result<_, _>>()
        .map_err(problem)?;
    let metadata = HashMap::from([(HEAD.to_owned(), json(head))]);
    let bytes = safetensors::serialize(views, Some(metadata)).map_err(problem)?;
    write_whole(path, &bytes).map_err(|source| Error::Io {
        path: path.into(),
        source,
    })
}

/// Writes beside the file, then puts it in its place: a full disk leaves the old file as it was.
fn write_whole(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(".part");
    let part = path.with_file_name(name);
    let written = std::fs::File::create(&part).and_then(|mut file| {
        file.write_all(bytes)?;
        file.sync_all()
    });
    written
        .and_then(|()| std::fs::rename(&part, path))
        .inspect_err(|_| {
            // The error that matters is the first one.
            let _ = std::fs::remove_file(&part);
        })
}

/// Writes a network.
pub(crate) fn save(
    path: &Path,
    storage: Storage,
    config: &NetworkConfig,
    parameters: &Parameters,
    card: &ModelCard,
) -> Result<(), Error> {
    let head = head(
        FORMAT,
        VERSION,
        [("network", json(config)), ("card", json(card))],
    );
    write(path, storage, &parameters.entries, &head)
}

/// Writes a copy of a checkpoint that says how likely its decisions are to earn their steps. The weights stay as they are.
pub fn calibrate(from: &Path, to: &Path, calibration: &Calibration) -> Result<(), Error> {
    let file = File::read(from, FORMAT, VERSION)?;
    let tensors =
        SafeTensors::deserialize(&file.bytes).map_err(|error| file.error(error.to_string()))?;
    let mut head = file.head.clone();
    head.insert(CALIBRATION.into(), json(calibration));
    let metadata = HashMap::from([(HEAD.to_owned(), json(&head))]);
    let bytes = safetensors::serialize(tensors.tensors(), Some(metadata))
        .map_err(|error| file.error(error.to_string()))?;
    write_whole(to, &bytes).map_err(|source| Error::Io {
        path: to.into(),
        source,
    })
}

/// Writes the mean of the weights of checkpoints of one network, in 16-bit floats, with the card of the last one: what a training
/// at a constant learning rate wanders about (stochastic weight averaging, Izmailov et al., UAI 2018).
pub fn average(from: &[PathBuf], to: &Path) -> Result<(), Error> {
    let Some(last) = from.last() else {
        return Err(Error::Config {
            what: "checkpoints to average",
            actual: "0".into(),
            expected: "at least 1",
        });
    };
    let (_, config, mut card) = open(last)?;
    let weights = || {
        let builder = Builder::empty(tch::Device::Cpu);
        Model::new(&config, builder, Precision::F32).parameters
    };
    let mean = weights();
    for path in from {
        let (file, other, _) = open(path)?;
        if other != config {
            let [other, config] = [&other, &config].map(json);
            return Err(file.error(format!("it is of the network {other}, expected {config}")));
        }
        let one = weights();
        file.fill(&one.entries)?;
        let share = one.flat / from.len() as f64;
        let _ = tch::no_grad(|| mean.flat.shallow_clone().f_add_(&share))?;
    }
    card.insert("mean of".into(), format!("{} snapshots", from.len()));
    save(to, Storage::F16, &config, &mean, &card)
}

/// Reads the head of a network's file: its configuration and its card.
pub(crate) fn open(path: &Path) -> Result<(File, NetworkConfig, ModelCard), Error> {
    let file = File::read(path, FORMAT, VERSION)?;
    let config: NetworkConfig = file.json("network")?;
    config
        .check()
        .map_err(|error| file.error(format!("\"network\" in its head: {error}")))?;
    let card = file.json("card")?;
    Ok((file, config, card))
}

/// Head of a file.
pub(crate) fn head<'a, const N: usize>(
    format: &str,
    version: &str,
    texts: [(&'a str, String); N],
) -> BTreeMap<&'a str, String> {
    let head = [("format", format.into()), ("version", version.into())];
    head.into_iter().chain(texts).collect()
}

/// A value as JSON.
pub(crate) fn json<T: serde::Serialize>(value: &T) -> String {
    // Our own types have string keys and finite numbers only: nothing here can fail.
    serde_json::to_string(value).unwrap_or_default()
}
