//! rosbag2's own compression (zstd), of whole files and of single messages, beside what a storage does.

use crate::BagError;
use crate::metadata::Metadata;
use crate::scan::MAX_RECORD_BYTES;
use std::borrow::Cow;
use std::ffi::OsStr;
use std::fs::File;
use std::io::{BufReader, Read, Write};
use std::path::{Path, PathBuf};
use tempfile::NamedTempFile;

/// What every frame of zstd begins with. No CDR does: its first byte is 0.
const MAGIC: [u8; 4] = [0x28, 0xb5, 0x2f, 0xfd];
/// Bytes that are held while a file is uncompressed.
const COPY_BYTES: usize = 1 << 16;

/// How the data of each message is compressed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Packing {
    /// Recognised by its first bytes; the metadata does not name it.
    Undeclared,
    /// As `metadata.yaml` says.
    Zstd,
}

impl Packing {
    /// As `metadata.yaml` says, if there is one.
    pub fn declared(metadata: Option<&Metadata>) -> Self {
        let mode = metadata.map(|metadata| metadata.compression_mode.to_lowercase());
        if mode.as_deref() == Some("message") {
            Self::Zstd
        } else {
            Self::Undeclared
        }
    }

    /// A message of that encoding as it was before.
    pub fn open(self, encoding: &str, data: &[u8]) -> Result<Option<Vec<u8>>, String> {
        if self == Self::Undeclared && !(encoding == "cdr" && data.starts_with(&MAGIC)) {
            return Ok(None);
        }
        let mut opened = Vec::new();
        zstd::stream::read::Decoder::new(data)
            .and_then(|decoder| decoder.take(MAX_RECORD_BYTES + 1).read_to_end(&mut opened))
            .map_err(|error| error.to_string())?;
        if opened.len() as u64 > MAX_RECORD_BYTES {
            return Err(format!("more than {MAX_RECORD_BYTES} bytes"));
        }
        Ok(Some(opened))
    }

    /// The same, without a copy of what was not compressed.
    pub fn open_cow<'a>(self, encoding: &str, data: &'a [u8]) -> Result<Cow<'a, [u8]>, String> {
        let opened = self.open(encoding, data)?;
        Ok(opened.map_or(Cow::Borrowed(data), Cow::Owned))
    }
}

/// A file of a bag, uncompressed if it was compressed as a whole.
pub(crate) struct Unpacked {
    /// Its uncompressed contents.
    pub path: PathBuf,
    /// Why they end early, if they do.
    pub cut: Option<String>,
    /// Removed with it.
    _temporary: Option<NamedTempFile>,
}

/// `NAME.mcap` of `NAME.mcap.zstd`; none if it is not compressed as a whole.
pub(crate) fn inner_name(path: &Path) -> Option<PathBuf> {
    (path.extension() == Some(OsStr::new("zstd"))).then(|| path.with_extension(""))
}

/// Uncompresses a file into the folder for temporary files (`TMPDIR`) if it is compressed as a whole. Damage is no error: what
/// comes before it is there.
pub(crate) fn unpack(path: &Path) -> Result<Unpacked, BagError> {
    let Some(inner) = inner_name(path) else {
        return Ok(Unpacked {
            path: path.to_owned(),
            cut: None,
            _temporary: None,
        });
    };
    let io = |error| BagError::io(path, error);
    let mut ending = std::ffi::OsString::from(".");
    ending.push(inner.extension().unwrap_or(OsStr::new("mcap")));
    let mut temporary = tempfile::Builder::new()
        .suffix(&ending)
        .tempfile()
        .map_err(io)?;
    let file = BufReader::new(File::open(path).map_err(io)?);
    let mut decoder = zstd::stream::read::Decoder::with_buffer(file).map_err(io)?;
    let mut buffer = vec![0; COPY_BYTES];
    let mut cut = None;
    loop {
        match decoder.read(&mut buffer) {
            Ok(0) => break,
            Ok(count) => {
                let written = temporary.write_all(&buffer[..count]);
                written.map_err(|error| BagError::io(temporary.path(), error))?;
            }
            Err(error) if error.kind() == std::io::ErrorKind::Interrupted => {}
            Err(error) => {
                cut = Some(error.to_string());
                break;
            }
        }
    }
    temporary
        .flush()
        .map_err(|error| BagError::io(temporary.path(), error))?;
    Ok(Unpacked {
        path: temporary.path().to_owned(),
        cut,
        _temporary: Some(temporary),
    })
}
