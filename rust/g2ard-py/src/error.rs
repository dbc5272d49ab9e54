//! Conversion of core errors into Python exceptions.

use g2ard_core::Error;
use pyo3::exceptions::{PyKeyboardInterrupt, PyRuntimeError};
use pyo3::prelude::*;

/// `InvalidInput` and `NonFinite` → `g2ard.errors.InputError`; `Interrupted` → `KeyboardInterrupt`.
pub fn to_py(error: Error) -> PyErr {
    if error == Error::Interrupted {
        return PyKeyboardInterrupt::new_err(());
    }
    Python::attach(|py| {
        let class = py
            .import("g2ard.errors")
            .and_then(|m| m.getattr("InputError"));
        match class.and_then(|c| c.call1((error.to_string(),))) {
            Ok(value) => PyErr::from_value(value),
            Err(_) => PyRuntimeError::new_err(error.to_string()),
        }
    })
}
