//! The packages of the workspace and what they use of each other, from `cargo metadata`.

use crate::command::{cargo, output, repository_root};
use anyhow::{Context as _, Result};
use serde::Deserialize;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// A package of the workspace.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Package {
    pub name: String,
    /// Relative to the repository root.
    pub folder: PathBuf,
    /// Packages of the workspace that its library or program uses; not those that only its tests use.
    pub uses: BTreeSet<String>,
    /// What of it has unit tests.
    pub tested: BTreeSet<TestTarget>,
}

/// A target with tests, as Cargo is told of it.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum TestTarget {
    Library,
    Program(String),
    /// A file of the folder `tests`.
    Tests(String),
}

impl TestTarget {
    /// What selects it, and those of its name in other packages.
    pub fn arguments(&self) -> Vec<&str> {
        match self {
            Self::Library => vec!["--lib"],
            Self::Program(name) => vec!["--bin", name],
            Self::Tests(name) => vec!["--test", name],
        }
    }
}

#[derive(Deserialize)]
struct Metadata {
    packages: Vec<MetadataPackage>,
}

#[derive(Deserialize)]
struct MetadataPackage {
    name: String,
    manifest_path: PathBuf,
    dependencies: Vec<Dependency>,
    targets: Vec<Target>,
}

#[derive(Deserialize)]
struct Target {
    name: String,
    kind: Vec<String>,
    test: bool,
    #[serde(default, rename = "required-features")]
    required_features: Vec<String>,
}

impl Target {
    /// What it has tests for; nothing where Cargo would not build it by itself.
    fn tested(&self) -> Option<TestTarget> {
        let is = |kinds: &[&str]| self.kind.iter().any(|kind| kinds.contains(&kind.as_str()));
        if !self.test || !self.required_features.is_empty() {
            return None;
        }
        if is(&["lib", "rlib", "dylib", "cdylib", "staticlib", "proc-macro"]) {
            return Some(TestTarget::Library);
        }
        let name = self.name.clone();
        match is(&["bin"]) {
            true => Some(TestTarget::Program(name)),
            false => is(&["test"]).then_some(TestTarget::Tests(name)),
        }
    }
}

#[derive(Deserialize)]
struct Dependency {
    name: String,
    kind: Option<String>,
}

/// All packages of the workspace, sorted by folder.
pub fn of_workspace() -> Result<Vec<Package>> {
    let json = output(cargo().args(["metadata", "--format-version", "1", "--no-deps"]))?;
    let metadata: Metadata =
        serde_json::from_str(&json).context("cannot read the output of cargo metadata")?;
    let ours: BTreeSet<String> = metadata.packages.iter().map(|p| p.name.clone()).collect();
    let root = repository_root();
    let mut packages = Vec::new();
    for package in metadata.packages {
        let folder = package
            .manifest_path
            .parent()
            .and_then(|folder| folder.strip_prefix(&root).ok())
            .with_context(|| format!("{} lies outside", package.manifest_path.display()))?
            .to_owned();
        let uses = package
            .dependencies
            .iter()
            .filter(|dependency| dependency.kind.as_deref() != Some("dev"))
            .map(|dependency| dependency.name.clone())
            .filter(|name| ours.contains(name))
            .collect();
        packages.push(Package {
            tested: package.targets.iter().filter_map(Target::tested).collect(),
            uses,
            name: package.name,
            folder,
        });
    }
    packages.sort_by(|a, b| a.folder.cmp(&b.folder));
    Ok(packages)
}

/// The package that a file of the repository belongs to; `file` is relative to the repository root.
pub fn owner<'a>(packages: &'a [Package], file: &Path) -> Option<&'a Package> {
    packages
        .iter()
        .filter(|package| file.starts_with(&package.folder))
        .max_by_key(|package| package.folder.components().count())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn package(name: &str) -> Package {
        Package {
            name: name.to_owned(),
            folder: name.into(),
            uses: BTreeSet::new(),
            tested: BTreeSet::new(),
        }
    }

    #[test]
    fn what_cargo_tests_by_itself_is_selected_by_kind_and_name() {
        let target = |json: &str| {
            let target: Target = serde_json::from_str(json).unwrap();
            let tested = target.tested();
            tested.map(|target| target.arguments().join(" "))
        };
        for (json, expected) in [
            (
                r#"{"name":"bags","kind":["lib"],"test":true}"#,
                Some("--lib"),
            ),
            (
                r#"{"name":"multiravens","kind":["cdylib"],"test":true}"#,
                Some("--lib"),
            ),
            (
                r#"{"name":"sctn","kind":["bin"],"test":true}"#,
                Some("--bin sctn"),
            ),
            (
                r#"{"name":"older","kind":["test"],"test":true}"#,
                Some("--test older"),
            ),
            (r#"{"name":"check","kind":["bench"],"test":false}"#, None),
            (
                r#"{"name":"build-script-build","kind":["custom-build"],"test":false}"#,
                None,
            ),
            (
                r#"{"name":"planted","kind":["bin"],"test":true,"required-features":["planted_faults"]}"#,
                None,
            ),
        ] {
            assert_eq!(target(json).as_deref(), expected, "{json}");
        }
    }

    #[test]
    fn a_file_belongs_to_the_innermost_package() {
        let packages = [package("bags"), package("bags/fuzz")];
        let owner = |file: &str| owner(&packages, Path::new(file)).map(|p| p.name.as_str());
        assert_eq!(owner("bags/src/lib.rs"), Some("bags"));
        assert_eq!(owner("bags/fuzz/src/main.rs"), Some("bags/fuzz"));
        assert_eq!(owner("README.md"), None);
    }
}
