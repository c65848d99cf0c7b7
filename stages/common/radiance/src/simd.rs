//! Sixteen logical lanes on any machine, and the choice of machine code at run time.
//!
//! Every family does the same operations on the same lanes in the same order, so all give equal
//! bits; a test compares them.

use std::sync::atomic::{AtomicU8, Ordering};

/// Logical lanes of every kernel.
pub(crate) const LANES: usize = 16;

/// A family of machine code.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Family {
    /// 512-bit vectors (x86-64-v4).
    Avx512,
    /// 256-bit vectors with fused multiply-add (x86-64-v3).
    Avx2,
    /// Whatever the target has.
    Portable,
}

/// 0: not chosen yet; else 1 + the family.
static CHOSEN: AtomicU8 = AtomicU8::new(0);

impl Family {
    /// The best family of this machine, or the one set with [`set_family`].
    pub(crate) fn current() -> Self {
        match CHOSEN.load(Ordering::Relaxed) {
            1 => Self::Avx512,
            2 => Self::Avx2,
            3 => Self::Portable,
            _ => {
                let best = [Self::Avx512, Self::Avx2]
                    .into_iter()
                    .find(|f| f.is_supported())
                    .unwrap_or(Self::Portable);
                set_family(best);
                best
            }
        }
    }

    /// Whether this machine can run it.
    pub fn is_supported(self) -> bool {
        #[cfg(target_arch = "x86_64")]
        match self {
            Self::Avx512 => {
                is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512vl")
                    && is_x86_feature_detected!("avx512bw")
                    && is_x86_feature_detected!("avx512dq")
                    && Self::Avx2.is_supported()
            }
            Self::Avx2 => is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"),
            Self::Portable => true,
        }
        #[cfg(not(target_arch = "x86_64"))]
        {
            self == Self::Portable
        }
    }
}

/// Uses a family from now on, in the whole process: for tests and benchmarks. One that the machine
/// lacks is ignored.
pub fn set_family(family: Family) {
    if family.is_supported() {
        let code = match family {
            Family::Avx512 => 1,
            Family::Avx2 => 2,
            Family::Portable => 3,
        };
        CHOSEN.store(code, Ordering::Relaxed);
    }
}

/// Four `f32`: the features of a vertex.
pub(crate) trait Quad: Copy {
    fn splat(value: f32) -> Self;
    fn load(from: &[f32; 4]) -> Self;
    fn store(self, to: &mut [f32; 4]);
    /// self · factor + addend, rounded once.
    fn mul_add(self, factor: Self, addend: Self) -> Self;
}

impl Quad for [f32; 4] {
    #[inline(always)]
    fn splat(value: f32) -> Self {
        [value; 4]
    }
    #[inline(always)]
    fn load(from: &[f32; 4]) -> Self {
        *from
    }
    #[inline(always)]
    fn store(self, to: &mut [f32; 4]) {
        *to = self;
    }
    #[inline(always)]
    fn mul_add(self, factor: Self, addend: Self) -> Self {
        std::array::from_fn(|i| self[i].mul_add(factor[i], addend[i]))
    }
}

/// Sixteen `f32`.
pub(crate) trait Lanes: Copy {
    /// Four of the same family.
    type Quad: Quad;
    /// Whether 24 of them fit into registers at once.
    const WIDE: bool;
    fn splat(value: f32) -> Self;
    fn load(from: &[f32; LANES]) -> Self;
    fn store(self, to: &mut [f32; LANES]);
    fn add(self, other: Self) -> Self;
    /// self · factor + addend, rounded once.
    fn mul_add(self, factor: Self, addend: Self) -> Self;
    /// self where it is above 0, else 0.
    fn positive(self) -> Self;
    /// self where `gate` is above 0, else 0.
    fn where_positive(self, gate: Self) -> Self;
}

#[derive(Clone, Copy)]
pub(crate) struct Portable([f32; LANES]);

impl Lanes for Portable {
    type Quad = [f32; 4];
    const WIDE: bool = false;
    #[inline(always)]
    fn splat(value: f32) -> Self {
        Self([value; LANES])
    }
    #[inline(always)]
    fn load(from: &[f32; LANES]) -> Self {
        Self(*from)
    }
    #[inline(always)]
    fn store(self, to: &mut [f32; LANES]) {
        *to = self.0;
    }
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Self(std::array::from_fn(|i| self.0[i] + other.0[i]))
    }
    #[inline(always)]
    fn mul_add(self, factor: Self, addend: Self) -> Self {
        Self(std::array::from_fn(|i| self.0[i].mul_add(factor.0[i], addend.0[i])))
    }
    #[inline(always)]
    fn positive(self) -> Self {
        self.where_positive(self)
    }
    #[inline(always)]
    fn where_positive(self, gate: Self) -> Self {
        Self(std::array::from_fn(|i| if gate.0[i] > 0.0 { self.0[i] } else { 0.0 }))
    }
}

#[cfg(target_arch = "x86_64")]
pub(crate) mod x86 {
    //! `unsafe` here pays with a known vector width: left to the optimiser, the accumulators of a
    //! matrix tile spill. All of it is sound because these types are only used inside functions
    //! compiled for their features (see `kernel!`).

    use std::arch::x86_64::*;

    use super::{LANES, Lanes, Quad};

    #[derive(Clone, Copy)]
    pub(crate) struct Four(__m128);

    impl Quad for Four {
        #[inline(always)]
        fn splat(value: f32) -> Self {
            // SAFETY: the caller runs with AVX2 or AVX-512 (module docs).
            Self(unsafe { _mm_set1_ps(value) })
        }
        #[inline(always)]
        fn load(from: &[f32; 4]) -> Self {
            // SAFETY: four floats are there; the caller runs with AVX2 or AVX-512.
            Self(unsafe { _mm_loadu_ps(from.as_ptr()) })
        }
        #[inline(always)]
        fn store(self, to: &mut [f32; 4]) {
            // SAFETY: four floats are there; the caller runs with AVX2 or AVX-512.
            unsafe { _mm_storeu_ps(to.as_mut_ptr(), self.0) }
        }
        #[inline(always)]
        fn mul_add(self, factor: Self, addend: Self) -> Self {
            // SAFETY: the caller runs with FMA.
            Self(unsafe { _mm_fmadd_ps(self.0, factor.0, addend.0) })
        }
    }

    #[derive(Clone, Copy)]
    pub(crate) struct Avx512(__m512);

    impl Lanes for Avx512 {
        type Quad = Four;
        const WIDE: bool = true;
        #[inline(always)]
        fn splat(value: f32) -> Self {
            // SAFETY: the caller runs with AVX-512 (module docs).
            Self(unsafe { _mm512_set1_ps(value) })
        }
        #[inline(always)]
        fn load(from: &[f32; LANES]) -> Self {
            // SAFETY: 16 floats are there; the caller runs with AVX-512.
            Self(unsafe { _mm512_loadu_ps(from.as_ptr()) })
        }
        #[inline(always)]
        fn store(self, to: &mut [f32; LANES]) {
            // SAFETY: 16 floats are there; the caller runs with AVX-512.
            unsafe { _mm512_storeu_ps(to.as_mut_ptr(), self.0) }
        }
        #[inline(always)]
        fn add(self, other: Self) -> Self {
            // SAFETY: the caller runs with AVX-512.
            Self(unsafe { _mm512_add_ps(self.0, other.0) })
        }
        #[inline(always)]
        fn mul_add(self, factor: Self, addend: Self) -> Self {
            // SAFETY: the caller runs with AVX-512.
            Self(unsafe { _mm512_fmadd_ps(self.0, factor.0, addend.0) })
        }
        #[inline(always)]
        fn positive(self) -> Self {
            // SAFETY: the caller runs with AVX-512. A NaN gives the second operand, 0.
            Self(unsafe { _mm512_max_ps(self.0, _mm512_setzero_ps()) })
        }
        #[inline(always)]
        fn where_positive(self, gate: Self) -> Self {
            // SAFETY: the caller runs with AVX-512.
            Self(unsafe {
                _mm512_maskz_mov_ps(
                    _mm512_cmp_ps_mask::<_CMP_GT_OQ>(gate.0, _mm512_setzero_ps()),
                    self.0,
                )
            })
        }
    }

    #[derive(Clone, Copy)]
    pub(crate) struct Avx2([__m256; 2]);

    impl Lanes for Avx2 {
        type Quad = Four;
        const WIDE: bool = false;
        #[inline(always)]
        fn splat(value: f32) -> Self {
            // SAFETY: the caller runs with AVX2 and FMA (module docs).
            Self(unsafe { [_mm256_set1_ps(value); 2] })
        }
        #[inline(always)]
        fn load(from: &[f32; LANES]) -> Self {
            let (low, high) = from.split_at(8);
            // SAFETY: 8 floats are in each half; the caller runs with AVX2.
            Self(unsafe { [_mm256_loadu_ps(low.as_ptr()), _mm256_loadu_ps(high.as_ptr())] })
        }
        #[inline(always)]
        fn store(self, to: &mut [f32; LANES]) {
            let (low, high) = to.split_at_mut(8);
            // SAFETY: 8 floats are in each half; the caller runs with AVX2.
            unsafe {
                _mm256_storeu_ps(low.as_mut_ptr(), self.0[0]);
                _mm256_storeu_ps(high.as_mut_ptr(), self.0[1]);
            }
        }
        #[inline(always)]
        fn add(self, other: Self) -> Self {
            // SAFETY: the caller runs with AVX2.
            Self([0, 1].map(|i| unsafe { _mm256_add_ps(self.0[i], other.0[i]) }))
        }
        #[inline(always)]
        fn mul_add(self, factor: Self, addend: Self) -> Self {
            // SAFETY: the caller runs with FMA.
            Self([0, 1].map(|i| unsafe { _mm256_fmadd_ps(self.0[i], factor.0[i], addend.0[i]) }))
        }
        #[inline(always)]
        fn positive(self) -> Self {
            // SAFETY: the caller runs with AVX2. A NaN gives the second operand, 0.
            Self(self.0.map(|v| unsafe { _mm256_max_ps(v, _mm256_setzero_ps()) }))
        }
        #[inline(always)]
        fn where_positive(self, gate: Self) -> Self {
            // SAFETY: the caller runs with AVX2.
            Self([0, 1].map(|i| unsafe {
                _mm256_and_ps(
                    self.0[i],
                    _mm256_cmp_ps::<_CMP_GT_OQ>(gate.0[i], _mm256_setzero_ps()),
                )
            }))
        }
    }
}

/// Defines a kernel: one body, generic over `L: Lanes`, compiled for every family and chosen at run
/// time.
macro_rules! kernel {
    ($(#[$meta:meta])* $vis:vis fn $name:ident<$lanes:ident>($($arg:ident: $ty:ty),* $(,)?) $body:block) => {
        $(#[$meta])*
        #[allow(clippy::too_many_arguments, reason = "slices and sizes of one kernel")]
        $vis fn $name($($arg: $ty),*) {
            #[allow(clippy::too_many_arguments, reason = "slices and sizes of one kernel")]
            #[inline(always)]
            fn body<$lanes: $crate::simd::Lanes>($($arg: $ty),*) $body
            #[cfg(target_arch = "x86_64")]
            #[allow(clippy::too_many_arguments, reason = "slices and sizes of one kernel")]
            #[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")]
            fn avx512($($arg: $ty),*) {
                body::<$crate::simd::x86::Avx512>($($arg),*);
            }
            #[cfg(target_arch = "x86_64")]
            #[allow(clippy::too_many_arguments, reason = "slices and sizes of one kernel")]
            #[target_feature(enable = "avx2,fma")]
            fn avx2($($arg: $ty),*) {
                body::<$crate::simd::x86::Avx2>($($arg),*);
            }
            match $crate::simd::Family::current() {
                // SAFETY: a family is chosen only where the machine has its features.
                #[cfg(target_arch = "x86_64")]
                $crate::simd::Family::Avx512 => unsafe { avx512($($arg),*) },
                // SAFETY: as above.
                #[cfg(target_arch = "x86_64")]
                $crate::simd::Family::Avx2 => unsafe { avx2($($arg),*) },
                _ => body::<$crate::simd::Portable>($($arg),*),
            }
        }
    };
}
pub(crate) use kernel;
