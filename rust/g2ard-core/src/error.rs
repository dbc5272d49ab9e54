//! The error type of the core.

/// Return the error of an invalid argument if a condition holds: `refuse!(condition => name, expected, got)`.
macro_rules! refuse {
    ($bad:expr => $name:expr, $expected:expr, $got:expr) => {
        if $bad {
            return Err($crate::Error::invalid($name, $expected, $got));
        }
    };
}

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
    /// A loop would never end: what should hold of its input does not.
    #[error("{0}: this is a bug in g2ard")]
    Stuck(&'static str),
    /// A device other than the CPU failed; the work continues on the CPU.
    #[error("{0}")]
    Device(String),
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
    pub fn unless_equal(name: &'static str, got: usize, expected: usize, what: &str) -> Result<()> {
        refuse!(got != expected => name, format!("{expected} {what}"), got);
        Ok(())
    }
}

pub type Result<T> = std::result::Result<T, Error>;
