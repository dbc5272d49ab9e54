//! Conversion of core errors into Python exceptions.

use g2ard_core::Error;
use pyo3::exceptions::{PyKeyboardInterrupt, PyRuntimeError};
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// `InvalidInput` and `NonFinite` → `g2ard.errors.InputError`; `Device` → `DeviceError`; `Interrupted` →
/// `KeyboardInterrupt`; others → `RuntimeError`.
pub fn to_py(error: Error) -> PyErr {
    if error == Error::Interrupted {
        return PyKeyboardInterrupt::new_err(());
    }
    Python::attach(|py| {
        let known = known_error(py, &error).ok().flatten();
        known.unwrap_or_else(|| PyRuntimeError::new_err(error.to_string()))
    })
}

/// An `InputError` about one argument.
pub fn invalid(
    name: &'static str,
    expected: impl Into<String>,
    got: impl std::fmt::Display,
) -> PyErr {
    to_py(Error::invalid(name, expected, got))
}

/// An exception of `g2ard.errors`. The `parameter` of an `InputError` is the field at fault, its `index` the first row
/// that is not finite.
fn known_error(py: Python<'_>, error: &Error) -> PyResult<Option<PyErr>> {
    let fields = PyDict::new(py);
    let message = match error {
        Error::InvalidInput {
            name,
            expected,
            got,
        } => {
            fields.set_item("parameter", name)?;
            format!("expected {expected}, got {got}")
        }
        Error::NonFinite {
            field,
            count,
            first_index,
        } => {
            fields.set_item("parameter", field)?;
            fields.set_item("index", first_index)?;
            format!("is the first of {count} with a non-finite value")
        }
        Error::Device(why) => why.clone(),
        Error::Stuck(_) | Error::Interrupted => return Ok(None),
    };
    let name = match error {
        Error::Device(_) => "DeviceError",
        _ => "InputError",
    };
    let class = py.import("g2ard.errors")?.getattr(name)?;
    Ok(Some(PyErr::from_value(
        class.call((message,), Some(&fields))?,
    )))
}
