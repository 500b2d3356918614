//! Rows of floats as the kernels want them: each starts on a cache line, so no vector straddles two.

use bytemuck::{Pod, Zeroable};

use super::simd::LANES;

/// One cache line.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C, align(64))]
struct Line([f32; LANES]);

/// `rows × width` floats; a row takes `stride` floats, `width` rounded up to whole vectors. What stands between rows is
/// never read into a result.
#[derive(Clone, Debug, Default)]
pub(crate) struct Rows {
    lines: Vec<Line>,
    width: usize,
}

impl Rows {
    /// Floats from one row to the next, for rows of `width`.
    pub(crate) fn stride_of(width: usize) -> usize {
        width.next_multiple_of(LANES)
    }

    /// Makes room for `rows` rows of `width`; old contents become meaningless, memory is kept.
    pub(crate) fn shape(&mut self, rows: usize, width: usize) {
        self.width = width;
        self.lines.resize(rows * Self::stride_of(width) / LANES, Line::zeroed());
    }

    /// All zeros.
    pub(crate) fn clear(&mut self) {
        self.lines.fill(Line::zeroed());
    }

    /// Floats of a row.
    pub(crate) fn width(&self) -> usize {
        self.width
    }

    /// Floats from one row to the next.
    pub(crate) fn stride(&self) -> usize {
        Self::stride_of(self.width)
    }

    /// Everything, row by row, `stride` apart.
    pub(crate) fn flat(&self) -> &[f32] {
        bytemuck::cast_slice(&self.lines)
    }

    /// Everything, row by row, `stride` apart.
    pub(crate) fn flat_mut(&mut self) -> &mut [f32] {
        bytemuck::cast_slice_mut(&mut self.lines)
    }

    /// The rows without what stands between them.
    pub(crate) fn iter(&self) -> impl Iterator<Item = &[f32]> {
        let (width, stride) = (self.width, self.stride().max(1));
        self.flat().chunks_exact(stride).map(move |row| &row[..width])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_start_on_cache_lines_and_keep_their_width() {
        let mut rows = Rows::default();
        rows.shape(3, 17);
        assert_eq!((rows.stride(), rows.flat().len()), (32, 96));
        assert_eq!(rows.flat().as_ptr().addr() % 64, 0);
        rows.flat_mut()[32] = 5.0;
        assert_eq!(rows.iter().map(|r| (r.len(), r[0])).collect::<Vec<_>>(), [(17, 0.0), (17, 5.0), (17, 0.0)]);
    }
}
