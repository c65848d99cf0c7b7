use serde_json::Value;

/// A parameter schema that can't be used: what is wrong with it.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SchemaError {
    /// It isn't one that is understood.
    #[error("not a JSON Schema: {0}")]
    Keyword(KeywordError),
    /// Which variant's parameters there are depends on two of them.
    #[error("one where {first} and {second} both select a variant")]
    Selectors {
        /// The one.
        first: String,
        /// The other.
        second: String,
    },
    /// A name means two parameters.
    #[error("one where {name} is a parameter beside {selector} and inside its {variant}")]
    Ambiguous {
        /// The name.
        name: String,
        /// The parameter that selects a variant.
        selector: String,
        /// The variant that has one of that name, too.
        variant: String,
    },
}

/// What is wrong with a JSON Schema.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum KeywordError {
    /// Something that is no schema at all.
    #[error("{0} is neither an object nor true or false")]
    Kind(Value),
    /// A keyword with a value that it can't have.
    #[error("{keyword}: {value} can't stand there")]
    Misused {
        /// The keyword.
        keyword: String,
        /// Its value.
        value: Value,
    },
    /// A keyword that isn't understood.
    #[error("keyword {0} isn't supported; leave it out")]
    Unsupported(String),
}
