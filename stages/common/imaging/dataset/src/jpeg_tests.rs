use super::*;
use jpeg_encoder::{ColorType, Encoder, SamplingFactor};

/// Encodes a noisy image as JPEG: grey if `sampling` is `None`, without restart markers if
/// `restart_interval` is 0.
pub(crate) fn jpeg(
    (width, height): (u16, u16),
    sampling: Option<SamplingFactor>,
    is_progressive: bool,
    restart_interval: u16,
) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, 80);
    encoder.set_progressive(is_progressive);
    encoder.set_optimized_huffman_tables(restart_interval == 0);
    if restart_interval > 0 {
        encoder.set_restart_interval(restart_interval);
    }
    let channels = if sampling.is_some() { 3 } else { 1 };
    let samples: Vec<u8> = (0..usize::from(width) * usize::from(height) * channels)
        .map(|i| (i * 7 + i * i / 31) as u8)
        .collect();
    let colours = if channels == 3 { ColorType::Rgb } else { ColorType::Luma };
    if let Some(sampling) = sampling {
        encoder.set_sampling_factor(sampling);
    }
    encoder.encode(&samples, width, height, colours).unwrap();
    bytes
}

/// Returns a JPEG that only the decoder reads: the decoder takes a restart marker for a segment.
pub(crate) fn hidden_jpeg() -> Vec<u8> {
    let bytes = jpeg(SIZE, None, false, 0);
    let hidden = [&bytes[..2], b"\xff\xd7\0\x08\xff\xe0\xff\xff\0\0", &bytes[2..]].concat();
    assert!(decoded(&hidden).is_some());
    hidden
}

const SAMPLINGS: [Option<SamplingFactor>; 6] = [
    None,
    Some(SamplingFactor::R_4_4_4),
    Some(SamplingFactor::R_4_2_2),
    Some(SamplingFactor::R_4_2_0),
    Some(SamplingFactor::R_4_4_0),
    Some(SamplingFactor::R_4_1_1),
];

const SIZE: (u16, u16) = (45, 70);
const ROWS: u32 = 70;

fn decoded(bytes: &[u8]) -> Option<Vec<u8>> {
    image::load_from_memory(bytes).ok().map(|image| image.into_rgb8().into_raw())
}

/// Rows above the counted missing ones are decoded as in the complete image.
#[test]
fn missing_rows_are_counted() {
    for sampling in SAMPLINGS {
        for restart_interval in [0, 4] {
            let bytes = jpeg(SIZE, sampling, false, restart_interval);
            let case = format!("{sampling:?}, restart {restart_interval}");
            assert_eq!(check_completeness(&bytes), Completeness::Complete, "{case}");
            assert_eq!(
                check_completeness(&[&bytes, &b"\xff\xd8 more"[..]].concat()),
                Completeness::Complete
            );
            let complete = decoded(&bytes).unwrap();
            let scan = bytes.windows(2).position(|w| w == [0xff, SOS]).unwrap();
            let mut previous = ROWS;
            for end in (scan + 20..bytes.len()).step_by(13) {
                let cut = &bytes[..end];
                let zeros = [cut, &[0; 512]].concat();
                let terminated = [cut, &END_MARKER].concat();
                let (found, rows) = match check_completeness(cut) {
                    missing @ Completeness::Missing { rows, height: ROWS } => (missing, rows),
                    Completeness::Unterminated { end: found } if found == end => {
                        (Completeness::Complete, 0)
                    }
                    other => panic!("{case}: {other:?} at {end}"),
                };
                assert!(
                    rows <= previous,
                    "{case}: {rows} rows missing at {end}, {previous} before"
                );
                previous = rows;
                assert_eq!(check_completeness(&terminated), found, "{case} at {end}");
                if rows > 0 {
                    assert_eq!(check_completeness(&zeros), found, "{case} at {end}");
                }
                // The decoder blends the row above the missing ones with them. After a restart
                // marker, the decoder may stop earlier.
                let compared = 3 * usize::from(SIZE.0) * (ROWS - rows).saturating_sub(1) as usize;
                if let Some(pixels) = decoded(&terminated) {
                    let is_same =
                        restart_interval > 0 || pixels[..compared] == complete[..compared];
                    assert!(is_same, "{case}: rows above the {rows} missing ones at {end}");
                    assert!(rows > 0 || pixels == complete, "{case}: no row is missing at {end}");
                }
            }
            assert!(previous < 20, "{case}: {previous} rows missing near the end");
            let end = bytes.len() - END_MARKER.len();
            assert_eq!(
                check_completeness(&bytes[..end]),
                Completeness::Unterminated { end },
                "{case}"
            );
        }
    }
}

/// At an unknown marker, the decoder would drop the last blocks.
#[test]
fn unknown_markers_end_the_image_data() {
    for sampling in SAMPLINGS {
        let bytes = jpeg(SIZE, sampling, false, 0);
        let complete = decoded(&bytes).unwrap();
        let end = bytes.len() - END_MARKER.len();
        for (marker, fill) in [(&b"\xff\x46"[..], 0), (b"\xff\xe5", 0), (b"\xff\xff\xff\xf3", 2)] {
            let tail = [marker, &b"\x00\x04ab"[..], &END_MARKER].concat();
            let mut extended = [&bytes[..end], &tail].concat();
            let found = check_completeness(&extended);
            assert_eq!(found, Completeness::Unterminated { end: end + fill }, "{sampling:?}");
            extended.truncate(end + fill);
            extended.extend(END_MARKER);
            assert!(decoded(&extended).unwrap() == complete, "{sampling:?} {marker:?}");
        }
        let known = [&bytes[..end], b"\xff\xe1\x00\x04ab", &END_MARKER].concat();
        assert_eq!(check_completeness(&known), Completeness::Complete);
        assert!(decoded(&known).unwrap() == complete, "{sampling:?}");
    }
}

#[test]
fn a_truncated_progressive_jpeg_is_coarse() {
    for sampling in SAMPLINGS {
        for restart_interval in [0, 4] {
            let bytes = jpeg(SIZE, sampling, true, restart_interval);
            assert_eq!(check_completeness(&bytes), Completeness::Complete);
            for end in (bytes.len() / 4..bytes.len()).step_by(17) {
                let found = check_completeness(&bytes[..end]);
                assert!(
                    matches!(found, Completeness::Coarse { height: ROWS, .. }),
                    "{found:?} at {end}"
                );
            }
        }
    }
}

#[test]
fn an_invalid_scan_header_is_damage() {
    for is_progressive in [false, true] {
        let bytes = jpeg(SIZE, Some(SamplingFactor::R_4_2_0), is_progressive, 0);
        let scan = bytes.windows(2).position(|w| w == [0xff, SOS]).unwrap();
        // The first component's number follows the marker, the length and the number of components.
        let mut unknown = bytes.clone();
        unknown[scan + 5] = 9;
        let expected = if is_progressive {
            Completeness::Coarse { scan: 1, height: ROWS }
        } else {
            Completeness::Missing { rows: ROWS, height: ROWS }
        };
        assert_eq!(check_completeness(&unknown), expected);
        if is_progressive {
            let mut invalid_band = bytes;
            let components = usize::from(invalid_band[scan + 4]);
            invalid_band[scan + 5 + 2 * components] = 34;
            assert_eq!(check_completeness(&invalid_band), expected);
        }
    }
}

/// The loss of a piece is found even if restart markers let the decoder resume after it.
#[test]
fn rows_of_a_lost_piece_are_missing() {
    let bytes = jpeg(SIZE, Some(SamplingFactor::R_4_4_4), false, 6);
    let marker = |n: u8| bytes.windows(2).position(|w| w == [0xff, 0xd0 + n]).unwrap();
    let (from, to) = (marker(2), marker(3));
    let lost = [&bytes[..from + 12], &bytes[to..]].concat();
    assert_eq!(check_completeness(&lost), Completeness::Missing { rows: 8, height: ROWS });
}

#[test]
fn any_bytes_are_checked() {
    for sampling in SAMPLINGS {
        let bytes = jpeg((20, 20), sampling, false, 2);
        for offset in 0..bytes.len() {
            for value in [0, 1, 0x11, 0x7f, 0xff] {
                let mut damaged = bytes.clone();
                damaged[offset] = value;
                check_completeness(&damaged);
            }
            check_completeness(&bytes[offset..]);
        }
    }
    assert_eq!(check_completeness(b""), Completeness::UnreadableHeader);
    assert_eq!(check_completeness(&hidden_jpeg()), Completeness::UnreadableHeader);
}
