//! `sctn train`, `search`, `embed` and `goals` as programs: what goes on after a stop, and what is refused.

use gctn::Policy;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/..");

/// A folder with one demonstration of *placing*, and a recipe of a network so small that a step takes milliseconds.
struct Desk {
    folder: tempfile::TempDir,
}

impl Desk {
    fn new(name: &str) -> Self {
        let folder = tempfile::Builder::new().prefix(name).tempdir().unwrap();
        let desk = Self { folder };
        let made = desk.sctn(None, &["demos", "--problem", "placing", "--episodes", "1"]);
        assert!(made.status.success(), "{}", said(&made));
        std::fs::write(desk.path("recipe.yaml"), recipe("placing", 0)).unwrap();
        desk
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Runs a command with what it needs from here, files being at most so many blocks of 512 bytes or 1 KiB long.
    fn sctn(&self, most_blocks: Option<u32>, arguments: &[&str]) -> Output {
        // Ignored, a file that grows too long is a write that fails, as on a full disk.
        let limit = most_blocks.map_or(String::new(), |n| format!("trap '' XFSZ; ulimit -f {n};"));
        let common: &[&str] = match arguments[0] {
            "demos" => &["--seed", "0", "--out", "demos", "--threads", "1"],
            _ => &["--demos", "demos"],
        };
        Command::new("sh")
            .current_dir(self.folder.path())
            .args(["-c", &format!("{limit} exec \"$@\""), "sh"])
            .args([env!("CARGO_BIN_EXE_sctn"), "--root", ROOT])
            .args(arguments)
            .args(common)
            .output()
            .unwrap()
    }

    fn train(&self, most_blocks: Option<u32>, out: &str, resume: bool) -> Output {
        let mut arguments = vec!["train", "--recipe", "recipe.yaml", "--out", out];
        arguments.extend(resume.then_some("--resume"));
        self.sctn(most_blocks, &arguments)
    }
}

fn recipe(problem: &str, validation_episodes: u32) -> String {
    format!(
        "problems: [{problem}]
demonstrations: 1
network: {{network: {{kind: compact, channels: [4, 4, 8, 8], blocks: [0, 0, 0, 0], window_cells: 5}}, rotations: 4}}
training: {{seed: 0, steps: 4, batch: 1, learning_rate: 0.001, schedule: cosine, warm_up_steps: 1, weight_decay: 0.0,
  gradient_clip: 5.0, place_loss: right_and_one_wrong, label_sigma_cells: 0.7, augmentation: {{}}, threads: 1}}
snapshots: 2
validation: {{episodes: {validation_episodes}, seed: 1}}
"
    )
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// What a command that has to fail said.
fn refused(output: &Output) -> String {
    assert!(!output.status.success(), "{}", said(output));
    said(output)
}

fn bytes(path: &Path) -> Vec<u8> {
    std::fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

#[test]
fn a_full_disk_is_told_and_the_last_good_snapshot_stays_usable() {
    let desk = Desk::new("full");
    assert!(desk.train(None, "whole", false).status.success());

    // The second snapshot cannot be written: a folder stands where it would be.
    let blocked = desk.path("out/snapshots/0000004.safetensors.part");
    std::fs::create_dir_all(&blocked).unwrap();
    let said = refused(&desk.train(None, "out", false));
    assert!(said.contains("0000004.safetensors"), "{said}");
    std::fs::remove_dir(&blocked).unwrap();
    // Nor when the disk is full.
    let said = refused(&desk.train(Some(4), "out", true));
    assert!(
        said.contains("0000004.safetensors") && said.contains("too large"),
        "{said}"
    );
    assert!(!desk.path("out/policy.safetensors").exists());
    let snapshot = desk.path("out/snapshots/0000002.safetensors");
    Policy::load(&snapshot).unwrap();
    assert!(!desk.path("out/snapshots/0000004.safetensors").exists());

    let resumed = desk.train(None, "out", true);
    assert!(resumed.status.success(), "{}", self::said(&resumed));
    let [whole, resumed] = ["whole", "out"].map(|out| desk.path(out).join("policy.safetensors"));
    assert!(bytes(&whole) == bytes(&resumed), "another policy");
}

#[test]
fn a_deadline_stops_a_training_which_then_goes_on_as_if_it_had_not() {
    let desk = Desk::new("deadline");
    let train = |out: &str, more: &[&str]| {
        let arguments = ["train", "--recipe", "recipe.yaml", "--json", "--out", out];
        let output = desk.sctn(None, &[&arguments[..], more].concat());
        assert!(output.status.success(), "{}", said(&output));
        serde_json::from_slice::<serde_json::Value>(&output.stdout).unwrap()
    };
    // Snapshots after every step; then the recipe's two, of the same four steps.
    let each = recipe("placing", 0).replace("snapshots: 2", "snapshots: 4");
    std::fs::write(desk.path("recipe.yaml"), each).unwrap();
    train("each", &[]);
    std::fs::write(desk.path("recipe.yaml"), recipe("placing", 1)).unwrap();
    let whole = train("whole", &[]);
    assert_eq!(whole["stopped"], "end");
    assert_eq!(whole["step"], 4);

    // It has passed before the first step, which is done all the same.
    for step in 1..4 {
        let resume: &[&str] = if step > 1 { &["--resume"] } else { &[] };
        let stopped = train("out", &[&["--deadline", "0"][..], resume].concat());
        assert_eq!(stopped["stopped"], "deadline");
        assert_eq!([&stopped["step"], &stopped["steps"]], [step, 4]);
        let last = stopped["snapshots"].as_array().unwrap().last().unwrap();
        assert_eq!(last["step"], step);
        assert!(last["completion"]["placing"].is_number(), "{last}");
        // Where the clock stopped it makes no difference to the weights.
        let weights = |out: &str| {
            let path = desk.path(&format!("{out}/snapshots/{step:07}.safetensors"));
            let bytes = bytes(&path);
            let head = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
            bytes[8 + head..].to_vec()
        };
        assert!(weights("out") == weights("each"), "step {step}");
        assert!(desk.path("out/policy.safetensors").exists());
    }
    let resumed = train("out", &["--resume", "--deadline", "1e9"]);
    let close = |one: &serde_json::Value, other: &serde_json::Value| {
        (one.as_f64().unwrap() - other.as_f64().unwrap()).abs() < 1e-5
    };
    let [snapshots, expected] =
        [&resumed, &whole].map(|report| report["snapshots"].as_array().unwrap());
    assert_eq!(snapshots.len(), expected.len());
    for (one, other) in snapshots.iter().zip(expected) {
        assert_eq!(one["step"], other["step"]);
        assert_eq!(one["completion"], other["completion"]);
        for loss in ["pick_loss", "place_loss"] {
            assert!(close(&one[loss], &other[loss]), "{loss}: {one} {other}");
        }
    }
    let [whole, resumed] = ["whole", "out"].map(|out| desk.path(out).join("policy.safetensors"));
    assert!(bytes(&whole) == bytes(&resumed), "another policy");

    let wrong = ["train", "--recipe", "recipe.yaml", "--out", "wrong"];
    let said = refused(&desk.sctn(None, &[&wrong[..], &["--deadline=-1"]].concat()));
    assert!(said.contains("expected a number of seconds"), "{said}");
}

#[test]
fn a_device_that_cannot_be_used_is_refused_before_anything_is_done() {
    let desk = Desk::new("device");
    std::fs::write(
        desk.path("sweep.yaml"),
        format!(
            "{}agents: [sctn_step]\nseeds: [0]\ntest: {{episodes: 1, seed: 10000}}\n",
            recipe("placing", 1).replace("demonstrations: 1", "demonstrations: [1]")
        ),
    )
    .unwrap();
    let commands = [
        "train --recipe recipe.yaml --demos demos --out out",
        "sweep --sweep sweep.yaml --demos demos --out out",
        "evaluate --problem placing --seed 10000 --episodes 1",
        "launch --problem placing --seed 10000 --record out",
    ];
    for command in commands {
        let with = |device: &str| {
            Command::new(env!("CARGO_BIN_EXE_sctn"))
                .current_dir(desk.folder.path())
                // Where this machine has CUDA, none of its cards is seen.
                .env("CUDA_VISIBLE_DEVICES", "")
                .args(["--root", ROOT])
                .args(command.split(' '))
                .args(["--device", device])
                .output()
                .unwrap()
        };
        for device in ["cuda", "cuda:1"] {
            let said = refused(&with(device));
            assert!(
                said.contains(&format!("device {device} cannot be used: ")),
                "{command}: {said}"
            );
        }
        let said = refused(&with("gpu"));
        assert!(
            said.contains("device is gpu, expected cpu, cuda or cuda:N"),
            "{command}: {said}"
        );
        assert!(!desk.path("out").exists(), "{command}");
    }
    // In a recipe too.
    let asked = recipe("placing", 0).replace("threads: 1", "threads: 1, device: tpu");
    std::fs::write(desk.path("recipe.yaml"), asked).unwrap();
    let said = refused(&desk.train(None, "out", false));
    assert!(
        said.contains("recipe.yaml") && said.contains("device is tpu"),
        "{said}"
    );
}

#[test]
fn demonstrations_of_another_problem_and_broken_ones_are_refused_by_name() {
    let desk = Desk::new("data");
    std::fs::rename(desk.path("demos/placing"), desk.path("demos/stacking")).unwrap();
    std::fs::write(desk.path("recipe.yaml"), recipe("stacking", 0)).unwrap();
    let said = refused(&desk.train(None, "out", false));
    for expected in ["demos/stacking/000000", "placing", "expected stacking"] {
        assert!(said.contains(expected), "{expected}: {said}");
    }
    std::fs::rename(desk.path("demos/stacking"), desk.path("demos/placing")).unwrap();
    std::fs::write(desk.path("recipe.yaml"), recipe("placing", 0)).unwrap();
    let folder = desk.path("demos/placing/000000");
    let file = std::fs::read_dir(&folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .find(|path| {
            path.extension()
                .is_some_and(|extension| extension == "mcap")
        })
        .unwrap();
    let whole = bytes(&file);
    for len in [0, whole.len() / 2, whole.len() - 100] {
        std::fs::write(&file, &whole[..len]).unwrap();
        let said = refused(&desk.train(None, "out", false));
        assert!(said.contains("demos/placing/000000"), "{len}: {said}");
    }
    assert!(!desk.path("out/policy.safetensors").exists());
    std::fs::write(&file, whole).unwrap();
    assert!(desk.train(None, "out", false).status.success());
    // One is there, and two are asked for.
    let two = recipe("placing", 0).replace("demonstrations: 1", "demonstrations: 2");
    std::fs::write(desk.path("recipe.yaml"), two).unwrap();
    let said = refused(&desk.train(None, "two", false));
    assert!(
        said.contains("holds 1 demonstrations, expected 2"),
        "{said}"
    );
}

#[test]
fn a_search_goes_on_where_it_stopped_and_repeats() {
    let desk = Desk::new("search");
    std::fs::write(desk.path("recipe.yaml"), recipe("placing", 1)).unwrap();
    let search = |trials: &str, more: &[&str]| {
        let arguments = ["search", "--recipe", "recipe.yaml", "--out", "found"];
        let arguments = [&arguments[..], &["--trials", trials], more].concat();
        desk.sctn(None, &arguments)
    };
    let first = search("1", &[]);
    assert!(first.status.success(), "{}", said(&first));
    let trial = |number: u32| {
        let path = desk.path(&format!("found/{number:03}.json"));
        let mut trial: serde_json::Value = serde_json::from_slice(&bytes(&path)).unwrap();
        trial["cpu_seconds"] = 0.into();
        trial
    };
    let before = bytes(&desk.path("found/000.json"));
    let both = search("2", &["--json"]);
    assert!(both.status.success(), "{}", said(&both));
    assert!(before == bytes(&desk.path("found/000.json")), "done twice");
    let report: serde_json::Value = serde_json::from_slice(&both.stdout).unwrap();
    assert_eq!(report["trials"], 2);
    assert_eq!(report["best"]["best"]["episodes"], 1);
    assert_eq!(trial(0)["snapshots"].as_array().unwrap().len(), 2);
    let schemes = [trial(0), trial(1)].map(|trial| trial["steps"]["scheme"].clone());
    assert_eq!(schemes, ["linear", "last"]);

    // What is lost is done again, and comes out the same.
    let known = trial(1);
    std::fs::remove_file(desk.path("found/001.json")).unwrap();
    std::fs::remove_dir_all(desk.path("found/trials/001")).unwrap();
    assert!(search("2", &[]).status.success());
    assert_eq!(trial(1), known);
    let said = refused(&search("2", &["--seed", "7"]));
    assert!(said.contains("000.json") && said.contains("seed"), "{said}");
    std::fs::write(desk.path("recipe.yaml"), recipe("placing", 0)).unwrap();
    let said = refused(&search("1", &[]));
    assert!(said.contains("validation.episodes is 0"), "{said}");
    std::fs::write(desk.path("recipe.yaml"), recipe("placing_stacking", 1)).unwrap();
    let said = refused(&search("1", &[]));
    assert!(said.contains("2 task modules"), "{said}");
}

#[test]
fn an_embedding_is_trained_and_measured_beside_image_distance() {
    let desk = Desk::new("embed");
    let text = "problems: [placing]\ndemonstrations: 1\nnetwork: {channels: [4, 4, 4, 4]}\ntraining: {steps: 2, batch: 1}\n";
    std::fs::write(desk.path("embed.yaml"), text).unwrap();
    let embedded = desk.sctn(
        None,
        &[
            "embed",
            "--recipe",
            "embed.yaml",
            "--out",
            "embedding.safetensors",
        ],
    );
    assert!(embedded.status.success(), "{}", said(&embedded));
    let goals = |checkpoint: &str| {
        Command::new(env!("CARGO_BIN_EXE_sctn"))
            .current_dir(desk.folder.path())
            .args(["--root", ROOT, "goals", "--problem", "placing", "--json"])
            .args(["--episodes", "1", "--seed", "10000"])
            .args(["--embedding", checkpoint])
            .output()
            .unwrap()
    };
    let measured = goals("embedding.safetensors");
    assert!(measured.status.success(), "{}", said(&measured));
    let report: serde_json::Value = serde_json::from_slice(&measured.stdout).unwrap();
    // What is seen is what was shown: at a distance of nothing, whatever the network.
    let shown = &report["demonstrator"];
    assert_eq!(shown["steps"], 9);
    assert_eq!(shown["image_distance"], 9);
    assert_eq!(shown["embedding"], 9);
    assert_eq!(report["policy"]["episodes"], 1);
    let policy = format!("{ROOT}/config/checkpoints/placing.safetensors");
    let said = refused(&goals(&policy));
    assert!(
        said.contains("placing.safetensors") && said.contains("gctn-embedding"),
        "{said}"
    );
}
