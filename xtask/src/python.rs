//! The Python on this machine, and the virtual environment of the end-to-end tests: rclpy, our messages, pytest.

use crate::command::{
    command, output, repository_root, run, target_directory, without_cargo_variables,
};
use anyhow::{Context as _, Result, bail, ensure};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Mutex, PoisonError};

/// Oldest and newest CPython 3 for which there are ROS 2 wheels.
const ROS_MINORS: std::ops::RangeInclusive<u32> = 10..=13;

/// A distribution of ROS 2 that the tests run against.
struct Distribution {
    /// Folder of the virtual environment.
    folder: &'static str,
    requirements: &'static str,
    /// ROS packages to build: ours, and what is needed beside it that has no wheel.
    packages: &'static [&'static str],
}

/// Everything is tested against it.
const JAZZY: Distribution = Distribution {
    folder: ".venv",
    requirements: "tests/requirements.txt",
    packages: &["msgs", "tests/tf2_msgs", "tests/ur_msgs"],
};

/// The table of docs/ros2.md is tested against it too.
const KILTED: Distribution = Distribution {
    folder: ".venv.kilted",
    requirements: "tests/requirements-kilted.txt",
    packages: &["msgs"],
};

/// The machine's `python3`, checked to be 3.9 or newer and to have pip.
pub fn with_pip() -> Result<PathBuf> {
    let python = PathBuf::from("python3");
    let minor = minor_version(&python).context(
        "Python 3.9 or newer is needed (to fetch libtorch with pip), and `python3` does not run",
    )?;
    ensure!(
        minor >= 9,
        "Python 3.9 or newer is needed, and `python3` is 3.{minor}"
    );
    output(command(&python).args(["-m", "pip", "--version"]))
        .context("`python3` has no pip: install it (Debian and Ubuntu: apt install python3-pip)")?;
    Ok(python)
}

/// A Python that can import PyTorch: this repository's, the shell's, or the distribution's.
pub fn with_pytorch() -> Option<PathBuf> {
    let environment = repository_root().join(".venv/bin/python3");
    let pythons = [environment, "python3".into(), "/usr/bin/python3".into()];
    pythons
        .into_iter()
        .find(|python| output(command(python).args(["-c", "import torch"])).is_ok())
}

/// ruff over every Python file of the repository, by the rules of ruff.toml.
pub fn lint() -> Result<()> {
    let environment = Environment::set_up()?;
    for check in [&["check"][..], &["format", "--check"]] {
        run(environment.python()?.args(["-m", "ruff"]).args(check))?;
    }
    Ok(())
}

/// Installs the package of `python/` as a user does, with pip into a fresh environment, and what its tests need; returns the
/// environment's Python. That of a Python with PyTorch, where there is one, sees it: the networks are tested too.
pub fn install_package() -> Result<PathBuf> {
    let base = match with_pytorch() {
        Some(python) if fits_package(&python).is_ok() => python,
        _ => for_package()?,
    };
    let prefix = target_directory().join("multiravens-venv");
    if prefix.exists() {
        fs::remove_dir_all(&prefix)
            .with_context(|| format!("cannot remove the old {}", prefix.display()))?;
    }
    output(
        command(&base)
            .args(["-m", "venv", "--system-site-packages"])
            .arg(&prefix),
    )
    .context("cannot make a virtual environment (Debian and Ubuntu: apt install python3-venv)")?;
    let python = prefix.join("bin/python");
    println!("python: installing multiravens for {} ...", base.display());
    let pip = [
        "-m",
        "pip",
        "install",
        "--quiet",
        "--disable-pip-version-check",
    ];
    run(command(&python)
        .args(pip)
        .args(["-r", "python/tests/requirements.txt"]))?;
    // As from a shell: what Cargo says of xtask would have dependencies compiled again.
    let mut install = command(&python);
    without_cargo_variables(&mut install);
    run(install.args(pip).arg("./python"))?;
    Ok(python)
}

/// Checks that the package can be installed for this Python.
fn fits_package(python: &Path) -> Result<()> {
    let minor = minor_version(python).context("does not run")?;
    ensure!(minor >= 10, "is Python 3.{minor}, expected 3.10 or newer");
    output(command(python).args(["-c", "import ensurepip, venv"]))
        .context("has no venv (Debian and Ubuntu: apt install python3-venv)")?;
    Ok(())
}

/// The first Python here that the package can be installed for.
fn for_package() -> Result<PathBuf> {
    let names = [
        "python3",
        "/usr/bin/python3",
        "python3.13",
        "python3.12",
        "python3.11",
        "python3.10",
    ];
    let mut reasons = String::new();
    for name in names {
        match fits_package(Path::new(name)) {
            Ok(()) => return Ok(name.into()),
            Err(error) => reasons += &format!("\n  {name}: {error:#}"),
        }
    }
    bail!("the package multiravens needs Python 3.10 or newer with venv; none was found:{reasons}")
}

/// The 11 of Python 3.11.
fn minor_version(python: &Path) -> Result<u32> {
    let script = "import sys; print(*sys.version_info[:2])";
    let version = output(command(python).args(["-c", script]))?;
    match version.split_whitespace().collect::<Vec<_>>()[..] {
        ["3", minor] => minor.parse().with_context(|| {
            format!(
                "cannot read the version {version:?} of {}",
                python.display()
            )
        }),
        _ => bail!(
            "{} is not Python 3 but {}",
            python.display(),
            version.trim()
        ),
    }
}

/// A virtual environment with ROS 2.
pub struct Environment {
    prefix: PathBuf,
    distribution: &'static Distribution,
}

impl Environment {
    /// Makes `.venv` with ROS 2 Jazzy and our messages; does nothing when it is there in the right version.
    pub fn set_up() -> Result<Self> {
        Self::of(&JAZZY)
    }

    /// Makes `.venv.kilted`, the same for ROS 2 Kilted.
    pub fn set_up_kilted() -> Result<Self> {
        Self::of(&KILTED)
    }

    /// Waits where another thread makes one.
    fn of(distribution: &'static Distribution) -> Result<Self> {
        static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());
        let _made = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
        let root = repository_root();
        let environment = Self {
            prefix: root.join(distribution.folder),
            distribution,
        };
        environment.install_packages(&root)?;
        environment.build_messages(&root)?;
        Ok(environment)
    }

    /// A command that runs this environment's Python, with its programs first in PATH.
    pub fn python(&self) -> Result<Command> {
        let mut command = command(self.prefix.join("bin/python"));
        let mut path = vec![self.prefix.join("bin")];
        path.extend(std::env::split_paths(
            &std::env::var_os("PATH").unwrap_or_default(),
        ));
        command
            .env("PATH", std::env::join_paths(path)?)
            .env("VIRTUAL_ENV", &self.prefix)
            .env("AMENT_PREFIX_PATH", &self.prefix)
            .env("CMAKE_PREFIX_PATH", &self.prefix)
            // Another ROS install in the shell must not mix in.
            .env_remove("PYTHONPATH")
            .env_remove("PYTHONHOME");
        Ok(command)
    }

    fn install_packages(&self, root: &Path) -> Result<()> {
        let stamp = self.prefix.join("made-from.txt");
        let requirements = root.join(self.distribution.requirements);
        let wanted = fs::read_to_string(&requirements)
            .with_context(|| format!("cannot read {}", requirements.display()))?;
        // A virtual environment holds absolute paths: one that was moved has to be made again.
        let recipe = format!("{}\n{wanted}", self.prefix.display());
        if fs::read_to_string(&stamp).is_ok_and(|text| text == recipe) {
            println!("python: packages present in {}", self.prefix.display());
            return Ok(());
        }
        let python = for_ros()?;
        println!(
            "python: installing ROS 2 for {} into {} ...",
            python.display(),
            self.prefix.display()
        );
        if self.prefix.exists() {
            fs::remove_dir_all(&self.prefix)
                .with_context(|| format!("cannot remove the old {}", self.prefix.display()))?;
        }
        output(command(&python).args(["-m", "venv"]).arg(&self.prefix)).context(
            "cannot make a virtual environment (Debian and Ubuntu: apt install python3-venv)",
        )?;
        run(self
            .python()?
            .args([
                "-m",
                "pip",
                "install",
                "--quiet",
                "--disable-pip-version-check",
                "-r",
            ])
            .arg(&requirements))
        .with_context(|| format!("cannot install the packages of {}", requirements.display()))?;
        run(self.python()?.arg(root.join("xtask/repair_ros_wheels.py")))?;
        fs::write(&stamp, recipe).with_context(|| format!("cannot write {}", stamp.display()))
    }

    /// Builds our ROS packages and installs them into the environment.
    fn build_messages(&self, root: &Path) -> Result<()> {
        let stamp = self.prefix.join("messages-made-from.txt");
        let mut recipe = String::new();
        for package in self.distribution.packages {
            recipe += &message_sources(&root.join(package))?;
        }
        if fs::read_to_string(&stamp).is_ok_and(|text| text == recipe) {
            println!("python: messages present in {}", self.prefix.display());
            return Ok(());
        }
        for package in self.distribution.packages {
            println!("python: building the messages of {package} ...");
            self.build_package(
                &root.join(package),
                &self.prefix.join("build").join(package),
            )
            .with_context(|| {
                format!("cannot build the ROS package {package} (a C++ compiler is needed)")
            })?;
        }
        fs::write(&stamp, recipe).with_context(|| format!("cannot write {}", stamp.display()))
    }

    fn build_package(&self, source: &Path, build: &Path) -> Result<()> {
        if build.exists() {
            fs::remove_dir_all(build)
                .with_context(|| format!("cannot remove {}", build.display()))?;
        }
        // Through Python, so that the environment's CMake runs and no other.
        let cmake = || -> Result<Command> {
            let mut command = self.python()?;
            command.args(["-c", "import cmake; cmake.cmake()"]);
            Ok(command)
        };
        let prefix = format!("-DCMAKE_INSTALL_PREFIX={}", self.prefix.display());
        output(
            cmake()?
                .arg("-S")
                .arg(source)
                .arg("-B")
                .arg(build)
                .args([
                    "-G",
                    "Ninja",
                    &prefix,
                    "-DCMAKE_INSTALL_RPATH=$ORIGIN",
                    "-DCMAKE_BUILD_TYPE=Release",
                ])
                .args(["-DBUILD_TESTING=OFF", "-DPython3_FIND_VIRTUALENV=ONLY"]),
        )?;
        output(
            cmake()?
                .arg("--build")
                .arg(build)
                .args(["--target", "install"]),
        )
        .map(drop)
    }
}

/// A Python that the ROS 2 wheels fit and that can build extension modules.
fn for_ros() -> Result<PathBuf> {
    let names = std::iter::once("python3".to_owned())
        .chain(ROS_MINORS.rev().map(|minor| format!("python3.{minor}")));
    let mut reasons = String::new();
    for name in names {
        match fits_ros(Path::new(&name)) {
            Ok(()) => return Ok(name.into()),
            Err(error) => reasons += &format!("\n  {name}: {error:#}"),
        }
    }
    bail!(
        "the end-to-end tests need Python 3.{} to 3.{} with pip, venv and headers; none was found:{reasons}",
        ROS_MINORS.start(),
        ROS_MINORS.end()
    )
}

fn fits_ros(python: &Path) -> Result<()> {
    let minor = minor_version(python).context("does not run")?;
    ensure!(
        ROS_MINORS.contains(&minor),
        "there are no ROS 2 wheels for Python 3.{minor}"
    );
    output(command(python).args(["-c", "import ensurepip, venv"]))
        .context("has no venv (Debian and Ubuntu: apt install python3-venv)")?;
    let script = "import pathlib, sysconfig; print(pathlib.Path(sysconfig.get_path('include'), 'Python.h').is_file())";
    ensure!(
        output(command(python).args(["-c", script]))?.trim() == "True",
        "has no headers (Debian and Ubuntu: apt install python3-dev)"
    );
    Ok(())
}

/// Everything that the ROS package is built from, as one text: file names and contents.
fn message_sources(package: &Path) -> Result<String> {
    let mut text = String::new();
    let mut add = |path: &Path| -> Result<()> {
        let contents =
            fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
        text += &format!("== {}\n{contents}\n", path.display());
        Ok(())
    };
    for file in ["package.xml", "CMakeLists.txt"] {
        add(&package.join(file))?;
    }
    for folder in ["msg", "srv", "action"] {
        let folder = package.join(folder);
        if folder.is_dir() {
            let mut files = fs::read_dir(&folder)?
                .map(|entry| Ok(entry?.path()))
                .collect::<Result<Vec<_>>>()?;
            files.sort();
            files.iter().try_for_each(|path| add(path))?;
        }
    }
    Ok(text)
}
