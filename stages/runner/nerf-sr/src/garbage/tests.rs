//! Garbage collection against its definition, on random stores.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;

use artifact::{hash_json, unix_time};
use proptest::prelude::*;
use serde_json::{Map, Value, json};
use store::{
    KEY_VERSION, KEY_VERSION_PART, KeyLock, Locked, PartialKey, Record, RunFile, Store, Unfinished,
};

use super::{Collection, Policy, Root};

/// Action of a random store. Numbers refer to earlier actions, modulo their count.
#[derive(Debug, Clone)]
struct Action {
    stage: u8,
    parameter: u8,
    /// Earlier actions whose outputs are inputs.
    inputs: Vec<u8>,
    /// Content of the output; equal contents are one object.
    content: u8,
    days_old: u64,
    state: State,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum State {
    Finished,
    WithCheckpoint,
    WithoutCheckpoint,
}

/// Reason for keeping actions.
#[derive(Debug, Clone)]
enum Holder {
    Pin(Vec<u8>),
    Lock(u8),
    Run { keys: Vec<u8>, waiting: Vec<(u8, u8)>, days_ago: u64, in_progress: bool },
}

#[derive(Debug, Clone)]
struct Case {
    actions: Vec<Action>,
    holders: Vec<Holder>,
    plan: (Vec<u8>, Vec<(u8, u8)>),
    keep_days: u64,
    drop_unfinished: bool,
}

fn cases() -> impl Strategy<Value = Case> {
    let state = prop_oneof![
        6 => Just(State::Finished),
        1 => Just(State::WithCheckpoint),
        1 => Just(State::WithoutCheckpoint)
    ];
    let inputs = prop::collection::vec(any::<u8>(), 0..3);
    let action = (0..3u8, 0..2u8, inputs, 0..6u8, 0..20u64, state).prop_map(
        |(stage, parameter, inputs, content, days_old, state)| Action {
            stage,
            parameter,
            inputs,
            content,
            days_old,
            state,
        },
    );
    let numbers = || prop::collection::vec(any::<u8>(), 0..3);
    let waiting = || prop::collection::vec((0..3u8, 0..2u8), 0..2);
    let holder = prop_oneof![
        prop::collection::vec(any::<u8>(), 1..3).prop_map(Holder::Pin),
        any::<u8>().prop_map(Holder::Lock),
        (numbers(), waiting(), 0..20u64, any::<bool>()).prop_map(
            |(keys, waiting, days_ago, in_progress)| Holder::Run {
                keys,
                waiting,
                days_ago,
                in_progress
            }
        ),
    ];
    (
        prop::collection::vec(action, 1..12),
        prop::collection::vec(holder, 0..4),
        (numbers(), waiting()),
        prop_oneof![Just(0u64), Just(7)],
        any::<bool>(),
    )
        .prop_map(|(actions, holders, plan, keep_days, drop_unfinished)| Case {
            actions,
            holders,
            plan,
            keep_days,
            drop_unfinished,
        })
}

/// Store of a case, with its open locks and runs.
struct Setup {
    _dir: tempfile::TempDir,
    store: Store,
    /// Keys of all actions, in order.
    keys: Vec<String>,
    /// Parts of the key and keys of the inputs' actions, by key of each action, finished or not.
    parts: BTreeMap<String, (Map<String, Value>, Vec<String>)>,
    _locks: Vec<KeyLock>,
    _runs: Vec<RunFile>,
}

/// Repeats an attempt until it gets the lock: other tests start programs, and a file that was open
/// at such a start stays locked until the program is loaded.
fn acquire<T>(mut attempt: impl FnMut() -> Result<Locked<T>, store::StoreError>) -> T {
    loop {
        if let Locked::Acquired(lock) = attempt().unwrap() {
            return lock;
        }
        std::thread::yield_now();
    }
}

fn days_ago(days: u64) -> u64 {
    unix_time() - days * 86_400
}

fn waiting((stage, parameter): (u8, u8)) -> PartialKey {
    let parameters = json!({ "p": parameter }).as_object().unwrap().clone();
    PartialKey { program: format!("s{stage}"), parameters }
}

fn set_up(case: &Case) -> Setup {
    // The store is in memory if possible, since objects are synced to disk.
    let memory = std::path::Path::new("/dev/shm");
    let dir =
        if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() }.unwrap();
    let store = Store::open(dir.path()).unwrap();
    let (mut keys, mut parts): (Vec<String>, _) = (Vec::new(), BTreeMap::new());
    for action in &case.actions {
        let mut key_parts = Map::new();
        key_parts.insert("stage".into(), json!(format!("s{}", action.stage)));
        key_parts.insert("parameter p".into(), json!(action.parameter));
        let mut made_of = Vec::new();
        if !keys.is_empty() {
            made_of.extend(
                action.inputs.iter().map(|earlier| keys[*earlier as usize % keys.len()].clone()),
            );
        }
        // Equal inputs and parameters mean the same action.
        key_parts.insert("input".into(), json!(made_of));
        let key = make_action(&store, action, &key_parts, &made_of);
        parts.insert(key.clone(), (key_parts, made_of));
        keys.push(key);
    }
    let (mut locks, mut runs) = (Vec::new(), Vec::new());
    let key = |number: &u8| keys[*number as usize % keys.len()].clone();
    for (i, holder) in case.holders.iter().enumerate() {
        let entered = acquire(|| store.try_enter());
        match holder {
            Holder::Pin(numbers) => {
                let actions: Vec<(String, String)> =
                    numbers.iter().map(|n| ("s".to_owned(), key(n))).collect();
                store.pin(&entered, &format!("pin-{i}"), Vec::new(), &actions).unwrap();
            }
            Holder::Lock(number) => {
                if let Locked::Acquired(lock) = store.try_lock(&key(number)).unwrap() {
                    locks.push(lock);
                }
            }
            Holder::Run { keys, waiting: nodes, days_ago: days, in_progress } => {
                let run = store.begin_run(&entered, Vec::new()).unwrap();
                keys.iter()
                    .for_each(|number| run.record_action(&entered, "s", &key(number)).unwrap());
                nodes.iter().for_each(|node| run.record_waiting(&entered, waiting(*node)).unwrap());
                if *in_progress {
                    runs.push(run);
                } else {
                    let path = store.root().join(format!("runs/{}.jsonl", run.id()));
                    drop(run);
                    let text = fs::read_to_string(&path).unwrap()
                        + &format!("{{\"ended\":{{\"unix\":{}}}}}\n", days_ago(*days));
                    // Replace the file by one that was never locked.
                    fs::remove_file(&path).unwrap();
                    fs::write(&path, text).unwrap();
                }
            }
        }
    }
    Setup { _dir: dir, store, keys, parts, _locks: locks, _runs: runs }
}

/// Creates an action. Returns its key.
fn make_action(
    store: &Store,
    action: &Action,
    key_parts: &Map<String, Value>,
    made_of: &[String],
) -> String {
    let (key, stage, made_of) =
        (hash_json(key_parts), format!("s{}", action.stage), made_of.to_vec());
    if store.record(&key).unwrap().is_some() {
        return key;
    }
    let entered = acquire(|| store.try_enter());
    let unfinished = Unfinished {
        stage: stage.clone(),
        key_parts: key_parts.clone(),
        made_of: made_of.clone(),
        ..Default::default()
    };
    let attempt = store.begin(&entered, &unfinished, &json!({})).unwrap();
    if action.state != State::Finished {
        fs::create_dir_all(&attempt.work).unwrap();
        if action.state == State::WithCheckpoint {
            fs::write(attempt.work.join("checkpoint"), "x").unwrap();
        }
        return key;
    }
    fs::create_dir_all(&attempt.output).unwrap();
    fs::write(attempt.output.join("file"), format!("{}", action.content)).unwrap();
    let checked = store.check(attempt, "kind").unwrap();
    let started_unix = days_ago(action.days_old);
    let record =
        Record { stage, key_parts: key_parts.clone(), made_of, started_unix, ..Record::default() };
    store.publish(&entered, checked, record).unwrap();
    key
}

/// Returns the keys to keep by definition: repeats passes until a pass adds none.
fn expected_keys(case: &Case, setup: &Setup) -> BTreeSet<String> {
    let key = |number: &u8| setup.keys[*number as usize % setup.keys.len()].clone();
    let recent = |days: u64| days < case.keep_days;
    // `single` keeps actions alone, `with_inputs` together with all actions of their inputs.
    let mut single: BTreeSet<String> = case.plan.0.iter().map(key).collect();
    let mut with_inputs: BTreeSet<String> = BTreeSet::new();
    let mut nodes: Vec<(u8, u8)> = case.plan.1.clone();
    for holder in &case.holders {
        match holder {
            Holder::Pin(numbers) => single.extend(numbers.iter().map(key)),
            Holder::Lock(number) => with_inputs.extend([key(number)]),
            Holder::Run { keys, waiting, days_ago, in_progress }
                if *in_progress || recent(*days_ago) =>
            {
                single.extend(keys.iter().map(key));
                nodes.extend(waiting);
            }
            Holder::Run { .. } => {}
        }
    }
    for (action, (parts, _)) in &setup.parts {
        let record = setup.store.record(action).unwrap();
        let is_waiting = nodes.iter().any(|(stage, parameter)| {
            parts["stage"] == json!(format!("s{stage}")) && parts["parameter p"] == json!(parameter)
        });
        if record.is_some() && is_waiting {
            single.insert(action.clone());
        }
        let is_recent =
            record.is_some_and(|r| unix_time() - r.started_unix < case.keep_days * 86_400);
        let has_checkpoint =
            setup.store.partial(action).join("work/checkpoint").exists() && !case.drop_unfinished;
        if is_recent || has_checkpoint {
            with_inputs.insert(action.clone());
        }
    }
    loop {
        let inputs: BTreeSet<String> =
            with_inputs.iter().flat_map(|key| setup.parts[key].1.clone()).collect();
        if inputs.is_subset(&with_inputs) {
            return single.union(&with_inputs).cloned().collect();
        }
        with_inputs.extend(inputs);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    /// An entry is kept if and only if a root reaches it.
    #[test]
    fn only_entries_that_roots_reach_are_kept(case in cases()) {
        let setup = set_up(&case);
        let store = &setup.store;
        let kept = expected_keys(&case, &setup);
        let records: BTreeSet<String> =
            kept.iter().filter(|key| store.record(key).unwrap().is_some()).cloned().collect();
        let unfinished: BTreeSet<String> =
            kept.iter().filter(|key| store.partial(key).exists()).cloned().collect();
        let objects: BTreeSet<String> =
            records.iter().map(|key| store.record(key).unwrap().unwrap().output).collect();
        let key = |number: &u8| setup.keys[*number as usize % setup.keys.len()].clone();
        let plan = Root {
            reason: "the plan".into(),
            keys: case.plan.0.iter().map(key).collect(),
            waiting: case.plan.1.iter().map(|node| waiting(*node)).collect(),
            with_inputs: false,
        };
        let policy = Policy { keep_days: case.keep_days, drop_unfinished: case.drop_unfinished,
            drop_old: true };

        let collection = Collection::new(store, plan, policy).unwrap();
        prop_assert_eq!(collection.decisions().len(),
            store.objects().unwrap().len() + store.partials().unwrap().len());
        collection.carry_out(store, &acquire(|| store.try_close())).unwrap();
        store.empty_trash().unwrap();

        let set = |names: Vec<String>| -> BTreeSet<String> { names.into_iter().collect() };
        prop_assert_eq!(set(store.action_keys().unwrap()), records);
        prop_assert_eq!(set(store.objects().unwrap()), objects);
        prop_assert_eq!(set(store.partials().unwrap()), unfinished);
        for object in store.objects().unwrap() {
            store.verify(&object).unwrap();
        }
        prop_assert_eq!(fs::read_dir(store.root().join("trash")).unwrap().count(), 0);
        for run in store.runs().unwrap() {
            let is_recent = || unix_time() - run.last_used_unix() < case.keep_days * 86_400;
            prop_assert!(run.in_progress || is_recent());
        }
    }
}

const POLICY: Policy = Policy { keep_days: 7, drop_unfinished: false, drop_old: true };

/// An object that no record names is deleted with its leftover log, and the reason is printed. If
/// a record is damaged, nothing is deleted, since that record may name the object.
#[test]
fn orphans_are_deleted() {
    let dir = tempfile::tempdir().unwrap();
    let store = Store::open(dir.path()).unwrap();
    let parts = json!({"stage": "s0"}).as_object().unwrap().clone();
    let key = make_action(&store, &old_action(1), &parts, &[]);
    let record = store.action(&key, "json");
    fs::write(store.action(&key, "log"), "done").unwrap();
    fs::write(&record, "{").unwrap();
    let message = Collection::new(&store, Root::default(), POLICY).err().unwrap().to_string();
    assert!(message.contains(&format!("{key}.json: the record is damaged")), "{message}");
    fs::remove_file(&record).unwrap();
    let collection = Collection::new(&store, Root::default(), POLICY).unwrap();
    let decision = collection.decisions()[0].to_string();
    assert!(decision.ends_with("no record names it: delete"), "{decision}");
    collection.carry_out(&store, &acquire(|| store.try_close())).unwrap();
    assert!(store.objects().unwrap().is_empty() && store.action_keys().unwrap().is_empty());
}

/// An unreadable entry may be needed, or may name needed ones. A loop of links is unreadable even
/// for the superuser.
#[test]
fn unreadable_entries_are_errors() {
    let key = hash_json(&json!({"stage": "s0", "unfinished": true}));
    let unfinished_path = |folder: &str| format!("partial/{key}/{folder}");
    for file in [
        "actions/{record}.json".to_owned(),
        "objects/{object}/artifact.json".to_owned(),
        "runs/x.jsonl".to_owned(),
        "pins/x.jsonl".to_owned(),
        format!("locks/{key}"),
        unfinished_path("action.json"),
        unfinished_path("work"),
        "slurm/1-2-x".to_owned(),
    ] {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let parts = json!({"stage": "s0"}).as_object().unwrap().clone();
        let record = make_action(&store, &old_action(1), &parts, &[]);
        let object = store.objects().unwrap().remove(0);
        fs::create_dir_all(dir.path().join(unfinished_path(""))).unwrap();
        let file = file.replace("{record}", &record).replace("{object}", &object);
        let path = dir.path().join(&file);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::remove_file(&path).ok();
        std::os::unix::fs::symlink(path.file_name().unwrap(), &path).unwrap();
        let message = Collection::new(&store, Root::default(), POLICY).err().unwrap().to_string();
        assert!(message.contains(&file), "{file}: {message}");
    }
}

fn old_action(content: u8) -> Action {
    Action { stage: 0, parameter: 0, inputs: vec![], content, days_old: 90, state: State::Finished }
}

#[test]
fn a_recent_artifact_is_listed_with_its_age() {
    let dir = tempfile::tempdir().unwrap();
    let store = Store::open(dir.path()).unwrap();
    let parts = json!({KEY_VERSION_PART: KEY_VERSION}).as_object().unwrap().clone();
    make_action(&store, &Action { days_old: 3, ..old_action(1) }, &parts, &[]);
    let policy = Policy { keep_days: 7, drop_unfinished: false, drop_old: false };
    let collection = Collection::new(&store, Root::default(), policy).unwrap();
    let line = collection.decisions()[0].to_string();
    assert!(line.ends_with("created 3 days ago: keep: younger than --keep-days 7"), "{line}");
}

/// An artifact with a key of an older version is kept, with its inputs, unless `drop_old` is set.
#[test]
fn artifacts_of_older_versions_are_kept_until_dropped() {
    let dir = tempfile::tempdir().unwrap();
    let store = Store::open(dir.path()).unwrap();
    let map = |parts: Value| parts.as_object().unwrap().clone();
    let old = make_action(
        &store,
        &old_action(1),
        &map(json!({"key version": 1, "parameter lr": 100})),
        &[],
    );
    let now = map(json!({KEY_VERSION_PART: KEY_VERSION, "parameter lr_width": 100}));
    make_action(&store, &old_action(2), &now, &[]);
    for (drop_old, expected) in [(false, vec![old]), (true, vec![])] {
        let collection = Collection::new(
            &store,
            Root::default(),
            Policy { keep_days: 7, drop_unfinished: false, drop_old },
        )
        .unwrap();
        let reason_count = collection
            .decisions()
            .iter()
            .map(ToString::to_string)
            .filter(|line| {
                line.ends_with("created by an older version of nerf-sr; deleted by --drop-old")
            })
            .count();
        assert_eq!(reason_count, expected.len());
        collection.carry_out(&store, &acquire(|| store.try_close())).unwrap();
        assert_eq!(store.action_keys().unwrap(), expected);
    }
}
