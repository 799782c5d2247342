//! `sctn health`.

use crate::progress;
use crate::root::Root;
use anyhow::{Result, bail};
use clap::{Args, ValueEnum};
use learning::wilson_95;
use multiravens::Environment;
use multiravens::health::{BaselinePolicy, Checkup, Extremes, check_up};
use serde::Serialize;
use std::collections::BTreeMap;

/// Arguments of `sctn health`.
#[derive(Args)]
pub struct Health {
    /// Problem
    #[arg(long)]
    problem: String,
    /// Episodes; the policies take turns
    #[arg(long, default_value_t = 500)]
    episodes: u64,
    /// Seed of the first episode; the next ones are seed + 1, seed + 2, ...
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Policies
    #[arg(long, value_enum, value_delimiter = ',', default_values_t = [Policy::Pixels, Policy::Bodies, Policy::Demonstrator])]
    policy: Vec<Policy>,
    /// Print a JSON object last
    #[arg(long)]
    json: bool,
}

/// Who acts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Policy {
    /// Random pixels
    Pixels,
    /// A random body to a random pixel
    Bodies,
    /// The demonstrator's first action, again and again
    Repeat,
    /// The cable's end straight to its goal
    Drag,
    /// The demonstrator
    Demonstrator,
}

impl Policy {
    fn blind(self) -> Option<BaselinePolicy> {
        match self {
            Self::Pixels => Some(BaselinePolicy::Pixels),
            Self::Bodies => Some(BaselinePolicy::Bodies),
            Self::Repeat => Some(BaselinePolicy::Repeat),
            Self::Drag => Some(BaselinePolicy::Drag),
            Self::Demonstrator => None,
        }
    }

    fn name(self) -> String {
        let value = self.to_possible_value();
        value.map(|v| v.get_name().to_owned()).unwrap_or_default()
    }
}

/// A policy that knows nothing completes less than this share of its episodes.
const ACCIDENTS: f64 = 0.02;

#[derive(Serialize)]
struct Report {
    problem: String,
    episodes: u64,
    joint_error_m: Distribution,
    depth_in_peg_m: Distribution,
    depth_in_table_m: Distribution,
    speed_m_s: Distribution,
    /// Episodes in which a body did not come to rest.
    restless: u64,
    /// Episodes in which a number was not finite.
    not_finite: u64,
    /// Episodes that ended with a step that the primitive could not carry out.
    failed: u64,
    policies: BTreeMap<String, Completion>,
    /// What exceeds its bar; empty when all is well.
    broken: Vec<String>,
}

/// Of the worst values of all episodes.
#[derive(Serialize)]
struct Distribution {
    median: f64,
    p90: f64,
    p99: f64,
    max: f64,
    bar: f64,
}

impl Distribution {
    fn new(checkups: &[(Policy, Checkup)], value: fn(&Extremes) -> f64) -> Self {
        let mut values: Vec<_> = checkups.iter().map(|(_, c)| value(&c.extremes)).collect();
        values.sort_by(f64::total_cmp);
        let at = |share: f64| {
            let index = (share * values.len() as f64).ceil() as usize;
            values[index.clamp(1, values.len()) - 1]
        };
        Self {
            median: at(0.5),
            p90: at(0.9),
            p99: at(0.99),
            max: at(1.0),
            bar: value(&Extremes::LIMITS),
        }
    }
}

#[derive(Serialize)]
struct Completion {
    episodes: usize,
    completion: f64,
    interval_95: [f64; 2],
    reward: f64,
}

impl Health {
    pub fn run(self, root: &Root) -> Result<()> {
        if self.episodes == 0 || self.policy.is_empty() {
            bail!("--episodes and --policy: expected at least one");
        }
        let problem = root.problem(&self.problem)?;
        if self.policy.contains(&Policy::Drag)
            && problem.modules().iter().any(|m| m.name != "routing")
        {
            bail!("--policy drag: only the problem routing ends in a drag to the goal");
        }
        let mut environment = Environment::new(&problem, &root.work_cell()?);
        let bar = progress::bar(self.episodes, "episodes");
        let mut checkups = Vec::new();
        for index in 0..self.episodes {
            let policy = self.policy[index as usize % self.policy.len()];
            let checkup = check_up(&mut environment, self.seed + index, policy.blind())?;
            checkups.push((policy, checkup));
            bar.inc(1);
        }
        bar.finish_and_clear();
        let report = Report::new(self.problem, &self.policy, &checkups);
        if self.json {
            println!("{}", serde_json::to_string(&report)?);
        } else {
            report.print();
        }
        if !report.broken.is_empty() {
            bail!("{}: {}", report.problem, report.broken.join("; "));
        }
        Ok(())
    }
}

impl Report {
    fn new(problem: String, policies: &[Policy], checkups: &[(Policy, Checkup)]) -> Self {
        let count = |is: fn(&Checkup) -> bool| {
            let episodes = checkups.iter().filter(|(_, checkup)| is(checkup));
            episodes.count() as u64
        };
        let policies = policies.iter().map(|policy| {
            let of = checkups.iter().filter(|(who, _)| who == policy);
            let of: Vec<_> = of.map(|(_, checkup)| checkup).collect();
            let complete = of.iter().filter(|checkup| checkup.complete).count();
            let reward: f64 = of.iter().map(|checkup| checkup.total_reward).sum();
            let episodes = of.len().max(1) as f64;
            let completion = Completion {
                episodes: of.len(),
                completion: complete as f64 / episodes,
                interval_95: wilson_95(complete, of.len()),
                reward: reward / episodes,
            };
            (policy.name(), completion)
        });
        let mut report = Self {
            problem,
            episodes: checkups.len() as u64,
            joint_error_m: Distribution::new(checkups, |e| e.joint_error_m),
            depth_in_peg_m: Distribution::new(checkups, |e| e.depth_in_peg_m),
            depth_in_table_m: Distribution::new(checkups, |e| e.depth_in_table_m),
            speed_m_s: Distribution::new(checkups, |e| e.speed_m_s),
            restless: count(|checkup| !checkup.settled),
            not_finite: count(|checkup| !checkup.finite),
            failed: count(|checkup| checkup.failed_steps > 0),
            policies: policies.collect(),
            broken: Vec::new(),
        };
        let mut broken = Vec::new();
        for (name, distribution) in report.distributions() {
            let Distribution { max, bar, .. } = distribution;
            // Not "above": NaN breaks the bar, too.
            let holds = max <= bar;
            if !holds {
                broken.push(format!("{name} is {max:.4}, expected at most {bar}"));
            }
        }
        for (episodes, what) in [
            (report.restless, "do not come to rest"),
            (report.not_finite, "leave the finite numbers"),
            (report.failed, "end with a step that cannot be carried out"),
        ] {
            if episodes > 0 {
                broken.push(format!("{episodes} episodes {what}"));
            }
        }
        for (name, completion) in &report.policies {
            let share = completion.completion;
            if *name != Policy::Demonstrator.name() && share >= ACCIDENTS {
                broken.push(format!(
                    "the policy {name} completes {share}, expected less than {ACCIDENTS}"
                ));
            }
        }
        report.broken = broken;
        report
    }

    fn distributions(&self) -> [(&'static str, &Distribution); 4] {
        [
            ("joint_error_m", &self.joint_error_m),
            ("depth_in_peg_m", &self.depth_in_peg_m),
            ("depth_in_table_m", &self.depth_in_table_m),
            ("speed_m_s", &self.speed_m_s),
        ]
    }

    fn print(&self) {
        println!(
            "{}, {} episodes, the worst of each:",
            self.problem, self.episodes
        );
        println!(
            "{:18} {:>9} {:>9} {:>9} {:>9} {:>9}",
            "", "median", "90 %", "99 %", "max", "bar"
        );
        for (name, d) in self.distributions() {
            println!(
                "{name:18} {:>9.5} {:>9.5} {:>9.5} {:>9.5} {:>9}",
                d.median, d.p90, d.p99, d.max, d.bar
            );
        }
        println!(
            "restless {}, not finite {}, ended by a failed step {}",
            self.restless, self.not_finite, self.failed
        );
        for (name, c) in &self.policies {
            println!(
                "{name:18} {} episodes, {:.1} % complete ({:.1} to {:.1}), reward {:.3}",
                c.episodes,
                100.0 * c.completion,
                100.0 * c.interval_95[0],
                100.0 * c.interval_95[1],
                c.reward
            );
        }
    }
}
