//! The stage's binary; see the library.

stage::main!(train_refine::TrainRefine);
