//! Amounts as people write them: `8G`, `1h30m`.

use std::fmt::{self, Display, Formatter};
use std::marker::PhantomData;
use std::str::FromStr;

use serde::de::{Deserializer, Error, Visitor};

/// A text that is no amount.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum AmountError {
    /// It is no amount of memory.
    #[error("{0:?} is no amount of memory; write a number with M, G or T, such as 8G")]
    Memory(String),
    /// It is no time.
    #[error("{0:?} is no time; write numbers with d, h, m or s, such as 2h or 1h30m")]
    Period(String),
}

/// An amount of memory in whole MiB: `512M`, `8G`, `1T`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Memory {
    pub(crate) mib: u64,
}

/// A time in whole seconds: `90s`, `30m`, `2h`, `1d12h`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Period {
    pub(crate) seconds: u64,
}

impl Memory {
    /// In bytes.
    pub fn bytes(self) -> u64 {
        self.mib.saturating_mul(1 << 20)
    }
}

impl Period {
    /// In minutes, a begun one counted: Slurm's unit.
    pub(crate) fn minutes(self) -> u64 {
        self.seconds.div_ceil(60)
    }
}

const MEMORY_UNITS: [(char, u64); 3] = [('T', 1 << 20), ('G', 1 << 10), ('M', 1)];
const PERIOD_UNITS: [(char, u64); 4] = [('d', 86_400), ('h', 3600), ('m', 60), ('s', 1)];

impl FromStr for Memory {
    type Err = AmountError;

    fn from_str(text: &str) -> Result<Self, AmountError> {
        let problem = || AmountError::Memory(text.to_owned());
        let (count, last) = split_unit(text).ok_or_else(problem)?;
        let unit = MEMORY_UNITS.iter().find(|(unit, _)| *unit == last).ok_or_else(problem)?.1;
        let mib = count.parse::<u64>().ok().and_then(|count| count.checked_mul(unit));
        // Slurm takes 0 as all there is.
        mib.filter(|&mib| mib > 0).map(|mib| Self { mib }).ok_or_else(problem)
    }
}

impl FromStr for Period {
    type Err = AmountError;

    fn from_str(text: &str) -> Result<Self, AmountError> {
        let problem = || AmountError::Period(text.to_owned());
        let mut units = PERIOD_UNITS.iter();
        let mut seconds = 0u64;
        for piece in text.split_inclusive(|c: char| !c.is_ascii_digit()) {
            let (count, last) = split_unit(piece).ok_or_else(problem)?;
            // Each unit comes once, the larger one first.
            let unit = units.find(|(unit, _)| *unit == last).ok_or_else(problem)?.1;
            let more = count.parse::<u64>().ok().and_then(|count| count.checked_mul(unit));
            seconds = more.and_then(|more| seconds.checked_add(more)).ok_or_else(problem)?;
        }
        if seconds == 0 { Err(problem()) } else { Ok(Self { seconds }) }
    }
}

/// A number's digits and the one letter after them.
fn split_unit(text: &str) -> Option<(&str, char)> {
    let last = text.chars().next_back()?;
    let count = &text[..text.len() - last.len_utf8()];
    (!count.is_empty() && count.bytes().all(|b| b.is_ascii_digit())).then_some((count, last))
}

impl Display for Memory {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let (name, unit) = MEMORY_UNITS
            .iter()
            .find(|(_, unit)| self.mib.is_multiple_of(*unit))
            .unwrap_or(&('M', 1));
        write!(f, "{}{name}", self.mib / unit)
    }
}

impl Display for Period {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let mut left = self.seconds;
        for (name, unit) in PERIOD_UNITS.iter().filter(|(_, unit)| self.seconds >= *unit) {
            if left >= *unit {
                write!(f, "{}{name}", left / unit)?;
            }
            left %= unit;
        }
        Ok(())
    }
}

/// Reads an amount; a bare number gets the amount's own error, which says what is missing.
pub(crate) fn read<'de, D: Deserializer<'de>, T: FromStr<Err = AmountError>>(
    deserializer: D,
) -> Result<T, D::Error> {
    struct Words<T>(PhantomData<T>);
    impl<T: FromStr<Err = AmountError>> Visitor<'_> for Words<T> {
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
    deserializer.deserialize_any(Words(PhantomData))
}

macro_rules! as_text {
    ($type:ty) => {
        impl serde::Serialize for $type {
            fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                serializer.collect_str(self)
            }
        }
        impl<'de> serde::Deserialize<'de> for $type {
            fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                read(deserializer)
            }
        }
    };
}
as_text!(Memory);
as_text!(Period);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn amounts_of_memory() {
        for (text, mib, shown) in [
            ("512M", 512, "512M"),
            ("8G", 8192, "8G"),
            ("1024M", 1024, "1G"),
            ("1T", 1 << 20, "1T"),
            ("1500M", 1500, "1500M"),
        ] {
            let memory: Memory = text.parse().unwrap();
            assert_eq!((memory.mib, memory.to_string().as_str()), (mib, shown));
        }
        for text in
            ["", "G", "8", "0G", "-8G", "8GB", "8g", "1.5G", "8 G", "18446744073709551615T", "８G"]
        {
            let problem = text.parse::<Memory>().unwrap_err().to_string();
            assert!(problem.contains("such as 8G"), "{text}: {problem}");
        }
    }

    #[test]
    fn times() {
        for (text, seconds, minutes, shown) in [
            ("90s", 90, 2, "1m30s"),
            ("30m", 1800, 30, "30m"),
            ("2h", 7200, 120, "2h"),
            ("1d12h", 129_600, 2160, "1d12h"),
            ("1h30m", 5400, 90, "1h30m"),
        ] {
            let period: Period = text.parse().unwrap();
            assert_eq!(
                (period.seconds, period.minutes(), period.to_string().as_str()),
                (seconds, minutes, shown)
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
