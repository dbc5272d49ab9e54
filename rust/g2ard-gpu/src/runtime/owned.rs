//! What belongs to the process that made it. In a forked child the driver has neither its threads nor its connections, so
//! the child does not even free what it inherits.

use super::{Error, Result};

#[derive(Debug)]
pub struct Owned<T> {
    inner: Option<T>,
    process: u32,
}

impl<T> Owned<T> {
    pub fn new(inner: T) -> Self {
        Self {
            inner: Some(inner),
            process: std::process::id(),
        }
    }

    /// Whether it is a forked child's parent's.
    pub fn inherited(&self) -> bool {
        self.process != std::process::id()
    }

    /// The value; an error in a forked child.
    pub fn get(&self) -> Result<&T> {
        match &self.inner {
            Some(inner) if !self.inherited() => Ok(inner),
            _ => Err(Error::Forked),
        }
    }

    /// The value; an error in a forked child.
    pub fn get_mut(&mut self) -> Result<&mut T> {
        let inherited = self.inherited();
        match &mut self.inner {
            Some(inner) if !inherited => Ok(inner),
            _ => Err(Error::Forked),
        }
    }

    /// Make it another process's, as a fork does; a second call undoes it.
    #[cfg(test)]
    pub fn fork(&mut self) {
        self.process ^= 1;
    }
}

impl<T> Drop for Owned<T> {
    fn drop(&mut self) {
        if self.inherited() {
            std::mem::forget(self.inner.take());
        }
    }
}
