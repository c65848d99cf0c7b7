//! Human-readable amounts of memory and durations: `8G`, `1h30m`.

use std::fmt::{self, Display, Formatter};
use std::marker::PhantomData;
use std::str::FromStr;

use serde::de::{Deserializer, Error, Visitor};

/// Error returned when a text is not an amount.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct AmountError(String);

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

    fn parse(text: &str) -> Option<Self> {
        let (count, letter) = split_unit(text)?;
        let (_, factor) = MEMORY_UNITS.iter().find(|(unit, _)| *unit == letter)?;
        // Slurm reads `--mem=0` as all memory of a node.
        count.checked_mul(*factor).filter(|&mib| mib > 0).map(|mib| Self { mib })
    }
}

impl Period {
    /// Returns the duration in minutes, Slurm's unit, rounded up.
    pub(crate) fn minutes(self) -> u64 {
        self.seconds.div_ceil(60)
    }

    fn parse(text: &str) -> Option<Self> {
        let mut units = PERIOD_UNITS.iter();
        let mut seconds = 0u64;
        for piece in text.split_inclusive(|c: char| !c.is_ascii_digit()) {
            let (count, letter) = split_unit(piece)?;
            // The iterator only advances: each unit occurs at most once, larger units first.
            let (_, factor) = units.find(|(unit, _)| *unit == letter)?;
            seconds = seconds.checked_add(count.checked_mul(*factor)?)?;
        }
        (seconds > 0).then_some(Self { seconds })
    }
}

/// Splits an amount into its number and the letter of its unit.
fn split_unit(text: &str) -> Option<(u64, char)> {
    let letter = text.chars().next_back()?;
    let digits = &text[..text.len() - letter.len_utf8()];
    // `u64::from_str` would accept a leading `+`.
    let is_number = digits.bytes().all(|b| b.is_ascii_digit());
    Some((digits.parse().ok().filter(|_| is_number)?, letter))
}

impl FromStr for Memory {
    type Err = AmountError;

    fn from_str(text: &str) -> Result<Self, AmountError> {
        let remedy = "write a number with M, G or T, such as 8G";
        Self::parse(text)
            .ok_or_else(|| AmountError(format!("invalid amount of memory {text:?}; {remedy}")))
    }
}

impl FromStr for Period {
    type Err = AmountError;

    fn from_str(text: &str) -> Result<Self, AmountError> {
        let remedy = "write numbers with d, h, m or s, such as 2h or 1h30m";
        Self::parse(text).ok_or_else(|| AmountError(format!("invalid duration {text:?}; {remedy}")))
    }
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

/// Reads an amount. A number without a unit fails with [`AmountError`], which asks for the unit,
/// instead of with a type error.
fn deserialize_amount<'de, D: Deserializer<'de>, T: FromStr<Err = AmountError>>(
    deserializer: D,
) -> Result<T, D::Error> {
    struct AmountVisitor<T>(PhantomData<T>);
    impl<T: FromStr<Err = AmountError>> Visitor<'_> for AmountVisitor<T> {
        type Value = T;

        fn expecting(&self, f: &mut Formatter<'_>) -> fmt::Result {
            f.write_str("a number with its unit")
        }

        fn visit_str<E: Error>(self, text: &str) -> Result<T, E> {
            text.parse().map_err(E::custom)
        }

        fn visit_u64<E: Error>(self, number: u64) -> Result<T, E> {
            self.visit_str(&number.to_string())
        }

        fn visit_i64<E: Error>(self, number: i64) -> Result<T, E> {
            self.visit_str(&number.to_string())
        }

        fn visit_f64<E: Error>(self, number: f64) -> Result<T, E> {
            self.visit_str(&number.to_string())
        }
    }
    deserializer.deserialize_any(AmountVisitor(PhantomData))
}

macro_rules! serde_as_text {
    ($type:ty) => {
        impl serde::Serialize for $type {
            fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                serializer.collect_str(self)
            }
        }
        impl<'de> serde::Deserialize<'de> for $type {
            fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                deserialize_amount(deserializer)
            }
        }
    };
}
serde_as_text!(Memory);
serde_as_text!(Period);

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
        for text in
            ["", "G", "8", "0G", "-8G", "8GB", "8g", "1.5G", "8 G", "18446744073709551615T", "８G"]
        {
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
