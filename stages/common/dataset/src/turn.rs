/// Treatment of a photograph's EXIF orientation. Poses are commonly found for stored images, so
/// a photograph is turned only where its camera has the turned shape.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Turn {
    /// Pixels as stored: EXIF asks for no turn, or the camera has the stored shape.
    #[default]
    Stored,
    /// Pixels turned as EXIF asks.
    Upright,
    /// Pixels as stored by assumption: EXIF asks for a turn, and both shapes fit the camera.
    Assumed,
}
