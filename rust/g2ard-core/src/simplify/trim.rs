//! The rows of highest score: the paper's trim, and the dropping of transparent rows.

/// The `keep` rows of highest score, ascending. Which of equals stay is as good as random, but always the same: rows
/// are in Morton order, and the first of them would be one corner of the scene.
pub fn best(scores: &[f64], keep: usize) -> Vec<u32> {
    let mut rows: Vec<u32> = (0..scores.len() as u32).collect();
    if keep < rows.len() {
        if keep > 0 {
            rows.select_nth_unstable_by(keep - 1, |&a, &b| {
                scores[b as usize]
                    .total_cmp(&scores[a as usize])
                    .then(mixed(a).cmp(&mixed(b)))
            });
        }
        rows.truncate(keep);
        rows.sort_unstable();
    }
    rows
}

/// A bijection that scatters neighbours (the finaliser of MurmurHash3).
fn mixed(row: u32) -> u32 {
    let mut h = row;
    h = (h ^ (h >> 16)).wrapping_mul(0x85eb_ca6b);
    h = (h ^ (h >> 13)).wrapping_mul(0xc2b2_ae35);
    h ^ (h >> 16)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keeps_the_highest_and_of_equals_some_everywhere() {
        assert_eq!(best(&[1.0, 3.0, 2.0, 3.0], 2), [1, 3]);
        let kept = best(&[1.0; 1000], 100);
        assert_eq!(kept.len(), 100);
        for part in 0..10u32 {
            let here = kept.iter().filter(|&&row| row / 100 == part).count();
            assert!((3..=20).contains(&here), "{here} of part {part}");
        }
        assert_eq!(best(&[1.0, 2.0], 5), [0, 1]);
        assert_eq!(best(&[1.0, 2.0], 0), [0u32; 0]);
    }
}
