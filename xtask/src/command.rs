//! Child processes: every one runs in the repository root and a failure names the command.

use anyhow::{Context as _, Result, bail};
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The repository root, known at build time: `xtask` is only ever run from the tree it was built from.
pub fn repository_root() -> PathBuf {
    let manifest = std::env::var_os("CARGO_MANIFEST_DIR")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")), PathBuf::from);
    manifest
        .parent()
        .map_or(manifest.clone(), Path::to_path_buf)
}

/// Where Cargo puts what it builds: `CARGO_TARGET_DIR` if set, else `target` in the repository.
pub fn target_directory() -> PathBuf {
    let root = repository_root();
    std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| root.join("target"), |dir| root.join(dir))
}

/// A command that runs in the repository root.
pub fn command(program: impl AsRef<OsStr>) -> Command {
    let mut command = Command::new(program);
    command.current_dir(repository_root());
    command
}

/// Cargo, with the environment a person's shell would give it.
///
/// `cargo xtask` hands its `[env]` table and what it says of the package `xtask` on to this process. Left in place, build
/// scripts would see LIBTORCH, CARGO_PKG_NAME and others change between `cargo xtask test` and a plain `cargo test`, and compile
/// torch-sys, ring and what uses them again each time.
pub fn cargo() -> Command {
    let mut command = command(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    without_cargo_variables(&mut command);
    command
}

/// Takes from a command what Cargo told this process of itself.
pub fn without_cargo_variables(command: &mut Command) {
    if std::env::var_os("LIBTORCH")
        .is_some_and(|dir| Path::new(&dir) == repository_root().join(".libtorch"))
    {
        command.env_remove("LIBTORCH");
    }
    for (name, _) in std::env::vars_os() {
        let text = name.to_string_lossy();
        if text.starts_with("CARGO_PKG_") || text.starts_with("CARGO_MANIFEST_") {
            command.env_remove(&name);
        }
    }
}

/// Runs a command with its output passed through.
pub fn run(command: &mut Command) -> Result<()> {
    let shown = shown(command);
    let status = command
        .status()
        .with_context(|| format!("cannot start `{shown}`"))?;
    if !status.success() {
        bail!("`{shown}` failed: {status}");
    }
    Ok(())
}

/// Runs a command and returns what it printed; its error output becomes part of the error.
pub fn output(command: &mut Command) -> Result<String> {
    let shown = shown(command);
    let output = command
        .output()
        .with_context(|| format!("cannot start `{shown}`"))?;
    if !output.status.success() {
        bail!(
            "`{shown}` failed: {}\n{}{}",
            output.status,
            String::from_utf8_lossy(&output.stdout),
            String::from_utf8_lossy(&output.stderr)
        );
    }
    String::from_utf8(output.stdout)
        .with_context(|| format!("`{shown}` printed text that is not UTF-8"))
}

/// A command as a person would type it.
pub fn shown(command: &Command) -> String {
    let mut text = command.get_program().to_string_lossy().into_owned();
    for argument in command.get_args() {
        let argument = argument.to_string_lossy();
        text.push(' ');
        // A script given with -c would fill the screen.
        text.push_str(if argument.contains('\n') {
            "..."
        } else {
            &argument
        });
    }
    text
}
