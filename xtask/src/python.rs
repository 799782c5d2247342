//! The Python on this machine, and the virtual environment of the end-to-end tests.

use crate::command::{command, output};
use anyhow::{Context as _, Result, ensure};
use std::path::PathBuf;

/// The machine's `python3`, checked to be 3.9 or newer and to have pip.
pub fn with_pip() -> Result<PathBuf> {
    let python = PathBuf::from("python3");
    let version = output(command(&python).args(["-c", "import sys; print(*sys.version_info[:2])"]))
        .context("Python 3.9 or newer is needed (to fetch libtorch with pip), and `python3` does not run")?;
    let mut numbers = version.split_whitespace().map(str::parse::<u32>);
    ensure!(
        matches!((numbers.next(), numbers.next()), (Some(Ok(3)), Some(Ok(minor))) if minor >= 9),
        "Python 3.9 or newer is needed, and `python3` is {}",
        version.trim().replace(' ', ".")
    );
    output(command(&python).args(["-m", "pip", "--version"]))
        .context("`python3` has no pip: install it (Debian and Ubuntu: apt install python3-pip)")?;
    Ok(python)
}
