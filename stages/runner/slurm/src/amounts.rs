//! Human-readable amounts of memory and durations: `8G`, `1h30m`.

use std::fmt::{self, Display, Formatter};
use std::str::FromStr;

use serde::de::{Deserialize, Deserializer, Error, Visitor};

use crate::SlurmError;

/// An amount of memory in whole MiB: `512M`, `8G`, `1T`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Memory {
    pub(crate) mib: u64,
}

/// A duration in whole seconds: `90s`, `30m`, `2h`, `1d12h`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Period {
    pub(crate) seconds: u64,
}

const MEMORY_UNITS: [(char, u64); 3] = [('T', 1 << 20), ('G', 1 << 10), ('M', 1)];
const PERIOD_UNITS: [(char, u64); 4] = [('d', 86_400), ('h', 3600), ('m', 60), ('s', 1)];

impl Memory {
    /// Returns the amount in bytes.
    pub fn bytes(self) -> u64 {
        self.mib.saturating_mul(1 << 20)
    }

    /// Parses one number with its unit: Slurm knows no sums of memory.
    fn parse(text: &str) -> Option<u64> {
        let has_one_unit = text.chars().filter(|c| !c.is_ascii_digit()).count() == 1;
        parse_sum(text, &MEMORY_UNITS).filter(|_| has_one_unit)
    }
}

impl Period {
    /// Returns the duration in minutes, Slurm's unit, rounded up.
    pub(crate) fn minutes(self) -> u64 {
        self.seconds.div_ceil(60)
    }

    fn parse(text: &str) -> Option<u64> {
        parse_sum(text, &PERIOD_UNITS)
    }
}

/// Parses numbers with units, larger units first, to a sum. Returns `None` for other texts, and for
/// 0, which Slurm reads as all memory of a node or as no time limit.
fn parse_sum(text: &str, units: &[(char, u64)]) -> Option<u64> {
    let mut units = units.iter();
    let mut sum = 0u64;
    for piece in text.split_inclusive(|c: char| !c.is_ascii_digit()) {
        let letter = piece.chars().next_back()?;
        let count: u64 = piece.strip_suffix(letter)?.parse().ok()?;
        // The iterator only advances: each unit occurs at most once.
        let (_, factor) = units.find(|(unit, _)| *unit == letter)?;
        sum = sum.checked_add(count.checked_mul(*factor)?)?;
    }
    (sum > 0).then_some(sum)
}

impl Display for Memory {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let (unit, factor) = MEMORY_UNITS
            .into_iter()
            .find(|(_, factor)| self.mib.is_multiple_of(*factor))
            .expect("all numbers are multiples of 1");
        write!(f, "{}{unit}", self.mib / factor)
    }
}

impl Display for Period {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let mut left = self.seconds;
        for (unit, factor) in PERIOD_UNITS {
            if left >= factor {
                write!(f, "{}{unit}", left / factor)?;
            }
            left %= factor;
        }
        Ok(())
    }
}

// Implements `FromStr` by the type's own `parse`, and serde's traits by `FromStr` and `Display`.
macro_rules! impl_text_conversions {
    ($type:ident { $field:ident }, $name:literal, $units_and_example:literal) => {
        impl FromStr for $type {
            type Err = SlurmError;

            fn from_str(text: &str) -> Result<Self, SlurmError> {
                let $field = Self::parse(text).ok_or_else(|| {
                    let remedy = concat!("write a number with ", $units_and_example);
                    SlurmError(format!("invalid {} {text:?}; {remedy}", $name))
                })?;
                Ok(Self { $field })
            }
        }
        impl serde::Serialize for $type {
            fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                serializer.collect_str(self)
            }
        }
        impl<'de> Deserialize<'de> for $type {
            fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                struct Text;
                impl Visitor<'_> for Text {
                    type Value = $type;

                    fn expecting(&self, f: &mut Formatter<'_>) -> fmt::Result {
                        f.write_str(concat!("a number with ", $units_and_example))
                    }

                    fn visit_str<E: Error>(self, text: &str) -> Result<$type, E> {
                        text.parse().map_err(E::custom)
                    }
                }
                deserializer.deserialize_str(Text)
            }
        }
    };
}
impl_text_conversions!(Memory { mib }, "amount of memory", "M, G or T, such as 8G");
impl_text_conversions!(Period { seconds }, "duration", "d, h, m or s, such as 2h or 1h30m");

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_sizes_are_parsed_and_formatted() {
        for (text, mib, formatted) in [
            ("512M", 512, "512M"),
            ("8G", 8192, "8G"),
            ("1024M", 1024, "1G"),
            ("1T", 1 << 20, "1T"),
            ("1500M", 1500, "1500M"),
        ] {
            let memory: Memory = text.parse().unwrap();
            assert_eq!((memory.mib, memory.to_string().as_str()), (mib, formatted));
        }
        for text in [
            "",
            "G",
            "8",
            "0G",
            "-8G",
            "8GB",
            "8g",
            "1.5G",
            "8 G",
            "1G512M",
            "18446744073709551615T",
            "８G",
        ] {
            let problem = text.parse::<Memory>().unwrap_err().to_string();
            assert!(problem.contains("such as 8G"), "{text}: {problem}");
        }
    }

    #[test]
    fn durations_are_parsed_and_formatted() {
        for (text, seconds, minutes, formatted) in [
            ("90s", 90, 2, "1m30s"),
            ("30m", 1800, 30, "30m"),
            ("2h", 7200, 120, "2h"),
            ("1d12h", 129_600, 2160, "1d12h"),
            ("1h30m", 5400, 90, "1h30m"),
        ] {
            let period: Period = text.parse().unwrap();
            assert_eq!(
                (period.seconds, period.minutes(), period.to_string().as_str()),
                (seconds, minutes, formatted)
            );
        }
        for text in [
            "",
            "2",
            "h",
            "0m",
            "-2h",
            "2H",
            "30m1h",
            "1h1h",
            "2:00:00",
            "1.5h",
            "1h ",
            "99999999999999999999d",
        ] {
            let problem = text.parse::<Period>().unwrap_err().to_string();
            assert!(problem.contains("such as 2h"), "{text}: {problem}");
        }
    }
}
