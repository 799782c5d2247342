//! `sctn demos` as a program: what it keeps when it is stopped half-way, on any number of threads.

use bags::Demonstration;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/..");

/// Runs `sctn demos` of *stacking* on so many threads, files being at most so many blocks of 512
/// bytes or 1 KiB long.
fn demos(out: &Path, threads: u32, episodes: u32, most_blocks: Option<u32>) -> Output {
    // Ignored, a file that grows too long is a write that fails, as on a full disk.
    let limit = most_blocks.map_or(String::new(), |n| format!("trap '' XFSZ; ulimit -f {n};"));
    Command::new("sh")
        .args(["-c", &format!("{limit} exec \"$@\""), "sh"])
        .args([env!("CARGO_BIN_EXE_sctn"), "--root", ROOT, "demos"])
        .args(["--problem", "stacking", "--seed", "20", "--json"])
        .args(["--threads", &threads.to_string()])
        .args(["--episodes", &episodes.to_string()])
        .arg("--out")
        .arg(out)
        .output()
        .unwrap()
}

/// The files of all bags.
fn files(out: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut files = BTreeMap::new();
    for bag in std::fs::read_dir(out.join("stacking")).unwrap() {
        for file in std::fs::read_dir(bag.unwrap().path()).unwrap() {
            let path = file.unwrap().path();
            let bytes = std::fs::read(&path).unwrap();
            files.insert(path.strip_prefix(out).unwrap().to_owned(), bytes);
        }
    }
    files
}

#[test]
fn a_full_disk_is_told_and_loses_no_finished_episode() {
    let folder = tempfile::tempdir().unwrap();
    let (out, whole) = (folder.path().join("out"), folder.path().join("whole"));
    assert!(demos(&whole, 2, 3, None).status.success());
    assert!(demos(&out, 1, 2, None).status.success());
    let finished = files(&out);
    let full = demos(&out, 1, 3, Some(8));
    let said = String::from_utf8_lossy(&full.stderr);
    assert!(!full.status.success());
    // Which file, and why.
    assert!(
        said.contains("stacking/000024") && said.contains("disk is full"),
        "{said}"
    );
    for (path, bytes) in &finished {
        assert_eq!(&std::fs::read(out.join(path)).unwrap(), bytes, "{path:?}");
    }
    for seed in [20, 22] {
        let bag = out.join(format!("stacking/{seed:06}"));
        assert_eq!(Demonstration::read(&bag).unwrap().steps.len(), 6);
    }
    let steps = 2 * 6;
    let bytes: usize = finished.values().map(Vec::len).sum();
    assert!(bytes <= steps * 120_000, "{bytes}");
    // What has been left half-written is no finished episode: it is made anew, with the same bytes.
    let again = demos(&out, 1, 3, None);
    assert!(again.status.success());
    let report = String::from_utf8_lossy(&again.stdout);
    assert!(report.contains("\"success\":1.0"), "{report}");
    assert_eq!(files(&out), files(&whole));
}

#[test]
fn an_episode_half_written_when_a_run_was_killed_is_made_anew() {
    let folder = tempfile::tempdir().unwrap();
    let (out, whole) = (folder.path().join("out"), folder.path().join("whole"));
    assert!(demos(&whole, 2, 2, None).status.success());
    assert!(demos(&out, 1, 2, None).status.success());
    // A run that is killed leaves a bag without its name, its last bytes and its metadata.
    let partial = out.join("stacking/000022.partial");
    std::fs::rename(out.join("stacking/000022"), &partial).unwrap();
    let mcap = partial.join("000022_0.mcap");
    let bytes = std::fs::read(&mcap).unwrap();
    std::fs::write(&mcap, &bytes[..bytes.len() / 2]).unwrap();
    std::fs::remove_file(partial.join("metadata.yaml")).unwrap();
    let again = demos(&out, 1, 2, None);
    assert!(again.status.success());
    assert!(!partial.exists());
    assert_eq!(files(&out), files(&whole));
}

#[test]
fn an_unknown_problem_is_told_with_those_that_there_are() {
    let output = Command::new(env!("CARGO_BIN_EXE_sctn"))
        .args(["--root", ROOT, "demos", "--problem", "juggling"])
        .args(["--episodes", "1", "--seed", "0"])
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success());
    assert!(
        said.contains("juggling") && said.contains("placing_routing"),
        "{said}"
    );
}

/// A policy that is shown no image before its goal is no good at another start.
#[test]
fn a_demonstration_goes_on_from_the_mistakes_of_a_policy() {
    let folder = tempfile::tempdir().unwrap();
    let run = |starts: &str, out: &str, more: &[&str]| {
        Command::new(env!("CARGO_BIN_EXE_sctn"))
            .args(["--root", ROOT, "demos", "--problem", "stacking"])
            .args(["--seed", "20", "--episodes", "1", "--threads", "1"])
            .args(["--starts", starts])
            .args(more)
            .arg("--out")
            .arg(folder.path().join(out))
            .output()
            .unwrap()
    };
    let checkpoint = format!("{ROOT}/config/checkpoints/ten_problems.safetensors");
    let mistakes = ["--mistakes-of", &checkpoint];
    let refused = run("1", "mistakes", &mistakes);
    let said = String::from_utf8_lossy(&refused.stderr);
    assert!(!refused.status.success());
    assert!(said.contains("--starts of 2 or more"), "{said}");
    assert!(run("3", "mistakes", &mistakes).status.success());
    assert!(run("3", "clean", &[]).status.success());
    let [corrected, clean] = ["mistakes", "clean"].map(|out| {
        let bag = folder.path().join(out).join("stacking/000020_000024");
        Demonstration::read(&bag).unwrap()
    });
    // The policy's actions are no steps; what it has put in the way is put aside.
    assert_eq!(corrected.goals().len(), clean.goals().len());
    assert!(corrected.steps.len() < clean.steps.len() + 3);
    let [begin, start] = [&corrected, &clean].map(|shown| &shown.observation(0).height_m);
    assert_ne!(begin, start, "the policy was not there");
}
