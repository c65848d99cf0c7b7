//! The stage's binary; see the library.

stage::main!(train_ss::TrainSs);
