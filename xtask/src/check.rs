//! `cargo xtask check`: what a developer runs after each edit, on the packages that the edit concerns.

use crate::command::{cargo, output, run};
use crate::packages::{self, Package};
use crate::stage::clippy;
use crate::{python, unit_tests};
use anyhow::{Result, bail};
use std::collections::BTreeSet;
use std::path::PathBuf;
use std::time::Instant;

/// Checks formatting, clippy and the tests of `chosen`, or of every package with a change since `origin/main`.
///
/// clippy reads every package, so that a changed interface is noticed where it is used. Fuzzing, golden
/// episodes without optimisation and end-to-end tests are left to `cargo xtask test`.
pub fn run_checks(chosen: &[String]) -> Result<()> {
    let start = Instant::now();
    let packages = packages::of_workspace()?;
    let changed_files = changed_files()?;
    let changed = if chosen.is_empty() {
        changed_files
            .iter()
            .filter_map(|file| packages::owner(&packages, file))
            .map(|package| package.name.clone())
            .collect()
    } else {
        named(&packages, chosen)?
    };
    run(cargo().args(["fmt", "--check"]))?;
    if changed_files
        .iter()
        .any(|file| file.extension().is_some_and(|end| end == "py"))
    {
        python::lint()?;
    }
    if changed.is_empty() {
        println!("check: no package has a change; -p CRATE names one");
        return Ok(());
    }
    println!("check: tests of {}", list(&changed));
    let chosen = packages
        .iter()
        .filter(|package| changed.contains(&package.name));
    unit_tests::of_packages(&chosen.collect::<Vec<_>>())?;
    println!("check: clippy");
    run(&mut clippy())?;
    println!("check: passed in {:.0} s", start.elapsed().as_secs_f64());
    Ok(())
}

/// Files that differ from where this branch left `origin/main`, committed or not, relative to the repository root.
fn changed_files() -> Result<Vec<PathBuf>> {
    let git = |arguments: &[&str]| output(crate::command::command("git").args(arguments));
    // A clone without a remote of that name compares with its own last commit.
    let base = git(&["merge-base", "HEAD", "origin/main"]).unwrap_or_else(|_| "HEAD".to_owned());
    let differing = git(&["diff", "--name-only", base.trim()])?;
    let untracked = git(&["ls-files", "--others", "--exclude-standard"])?;
    Ok(differing
        .lines()
        .chain(untracked.lines())
        .map(PathBuf::from)
        .collect())
}

/// The chosen names, each checked to be a package of the workspace.
fn named(packages: &[Package], chosen: &[String]) -> Result<BTreeSet<String>> {
    for name in chosen {
        if !packages.iter().any(|package| &package.name == name) {
            let known: Vec<&str> = packages.iter().map(|p| p.name.as_str()).collect();
            bail!("no package {name:?} here; there are {}", known.join(", "));
        }
    }
    Ok(chosen.iter().cloned().collect())
}

fn list(names: &BTreeSet<String>) -> String {
    names.iter().cloned().collect::<Vec<_>>().join(", ")
}
