//! Nearest neighbours and counts in the maximum norm, exactly as comparing all pairs would find them.
//!
//! Own code and not the `kdtree` crate: leaves of sixteen points lie column by column and are compared together, and a
//! search starts in the leaf of its own point.

use rayon::prelude::*;

/// Points in a leaf.
const LEAF: usize = 16;
/// Queries that one thread takes at a time.
const CHUNK: usize = 512;

/// Points, row-major `[n, width]`; finite.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Points {
    pub(super) data: Vec<f64>,
    pub(super) width: usize,
}

impl Points {
    pub(super) fn len(&self) -> usize {
        self.data.len().checked_div(self.width).unwrap_or(0)
    }

    pub(super) fn row(&self, i: usize) -> &[f64] {
        &self.data[i * self.width..(i + 1) * self.width]
    }

    /// The columns of all of `parts` side by side.
    pub(super) fn joined(parts: &[&Self]) -> Self {
        let width = parts.iter().map(|p| p.width).sum();
        let mut data = Vec::with_capacity(parts.first().map_or(0, |p| p.len()) * width);
        for i in 0..parts.first().map_or(0, |p| p.len()) {
            for part in parts {
                data.extend_from_slice(part.row(i));
            }
        }
        Self { data, width }
    }
}

/// A balanced k-d tree. Nodes are numbered as in a heap: below node i lie 2 i + 1 and 2 i + 2.
pub(super) struct Tree {
    width: usize,
    leaves: usize,
    /// Per node its box: `width` lower ends, then `width` upper ends.
    boxes: Vec<f64>,
    /// Points below each node.
    counts: Vec<u32>,
    /// Per leaf `[width, LEAF]`; infinite where there is no point.
    columns: Vec<f64>,
    /// Per leaf its points' numbers.
    numbers: Vec<[u32; LEAF]>,
}

impl Tree {
    pub(super) fn new(points: &Points) -> Self {
        let (n, width) = (points.len(), points.width);
        let leaves = n.div_ceil(LEAF).next_power_of_two();
        let mut tree = Self {
            width,
            leaves,
            boxes: vec![0.0; (2 * leaves - 1) * 2 * width],
            counts: vec![0; 2 * leaves - 1],
            columns: vec![f64::INFINITY; leaves * width * LEAF],
            numbers: vec![[u32::MAX; LEAF]; leaves],
        };
        tree.build(0, points, &mut (0..n as u32).collect::<Vec<_>>());
        tree
    }

    fn build(&mut self, node: usize, points: &Points, own: &mut [u32]) {
        let width = self.width;
        self.counts[node] = own.len() as u32;
        let (low, high) = self.boxes[node * 2 * width..(node + 1) * 2 * width].split_at_mut(width);
        low.fill(f64::INFINITY);
        high.fill(f64::NEG_INFINITY);
        for &i in &*own {
            for (c, &v) in points.row(i as usize).iter().enumerate() {
                low[c] = low[c].min(v);
                high[c] = high[c].max(v);
            }
        }
        if node + 1 >= self.leaves {
            let leaf = node + 1 - self.leaves;
            let columns = &mut self.columns[leaf * width * LEAF..(leaf + 1) * width * LEAF];
            for (slot, &i) in own.iter().enumerate() {
                self.numbers[leaf][slot] = i;
                points.row(i as usize).iter().enumerate().for_each(|(c, &v)| columns[c * LEAF + slot] = v);
            }
            return;
        }
        let widest = (0..width).max_by(|&a, &b| (high[a] - low[a]).total_cmp(&(high[b] - low[b]))).unwrap_or(0);
        let middle = own.len() / 2;
        if middle > 0 {
            let value = |i: &u32| points.data[*i as usize * width + widest];
            own.select_nth_unstable_by(middle, |a, b| value(a).total_cmp(&value(b)));
        }
        let (left, right) = own.split_at_mut(middle);
        self.build(2 * node + 1, points, left);
        self.build(2 * node + 2, points, right);
    }

    /// The points' numbers, leaf by leaf.
    pub(super) fn cells(&self) -> impl Iterator<Item = &[u32]> {
        let leaves = self.numbers.iter().zip(&self.counts[self.leaves - 1..]);
        leaves.map(|(numbers, &count)| &numbers[..count as usize])
    }

    /// Distance of each point to its `k`-th nearest other one, `[n]`; infinite when there are fewer.
    pub(super) fn kth(&self, k: usize) -> Vec<f64> {
        self.per_point(f64::INFINITY, |tree, query| {
            query.best.clear();
            query.best.resize(k, f64::INFINITY);
            tree.scan(query.leaf, query);
            let mut node = query.leaf + tree.leaves - 1;
            while node > 0 {
                tree.nearest(if node % 2 == 1 { node + 1 } else { node - 1 }, query);
                node = (node - 1) / 2;
            }
            query.best[k - 1]
        })
    }

    /// Points within `radii[i]` (inclusive) of each point i, itself counted, `[n]`.
    pub(super) fn within(&self, radii: &[f64]) -> Vec<u32> {
        self.per_point(0, |tree, query| tree.count(0, query, radii[query.number as usize]))
    }

    /// For each point i the largest distance in the first `split` columns, and in the others, of the points within
    /// `radii[i]` of it.
    pub(super) fn extents(&self, split: usize, radii: &[f64]) -> Vec<[f64; 2]> {
        self.per_point([0.0; 2], |tree, query| {
            let mut extent = [0.0; 2];
            tree.extend(0, query, radii[query.number as usize], split, &mut extent);
            extent
        })
    }

    /// Asks `ask` for every point, leaf by leaf, and puts the answers into the order of the points.
    fn per_point<T: Copy + Send>(&self, blank: T, ask: impl Fn(&Self, &mut Query) -> T + Sync) -> Vec<T> {
        let chunks: Vec<Vec<(u32, T)>> = (0..self.leaves.div_ceil(CHUNK / LEAF))
            .into_par_iter()
            .map(|chunk| {
                let mut query = Query { at: vec![0.0; self.width], best: Vec::new(), leaf: 0, slot: 0, number: 0 };
                let mut found = Vec::with_capacity(CHUNK);
                let first = chunk * (CHUNK / LEAF);
                for leaf in first..self.leaves.min(first + CHUNK / LEAF) {
                    for slot in 0..self.counts[leaf + self.leaves - 1] as usize {
                        (query.leaf, query.slot, query.number) = (leaf, slot, self.numbers[leaf][slot]);
                        let columns = &self.columns[leaf * self.width * LEAF..];
                        query.at.iter_mut().enumerate().for_each(|(c, v)| *v = columns[c * LEAF + slot]);
                        found.push((query.number, ask(self, &mut query)));
                    }
                }
                found
            })
            .collect();
        let mut out = vec![blank; self.counts[0] as usize];
        chunks.into_iter().flatten().for_each(|(number, value)| out[number as usize] = value);
        out
    }

    /// Distances of a leaf's points, or `None` as soon as all of them exceed `limit`.
    #[inline]
    fn distances(&self, leaf: usize, at: &[f64], limit: f64) -> Option<[f64; LEAF]> {
        let mut distances = [0.0f64; LEAF];
        let columns = self.columns[leaf * self.width * LEAF..(leaf + 1) * self.width * LEAF].as_chunks::<LEAF>().0;
        for (c, (column, &v)) in columns.iter().zip(at).enumerate() {
            for (d, &p) in distances.iter_mut().zip(column) {
                let distance = (p - v).abs();
                // not f64::max, whose care for NaN costs a third of the search
                *d = if distance > *d { distance } else { *d };
            }
            if c % 4 == 3 && distances.iter().all(|&d| d > limit) {
                return None;
            }
        }
        Some(distances)
    }

    fn scan(&self, leaf: usize, query: &mut Query) {
        let k = query.best.len();
        let Some(mut distances) = self.distances(leaf, &query.at, query.best[k - 1]) else { return };
        if leaf == query.leaf {
            distances[query.slot] = f64::INFINITY;
        }
        for d in distances {
            if d < query.best[k - 1] {
                let place = query.best.partition_point(|&b| b <= d);
                query.best.copy_within(place..k - 1, place + 1);
                query.best[place] = d;
            }
        }
    }

    fn nearest(&self, node: usize, query: &mut Query) {
        if self.counts[node] == 0 || self.nearest_corner(node, &query.at) >= query.best[query.best.len() - 1] {
            return;
        }
        if node + 1 >= self.leaves {
            return self.scan(node + 1 - self.leaves, query);
        }
        let (left, right) = (2 * node + 1, 2 * node + 2);
        let nearer_right = self.nearest_corner(right, &query.at) < self.nearest_corner(left, &query.at);
        let (first, then) = if nearer_right { (right, left) } else { (left, right) };
        self.nearest(first, query);
        self.nearest(then, query);
    }

    fn count(&self, node: usize, query: &Query, radius: f64) -> u32 {
        if self.counts[node] == 0 || self.nearest_corner(node, &query.at) > radius {
            return 0;
        }
        if self.farthest_corner(node, &query.at) <= radius {
            return self.counts[node];
        }
        if node + 1 >= self.leaves {
            let distances = self.distances(node + 1 - self.leaves, &query.at, radius);
            return distances.map_or(0, |all| all.iter().map(|&d| u32::from(d <= radius)).sum());
        }
        self.count(2 * node + 1, query, radius) + self.count(2 * node + 2, query, radius)
    }

    fn extend(&self, node: usize, query: &Query, radius: f64, split: usize, extent: &mut [f64; 2]) {
        if self.counts[node] == 0 || self.nearest_corner(node, &query.at) > radius {
            return;
        }
        if node + 1 < self.leaves {
            self.extend(2 * node + 1, query, radius, split, extent);
            return self.extend(2 * node + 2, query, radius, split, extent);
        }
        let leaf = node + 1 - self.leaves;
        let Some(distances) = self.distances(leaf, &query.at, radius) else { return };
        let columns = &self.columns[leaf * self.width * LEAF..(leaf + 1) * self.width * LEAF];
        let points = distances.iter().take(self.counts[node] as usize).enumerate();
        for (slot, _) in points.filter(|(_, d)| **d <= radius) {
            for (c, &v) in query.at.iter().enumerate() {
                let part = &mut extent[usize::from(c >= split)];
                *part = part.max((columns[c * LEAF + slot] - v).abs());
            }
        }
    }

    /// Least distance that a point in the node's box can have.
    #[inline]
    fn nearest_corner(&self, node: usize, at: &[f64]) -> f64 {
        let (low, high) = self.boxes[node * 2 * self.width..(node + 1) * 2 * self.width].split_at(self.width);
        let sides = low.iter().zip(high).zip(at).map(|((l, h), v)| (l - v).max(v - h));
        sides.fold(0.0, |a: f64, b| if b > a { b } else { a })
    }

    /// Greatest distance that a point in the node's box can have.
    #[inline]
    fn farthest_corner(&self, node: usize, at: &[f64]) -> f64 {
        let (low, high) = self.boxes[node * 2 * self.width..(node + 1) * 2 * self.width].split_at(self.width);
        let sides = low.iter().zip(high).zip(at).map(|((l, h), v)| (h - v).max(v - l));
        sides.fold(0.0, |a: f64, b| if b > a { b } else { a })
    }
}

/// A point that asks, where it lies, and the distances found so far in ascending order.
struct Query {
    at: Vec<f64>,
    best: Vec<f64>,
    leaf: usize,
    slot: usize,
    number: u32,
}

/// Points within `radii[i]` (inclusive) of each point i, itself counted, `[n]`: one column is sorted, more are put into
/// a tree.
pub(super) fn within(points: &Points, radii: &[f64]) -> Vec<u32> {
    if points.width != 1 {
        return Tree::new(points).within(radii);
    }
    let mut order: Vec<(f64, u32)> = points.data.iter().copied().zip(0..).collect();
    order.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let sorted: Vec<f64> = order.iter().map(|o| o.0).collect();
    // neighbours ask for almost the same range, so that it is found in cache
    let count = |&(v, i): &(f64, u32)| {
        let radius = radii[i as usize];
        let first = sorted.partition_point(|&s| v - s > radius);
        let end = first + sorted[first..].partition_point(|&s| s - v <= radius);
        (end - first) as u32
    };
    let counts: Vec<u32> = order.par_iter().with_min_len(CHUNK).map(count).collect();
    let mut out = vec![0; order.len()];
    order.iter().zip(counts).for_each(|(&(_, i), count)| out[i as usize] = count);
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{self, Seeds};

    /// Points on a grid of `levels` values per column (0: continuous), so that there are ties.
    fn points(n: usize, width: usize, levels: usize, seed: u64) -> Points {
        let mut rng = Seeds::new(seed).stream("points");
        let mut draw = || if levels > 0 { rng::below(&mut rng, levels) as f64 } else { rng::normal(&mut rng) };
        Points { data: (0..n * width).map(|_| draw()).collect(), width }
    }

    fn distance(points: &Points, i: usize, j: usize, columns: std::ops::Range<usize>) -> f64 {
        columns.map(|c| (points.row(i)[c] - points.row(j)[c]).abs()).fold(0.0, f64::max)
    }

    #[test]
    fn everything_equals_comparing_all_pairs_ties_included() {
        let sizes = [(1, 1), (2, 2), (5, 1), (16, 3), (17, 2), (100, 1), (333, 2), (400, 5), (200, 50)];
        for (case, (n, width)) in sizes.into_iter().enumerate() {
            for (levels, k) in [(0, 1), (0, 4), (2, 3), (5, 3), (40, 7)] {
                let points = points(n, width, levels, case as u64);
                let tree = Tree::new(&points);
                let radii = tree.kth(k);
                let at = |i: usize| (0..n).map(move |j| (j, i));
                for i in 0..n {
                    let mut all: Vec<f64> =
                        at(i).filter(|(j, i)| j != i).map(|(j, i)| distance(&points, i, j, 0..width)).collect();
                    all.sort_unstable_by(f64::total_cmp);
                    assert_eq!(radii[i], all.get(k - 1).copied().unwrap_or(f64::INFINITY), "{n} {width} {levels} {k}");
                }
                for strict in [false, true] {
                    let radii: Vec<f64> = radii.iter().map(|r| if strict { r.next_down() } else { *r }).collect();
                    let (by_tree, by_any) = (tree.within(&radii), within(&points, &radii));
                    let split = width / 2;
                    let extents = tree.extents(split, &radii);
                    for i in 0..n {
                        let near: Vec<usize> =
                            (0..n).filter(|&j| distance(&points, i, j, 0..width) <= radii[i]).collect();
                        assert_eq!((by_tree[i] as usize, by_any[i] as usize), (near.len(), near.len()));
                        let most = |columns: std::ops::Range<usize>| {
                            near.iter().map(|&j| distance(&points, i, j, columns.clone())).fold(0.0, f64::max)
                        };
                        assert_eq!(extents[i], [most(0..split), most(split..width)]);
                    }
                }
            }
        }
    }

    #[test]
    fn one_value_many_times_costs_no_more_than_any_other() {
        let points = Points { data: vec![2.5; 200_000], width: 2 };
        let tree = Tree::new(&points);
        assert!(tree.kth(3).iter().all(|&d| d == 0.0));
        assert!(tree.within(&vec![0.0; 100_000]).iter().all(|&c| c == 100_000));
    }
}
