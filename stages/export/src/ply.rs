use std::io::{self, Write};

/// Kinds of numbers of a PLY property.
#[derive(Clone, Copy)]
pub(crate) enum Kind {
    /// 32-bit floating point.
    Float,
    /// A byte.
    Byte,
}

/// Writes the header of a binary little-endian PLY file with one list of elements.
pub(crate) fn write_header(
    file: &mut impl Write,
    comments: &[String],
    count: usize,
    properties: &[(String, Kind)],
) -> io::Result<()> {
    writeln!(file, "ply\nformat binary_little_endian 1.0")?;
    comments.iter().try_for_each(|comment| writeln!(file, "comment {comment}"))?;
    writeln!(file, "element vertex {count}")?;
    for (name, kind) in properties {
        let kind = match kind {
            Kind::Float => "float",
            Kind::Byte => "uchar",
        };
        writeln!(file, "property {kind} {name}")?;
    }
    writeln!(file, "end_header")
}

/// Writes floating-point numbers.
pub(crate) fn write_floats(file: &mut impl Write, numbers: &[f32]) -> io::Result<()> {
    numbers.iter().try_for_each(|number| file.write_all(&number.to_le_bytes()))
}
