//! The stage's binary; see the library.

stage::main!(camera_path::CameraPath);
