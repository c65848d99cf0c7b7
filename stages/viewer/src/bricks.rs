//! Sparse grid of voxels over the unit cube: bricks of 8³ voxels where density is possible.

/// Voxels along a brick's side.
pub(crate) const BRICK_SIDE: usize = 8;
/// Number of voxels in a brick.
pub(crate) const VOXELS: usize = BRICK_SIDE * BRICK_SIDE * BRICK_SIDE;
/// Index at a grid position without brick.
const NO_BRICK: u32 = u32::MAX;

/// Existing bricks of a grid of `resolution`³ voxels. Voxel (x, y, z) has its centre at
/// (x + 0.5, y + 0.5, z + 0.5) / resolution. Bricks are numbered in the order of their positions, x
/// fastest; so are voxels in a brick.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Bricks {
    pub(crate) resolution: usize,
    /// Index of the brick at each grid position, or [`NO_BRICK`].
    indices: Vec<u32>,
    /// Grid position of each brick.
    positions: Vec<[usize; 3]>,
}

impl Bricks {
    /// Creates the bricks whose grid position fulfils a condition.
    ///
    /// # Panics
    /// When the resolution isn't a multiple of [`BRICK_SIDE`].
    pub(crate) fn new(resolution: usize, is_kept: impl Fn([usize; 3]) -> bool) -> Self {
        assert_eq!(resolution % BRICK_SIDE, 0, "whole bricks");
        let mut bricks = Self { resolution, indices: Vec::new(), positions: Vec::new() };
        let grid_side = bricks.bricks_per_side();
        for i in 0..grid_side * grid_side * grid_side {
            let position = [i % grid_side, i / grid_side % grid_side, i / (grid_side * grid_side)];
            if is_kept(position) {
                bricks.indices.push(bricks.positions.len() as u32);
                bricks.positions.push(position);
            } else {
                bricks.indices.push(NO_BRICK);
            }
        }
        bricks
    }

    /// Returns the number of bricks along the grid's side.
    pub(crate) fn bricks_per_side(&self) -> usize {
        self.resolution / BRICK_SIDE
    }

    /// Returns the number of bricks.
    pub(crate) fn len(&self) -> usize {
        self.positions.len()
    }

    /// Returns the bricks' grid positions, in their order.
    pub(crate) fn brick_positions(&self) -> &[[usize; 3]] {
        &self.positions
    }

    /// Returns the index of the brick at a grid position, if any.
    pub(crate) fn brick_index(&self, [x, y, z]: [usize; 3]) -> Option<usize> {
        let grid_side = self.bricks_per_side();
        let index = self.indices[x + grid_side * (y + grid_side * z)];
        (index != NO_BRICK).then_some(index as usize)
    }

    /// Returns the index of a voxel among those of all bricks; `None` outside of bricks.
    pub(crate) fn voxel_index(&self, position: [usize; 3]) -> Option<usize> {
        let brick = self.brick_index(position.map(|c| c / BRICK_SIDE))?;
        let [x, y, z] = position.map(|c| c % BRICK_SIDE);
        Some(brick * VOXELS + x + BRICK_SIDE * (y + BRICK_SIDE * z))
    }

    /// Returns the position of a voxel by its index.
    pub(crate) fn voxel_position(&self, voxel: usize) -> [usize; 3] {
        let [x, y, z] = self.positions[voxel / VOXELS].map(|c| c * BRICK_SIDE);
        let i = voxel % VOXELS;
        [x + i % BRICK_SIDE, y + i / BRICK_SIDE % BRICK_SIDE, z + i / (BRICK_SIDE * BRICK_SIDE)]
    }

    /// Returns the distance from each grid position to the nearest brick: the maximum of the
    /// differences along the axes, 0 in a brick, at most 255.
    pub(crate) fn distances(&self) -> Vec<u8> {
        let grid_side = self.bricks_per_side();
        let mut distances: Vec<u8> =
            self.indices.iter().map(|&index| if index == NO_BRICK { 255 } else { 0 }).collect();
        // Each pass takes the minimum over the 26 neighbours, one axis after the other, plus 1.
        // Passes repeat until nothing changes.
        for _ in 0..grid_side {
            let mut next = distances.clone();
            for axis in 0..3 {
                let before = next.clone();
                let step = grid_side.pow(axis);
                for (i, value) in next.iter_mut().enumerate() {
                    let along = i / step % grid_side;
                    let low = if along > 0 { before[i - step] } else { 255 };
                    let high = if along + 1 < grid_side { before[i + step] } else { 255 };
                    *value = (*value).min(low).min(high);
                }
            }
            // `next` is now the minimum within one step along all axes.
            for (i, value) in next.iter_mut().enumerate() {
                *value = distances[i].min(value.saturating_add(1));
            }
            if next == distances {
                break;
            }
            distances = next;
        }
        distances
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn voxels_have_indices_and_positions() {
        let bricks = Bricks::new(32, |[x, y, z]| (x + y + z) % 3 == 1);
        assert_eq!((bricks.bricks_per_side(), bricks.len()), (4, 21));
        for voxel in 0..bricks.len() * VOXELS {
            assert_eq!(bricks.voxel_index(bricks.voxel_position(voxel)), Some(voxel));
        }
        assert_eq!(bricks.voxel_index([7, 7, 7]), None);
        assert!(bricks.voxel_index([8, 7, 7]).is_some());
    }

    #[test]
    fn distances_are_those_to_the_nearest_brick() {
        let kept = [[1, 2, 3], [7, 0, 5]];
        let bricks = Bricks::new(64, |position| kept.contains(&position));
        for (i, &distance) in bricks.distances().iter().enumerate() {
            let position = [i % 8, i / 8 % 8, i / 64];
            let distance_to =
                |brick: &[usize; 3]| (0..3).map(|c| position[c].abs_diff(brick[c])).max();
            assert_eq!(
                Some(usize::from(distance)),
                kept.iter().filter_map(distance_to).min(),
                "{position:?}"
            );
        }
        assert!(Bricks::new(16, |_| false).distances().iter().all(|&d| d == 255));
    }
}
