//! The stage's binary; see the library.

stage::main!(render_depth::RenderDepth);
