//! `_core.defaults`: the core's constants, which Python's configs take their defaults from.

use g2ard_core::lift::LiftConfig;
use g2ard_core::scene::limits;
use g2ard_core::simplify::{Pairwise, Paper};
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// A dict of `name: config.name`.
macro_rules! fields {
    ($py:ident, $config:expr, $($name:ident),*) => {{
        let (config, out) = ($config, PyDict::new($py));
        $(out.set_item(stringify!($name), config.$name)?;)*
        out
    }};
}

/// Constants by config: "lift", "limits" and the methods of simplification.
#[pyfunction]
fn defaults(py: Python<'_>) -> PyResult<Bound<'_, PyDict>> {
    let out = PyDict::new(py);
    out.set_item(
        "lift",
        fields!(
            py,
            LiftConfig::default(),
            neighbors,
            normal_ratio,
            max_anisotropy
        ),
    )?;
    for (method, config) in [("default", Pairwise::default()), ("fast", Pairwise::fast())] {
        let constants = fields!(
            py,
            config,
            min_opacity,
            morton_premerge_ratio,
            morton_premerge_steps,
            neighbors,
            geometric_weight,
            dilation,
            pixel_scale,
            max_growth
        );
        out.set_item(method, constants)?;
    }
    let (paper, texture) = (Paper::default(), Paper::default().texture);
    let constants = fields!(
        py,
        paper,
        min_opacity,
        color_bin,
        max_energy,
        min_coverage,
        support,
        protection
    );
    constants.set_item("flag_threshold", texture.threshold)?;
    constants.set_item("flag_members", texture.members)?;
    out.set_item("paper", constants)?;
    let cuts = PyDict::new(py);
    cuts.set_item("logit_of_opaque", limits::LOGIT_OF_OPAQUE)?;
    cuts.set_item("drawn_logits", limits::DRAWN_LOGITS)?;
    cuts.set_item("drawn_log_scales", limits::DRAWN_LOG_SCALES)?;
    out.set_item("limits", cuts)?;
    Ok(out)
}

pub fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(defaults, m)?)
}
