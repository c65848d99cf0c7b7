use serde::Serialize;

/// Formats a value as canonical JSON, the only form that is hashed: sorted keys, no white space,
/// numbers as `serde_json` prints them.
///
/// # Panics
/// If the value can't be JSON (a map whose keys aren't strings), which is a programming error.
pub fn canonical_json(value: &impl Serialize) -> String {
    let mut value = serde_json::to_value(value).expect("hashed types serialise to JSON");
    // `serde_json` keeps insertion order if any crate enables its `preserve_order`.
    value.sort_all_objects();
    value.to_string()
}

/// Hashes the [`canonical_json`] of a value: blake3, in hexadecimal.
pub fn hash_json(value: &impl Serialize) -> String {
    blake3::hash(canonical_json(value).as_bytes()).to_hex().to_string()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::Value;

    use super::*;

    fn any_json() -> impl Strategy<Value = Value> {
        let leaf = prop_oneof![
            Just(Value::Null),
            any::<bool>().prop_map(Value::from),
            any::<i64>().prop_map(Value::from),
            any::<f64>().prop_filter("finite", |x| x.is_finite()).prop_map(Value::from),
            ".*".prop_map(Value::from),
        ];
        leaf.prop_recursive(4, 32, 6, |inner| {
            prop_oneof![
                prop::collection::vec(inner.clone(), 0..6).prop_map(Value::from),
                prop::collection::vec((".*", inner), 0..6)
                    .prop_map(|v| Value::Object(v.into_iter().collect())),
            ]
        })
    }

    proptest! {
        #[test]
        fn canonical_form_parses_back_and_is_stable(value in any_json()) {
            let text = canonical_json(&value);
            let back: Value = serde_json::from_str(&text).unwrap();
            prop_assert_eq!(&back, &value);
            prop_assert_eq!(canonical_json(&back), text);
        }

        #[test]
        fn key_order_does_not_matter(mut entries in prop::collection::btree_map(".*", any::<i32>(),
            0..8)) {
            let forward: serde_json::Map<_, _> = entries.iter().map(|(k, v)| (k.clone(),
                (*v).into())).collect();
            let mut backward = serde_json::Map::new();
            while let Some((k, v)) = entries.pop_last() {
                backward.insert(k, v.into());
            }
            prop_assert_eq!(hash_json(&forward), hash_json(&backward));
        }
    }
}
