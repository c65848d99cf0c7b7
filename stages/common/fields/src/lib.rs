//! Whatever radiance field an artifact holds, ready to cast rays through: what stages that render
//! have in common.
//!
//! * [`Members`]: all fields of an artifact. What they render is averaged: each errs in its own way
//!   where images leave it open.
//!
//! ```no_run
//! use artifact::GivenInput;
//! let input = GivenInput::open("field", "field".as_ref())?;
//! let members = fields::Members::read(&input, "cpu")?;
//! println!("{} fields over {:?}", members.fields.len(), members.file.background);
//! # Ok::<(), anyhow::Error>(())
//! ```

use std::error::Error;
use std::path::PathBuf;

use artifact::{Failure, FailureExt as _, GivenInput};
use radiance::{FIELD_FILE, Field, FieldFile, FieldModel, Pixel, Ray, RayField};

/// Variables of the environment that change what fields render.
pub const ENVIRONMENT: &[&str] = &[
    #[cfg(feature = "torch")]
    nets::TF32_VARIABLE,
];

/// The fields of an artifact.
pub struct Members {
    /// What the artifact says of them.
    pub file: FieldFile,
    /// Each of them, on the device asked for.
    pub fields: Vec<Box<dyn RayField>>,
}

impl Members {
    /// Reads all of an input, whichever field it is, onto `cpu` or `cuda:N`.
    pub fn read(input: &GivenInput, device: &str) -> anyhow::Result<Self> {
        let file: FieldFile = input.read_json(FIELD_FILE)?;
        file.check().map_err(|reason| {
            Failure::BadInput(format!("{}: {reason}", input.path(FIELD_FILE).display()))
        })?;
        let fields = read_all(&file, input, device)?;
        Ok(Self { file, fields })
    }
}

/// The mean of what all members see. A distance that half of the light stops at is the mean of
/// theirs, too.
impl RayField for Members {
    fn render(&self, rays: &[Ray]) -> Result<Vec<Pixel>, Box<dyn Error + Send + Sync>> {
        let mut rendered = self.fields.iter().map(|field| field.render(rays));
        let mut sums = rendered.next().transpose()?.unwrap_or_default();
        for pixels in rendered {
            for (sum, pixel) in sums.iter_mut().zip(pixels?) {
                for c in 0..3 {
                    sum.colour[c] += pixel.colour[c];
                    sum.premultiplied[c] += pixel.premultiplied[c];
                }
                sum.opacity += pixel.opacity;
                sum.depth += pixel.depth;
                sum.median_depth += pixel.median_depth;
            }
        }
        let share = 1.0 / self.fields.len().max(1) as f32;
        let mean = |p: Pixel| Pixel {
            colour: p.colour.map(|v| share * v),
            premultiplied: p.premultiplied.map(|v| share * v),
            opacity: share * p.opacity,
            depth: share * p.depth,
            median_depth: share * p.median_depth,
        };
        Ok(sums.into_iter().map(mean).collect())
    }
}

fn read_all(
    file: &FieldFile,
    input: &GivenInput,
    device: &str,
) -> anyhow::Result<Vec<Box<dyn RayField>>> {
    let paths = (0..file.members).map(|i| input.path(&FieldFile::member(i)));
    match file.field {
        FieldModel::Grid(architecture) => {
            let read =
                |path: PathBuf| Field::read(&path, architecture, file.bounds).bad_input("field");
            paths.map(|path| grid_on(device, read(path)?)).collect()
        }
        #[cfg(feature = "torch")]
        FieldModel::Mlp(architecture) => {
            let device = nets::device(device).map_err(|e| Failure::Usage(e.to_string()))?;
            nets::deterministic();
            let read = |path: PathBuf| {
                torch_field::Mlp::read(&path, architecture, file.bounds, device).bad_input("field")
            };
            paths.map(|path| Ok(Box::new(read(path)?) as Box<dyn RayField>)).collect()
        }
        #[cfg(not(feature = "torch"))]
        FieldModel::Mlp(_) => {
            let message = "field: mlp needs libtorch, and this was built without it; build with \
                --features torch";
            Err(Failure::Usage(message.to_owned()).into())
        }
    }
}

/// A grid: on the CPU as it is, elsewhere through libtorch.
#[cfg(feature = "torch")]
fn grid_on(device: &str, field: Field) -> anyhow::Result<Box<dyn RayField>> {
    if device == "cpu" {
        return Ok(Box::new(field));
    }
    let device = nets::device(device).map_err(|e| Failure::Usage(e.to_string()))?;
    nets::deterministic();
    Ok(Box::new(torch_field::TorchGrid::new(&field, device)?))
}

#[cfg(not(feature = "torch"))]
fn grid_on(device: &str, field: Field) -> anyhow::Result<Box<dyn RayField>> {
    if device == "cpu" {
        return Ok(Box::new(field));
    }
    let message = format!(
        "--device {device}: it needs libtorch, and this was built without it; build with \
        --features torch"
    );
    Err(Failure::Usage(message).into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use radiance::Architecture;
    use scene::{Background, Bounds};

    /// All members are read, and what they see is averaged; one that is missing, and numbers that
    /// can't be, are refused.
    #[test]
    fn members_are_averaged() {
        let bounds =
            Bounds { min: [-1.0; 3], max: [1.0; 3], near: 2.0, far: 6.0, ..Bounds::default() };
        let architecture = Architecture {
            finest: 32,
            levels: 4,
            log2_entries: 10,
            steps: 64,
            ..Architecture::default()
        };
        let folder = tempfile::tempdir().unwrap();
        let write = |members: u32| {
            let file = FieldFile {
                format: radiance::FIELD_FORMAT,
                field: FieldModel::Grid(architecture),
                members,
                bounds,
                background: Background::White,
            };
            std::fs::write(folder.path().join(FIELD_FILE), serde_json::to_vec(&file).unwrap())
                .unwrap();
        };
        let fields: Vec<Field> = [3, 4].map(|seed| Field::new(architecture, bounds, seed)).into();
        for (i, field) in (0..).zip(&fields) {
            field.write(&folder.path().join(FieldFile::member(i))).unwrap();
        }
        let read = || Members::read(&GivenInput::open("field", folder.path()).unwrap(), "cpu");
        let ray = |x: f32| Ray {
            origin: [x, 0.1, 4.0],
            direction: [0.0, 0.0, -1.0],
            background: [1.0; 3],
        };
        let rays: Vec<Ray> = [-0.5, 0.0, 0.7].map(ray).into();
        write(2);
        let together = RayField::render(&read().unwrap(), &rays).unwrap();
        let apart: Vec<_> = fields.iter().map(|f| f.render(&rays)).collect();
        for (i, pixel) in together.iter().enumerate() {
            let mean = |of: fn(&Pixel) -> f32| 0.5 * (of(&apart[0][i]) + of(&apart[1][i]));
            assert!(
                (pixel.colour[1] - mean(|p| p.colour[1])).abs() < 1e-6
                    && (pixel.opacity - mean(|p| p.opacity)).abs() < 1e-6
            );
            assert!((pixel.depth - mean(|p| p.depth)).abs() < 1e-5 && apart[0][i] != apart[1][i]);
        }
        for (members, expected) in [(3, "field-2.safetensors"), (0, "members = 0")] {
            write(members);
            let message = format!("{:#}", read().err().unwrap());
            assert!(message.contains(expected), "{message}");
        }
    }
}
