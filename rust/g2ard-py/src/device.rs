//! `g2ard.system.devices`: the device that runs the kernels, for the whole process.

use std::sync::{Arc, PoisonError, RwLock};

#[cfg(not(feature = "gpu"))]
use g2ard_core::Cpu;
use g2ard_core::Result;
use g2ard_core::raster::{Camera, Params, Settings};
#[cfg(feature = "gpu")]
use g2ard_gpu::{Choice, Device, runtime};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

#[cfg(feature = "gpu")]
use crate::work::quick;

#[cfg(feature = "gpu")]
pub type Kernels = Device;
#[cfg(not(feature = "gpu"))]
pub type Kernels = Cpu;

static KERNELS: RwLock<Option<Arc<Kernels>>> = RwLock::new(None);

/// The kernels in use; the CPU's unless others were chosen.
pub fn kernels() -> Arc<Kernels> {
    let chosen = KERNELS.read().unwrap_or_else(PoisonError::into_inner);
    chosen.clone().unwrap_or_default()
}

/// Train on the CPU from now on, because a device's trainer failed.
#[cfg(feature = "gpu")]
pub fn stop_training(why: &str) {
    kernels().stop_training(why);
}

/// No other device trains in this build.
#[cfg(not(feature = "gpu"))]
pub fn stop_training(_why: &str) {}

#[cfg(feature = "gpu")]
pub use g2ard_gpu::Drawn;
#[cfg(not(feature = "gpu"))]
pub type Drawn = ();

/// Draw an image on the device in use; None if the CPU must draw. With `drawn` the scene must stay the same.
#[cfg(feature = "gpu")]
pub fn image(
    drawn: &mut Drawn,
    params: &Params,
    camera: &Camera,
    settings: &Settings,
    background: [f32; 3],
) -> Result<Option<Vec<f32>>> {
    kernels().image(drawn, params, camera, settings, background)
}

/// No other device draws in this build.
#[cfg(not(feature = "gpu"))]
pub fn image(
    _drawn: &mut Drawn,
    _params: &Params,
    _camera: &Camera,
    _settings: &Settings,
    _background: [f32; 3],
) -> Result<Option<Vec<f32>>> {
    Ok(None)
}

/// Choose cpu, gpu or auto for all kernels from now on. For tests, `max_binding` limits the bytes bound at once;
/// `timed` measures the time of every kernel.
#[cfg(feature = "gpu")]
#[pyfunction]
#[pyo3(signature = (name, max_binding=None, timed=false))]
pub fn set_device(name: &str, max_binding: Option<u64>, timed: bool) -> PyResult<()> {
    let choice = match name {
        "cpu" => Choice::Cpu,
        "gpu" => Choice::Gpu,
        "auto" => Choice::Auto,
        _ => return Err(unknown(name)),
    };
    let device = Device::new(choice, runtime::Options { max_binding, timed });
    *KERNELS.write().unwrap_or_else(PoisonError::into_inner) = Some(Arc::new(device));
    Ok(())
}

/// Accept cpu and auto; this build has no GPU kernels.
#[cfg(not(feature = "gpu"))]
#[pyfunction]
#[pyo3(signature = (name, max_binding=None, timed=false))]
pub fn set_device(name: &str, max_binding: Option<u64>, timed: bool) -> PyResult<()> {
    let _ = (max_binding, timed);
    if ["cpu", "gpu", "auto"].contains(&name) {
        Ok(())
    } else {
        Err(unknown(name))
    }
}

fn unknown(name: &str) -> PyErr {
    PyValueError::new_err(format!("device: expected cpu, gpu or auto, got {name:?}"))
}

/// Return {adapter, served, uploaded_bytes, seconds}: the device in use, the number of kernels that it ran, bytes sent,
/// and seconds per kernel.
#[pyfunction]
pub fn device_state(py: Python<'_>) -> PyResult<Bound<'_, PyDict>> {
    let out = PyDict::new(py);
    #[cfg(feature = "gpu")]
    {
        let kernels = kernels();
        let gpu = kernels.gpu();
        out.set_item("adapter", gpu.as_ref().map(|g| g.adapter.name.clone()))?;
        out.set_item("served", kernels.served())?;
        out.set_item("uploaded_bytes", gpu.as_ref().map_or(0, |g| g.sent()))?;
        out.set_item("seconds", gpu.map(|g| g.timings()).unwrap_or_default())?;
    }
    #[cfg(not(feature = "gpu"))]
    {
        out.set_item("adapter", None::<String>)?;
        out.set_item("served", 0)?;
        out.set_item("uploaded_bytes", 0)?;
        out.set_item("seconds", PyDict::new(py))?;
    }
    Ok(out)
}

/// Return messages for the user since the last call.
#[pyfunction]
pub fn device_notes() -> Vec<String> {
    #[cfg(feature = "gpu")]
    return kernels().notes();
    #[cfg(not(feature = "gpu"))]
    Vec::new()
}

/// Return every adapter, the preferred one first; None if this build has no GPU kernels.
#[pyfunction]
pub fn adapters(py: Python<'_>) -> PyResult<Option<Vec<Bound<'_, PyDict>>>> {
    #[cfg(feature = "gpu")]
    {
        let found = quick(py, || Ok(runtime::list()))?;
        let rows = found.into_iter().map(|a| {
            let out = PyDict::new(py);
            out.set_item("name", a.name)?;
            out.set_item("kind", a.kind)?;
            out.set_item("backend", a.backend)?;
            out.set_item("driver", a.driver)?;
            out.set_item("max_buffer", a.max_buffer)?;
            out.set_item("max_binding", a.max_binding)?;
            out.set_item("max_workgroup_memory", a.max_workgroup_memory)?;
            out.set_item("timestamps", a.timestamps)?;
            Ok(out)
        });
        rows.collect::<PyResult<_>>().map(Some)
    }
    #[cfg(not(feature = "gpu"))]
    {
        let _ = py;
        Ok(None)
    }
}
