//! Runs of a sweep as jobs of a cluster.

use anyhow::{Context, Result, ensure};
use clap::ValueEnum;
use serde_json::json;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

/// What carries out the runs of a sweep.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Engine {
    /// This process, one run after the other
    #[default]
    Local,
    /// Ray: the cluster that RAY_ADDRESS names, or this host. A run whose worker is lost goes on on another one
    Ray,
    /// Slurm: an array job; sbatch reads partition, account and limits from its variables SBATCH_*
    Slurm,
}

/// The program that makes a task of each job. It reads the jobs as JSON from its first argument.
const RAY: &str = include_str!("ray_jobs.py");

/// Jobs that are alike.
pub struct Jobs {
    /// The program and its arguments, but for the last one.
    pub command: Vec<String>,
    /// A name and the last argument of each job.
    pub parts: Vec<(String, String)>,
    /// Cores of each.
    pub cores: usize,
    /// GPUs of each.
    pub gpus: f64,
    /// Folder for the output of Slurm's jobs.
    pub logs: PathBuf,
}

impl Jobs {
    /// Waits until every job has ended. What a job did not achieve is for the caller to find out: it has said why in its own output.
    pub fn carry_out(&self, engine: Engine, python: &Path) -> Result<()> {
        let (mut command, missing) = match engine {
            _ if self.parts.is_empty() => return Ok(()),
            Engine::Local => return Ok(()),
            Engine::Ray => (
                self.ray(python),
                "expected a Python with the package ray; --python names one",
            ),
            Engine::Slurm => (
                self.slurm()?,
                "expected Slurm's commands on this host, from which its jobs are submitted",
            ),
        };
        let program = command.get_program().to_owned();
        let ended = command
            .status()
            .with_context(|| format!("{}: {missing}", program.display()))?;
        if !ended.success() {
            tracing::warn!("{}: {ended}", program.display());
        }
        Ok(())
    }

    fn ray(&self, python: &Path) -> Command {
        let parts: BTreeMap<_, _> = self.parts.iter().cloned().collect();
        let jobs = json!({
            "command": self.command, "parts": parts, "cores": self.cores, "gpus": self.gpus,
        });
        let mut command = Command::new(python);
        command.args(["-c", RAY, &jobs.to_string()]);
        command
    }

    fn slurm(&self) -> Result<Command> {
        ensure!(
            self.gpus >= 0.0 && self.gpus.fract() == 0.0,
            "--gpus {}: expected a whole number for --engine slurm",
            self.gpus
        );
        std::fs::create_dir_all(&self.logs).with_context(|| self.logs.display().to_string())?;
        let parts = self.parts.iter().map(|(_, part)| part.as_str());
        let parts = parts.collect::<Vec<_>>().join(" ");
        let program = self.command.iter().map(|word| quoted(word));
        let program = program.collect::<Vec<_>>().join(" ");
        let mut command = Command::new("sbatch");
        command
            .args(["--wait", "--requeue", "--job-name=sctn-sweep"])
            .arg(format!("--array=0-{}", self.parts.len() - 1))
            .arg(format!("--cpus-per-task={}", self.cores))
            .arg(format!("--output={}/%A_%a.log", self.logs.display()));
        if self.gpus > 0.0 {
            command.arg(format!("--gres=gpu:{}", self.gpus));
        }
        // The job's number in the array chooses its part.
        command.arg(format!(
            "--wrap=set -- {parts}; shift \"$SLURM_ARRAY_TASK_ID\"; exec {program} \"$1\""
        ));
        Ok(command)
    }
}

/// One word for a shell.
fn quoted(word: &str) -> String {
    format!("'{}'", word.replace('\'', r"'\''"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_job_of_slurm_takes_the_part_of_its_number() {
        let folder = tempfile::tempdir().unwrap();
        let part = |index: usize| (format!("run{index}"), format!("{index}/9"));
        let jobs = Jobs {
            command: vec!["echo".into(), "it's all".into()],
            parts: vec![part(2), part(5)],
            cores: 1,
            gpus: 0.0,
            logs: folder.path().join("slurm"),
        };
        let command = jobs.slurm().unwrap();
        let last = command.get_args().last().unwrap().to_str().unwrap();
        let script = last.strip_prefix("--wrap=").unwrap();
        let job = Command::new("sh")
            .args(["-c", script])
            .env("SLURM_ARRAY_TASK_ID", "1")
            .output()
            .unwrap();
        assert_eq!(job.stdout, b"it's all 5/9\n");
        let fraction = Jobs { gpus: 0.5, ..jobs };
        let error = fraction.slurm().unwrap_err().to_string();
        assert!(
            error.contains("--gpus 0.5: expected a whole number"),
            "{error}"
        );
    }
}
