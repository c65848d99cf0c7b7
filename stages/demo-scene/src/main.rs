//! The stage's binary; see the library.

stage::main!(demo_scene::DemoScene);
