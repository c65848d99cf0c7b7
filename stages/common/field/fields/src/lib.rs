//! Loader of field artifacts for stages that render: hash-grid fields and the paper's field.
//!
//! * [`FieldArtifact`]: all fields of an artifact, rendered as an ensemble. The mean of their
//!   renders cancels errors where images don't determine the scene (docs/design/011).
//!   [`read_field`] reads one of them.
//! * [`read_point_fields`]: all fields of an artifact at points, for baking.
//! * [`FieldFile`]: description of a field artifact.
//! * [`pixel_rays`]: the rays of a view's pixels.
//! * [`mean`], [`lower_median`]: a pixel's value from several fields or rays.
//!
//! ```no_run
//! use artifact::GivenInput;
//! let input = GivenInput::open("field", "field".as_ref())?;
//! let members = fields::FieldArtifact::read(&input, "cpu")?;
//! println!("{} fields over {:?}", members.fields.len(), members.file.background);
//! # Ok::<(), artifact::Failure>(())
//! ```

mod field_file;

use std::path::Path;

use artifact::{Failure, FailureExt as _, GivenInput};
use radiance::{Field, Pixel, PointField, Ray, RayField, RenderError};
use rayon::prelude::*;
use scene::{Background, Bounds, Camera};

pub use field_file::{FIELD_FILE, FIELD_FORMAT, FieldFile, FieldModel};

/// Environment variables that change renders. Builds without libtorch list them, too, so that keys
/// agree. If 1, `TORCH_ALLOW_TF32_CUBLAS_OVERRIDE` lets CUDA multiply in TensorFloat-32, with a
/// mantissa of ten bits.
pub const ENVIRONMENT: &[&str] = &["TORCH_ALLOW_TF32_CUBLAS_OVERRIDE"];

/// Fields of an artifact.
pub struct FieldArtifact {
    /// Description of the fields.
    pub file: FieldFile,
    /// Fields on the requested device.
    pub fields: Vec<Box<dyn RayField>>,
}

impl FieldArtifact {
    /// Reads all fields of an input onto device `cpu` or `cuda:N`.
    ///
    /// # Errors
    /// [`Failure::BadInput`] if the input can't be read, [`Failure::Usage`] if the device can't be
    /// used.
    pub fn read(input: &GivenInput, device: &str) -> Result<Self, Failure> {
        let file = read_field_file(input)?;
        let paths = (0..file.members).map(|index| input.path(&FieldFile::member_file(index)));
        let fields = paths.map(|path| read_field(file.field, file.bounds, &path, device));
        let fields = fields.collect::<Result<_, _>>()?;
        Ok(Self { file, fields })
    }
}

/// Reads all fields of an input, to be evaluated at points by the CPU.
///
/// # Errors
/// Those of [`FieldArtifact::read`].
pub fn read_point_fields(
    input: &GivenInput,
) -> Result<(FieldFile, Vec<Box<dyn PointField>>), Failure> {
    let file = read_field_file(input)?;
    let paths = (0..file.members).map(|index| input.path(&FieldFile::member_file(index)));
    let fields = paths.map(|path| read_point_field(file.field, file.bounds, &path));
    Ok((file, fields.collect::<Result<_, _>>()?))
}

fn read_point_field(
    model: FieldModel,
    bounds: Bounds,
    weights: &Path,
) -> Result<Box<dyn PointField>, Failure> {
    match model {
        FieldModel::Grid(architecture) => {
            Ok(Box::new(Field::read(weights, architecture, bounds).bad_input("field")?))
        }
        #[cfg(feature = "torch")]
        FieldModel::Mlp(architecture) => {
            let field = torch_field::Mlp::read(weights, architecture, bounds, torch_device("cpu")?);
            Ok(Box::new(torch_field::MlpPoints::new(field.bad_input("field")?)))
        }
        #[cfg(not(feature = "torch"))]
        FieldModel::Mlp(_) => Err(needs_libtorch("field: mlp")),
    }
}

/// Reads and checks the description of an input's fields.
///
/// # Errors
/// [`Failure::BadInput`] with the file and the number that is out of range.
pub fn read_field_file(input: &GivenInput) -> Result<FieldFile, Failure> {
    let file: FieldFile = input.read_json(FIELD_FILE)?;
    file.check().bad_input(input.path(FIELD_FILE).display())?;
    Ok(file)
}

/// Renders the mean of all members. The median depth is the median of the members' median depths: a
/// mean would invent a surface between two surfaces.
impl RayField for FieldArtifact {
    fn render(&self, rays: &[Ray]) -> Result<Vec<Pixel>, RenderError> {
        let renders: Vec<Vec<Pixel>> =
            self.fields.iter().map(|field| field.render(rays)).collect::<Result<_, _>>()?;
        let mut of_ray = Vec::with_capacity(renders.len());
        let pixels: Vec<Pixel> = (0..rays.len())
            .map(|ray| {
                of_ray.clear();
                of_ray.extend(renders.iter().map(|pixels| pixels[ray]));
                average_pixels(&mut of_ray)
            })
            .collect();
        if pixels.iter().all(Pixel::is_finite) { Ok(pixels) } else { Err(RenderError::NotFinite) }
    }
}

/// Combines several fields' renders of one ray.
fn average_pixels(pixels: &mut [Pixel]) -> Pixel {
    Pixel {
        colour: [0, 1, 2].map(|c| mean(pixels, |p| p.colour[c])),
        premultiplied: [0, 1, 2].map(|c| mean(pixels, |p| p.premultiplied[c])),
        opacity: mean(pixels, |p| p.opacity),
        depth: mean(pixels, |p| p.depth),
        median_depth: lower_median(pixels, |p| p.median_depth).map_or(0.0, |p| p.median_depth),
    }
}

/// Minimum number of rays that a task casts; chosen by hand.
const MIN_RAYS_PER_TASK: usize = 64;

/// Returns n × n rays through each of a camera's pixels `[x, y]`, pixel by pixel, and the z-depth
/// per unit of distance along each ray.
pub fn pixel_rays(
    camera: &Camera,
    background: Background,
    pixels: &[[usize; 2]],
    n: usize,
) -> (Vec<Ray>, Vec<f32>) {
    let (camera_rays, background) = (camera.rays(), [background.grey_level(); 3]);
    let rays = (0..pixels.len() * n * n).into_par_iter().with_min_len(MIN_RAYS_PER_TASK);
    rays.map(|i| {
        let ([x, y], sub) = (pixels[i / (n * n)], i % (n * n));
        let u = x as f64 + ((sub % n) as f64 + 0.5) / n as f64;
        let v = y as f64 + ((sub / n) as f64 + 0.5) / n as f64;
        let ray = camera_rays.ray(u, v);
        (Ray::new(&ray, background), camera.depth_per_distance(&ray) as f32)
    })
    .unzip()
}

/// Returns the mean of one number over all items; 0 if there are none.
pub fn mean<T>(items: &[T], number: impl Fn(&T) -> f32) -> f32 {
    let share = 1.0 / items.len().max(1) as f32;
    share * items.iter().map(number).sum::<f32>()
}

/// Sorts the items by distance and returns the middle one; of two, the nearer. NaN is beyond all
/// numbers, on the side of its sign.
pub fn lower_median<T>(items: &mut [T], distance: impl Fn(&T) -> f32) -> Option<&T> {
    items.sort_unstable_by(|a, b| distance(a).total_cmp(&distance(b)));
    items.get(items.len().saturating_sub(1) / 2)
}

/// Converts a render error to a failure with its exit code: 4 if numbers aren't finite, otherwise
/// 1.
pub fn rendering_failure(error: RenderError) -> anyhow::Error {
    match error {
        RenderError::NotFinite => Failure::Numerical(error.to_string()).into(),
        RenderError::Backend(_) => error.into(),
    }
}

/// Reads the weights of one field onto device `cpu` or `cuda:N`.
///
/// # Errors
/// Those of [`FieldArtifact::read`].
pub fn read_field(
    model: FieldModel,
    bounds: Bounds,
    weights: &Path,
    device: &str,
) -> Result<Box<dyn RayField>, Failure> {
    match model {
        FieldModel::Grid(architecture) => {
            move_grid(Field::read(weights, architecture, bounds).bad_input("field")?, device)
        }
        #[cfg(feature = "torch")]
        FieldModel::Mlp(architecture) => {
            let device = torch_device(device)?;
            let field = torch_field::Mlp::read(weights, architecture, bounds, device);
            Ok(Box::new(field.bad_input("field")?))
        }
        #[cfg(not(feature = "torch"))]
        FieldModel::Mlp(_) => Err(needs_libtorch("field: mlp")),
    }
}

/// Moves a grid field to a device other than the CPU by libtorch.
fn move_grid(field: Field, device: &str) -> Result<Box<dyn RayField>, Failure> {
    if device == "cpu" {
        return Ok(Box::new(field));
    }
    #[cfg(feature = "torch")]
    return Ok(Box::new(
        torch_field::TorchGrid::new(&field, torch_device(device)?).usage("--device")?,
    ));
    #[cfg(not(feature = "torch"))]
    Err(needs_libtorch(&format!("--device {device}")))
}

/// Creates the failure of a program without libtorch, which `argument` needs.
pub fn needs_libtorch(argument: &str) -> Failure {
    Failure::Usage(format!(
        "{argument} needs libtorch, and this program was built without it; run `make build`"
    ))
}

/// Opens a device of libtorch, on which equal calls give equal bits.
///
/// # Errors
/// [`Failure::Usage`] if the device can't be used.
#[cfg(feature = "torch")]
pub fn torch_device(device: &str) -> Result<nets::Device, Failure> {
    nets::deterministic();
    nets::device(device).map_err(|error| Failure::Usage(error.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use radiance::Architecture;

    /// Field with the same opacity everywhere.
    struct UniformField(f32);

    impl RayField for UniformField {
        fn render(&self, rays: &[Ray]) -> Result<Vec<Pixel>, RenderError> {
            Ok(vec![Pixel { opacity: self.0, ..Pixel::default() }; rays.len()])
        }
    }

    fn render_with_opacity(opacity: f32) -> Result<Vec<Pixel>, RenderError> {
        let file = FieldFile {
            format: FIELD_FORMAT,
            field: FieldModel::Grid(Architecture::default()),
            members: 1,
            bounds: Bounds::default(),
            background: Background::White,
        };
        let members = FieldArtifact { file, fields: vec![Box::new(UniformField(opacity))] };
        members.render(&[Ray::default()])
    }

    /// Pixels that aren't finite give exit code 4, an error of the backend 1.
    #[test]
    fn rendering_failures_have_exit_codes() {
        assert_eq!(render_with_opacity(0.5).unwrap()[0].opacity, 0.5);
        let failure = rendering_failure(render_with_opacity(f32::NAN).unwrap_err());
        assert_eq!(artifact::exit_code(&failure), 4);
        let backend_failure = rendering_failure(RenderError::Backend("out of memory".to_owned()));
        assert_eq!(artifact::exit_code(&backend_failure), 1);
        assert_eq!(backend_failure.to_string(), "cannot render the field: out of memory");
    }

    /// The result doesn't depend on the items' order, even with ties, infinities and NaN.
    #[test]
    fn the_lower_median_is_found_in_any_order() {
        let nan = f32::NAN.copysign(1.0);
        let cases: [(&[f32], Option<f32>); 9] = [
            (&[], None),
            (&[5.0], Some(5.0)),
            (&[2.0, 9.0], Some(2.0)),
            (&[2.0, 4.0, 9.0], Some(4.0)),
            (&[1.0, 2.0, 3.0, 100.0], Some(2.0)),
            (&[1.0, 7.0, 7.0], Some(7.0)),
            (&[1.0, 1.0, 7.0, 7.0], Some(1.0)),
            (&[1.0, 2.0, f32::INFINITY, nan, nan], Some(f32::INFINITY)),
            (&[-nan, 1.0, 2.0], Some(1.0)),
        ];
        for (distances, expected) in cases {
            for shift in 0..distances.len().max(1) {
                let mut items = distances.to_vec();
                items.rotate_left(shift);
                let mut reversed: Vec<f32> = items.iter().rev().copied().collect();
                assert_eq!(lower_median(&mut items, |d| *d).copied(), expected, "{distances:?}");
                assert_eq!(lower_median(&mut reversed, |d| *d).copied(), expected, "{distances:?}");
            }
        }
    }

    #[test]
    fn the_whole_median_item_is_returned() {
        let mut items = [(3.0, "far"), (1.0, "near"), (2.0, "middle")];
        assert_eq!(lower_median(&mut items, |item| item.0), Some(&(2.0, "middle")));
        assert_eq!(mean(&items, |item| item.0 + 1.0), 3.0);
    }

    fn write_file(folder: &Path, architecture: Architecture, bounds: Bounds, members: u32) {
        let file = FieldFile {
            format: FIELD_FORMAT,
            field: FieldModel::Grid(architecture),
            members,
            bounds,
            background: Background::White,
        };
        std::fs::write(folder.join(FIELD_FILE), serde_json::to_vec(&file).unwrap()).unwrap();
    }

    fn ray(x: f64) -> Ray {
        Ray { origin: [x, 0.1, 4.0], direction: [0.0, 0.0, -1.0], background: [1.0; 3] }
    }

    /// All members are read and their renders averaged; a missing member or a number out of range
    /// is an error.
    #[test]
    fn members_are_averaged() {
        let bounds = Bounds::cube(1.0, 2.0, 6.0);
        let architecture = Architecture {
            max_resolution: 32,
            n_levels: 4,
            log2_hashmap_size: 10,
            march_steps: 64,
            ..Architecture::default()
        };
        let folder = tempfile::tempdir().unwrap();
        let fields: Vec<Field> = [3, 4].map(|seed| Field::new(architecture, bounds, seed)).into();
        for (i, field) in (0..).zip(&fields) {
            field.write(&folder.path().join(FieldFile::member_file(i))).unwrap();
        }
        let read =
            || FieldArtifact::read(&GivenInput::open("field", folder.path()).unwrap(), "cpu");
        let rays: Vec<Ray> = [-0.5, 0.0, 0.7].map(ray).into();
        write_file(folder.path(), architecture, bounds, 2);
        let averaged = RayField::render(&read().unwrap(), &rays).unwrap();
        let separate: Vec<_> = fields.iter().map(|f| f.render(&rays)).collect();
        for (i, pixel) in averaged.iter().enumerate() {
            let mean =
                |value: fn(&Pixel) -> f32| 0.5 * (value(&separate[0][i]) + value(&separate[1][i]));
            assert!(
                (pixel.colour[1] - mean(|p| p.colour[1])).abs() < 1e-6
                    && (pixel.opacity - mean(|p| p.opacity)).abs() < 1e-6
            );
            assert!(
                (pixel.depth - mean(|p| p.depth)).abs() < 1e-5 && separate[0][i] != separate[1][i]
            );
            // The nearer of two depths: the space between them may be empty.
            let nearer = separate[0][i].median_depth.min(separate[1][i].median_depth);
            assert_eq!(pixel.median_depth, nearer);
        }
        for (members, expected) in [(3, "field-2.safetensors"), (0, "members = 0")] {
            write_file(folder.path(), architecture, bounds, members);
            let message = format!("{:#}", read().err().unwrap());
            assert!(message.contains(expected), "{message}");
        }
    }
}
