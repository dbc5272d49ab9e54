//! Parameters and moments in blocks of sixteen Gaussians, attribute after attribute.

use crate::raster::Params;
use crate::raster::bounds::{Bounds, GROUPS};
use crate::raster::disjoint::DisjointSlice;
use crate::raster::find_bounds::bounds_of;
use crate::raster::params::Source;
use crate::raster::simd::{LANES, Lanes, Lanes16};
use crate::spatial::{codes_in_box, order};
use crate::{Error, Result};

/// Attributes before the SH: 3 means, 4 quats, 3 log-scales, 1 logit.
pub const QUAT: usize = 3;
pub const LOG_SCALE: usize = 7;
pub const LOGIT: usize = 10;
pub const SH: usize = 11;

/// N Gaussians' parameters, Adam's two moments of each, and how many steps each has taken.
#[derive(Debug, Clone)]
pub struct Store {
    rows: usize,
    sh_coeffs: usize,
    /// Block g's attribute a is row `g · attributes + a`.
    values: Vec<Lanes16>,
    first: Vec<Lanes16>,
    second: Vec<Lanes16>,
    /// Factors of the means' rate.
    units: Vec<Lanes16>,
    /// Bounds of every [`GROUPS`] groups of `values`.
    bounds: Vec<Bounds>,
    steps: Vec<u32>,
    /// An upper bound of `steps`.
    most_steps: u32,
    /// The caller's row of each row here.
    order: Vec<u32>,
}

/// All of a [`Store`], rows in the caller's order, one attribute after the other, as a checkpoint holds it.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Exported {
    /// N × (11 + 3K): means, quats, log-scales, logit, SH.
    pub values: Vec<f32>,
    pub first: Vec<f32>,
    pub second: Vec<f32>,
    pub units: Vec<f32>,
    pub steps: Vec<u32>,
    pub order: Vec<u32>,
}

/// What of an [`Exported`] is wanted; the moments and the values are its large arrays.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    Values,
    First,
    Second,
    Rest,
}

impl Exported {
    /// Check the lengths, and that `order` is a permutation.
    pub fn validate(&self, rows: usize, attributes: usize) -> Result<()> {
        let (n, all) = (rows, rows * attributes);
        for (name, got, expected) in [
            ("values", self.values.len(), all),
            ("first moments", self.first.len(), all),
            ("second moments", self.second.len(), all),
            ("units", self.units.len(), n),
            ("steps", self.steps.len(), n),
            ("order", self.order.len(), n),
        ] {
            Error::unless_equal(name, got, expected, "values")?;
        }
        let mut seen = vec![false; n];
        for row in &self.order {
            match seen.get_mut(*row as usize) {
                Some(s) if !*s => *s = true,
                _ => {
                    return Err(Error::invalid(
                        "order",
                        "a permutation",
                        format!("{row} twice or too large"),
                    ));
                }
            }
        }
        Ok(())
    }
}

impl Store {
    /// Copies the parameters in Morton order, with moments of 0. `units` are factors of the means' rate, 1 by default.
    pub fn new(params: &Params, units: Option<&[f32]>) -> Result<Self> {
        params.validate()?;
        let rows = params.len();
        Error::unless_equal("units", units.map_or(rows, <[f32]>::len), rows, "values")?;
        let attributes = SH + 3 * params.sh_coeffs;
        let blocks = rows.div_ceil(LANES);
        let zeros = vec![Lanes16::default(); blocks * attributes];
        let mut store = Self {
            rows,
            sh_coeffs: params.sh_coeffs,
            values: zeros.clone(),
            first: zeros.clone(),
            second: zeros,
            units: vec![Lanes16([1.0; LANES]); blocks],
            bounds: Vec::new(),
            steps: vec![0; blocks * LANES],
            most_steps: 0,
            order: order(&codes_in_box(params.means.as_chunks().0)),
        };
        for row in 0..rows {
            let from = store.order[row] as usize;
            let rest = 3 * (params.sh_coeffs - 1);
            let parts = [
                &params.means[3 * from..][..3],
                &params.quats[4 * from..][..4],
                &params.log_scales[3 * from..][..3],
                &params.logit_opacities[from..][..1],
                &params.sh0[3 * from..][..3],
                &params.sh_n[rest * from..][..rest],
            ];
            for (attribute, value) in parts.into_iter().flatten().enumerate() {
                store.values[row / LANES * attributes + attribute].0[row % LANES] = *value;
            }
            if let Some(units) = units {
                store.units[row / LANES].0[row % LANES] = units[from];
            }
        }
        store.find_bounds();
        Ok(store)
    }

    fn find_bounds(&mut self) {
        self.bounds = bounds_of(&self.parameters().unbounded());
    }

    pub fn len(&self) -> usize {
        self.rows
    }

    pub fn is_empty(&self) -> bool {
        self.rows == 0
    }

    pub fn sh_coeffs(&self) -> usize {
        self.sh_coeffs
    }

    pub(crate) fn attributes(&self) -> usize {
        SH + 3 * self.sh_coeffs
    }

    pub(crate) fn order(&self) -> &[u32] {
        &self.order
    }

    pub(crate) fn most_steps(&self) -> u32 {
        self.most_steps
    }

    pub(crate) fn count_step(&mut self) {
        self.most_steps += 1;
    }

    /// Attributes `from..to` of every Gaussian, row-major, in the caller's order.
    pub fn columns(&self, from: usize, to: usize) -> Vec<f32> {
        self.unblock(&self.values, from, to)
    }

    /// Copies attributes `from..to` of blocks to row-major rows in the caller's order.
    fn unblock(&self, blocks: &[Lanes16], from: usize, to: usize) -> Vec<f32> {
        let mut out = vec![0.0; self.rows * (to - from)];
        for row in 0..self.rows {
            let at = self.order[row] as usize * (to - from);
            for k in from..to {
                out[at + k - from] = blocks[row / LANES * self.attributes() + k].0[row % LANES];
            }
        }
        out
    }

    /// Copies row-major `rows` in the caller's order into blocks.
    fn block(&self, rows: &[f32], into: &mut [Lanes16]) {
        let attributes = self.attributes();
        for row in 0..self.rows {
            let from = self.order[row] as usize * attributes;
            for k in 0..attributes {
                into[row / LANES * attributes + k].0[row % LANES] = rows[from + k];
            }
        }
    }

    /// How many steps each Gaussian has taken, in the caller's order.
    pub fn steps(&self) -> Vec<u32> {
        let mut steps = vec![0; self.rows];
        for (row, &to) in self.order.iter().enumerate() {
            steps[to as usize] = self.steps[row];
        }
        steps
    }

    /// One part of what [`Store::import`] needs; the rest is empty.
    pub fn export_part(&self, part: Part) -> Exported {
        let rows = |blocks| self.unblock(blocks, 0, self.attributes());
        let mut exported = Exported::default();
        match part {
            Part::Values => exported.values = rows(&self.values),
            Part::First => exported.first = rows(&self.first),
            Part::Second => exported.second = rows(&self.second),
            Part::Rest => {
                exported.units = self.units();
                exported.steps = self.steps();
                exported.order = self.order.clone();
            }
        }
        exported
    }

    fn units(&self) -> Vec<f32> {
        let mut units = vec![0.0; self.rows];
        for row in 0..self.rows {
            units[self.order[row] as usize] = self.units[row / LANES].0[row % LANES];
        }
        units
    }

    /// Everything that [`Store::import`] needs.
    pub fn export(&self) -> Exported {
        Exported {
            values: self.export_part(Part::Values).values,
            first: self.export_part(Part::First).first,
            second: self.export_part(Part::Second).second,
            ..self.export_part(Part::Rest)
        }
    }

    /// Restores an exported store of as many rows and attributes, including its order.
    pub fn import(&mut self, state: &Exported) -> Result<()> {
        state.validate(self.rows, self.attributes())?;
        let n = self.rows;
        self.order.clone_from(&state.order);
        let [mut values, mut first, mut second] =
            [&mut self.values, &mut self.first, &mut self.second].map(std::mem::take);
        self.block(&state.values, &mut values);
        self.block(&state.first, &mut first);
        self.block(&state.second, &mut second);
        (self.values, self.first, self.second) = (values, first, second);
        for row in 0..n {
            self.units[row / LANES].0[row % LANES] = state.units[self.order[row] as usize];
            self.steps[row] = state.steps[self.order[row] as usize];
        }
        self.most_steps = self.steps.iter().copied().max().unwrap_or(0);
        self.find_bounds();
        Ok(())
    }

    /// The parameters as the rasteriser reads them.
    pub(crate) fn parameters(&self) -> ParameterView<'_> {
        ParameterView {
            values: &self.values,
            bounds: Some(&self.bounds),
            first_group: 0,
            rows: self.rows,
            sh_coeffs: self.sh_coeffs,
        }
    }

    /// The blocks as the threads of a step share them.
    pub(crate) fn blocks(&mut self) -> Blocks<'_> {
        Blocks {
            values: DisjointSlice::new(&mut self.values),
            first: DisjointSlice::new(&mut self.first),
            second: DisjointSlice::new(&mut self.second),
            steps: DisjointSlice::new(&mut self.steps),
            bounds: DisjointSlice::new(&mut self.bounds),
            units: &self.units,
            rows: self.rows,
            sh_coeffs: self.sh_coeffs,
        }
    }
}

/// Parameters of consecutive groups, borrowed.
#[derive(Clone, Copy)]
pub(crate) struct ParameterView<'a> {
    values: &'a [Lanes16],
    bounds: Option<&'a [Bounds]>,
    /// The group that `values` begin with.
    first_group: usize,
    /// Rows of the whole store.
    rows: usize,
    sh_coeffs: usize,
}

impl ParameterView<'_> {
    /// The same without bounds: every row is projected in every view.
    pub fn unbounded(self) -> Self {
        Self {
            bounds: None,
            ..self
        }
    }

    #[inline(always)]
    fn get<F: Lanes>(&self, group: usize, attribute: usize) -> F {
        let attributes = SH + 3 * self.sh_coeffs;
        F::load(&self.values[(group - self.first_group) * attributes + attribute])
    }

    #[inline(always)]
    pub fn log_scale<F: Lanes>(&self, group: usize, axis: usize) -> F {
        self.get(group, LOG_SCALE + axis)
    }
}

/// A store while threads step it, each its own blocks.
#[derive(Clone, Copy)]
pub(crate) struct Blocks<'a> {
    values: DisjointSlice<'a, Lanes16>,
    first: DisjointSlice<'a, Lanes16>,
    second: DisjointSlice<'a, Lanes16>,
    steps: DisjointSlice<'a, u32>,
    bounds: DisjointSlice<'a, Bounds>,
    units: &'a [Lanes16],
    pub rows: usize,
    sh_coeffs: usize,
}

/// One group's parameters, moments and counts of steps.
pub(crate) struct Block<'a> {
    pub group: usize,
    /// Attribute after attribute.
    pub values: &'a mut [Lanes16],
    pub first: &'a mut [Lanes16],
    pub second: &'a mut [Lanes16],
    /// Step count of each lane.
    pub steps: &'a mut [u32],
    /// Factors of the means' rate.
    pub units: &'a Lanes16,
    rows: usize,
    pub sh_coeffs: usize,
}

impl<'a> Blocks<'a> {
    /// # Safety
    /// `group` is one of the store's, and no other block of the group exists.
    #[inline(always)]
    pub unsafe fn block(&self, group: usize) -> Block<'a> {
        let attributes = SH + 3 * self.sh_coeffs;
        let at = group * attributes;
        // SAFETY: the store is borrowed for 'a, its arrays hold `attributes` registers and sixteen counts of every
        // group, and the caller promises that the group's are not borrowed elsewhere.
        unsafe {
            Block {
                group,
                values: self.values.slice(at, attributes),
                first: self.first.slice(at, attributes),
                second: self.second.slice(at, attributes),
                steps: self.steps.slice(group * LANES, LANES),
                units: &self.units[group],
                rows: self.rows,
                sh_coeffs: self.sh_coeffs,
            }
        }
    }
}

impl Blocks<'_> {
    /// Finds the bounds of the groups from `first`, a multiple of [`GROUPS`], up to `last` again.
    ///
    /// # Safety
    /// These are groups of the store, and no [`Block`] of them exists.
    #[inline(always)]
    pub unsafe fn find_bounds<F: Lanes>(&self, first: usize, last: usize) {
        let attributes = SH + 3 * self.sh_coeffs;
        // SAFETY: the caller's promise; there are bounds of every GROUPS groups.
        unsafe {
            let count = (last - first) * attributes;
            let parameters = ParameterView {
                values: self.values.slice(first * attributes, count),
                bounds: None,
                first_group: first,
                rows: self.rows,
                sh_coeffs: self.sh_coeffs,
            };
            let found = Bounds::of_groups::<F, _>(&parameters, first..last);
            self.bounds.write(first / GROUPS, found);
        }
    }
}

impl Block<'_> {
    /// Its parameters, for reading.
    #[inline(always)]
    pub fn parameters(&self) -> ParameterView<'_> {
        ParameterView {
            values: self.values,
            bounds: None,
            first_group: self.group,
            rows: self.rows,
            sh_coeffs: self.sh_coeffs,
        }
    }
}

impl Source for ParameterView<'_> {
    #[inline(always)]
    fn len(&self) -> usize {
        self.rows
    }
    fn bounds(&self) -> Option<&[Bounds]> {
        self.bounds
    }
    #[inline(always)]
    fn sh_coeffs(&self) -> usize {
        self.sh_coeffs
    }
    #[inline(always)]
    fn mean<F: Lanes>(&self, group: usize, axis: usize) -> F {
        self.get(group, axis)
    }
    #[inline(always)]
    fn quat<F: Lanes>(&self, group: usize, part: usize) -> F {
        self.get(group, QUAT + part)
    }
    #[inline(always)]
    fn scale<F: Lanes>(&self, group: usize, axis: usize) -> F {
        self.log_scale::<F>(group, axis).exp()
    }
    #[inline(always)]
    fn logit_opacity<F: Lanes>(&self, group: usize) -> F {
        self.get(group, LOGIT)
    }
    #[inline(always)]
    fn sh<F: Lanes>(&self, group: usize, k: usize, c: usize) -> F {
        self.get(group, SH + 3 * k + c)
    }
}
