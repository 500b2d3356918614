//! Vectors of `f32`: AVX-512, AVX2 with FMA, or plain arrays of four, chosen once at run time.
//!
//! A kernel is an [`Operation`]: generic over [`Simd`], compiled once per instruction set. Its body must be
//! `#[inline(always)]`, or the compiler cannot use the set's instructions in it. Every sum runs in an order that does
//! not depend on the width, so AVX-512 and AVX2 give the same bits; portable code rounds products apart.
#![expect(unsafe_code, reason = "processor intrinsics; a vector type exists only where its instructions were detected")]
#![expect(clippy::inline_always, reason = "instructions of a set are only generated in code inlined into its entry")]

use std::sync::OnceLock;

/// Floats in the widest vector: rows that kernels see are padded to a multiple of this.
pub(crate) const LANES: usize = 16;

/// An instruction set.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Level {
    /// 16 lanes: AVX-512F.
    #[cfg(target_arch = "x86_64")]
    Avx512,
    /// 8 lanes: AVX2 and FMA.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// 4 lanes of whatever the target always has; products and sums are rounded apart.
    Portable,
}

impl Level {
    /// Every instruction set of this processor, best first.
    pub fn available() -> Vec<Self> {
        let mut levels = Vec::new();
        #[cfg(target_arch = "x86_64")]
        {
            if std::arch::is_x86_feature_detected!("avx512f") {
                levels.push(Self::Avx512);
            }
            if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
                levels.push(Self::Avx2);
            }
        }
        levels.push(Self::Portable);
        levels
    }

    /// The best instruction set of this processor.
    pub fn best() -> Self {
        static BEST: OnceLock<Level> = OnceLock::new();
        *BEST.get_or_init(|| Self::available()[0])
    }

    /// Runs `operation` with this instruction set, which must be one of [`Self::available`].
    pub(crate) fn run<O: Operation>(self, operation: O) -> O::Output {
        match self {
            // SAFETY: `Level` values other than `Portable` come from `available` only, which has detected them
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => unsafe { x86::avx512(operation) },
            // SAFETY: as above
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => unsafe { x86::avx2(operation) },
            Self::Portable => operation.run(Portable(())),
        }
    }
}

/// A kernel: `run` is compiled once per instruction set.
pub(crate) trait Operation {
    /// What it gives.
    type Output;

    /// Does it with the vectors of `S`; must be `#[inline(always)]`.
    fn run<S: Simd>(self, simd: S) -> Self::Output;
}

/// One instruction set's vectors. A value of the type is the proof that the processor has them.
pub(crate) trait Simd: Copy {
    /// A vector.
    type V: Copy;
    /// Its floats.
    const WIDTH: usize;
    /// All lanes `x`.
    fn splat(self, x: f32) -> Self::V;
    /// Lanes from `from`.
    ///
    /// # Safety
    /// `from` must be readable for `WIDTH` floats.
    unsafe fn load_at(self, from: *const f32) -> Self::V;
    /// Lanes to `to`.
    ///
    /// # Safety
    /// `to` must be writable for `WIDTH` floats.
    unsafe fn store_at(self, to: *mut f32, v: Self::V);
    /// a + b.
    fn add(self, a: Self::V, b: Self::V) -> Self::V;
    /// a − b.
    fn sub(self, a: Self::V, b: Self::V) -> Self::V;
    /// a b.
    fn mul(self, a: Self::V, b: Self::V) -> Self::V;
    /// a / b.
    fn div(self, a: Self::V, b: Self::V) -> Self::V;
    /// a b + c, rounded once where the processor can.
    fn fma(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    /// a > b ? a : b, so b when either is no number.
    fn max(self, a: Self::V, b: Self::V) -> Self::V;
    /// a < b ? a : b, so b when either is no number.
    fn min(self, a: Self::V, b: Self::V) -> Self::V;
    /// √v.
    fn sqrt(self, v: Self::V) -> Self::V;
    /// test > 0 ? yes : no.
    fn positive(self, test: Self::V, yes: Self::V, no: Self::V) -> Self::V;
    /// v 2ⁿ for whole n with v 2ⁿ a normal number.
    fn scale(self, v: Self::V, n: Self::V) -> Self::V;
    /// Exponent and mantissa in [1, 2) of normal positive numbers.
    fn split(self, v: Self::V) -> (Self::V, Self::V);

    /// The first `WIDTH` floats of a slice.
    #[inline(always)]
    fn load(self, from: &[f32]) -> Self::V {
        assert!(from.len() >= Self::WIDTH);
        // SAFETY: checked above
        unsafe { self.load_at(from.as_ptr()) }
    }

    /// Writes the first `WIDTH` floats of a slice.
    #[inline(always)]
    fn store(self, to: &mut [f32], v: Self::V) {
        assert!(to.len() >= Self::WIDTH);
        // SAFETY: checked above
        unsafe { self.store_at(to.as_mut_ptr(), v) }
    }

    /// The nearest whole number, for |v| < 2²².
    #[inline(always)]
    fn round(self, v: Self::V) -> Self::V {
        let magic = self.splat(12_582_912.0);
        self.sub(self.add(v, magic), magic)
    }

    /// The sum of sixteen lanes in as many vectors as they take (the first of the four), in pairs at distance 1, then 2,
    /// 4 and 8: the same order whatever the width.
    #[inline(always)]
    fn sum16(self, vectors: [Self::V; 4]) -> f32 {
        let mut lanes = [0.0; LANES];
        for (lanes, v) in lanes.chunks_exact_mut(Self::WIDTH).zip(vectors) {
            self.store(lanes, v);
        }
        let mut distance = 1;
        while distance < LANES {
            for at in (0..LANES).step_by(2 * distance) {
                lanes[at] += lanes[at + distance];
            }
            distance *= 2;
        }
        lanes[0]
    }
}

/// Four lanes in plain Rust.
#[derive(Clone, Copy)]
pub(crate) struct Portable(());

macro_rules! lanewise {
    ($($name:ident($($v:ident),*) $result:expr;)*) => {
        $(#[inline(always)]
        fn $name(self, $($v: [f32; 4]),*) -> [f32; 4] {
            std::array::from_fn(|i| { $(let $v = $v[i];)* $result })
        })*
    };
}

impl Simd for Portable {
    type V = [f32; 4];
    const WIDTH: usize = 4;
    #[inline(always)]
    fn splat(self, x: f32) -> [f32; 4] {
        [x; 4]
    }
    #[inline(always)]
    unsafe fn load_at(self, from: *const f32) -> [f32; 4] {
        // SAFETY: the caller's promise
        unsafe { from.cast::<[f32; 4]>().read_unaligned() }
    }
    #[inline(always)]
    unsafe fn store_at(self, to: *mut f32, v: [f32; 4]) {
        // SAFETY: the caller's promise
        unsafe { to.cast::<[f32; 4]>().write_unaligned(v) }
    }
    lanewise! {
        add(a, b) a + b;
        sub(a, b) a - b;
        mul(a, b) a * b;
        div(a, b) a / b;
        fma(a, b, c) a * b + c;
        max(a, b) if a > b { a } else { b };
        min(a, b) if a < b { a } else { b };
        sqrt(v) v.sqrt();
        positive(test, yes, no) if test > 0.0 { yes } else { no };
        scale(v, n) f32::from_bits(v.to_bits().wrapping_add((n as i32 as u32) << 23));
    }
    #[inline(always)]
    fn split(self, v: [f32; 4]) -> ([f32; 4], [f32; 4]) {
        let exponent = std::array::from_fn(|i| ((v[i].to_bits() >> 23) as i32 - 127) as f32);
        (exponent, std::array::from_fn(|i| f32::from_bits(v[i].to_bits() & 0x007f_ffff | 0x3f80_0000)))
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::{
        __m256, __m512, _CMP_GT_OQ, _MM_MANT_NORM_1_2, _MM_MANT_SIGN_ZERO, _mm256_add_epi32, _mm256_add_ps,
        _mm256_and_si256, _mm256_blendv_ps, _mm256_castps_si256, _mm256_castsi256_ps, _mm256_cmp_ps,
        _mm256_cvtepi32_ps, _mm256_cvtps_epi32, _mm256_div_ps, _mm256_fmadd_ps, _mm256_loadu_ps, _mm256_max_ps,
        _mm256_min_ps, _mm256_mul_ps, _mm256_or_si256, _mm256_set1_epi32, _mm256_set1_ps, _mm256_setzero_ps,
        _mm256_slli_epi32, _mm256_sqrt_ps, _mm256_srli_epi32, _mm256_storeu_ps, _mm256_sub_epi32, _mm256_sub_ps,
        _mm512_add_ps, _mm512_cmp_ps_mask, _mm512_div_ps, _mm512_fmadd_ps, _mm512_getexp_ps, _mm512_getmant_ps,
        _mm512_loadu_ps, _mm512_mask_blend_ps, _mm512_max_ps, _mm512_min_ps, _mm512_mul_ps, _mm512_scalef_ps,
        _mm512_set1_ps, _mm512_setzero_ps, _mm512_sqrt_ps, _mm512_storeu_ps, _mm512_sub_ps,
    };

    use super::{Operation, Simd};

    /// The entry into code for AVX-512.
    #[target_feature(enable = "avx512f,avx2,fma")]
    pub(super) fn avx512<O: Operation>(operation: O) -> O::Output {
        operation.run(Avx512(()))
    }

    /// The entry into code for AVX2 and FMA.
    #[target_feature(enable = "avx2,fma")]
    pub(super) fn avx2<O: Operation>(operation: O) -> O::Output {
        operation.run(Avx2(()))
    }

    /// Sixteen lanes.
    #[derive(Clone, Copy)]
    pub(crate) struct Avx512(());

    /// Eight lanes.
    #[derive(Clone, Copy)]
    pub(crate) struct Avx2(());

    macro_rules! intrinsics {
        ($V:ty: $($name:ident($($v:ident),*) = $intrinsic:ident;)*) => {
            $(#[inline(always)]
            fn $name(self, $($v: $V),*) -> $V {
                // SAFETY: a value of this type exists only where the instructions were detected
                unsafe { $intrinsic($($v),*) }
            })*
        };
    }

    impl Simd for Avx512 {
        type V = __m512;
        const WIDTH: usize = 16;
        intrinsics! { __m512:
            add(a, b) = _mm512_add_ps;
            sub(a, b) = _mm512_sub_ps;
            mul(a, b) = _mm512_mul_ps;
            div(a, b) = _mm512_div_ps;
            fma(a, b, c) = _mm512_fmadd_ps;
            max(a, b) = _mm512_max_ps;
            min(a, b) = _mm512_min_ps;
            sqrt(v) = _mm512_sqrt_ps;
            scale(v, n) = _mm512_scalef_ps;
        }
        #[inline(always)]
        fn splat(self, x: f32) -> __m512 {
            // SAFETY: as for the others
            unsafe { _mm512_set1_ps(x) }
        }
        #[inline(always)]
        unsafe fn load_at(self, from: *const f32) -> __m512 {
            // SAFETY: the caller's promise
            unsafe { _mm512_loadu_ps(from) }
        }
        #[inline(always)]
        unsafe fn store_at(self, to: *mut f32, v: __m512) {
            // SAFETY: the caller's promise
            unsafe { _mm512_storeu_ps(to, v) }
        }
        #[inline(always)]
        fn positive(self, test: __m512, yes: __m512, no: __m512) -> __m512 {
            // SAFETY: as for the others
            unsafe { _mm512_mask_blend_ps(_mm512_cmp_ps_mask::<_CMP_GT_OQ>(test, _mm512_setzero_ps()), no, yes) }
        }
        #[inline(always)]
        fn split(self, v: __m512) -> (__m512, __m512) {
            // SAFETY: as for the others
            unsafe { (_mm512_getexp_ps(v), _mm512_getmant_ps::<_MM_MANT_NORM_1_2, _MM_MANT_SIGN_ZERO>(v)) }
        }
    }

    impl Simd for Avx2 {
        type V = __m256;
        const WIDTH: usize = 8;
        intrinsics! { __m256:
            add(a, b) = _mm256_add_ps;
            sub(a, b) = _mm256_sub_ps;
            mul(a, b) = _mm256_mul_ps;
            div(a, b) = _mm256_div_ps;
            fma(a, b, c) = _mm256_fmadd_ps;
            max(a, b) = _mm256_max_ps;
            min(a, b) = _mm256_min_ps;
            sqrt(v) = _mm256_sqrt_ps;
        }
        #[inline(always)]
        fn splat(self, x: f32) -> __m256 {
            // SAFETY: as for the others
            unsafe { _mm256_set1_ps(x) }
        }
        #[inline(always)]
        unsafe fn load_at(self, from: *const f32) -> __m256 {
            // SAFETY: the caller's promise
            unsafe { _mm256_loadu_ps(from) }
        }
        #[inline(always)]
        unsafe fn store_at(self, to: *mut f32, v: __m256) {
            // SAFETY: the caller's promise
            unsafe { _mm256_storeu_ps(to, v) }
        }
        #[inline(always)]
        fn positive(self, test: __m256, yes: __m256, no: __m256) -> __m256 {
            // SAFETY: as for the others
            unsafe { _mm256_blendv_ps(no, yes, _mm256_cmp_ps::<_CMP_GT_OQ>(test, _mm256_setzero_ps())) }
        }
        #[inline(always)]
        fn scale(self, v: __m256, n: __m256) -> __m256 {
            // SAFETY: as for the others
            unsafe {
                let shifted = _mm256_slli_epi32::<23>(_mm256_cvtps_epi32(n));
                _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(v), shifted))
            }
        }
        #[inline(always)]
        fn split(self, v: __m256) -> (__m256, __m256) {
            // SAFETY: as for the others
            unsafe {
                let bits = _mm256_castps_si256(v);
                let exponent = _mm256_sub_epi32(_mm256_srli_epi32::<23>(bits), _mm256_set1_epi32(127));
                let mantissa = _mm256_and_si256(bits, _mm256_set1_epi32(0x007f_ffff));
                let one = _mm256_set1_epi32(0x3f80_0000);
                (_mm256_cvtepi32_ps(exponent), _mm256_castsi256_ps(_mm256_or_si256(mantissa, one)))
            }
        }
    }
}
