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
