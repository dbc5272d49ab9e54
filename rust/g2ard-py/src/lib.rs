//! `g2ard._core`: one file per stage.

mod arrays;
mod constants;
mod device;
mod error;
mod lift;
mod quantize;
mod raster;
mod register;
mod scene;
mod select;
mod simplify;
mod spatial;
mod ssim;
mod tile;
mod train;
mod views;
mod visibility;
mod work;

/// The module of Python.
#[pyo3::pymodule]
mod _core {
    #[pymodule_export]
    #[allow(non_upper_case_globals)] // Python's name
    const __version__: &str = env!("CARGO_PKG_VERSION");
    #[pymodule_export]
    use crate::constants::defaults;
    #[pymodule_export]
    use crate::device::{adapters, device_notes, device_state, set_device};
    #[pymodule_export]
    use crate::lift::lift_points;
    #[pymodule_export]
    use crate::quantize::{codebook, palette};
    #[pymodule_export]
    use crate::raster::{
        PyRasterizer, PyRowBounds, accumulate, accumulate_each, instruction_sets, light_on,
        reaching,
    };
    #[pymodule_export]
    use crate::register::{flow, local_zncc, normal_equations, shot};
    #[pymodule_export]
    use crate::scene::PyScene;
    #[pymodule_export]
    use crate::select::{
        select_greedy, select_light, select_surface, select_view_statistics, select_visible,
    };
    #[pymodule_export]
    use crate::simplify::{simplify_flags, simplify_pairwise, simplify_paper};
    #[pymodule_export]
    use crate::spatial::{cast_rays, knn};
    #[pymodule_export]
    use crate::ssim::{contrasts, l1_ssim, psnr, ssim_metric, steps};
    #[pymodule_export]
    use crate::tile::{PyFrame, PyTileMerging};
    #[pymodule_export]
    use crate::train::{PyTrainer, adam_rows};
    #[pymodule_export]
    use crate::visibility::PyVisibilityAccumulator;
    #[pymodule_export]
    use crate::work::{num_threads, set_num_threads};
}
