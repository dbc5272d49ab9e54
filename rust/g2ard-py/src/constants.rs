//! Structs of constants: read from attributes of a Python config with the same names, and returned as defaults.

use g2ard_core::constants::{Constants, Slot};
use g2ard_core::lift::LiftConfig;
use g2ard_core::scene::limits;
use g2ard_core::select::Coverage;
use g2ard_core::simplify::{Pairwise, Paper};
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// A core config, extracted from the attributes of a Python object.
pub struct Config<T>(pub T);

impl<'py, T: Constants> FromPyObject<'_, 'py> for Config<T> {
    type Error = PyErr;

    fn extract(object: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        let mut config = T::default();
        for (name, slot) in config.slots() {
            let value = object.getattr(name)?;
            match slot {
                Slot::F64(to) => *to = value.extract()?,
                Slot::F32(to) => *to = value.extract()?,
                Slot::Count(to) => *to = value.extract()?,
                Slot::Flag(to) => *to = value.extract()?,
            }
        }
        Ok(Self(config))
    }
}

fn as_dict<'py>(py: Python<'py>, mut config: impl Constants) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    for (name, slot) in config.slots() {
        match slot {
            Slot::F64(value) => dict.set_item(name, *value)?,
            Slot::F32(value) => dict.set_item(name, *value)?,
            Slot::Count(value) => dict.set_item(name, *value)?,
            Slot::Flag(value) => dict.set_item(name, *value)?,
        }
    }
    Ok(dict)
}

/// Return the core's constants by config: "lift", "coverage", "limits" and the methods of simplification.
#[pyfunction]
pub fn defaults(py: Python<'_>) -> PyResult<Bound<'_, PyDict>> {
    let cuts = PyDict::new(py);
    cuts.set_item("logit_of_opaque", limits::LOGIT_OF_OPAQUE)?;
    cuts.set_item("max_opacity", limits::MAX_OPACITY)?;
    cuts.set_item("drawn_logits", limits::DRAWN_LOGITS)?;
    cuts.set_item("drawn_log_scales", limits::DRAWN_LOG_SCALES)?;
    let out = PyDict::new(py);
    out.set_item("limits", cuts)?;
    out.set_item("lift", as_dict(py, LiftConfig::default())?)?;
    out.set_item("coverage", as_dict(py, Coverage::default())?)?;
    out.set_item("default", as_dict(py, Pairwise::default())?)?;
    out.set_item("fast", as_dict(py, Pairwise::fast())?)?;
    out.set_item("paper", as_dict(py, Paper::default())?)?;
    Ok(out)
}
