//! Removal of specks from the occupancy of a trained field (docs/design/045).

use std::f32::consts::LN_2;

use crate::field::Field;
use crate::occupancy::{CELLS, Cell, Occupancy, cell_and_neighbours};
use crate::spec::OCCUPANCY_CELLS as GRID;

/// Maximum number of cells of a speck, 3³ (docs/design/045).
const MAX_SPECK_CELLS: usize = 27;
/// Density per cube side at which a cell stops half of the light that crosses it.
const HALF_OPAQUE_DENSITY: f32 = LN_2 * GRID as f32;

impl Field {
    /// Empties specks: connected groups of at most 27 cells, none of which stops half of the light
    /// that crosses it. Training leaves specks where it has removed density; rendered, they are
    /// faint dots in front of the background. A group with a more opaque cell stays, however small.
    ///
    /// A field read from a file has no cell densities and stays unchanged.
    pub fn remove_specks(&mut self) {
        let is_speck = find_specks(&self.occupancy);
        let cells: Vec<Cell> = (0..CELLS)
            .map(|cell| if is_speck[cell] { Cell::Empty } else { self.occupancy.cell(cell) })
            .collect();
        self.occupancy.set(|cell| cells[cell]);
    }
}

/// Returns whether each cell belongs to a speck.
fn find_specks(occupancy: &Occupancy) -> Vec<bool> {
    let mut is_visited = vec![false; CELLS];
    let mut is_speck = vec![false; CELLS];
    for cell in occupancy.cells() {
        if !is_visited[cell] {
            let group = connected_cells(occupancy, cell, &mut is_visited);
            // A density below 0 isn't known.
            if group.len() <= MAX_SPECK_CELLS
                && group
                    .iter()
                    .all(|&cell| (0.0..HALF_OPAQUE_DENSITY).contains(&occupancy.density(cell)))
            {
                for cell in group {
                    is_speck[cell] = true;
                }
            }
        }
    }
    is_speck
}

/// Lists the occupied cells that are connected to a cell by faces, edges or corners, itself
/// included, and marks them as visited.
fn connected_cells(occupancy: &Occupancy, first: usize, is_visited: &mut [bool]) -> Vec<usize> {
    let mut group = vec![first];
    is_visited[first] = true;
    let mut next = 0;
    while next < group.len() {
        for cell in cell_and_neighbours(group[next]) {
            if !is_visited[cell] && occupancy.is_occupied(cell) {
                is_visited[cell] = true;
                group.push(cell);
            }
        }
        next += 1;
    }
    group
}

#[cfg(test)]
mod tests {
    use scene::Bounds;

    use super::*;
    use crate::architecture::Architecture;

    const FAINT: f32 = 0.9 * HALF_OPAQUE_DENSITY;
    const OPAQUE: f32 = 1.1 * HALF_OPAQUE_DENSITY;

    fn cell(x: usize, y: usize, z: usize) -> usize {
        x + GRID * (y + GRID * z)
    }

    /// Removes specks from a field with the given occupied cells and their densities. Returns
    /// whether each of these cells remains occupied.
    fn remaining(occupied: &[(usize, f32)]) -> Vec<bool> {
        let mut field = Field::new(Architecture::default(), Bounds::default(), 1);
        let (mut densities, mut before) = (vec![0.0; CELLS], vec![0; CELLS]);
        for &(cell, density) in occupied {
            (densities[cell], before[cell]) = (density, 1 + (cell % 2) as u8);
        }
        field.occupancy.restore(densities, &before);
        field.remove_specks();
        let after = field.occupancy.to_bytes();
        assert!((0..CELLS).all(|cell| [0, before[cell]].contains(&after[cell])), "only removals");
        occupied.iter().map(|(cell, _)| after[*cell] != 0).collect()
    }

    fn faint(cells: impl IntoIterator<Item = usize>) -> Vec<(usize, f32)> {
        cells.into_iter().map(|cell| (cell, FAINT)).collect()
    }

    #[test]
    fn only_small_faint_groups_are_specks() {
        let row = |n: usize| faint((0..n).map(|x| cell(x + 50, 7, 127)));
        assert!(remaining(&row(MAX_SPECK_CELLS)).iter().all(|remains| !remains));
        assert!(remaining(&row(MAX_SPECK_CELLS + 1)).iter().all(|remains| *remains));
        for density in [OPAQUE, -1.0] {
            let mut with_opaque = row(3);
            with_opaque[2].1 = density;
            assert_eq!(remaining(&with_opaque), [true; 3], "{density}");
        }
    }

    /// Corners connect cells of different bricks, too. Opposite faces of the cube aren't connected.
    #[test]
    fn cells_are_connected_by_corners() {
        let diagonal = |n: usize| faint((0..n).map(|i| cell(i, i, 127 - i)));
        assert!(remaining(&diagonal(MAX_SPECK_CELLS + 1)).iter().all(|remains| *remains));
        let mut apart = diagonal(1);
        apart.push((cell(2, 0, 127), OPAQUE));
        assert_eq!(remaining(&apart), [false, true]);
        // Consecutive cell indices at opposite faces of the cube.
        assert_eq!(
            remaining(&[(cell(127, 4, 4), FAINT), (cell(0, 5, 4), OPAQUE)]),
            [false, true],
            "not connected"
        );
    }

    #[test]
    fn empty_and_full_grids_stay_unchanged() {
        for byte in [0, 1] {
            let mut field = Field::new(Architecture::default(), Bounds::default(), 1);
            field.occupancy.restore(vec![0.0; CELLS], &vec![byte; CELLS]);
            field.remove_specks();
            assert_eq!(field.occupancy.cells().count(), CELLS * usize::from(byte));
        }
    }
}
