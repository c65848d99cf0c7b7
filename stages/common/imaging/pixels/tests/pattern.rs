//! Byte pattern, equal to that of scripts/goldens/images.py.

/// Returns noise, checkerboards and gradients, with alpha of every kind; `channels` interleaved.
pub fn pattern(width: usize, height: usize, channels: usize, seed: u32) -> Vec<u8> {
    let mut state = seed;
    let mut out = Vec::with_capacity(width * height * channels);
    for y in 0..height {
        for x in 0..width {
            for c in 0..channels {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                let mut value = match (x / 7 + y / 5) % 3 {
                    0 => (state >> 24) as u8,
                    1 => 255 * ((x + y + c) % 2) as u8,
                    _ => (x * 9 + y * 4 + c * 60) as u8,
                };
                if c == 3 && (x / 11 + y / 9) % 2 == 0 {
                    value = if (x / 11) % 2 == 1 { 0 } else { 255 };
                }
                out.push(value);
            }
        }
    }
    out
}
