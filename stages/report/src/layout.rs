//! A layered drawing of a graph without circles, from top to bottom, after Sugiyama: edges that
//! skip layers get a lane of their own in each, so that they pass beside boxes.

/// Size of a box, in CSS pixels.
pub(crate) const WIDTH: f64 = 184.0;
pub(crate) const HEIGHT: f64 = 74.0;
/// Between two boxes of a layer, and between layers.
const BOX_GAP: f64 = 24.0;
const LAYER_GAP: f64 = 34.0;
/// Between a lane and what is beside it.
const LANE_GAP: f64 = 16.0;
/// Rounds of moving things towards what they are joined to.
const ROUNDS: usize = 12;

/// Where boxes and edges are.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Drawing {
    pub(crate) width: f64,
    pub(crate) height: f64,
    /// Left upper corner of each node's box.
    pub(crate) boxes: Vec<[f64; 2]>,
    /// Paths of the edges, in SVG's words.
    pub(crate) edges: Vec<String>,
}

/// A box, or the lane of an edge in a layer that it skips.
struct Item {
    layer: usize,
    is_lane: bool,
    /// Centre.
    x: f64,
    above: Vec<usize>,
    below: Vec<usize>,
}

impl Item {
    fn half_width(&self) -> f64 {
        if self.is_lane { 1.0 } else { WIDTH / 2.0 }
    }
}

/// Draws `count` nodes with edges `(from, to)`, where `from` comes before `to`.
pub(crate) fn draw(count: usize, edges: &[(usize, usize)]) -> Drawing {
    let mut layer_of = vec![0; count];
    for to in 0..count {
        let parents = edges.iter().filter(|edge| edge.1 == to);
        layer_of[to] = parents.map(|edge| layer_of[edge.0] + 1).max().unwrap_or(0);
    }
    let item = |layer, is_lane| Item { layer, is_lane, x: 0.0, above: vec![], below: vec![] };
    let mut items: Vec<Item> = layer_of.iter().map(|&layer| item(layer, false)).collect();
    let mut routes = Vec::new();
    for &(from, to) in edges {
        let mut route = vec![from];
        for layer in layer_of[from] + 1..layer_of[to] {
            route.push(items.len());
            items.push(item(layer, true));
        }
        route.push(to);
        for pair in route.windows(2) {
            items[pair[0]].below.push(pair[1]);
            items[pair[1]].above.push(pair[0]);
        }
        routes.push(route);
    }
    let count_of_layers = layer_of.iter().max().map_or(0, |last| last + 1);
    let mut layers: Vec<Vec<usize>> = vec![Vec::new(); count_of_layers];
    for (index, item) in items.iter().enumerate() {
        layers[item.layer].push(index);
    }
    arrange(&mut items, &mut layers);
    let left = items.iter().map(|item| item.x - item.half_width()).fold(f64::INFINITY, f64::min);
    let left = if left.is_finite() { left } else { 0.0 };
    items.iter_mut().for_each(|item| item.x -= left);
    let top = |layer: usize| layer as f64 * (HEIGHT + LAYER_GAP);
    Drawing {
        width: items.iter().map(|item| item.x + item.half_width()).fold(0.0, f64::max),
        height: top(count_of_layers.max(1) - 1) + HEIGHT,
        boxes: items[..count].iter().map(|item| [item.x - WIDTH / 2.0, top(item.layer)]).collect(),
        edges: routes.iter().map(|route| path(&items, route, top)).collect(),
    }
}

/// Orders the layers so that few edges cross, and moves all towards what it is joined to.
fn arrange(items: &mut [Item], layers: &mut [Vec<usize>]) {
    for layer in layers.iter_mut() {
        let mean = |index: usize| mean_x(items, &items[index].above);
        layer.sort_by(|&a, &b| mean(a).total_cmp(&mean(b)));
        let mut x = 0.0;
        for &index in layer.iter() {
            let half = items[index].half_width();
            items[index].x = x + half;
            x += 2.0 * half + BOX_GAP;
        }
    }
    for round in 0..ROUNDS {
        let order: Vec<usize> = if round % 2 == 0 {
            (0..layers.len()).collect()
        } else {
            (0..layers.len()).rev().collect()
        };
        for layer in order {
            settle(items, &layers[layer]);
        }
    }
}

fn mean_x(items: &[Item], of: &[usize]) -> f64 {
    of.iter().map(|&index| items[index].x).sum::<f64>() / of.len().max(1) as f64
}

/// Moves a layer's boxes to the mean of the boxes that they are joined to, as near as their widths
/// allow, and lanes to where nothing is, near the ends of their edges.
fn settle(items: &mut [Item], layer: &[usize]) {
    let (lanes, boxes): (Vec<usize>, Vec<usize>) =
        layer.iter().partition(|&&index| items[index].is_lane);
    let mut wishes: Vec<(usize, f64)> =
        boxes.into_iter().map(|index| (index, wish(items, index))).collect();
    wishes.sort_by(|a, b| a.1.total_cmp(&b.1));
    // Pushed to the right as far as needed, and to the left: the mean keeps the distances.
    let mut right: Vec<f64> = wishes.iter().map(|wish| wish.1).collect();
    let mut left = right.clone();
    for i in 1..wishes.len() {
        right[i] = right[i].max(right[i - 1] + WIDTH + BOX_GAP);
    }
    for i in (1..wishes.len()).rev() {
        left[i - 1] = left[i - 1].min(left[i] - WIDTH - BOX_GAP);
    }
    let mut taken: Vec<(f64, f64)> = Vec::new();
    for (place, (index, _)) in wishes.iter().enumerate() {
        items[*index].x = (left[place] + right[place]) / 2.0;
        taken.push((items[*index].x, WIDTH / 2.0));
    }
    let mut lanes: Vec<(usize, f64)> =
        lanes.into_iter().map(|index| (index, wish(items, index))).collect();
    lanes.sort_by(|a, b| a.1.total_cmp(&b.1));
    for (index, wish) in lanes {
        items[index].x = free_place(&taken, wish);
        taken.push((items[index].x, 0.0));
    }
}

/// Where an item wants to be: at the mean of what it is joined to, a box of boxes alone if it can.
fn wish(items: &[Item], index: usize) -> f64 {
    let Item { above, below, x, is_lane, .. } = &items[index];
    let all = [above.as_slice(), below.as_slice()].concat();
    let boxes: Vec<usize> = all.iter().copied().filter(|&other| !items[other].is_lane).collect();
    match (all.is_empty(), boxes.is_empty()) {
        (true, _) => *x,
        (_, false) if !is_lane => mean_x(items, &boxes),
        _ => mean_x(items, &all),
    }
}

/// The place for a lane next to a wish, beside what is taken (centre and half its width).
fn free_place(taken: &[(f64, f64)], wish: f64) -> f64 {
    let room = |half: f64| half + LANE_GAP;
    let beside = taken.iter().flat_map(|(x, half)| [x + room(*half), x - room(*half)]);
    let is_free = |at: &f64| taken.iter().all(|(x, half)| (x - at).abs() > room(*half) - 1e-6);
    let near = |a: &f64, b: &f64| (a - wish).abs().total_cmp(&(b - wish).abs());
    [wish].into_iter().chain(beside).filter(is_free).min_by(near).unwrap_or(wish)
}

/// From the bottom of the first box to the top of the last, down through the lanes between.
fn path(items: &[Item], route: &[usize], top: impl Fn(usize) -> f64) -> String {
    let mut text = String::new();
    for pair in route.windows(2) {
        let (from, to) = (&items[pair[0]], &items[pair[1]]);
        let (y, end) = (top(from.layer) + HEIGHT, top(to.layer));
        let (x, bend, to_x) = (from.x, (y + end) / 2.0, to.x);
        if text.is_empty() {
            text = format!("M{x:.1} {y:.1}");
        } else {
            text += &format!("L{x:.1} {y:.1}");
        }
        text += &format!("C{x:.1} {bend:.1} {to_x:.1} {bend:.1} {to_x:.1} {end:.1}");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The shipped pipeline: `prep` is joined to all that follow.
    #[test]
    fn edges_pass_beside_boxes() {
        let drawing = draw(5, &[(0, 1), (1, 2), (2, 3), (1, 3), (3, 4), (1, 4)]);
        assert_eq!(drawing.boxes.iter().map(|b| b[1]).collect::<Vec<_>>(), {
            let step = HEIGHT + LAYER_GAP;
            vec![0.0, step, 2.0 * step, 3.0 * step, 4.0 * step]
        });
        assert_eq!(drawing.height, 5.0 * HEIGHT + 4.0 * LAYER_GAP);
        // prep → eval goes straight down through two layers, outside of their boxes.
        let long = &drawing.edges[5];
        let lanes: Vec<f64> = long
            .split('L')
            .skip(1)
            .map(|part| part.split(' ').next().unwrap().parse().unwrap())
            .collect();
        assert_eq!(lanes.len(), 2, "{long}");
        for (x, [left, _]) in lanes.iter().zip(&drawing.boxes[2..4]) {
            assert!(*x < *left || *x > left + WIDTH, "{long} crosses {:?}", drawing.boxes);
        }
        assert!(drawing.width < 2.0 * WIDTH, "{}", drawing.width);
    }

    #[test]
    fn boxes_do_not_overlap() {
        // Many parents of one, and one of many.
        let edges: Vec<(usize, usize)> =
            (1..8).map(|i| (0, i)).chain((1..8).map(|i| (i, 8))).chain([(0, 8)]).collect();
        let drawing = draw(9, &edges);
        for (i, a) in drawing.boxes.iter().enumerate() {
            assert!(a[0] >= -1e-9 && a[0] + WIDTH <= drawing.width + 1e-9);
            for b in &drawing.boxes[..i] {
                assert!(
                    (a[0] - b[0]).abs() >= WIDTH || (a[1] - b[1]).abs() >= HEIGHT,
                    "{a:?} {b:?}"
                );
            }
        }
        assert_eq!(draw(1, &[]).boxes, [[0.0, 0.0]]);
        assert_eq!(draw(0, &[]).boxes.len(), 0);
    }
}
