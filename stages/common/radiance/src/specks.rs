//! Removes specks from the occupancy of a trained field.

use crate::field::Field;
use crate::occupancy::{CELLS, Cell, Occupancy, around};

/// Most cells of a speck: 3³.
const SPECK_CELLS: usize = 27;

impl Field {
    /// Empties specks: connected groups of at most 27 thin cells. Training leaves them where it has
    /// removed density, and they show as faint dots in front of the background. A group with a
    /// dense cell stays, however small.
    pub fn remove_specks(&mut self) {
        let is_speck = specks(&self.occupancy);
        let cells: Vec<Cell> = (0..CELLS)
            .map(|cell| if is_speck[cell] { Cell::Empty } else { self.occupancy.cell(cell) })
            .collect();
        self.occupancy.set(|cell| cells[cell]);
    }
}

/// Which cells belong to specks.
fn specks(occupancy: &Occupancy) -> Vec<bool> {
    let (mut is_seen, mut is_speck) = (vec![false; CELLS], vec![false; CELLS]);
    let mut group = Vec::new();
    for cell in occupancy.cells() {
        if !is_seen[cell] {
            gather(occupancy, cell, &mut is_seen, &mut group);
            let is_thin = |&cell: &usize| occupancy.cell(cell) == Cell::Thin;
            if group.len() <= SPECK_CELLS && group.iter().all(is_thin) {
                group.iter().for_each(|&cell| is_speck[cell] = true);
            }
        }
    }
    is_speck
}

/// Lists the occupied cells that are connected to one, by faces, edges or corners.
fn gather(occupancy: &Occupancy, first: usize, is_seen: &mut [bool], group: &mut Vec<usize>) {
    group.clear();
    group.push(first);
    is_seen[first] = true;
    let mut next = 0;
    while next < group.len() {
        for cell in around(group[next]) {
            if !is_seen[cell] && occupancy.is_occupied(cell) {
                is_seen[cell] = true;
                group.push(cell);
            }
        }
        next += 1;
    }
}

#[cfg(test)]
mod tests {
    use scene::Bounds;

    use super::*;
    use crate::architecture::Architecture;
    use crate::spec::OCCUPANCY_CELLS as GRID;

    fn cell(x: usize, y: usize, z: usize) -> usize {
        x + GRID * (y + GRID * z)
    }

    /// Which of the held cells are left without specks, where all other cells are empty.
    fn left(held: &[(usize, Cell)]) -> Vec<bool> {
        let mut field = Field::new(Architecture::default(), Bounds::default(), 1);
        let of = |cell: usize| held.iter().find(|(at, _)| *at == cell).map_or(Cell::Empty, |h| h.1);
        field.occupancy.set(of);
        field.remove_specks();
        let kept: Vec<usize> = field.occupancy.cells().collect();
        assert!(kept.iter().all(|&cell| of(cell) == field.occupancy.cell(cell)), "none changes");
        held.iter().map(|(cell, _)| kept.contains(cell)).collect()
    }

    fn thin(cells: impl IntoIterator<Item = usize>) -> Vec<(usize, Cell)> {
        cells.into_iter().map(|cell| (cell, Cell::Thin)).collect()
    }

    #[test]
    fn only_small_thin_groups_are_specks() {
        let row = |n: usize| thin((0..n).map(|x| cell(x + 50, 7, 127)));
        assert!(left(&row(SPECK_CELLS)).iter().all(|left| !left));
        assert!(left(&row(SPECK_CELLS + 1)).iter().all(|left| *left));
        let mut with_dense = row(3);
        with_dense[2].1 = Cell::Dense;
        assert_eq!(left(&with_dense), [true; 3]);
    }

    /// Cells are connected by corners, also of bricks. Opposite faces of the cube aren't.
    #[test]
    fn corners_connect() {
        let diagonal = |n: usize| thin((0..n).map(|i| cell(i, i, 127 - i)));
        assert!(left(&diagonal(SPECK_CELLS + 1)).iter().all(|left| *left));
        let mut beside = diagonal(1);
        beside.push((cell(2, 0, 127), Cell::Dense));
        assert_eq!(left(&beside), [false, true]);
        // Neighbours by number, at opposite sides of the cube.
        let wrapped = [(cell(127, 4, 4), Cell::Thin), (cell(0, 5, 4), Cell::Dense)];
        assert_eq!(left(&wrapped), [false, true]);
    }

    #[test]
    fn nothing_and_everything_stay() {
        let mut field = Field::new(Architecture::default(), Bounds::default(), 1);
        field.occupancy.set(|_| Cell::Empty);
        field.remove_specks();
        assert_eq!(field.occupancy.cells().count(), 0);
        field.occupancy.set(|_| Cell::Thin);
        field.remove_specks();
        assert_eq!(field.occupancy.cells().count(), CELLS);
    }
}
