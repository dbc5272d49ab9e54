//! Gaussians on the device: parameters and Adam's moments, one attribute after the other, in the order of a [`Store`].

use g2ard_core::raster::Params;
use g2ard_core::train::{Biases, Exported};
use rayon::prelude::*;

use crate::runtime::{Buffer, Gpu, Result, Work};

/// Values of an anchor.
const ANCHOR: usize = 14;
/// Words of `Row` of update.wgsl.
const ROW: usize = 3;

/// Parameters, one attribute after the other.
pub struct Values {
    pub rows: usize,
    /// SH coefficients of a colour.
    pub coeffs: usize,
    pub buffer: Buffer,
}

impl Values {
    fn new(gpu: &Gpu, rows: usize, coeffs: usize) -> Result<Self> {
        Ok(Self {
            rows,
            coeffs,
            buffer: gpu.buffer("values", rows * attributes(coeffs))?,
        })
    }

    /// A scene's, in the caller's order.
    pub fn of(gpu: &Gpu, params: &Params) -> Result<Self> {
        let values = Self::new(gpu, params.len(), params.sh_coeffs)?;
        let rest = 3 * (params.sh_coeffs - 1);
        let parts = [
            (params.means, 3),
            (params.quats, 4),
            (params.log_scales, 3),
            (params.logit_opacities, 1),
            (params.sh0, 3),
            (params.sh_n, rest),
        ];
        let columns = parts
            .into_iter()
            .flat_map(|(rows, width)| (0..width).map(move |k| (rows, width, k)));
        for (number, (rows, width, k)) in columns.enumerate() {
            let column: Vec<f32> = rows.par_chunks(width).map(|row| row[k]).collect();
            gpu.overwrite_at(&values.buffer, number * values.rows, &column);
        }
        gpu.check()?;
        Ok(values)
    }
}

pub struct Scene {
    pub values: Values,
    pub moments: Buffer,
    pub states: Buffer,
    pub anchors: Buffer,
    pub biases: Buffer,
    /// The caller's row of each row here.
    pub order: Vec<u32>,
    units: Vec<f32>,
    /// Frozen rows as the caller numbers them; empty if none is.
    frozen: Vec<bool>,
}

impl Scene {
    pub fn new(gpu: &Gpu, state: &Exported, coeffs: usize) -> Result<Self> {
        let rows = state.order.len();
        let mut scene = Self {
            values: Values::new(gpu, rows, coeffs)?,
            moments: gpu.buffer("moments", 2 * rows * attributes(coeffs))?,
            states: gpu.buffer("rows", ROW * rows)?,
            anchors: gpu.buffer("anchors", ANCHOR * rows)?,
            biases: gpu.upload("biases", &Biases::table())?,
            order: Vec::new(),
            units: Vec::new(),
            frozen: Vec::new(),
        };
        scene.import(gpu, state)?;
        Ok(scene)
    }

    pub fn attributes(&self) -> usize {
        attributes(self.values.coeffs)
    }

    /// Replace everything but anchors and frozen rows by a state of as many rows.
    pub fn import(&mut self, gpu: &Gpu, state: &Exported) -> Result<()> {
        self.order.clone_from(&state.order);
        self.units.clone_from(&state.units);
        let all = self.attributes();
        let columns = |from: &(dyn Fn(usize) -> [f32; 2] + Sync)| -> Vec<[f32; 2]> {
            let column = |k| self.order.iter().map(move |&row| row as usize * all + k);
            (0..all)
                .into_par_iter()
                .flat_map_iter(|k| column(k).map(from))
                .collect()
        };
        let values: Vec<f32> = columns(&|at| [state.values[at]; 2])
            .into_iter()
            .map(|[value, _]| value)
            .collect();
        gpu.overwrite(&self.values.buffer, &values);
        let moments = columns(&|at| [state.first[at], state.second[at]]);
        gpu.overwrite(&self.moments, &moments);
        self.write_rows(gpu, &state.steps);
        gpu.check()
    }

    /// Write the rows with these counts of steps, as the caller numbers them.
    fn write_rows(&self, gpu: &Gpu, steps: &[u32]) {
        let row = |&row: &u32| {
            let row = row as usize;
            let frozen = self.frozen.get(row).is_some_and(|f| *f);
            [self.units[row].to_bits(), steps[row], frozen.into()]
        };
        let rows: Vec<[u32; ROW]> = self.order.iter().map(row).collect();
        gpu.overwrite(&self.states, &rows);
    }

    pub fn freeze(&mut self, gpu: &Gpu, frozen: &[bool]) -> Result<()> {
        self.frozen = frozen.to_vec();
        let steps = self.export(gpu)?.steps;
        self.write_rows(gpu, &steps);
        gpu.check()
    }

    /// Write the anchors, in the order of the rows here.
    pub fn set_anchors(&self, gpu: &Gpu, rows: &[[f32; ANCHOR]]) -> Result<()> {
        let values: Vec<f32> = (0..ANCHOR)
            .flat_map(|k| rows.iter().map(move |row| row[k]))
            .collect();
        gpu.overwrite(&self.anchors, &values);
        gpu.check()
    }

    /// Read the parameters, as [`Exported::values`].
    pub fn values(&self, gpu: &Gpu) -> Result<Vec<f32>> {
        let buffer = &self.values.buffer;
        let read = Work::new(gpu).submit(&[(buffer, buffer.words())])?;
        let [words] = read.take()?.try_into().unwrap_or_default();
        Ok(self.by_row(&words, 0, 1))
    }

    pub fn export(&self, gpu: &Gpu) -> Result<Exported> {
        let buffers = [&self.values.buffer, &self.moments, &self.states];
        let reads = buffers.map(|buffer| (buffer, buffer.words()));
        let found = Work::new(gpu).submit(&reads)?.take()?;
        let [values, moments, states] = found.try_into().unwrap_or_default();
        let mut steps = vec![0; self.values.rows];
        for (&row, state) in self.order.iter().zip(states.chunks(ROW)) {
            steps[row as usize] = state[1];
        }
        Ok(Exported {
            values: self.by_row(&values, 0, 1),
            first: self.by_row(&moments, 0, 2),
            second: self.by_row(&moments, 1, 2),
            units: self.units.clone(),
            steps,
            order: self.order.clone(),
        })
    }

    /// Row-major values in the caller's order, from every `stride`-th word from `first`.
    fn by_row(&self, words: &[u32], first: usize, stride: usize) -> Vec<f32> {
        let (all, rows) = (self.attributes(), self.values.rows);
        let mut out = vec![0.0; rows * all];
        for (i, &row) in self.order.iter().enumerate() {
            for (k, value) in out[row as usize * all..][..all].iter_mut().enumerate() {
                *value = f32::from_bits(words[(k * rows + i) * stride + first]);
            }
        }
        out
    }
}

/// Values of a Gaussian: mean, quaternion, log-scales, logit, SH.
fn attributes(coeffs: usize) -> usize {
    11 + 3 * coeffs
}
