//! Hashes the stage's sources into `STAGE_FINGERPRINT`.

fn main() {
    fingerprint::emit();
}
