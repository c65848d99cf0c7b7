use glam::DVec3;

/// Which views are references: the first, then each time the one whose camera stands farthest from
/// those there are, so that together they see as much of the scene as so many can. Fewer are the
/// first of more.
pub(crate) fn choose(centres: impl Iterator<Item = DVec3>, count: usize) -> Vec<usize> {
    let centres: Vec<DVec3> = centres.collect();
    let mut away = vec![f64::INFINITY; centres.len()];
    let mut chosen = Vec::with_capacity(count.min(centres.len()));
    while chosen.len() < count.min(centres.len()) {
        // Of equals the first; what is chosen is no distance away.
        let next = (0..centres.len())
            .filter(|i| !chosen.contains(i))
            .reduce(|best, i| if away[i] > away[best] { i } else { best });
        let Some(next) = next else { break };
        away.iter_mut()
            .zip(&centres)
            .for_each(|(away, centre)| *away = away.min(centre.distance(centres[next])));
        chosen.push(next);
    }
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;

    fn along(places: &[f64]) -> std::vec::IntoIter<DVec3> {
        places.iter().map(|&x| DVec3::new(x, 0.0, 0.0)).collect::<Vec<_>>().into_iter()
    }

    #[test]
    fn references_are_spread() {
        let cameras = || along(&[0.0, 1.0, 2.0, 3.0, 9.0, 10.0]);
        assert_eq!(choose(cameras(), 4), [0, 5, 3, 1]);
        assert_eq!(choose(cameras(), 2), [0, 5]);
        assert_eq!(choose(cameras(), 99).len(), 6);
        assert!(choose(cameras(), 0).is_empty());
        // All in one place, or nowhere.
        assert_eq!(choose(along(&[1.0, 1.0, f64::NAN]), 3).len(), 3);
    }
}
