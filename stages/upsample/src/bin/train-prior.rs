//! The binary of stage `train-prior`; see the library.

stage::main!(upsample::TrainPrior);
