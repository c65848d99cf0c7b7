//! Sparse grid of voxels over the unit cube: bricks of 8³ voxels where density is possible.

/// Voxels along a brick's side.
pub(crate) const BRICK_SIDE: usize = 8;
/// Number of voxels in a brick.
pub(crate) const VOXELS: usize = BRICK_SIDE * BRICK_SIDE * BRICK_SIDE;
/// Index at a grid position without a brick.
const NO_BRICK: u32 = u32::MAX;

/// Returns the position of an entry in a cubic grid of `side`³, x fastest.
pub(crate) fn grid_position(index: usize, side: usize) -> [usize; 3] {
    [index % side, index / side % side, index / (side * side)]
}

/// Returns the index of a position in a cubic grid of `side`³, x fastest.
pub(crate) fn grid_index([x, y, z]: [usize; 3], side: usize) -> usize {
    x + side * (y + side * z)
}

/// Existing bricks of a grid of `resolution`³ voxels. Voxel (x, y, z) has its centre at
/// (x + 0.5, y + 0.5, z + 0.5) / resolution. Bricks are numbered in the order of their positions, x
/// fastest; so are voxels in a brick.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Bricks {
    pub(crate) resolution: usize,
    /// Index of the brick at each grid position, or [`NO_BRICK`].
    indices: Vec<u32>,
    /// Grid position of each brick.
    pub(crate) positions: Vec<[usize; 3]>,
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
            let position = grid_position(i, grid_side);
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

    /// Returns the index of a voxel among those of all bricks; `None` outside of bricks.
    pub(crate) fn voxel_index(&self, position: [usize; 3]) -> Option<usize> {
        let brick = grid_index(position.map(|c| c / BRICK_SIDE), self.bricks_per_side());
        let brick = Some(self.indices[brick]).filter(|&brick| brick != NO_BRICK)?;
        let within = grid_index(position.map(|c| c % BRICK_SIDE), BRICK_SIDE);
        Some(brick as usize * VOXELS + within)
    }

    /// Returns the position of a voxel by its index.
    pub(crate) fn voxel_position(&self, voxel: usize) -> [usize; 3] {
        let corner = self.positions[voxel / VOXELS].map(|c| c * BRICK_SIDE);
        let within = grid_position(voxel % VOXELS, BRICK_SIDE);
        std::array::from_fn(|axis| corner[axis] + within[axis])
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
