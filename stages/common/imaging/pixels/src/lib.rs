//! Image buffers, image files, resampling and colour conversion.
//!
//! * [`Rgba8`]: 8-bit RGBA with straight alpha, as in PNG; [`Image`]: floating-point samples,
//!   channels interleaved.
//! * [`read_premultiplied`]: reads a view's image, PNG (straight alpha) or EXR (premultiplied), as
//!   premultiplied RGBA.
//! * [`read_png`], [`write_png`], [`PngRows`]; [`read_exr`], [`write_exr`]: one writer per format,
//!   with reproducible bytes.
//! * [`DepthMap`]: depth and opacity of a view, and a drawing of them.
//! * [`resize_pillow`]: Pillow's resampling to the last bit; [`average_pool`]: the paper code's
//!   `avg`.
//! * [`Resampling`]: the same resampling as a linear operator in floats, with its adjoint;
//!   [`Degradation`]: kernel from HR to LR images.
//! * [`Exposure`]: affine change of each colour channel between two exposures.
//! * [`Mask`]: pixels of an image that count.
//! * [`sample_cubic`], [`Image::colour_at`]: cubic interpolation.
//! * [`psnr_of`]: a mean squared error in dB.
//! * [`medians`], [`are_similar`]: comparisons of 8-bit colours.
//! * [`palette_colour`]: colour scales of depth and error maps.
//!
//! Colours are display-encoded sRGB in [0, 1] throughout.
//!
//! ```
//! use pixels::{Filter, Rgba8, resize_pillow};
//! let image = Rgba8::new(4, 4, vec![200; 64]);
//! assert_eq!(resize_pillow(&image, 2, 2, Filter::Lanczos).data[0], 200);
//! ```

mod colour;
mod cubic;
mod degradation;
mod depth_map;
mod error;
mod exposure;
mod exr_file;
mod image_buffer;
mod mask;
mod operator;
mod pillow_resample;
mod png_file;
mod similar;

pub use colour::{Palette, linear_from_srgb, palette_colour, srgb_from_linear, to_u8};
pub use cubic::sample_cubic;
pub use degradation::{DEGRADATION_FILE, Degradation, Kernel, average_pool};
pub use depth_map::{DepthMap, common_range};
pub use error::{MAX_PIXELS, PixelError};
pub use exposure::Exposure;
pub use exr_file::{
    COLOUR_CHANNELS, Channel, DEPTH_CHANNELS, ExrImage, SampleType, check_finite,
    exr_reading_bytes, exr_size, read_exr, read_premultiplied, write_exr,
};
pub use image_buffer::{Image, Rgba8, psnr_of};
pub use mask::{MIN_BRIGHT_LEVEL, Mask};
pub use operator::{AxisTaps, Resampling};
pub use pillow_resample::{Filter, resize_pillow};
pub use png_file::{PngRows, encode_png, read_png, write_png};
pub use similar::{are_similar, count_similar, medians};
