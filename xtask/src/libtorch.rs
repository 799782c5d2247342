//! The slim libtorch: the few files of PyTorch's wheel that the tch crate links and loads.

use crate::command::{command, output, repository_root, run};
use anyhow::{Context as _, Result, bail, ensure};
use std::fs;
use std::path::Path;

const REQUIREMENTS: &str = include_str!("../libtorch-requirements.txt");

/// Files taken from the wheels, as `member=>place in .libtorch`.
const FILES: [&str; 6] = [
    "torch/lib/libtorch_cpu.so=>lib/libtorch_cpu.so",
    "torch/lib/libc10.so=>lib/libc10.so",
    "torch/lib/libgomp.so.1=>lib/libgomp.so.1",
    "torch/include/=>include/",
    "nvidia/cu13/lib/libcupti.so.13=>lib/libcupti.so.13",
    "nvidia/cu13/lib/libcudart.so.13=>lib/libcudart.so.13",
];

/// Room for the wheels and what is taken from them.
const NEEDED_BYTES: u64 = 1_200_000_000;

/// Makes `.libtorch` in the repository root; does nothing when it is there in the right version.
pub fn set_up(python: &Path) -> Result<()> {
    let root = repository_root();
    let destination = root.join(".libtorch");
    let stamp = destination.join("made-from.txt");
    let recipe = format!("{REQUIREMENTS}{}\n", FILES.join("\n"));
    if fs::read_to_string(&stamp).is_ok_and(|text| text == recipe) {
        println!("libtorch: present in {}", destination.display());
        return Ok(());
    }
    ensure!(
        cfg!(all(target_os = "linux", target_arch = "x86_64")),
        "the slim libtorch is made from wheels for Linux on x86_64, and this is {} on {}; unpack libtorch {} yourself and \
         point LIBTORCH at it",
        std::env::consts::OS,
        std::env::consts::ARCH,
        version()?
    );
    check_room(&root)?;

    println!("libtorch: downloading three wheels (543 MB) with pip ...");
    // Beside its destination, so that the rename at the end cannot leave half a libtorch behind.
    let work = root.join(format!(".libtorch.{}", std::process::id()));
    let made = make(python, &work, &recipe);
    let result = made.and_then(|()| {
        if destination.exists() {
            fs::remove_dir_all(&destination)
                .with_context(|| format!("cannot remove the old {}", destination.display()))?;
        }
        fs::rename(work.join("libtorch"), &destination)
            .with_context(|| format!("cannot move libtorch to {}", destination.display()))
    });
    if work.exists() {
        fs::remove_dir_all(&work).with_context(|| format!("cannot remove {}", work.display()))?;
    }
    result?;
    println!("libtorch: {} made in {}", version()?, destination.display());
    Ok(())
}

fn make(python: &Path, work: &Path, recipe: &str) -> Result<()> {
    let (wheels, libtorch) = (work.join("wheels"), work.join("libtorch"));
    fs::create_dir_all(&wheels).with_context(|| format!("cannot make {}", wheels.display()))?;
    let mut pip = command(python);
    pip.args([
        "-m",
        "pip",
        "download",
        "--quiet",
        "--disable-pip-version-check",
        "--no-deps",
        "--no-cache-dir",
    ])
    .args([
        "--python-version",
        "3.11",
        "--implementation",
        "cp",
        "--abi",
        "cp311",
        "--only-binary=:all:",
    ]);
    // pip takes these names literally: a wheel for an older glibc has to be asked for by name.
    for glibc in [28, 27, 26, 25, 24, 17] {
        pip.arg("--platform")
            .arg(format!("manylinux_2_{glibc}_x86_64"));
    }
    pip.arg("--dest")
        .arg(&wheels)
        .arg("--require-hashes")
        .arg("--requirement");
    run(pip.arg(repository_root().join("xtask/libtorch-requirements.txt")))
        .context("cannot download libtorch: is a Python package index reachable with pip?")?;
    output(
        command(python)
            .arg(repository_root().join("xtask/extract_wheels.py"))
            .args([&wheels, &libtorch])
            .args(FILES),
    )?;
    // The wheel's own libtorch.so also pulls in CUDA. torch-sys asks the linker for -ltorch: hand on to the CPU library.
    fs::write(libtorch.join("lib/libtorch.so"), "INPUT(-ltorch_cpu)\n")?;
    fs::write(libtorch.join("build-version"), version()?)?;
    fs::write(libtorch.join("made-from.txt"), recipe)?;
    Ok(())
}

/// The version of torch in the list of wheels.
fn version() -> Result<&'static str> {
    REQUIREMENTS
        .lines()
        .find_map(|line| line.strip_prefix("torch==")?.split_whitespace().next())
        .context("xtask/libtorch-requirements.txt names no torch==VERSION")
}

/// Fails early when the disk has no room; `df -P` is the portable way to ask.
fn check_room(root: &Path) -> Result<()> {
    let table = output(command("df").args(["-P", "-k"]).arg(root))?;
    let free_kib: u64 = table
        .lines()
        .nth(1)
        .and_then(|line| line.split_whitespace().nth(3)?.parse().ok())
        .with_context(|| format!("cannot read the free space from df:\n{table}"))?;
    if free_kib * 1024 < NEEDED_BYTES {
        bail!(
            "libtorch needs {} MB of disk in {} while it is made (500 MB afterwards), {} MB are free",
            NEEDED_BYTES / 1_000_000,
            root.display(),
            free_kib * 1024 / 1_000_000
        );
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_version_comes_from_the_list_of_wheels() {
        assert_eq!(super::version().unwrap(), "2.11.0");
    }

    #[test]
    fn every_wheel_is_pinned_by_version_and_hash() {
        for line in super::REQUIREMENTS
            .lines()
            .filter(|line| !line.starts_with('#'))
        {
            assert!(
                line.contains("==") && line.contains("--hash=sha256:"),
                "{line}"
            );
        }
    }
}
