//! Image buffers and what happens to pixels on the way in and out.
//!
//! * [`Rgba8`]: 8-bit RGBA with straight alpha, as in PNG; [`Image`]: floating-point samples,
//!   channels interleaved.
//! * [`read_premultiplied`]: a view's image, PNG (straight alpha) or EXR (premultiplied), as
//!   premultiplied RGBA.
//! * [`read_png`], [`write_png`], [`PngRows`]; [`read_exr`], [`write_exr`]: one writer a format,
//!   whose bytes repeat.
//! * [`DepthMap`]: depth and opacity of a view, and its image for people.
//! * [`resize_pillow`]: Pillow's resampling to the last bit; [`average_pool`]: the paper code's
//!   `avg`.
//! * [`Resampling`]: the same as a linear operator in floats, with its adjoint; [`Degradation`]:
//!   which one made LR images.
//! * [`Exposure`]: what another exposure made of an image.
//! * [`Mask`]: which pixels of an image count.
//! * [`sample_cubic`], [`Image::colour_at`]: an image between its pixels.
//! * [`psnr_of`]: a mean squared error in dB.
//! * [`heat`]: a value in [0, 1] as a colour, for depth and error maps.
//!
//! Colours are display-encoded sRGB in [0, 1] throughout.
//!
//! ```
//! use pixels::{Filter, Rgba8, resize_pillow};
//! let image = Rgba8::new(4, 4, vec![200; 64]);
//! assert_eq!(resize_pillow(&image, 2, 2, Filter::Lanczos).data[0], 200);
//! ```

mod cubic;
mod degradation;
mod depth_map;
mod error;
mod exposure;
mod exr_file;
mod heat;
mod image_buffer;
mod image_file;
mod mask;
mod operator;
mod pillow_resample;
mod png_file;
mod pool;
mod srgb;

pub use cubic::sample_cubic;
pub use degradation::{DEGRADATION_FILE, Degradation, Kernel};
pub use depth_map::{DepthMap, common_range};
pub use error::{MAX_PIXELS, PixelError};
pub use exposure::Exposure;
pub use exr_file::{
    COLOUR_CHANNELS, Channel, DEPTH_CHANNELS, ExrImage, SampleType, exr_reading_bytes, exr_size,
    read_exr, write_exr,
};
pub use heat::{Palette, heat};
pub use image_buffer::{Image, Rgba8, psnr_of, to_u8};
pub use image_file::read_premultiplied;
pub use mask::Mask;
pub use operator::{AxisTaps, Resampling};
pub use pillow_resample::{Filter, resize_pillow};
pub use png_file::{PngRows, encode_png, read_png, write_png};
pub use pool::average_pool;
pub use srgb::{linear_from_srgb, srgb_from_linear};
