//! The exact budget: which rows stay when there are too many.

/// The `keep` rows of highest score, ascending; between equals the earlier row stays.
pub fn best(scores: &[f64], keep: usize) -> Vec<u32> {
    let mut rows: Vec<u32> = (0..scores.len() as u32).collect();
    if keep < rows.len() {
        if keep > 0 {
            rows.select_nth_unstable_by(keep - 1, |&a, &b| {
                scores[b as usize]
                    .total_cmp(&scores[a as usize])
                    .then(a.cmp(&b))
            });
        }
        rows.truncate(keep);
        rows.sort_unstable();
    }
    rows
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keeps_the_highest_and_of_equals_the_first() {
        assert_eq!(best(&[1.0, 3.0, 2.0, 3.0], 2), [1, 3]);
        assert_eq!(best(&[1.0; 5], 3), [0, 1, 2]);
        assert_eq!(best(&[1.0, 2.0], 5), [0, 1]);
        assert_eq!(best(&[1.0, 2.0], 0), [0u32; 0]);
    }
}
