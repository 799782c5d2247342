//! libtorch in two parts, both cut from PyTorch's wheel: the few files that the tch crate links and loads, and those that compute on CUDA.

use crate::command::{command, output, repository_root, run};
use anyhow::{Context as _, Result, bail, ensure};
use std::fs;
use std::path::Path;

/// What is made of wheels: a folder of libraries in the repository root.
struct Part {
    /// What it is, for people.
    name: &'static str,
    /// The folder's name in the repository root.
    folder: &'static str,
    /// List of the wheels, for pip: its place in the repository, and what it says.
    requirements: [&'static str; 2],
    /// Files taken from the wheels, as `member=>place in the folder`; of a member that ends in `/`, all that is below it.
    files: &'static [&'static str],
    /// Size of the wheels.
    download_mb: u64,
    /// Room for the wheels and what is taken from them, and for the latter alone.
    needed_mb: [u64; 2],
}

/// What every build needs.
const SLIM: Part = Part {
    name: "libtorch",
    folder: ".libtorch",
    requirements: [
        "xtask/libtorch-requirements.txt",
        include_str!("../libtorch-requirements.txt"),
    ],
    files: &[
        "torch/lib/libtorch_cpu.so=>lib/libtorch_cpu.so",
        "torch/lib/libc10.so=>lib/libc10.so",
        "torch/lib/libgomp.so.1=>lib/libgomp.so.1",
        "torch/include/=>include/",
        "nvidia/cu13/lib/libcupti.so.13=>lib/libcupti.so.13",
        "nvidia/cu13/lib/libcudart.so.13=>lib/libcudart.so.13",
    ],
    download_mb: 543,
    needed_mb: [1200, 500],
};

/// What is loaded beside it at run time where something is computed on CUDA: nothing is linked to it, so that programs are the same
/// with and without.
const CUDA: Part = Part {
    name: "libtorch for CUDA",
    folder: ".libtorch-cuda",
    requirements: [
        "xtask/cuda-requirements.txt",
        include_str!("../cuda-requirements.txt"),
    ],
    files: &[
        "torch/lib/libtorch_cuda.so=>lib/libtorch_cuda.so",
        "torch/lib/libtorch_cuda_linalg.so=>lib/libtorch_cuda_linalg.so",
        "torch/lib/libcaffe2_nvrtc.so=>lib/libcaffe2_nvrtc.so",
        "torch/lib/libtorch_nvshmem.so=>lib/libtorch_nvshmem.so",
        "torch/lib/libc10_cuda.so=>lib/libc10_cuda.so",
        "nvidia/cu13/lib/=>lib/",
        "nvidia/cudnn/lib/=>lib/",
        "nvidia/cusparselt/lib/=>lib/",
        "nvidia/nccl/lib/=>lib/",
        "nvidia/nvshmem/lib/=>lib/",
    ],
    download_mb: 2512,
    needed_mb: [5900, 3350],
};

/// Makes `.libtorch` in the repository root; does nothing when it is there in the right version.
pub fn set_up(python: &Path) -> Result<()> {
    SLIM.set_up(python)
}

/// Makes `.libtorch-cuda` beside it.
pub fn set_up_cuda(python: &Path) -> Result<()> {
    CUDA.set_up(python)
}

impl Part {
    fn set_up(&self, python: &Path) -> Result<()> {
        let root = repository_root();
        let destination = root.join(self.folder);
        let stamp = destination.join("made-from.txt");
        let (name, recipe) = (self.name, self.recipe());
        if fs::read_to_string(&stamp).is_ok_and(|text| text == recipe) {
            println!("{name}: present in {}", destination.display());
            return Ok(());
        }
        ensure!(
            cfg!(all(target_os = "linux", target_arch = "x86_64")),
            "{name} is made from wheels for Linux on x86_64, and this is {} on {}; unpack libtorch {} yourself and \
             point LIBTORCH at it",
            std::env::consts::OS,
            std::env::consts::ARCH,
            version()?
        );
        self.check_room(&root)?;

        println!(
            "{name}: downloading {} wheels ({} MB) with pip ...",
            self.wheels().count(),
            self.download_mb
        );
        // Beside its destination, so that the rename at the end cannot leave half a libtorch behind.
        let work = root.join(format!(".libtorch.{}", std::process::id()));
        let made = self.make(python, &work, &recipe);
        let result = made.and_then(|()| {
            if destination.exists() {
                fs::remove_dir_all(&destination)
                    .with_context(|| format!("cannot remove the old {}", destination.display()))?;
            }
            fs::rename(work.join("libtorch"), &destination)
                .with_context(|| format!("cannot move {name} to {}", destination.display()))
        });
        if work.exists() {
            fs::remove_dir_all(&work)
                .with_context(|| format!("cannot remove {}", work.display()))?;
        }
        result?;
        println!("{name}: {} made in {}", version()?, destination.display());
        Ok(())
    }

    /// Everything that it is made from: where this is the same, it is.
    fn recipe(&self) -> String {
        format!("{}{}\n", self.requirements[1], self.files.join("\n"))
    }

    /// A line for each wheel: its name, version and hash.
    fn wheels(&self) -> impl Iterator<Item = &'static str> {
        let lines = self.requirements[1].lines();
        lines.filter(|line| !line.starts_with('#'))
    }

    fn make(&self, python: &Path, work: &Path, recipe: &str) -> Result<()> {
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
        let glibc = [28, 27, 26, 25, 24, 18, 17, 12, 5].map(|minor| format!("manylinux_2_{minor}"));
        // The old name of manylinux_2_17, which some wheels have alone.
        for name in glibc.iter().map(String::as_str).chain(["manylinux2014"]) {
            pip.arg("--platform").arg(format!("{name}_x86_64"));
        }
        pip.arg("--dest")
            .arg(&wheels)
            .arg("--require-hashes")
            .arg("--requirement");
        run(pip.arg(repository_root().join(self.requirements[0])))
            .context("cannot download libtorch: is a Python package index reachable with pip?")?;
        output(
            command(python)
                .arg(repository_root().join("xtask/extract_wheels.py"))
                .args([&wheels, &libtorch])
                .args(self.files),
        )?;
        if libtorch.join("include").exists() {
            // The wheel's own libtorch.so also pulls in CUDA. torch-sys asks the linker for -ltorch: hand on to the CPU library.
            fs::write(libtorch.join("lib/libtorch.so"), "INPUT(-ltorch_cpu)\n")?;
            fs::write(libtorch.join("build-version"), version()?)?;
        }
        fs::write(libtorch.join("made-from.txt"), recipe)?;
        Ok(())
    }

    /// Fails early when the disk has no room; `df -P` is the portable way to ask.
    fn check_room(&self, root: &Path) -> Result<()> {
        let table = output(command("df").args(["-P", "-k"]).arg(root))?;
        let free_kib: u64 = table
            .lines()
            .nth(1)
            .and_then(|line| line.split_whitespace().nth(3)?.parse().ok())
            .with_context(|| format!("cannot read the free space from df:\n{table}"))?;
        let ([needed_mb, afterwards_mb], free_mb) = (self.needed_mb, free_kib * 1024 / 1_000_000);
        if free_mb < needed_mb {
            bail!(
                "{} needs {needed_mb} MB of disk in {} while it is made ({afterwards_mb} MB afterwards), {free_mb} MB are free",
                self.name,
                root.display(),
            );
        }
        Ok(())
    }
}

/// The version of torch in the list of wheels.
pub fn version() -> Result<&'static str> {
    let mut wheels = SLIM.wheels();
    wheels
        .find_map(|line| line.strip_prefix("torch==")?.split_whitespace().next())
        .context("xtask/libtorch-requirements.txt names no torch==VERSION")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_version_comes_from_the_list_of_wheels() {
        assert_eq!(version().unwrap(), "2.11.0");
    }

    #[test]
    fn every_wheel_is_pinned_by_version_and_hash() {
        for line in [SLIM, CUDA].iter().flat_map(Part::wheels) {
            assert!(
                line.contains("==") && line.contains("--hash=sha256:"),
                "{line}"
            );
        }
    }

    #[test]
    fn the_part_for_cuda_is_of_the_wheels_of_the_slim_one_and_of_nvidias_libraries() {
        let slim: Vec<_> = SLIM.wheels().collect();
        let cuda: Vec<_> = CUDA.wheels().collect();
        assert!(slim.iter().all(|wheel| cuda.contains(wheel)), "{slim:?}");
        let library = |name: &str| {
            let begin = format!("nvidia-{name}");
            cuda.iter()
                .filter(|wheel| wheel.starts_with(&begin))
                .count()
        };
        for name in [
            "cublas",
            "cudnn",
            "cufft",
            "cusolver",
            "cusparse=",
            "nccl",
            "curand",
        ] {
            assert_eq!(library(name), 1, "{name}");
        }
        // What both parts have is the slim one's: the other one is loaded after it.
        let place = |rule: &&'static str| rule.split_once("=>").map(|(_, place)| place);
        let torch = CUDA.files.iter().filter(|rule| rule.starts_with("torch/"));
        for place in torch.filter_map(place) {
            assert!(
                SLIM.files.iter().all(|rule| !rule.ends_with(place)),
                "{place}"
            );
        }
        assert!(CUDA.needed_mb[0] >= CUDA.download_mb + CUDA.needed_mb[1]);
    }
}
