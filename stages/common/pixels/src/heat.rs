/// A colour scale.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Palette {
    /// Dark to light, for errors.
    Error,
    /// Rainbow-like with even steps, for depth.
    Depth,
}

/// The colour of a value in [0, 1]; outside it, of the nearer end.
pub fn heat(palette: Palette, value: f32) -> [u8; 3] {
    let gradient = match palette {
        Palette::Error => colorous::INFERNO,
        Palette::Depth => colorous::TURBO,
    };
    // NaN.max(0.0) is 0.0: even a broken value has a colour.
    let colour = gradient.eval_continuous(f64::from(value.max(0.0).min(1.0)));
    [colour.r, colour.g, colour.b]
}
