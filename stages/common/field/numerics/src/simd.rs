//! Sixteen logical lanes on any machine, and the choice of machine code at run time.
//!
//! All families execute the same operations on the same lanes in the same order, so their results
//! have equal bits; a test compares them.

use std::sync::atomic::{AtomicU8, Ordering};

/// Number of logical lanes of every kernel.
pub const LANES: usize = 16;

/// SIMD family of machine code; the discriminant is its number in `CHOSEN`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Family {
    /// 512-bit vectors (x86-64-v4).
    Avx512 = 0,
    /// 256-bit vectors with fused multiply-add (x86-64-v3).
    Avx2 = 1,
    /// Instructions of the compilation target.
    Portable = 2,
}

/// Discriminant of the chosen [`Family`]; another number before the first choice.
static CHOSEN: AtomicU8 = AtomicU8::new(u8::MAX);

impl Family {
    const AVX512: u8 = Self::Avx512 as u8;
    const AVX2: u8 = Self::Avx2 as u8;
    const PORTABLE: u8 = Self::Portable as u8;

    /// Returns the family set with [`set_family`], by default the best that the machine supports.
    pub fn current() -> Self {
        match CHOSEN.load(Ordering::Relaxed) {
            Self::AVX512 => Self::Avx512,
            Self::AVX2 => Self::Avx2,
            Self::PORTABLE => Self::Portable,
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

    /// Returns whether the machine supports the family.
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

/// Sets the family of the whole process, for tests and benchmarks. A family that the machine
/// doesn't support is ignored.
pub fn set_family(family: Family) {
    if family.is_supported() {
        CHOSEN.store(family as u8, Ordering::Relaxed);
    }
}

/// Runs a test with every family that the machine supports, and prints the others.
pub fn test_every_family(mut test: impl FnMut(Family)) {
    // Tests run in parallel, and the family is global.
    static ALONE_HERE: std::sync::Mutex<()> = std::sync::Mutex::new(());
    let _alone = ALONE_HERE.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    for family in [Family::Avx512, Family::Avx2, Family::Portable] {
        if family.is_supported() {
            set_family(family);
            test(family);
        } else {
            eprintln!("skipped: this machine has no {family:?}");
        }
    }
    // Restores the best family: unsupported ones are ignored, and the last call wins.
    for family in [Family::Portable, Family::Avx2, Family::Avx512] {
        set_family(family);
    }
}

/// Four `f32`: the features of a vertex.
pub trait Quad: Copy {
    /// Returns a number in all lanes.
    fn splat(value: f32) -> Self;
    /// Reads four numbers.
    fn load(from: &[f32; 4]) -> Self;
    /// Writes four numbers.
    fn store(self, to: &mut [f32; 4]);
    /// Returns self · factor + addend, rounded once.
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
pub trait Lanes: Copy {
    /// Four `f32` of the same family.
    type Quad: Quad;
    /// True if 24 `Self` fit into registers at once, as a matrix tile needs.
    const WIDE: bool;
    /// Returns a number in all lanes.
    fn splat(value: f32) -> Self;
    /// Reads sixteen numbers.
    fn load(from: &[f32; LANES]) -> Self;
    /// Writes sixteen numbers.
    fn store(self, to: &mut [f32; LANES]);
    /// Returns self · factor + addend, rounded once.
    fn mul_add(self, factor: Self, addend: Self) -> Self;
    /// Returns self in lanes where it is above 0, otherwise 0.
    fn positive(self) -> Self;
    /// Returns self in lanes where `gate` is above 0, otherwise 0.
    fn where_positive(self, gate: Self) -> Self;
    /// Returns the sum of the lanes of each of four values. Each pass adds the upper half of the
    /// remaining lanes to the lower half: first lane 8 to lane 0, 9 to 1, ….
    fn sums(four: [Self; 4]) -> Self::Quad;
    /// Prefetches the first cache line of elements that are needed soon.
    fn prefetch<T>(_soon: &[T]) {}
}

/// Sixteen floats for the compilation target.
#[derive(Clone, Copy, Debug)]
pub struct Portable([f32; LANES]);

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
    #[inline(always)]
    fn sums(four: [Self; 4]) -> Self::Quad {
        four.map(|Self(mut lanes)| {
            let mut width = LANES / 2;
            while width > 0 {
                for k in 0..width {
                    lanes[k] += lanes[k + width];
                }
                width /= 2;
            }
            lanes[0]
        })
    }
}

#[cfg(target_arch = "x86_64")]
pub mod x86 {
    //! Lanes in registers of x86-64. Intrinsics fix the vector width: with auto-vectorisation the
    //! accumulators of a matrix tile spill. Use these types only in functions compiled for their
    //! features (see `kernel!`): elsewhere, the `unsafe` is unsound on machines without them. There
    //! are no closures: a closure wouldn't inherit the features, and its intrinsics would be calls.

    use std::arch::x86_64::*;

    use super::{LANES, Lanes, Quad};

    /// Four floats.
    #[derive(Clone, Copy, Debug)]
    pub struct Four(__m128);

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

    impl Four {
        /// Sums each of four vectors of eight floats.
        ///
        /// # Safety
        /// The caller runs with AVX2.
        #[inline(always)]
        unsafe fn sums([a, b, c, d]: [__m256; 4]) -> Self {
            // SAFETY: the caller runs with AVX2.
            unsafe {
                let a = _mm_add_ps(_mm256_castps256_ps128(a), _mm256_extractf128_ps::<1>(a));
                let b = _mm_add_ps(_mm256_castps256_ps128(b), _mm256_extractf128_ps::<1>(b));
                let c = _mm_add_ps(_mm256_castps256_ps128(c), _mm256_extractf128_ps::<1>(c));
                let d = _mm_add_ps(_mm256_castps256_ps128(d), _mm256_extractf128_ps::<1>(d));
                let ab = _mm_add_ps(_mm_movelh_ps(a, b), _mm_movehl_ps(b, a));
                let cd = _mm_add_ps(_mm_movelh_ps(c, d), _mm_movehl_ps(d, c));
                Self(_mm_add_ps(
                    _mm_shuffle_ps::<0b10_00_10_00>(ab, cd),
                    _mm_shuffle_ps::<0b11_01_11_01>(ab, cd),
                ))
            }
        }
    }

    /// Sixteen floats in one register.
    #[derive(Clone, Copy, Debug)]
    pub struct Avx512(__m512);

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
        #[inline(always)]
        fn sums([a, b, c, d]: [Self; 4]) -> Four {
            // SAFETY: the caller runs with AVX-512.
            unsafe {
                Four::sums([
                    _mm256_add_ps(_mm512_castps512_ps256(a.0), _mm512_extractf32x8_ps::<1>(a.0)),
                    _mm256_add_ps(_mm512_castps512_ps256(b.0), _mm512_extractf32x8_ps::<1>(b.0)),
                    _mm256_add_ps(_mm512_castps512_ps256(c.0), _mm512_extractf32x8_ps::<1>(c.0)),
                    _mm256_add_ps(_mm512_castps512_ps256(d.0), _mm512_extractf32x8_ps::<1>(d.0)),
                ])
            }
        }
        #[inline(always)]
        fn prefetch<T>(soon: &[T]) {
            // SAFETY: it reads nothing that the program sees.
            unsafe { _mm_prefetch::<_MM_HINT_T0>(soon.as_ptr().cast()) }
        }
    }

    /// Sixteen floats in two registers.
    #[derive(Clone, Copy, Debug)]
    pub struct Avx2([__m256; 2]);

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
        fn mul_add(self, factor: Self, addend: Self) -> Self {
            // SAFETY: the caller runs with FMA.
            Self(unsafe {
                [
                    _mm256_fmadd_ps(self.0[0], factor.0[0], addend.0[0]),
                    _mm256_fmadd_ps(self.0[1], factor.0[1], addend.0[1]),
                ]
            })
        }
        #[inline(always)]
        fn positive(self) -> Self {
            // SAFETY: the caller runs with AVX2. A NaN gives the second operand, 0.
            Self(unsafe {
                let zero = _mm256_setzero_ps();
                [_mm256_max_ps(self.0[0], zero), _mm256_max_ps(self.0[1], zero)]
            })
        }
        #[inline(always)]
        fn where_positive(self, gate: Self) -> Self {
            // SAFETY: the caller runs with AVX2.
            Self(unsafe {
                let zero = _mm256_setzero_ps();
                [
                    _mm256_and_ps(self.0[0], _mm256_cmp_ps::<_CMP_GT_OQ>(gate.0[0], zero)),
                    _mm256_and_ps(self.0[1], _mm256_cmp_ps::<_CMP_GT_OQ>(gate.0[1], zero)),
                ]
            })
        }
        #[inline(always)]
        fn sums([a, b, c, d]: [Self; 4]) -> Four {
            // SAFETY: the caller runs with AVX2.
            unsafe {
                Four::sums([
                    _mm256_add_ps(a.0[0], a.0[1]),
                    _mm256_add_ps(b.0[0], b.0[1]),
                    _mm256_add_ps(c.0[0], c.0[1]),
                    _mm256_add_ps(d.0[0], d.0[1]),
                ])
            }
        }
        #[inline(always)]
        fn prefetch<T>(soon: &[T]) {
            // SAFETY: it reads nothing that the program sees.
            unsafe { _mm_prefetch::<_MM_HINT_T0>(soon.as_ptr().cast()) }
        }
    }
}

/// Defines a kernel: one body, generic over `L: Lanes`, compiled for every family. The family is
/// chosen at run time.
#[macro_export]
macro_rules! kernel {
    (
        $(#[$meta:meta])*
        $vis:vis fn $name:ident<$lanes:ident>($($arg:ident: $ty:ty),* $(,)?) $body:block
    ) => {
        $(#[$meta])*
        $vis fn $name($($arg: $ty),*) {
            #[inline(always)]
            fn body<$lanes: $crate::simd::Lanes>($($arg: $ty),*) $body
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")]
            fn avx512($($arg: $ty),*) {
                body::<$crate::simd::x86::Avx512>($($arg),*);
            }
            #[cfg(target_arch = "x86_64")]
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
