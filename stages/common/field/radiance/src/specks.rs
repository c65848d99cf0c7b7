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

    /// Returns whether each of some occupied cells, given with its density, is left after specks
    /// are removed. All other cells are empty.
    fn left(held: &[(usize, f32)]) -> Vec<bool> {
        let mut field = Field::new(Architecture::default(), Bounds::default(), 1);
        let (mut density, mut cells) = (vec![0.0; CELLS], vec![0; CELLS]);
        for &(cell, of_cell) in held {
            (density[cell], cells[cell]) = (of_cell, 1 + (cell % 2) as u8);
        }
        field.occupancy.restore(density, &cells);
        field.remove_specks();
        let kept = field.occupancy.to_bytes();
        assert!((0..CELLS).all(|cell| [0, cells[cell]].contains(&kept[cell])), "none changes");
        held.iter().map(|(cell, _)| kept[*cell] != 0).collect()
    }

    fn faint(cells: impl IntoIterator<Item = usize>) -> Vec<(usize, f32)> {
        cells.into_iter().map(|cell| (cell, FAINT)).collect()
    }

    #[test]
    fn only_small_faint_groups_are_specks() {
        let row = |n: usize| faint((0..n).map(|x| cell(x + 50, 7, 127)));
        assert!(left(&row(MAX_SPECK_CELLS)).iter().all(|left| !left));
        assert!(left(&row(MAX_SPECK_CELLS + 1)).iter().all(|left| *left));
        for density in [OPAQUE, -1.0] {
            let mut with_opaque = row(3);
            with_opaque[2].1 = density;
            assert_eq!(left(&with_opaque), [true; 3], "{density}");
        }
    }

    /// Cells are connected by corners, also of bricks. Opposite faces of the cube aren't.
    #[test]
    fn corners_connect() {
        let diagonal = |n: usize| faint((0..n).map(|i| cell(i, i, 127 - i)));
        assert!(left(&diagonal(MAX_SPECK_CELLS + 1)).iter().all(|left| *left));
        let mut beside = diagonal(1);
        beside.push((cell(2, 0, 127), OPAQUE));
        assert_eq!(left(&beside), [false, true]);
        // Neighbours by number, at opposite sides of the cube.
        assert_eq!(
            left(&[(cell(127, 4, 4), FAINT), (cell(0, 5, 4), OPAQUE)]),
            [false, true],
            "not connected"
        );
    }

    #[test]
    fn nothing_and_everything_stay() {
        for byte in [0, 1] {
            let mut field = Field::new(Architecture::default(), Bounds::default(), 1);
            field.occupancy.restore(vec![0.0; CELLS], &vec![byte; CELLS]);
            field.remove_specks();
            assert_eq!(field.occupancy.cells().count(), CELLS * usize::from(byte));
        }
    }
}
