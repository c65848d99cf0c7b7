use super::*;
use serde_json::json;

/// Each schema accepts its valid value, and refuses its invalid value with the expected message.
#[test]
fn values_fit_schemas_or_are_refused() {
    for (schema, valid, invalid, expected) in [
        (json!({"type": "integer"}), json!(2.0), json!(2.5), "2.5 is not a whole number"),
        (
            json!({"type": ["integer", "null"]}),
            Value::Null,
            json!("a"),
            "\"a\" is not a whole number or null",
        ),
        (json!({"type": "number"}), json!(1), json!(true), "true is not a number"),
        (json!({"type": "object"}), json!({}), json!([]), "[] is not a mapping"),
        (json!({"const": 2}), json!(2.0), json!(3), "2 was expected"),
        (json!({"const": {"a": [1]}}), json!({"a": [1.0]}), json!({"a": []}), "was expected"),
        (json!({"enum": ["a", 1]}), json!(1), json!("b"), "\"b\" is not one of \"a\", 1"),
        (json!({"minimum": 1}), json!(1.0), json!(0), "0 is less than the minimum of 1"),
        (json!({"maximum": 0.5}), json!(0.5), json!(1), "1 is greater than the maximum of 0.5"),
        (
            json!({"maximum": u64::MAX}),
            json!(u64::MAX),
            json!(18_446_744_073_709_551_616.0),
            "greater than the maximum of 18446744073709551615",
        ),
        (json!({"minimum": i64::MIN}), json!(i64::MIN), json!(-1e30), "less than the minimum"),
        (json!({"exclusiveMinimum": 0}), json!(1e-9), json!(0), "0 is not greater than 0"),
        (json!({"exclusiveMaximum": 1}), json!(0), json!(1.0), "is not less than 1"),
        (json!({"multipleOf": 1}), json!(2.0), json!(2.7), "2.7 is not a multiple of 1"),
        (json!({"multipleOf": 0.1}), json!(0.3), json!(0.35), "not a multiple of 0.1"),
        (json!({"minLength": 2}), json!("äö"), json!("ä"), "has fewer than 2 characters"),
        (json!({"maxLength": 2}), json!("äö"), json!("abc"), "has more than 2 characters"),
        (json!({"minItems": 1}), json!([0]), json!([]), "[] has fewer than 1 items"),
        (json!({"maxItems": 1}), json!([0]), json!([0, 1]), "has more than 1 items"),
        (json!({"items": {"type": "null"}}), json!([null]), json!([null, 1]), "1 is not null"),
        (
            json!({"prefixItems": [{"type": "null"}], "items": {"type": "string"}}),
            json!([null, "a"]),
            json!([null, null]),
            "null is not text",
        ),
        (json!({"required": ["a"]}), json!({"a": 1}), json!({}), "\"a\" is missing"),
        (
            json!({"properties": {"a": {}}, "additionalProperties": false}),
            json!({"a": 1}),
            json!({"b": 1}),
            "\"b\" is not expected",
        ),
        (
            json!({"additionalProperties": {"type": "null"}}),
            json!({"a": null}),
            json!({"a": 1}),
            "1 is not null",
        ),
        (
            json!({"anyOf": [{"type": "null"}, {"maximum": 1}]}),
            Value::Null,
            json!(2),
            "2 fits none of the alternatives",
        ),
        (
            json!({"oneOf": [{"type": "null"}, {"const": 1}]}),
            json!(1),
            json!(2),
            "2 fits none of the alternatives",
        ),
        (
            json!({"oneOf": [{"minimum": 1}, {"minimum": 2}]}),
            json!(1),
            json!(2),
            "2 fits several alternatives",
        ),
        (
            json!({"allOf": [{"minimum": 1}, {"maximum": 2}]}),
            json!(2),
            json!(3),
            "greater than the maximum",
        ),
        (json!({"not": {"const": "a"}}), json!("b"), json!("a"), "\"a\" isn't allowed"),
        (
            json!({"$ref": "#/$defs/A", "$defs": {"A": {"type": "null"}}}),
            Value::Null,
            json!(1),
            "1 is not null",
        ),
        // No value is invalid, and no message is expected.
        (json!({"not": false, "x-own": 1, "format": "uri"}), json!(1), json!(1), ""),
        (json!({"properties": {"a": false}}), json!({}), json!({"a": 1}), "1 isn't allowed"),
        // Keywords of other types don't apply.
        (
            json!({"minimum": 3, "minLength": 3, "not": {"const": 4}}),
            json!([]),
            json!(4),
            "4 isn't",
        ),
    ] {
        let validator = Validator::new(&schema).unwrap();
        assert!(validator.is_valid(&valid), "{schema} {valid}");
        let problems: Vec<String> =
            validator.violations(&invalid).into_iter().map(|violation| violation.problem).collect();
        assert!(
            expected.is_empty() || (problems.len() == 1 && problems[0].contains(expected)),
            "{schema} {invalid}: {problems:?}"
        );
    }
}

#[test]
fn a_violation_contains_the_path_of_its_value() {
    let schema = json!({"properties": {"a": {"items": {"type": "null"}}}});
    let violations = Validator::new(&schema).unwrap().violations(&json!({"a": [null, 2]}));
    let [Violation { path, value, .. }] = &violations[..] else { panic!("{violations:?}") };
    assert_eq!((path.as_str(), value), ("/a/1", &json!(2)));
}

/// Unsupported keywords are refused at any depth: no value may pass unchecked.
#[test]
fn unsupported_schemas_are_refused() {
    for (schema, expected) in [
        (json!(1), "neither an object nor true or false"),
        (json!({"type": "nonsense"}), "keyword type cannot have the value \"nonsense\""),
        (json!({"type": 1}), "type cannot have the value 1"),
        (json!({"enum": 1}), "enum cannot have the value 1"),
        (json!({"minimum": "1"}), "minimum cannot have the value \"1\""),
        (json!({"multipleOf": 0}), "multipleOf cannot have the value 0"),
        (json!({"maxItems": -1}), "maxItems cannot have the value -1"),
        (json!({"$ref": "#/$defs/A"}), "$ref cannot have the value \"#/$defs/A\""),
        (json!({"$ref": "other.json"}), "$ref cannot have the value \"other.json\""),
        (json!({"anyOf": {}}), "anyOf cannot have the value {}"),
        (json!({"properties": []}), "properties cannot have the value []"),
        (json!({"properties": {"a": {"pattern": "a+"}}}), "keyword pattern isn't supported"),
        (json!({"$defs": {"A": {"items": {"if": {}}}}}), "keyword if isn't supported"),
        (json!({"items": {"not": 3}}), "3 is neither"),
    ] {
        let problem = Validator::new(&schema).unwrap_err().to_string();
        assert!(problem.contains(expected), "{schema}: {problem}");
    }
}

/// A schema may refer to itself for nested values, but not for the value itself.
#[test]
fn recursive_schemas_accept_nested_values_only() {
    let nested_lists = json!({"type": "array", "items": {"$ref": "#"}});
    let nested_lists = Validator::new(&nested_lists).unwrap();
    assert!(nested_lists.is_valid(&json!([[], [[]]])) && !nested_lists.is_valid(&json!([[], [1]])));
    for schema in [json!({"$ref": "#"}), json!({"anyOf": [{"$ref": "#"}]})] {
        assert!(!Validator::new(&schema).unwrap().is_valid(&json!(1)), "{schema}");
    }
}
