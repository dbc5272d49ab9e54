//! Errors of a device. After any of them the CPU continues; none panics.

/// Every message is one line, printed before the program continues without the device.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    #[error("no adapter: no graphics driver that speaks Vulkan, Metal or DirectX 12 was found")]
    NoAdapter,
    #[error("{name}: the driver opened no device ({why})")]
    NoDevice { name: String, why: String },
    #[error("{what} needs a buffer of {bytes} bytes; the device binds {limit} at most")]
    TooLarge {
        what: &'static str,
        bytes: u64,
        limit: u64,
    },
    #[error("{count} {what} are too many for the device, which takes {limit} at most")]
    TooMany {
        what: &'static str,
        count: u64,
        limit: u64,
    },
    /// The process's own limit (`ulimit -v`), not the device's.
    #[error("it may need {} MB of address space, and of what is allowed {} MB are left", bytes >> 20, left >> 20)]
    NoRoom { bytes: u64, left: u64 },
    #[error("the device is out of memory")]
    OutOfMemory,
    #[error("the device was lost ({0})")]
    Lost(String),
    #[error("the device did not answer within {0} s")]
    Timeout(u64),
    #[error("the driver refused a kernel ({0})")]
    Refused(String),
    #[error("the driver panicked ({0})")]
    Panicked(String),
    #[error("a forked process cannot use the device of its parent; start processes by spawn")]
    Forked,
    /// A kernel's answers differ from the CPU's on the probe.
    #[error("{0} computes wrongly: its answers differ from the CPU's")]
    Wrong(String),
    /// The caller asked to stop.
    #[error("interrupted")]
    Interrupted,
}

impl Error {
    /// Whether the failure depends on the amount of work, so that a smaller kernel may succeed.
    pub fn is_of_size(&self) -> bool {
        matches!(self, Self::TooLarge { .. } | Self::TooMany { .. })
    }
}

pub type Result<T> = std::result::Result<T, Error>;

impl From<g2ard_core::Error> for Error {
    /// The only error of the core that a twin can return, because inputs are checked before.
    fn from(error: g2ard_core::Error) -> Self {
        match error {
            g2ard_core::Error::Interrupted => Self::Interrupted,
            other => Self::Refused(other.to_string()),
        }
    }
}
