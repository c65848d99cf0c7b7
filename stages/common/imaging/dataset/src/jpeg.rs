//! Finds the end marker of a JPEG (ITU-T T.81), which a file that is cut short lacks. The decoder
//! fills the missing rows with grey, without an error.

const TEM: u8 = 0x01;
const FIRST_RESTART: u8 = 0xd0;
const SOI: u8 = 0xd8;
const EOI: u8 = 0xd9;

/// Returns whether a JPEG has its end marker, whatever follows the marker. Damaged image data
/// before the marker are not found.
pub(crate) fn has_end(jpeg: &[u8]) -> bool {
    let mut rest = jpeg;
    while let Some((marker, after)) = next_marker(rest) {
        rest = match marker {
            EOI => return true,
            // These markers have no segment.
            TEM | FIRST_RESTART..=SOI => after,
            // A segment may contain end markers, such as that of a thumbnail.
            _ => match segment_end(after) {
                Some(end) => end,
                None => return false,
            },
        };
    }
    false
}

/// Finds the next marker, also in image data; returns it and the bytes after it.
fn next_marker(bytes: &[u8]) -> Option<(u8, &[u8])> {
    let is_marker = |pair: &[u8]| pair[0] == 0xff && !matches!(pair[1], 0 | 0xff);
    let offset = bytes.windows(2).position(is_marker)?;
    Some((bytes[offset + 1], &bytes[offset + 2..]))
}

/// Returns the bytes after a segment, which begins with its length; `None` if the file ends first.
fn segment_end(bytes: &[u8]) -> Option<&[u8]> {
    let length = u16::from_be_bytes(*bytes.first_chunk()?);
    bytes.get(usize::from(length)..)
}

#[cfg(test)]
mod tests {
    use jpeg_encoder::{ColorType, Encoder, SamplingFactor};

    use super::*;

    /// Makes a noisy JPEG of 45×70 pixels, with an end marker in a segment.
    fn jpeg(sampling: SamplingFactor, is_progressive: bool, restart_interval: u16) -> Vec<u8> {
        let mut bytes = Vec::new();
        let mut encoder = Encoder::new(&mut bytes, 80);
        encoder.set_progressive(is_progressive);
        if restart_interval > 0 {
            encoder.set_restart_interval(restart_interval);
        }
        encoder.set_sampling_factor(sampling);
        encoder.add_app_segment(1, b"Exif\xff\xd8\xff\xd9".to_vec()).unwrap();
        let samples: Vec<u8> =
            (0..45 * 70 * 3).map(|i: usize| (i * 7 + i * i / 31) as u8).collect();
        encoder.encode(&samples, 45, 70, ColorType::Rgb).unwrap();
        bytes
    }

    #[test]
    fn the_end_of_every_kind_is_found() {
        for sampling in [SamplingFactor::R_4_4_4, SamplingFactor::R_4_2_0] {
            for (is_progressive, restart_interval) in [(false, 0), (false, 4), (true, 0), (true, 4)]
            {
                let bytes = jpeg(sampling, is_progressive, restart_interval);
                let case = format!("{sampling:?} {is_progressive} {restart_interval}");
                assert!(has_end(&bytes) && has_end(&[&bytes, &b"\xff\xd8 more"[..]].concat()));
                for end in 0..bytes.len() {
                    assert!(!has_end(&bytes[..end]), "{case}: cut at {end}");
                }
                let zeros = [&bytes[..bytes.len() / 2], &[0; 512]].concat();
                assert!(!has_end(&zeros), "{case}: an interrupted copy");
            }
        }
    }
}
