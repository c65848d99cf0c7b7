//! Encodes the volume as the bytes that the page reads, deflated (zlib).
//!
//! First a byte for each grid position of bricks, x fastest: the distance to the nearest brick.
//! Then one plane per channel, with a byte for every voxel of all bricks: the square root of the
//! opacity, so that haze has enough levels; red, green and blue times this root; components of view
//! dependence times this root, 128 for 0.

use std::io::Write as _;

use flate2::{Compression, write::ZlibEncoder};
use stage::Progress;

use crate::bake::Volume;
use crate::bricks::{BRICK_SIDE, Bricks, VOXELS, grid_index};
use crate::view::Components;

/// Number of components of view dependence: the channels of one texture (docs/design/042).
pub(crate) const COMPONENTS: usize = 4;
/// Number of a voxel's channels.
const CHANNELS: usize = 4 + COMPONENTS;

/// Bytes that are deflated between two updates of the progress.
const BYTES_PER_STEP: usize = 1 << 20;

/// A packed volume.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Atlas {
    /// Number of bricks.
    pub(crate) bricks: usize,
    pub(crate) components: Components,
    /// Deflated content.
    pub(crate) bytes: Vec<u8>,
}

impl Atlas {
    /// Packs a volume; `progress_of` starts the progress over the given number of bytes.
    pub(crate) fn pack(
        volume: &Volume,
        progress_of: impl FnOnce(u64) -> Progress,
    ) -> std::io::Result<Self> {
        let side = volume.resolution / BRICK_SIDE;
        let mut is_kept = vec![false; side * side * side];
        for voxel in &volume.voxels {
            let brick = voxel.position.map(|c| usize::from(c) / BRICK_SIDE);
            is_kept[grid_index(brick, side)] = true;
        }
        let bricks = Bricks::new(volume.resolution, |brick| is_kept[grid_index(brick, side)]);
        let components =
            Components::of(volume.voxels.iter().map(|v| (&v.view, v.opacity)), COMPONENTS);
        let mut encoder = ZlibEncoder::new(Vec::new(), Compression::best());
        encoder.write_all(&bricks.distances())?;
        let planes = planes(volume, &bricks, &components);
        let progress = progress_of(planes.len() as u64);
        for part in planes.chunks(BYTES_PER_STEP) {
            encoder.write_all(part)?;
            progress.add(part.len() as u64);
        }
        Ok(Self { bricks: bricks.len(), components, bytes: encoder.finish()? })
    }
}

/// Returns all channels of all voxels.
fn planes(volume: &Volume, bricks: &Bricks, components: &Components) -> Vec<u8> {
    let count = bricks.len() * VOXELS;
    let mut planes = vec![0; 4 * count];
    planes.resize(CHANNELS * count, 128);
    for voxel in &volume.voxels {
        let Some(i) = bricks.voxel_index(voxel.position.map(usize::from)) else { continue };
        planes[i] = to_byte(voxel.opacity.sqrt());
        // Root after rounding, which the page divides by.
        let root = f32::from(planes[i]) / 255.0;
        for c in 0..3 {
            planes[(1 + c) * count + i] = to_byte(root * voxel.colour[c]);
        }
        for (k, value) in components.project(&voxel.view).enumerate() {
            planes[(4 + k) * count + i] = (128.0 + 127.0 * root * value).round() as u8;
        }
    }
    planes
}

fn to_byte(level: f32) -> u8 {
    (255.0 * level.max(0.0).min(1.0)).round() as u8
}

#[cfg(test)]
mod tests {
    use std::io::Read as _;

    use super::*;
    use crate::bake::tests::{Ball, bake};

    fn packed() -> (Volume, Atlas) {
        let ball = Ball { radius: 0.3, density: 200.0 };
        let volume = bake(vec![ball], 64);
        let atlas = Atlas::pack(&volume, |_| Progress::silent()).unwrap();
        (volume, atlas)
    }

    /// Every voxel is decoded from the bytes, within the rounding of a byte.
    #[test]
    fn bytes_encode_the_voxels() {
        let (volume, atlas) = packed();
        let mut bytes = Vec::new();
        flate2::read::ZlibDecoder::new(&atlas.bytes[..]).read_to_end(&mut bytes).unwrap();
        let (distances, planes) = bytes.split_at(8 * 8 * 8);
        assert_eq!(planes.len(), CHANNELS * VOXELS * atlas.bricks);
        let bricks = Bricks::new(64, |[x, y, z]| distances[x + 8 * (y + 8 * z)] == 0);
        assert_eq!((bricks.len(), &bricks.distances()[..]), (atlas.bricks, distances));
        let count = atlas.bricks * VOXELS;
        let mut opaque = 0;
        for voxel in &volume.voxels {
            let index = bricks.voxel_index(voxel.position.map(usize::from)).unwrap();
            let byte = |plane: usize| f32::from(planes[plane * count + index]);
            opaque += usize::from(byte(0) > 0.0);
            assert!((byte(0) / 255.0 - voxel.opacity.sqrt()).abs() < 0.51 / 255.0);
            let root = byte(0) / 255.0;
            for c in 0..3 {
                let expected = root * voxel.colour[c];
                assert!((byte(1 + c) / 255.0 - expected).abs() < 0.51 / 255.0);
            }
            for (k, value) in atlas.components.project(&voxel.view).enumerate() {
                let found = (byte(4 + k) - 128.0) / 127.0;
                assert!((found - root * value).abs() < 0.51 / 127.0);
            }
        }
        assert!(opaque == volume.voxels.len() && opaque > 0);
        // All other voxels are empty.
        assert_eq!(planes[..count].iter().filter(|&&opacity| opacity > 0).count(), opaque);
    }

    /// A ball's surface needs less than 8 bytes per voxel, and packing is deterministic.
    #[test]
    fn atlases_are_small_and_deterministic() {
        let (volume, atlas) = packed();
        assert!(atlas.bytes.len() < 8 * volume.voxels.len(), "{}", atlas.bytes.len());
        assert!(packed().1 == atlas);
    }
}
