//! The table of crates in ARCHITECTURE.md, checked against `cargo metadata`.

use crate::command::repository_root;
use crate::packages::{self, Package};
use anyhow::{Context as _, Result, bail, ensure};
use std::collections::BTreeSet;
use std::path::Path;

/// The heading above the table.
const HEADING: &str = "## Crates";

/// In the column "uses": any package of a lower row.
const ANYTHING_BELOW: &str = "everything below";

/// One row of the table. A row stands above everything that it uses.
#[derive(Debug)]
struct Row {
    /// A folder such as `bags`, or `nodes/*` for every package in it.
    folder: String,
    /// Names of packages; `None`: everything below.
    uses: Option<BTreeSet<String>>,
}

impl Row {
    fn holds(&self, folder: &Path) -> bool {
        match self.folder.strip_suffix("/*") {
            Some(parent) => folder.parent() == Some(Path::new(parent)),
            None => folder.starts_with(&self.folder),
        }
    }
}

/// Checks that every package has its row, that the rows name what the packages use, and that all arrows point down.
pub fn check() -> Result<()> {
    let path = repository_root().join("ARCHITECTURE.md");
    let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
    let faults = faults(&rows(&text)?, &packages::of_workspace()?);
    if !faults.is_empty() {
        bail!(
            "ARCHITECTURE.md, \"Crates\", and the manifests disagree:\n{}",
            faults.join("\n")
        );
    }
    Ok(())
}

/// The rows of the table below the heading.
fn rows(text: &str) -> Result<Vec<Row>> {
    let section = text
        .split_once(HEADING)
        .with_context(|| format!("ARCHITECTURE.md has no heading {HEADING:?}"))?
        .1;
    let lines = section
        .lines()
        .skip_while(|line| !line.starts_with('|'))
        .take_while(|line| line.starts_with('|'))
        // The names of the columns and the line below them.
        .skip(2);
    lines
        .map(|line| {
            let cells: Vec<&str> = line.trim_matches('|').split(" | ").map(str::trim).collect();
            ensure!(
                cells.len() == 3,
                "a row of {HEADING:?} has not three cells: {line}"
            );
            Ok(Row {
                folder: cells[0].replace('`', "").trim_end_matches('/').to_owned(),
                uses: (cells[2] != ANYTHING_BELOW).then(|| {
                    cells[2]
                        .split(',')
                        .map(|name| name.trim().replace('`', ""))
                        .filter(|name| name != "–")
                        .collect()
                }),
            })
        })
        .collect()
}

/// One sentence for each disagreement.
fn faults(rows: &[Row], packages: &[Package]) -> Vec<String> {
    let mut faults = Vec::new();
    let row_of = |package: &Package| rows.iter().position(|row| row.holds(&package.folder));
    let mut used_by_row: Vec<BTreeSet<String>> = vec![BTreeSet::new(); rows.len()];
    for package in packages {
        let Some(row) = row_of(package) else {
            faults.push(format!("{} has no row", package.folder.display()));
            continue;
        };
        for name in &package.uses {
            let Some(used) = packages.iter().find(|other| &other.name == name) else {
                continue;
            };
            match row_of(used) {
                // Within one row, as `bags/fuzz` uses `bags`: not for siblings of `folder/*`, which know nothing of each other.
                Some(same) if same == row && !rows[row].folder.ends_with("/*") => {}
                Some(lower) if lower > row => {
                    used_by_row[row].insert(name.clone());
                }
                _ => faults.push(format!(
                    "{} uses {name}, which does not stand below it",
                    package.name
                )),
            }
        }
    }
    for (row, used) in rows.iter().zip(&used_by_row) {
        if let Some(written) = &row.uses
            && written != used
        {
            faults.push(format!(
                "{} uses {}; its row says {}",
                row.folder,
                list(used),
                list(written)
            ));
        }
    }
    faults
}

fn list(names: &BTreeSet<String>) -> String {
    if names.is_empty() {
        return "–".to_owned();
    }
    names
        .iter()
        .map(|name| format!("`{name}`"))
        .collect::<Vec<_>>()
        .join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    const TABLE: &str = "\
## Crates

| folder | what | uses |
|---|---|---|
| `nodes/*` | thin | everything below |
| `bags/` | recordings | `msgs` |
| `msgs/` | messages | – |
";

    fn package(name: &str, folder: &str, uses: &[&str]) -> Package {
        Package {
            name: name.to_owned(),
            folder: folder.into(),
            uses: uses.iter().map(|&name| name.to_owned()).collect(),
            tested: BTreeSet::new(),
        }
    }

    fn told(packages: &[Package]) -> Vec<String> {
        faults(&rows(TABLE).unwrap(), packages)
    }

    #[test]
    fn the_table_of_architecture_md_is_true() {
        check().unwrap();
    }

    #[test]
    fn arrows_that_point_down_are_accepted() {
        let packages = [
            package("fusion", "nodes/fusion", &["bags", "msgs"]),
            package("bags", "bags", &["msgs"]),
            package("fuzz", "bags/fuzz", &["bags"]),
            package("msgs", "msgs", &[]),
        ];
        assert_eq!(told(&packages), Vec::<String>::new());
    }

    #[test]
    fn an_arrow_that_points_up_is_named() {
        let packages = [
            package("fusion", "nodes/fusion", &[]),
            package("bags", "bags", &["fusion", "msgs"]),
            package("msgs", "msgs", &[]),
        ];
        assert_eq!(
            told(&packages),
            ["bags uses fusion, which does not stand below it"]
        );
    }

    #[test]
    fn a_node_that_uses_a_node_is_named() {
        let packages = [
            package("fusion", "nodes/fusion", &["policy"]),
            package("policy", "nodes/policy", &[]),
            package("bags", "bags", &["msgs"]),
            package("msgs", "msgs", &[]),
        ];
        assert_eq!(
            told(&packages),
            ["fusion uses policy, which does not stand below it"]
        );
    }

    #[test]
    fn a_package_without_a_row_and_a_row_that_is_wrong_are_named() {
        let packages = [
            package("bags", "bags", &[]),
            package("msgs", "msgs", &[]),
            package("new", "new", &[]),
        ];
        assert_eq!(
            told(&packages),
            ["new has no row", "bags uses –; its row says `msgs`"]
        );
    }
}
