//! Unit tests: Cargo compiles the test programs, and this runs them two at a time, as many wait for other processes or for time to
//! pass.
//!
//! Everything is compiled as a part of the whole workspace, also where a few packages are tested: for these alone Cargo would choose other
//! features of what is not ours, and compile it again. Of other packages it compiles only what has the kind or the name of a target of these.

use crate::command::{cargo, command, run, shown};
use crate::packages::{Package, TestTarget};
use anyhow::{Context as _, Result, ensure};
use serde::Deserialize;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Test programs that run at a time.
const AT_A_TIME: usize = 2;
/// Cargo, for the whole workspace.
const TEST: [&str; 3] = ["test", "--workspace", "--release"];

/// The tests of all packages, documentation examples with them.
pub fn of_workspace() -> Result<()> {
    run_all(&built(&BTreeSet::new())?)?;
    run(cargo().args(TEST).arg("--doc"))
}

/// The tests of these packages.
pub fn of_packages(packages: &[&Package]) -> Result<()> {
    let targets = packages.iter().flat_map(|package| &package.tested);
    let targets: BTreeSet<&TestTarget> = targets.collect();
    let chosen = |program: &Program| packages.iter().any(|p| program.is_in(&p.folder));
    let programs = match targets.is_empty() {
        true => Vec::new(),
        false => built(&targets)?,
    };
    let programs: Vec<_> = programs.into_iter().filter(chosen).collect();
    run_all(&programs)?;
    // The names of documentation examples begin with their file.
    let files = packages.iter().map(|package| package.folder.join("src"));
    run(cargo()
        .args(TEST)
        .args(["--doc", "--quiet", "--"])
        .args(files))
}

/// A test program that Cargo has built.
#[derive(Debug, PartialEq, Eq)]
struct Program {
    executable: PathBuf,
    /// Where Cargo would run it.
    folder: PathBuf,
}

impl Program {
    /// Whether it belongs to the package in a folder, relative to the repository root.
    fn is_in(&self, folder: &Path) -> bool {
        self.folder == crate::command::repository_root().join(folder)
    }
}

/// What Cargo says of what it does, one line each.
#[derive(Deserialize)]
struct Message {
    executable: Option<PathBuf>,
    manifest_path: Option<PathBuf>,
    profile: Option<Profile>,
}

#[derive(Deserialize)]
struct Profile {
    test: bool,
}

/// Compiles the test programs of all packages: those of these targets, or all where there are none.
fn built(targets: &BTreeSet<&TestTarget>) -> Result<Vec<Program>> {
    let mut build = cargo();
    build
        .args(TEST)
        .args(targets.iter().flat_map(|target| target.arguments()))
        .args(["--no-run", "--message-format=json-render-diagnostics"])
        .stderr(Stdio::inherit());
    let output = build.output().context("cannot start cargo")?;
    ensure!(
        output.status.success(),
        "`{}` failed: {}",
        shown(&build),
        output.status
    );
    let said = String::from_utf8(output.stdout).context("cargo printed text that is not UTF-8")?;
    programs(&said)
}

/// The test programs in what Cargo says.
fn programs(said: &str) -> Result<Vec<Program>> {
    let mut programs = Vec::new();
    for line in said.lines() {
        let message: Message = serde_json::from_str(line)
            .with_context(|| format!("cargo said {line:?}, expected a JSON message"))?;
        let is_test = message.profile.is_some_and(|profile| profile.test);
        let (Some(executable), Some(manifest)) = (message.executable, message.manifest_path) else {
            continue;
        };
        if let Some(folder) = manifest.parent().filter(|_| is_test) {
            let folder = folder.to_owned();
            programs.push(Program { executable, folder });
        }
    }
    Ok(programs)
}

/// Runs all of them; fails at the end where one has failed.
fn run_all(programs: &[Program]) -> Result<()> {
    let next = Mutex::new(programs.iter());
    let taken = || next.lock().unwrap_or_else(PoisonError::into_inner).next();
    let failed = Mutex::new(Vec::new());
    std::thread::scope(|scope| {
        for _ in 0..AT_A_TIME {
            scope.spawn(|| {
                while let Some(program) = taken() {
                    if !program.passes() {
                        let name = program.executable.display().to_string();
                        let mut failed = failed.lock().unwrap_or_else(PoisonError::into_inner);
                        failed.push(name);
                    }
                }
            });
        }
    });
    let failed = failed.into_inner().unwrap_or_else(PoisonError::into_inner);
    ensure!(failed.is_empty(), "tests failed in {}", failed.join(", "));
    Ok(())
}

impl Program {
    /// Runs it, and prints its output as one piece when it has ended.
    fn passes(&self) -> bool {
        let start = Instant::now();
        let output = command(&self.executable)
            .current_dir(&self.folder)
            .stdin(Stdio::null())
            .output();
        let (passed, text) = match &output {
            Ok(output) => {
                let parts = [&output.stdout, &output.stderr];
                let text = parts.map(|part| String::from_utf8_lossy(part));
                (output.status.success(), text.concat())
            }
            Err(error) => (false, error.to_string()),
        };
        print!("{}", summary(self, passed, &text, start.elapsed()));
        passed
    }
}

/// A line for what has passed, everything for what has not.
fn summary(program: &Program, passed: bool, text: &str, took: Duration) -> String {
    let name = program.executable.file_name().unwrap_or_default();
    let name = format!("{} ({:.1} s)", name.to_string_lossy(), took.as_secs_f64());
    let results = text.lines().filter(|line| line.starts_with("test result:"));
    let results: Vec<_> = results.collect();
    match passed && !results.is_empty() {
        true => format!("{name}: {}\n", results.join("; ")),
        false => format!("{name}:\n{text}\n"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn test_programs_are_found_in_what_cargo_says_and_others_are_not() {
        let said = r#"{"reason":"compiler-artifact","manifest_path":"/r/bags/Cargo.toml","profile":{"test":false},"executable":"/t/sctn"}
{"reason":"compiler-artifact","manifest_path":"/r/bags/Cargo.toml","profile":{"test":true},"executable":"/t/bags-1"}
{"reason":"compiler-artifact","manifest_path":"/r/bags/Cargo.toml","profile":{"test":true},"executable":null}
{"reason":"build-finished","success":true}"#;
        let expected = Program {
            executable: "/t/bags-1".into(),
            folder: "/r/bags".into(),
        };
        assert_eq!(programs(said).unwrap(), [expected]);
        let reason = programs("nonsense").unwrap_err().to_string();
        assert!(reason.contains("nonsense"), "{reason}");
    }

    #[test]
    fn all_programs_run_though_one_fails_and_the_failure_is_named() {
        let folder = std::env::temp_dir();
        let program = |name: &str| Program {
            executable: name.into(),
            folder: folder.clone(),
        };
        run_all(&[program("true"), program("true")]).unwrap();
        let reason = run_all(&[
            program("false"),
            program("true"),
            program("no-such-program"),
        ]);
        let reason = reason.unwrap_err().to_string();
        assert!(
            reason.contains("false") && reason.contains("no-such-program"),
            "{reason}"
        );
    }

    #[test]
    fn the_output_of_a_failure_is_shown_whole() {
        let program = Program {
            executable: "/t/bags-1".into(),
            folder: "/r/bags".into(),
        };
        let text = "running 1 test\ntest result: ok. 1 passed\n";
        let took = Duration::from_millis(1500);
        let shown = summary(&program, true, text, took);
        assert_eq!(shown, "bags-1 (1.5 s): test result: ok. 1 passed\n");
        let shown = summary(&program, false, text, took);
        assert!(shown.contains("running 1 test"), "{shown}");
        // A program that ends before it says how its tests went has not passed quietly.
        let shown = summary(&program, true, "aborted", took);
        assert!(shown.contains("aborted"), "{shown}");
    }
}
