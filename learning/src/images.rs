//! Images of demonstrations: compressed in memory or in a file, and the ones used last decoded.

use heightmap::{Heightmap, Workspace};
use std::borrow::Cow;
use std::collections::HashMap;
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

/// Fast, and within a tenth of the size of the slow levels.
const LEVEL: i32 = 1;

/// Index of an image in its store.
pub(crate) type ImageId = usize;

/// How much memory the images of a data set take.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ImageMemory {
    /// Most MB of images that are kept decoded.
    pub decoded_mb: usize,
    /// Most MB of compressed images that are kept in memory; the others lie in a file.
    pub compressed_mb: usize,
}

impl Default for ImageMemory {
    fn default() -> Self {
        Self {
            decoded_mb: 512,
            compressed_mb: 2000,
        }
    }
}

/// Heightmaps, compressed without loss. Decoded ones are kept within a bound, the one used longest ago goes first.
#[derive(Debug)]
pub(crate) struct ImageStore {
    packed: Vec<Packed>,
    decoded: Mutex<Decoded>,
    decoded_bound: usize,
    /// Bytes of compressed images in memory.
    compressed_bytes: usize,
    compressed_bound: usize,
    overflow: Overflow,
    buffer: Vec<u8>,
}

/// Compressed images beyond the bound, one after the other in a file without a name, which disappears with the process.
#[derive(Debug)]
struct Overflow {
    /// Where the file is made when it is needed.
    folder: PathBuf,
    file: Option<File>,
    bytes: u64,
}

impl Overflow {
    fn append(&mut self, bytes: &[u8]) -> std::io::Result<Place> {
        let file = match &self.file {
            Some(file) => file,
            None => {
                std::fs::create_dir_all(&self.folder)?;
                self.file.insert(tempfile::tempfile_in(&self.folder)?)
            }
        };
        file.write_all_at(bytes, self.bytes)?;
        let place = Place::File {
            offset: self.bytes,
            len: bytes.len(),
        };
        self.bytes += bytes.len() as u64;
        Ok(place)
    }

    fn read(&self, offset: u64, len: usize) -> std::io::Result<Vec<u8>> {
        let mut bytes = vec![0; len];
        match &self.file {
            Some(file) => file.read_exact_at(&mut bytes, offset)?,
            None => return Err(std::io::ErrorKind::NotFound.into()),
        }
        Ok(bytes)
    }
}

#[derive(Debug)]
struct Packed {
    workspace: Workspace,
    place: Place,
}

/// Where a compressed image lies.
#[derive(Debug)]
enum Place {
    Memory(Box<[u8]>),
    File { offset: u64, len: usize },
}

#[derive(Debug, Default)]
struct Decoded {
    /// With the time of the last use.
    images: HashMap<ImageId, (Arc<Heightmap>, u64)>,
    bytes: usize,
    time: u64,
}

fn bytes_of(heightmap: &Heightmap) -> usize {
    heightmap.rgb.len() + size_of::<f32>() * heightmap.height_m.len()
}

impl ImageStore {
    /// An empty store, which makes its file in this folder.
    pub fn new(memory: ImageMemory, folder: &Path) -> Self {
        let [decoded, compressed] =
            [memory.decoded_mb, memory.compressed_mb].map(|mb| mb.saturating_mul(1_000_000));
        Self::with_bounds(decoded, compressed, folder)
    }

    /// Bounds in bytes.
    fn with_bounds(decoded_bound: usize, compressed_bound: usize, folder: &Path) -> Self {
        Self {
            packed: Vec::new(),
            decoded: Mutex::default(),
            decoded_bound,
            compressed_bytes: 0,
            compressed_bound,
            overflow: Overflow {
                folder: folder.to_owned(),
                file: None,
                bytes: 0,
            },
            buffer: Vec::new(),
        }
    }

    /// Adds an image.
    pub fn add(&mut self, heightmap: &Heightmap) -> std::io::Result<ImageId> {
        // The four bytes of heights lie apart: high bytes are nearly all the same.
        let heights = heightmap.height_m.iter().map(|height| height.to_le_bytes());
        let heights: Vec<[u8; 4]> = heights.collect();
        let mut bytes = heightmap.rgb.clone();
        for index in 0..4 {
            bytes.extend(heights.iter().map(|height| height[index]));
        }
        // Compressed in a buffer that is used again: a vector from `zstd::bulk::compress` keeps the room of the worst case.
        self.buffer
            .resize(zstd::zstd_safe::compress_bound(bytes.len()), 0);
        let len = zstd::bulk::compress_to_buffer(&bytes, &mut self.buffer, LEVEL)?;
        let place = if self.compressed_bytes + len <= self.compressed_bound {
            self.compressed_bytes += len;
            Place::Memory(self.buffer[..len].into())
        } else {
            self.overflow.append(&self.buffer[..len])?
        };
        self.packed.push(Packed {
            workspace: heightmap.workspace,
            place,
        });
        Ok(self.packed.len() - 1)
    }

    /// An image, bit for bit as it was added.
    pub fn get(&self, id: ImageId) -> std::io::Result<Arc<Heightmap>> {
        let mut decoded = self.decoded.lock().unwrap_or_else(PoisonError::into_inner);
        decoded.time += 1;
        let now = decoded.time;
        if let Some((image, used)) = decoded.images.get_mut(&id) {
            *used = now;
            return Ok(Arc::clone(image));
        }
        let image = Arc::new(self.open(id)?);
        let bytes = bytes_of(&image);
        while decoded.bytes + bytes > self.decoded_bound {
            let oldest = decoded.images.iter().min_by_key(|(_, (_, used))| *used);
            let Some(oldest) = oldest.map(|(id, _)| *id) else {
                // Larger than the bound alone: not kept.
                return Ok(image);
            };
            if let Some((image, _)) = decoded.images.remove(&oldest) {
                decoded.bytes -= bytes_of(&image);
            }
        }
        decoded.bytes += bytes;
        decoded.images.insert(id, (Arc::clone(&image), now));
        Ok(image)
    }

    /// Bytes of the compressed images, in memory and in the file.
    pub fn compressed_bytes(&self) -> [u64; 2] {
        [self.compressed_bytes as u64, self.overflow.bytes]
    }

    /// Bytes of the decoded images that are kept.
    #[cfg(test)]
    fn decoded_bytes(&self) -> usize {
        let decoded = self.decoded.lock().unwrap_or_else(PoisonError::into_inner);
        decoded.bytes
    }
}

impl ImageStore {
    fn open(&self, id: ImageId) -> std::io::Result<Heightmap> {
        let Packed { workspace, place } = &self.packed[id];
        let bytes = match place {
            Place::Memory(bytes) => Cow::Borrowed(&**bytes),
            Place::File { offset, len } => Cow::Owned(self.overflow.read(*offset, *len)?),
        };
        let mut heightmap = Heightmap::new(*workspace);
        let cells = heightmap.height_m.len();
        let bytes = zstd::bulk::decompress(&bytes, bytes_of(&heightmap))?;
        let (rgb, heights) = bytes.split_at(3 * cells);
        heightmap.rgb.copy_from_slice(rgb);
        for (index, height) in heightmap.height_m.iter_mut().enumerate() {
            let byte = |plane: usize| heights[plane * cells + index];
            *height = f32::from_le_bytes([byte(0), byte(1), byte(2), byte(3)]);
        }
        Ok(heightmap)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(mark: usize) -> Heightmap {
        let mut heightmap = Heightmap::new(Workspace {
            rows: 16,
            cols: 8,
            ..Workspace::RAVENS
        });
        for (index, byte) in heightmap.rgb.iter_mut().enumerate() {
            *byte = (index * mark) as u8;
        }
        for (index, height_m) in heightmap.height_m.iter_mut().enumerate() {
            *height_m = (index * mark) as f32 * 1.37e-4 - 0.002;
        }
        heightmap
    }

    #[test]
    fn images_come_back_bit_for_bit_within_the_bounds() {
        const BYTES: usize = 16 * 8 * 7;
        let folder = tempfile::tempdir().unwrap();
        let all = {
            let mut store = ImageStore::with_bounds(0, usize::MAX, folder.path());
            (0..5).for_each(|mark| assert_eq!(store.add(&image(mark)).unwrap(), mark));
            store.compressed_bytes()[0]
        };
        for (decoded_bound, kept) in [(usize::MAX, 5), (2 * BYTES + 1, 2), (0, 0)] {
            for compressed_bound in [usize::MAX, all as usize / 2, 0] {
                let mut store =
                    ImageStore::with_bounds(decoded_bound, compressed_bound, folder.path());
                for mark in 0..5 {
                    assert_eq!(store.add(&image(mark)).unwrap(), mark);
                }
                for mark in [0, 4, 0, 1, 2, 3, 0] {
                    assert_eq!(*store.get(mark).unwrap(), image(mark));
                    assert!(store.decoded_bytes() <= decoded_bound);
                }
                assert_eq!(store.decoded_bytes(), kept * BYTES);
                let [memory, file] = store.compressed_bytes();
                assert!(memory <= compressed_bound as u64);
                assert_eq!(memory + file, all);
                assert_eq!(file == 0, compressed_bound == usize::MAX);
                // The file has no name.
                assert_eq!(folder.path().read_dir().unwrap().count(), 0);
            }
        }
    }

    #[test]
    fn a_folder_that_holds_no_file_is_an_error() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let mut store = ImageStore::with_bounds(0, 0, &file.path().join("folder"));
        assert!(store.add(&image(1)).is_err());
    }
}
