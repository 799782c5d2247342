//! Images of demonstrations in memory: compressed, and the ones used last decoded as well.

use heightmap::{Heightmap, Workspace};
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

/// Fast, and within a tenth of the size of the slow levels.
const LEVEL: i32 = 1;

/// Index of an image in its store.
pub(crate) type ImageId = usize;

/// Heightmaps, compressed without loss. Decoded ones are kept within a bound, the one used longest ago goes first.
#[derive(Debug)]
pub(crate) struct ImageStore {
    packed: Vec<Packed>,
    decoded: Mutex<Decoded>,
    bound_bytes: usize,
}

#[derive(Debug)]
struct Packed {
    workspace: Workspace,
    bytes: Vec<u8>,
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
    /// An empty store that keeps at most so many bytes of decoded images.
    pub fn new(bound_bytes: usize) -> Self {
        Self {
            packed: Vec::new(),
            decoded: Mutex::default(),
            bound_bytes,
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
        self.packed.push(Packed {
            workspace: heightmap.workspace,
            bytes: zstd::bulk::compress(&bytes, LEVEL)?,
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
        let image = Arc::new(self.packed[id].open()?);
        let bytes = bytes_of(&image);
        while decoded.bytes + bytes > self.bound_bytes {
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

    /// Bytes of the compressed images.
    pub fn packed_bytes(&self) -> usize {
        self.packed.iter().map(|packed| packed.bytes.len()).sum()
    }

    /// Bytes of the decoded images that are kept.
    #[cfg(test)]
    fn decoded_bytes(&self) -> usize {
        let decoded = self.decoded.lock().unwrap_or_else(PoisonError::into_inner);
        decoded.bytes
    }
}

impl Packed {
    fn open(&self) -> std::io::Result<Heightmap> {
        let mut heightmap = Heightmap::new(self.workspace);
        let cells = heightmap.height_m.len();
        let bytes = zstd::bulk::decompress(&self.bytes, bytes_of(&heightmap))?;
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
    fn images_come_back_bit_for_bit_within_the_bound() {
        const BYTES: usize = 16 * 8 * 7;
        for (bound_bytes, kept) in [(usize::MAX, 5), (2 * BYTES + 1, 2), (0, 0)] {
            let mut store = ImageStore::new(bound_bytes);
            for mark in 0..5 {
                assert_eq!(store.add(&image(mark)).unwrap(), mark);
            }
            for mark in [0, 4, 0, 1, 2, 3, 0] {
                assert_eq!(*store.get(mark).unwrap(), image(mark));
                assert!(store.decoded_bytes() <= bound_bytes);
            }
            assert_eq!(store.decoded_bytes(), kept * BYTES);
        }
    }
}
