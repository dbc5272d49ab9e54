//! The devices of this machine.

use std::sync::OnceLock;

use wgpu::{Backends, DeviceType, Instance, InstanceDescriptor, InstanceFlags};

/// A driver's description of a device.
#[derive(Debug, Clone, PartialEq)]
pub struct Adapter {
    pub name: String,
    /// discrete, integrated, virtual, cpu or other.
    pub kind: &'static str,
    /// vulkan, metal or dx12.
    pub backend: &'static str,
    pub driver: String,
    /// Largest buffer, and largest part of a buffer that a kernel can bind, in bytes.
    pub max_buffer: u64,
    pub max_binding: u64,
    pub max_workgroup_memory: u64,
    pub timestamps: bool,
}

impl Adapter {
    /// A driver that computes on the processor: correct, but no faster than the CPU kernels.
    pub fn is_software(&self) -> bool {
        self.kind == "cpu"
    }

    fn of(adapter: &wgpu::Adapter) -> Self {
        let (info, limits) = (adapter.get_info(), adapter.limits());
        Self {
            name: info.name,
            kind: match info.device_type {
                DeviceType::DiscreteGpu => "discrete",
                DeviceType::IntegratedGpu => "integrated",
                DeviceType::VirtualGpu => "virtual",
                DeviceType::Cpu => "cpu",
                DeviceType::Other => "other",
            },
            backend: info.backend.to_str(),
            driver: [info.driver, info.driver_info].join(" ").trim().to_owned(),
            max_buffer: limits.max_buffer_size,
            max_binding: limits.max_storage_buffer_binding_size,
            max_workgroup_memory: u64::from(limits.max_compute_workgroup_storage_size),
            timestamps: adapter.features().contains(wgpu::Features::TIMESTAMP_QUERY),
        }
    }

    fn rank(&self) -> usize {
        ["discrete", "integrated", "virtual", "other", "cpu"]
            .iter()
            .position(|k| *k == self.kind)
            .unwrap_or(usize::MAX)
    }
}

/// One instance per process, because loading drivers twice can fail.
fn instance() -> &'static Instance {
    static INSTANCE: OnceLock<Instance> = OnceLock::new();
    INSTANCE.get_or_init(|| {
        Instance::new(InstanceDescriptor {
            backends: Backends::VULKAN | Backends::METAL | Backends::DX12,
            flags: InstanceFlags::empty(),
            ..InstanceDescriptor::new_without_display_handle()
        })
    })
}

/// Every adapter, in order of preference: real devices before software, larger kinds before smaller.
pub(super) fn found() -> Vec<(Adapter, wgpu::Adapter)> {
    let adapters = pollster::block_on(instance().enumerate_adapters(Backends::all()));
    let mut found: Vec<_> = adapters.into_iter().map(|a| (Adapter::of(&a), a)).collect();
    found.sort_by_key(|(adapter, _)| adapter.rank());
    found
}

/// Every adapter, in the order of preference.
pub fn list() -> Vec<Adapter> {
    found().into_iter().map(|(adapter, _)| adapter).collect()
}
