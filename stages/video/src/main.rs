//! The stage's binary; see the library.

stage::main!(video::Video);
