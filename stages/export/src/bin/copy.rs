//! The binary of stage `copy`; see the library.

stage::main!(export::CopyFiles);
