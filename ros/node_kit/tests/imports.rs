//! Modules of node_kit import each other in one direction.

use std::{collections::BTreeMap, fs, path::Path};

/// By module, the modules that it imports by `use crate::...`.
fn imports() -> BTreeMap<String, Vec<String>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut sources = BTreeMap::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_stem().unwrap().to_string_lossy().into_owned();
        if path.extension().is_some_and(|extension| extension == "rs") && name != "lib" {
            sources.insert(name, fs::read_to_string(path).unwrap());
        }
    }
    let modules: Vec<String> = sources.keys().cloned().collect();
    let imported = |source: &String| {
        let used: String = source
            .split("use crate::")
            .skip(1)
            .map(|rest| rest.split(';').next().unwrap_or_default().to_owned() + " ")
            .collect();
        let words: Vec<&str> = used
            .split(|letter: char| !(letter.is_alphanumeric() || letter == '_'))
            .collect();
        let known = modules.iter().filter(|name| words.contains(&name.as_str()));
        known.cloned().collect::<Vec<_>>()
    };
    sources
        .iter()
        .map(|(name, source)| (name.clone(), imported(source)))
        .collect()
}

#[test]
fn no_module_imports_itself_by_way_of_others() {
    let mut left = imports();
    assert!(left["node"].contains(&"topic".to_owned()), "{left:?}");
    // What imports nothing that is left can be taken away, until nothing is left.
    loop {
        let ready: Vec<String> = left
            .iter()
            .filter(|(_, imported)| !imported.iter().any(|name| left.contains_key(name)))
            .map(|(name, _)| name.clone())
            .collect();
        if ready.is_empty() {
            break;
        }
        ready.iter().for_each(|name| {
            left.remove(name);
        });
    }
    assert!(left.is_empty(), "import circles among {left:?}");
}
