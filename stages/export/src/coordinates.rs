/// What coordinates in all files are.
pub(crate) const COORDINATES: &str =
    "coordinates, scale and orientation are those of the input's cameras";
