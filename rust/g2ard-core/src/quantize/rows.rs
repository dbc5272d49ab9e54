//! Rows of a table of numbers, their weights, and distances between them.

/// N rows of `dims` values and their weights.
pub struct Rows<'a> {
    pub dims: usize,
    pub values: &'a [f32],
    pub weights: Option<&'a [f32]>,
}

impl Rows<'_> {
    pub fn len(&self) -> usize {
        self.values.len() / self.dims
    }

    pub fn row(&self, row: u32) -> &[f32] {
        &self.values[row as usize * self.dims..][..self.dims]
    }

    pub fn weight(&self, row: u32) -> f64 {
        self.weights.map_or(1.0, |w| f64::from(w[row as usize]))
    }

    pub fn distance(&self, row: u32, to: &[f32]) -> f32 {
        distance(self.row(row), to)
    }

    /// Σ w row / Σ w, in the given order; the plain mean if all weights are zero.
    pub fn mean(&self, rows: &[u32]) -> Vec<f32> {
        let total: f64 = rows.iter().map(|&r| self.weight(r)).sum();
        let weighted = total > 0.0;
        let mut sums = vec![0.0_f64; self.dims];
        for &row in rows {
            let weight = if weighted { self.weight(row) } else { 1.0 };
            let values = sums.iter_mut().zip(self.row(row));
            values.for_each(|(sum, &v)| *sum += weight * f64::from(v));
        }
        let total = if weighted { total } else { rows.len() as f64 };
        sums.into_iter().map(|sum| (sum / total) as f32).collect()
    }
}

/// |a − b|², summed in eight lanes: the compiler may use vectors, the result is the same everywhere.
pub fn distance(a: &[f32], b: &[f32]) -> f32 {
    let ((a, a_left), (b, b_left)) = (a.as_chunks::<8>(), b.as_chunks::<8>());
    let mut lanes = [0.0_f32; 8];
    for (a, b) in a.iter().zip(b) {
        for lane in 0..8 {
            let d = a[lane] - b[lane];
            lanes[lane] += d * d;
        }
    }
    for (lane, (a, b)) in lanes.iter_mut().zip(a_left.iter().zip(b_left)) {
        *lane += (a - b) * (a - b);
    }
    let [p, q, r, s] = [0, 1, 2, 3].map(|i| lanes[i] + lanes[i + 4]);
    (p + r) + (q + s)
}
