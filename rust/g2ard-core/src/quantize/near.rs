//! Neighbouring entries of a palette, searched among groups of entries.

use rayon::prelude::*;

use super::rows::distance;

/// Entries of a group: consecutive ones, which lie near each other.
const GROUP: usize = 64;
/// Groups looked into for the neighbours of an entry.
const GROUPS: usize = 8;
/// Neighbours of an entry. Fewer entries than that are all neighbours of each other.
pub const NEIGHBORS: usize = 24;

/// The nearest other entries of every entry, at most `NEIGHBORS`.
pub fn neighbors(entries: &[f32], dims: usize) -> Vec<Vec<u32>> {
    let count = entries.len() / dims;
    let middles: Vec<f32> = entries
        .chunks(GROUP * dims)
        .flat_map(|group| {
            let n = (group.len() / dims) as f32;
            (0..dims).map(move |d| group.iter().skip(d).step_by(dims).sum::<f32>() / n)
        })
        .collect();
    (0..count)
        .into_par_iter()
        .with_max_len(64)
        .map(|at| {
            let entry = &entries[at * dims..][..dims];
            let groups = nearest(entry, &middles, dims, 0..middles.len() / dims, GROUPS);
            let inside = groups
                .into_iter()
                .flat_map(|g| g as usize * GROUP..((g as usize + 1) * GROUP).min(count))
                .filter(|&other| other != at);
            nearest(entry, entries, dims, inside, NEIGHBORS)
        })
        .collect()
}

/// The `most` of some rows nearest to a point, ties by row.
fn nearest(
    point: &[f32],
    rows: &[f32],
    dims: usize,
    among: impl Iterator<Item = usize>,
    most: usize,
) -> Vec<u32> {
    let mut found: Vec<(f32, u32)> = among
        .map(|row| (distance(point, &rows[row * dims..][..dims]), row as u32))
        .collect();
    let order = |a: &(f32, u32), b: &(f32, u32)| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1));
    if found.len() > most {
        found.select_nth_unstable_by(most, order);
        found.truncate(most);
    }
    found.sort_unstable_by(order);
    // By reference: collecting in place would keep the allocation of all distances.
    found.iter().map(|&(_, row)| row).collect()
}
