//! Build script of all stages: hashes a stage's sources into `STAGE_FINGERPRINT`.

fn main() {
    fingerprint::emit();
}
