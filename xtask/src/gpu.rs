//! What a host with a GPU is asked: parity, speed and trainings with a deadline. It needs nothing but the built programs and a PyTorch with
//! CUDA; one JSON file comes back.

use crate::command::{repository_root, target_directory};
use crate::libtorch;
use anyhow::{Context as _, Result, bail, ensure};
use serde_json::{Value, json};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Instant;

/// Shares of the time for the steps per second, and for trainings of what is left after that.
const SPEED_SHARE: f64 = 0.15;
const TRAINING_SHARE: f64 = 0.75;

/// Arguments of `cargo xtask gpu`.
#[derive(clap::Args)]
pub struct Options {
    /// Time in all: parity and steps per second first, then all trainings side by side, then their evaluations
    #[arg(long, default_value_t = 10.0)]
    minutes: f64,
    /// cuda or cuda:N; cpu to try the script itself
    #[arg(long, default_value = "cuda")]
    device: String,
    /// The Python that has PyTorch with CUDA, of the version of our libtorch. Without one, .libtorch-cuda has to be there
    #[arg(long, default_value = "python3")]
    python: PathBuf,
    /// Folder of the built programs [default: that of this tree]
    #[arg(long)]
    programs: Option<PathBuf>,
    /// Folder that holds config/ and urdf/ [default: this tree where it was built, else the current folder]
    #[arg(long)]
    root: Option<PathBuf>,
    /// File for what was measured; beside it, in a folder of the same name, what the programs said
    #[arg(long, default_value = "out/gpu.json")]
    out: PathBuf,
    /// Recipes to train, by their names in config/recipes or as files; each sees the problems below
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "published_sctn,published_gctn"
    )]
    recipes: Vec<String>,
    /// Problems, each a training of its own
    #[arg(long, value_delimiter = ',', default_value = "placing,stacking")]
    problems: Vec<String>,
    /// Demonstrations of each problem, as the recipes say
    #[arg(long, default_value_t = 100)]
    demonstrations: u64,
    /// Test episodes of each policy
    #[arg(long, default_value_t = 20)]
    episodes: u64,
    /// Further arguments of `sctn bench device_parity` and `device_speed`, such as --networks compact
    #[arg(long, value_delimiter = ' ', allow_hyphen_values = true)]
    bench: Vec<String>,
    /// Keep demonstrations and weights too
    #[arg(long)]
    keep: bool,
}

/// Where everything is, and since when it runs.
struct Host {
    options: Options,
    root: PathBuf,
    sctn: PathBuf,
    /// For logs, demonstrations and weights.
    folder: PathBuf,
    /// Folder of PyTorch's libraries.
    libraries: Option<PathBuf>,
    begun: Instant,
}

/// What is found out on a host.
type Part = fn(&Host) -> Result<Value>;

/// Measures, and writes the file. Fails where a part failed; the file is there in any case, and says which.
pub fn measure(options: Options) -> Result<()> {
    let host = Host::new(options)?;
    let card = host.card();
    let mut report = json!({
        "device": host.options.device,
        "card": card,
        "processor": processor(),
        "cores": std::thread::available_parallelism().map_or(1, usize::from),
        "libtorch": libtorch::version()?,
        "libraries": host.libraries,
        "minutes": host.options.minutes,
    });
    let parts: [(&str, Part); 3] = [
        ("parity", Host::parity),
        ("speed", Host::speed),
        ("trainings", Host::trainings),
    ];
    let mut failed = Vec::new();
    for (name, part) in parts {
        println!("=== {name} ===");
        report[name] = part(&host).unwrap_or_else(|error| json!({"error": format!("{error:#}")}));
        failed.extend(errors(name, &report[name]));
        report["seconds"] = host.seconds().round().into();
        // Written after each part: what ends this in the middle leaves what was measured until then.
        let text = serde_json::to_string_pretty(&report)? + "\n";
        let out = &host.options.out;
        fs::write(out, text).with_context(|| out.display().to_string())?;
    }
    if !host.options.keep {
        for folder in ["demos", "trainings"] {
            let folder = host.folder.join(folder);
            if folder.exists() {
                fs::remove_dir_all(&folder).with_context(|| folder.display().to_string())?;
            }
        }
    }
    println!("{}", host.options.out.display());
    ensure!(failed.is_empty(), "failed: {}", failed.join("; "));
    Ok(())
}

/// What failed in a part, by its place.
fn errors(place: &str, value: &Value) -> Vec<String> {
    match value {
        Value::Object(fields) => match fields.get("error") {
            Some(error) => vec![format!("{place}: {error}")],
            None => {
                let inner = fields.iter();
                inner
                    .flat_map(|(name, value)| errors(&format!("{place}.{name}"), value))
                    .collect()
            }
        },
        Value::Array(values) => {
            let inner = values.iter().enumerate();
            inner
                .flat_map(|(index, value)| errors(&format!("{place}[{index}]"), value))
                .collect()
        }
        _ => Vec::new(),
    }
}

impl Host {
    fn new(options: Options) -> Result<Self> {
        let begun = Instant::now();
        let built_here = repository_root();
        let root = match &options.root {
            Some(root) => root.clone(),
            None if built_here.join("config").is_dir() => built_here,
            None => PathBuf::from("."),
        };
        let root = absolute(&root)?;
        ensure!(
            root.join("config/recipes").is_dir(),
            "{}: expected a folder with config/; --root names one",
            root.display()
        );
        let programs = options
            .programs
            .clone()
            .unwrap_or_else(target_directory_of_release);
        let sctn = absolute(&programs)?.join("sctn");
        ensure!(
            sctn.is_file(),
            "{}: no such program; build it with cargo build --release, or name its folder with --programs",
            sctn.display()
        );
        ensure!(
            options.minutes.is_finite() && options.minutes > 0.0,
            "--minutes {}: expected a positive number",
            options.minutes
        );
        let folder = absolute(&options.out)?.with_extension("");
        fs::create_dir_all(&folder).with_context(|| folder.display().to_string())?;
        let libraries = match options.device.starts_with("cuda") {
            true => Some(libraries(&options.python, &root)?),
            false => None,
        };
        Ok(Self {
            options,
            root,
            sctn,
            folder,
            libraries,
            begun,
        })
    }

    fn seconds(&self) -> f64 {
        self.begun.elapsed().as_secs_f64()
    }

    /// Seconds that are left.
    fn left(&self) -> f64 {
        (60.0 * self.options.minutes - self.seconds()).max(0.0)
    }

    /// The card's name, memory and driver, where NVIDIA's program says so.
    fn card(&self) -> Option<String> {
        let mut command = Command::new("nvidia-smi");
        command.args([
            "--query-gpu=name,memory.total,driver_version",
            "--format=csv,noheader",
        ]);
        let output = command
            .output()
            .ok()
            .filter(|output| output.status.success())?;
        let text = String::from_utf8_lossy(&output.stdout);
        let on_a_card = self.options.device.starts_with("cuda");
        on_a_card.then(|| text.trim().replace('\n', "; "))
    }

    /// A command of `sctn`, whose messages go to a file of this name.
    fn sctn(&self, log: &str, arguments: &[&str]) -> Result<Command> {
        let path = self.folder.join(format!("{log}.log"));
        let log = fs::File::create(&path).with_context(|| path.display().to_string())?;
        let mut command = Command::new(&self.sctn);
        command
            .arg("--root")
            .arg(&self.root)
            .args(arguments)
            .current_dir(&self.folder)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(log);
        if let Some(libraries) = &self.libraries {
            let mut paths = vec![libraries.clone()];
            let others = std::env::var_os("LD_LIBRARY_PATH");
            paths.extend(others.iter().flat_map(std::env::split_paths));
            command.env("LD_LIBRARY_PATH", std::env::join_paths(paths)?);
        }
        Ok(command)
    }

    /// The JSON object that a command prints last.
    fn json_of(&self, log: &str, arguments: &[&str]) -> Result<Value> {
        finished(log, self.sctn(log, arguments)?.spawn()?, &self.folder)
    }

    fn parity(&self) -> Result<Value> {
        let mut arguments = vec!["bench", "device_parity", "--json", "--device"];
        arguments.push(&self.options.device);
        arguments.extend(self.options.bench.iter().map(String::as_str));
        // In 32-bit floats, as the processor: a card would round them to 19 bits before it multiplies.
        let mut command = self.sctn("parity", &arguments)?;
        command.env("NVIDIA_TF32_OVERRIDE", "0");
        finished("parity", command.spawn()?, &self.folder)
    }

    fn speed(&self) -> Result<Value> {
        let seconds = (SPEED_SHARE * 60.0 * self.options.minutes).to_string();
        let mut arguments = vec!["bench", "device_speed", "--json", "--seconds", &seconds];
        arguments.extend(["--device", &self.options.device]);
        arguments.extend(self.options.bench.iter().map(String::as_str));
        self.json_of("speed", &arguments)
    }

    fn trainings(&self) -> Result<Value> {
        let Options {
            recipes,
            problems,
            demonstrations,
            ..
        } = &self.options;
        for problem in problems {
            // Demonstrators fail now and then.
            let count = (demonstrations + demonstrations / 10 + 4).to_string();
            let arguments = ["demos", "--problem", problem, "--episodes", &count];
            let arguments = [&arguments[..], &["--seed", "0", "--out", "demos", "--json"]].concat();
            self.json_of(&format!("demos-{problem}"), &arguments)?;
        }
        let mut runs = Vec::new();
        for recipe in recipes {
            let file = match Path::new(recipe).is_file() {
                true => absolute(Path::new(recipe))?,
                false => self
                    .root
                    .join("config/recipes")
                    .join(format!("{recipe}.yaml")),
            };
            let stem = file.file_stem().unwrap_or_default().to_string_lossy();
            for problem in problems {
                let name = format!("{stem}-{problem}");
                runs.push((name, file.display().to_string(), problem.as_str()));
            }
        }
        let deadline = (TRAINING_SHARE * self.left()).round();
        let device = self.options.device.as_str();
        // Side by side: all begin at once and have the same deadline.
        let trained = self.side_by_side(&runs, |(name, recipe, problem)| {
            let (out, deadline) = (format!("trainings/{name}"), deadline.to_string());
            let words = [
                "train",
                "--recipe",
                recipe,
                "--problems",
                problem,
                "--demos",
                "demos",
                "--out",
                &out,
                "--device",
                device,
                "--deadline",
                &deadline,
                "--json",
            ];
            (format!("train-{name}"), words.map(str::to_owned).to_vec())
        })?;
        let episodes = self.options.episodes.to_string();
        let tested = self.side_by_side(&runs, |(name, _, problem)| {
            let policy = format!("trainings/{name}/policy.safetensors");
            let words = [
                "evaluate",
                "--checkpoint",
                &policy,
                "--problem",
                problem,
                "--episodes",
                &episodes,
                "--seed",
                "10000",
                "--device",
                device,
                "--shown",
                "shown",
                "--json",
            ];
            (
                format!("evaluate-{name}"),
                words.map(str::to_owned).to_vec(),
            )
        })?;
        let all = runs.iter().zip(trained).zip(tested);
        let all = all.map(|(((name, _, problem), trained), mut tested)| {
            if let Some(report) = tested.as_object_mut() {
                // One line for each episode.
                report.remove("reports");
            }
            json!({
                "name": name, "problem": problem, "demonstrations": demonstrations,
                "deadline_s": deadline, "training": trained, "test": tested,
            })
        });
        Ok(all.collect())
    }

    /// A command for each run, all at once; what each printed, or why it failed.
    fn side_by_side<Run>(
        &self,
        runs: &[Run],
        command: impl Fn(&Run) -> (String, Vec<String>),
    ) -> Result<Vec<Value>> {
        let mut children = Vec::new();
        for run in runs {
            let (log, words) = command(run);
            let words: Vec<&str> = words.iter().map(String::as_str).collect();
            children.push((log.clone(), self.sctn(&log, &words)?.spawn()?));
        }
        let ends = children.into_iter().map(|(log, child)| {
            let end = finished(&log, child, &self.folder);
            end.unwrap_or_else(|error| json!({"error": format!("{error:#}")}))
        });
        Ok(ends.collect())
    }
}

/// Waits for a program; gives the JSON object that it printed last.
fn finished(log: &str, child: std::process::Child, folder: &Path) -> Result<Value> {
    println!("{log} ...");
    let output = child.wait_with_output()?;
    if !output.status.success() {
        let path = folder.join(format!("{log}.log"));
        let said = fs::read_to_string(&path).unwrap_or_default();
        let mut last: Vec<&str> = said.lines().rev().take(5).collect();
        last.reverse();
        bail!("{log}: {}: {}", output.status, last.join("\n"));
    }
    let text = String::from_utf8_lossy(&output.stdout);
    let last = text.lines().last().unwrap_or_default();
    serde_json::from_str(last).with_context(|| format!("{log} printed {last:?}, expected JSON"))
}

/// The folder of the libraries that compute on CUDA: of `.libtorch-cuda`, or of a PyTorch with CUDA of our version.
fn libraries(python: &Path, root: &Path) -> Result<PathBuf> {
    const SCRIPT: &str = "import os, torch\nprint(torch.__version__, torch.cuda.is_available(), \
                          os.path.join(os.path.dirname(torch.__file__), 'lib'), sep='\\n')";
    let own = root.join(".libtorch-cuda/lib");
    if own.is_dir() {
        return Ok(own);
    }
    let version = libtorch::version()?;
    let expected = format!(
        "expected a Python with PyTorch {version} with CUDA (--python), or .libtorch-cuda of `cargo xtask setup --cuda`"
    );
    let output = Command::new(python).args(["-c", SCRIPT]).output();
    let output = output.with_context(|| format!("{}: {expected}", python.display()))?;
    let text = String::from_utf8_lossy(&output.stdout);
    let lines: Vec<&str> = text.lines().collect();
    let [found, has_cuda, folder] = lines[..] else {
        bail!("{} cannot import torch: {expected}", python.display());
    };
    ensure!(
        found.split('+').next() == Some(version),
        "{} has PyTorch {found}: {expected}",
        python.display()
    );
    ensure!(
        has_cuda == "True",
        "{} has PyTorch {found}, which finds no card: {expected}",
        python.display()
    );
    Ok(PathBuf::from(folder))
}

fn target_directory_of_release() -> PathBuf {
    // Beside this program, where the tree that it was built in is not there.
    let built = target_directory().join("release");
    let own = std::env::current_exe().ok();
    match (built.is_dir(), own.as_deref().and_then(Path::parent)) {
        (false, Some(folder)) => folder.to_owned(),
        _ => built,
    }
}

fn absolute(path: &Path) -> Result<PathBuf> {
    std::path::absolute(path).with_context(|| path.display().to_string())
}

/// The processor's name.
fn processor() -> Option<String> {
    let info = fs::read_to_string("/proc/cpuinfo").ok()?;
    let line = info
        .lines()
        .find_map(|line| line.strip_prefix("model name"))?;
    Some(line.split_once(':')?.1.trim().to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_failed_is_named_by_its_place() {
        let report =
            json!([{"name": "a", "test": {"error": "no card"}}, {"training": {"step": 3}}]);
        assert_eq!(
            errors("trainings", &report),
            ["trainings[0].test: \"no card\""]
        );
    }

    #[test]
    fn a_python_without_pytorch_is_refused_by_name() {
        let folder = std::env::temp_dir();
        for python in ["/bin/false", "/nonexistent/python"] {
            let error = libraries(Path::new(python), &folder).unwrap_err();
            let error = format!("{error:#}");
            assert!(
                error.contains(python) && error.contains("PyTorch 2.11.0 with CUDA"),
                "{error}"
            );
        }
    }
}
