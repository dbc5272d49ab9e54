//! Targets and masks of views that stay on the device from the first step of each view on.

use std::collections::HashMap;

use g2ard_core::train::StepInput;

use super::frame::Target;
use crate::runtime::{Buffer, Error, Gpu, Result, Work};

/// Most bytes that stay.
const MOST: usize = 1 << 30;

pub struct Targets {
    kept: HashMap<u32, Kept>,
    /// Bytes that there is still room for.
    room: usize,
}

impl Default for Targets {
    fn default() -> Self {
        Self::within(MOST)
    }
}

/// A view's target, and its mask if it has one.
pub struct Kept {
    image: Buffer,
    mask: Option<Buffer>,
}

impl Targets {
    pub fn within(room: usize) -> Self {
        let kept = HashMap::new();
        Self { kept, room }
    }

    /// The target of a step; None if it does not fit.
    pub fn of(&mut self, gpu: &Gpu, input: &StepInput) -> Result<Option<&Kept>> {
        let Some(view) = input.view else {
            return Ok(None);
        };
        let bytes = size_of_val(input.target) + input.mask.map_or(0, <[bool]>::len);
        if !self.kept.contains_key(&view) && bytes <= self.room {
            match Kept::new(gpu, input) {
                Ok(kept) => {
                    self.room -= bytes;
                    self.kept.insert(view, kept);
                }
                Err(Error::OutOfMemory | Error::NoRoom { .. }) => self.room = 0,
                Err(other) => return Err(other),
            }
        }
        Ok(self.kept.get(&view))
    }

    #[cfg(test)]
    pub fn count(&self) -> usize {
        self.kept.len()
    }
}

impl Kept {
    fn new(gpu: &Gpu, input: &StepInput) -> Result<Self> {
        let mask = input.mask.map(|mask| gpu.upload("mask", &bytes_of(mask)));
        Ok(Self {
            image: gpu.upload("target", input.target)?,
            mask: mask.transpose()?,
        })
    }

    pub fn copy(&self, work: &mut Work, target: &Target) {
        work.copy(&self.image, &target.image);
        if let Some(mask) = &self.mask {
            work.copy(mask, &target.mask);
        }
    }
}

/// Send the target of a single step.
pub fn send(gpu: &Gpu, input: &StepInput, target: &Target) {
    gpu.overwrite(&target.image, input.target);
    if let Some(mask) = input.mask {
        gpu.overwrite(&target.mask, &bytes_of(mask));
    }
}

/// A byte per pixel, filled up to whole words.
fn bytes_of(mask: &[bool]) -> Vec<u8> {
    let mut bytes: Vec<u8> = mask.iter().map(|&counts| counts.into()).collect();
    bytes.resize(mask.len().next_multiple_of(4), 0);
    bytes
}
