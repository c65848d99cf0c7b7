//! A sparse grid of voxels over the unit cube: bricks of 8³ where there may be something.

/// Voxels along a brick's side.
pub(crate) const SIDE: usize = 8;
/// Voxels of a brick.
pub(crate) const VOXELS: usize = SIDE * SIDE * SIDE;
/// No brick.
const NO_BRICK: u32 = u32::MAX;

/// Which bricks there are of a grid of `resolution`³ voxels. Voxel (x, y, z) has its centre at
/// (x + 0.5, y + 0.5, z + 0.5) / resolution. Bricks are numbered in the order of their places, x
/// fastest; so are voxels in a brick.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Bricks {
    pub(crate) resolution: usize,
    slots: Vec<u32>,
    places: Vec<[usize; 3]>,
}

impl Bricks {
    /// The bricks whose place fulfils a condition.
    ///
    /// # Panics
    /// When the resolution isn't a multiple of [`SIDE`].
    pub(crate) fn new(resolution: usize, is_kept: impl Fn([usize; 3]) -> bool) -> Self {
        assert_eq!(resolution % SIDE, 0, "whole bricks");
        let mut bricks = Self { resolution, slots: Vec::new(), places: Vec::new() };
        let side = bricks.side();
        bricks.slots = (0..side * side * side)
            .map(|i| {
                let place = [i % side, i / side % side, i / (side * side)];
                if !is_kept(place) {
                    return NO_BRICK;
                }
                bricks.places.push(place);
                bricks.places.len() as u32 - 1
            })
            .collect();
        bricks
    }

    /// Bricks along the grid's side.
    pub(crate) fn side(&self) -> usize {
        self.resolution / SIDE
    }

    /// How many there are.
    pub(crate) fn len(&self) -> usize {
        self.places.len()
    }

    /// Places of the bricks, in their order.
    pub(crate) fn places(&self) -> &[[usize; 3]] {
        &self.places
    }

    /// Number of a brick, where there is one.
    pub(crate) fn slot(&self, [x, y, z]: [usize; 3]) -> Option<usize> {
        let slot = self.slots[x + self.side() * (y + self.side() * z)];
        (slot != NO_BRICK).then_some(slot as usize)
    }

    /// Number of a voxel among those of all bricks, where there is one.
    pub(crate) fn voxel(&self, place: [usize; 3]) -> Option<usize> {
        let slot = self.slot(place.map(|c| c / SIDE))?;
        let [x, y, z] = place.map(|c| c % SIDE);
        Some(slot * VOXELS + x + SIDE * (y + SIDE * z))
    }

    /// Place of a voxel, by its number.
    pub(crate) fn place_of(&self, voxel: usize) -> [usize; 3] {
        let (brick, own) = (self.places[voxel / VOXELS], voxel % VOXELS);
        let own = [own % SIDE, own / SIDE % SIDE, own / (SIDE * SIDE)];
        std::array::from_fn(|i| brick[i] * SIDE + own[i])
    }

    /// How far each place of the grid is from the nearest brick: 0 in a brick, 1 beside one; the
    /// largest of the differences along the axes, 255 at most.
    pub(crate) fn distances(&self) -> Vec<u8> {
        let side = self.side();
        let mut distances: Vec<u8> =
            self.slots.iter().map(|&slot| if slot == NO_BRICK { 255 } else { 0 }).collect();
        // The largest difference of three: one axis after the other, as long as something changes.
        for _ in 0..side {
            let mut next = distances.clone();
            for axis in 0..3 {
                let before = next.clone();
                let step = side.pow(axis);
                for (i, value) in next.iter_mut().enumerate() {
                    let along = i / step % side;
                    let low = if along > 0 { before[i - step] } else { 255 };
                    let high = if along + 1 < side { before[i + step] } else { 255 };
                    *value = (*value).min(low).min(high);
                }
            }
            // `next` is the smallest value within one step along all axes.
            let grown: Vec<u8> = distances
                .iter()
                .zip(&next)
                .map(|(&own, &near)| own.min(near.saturating_add(1)))
                .collect();
            if grown == distances {
                break;
            }
            distances = grown;
        }
        distances
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn voxels_have_numbers_and_places() {
        let bricks = Bricks::new(32, |[x, y, z]| (x + y + z) % 3 == 1);
        assert_eq!((bricks.side(), bricks.len()), (4, 21));
        for voxel in 0..bricks.len() * VOXELS {
            assert_eq!(bricks.voxel(bricks.place_of(voxel)), Some(voxel));
        }
        assert_eq!(bricks.voxel([7, 7, 7]), None);
        assert!(bricks.voxel([8, 7, 7]).is_some());
    }

    #[test]
    fn distances_are_those_to_the_nearest_brick() {
        let kept = [[1, 2, 3], [7, 0, 5]];
        let bricks = Bricks::new(64, |place| kept.contains(&place));
        for (i, &distance) in bricks.distances().iter().enumerate() {
            let place = [i % 8, i / 8 % 8, i / 64];
            let to = |brick: &[usize; 3]| (0..3).map(|c| place[c].abs_diff(brick[c])).max();
            assert_eq!(Some(usize::from(distance)), kept.iter().filter_map(to).min(), "{place:?}");
        }
        assert!(Bricks::new(16, |_| false).distances().iter().all(|&d| d == 255));
    }
}
