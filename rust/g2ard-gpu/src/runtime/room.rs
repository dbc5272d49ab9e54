//! Free address space of the process. If it is limited (`ulimit -v`) and runs out, drivers end the process instead of
//! reporting it, so g2ard checks it first.

use std::fs::read_to_string;
use std::num::NonZero;
use std::thread::available_parallelism;

use super::{Error, Result};

/// Address space for opening a device and its first kernels: 0.72 GB were measured with Mesa's llvmpipe on one thread,
/// and 0.15 GB more for the stack and heap of each further thread.
pub fn to_open() -> u64 {
    let threads = available_parallelism().map_or(1, NonZero::get);
    (640 + 192 * threads as u64) << 20
}

/// Address space that stays free for the driver's own needs.
pub const RESERVE: u64 = 256 << 20;

/// The limit on address space when the process began to use a device; None if it is unlimited or unknown.
#[derive(Debug, Clone, Copy)]
pub struct Room(Option<u64>);

impl Room {
    pub fn of_process() -> Self {
        Self(
            read_to_string("/proc/self/limits")
                .ok()
                .and_then(|l| limit(&l)),
        )
    }

    /// Fail if `bytes` more do not fit.
    pub fn check(self, bytes: u64) -> Result<()> {
        let Some(limit) = self.0 else { return Ok(()) };
        let status = read_to_string("/proc/self/status").unwrap_or_default();
        let left = limit.saturating_sub(taken(&status).unwrap_or(0));
        if left < bytes {
            return Err(Error::NoRoom { bytes, left });
        }
        Ok(())
    }
}

/// The limit on address space in bytes; None if it is unlimited.
fn limit(limits: &str) -> Option<u64> {
    let line = limits
        .lines()
        .find_map(|line| line.strip_prefix("Max address space"))?;
    line.split_whitespace().next()?.parse().ok()
}

/// Address space in use, in bytes.
fn taken(status: &str) -> Option<u64> {
    let line = status
        .lines()
        .find_map(|line| line.strip_prefix("VmSize:"))?;
    let kilobytes: u64 = line.split_whitespace().next()?.parse().ok()?;
    Some(kilobytes << 10)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_what_the_kernel_writes() {
        let head = "Limit                     Soft Limit           Hard Limit           Units\n";
        let line =
            |soft: &str| format!("{head}Max address space         {soft:20} unlimited bytes\n");
        assert_eq!(limit(&line("921600000")), Some(921_600_000));
        assert_eq!(limit(&line("unlimited")), None);
        assert_eq!(limit(""), None);
        let status = "Name:\tg2ard\nVmPeak:\t  725904 kB\nVmSize:\t  530528 kB\n";
        assert_eq!(taken(status), Some(530_528 << 10));
    }

    #[test]
    fn says_how_much_is_left() {
        assert_eq!(Room(None).check(u64::MAX), Ok(()));
        if read_to_string("/proc/self/status").is_err() {
            eprintln!("skipped: this system tells of no limit");
            return;
        }
        assert_eq!(Room(Some(1 << 60)).check(1 << 50), Ok(()));
        let error = Room(Some(1 << 20)).check(1 << 30).unwrap_err();
        let told = "it may need 1024 MB of address space, and of what is allowed 0 MB are left";
        assert_eq!(error.to_string(), told);
    }
}
