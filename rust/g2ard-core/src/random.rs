//! Random numbers for tests, benchmarks and device checks: seeded, the same on every machine.

/// A linear congruential generator (Knuth's MMIX constants); its upper bits are the better ones.
#[derive(Debug, Clone)]
pub struct Lcg(pub u64);

impl Lcg {
    fn next(&mut self) -> u64 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        self.0
    }

    /// Uniform in [0, 2²⁴).
    pub fn integer(&mut self) -> u32 {
        (self.next() >> 40) as u32
    }

    /// Uniform in 0 … count − 1.
    pub fn below(&mut self, count: u64) -> u64 {
        (self.uniform() * count as f64) as u64
    }

    /// Uniform in [0, 1).
    pub fn uniform(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Uniform in [−½, ½).
    pub fn centred(&mut self) -> f64 {
        self.uniform() - 0.5
    }

    /// Uniform in [low, high).
    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.uniform()
    }

    /// Uniform in [0, 1), single precision.
    pub fn uniform_f32(&mut self) -> f32 {
        self.integer() as f32 / (1u32 << 24) as f32
    }
}
