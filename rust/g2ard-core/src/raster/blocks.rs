//! The blocks of pixels that a tile is worked on in: the 4×4 of a row of sixteen lanes, or the 4×2 of either half.

use super::simd::{LANES, Vector};
use super::{BATCH, ROWS, TILE};

/// Blocks of a tile at most: 4×2 pixels, eight lanes, each.
pub const MOST_BLOCKS: usize = 2 * ROWS;

/// Bit p of word b: whether pair p of a batch reaches block b.
pub type BlockMasks = [u64; MOST_BLOCKS];

/// Blocks of a tile for lanes `B`: of its 4×4 pixels, a row of memory, or of either half.
pub const fn blocks<B: Vector>() -> usize {
    TILE * TILE / B::COUNT
}

/// The row that a block's pixels are in, and the block's position within it.
#[inline(always)]
pub fn row_and_part<B: Vector>(block: usize) -> (usize, usize) {
    let parts = LANES / B::COUNT;
    (block / parts % ROWS, block % parts)
}

/// The blocks that each pair reaches, from the pairs that reach each block: 16×16 bit matrices, transposed by swapping
/// halves, quarters, …
#[inline(always)]
pub fn by_pair<B: Vector>(block_masks: &BlockMasks) -> [u32; BATCH] {
    const SIDE: usize = 16;
    let mut masks = [0; BATCH];
    for (part, masks) in masks.as_chunks_mut::<SIDE>().0.iter_mut().enumerate() {
        for group in 0..blocks::<B>() / SIDE {
            let mut square = [0; SIDE];
            for i in 0..SIDE {
                square[i] = (block_masks[SIDE * group + i] >> (SIDE * part)) as u16;
            }
            swap::<8>(&mut square, 0x00ff);
            swap::<4>(&mut square, 0x0f0f);
            swap::<2>(&mut square, 0x3333);
            swap::<1>(&mut square, 0x5555);
            for i in 0..SIDE {
                masks[i] |= u32::from(square[i]) << (SIDE * group);
            }
        }
    }
    masks
}

#[inline(always)]
fn swap<const BY: usize>(m: &mut [u16; 16], low: u16) {
    for i in 0..16 {
        if i & BY == 0 {
            let t = (m[i] >> BY ^ m[i + BY]) & low;
            m[i + BY] ^= t;
            m[i] ^= t << BY;
        }
    }
}
