use serde_json::Value;

/// Reason why a parameter schema can't be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SchemaError {
    /// A part of the schema is invalid or not supported.
    #[error("invalid or unsupported JSON Schema: {0}")]
    Keyword(KeywordError),
    /// Two parameters select a variant; at most one may.
    #[error("{first} and {second} both select a variant; at most one parameter may")]
    TwoSelectors {
        /// First parameter that selects a variant.
        first: String,
        /// Second parameter that selects a variant.
        second: String,
    },
    /// A common parameter and a variant's parameter have the same name.
    #[error("variant {variant} of {selector} has a parameter {name}, like the stage itself")]
    AmbiguousName {
        /// Name of both parameters.
        name: String,
        /// Parameter that selects a variant.
        selector: String,
        /// Variant with a parameter of the same name.
        variant: String,
    },
}

/// Invalid or unsupported part of a JSON Schema.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum KeywordError {
    /// The value is not a schema.
    #[error("{0} is neither an object nor true or false")]
    NotASchema(Value),
    /// The keyword's value is invalid.
    #[error("keyword {keyword} cannot have the value {value}")]
    InvalidValue {
        /// Keyword.
        keyword: String,
        /// Value of the keyword.
        value: Value,
    },
    /// The keyword is not supported.
    #[error("keyword {0} isn't supported; leave it out")]
    Unsupported(String),
}
