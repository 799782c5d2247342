//! `sctn reliability`.

use anyhow::{Context, Result, bail};
use clap::Args;
use gctn::Calibration;
use learning::{SaidStep, reliability};
use serde::Deserialize;
use std::path::PathBuf;

/// Arguments of `sctn reliability`.
#[derive(Args)]
pub struct ReliabilityCommand {
    /// Reports that `sctn evaluate --out` wrote
    #[arg(long, required = true, num_args = 1..)]
    reports: Vec<PathBuf>,
    /// Fit the probability of success to these reports and write a copy of this checkpoint that says it
    #[arg(long, requires = "out")]
    fit: Option<PathBuf>,
    /// File for that copy
    #[arg(long, requires = "fit")]
    out: Option<PathBuf>,
    /// Print a JSON object
    #[arg(long)]
    json: bool,
}

/// What this needs of a report.
#[derive(Deserialize)]
struct Report {
    reports: Vec<Episode>,
}

#[derive(Deserialize)]
struct Episode {
    said: Vec<SaidStep>,
}

impl ReliabilityCommand {
    pub fn run(self) -> Result<()> {
        let mut steps: Vec<SaidStep> = Vec::new();
        for path in &self.reports {
            let name = || path.display().to_string();
            let text = std::fs::read_to_string(path).with_context(name)?;
            let report: Report = serde_json::from_str(&text)
                .with_context(|| format!("{}: expected a report of sctn evaluate --out", name()))?;
            steps.extend(report.reports.into_iter().flat_map(|episode| episode.said));
        }
        if steps.is_empty() {
            bail!("--reports: no step of a policy in them");
        }
        if let (Some(checkpoint), Some(out)) = (&self.fit, &self.out) {
            let outcomes: Vec<_> = steps
                .iter()
                .map(|step| (step.said.evidence, step.earned))
                .collect();
            let calibration = Calibration::fit(&outcomes)?;
            gctn::calibrate(checkpoint, out, &calibration)?;
            for step in &mut steps {
                step.said.success = Some(calibration.probability(&step.said.evidence));
            }
            println!("{}: fitted on {} steps", out.display(), calibration.steps);
        }
        let found = reliability(&steps);
        if self.json {
            println!("{}", serde_json::to_string(&found)?);
            return Ok(());
        }
        println!("said      steps   mean said   earned");
        for bin in &found.curve {
            println!(
                "{:.1} to {:.1} {:>6} {:>9.1} % {:>6.1} %",
                bin.from,
                bin.from + 0.1,
                bin.steps,
                100.0 * bin.said,
                100.0 * bin.earned
            );
        }
        println!(
            "{} steps, {:.1} % earned; Brier {:.4}, calibration error {:.4}",
            found.steps,
            100.0 * found.earned,
            found.brier,
            found.calibration_error
        );
        if let Some(unasked) = found.unasked {
            println!(
                "asked below {:.3}: {:.1} % of the steps need nobody, {:.2} % of those earn nothing",
                unasked.threshold,
                100.0 * unasked.share,
                100.0 * unasked.failed
            );
        }
        if found.done_judged > 0 {
            println!(
                "done or not: right in {:.1} % of {} judgements",
                100.0 * found.done_right,
                found.done_judged
            );
        }
        Ok(())
    }
}
