//! Running kernels without the GIL, on a pool of the chosen size, with Ctrl-C and progress.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock};
use std::time::Duration;

use g2ard_core::{Control, Result};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use pyo3::sync::MutexExt;
use rayon::{ThreadPool, ThreadPoolBuilder};

use crate::error::to_py;

/// A pool and the process that made it: a forked child has the pool without its threads.
struct Pool {
    threads: Arc<ThreadPool>,
    process: u32,
}

/// Locked only with the GIL held, which a thread that forks holds too: a child finds it unlocked.
static POOL: RwLock<Option<Pool>> = RwLock::new(None);

/// Interval at which long work checks for Ctrl-C and reports progress.
const POLL: Duration = Duration::from_millis(50);

fn pool() -> PyResult<Arc<ThreadPool>> {
    let mut threads = 0;
    if let Some(pool) = POOL.read().map_err(poisoned)?.as_ref() {
        if pool.process == std::process::id() {
            return Ok(pool.threads.clone());
        }
        threads = pool.threads.current_num_threads();
    }
    set_num_threads(threads)?;
    pool()
}

fn poisoned<T>(_: T) -> PyErr {
    PyRuntimeError::new_err("the thread pool's lock was poisoned by an earlier panic")
}

fn panicked() -> PyErr {
    PyRuntimeError::new_err("a kernel panicked: this is a bug in g2ard; its message is above")
}

/// Set the number of threads of every kernel from now on; 0 means all cores.
#[pyfunction]
pub fn set_num_threads(threads: usize) -> PyResult<()> {
    let built = ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .map_err(|e| PyRuntimeError::new_err(e.to_string()))?;
    let process = std::process::id();
    let new = Pool {
        threads: Arc::new(built),
        process,
    };
    let old = POOL.write().map_err(poisoned)?.replace(new);
    if let Some(inherited) = old.filter(|old| old.process != process) {
        std::mem::forget(inherited); // dropping it would wait for threads that are not there
    }
    Ok(())
}

#[pyfunction]
pub fn num_threads() -> PyResult<usize> {
    Ok(pool()?.current_num_threads())
}

/// Lock what an object's calls share; the GIL is released while others have it.
pub fn locked<'a, T>(py: Python<'_>, shared: &'a Mutex<T>) -> MutexGuard<'a, T> {
    shared
        .lock_py_attached(py)
        .unwrap_or_else(PoisonError::into_inner)
}

/// Run a kernel of a few milliseconds: GIL released, no Ctrl-C check.
pub fn quick<R: Send>(py: Python<'_>, f: impl FnOnce() -> Result<R> + Send) -> PyResult<R> {
    let pool = pool()?;
    match py.detach(|| catch_unwind(AssertUnwindSafe(|| pool.install(f)))) {
        Ok(result) => result.map_err(to_py),
        Err(_) => Err(panicked()),
    }
}

/// Run long work: GIL released; every 50 ms check for Ctrl-C and call `progress(done, total)`, last with all done.
pub fn long<R: Send>(
    py: Python<'_>,
    progress: Option<&Bound<'_, PyAny>>,
    f: impl FnOnce(&Control) -> Result<R> + Send,
) -> PyResult<R> {
    let pool = pool()?;
    let control = Control::default();
    let mut failure: Option<PyErr> = None;
    let outcome = std::thread::scope(|scope| {
        let (send, mut receive) = channel();
        let control = &control;
        scope.spawn(move || {
            let result = catch_unwind(AssertUnwindSafe(|| pool.install(|| f(control))));
            let _ = send.send(result); // the receiver outlives the scope: it cannot fail
        });
        loop {
            // A Receiver is Send but not Sync, so it moves into the closure and back.
            let (received, back) = py.detach(move || (receive.recv_timeout(POLL), receive));
            receive = back;
            match received {
                Ok(result) => break result.ok(),
                Err(RecvTimeoutError::Disconnected) => break None,
                Err(RecvTimeoutError::Timeout) if failure.is_none() => {
                    let (done, total) = control.progress();
                    let told = progress.map_or(Ok(()), |p| p.call1((done, total)).map(|_| ()));
                    if let Err(e) = py.check_signals().and(told) {
                        control.cancel();
                        failure = Some(e);
                    }
                }
                Err(RecvTimeoutError::Timeout) => {}
            }
        }
    });
    match (failure, outcome) {
        (Some(e), _) => Err(e),
        (None, Some(result)) => {
            let found = result.map_err(to_py)?;
            if let (Some(p), (_, total @ 1..)) = (progress, control.progress()) {
                p.call1((total, total))?; // also of work that ended before its last unit
            }
            Ok(found)
        }
        (None, None) => Err(panicked()),
    }
}
