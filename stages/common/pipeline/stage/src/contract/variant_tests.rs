//! Parameters that select a variant.

use serde_json::{Map, Value, json};

use crate::contract::Schema;

fn schema_json() -> Value {
    json!({
        "type": "object",
        "additionalProperties": false,
        "properties": {
            "seed": {"type": "integer", "default": 0},
            "field": {"$ref": "#/$defs/Field", "default": {"grid": {"rays": 30, "levels": 8}},
            "description": "Which."}
        },
        "$defs": {
            "Field": {"oneOf": [
                {"type": "object", "properties": {"mlp": {"$ref": "#/$defs/Mlp"}},
                    "required": ["mlp"]},
                {"type": "object", "properties": {"grid": {"$ref": "#/$defs/Grid"}},
                    "required": ["grid"]}
            ]},
            "Grid": {"properties": {
                "rays": {"type": "integer", "default": 30},
                "levels": {"type": "integer", "maximum": 16, "default": 8},
                "steps": {"type": ["integer", "null"], "default": null, "x-default": "by scene"}
            }},
            "Mlp": {"properties": {
                "rays": {"type": ["integer", "null"], "default": null, "x-default": "by scene"},
                "layers": {"type": "integer", "default": 8}
            }}
        }
    })
}

fn schema() -> Schema {
    Schema::new(&schema_json()).unwrap()
}

fn map(value: &Value) -> Map<String, Value> {
    value.as_object().cloned().unwrap()
}

/// Returns a copy of `base` with one entry changed.
fn with(base: &Value, name: &str, value: u32) -> Value {
    let mut changed = base.clone();
    changed[name] = json!(value);
    changed
}

#[test]
fn flat_and_nested_parameters_resolve_alike() {
    let grid = json!({"field": "grid", "rays": 30, "levels": 8, "steps": null, "seed": 0});
    let mlp = json!({"field": "mlp", "rays": null, "layers": 8, "seed": 0});
    for (given, expected) in [
        (json!({}), grid.clone()),
        (json!({"field": "grid"}), grid.clone()),
        (json!({"field": {"grid": {}}}), grid.clone()),
        (json!({"levels": 4}), with(&grid, "levels", 4)),
        (json!({"field": {"grid": {"levels": 4.0}}}), with(&grid, "levels", 4)),
        (json!({"field": {"grid": {"levels": 4}}, "levels": 5}), with(&grid, "levels", 5)),
        (json!({"field": "mlp"}), mlp.clone()),
        (json!({"field": {"mlp": {}}}), mlp.clone()),
        (json!({"field": "mlp", "layers": 2}), with(&mlp, "layers", 2)),
        (json!({"field": {"mlp": {"rays": 5}}}), with(&mlp, "rays", 5)),
    ] {
        assert_eq!(schema().resolve(&map(&given)).unwrap(), expected, "{given}");
    }
}

#[test]
fn foreign_and_unknown_parameters_are_refused() {
    for (given, expected) in [
        (
            json!({"layers": 2}),
            "parameter layers: belongs to field: mlp; leave it out, or choose field: mlp",
        ),
        (json!({"field": "mlp", "levels": 2}), "parameter levels: belongs to field: grid"),
        (json!({"field": {"mlp": {"levels": 2}}}), "parameter levels: belongs to field: grid"),
        (
            json!({"field": {"grid": {"levels": 17}}}),
            "parameter levels: 17 is greater than the maximum",
        ),
        (
            json!({"field": {"grid": {"levles": 2}}}),
            "parameter levles: unknown; did you mean levels?",
        ),
        (json!({"field": "voxels"}), r#"parameter field: "voxels" is not one of "grid", "mlp""#),
        (json!({"field": {"voxels": {}}}), "parameter field: {\"voxels\":{}} is not one of"),
        (json!({"field": {"grid": 3}}), "parameter field: {\"grid\":3} is not one of"),
        (json!({"field": {"grid": {}, "mlp": {}}}), "is not one of"),
        (json!({"field": null}), "null is not one of"),
    ] {
        let problems = schema().resolve(&map(&given)).unwrap_err();
        assert!(problems[0].to_string().contains(expected), "{given}: {}", problems[0]);
    }
}

/// A variant that is selected later has its own defaults; common parameters stay.
#[test]
fn a_later_variant_drops_parameters_that_it_lacks() {
    for (earlier, later, expected) in [
        (
            json!({"levels": 4, "rays": 9}),
            json!({"field": "mlp"}),
            json!({"field": "mlp", "rays": 9}),
        ),
        (
            json!({"field": {"grid": {"levels": 4}}, "seed": 1}),
            json!({"field": "mlp"}),
            json!({"field": "mlp", "seed": 1}),
        ),
        (
            json!({"field": {"grid": {"levels": 4}}}),
            json!({"levels": 5}),
            json!({"field": "grid", "levels": 5}),
        ),
        (json!({"levels": 4}), json!({"field": "grid"}), json!({"field": "grid", "levels": 4})),
        (json!({"levles": 4}), json!({"field": "mlp"}), json!({"field": "mlp", "levles": 4})),
        (json!({"levels": 4}), json!({"layers": 5}), json!({"levels": 4, "layers": 5})),
    ] {
        let mut given = Map::new();
        [&earlier, &later]
            .into_iter()
            .for_each(|layer| schema().override_with(&mut given, &map(layer)));
        assert_eq!(Value::Object(given), expected, "{earlier}, then {later}");
    }
}

#[test]
fn the_stage_gets_nested_parameters() {
    let resolved = schema().resolve(&map(&json!({"field": "mlp"}))).unwrap();
    assert_eq!(
        schema().nested(&resolved),
        json!({"field": {"mlp": {"rays": null, "layers": 8}}, "seed": 0})
    );
    assert_eq!(schema().by_scene(&resolved), ["rays"]);
    assert_eq!(schema().names(), ["field", "layers", "levels", "rays", "seed", "steps"]);
    assert_eq!(schema().canonical_value("layers", &json!(8.0)), json!(8));
}

#[test]
fn ambiguous_names_are_refused() {
    let mut duplicate = schema_json();
    duplicate["properties"]["layers"] = json!({"default": 1});
    assert!(
        Schema::new(&duplicate)
            .unwrap_err()
            .to_string()
            .contains("variant mlp of field has a parameter layers, like the stage itself")
    );
    let mut two_variants = schema_json();
    two_variants["properties"]["other"] = two_variants["properties"]["field"].clone();
    assert!(Schema::new(&two_variants).unwrap_err().to_string().contains("both select a variant"));
}
