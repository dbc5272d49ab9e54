//! The error type of the core.

/// Errors of kernels. Messages are one line that names the field, the expected and the actual value.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum Error {
    #[error("{name}: expected {expected}, got {got}")]
    InvalidInput {
        name: &'static str,
        expected: String,
        got: String,
    },
    #[error("{field}: {count} non-finite value(s), the first in row {first_index}")]
    NonFinite {
        field: &'static str,
        count: usize,
        first_index: usize,
    },
    /// The caller asked to stop (see [`crate::Control`]).
    #[error("interrupted")]
    Interrupted,
}

impl Error {
    pub fn invalid(
        name: &'static str,
        expected: impl Into<String>,
        got: impl std::fmt::Display,
    ) -> Self {
        Self::InvalidInput {
            name,
            expected: expected.into(),
            got: got.to_string(),
        }
    }

    /// Check that `name` has as many `what` (rows or values) as expected.
    pub(crate) fn unless_equal(
        name: &'static str,
        got: usize,
        expected: usize,
        what: &str,
    ) -> Result<()> {
        if got == expected {
            return Ok(());
        }
        Err(Self::invalid(name, format!("{expected} {what}"), got))
    }
}

pub type Result<T> = std::result::Result<T, Error>;
