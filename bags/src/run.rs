//! From a recorded run to a demonstration: the steps that an operator approved and confirmed.

use crate::demonstration::{HEIGHTMAP, PICK_PLACE};
use crate::{BagReader, Demonstration, DemonstrationError, DemonstrationStep, outcome_name};
use heightmap::Heightmap;
use msgs::Interface;
use msgs::builtin_interfaces::Time;
use msgs::convert;
use msgs::sctn_msgs::{self, Reward, StepConfirmation, StepResult};
use pick_place::Outcome;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::time::Duration;
use step_protocol::{ProposalStatus, StepOutcome};

/// A proposal of a run that is no step of its demonstration.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LeftOut {
    /// Step that it was made for, from 1.
    pub step: u32,
    /// Attempt at that step, from 0.
    pub attempt: u32,
    /// The proposal.
    pub proposal_id: u64,
    /// The reason.
    pub reason: String,
}

/// What was said of a proposal.
struct Attempt {
    proposal: sctn_msgs::PickPlace,
    decisions: BTreeSet<u8>,
    /// The result of its motion, else the last word of the executor.
    result: Option<StepResult>,
}

/// Whether the arm has moved for it. What a later version may add counts as a motion.
fn moved(result: &StepResult) -> bool {
    let status = ProposalStatus::from_repr(result.proposal_status);
    StepOutcome::from_repr(result.outcome).is_none_or(|outcome| outcome.arm_moved_for(status))
}

/// The moment of a stamp. Stamps of before the clock's zero count as its zero.
fn ns(stamp: &Time) -> u64 {
    u64::try_from(stamp.sec).unwrap_or(0) * 1_000_000_000 + u64::from(stamp.nanosec)
}

/// Whether the executor publishes there the proposals that came as goals of its action.
fn is_of_goals(topic: &str) -> bool {
    topic.rsplit('/').next() == Some("pick_place_goal")
}

/// The topics of a run that matter here.
struct Topics<'a> {
    heightmaps: &'a str,
    /// Those on a topic, and those that came as goals of the executor's action: one of both at least.
    proposals: Vec<&'a str>,
    confirmations: &'a str,
    results: &'a str,
    rewards: Option<&'a str>,
}

impl<'a> Topics<'a> {
    /// None if the bag is no recorded run: nobody confirmed anything in it.
    fn find(bag: &'a BagReader, path: &Path) -> Result<Option<Self>, DemonstrationError> {
        let names_of = |type_name: &str| -> Vec<&'a str> {
            let found = bag.topics().iter();
            let found =
                found.filter(|topic| topic.type_name == type_name && topic.message_count > 0);
            found.map(|topic| topic.name.as_str()).collect()
        };
        let refuse = |type_name, found| DemonstrationError::Topics {
            path: path.to_owned(),
            type_name,
            found,
        };
        let of_type = |type_name: &'static str| match names_of(type_name)[..] {
            [] => Ok(None),
            [name] => Ok(Some(name)),
            ref names => Err(refuse(type_name, names.join(", "))),
        };
        let Some(confirmations) = of_type(StepConfirmation::TYPE_NAME)? else {
            return Ok(None);
        };
        let needed =
            |type_name| of_type(type_name)?.ok_or_else(|| refuse(type_name, "none".to_owned()));
        let heightmaps = needed(sctn_msgs::Heightmap::TYPE_NAME)?;
        let proposals = names_of(sctn_msgs::PickPlace::TYPE_NAME);
        let goals = proposals.iter().filter(|name| is_of_goals(name)).count();
        let found = match (proposals.len(), goals) {
            (0, _) => Some("none".to_owned()),
            (all, goals) if goals > 1 || all - goals > 1 => Some(proposals.join(", ")),
            _ => None,
        };
        if let Some(found) = found {
            return Err(refuse(sctn_msgs::PickPlace::TYPE_NAME, found));
        }
        Ok(Some(Self {
            heightmaps,
            proposals,
            confirmations,
            results: needed(StepResult::TYPE_NAME)?,
            rewards: of_type(Reward::TYPE_NAME)?,
        }))
    }
}

impl Demonstration {
    /// Reads the bag of a recorded run as a demonstration, and says which proposals are no part of it. None if the bag
    /// is no recorded run.
    ///
    /// A proposal is a step if the arm carried it out as [`Outcome::Placed`], the operator said ADVANCE on it, and the
    /// bag holds the heightmap that it was made from and one of after its motion. What failed attempts in between have
    /// changed is part of the next step's observation. Its delta reward is the one that was measured after it, if
    /// that is positive; else the operator's word counts, and the reward is one share of as many as there are steps.
    pub fn read_run(path: &Path) -> Result<Option<(Self, Vec<LeftOut>)>, DemonstrationError> {
        let bag = BagReader::open(path)?;
        let Some(topics) = Topics::find(&bag, path)? else {
            return Ok(None);
        };
        let (order, attempts, rewards, seen) = gather(&bag, &topics)?;

        // When the arm moved, and from which observation: in the order of its motions.
        let mut motions: Vec<(u64, u64)> = attempts
            .values()
            .filter_map(|attempt| {
                let result = attempt.result.as_ref().filter(|result| moved(result))?;
                Some((ns(&result.header.stamp), ns(&attempt.proposal.header.stamp)))
            })
            .collect();
        motions.sort_unstable();
        let next_observation = |result_ns: u64| {
            let next = motions.iter().find(|(end, _)| *end > result_ns);
            next.map(|(_, observed)| *observed)
        };
        // What was seen after a motion: what the next one was decided from, else the first image of after it.
        let after = |result_ns: u64| {
            next_observation(result_ns)
                .filter(|observed| *observed >= result_ns && seen.contains(observed))
                .or_else(|| seen.range(result_ns..).next().copied())
        };

        let mut kept: Vec<(&Attempt, u64, u64)> = Vec::new();
        let mut left_out = Vec::new();
        for id in &order {
            let attempt = &attempts[id];
            let observed = ns(&attempt.proposal.header.stamp);
            let ended = attempt
                .result
                .as_ref()
                .map(|result| ns(&result.header.stamp));
            let reason = match reason_to_leave_out(attempt) {
                Some(reason) => reason,
                None if !seen.contains(&observed) => "its heightmap is not in the bag".to_owned(),
                None => match ended.and_then(after) {
                    Some(_) => {
                        kept.push((attempt, observed, ended.unwrap_or(0)));
                        continue;
                    }
                    None => "no heightmap shows what came of it".to_owned(),
                },
            };
            left_out.push(LeftOut {
                step: attempt.proposal.step,
                attempt: attempt.proposal.attempt,
                proposal_id: *id,
                reason,
            });
        }
        kept.sort_by_key(|(_, _, ended)| *ended);
        let Some((first, last)) = kept.first().zip(kept.last()) else {
            return Err(DemonstrationError::NoSteps {
                path: path.to_owned(),
                proposals: left_out.len(),
            });
        };
        let problem = first.0.proposal.problem.clone();
        if let Some((other, ..)) = kept
            .iter()
            .find(|(kept, ..)| kept.proposal.problem != problem)
        {
            return Err(DemonstrationError::Order {
                path: path.to_owned(),
                step: other.proposal.step as usize,
                actual: format!("the problem {}", other.proposal.problem),
                expected: "one problem in a run",
            });
        }
        let last = after(last.2).unwrap_or(last.1);
        let needed: BTreeSet<u64> = kept.iter().map(|kept| kept.1).chain([last]).collect();
        let heightmaps = heightmaps(&bag, &topics, path, &needed)?;
        let share = 1.0 / kept.len() as f64;
        let mut steps = Vec::with_capacity(kept.len());
        for (index, (attempt, observed, ended)) in kept.iter().enumerate() {
            let proposal = &attempt.proposal;
            let error = |source| DemonstrationError::Message {
                path: path.to_owned(),
                topic: PICK_PLACE,
                step: index + 1,
                source,
            };
            let until = next_observation(*ended).unwrap_or(u64::MAX);
            let measured = rewards
                .range(observed + 1..)
                .next()
                .filter(|(stamp, delta)| **stamp <= until && **delta > 0.0);
            steps.push(DemonstrationStep {
                observation: heightmaps[observed].clone(),
                action: convert::pick_place_from_msg(proposal).map_err(error)?,
                settings: convert::settings_from_msg(&proposal.settings).map_err(error)?,
                module: proposal.module.clone(),
                delta_reward: measured.map_or(share, |(_, delta)| *delta),
                outcome: Outcome::Placed,
            });
        }
        let seed = bag.notes().get("seed").and_then(|seed| seed.parse().ok());
        let seed = seed.unwrap_or(0);
        let demonstration = Self {
            problem,
            // Of a real cell there is none.
            seed,
            start_seed: seed,
            steps,
            last: heightmaps[&last].clone(),
        };
        Ok(Some((demonstration, left_out)))
    }
}

fn reason_to_leave_out(attempt: &Attempt) -> Option<String> {
    let said = |decision| attempt.decisions.contains(&decision);
    let Some(result) = &attempt.result else {
        return Some(if said(StepConfirmation::REJECT) {
            "the operator rejected it".to_owned()
        } else {
            "it was not carried out".to_owned()
        });
    };
    if result.outcome != StepResult::PLACED {
        Some(format!("it ended as: {}", outcome_name(result.outcome)))
    } else if said(StepConfirmation::ADVANCE) {
        None
    } else if said(StepConfirmation::RETRY) {
        Some("the operator said retry".to_owned())
    } else {
        Some("the operator did not confirm it".to_owned())
    }
}

type Gathered = (
    Vec<u64>,
    BTreeMap<u64, Attempt>,
    BTreeMap<u64, f64>,
    BTreeSet<u64>,
);

/// Proposals in their order with what was said of them, measured delta rewards by stamp, stamps of the heightmaps.
fn gather(bag: &BagReader, topics: &Topics<'_>) -> Result<Gathered, DemonstrationError> {
    let mut order = Vec::new();
    let mut attempts: BTreeMap<u64, Attempt> = BTreeMap::new();
    let mut said: BTreeMap<u64, BTreeSet<u8>> = BTreeMap::new();
    let mut results: BTreeMap<u64, StepResult> = BTreeMap::new();
    let mut rewards = BTreeMap::new();
    let mut seen = BTreeSet::new();
    let names = [topics.heightmaps, topics.confirmations, topics.results];
    let names = names.into_iter().chain(topics.rewards);
    let names: Vec<&str> = names.chain(topics.proposals.iter().copied()).collect();
    for message in bag.messages_between(&names, Duration::ZERO, Duration::MAX) {
        let message = message?;
        let name = message.topic.name.as_str();
        if name == topics.heightmaps {
            let heightmap: sctn_msgs::Heightmap = message.decode()?;
            seen.insert(ns(&heightmap.header.stamp));
        } else if topics.proposals.contains(&name) {
            let proposal: sctn_msgs::PickPlace = message.decode()?;
            let id = proposal.id;
            attempts.entry(id).or_insert_with(|| {
                order.push(id);
                Attempt {
                    proposal,
                    decisions: BTreeSet::new(),
                    result: None,
                }
            });
        } else if name == topics.confirmations {
            let confirmation: StepConfirmation = message.decode()?;
            let decisions = said.entry(confirmation.proposal_id).or_default();
            decisions.insert(confirmation.decision);
        } else if name == topics.results {
            let result: StepResult = message.decode()?;
            let known = results
                .entry(result.proposal_id)
                .or_insert_with(|| result.clone());
            // A refusal after the motion, of a second approval for instance, does not undo it.
            if !moved(known) {
                *known = result;
            }
        } else {
            let reward: Reward = message.decode()?;
            if reward.delta.is_finite() {
                rewards.insert(ns(&reward.header.stamp), reward.delta);
            }
        }
    }
    for (id, attempt) in &mut attempts {
        attempt.decisions = said.remove(id).unwrap_or_default();
        attempt.result = results.remove(id);
    }
    Ok((order, attempts, rewards, seen))
}

/// The heightmaps with these stamps.
fn heightmaps(
    bag: &BagReader,
    topics: &Topics<'_>,
    path: &Path,
    needed: &BTreeSet<u64>,
) -> Result<BTreeMap<u64, Heightmap>, DemonstrationError> {
    let mut found = BTreeMap::new();
    for message in bag.messages_between(&[topics.heightmaps], Duration::ZERO, Duration::MAX) {
        let heightmap: sctn_msgs::Heightmap = message?.decode()?;
        let stamp = ns(&heightmap.header.stamp);
        if needed.contains(&stamp) && !found.contains_key(&stamp) {
            let converted = convert::heightmap_from_msg(heightmap);
            let converted = converted.map_err(|source| DemonstrationError::Message {
                path: path.to_owned(),
                topic: HEIGHTMAP,
                step: found.len() + 1,
                source,
            })?;
            found.insert(stamp, converted);
        }
    }
    Ok(found)
}
