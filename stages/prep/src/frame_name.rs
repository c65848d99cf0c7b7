use dataset::Frame;

/// Where in the data set a complaint belongs.
pub(crate) fn frame_name(frame: &Frame) -> String {
    format!("frame {}", frame.name)
}
