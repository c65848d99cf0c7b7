//! Layered drawing of an acyclic graph from top to bottom (Sugiyama et al. 1981). An edge that
//! skips layers gets a lane in each of them, so that it passes between the boxes.

/// Width of a box in CSS pixels.
pub(crate) const WIDTH: f64 = 184.0;
/// Height of a box in CSS pixels.
pub(crate) const HEIGHT: f64 = 74.0;
/// Minimum distance between two boxes of a layer.
const BOX_GAP: f64 = 24.0;
/// Distance between two layers.
const LAYER_GAP: f64 = 34.0;
/// Minimum distance between a lane and a box or another lane.
const LANE_GAP: f64 = 16.0;
/// Number of passes that move items towards their neighbours; chosen by hand.
const ROUNDS: usize = 12;

/// Positions of boxes and edges.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Drawing {
    pub(crate) width: f64,
    pub(crate) height: f64,
    /// Upper left corner of each node's box.
    pub(crate) boxes: Vec<[f64; 2]>,
    /// SVG path of each edge.
    pub(crate) edges: Vec<String>,
}

/// A box, or the lane of an edge in a skipped layer.
struct Item {
    layer: usize,
    is_lane: bool,
    /// Centre.
    x: f64,
    /// Connected items in the layers above.
    above: Vec<usize>,
    /// Connected items in the layers below.
    below: Vec<usize>,
}

impl Item {
    fn new(layer: usize, is_lane: bool) -> Self {
        Self { layer, is_lane, x: 0.0, above: Vec::new(), below: Vec::new() }
    }

    fn half_width(&self) -> f64 {
        // A lane is a line: 1 keeps its stroke within the drawing. Chosen by hand.
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
    let mut items: Vec<Item> = layer_of.iter().map(|&layer| Item::new(layer, false)).collect();
    let mut routes = Vec::new();
    for &(from, to) in edges {
        let mut route = vec![from];
        for layer in layer_of[from] + 1..layer_of[to] {
            route.push(items.len());
            items.push(Item::new(layer, true));
        }
        route.push(to);
        for pair in route.windows(2) {
            items[pair[0]].below.push(pair[1]);
            items[pair[1]].above.push(pair[0]);
        }
        routes.push(route);
    }
    let layer_count = layer_of.iter().max().map_or(0, |last| last + 1);
    let mut layers: Vec<Vec<usize>> = vec![Vec::new(); layer_count];
    for (index, item) in items.iter().enumerate() {
        layers[item.layer].push(index);
    }
    arrange(&mut items, &mut layers);
    let left = items.iter().map(|item| item.x - item.half_width()).fold(f64::INFINITY, f64::min);
    let left = if left.is_finite() { left } else { 0.0 };
    for item in &mut items {
        item.x -= left;
    }
    Drawing {
        width: items.iter().map(|item| item.x + item.half_width()).fold(0.0, f64::max),
        height: top(layer_count.max(1) - 1) + HEIGHT,
        boxes: items[..count].iter().map(|item| [item.x - WIDTH / 2.0, top(item.layer)]).collect(),
        edges: routes.iter().map(|route| path(&items, route)).collect(),
    }
}

/// Returns the y coordinate of a layer's upper edge.
fn top(layer: usize) -> f64 {
    layer as f64 * (HEIGHT + LAYER_GAP)
}

/// Orders each layer's items so that few edges cross, and moves items towards their neighbours.
fn arrange(items: &mut [Item], layers: &mut [Vec<usize>]) {
    for layer in layers.iter_mut() {
        layer.sort_by(|&a, &b| {
            mean_x(items, &items[a].above).total_cmp(&mean_x(items, &items[b].above))
        });
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

/// Returns the mean x coordinate of some items.
fn mean_x(items: &[Item], indices: &[usize]) -> f64 {
    indices.iter().map(|&index| items[index].x).sum::<f64>() / indices.len().max(1) as f64
}

/// Moves a layer's boxes to the mean of their neighbours, as near as their widths allow, and its
/// lanes to free positions near the ends of their edges.
fn settle(items: &mut [Item], layer: &[usize]) {
    let boxes = with_targets(items, layer, false);
    // Overlaps are removed twice, by moving boxes only to the right and only to the left. The mean
    // of both positions has no overlaps, either.
    let mut right: Vec<f64> = boxes.iter().map(|(_, target)| *target).collect();
    let mut left = right.clone();
    for i in 1..boxes.len() {
        right[i] = right[i].max(right[i - 1] + WIDTH + BOX_GAP);
    }
    for i in (1..boxes.len()).rev() {
        left[i - 1] = left[i - 1].min(left[i] - WIDTH - BOX_GAP);
    }
    let mut taken: Vec<(f64, f64)> = Vec::new();
    for (i, (index, _)) in boxes.iter().enumerate() {
        items[*index].x = (left[i] + right[i]) / 2.0;
        taken.push((items[*index].x, WIDTH / 2.0));
    }
    for (index, target) in with_targets(items, layer, true) {
        items[index].x = nearest_free(&taken, target);
        taken.push((items[index].x, 0.0));
    }
}

/// Returns a layer's boxes or lanes with their target positions, from left to right.
fn with_targets(items: &[Item], layer: &[usize], are_lanes: bool) -> Vec<(usize, f64)> {
    let chosen = layer.iter().filter(|&&index| items[index].is_lane == are_lanes);
    let mut found: Vec<(usize, f64)> = chosen.map(|&index| (index, target(items, index))).collect();
    found.sort_by(|a, b| a.1.total_cmp(&b.1));
    found
}

/// Returns an item's target position: the mean of its neighbours; for a box, of neighbouring boxes
/// if it has any.
fn target(items: &[Item], index: usize) -> f64 {
    let Item { above, below, x, is_lane, .. } = &items[index];
    let all = [above.as_slice(), below.as_slice()].concat();
    let boxes: Vec<usize> = all.iter().copied().filter(|&other| !items[other].is_lane).collect();
    match (all.is_empty(), boxes.is_empty()) {
        (true, _) => *x,
        (_, false) if !is_lane => mean_x(items, &boxes),
        _ => mean_x(items, &all),
    }
}

/// Returns the free position of a lane that is nearest to its target; `taken` has centre and half
/// width of each occupied interval.
fn nearest_free(taken: &[(f64, f64)], target: f64) -> f64 {
    let mut candidates = vec![target];
    for (x, half) in taken {
        candidates.extend([x + (half + LANE_GAP), x - (half + LANE_GAP)]);
    }
    candidates.retain(|candidate| {
        taken.iter().all(|(x, half)| (x - candidate).abs() > half + LANE_GAP - 1e-6)
    });
    let nearest =
        candidates.into_iter().min_by(|a, b| (a - target).abs().total_cmp(&(b - target).abs()));
    nearest.unwrap_or(target)
}

/// Returns the SVG path from the bottom of the first box to the top of the last, through the lanes
/// between them.
fn path(items: &[Item], route: &[usize]) -> String {
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

    /// In the shipped pipeline, `prep` (node 1) has edges to all later stages.
    #[test]
    fn edges_pass_between_boxes() {
        let drawing = draw(5, &[(0, 1), (1, 2), (2, 3), (1, 3), (3, 4), (1, 4)]);
        assert_eq!(drawing.boxes.iter().map(|b| b[1]).collect::<Vec<_>>(), {
            let step = HEIGHT + LAYER_GAP;
            vec![0.0, step, 2.0 * step, 3.0 * step, 4.0 * step]
        });
        assert_eq!(drawing.height, 5.0 * HEIGHT + 4.0 * LAYER_GAP);
        // prep → eval goes straight down through two layers, outside of their boxes.
        let long_edge = &drawing.edges[5];
        let lanes: Vec<f64> = long_edge
            .split('L')
            .skip(1)
            .map(|part| part.split(' ').next().unwrap().parse().unwrap())
            .collect();
        assert_eq!(lanes.len(), 2, "{long_edge}");
        for (x, [left, _]) in lanes.iter().zip(&drawing.boxes[2..4]) {
            assert!(*x < *left || *x > left + WIDTH, "{long_edge} crosses {:?}", drawing.boxes);
        }
        assert!(drawing.width < 2.0 * WIDTH, "{}", drawing.width);
    }

    #[test]
    fn boxes_do_not_overlap() {
        // One parent of many children, and one child of many parents.
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
