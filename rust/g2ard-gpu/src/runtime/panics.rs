//! Panics in a driver or in wgpu become errors of the device, and print nothing.

use std::any::Any;
use std::cell::Cell;
use std::panic::{AssertUnwindSafe, catch_unwind, set_hook, take_hook};
use std::sync::Once;

use super::{Error, Result};

thread_local! {
    /// Whether panics of this thread are caught here and reported by the caller.
    static CAUGHT: Cell<bool> = const { Cell::new(false) };
}

/// Run `f` and return its panic as an error. The panic hook is wrapped once and stays silent only for this thread while
/// `f` runs.
pub fn guarded<T>(f: impl FnOnce() -> Result<T>) -> Result<T> {
    static WRAPPED: Once = Once::new();
    WRAPPED.call_once(|| {
        let print = take_hook();
        set_hook(Box::new(move |panic| {
            if !CAUGHT.get() {
                print(panic);
            }
        }));
    });
    let before = CAUGHT.replace(true);
    let outcome = catch_unwind(AssertUnwindSafe(f));
    CAUGHT.set(before);
    outcome.unwrap_or_else(|payload| Err(Error::Panicked(message(&*payload))))
}

fn message(payload: &(dyn Any + Send)) -> String {
    let text = payload.downcast_ref::<&str>().copied();
    let text = text.or_else(|| payload.downcast_ref::<String>().map(String::as_str));
    let words: Vec<_> = text
        .unwrap_or("without a word")
        .split_whitespace()
        .collect();
    words.join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::process::Command;

    const CHILD: &str = "G2ARD_TEST_PANICS";

    /// Run this test once more as a process whose stderr can be read.
    #[test]
    fn only_caught_panics_are_silent() {
        if std::env::var_os(CHILD).is_some() {
            let outcome: Result<()> = guarded(|| panic!("a driver's\n {}", "own"));
            assert_eq!(outcome, Err(Error::Panicked("a driver's own".to_owned())));
            let elsewhere = || std::thread::spawn(|| panic!("another thread's")).join();
            let outcome = guarded(|| Ok(elsewhere().is_err()));
            assert_eq!(outcome, Ok(true));
            let nested: Result<()> = guarded(|| {
                let _: Result<()> = guarded(|| panic!("the inner one"));
                panic!("the outer one")
            });
            assert!(nested.is_err());
            assert!(catch_unwind(|| panic!("uncaught afterwards")).is_err());
            return;
        }
        let name = "runtime::panics::tests::only_caught_panics_are_silent";
        let child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", name, "--nocapture", "--test-threads=1"])
            .env(CHILD, "1")
            .output()
            .unwrap();
        let told = String::from_utf8_lossy(&child.stderr);
        assert!(child.status.success(), "{told}");
        assert!(String::from_utf8_lossy(&child.stdout).contains("1 passed"));
        for loud in ["another thread's", "uncaught afterwards"] {
            assert!(told.contains(loud), "{told}");
        }
        for silent in ["a driver's", "the inner one", "the outer one"] {
            assert!(!told.contains(silent), "{told}");
        }
    }
}
