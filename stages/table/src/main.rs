//! The stage's binary; see the library.

stage::main!(table::Table);
