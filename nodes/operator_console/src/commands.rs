//! What the operator has decided, carried out in the graph.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use bags::Demonstration;
use console::{Command, Console, Page, PolicyState};
use heightmap::Heightmap;
use msgs::convert;
use msgs::sctn_msgs::{
    LoadCheckpoint, LoadCheckpointRequest, LoadDemonstration, LoadDemonstrationRequest,
    OperatorPresence, PickPlace, ProposeHome, ProposeHomeRequest, SetStep, SetStepRequest,
    StepConfirmation,
};
use node_kit::{CallOptions, Node, Publisher, Qos, ServiceClient};
use step_protocol::{Confirmation, Proposal, ProposalId};
use tracing::{error, info, warn};

use crate::{OperatorConsoleParameters, PRESENCE_PERIOD};

const CHOOSE_ANOTHER: &str =
    "Choose another demonstration, or look whether the goal oracle is at work.";
/// How long the plan of the way home may take.
const HOME_TIMEOUT: CallOptions = CallOptions {
    attempts: 1,
    timeout: Duration::from_secs(60),
};

/// Publishers and service clients.
pub struct Commands {
    page: Page,
    confirmations: Publisher<StepConfirmation>,
    proposals: Publisher<PickPlace>,
    presence: Publisher<OperatorPresence>,
    home: Arc<ServiceClient<ProposeHome>>,
    set_step: Arc<ServiceClient<SetStep>>,
    load: Arc<ServiceClient<LoadDemonstration>>,
    load_checkpoint: Arc<ServiceClient<LoadCheckpoint>>,
}

impl Commands {
    pub fn new(
        node: &Node,
        parameters: &OperatorConsoleParameters,
        page: Page,
    ) -> anyhow::Result<Self> {
        let OperatorConsoleParameters {
            executor,
            goal_oracle,
            policy,
            ..
        } = parameters;
        Ok(Self {
            page,
            confirmations: node.publisher("step_confirmation", Qos::Event)?,
            proposals: node.publisher("pick_place", Qos::Latched)?,
            presence: node.publisher("operator_presence", Qos::Event)?,
            home: Arc::new(node.service_client(&format!("{executor}/propose_home"))?),
            set_step: Arc::new(node.service_client(&format!("{goal_oracle}/set_step"))?),
            load: Arc::new(node.service_client(&format!("{goal_oracle}/load_demonstration"))?),
            load_checkpoint: Arc::new(node.service_client(&format!("{policy}/load_checkpoint"))?),
        })
    }

    fn console(&self) -> Arc<Console> {
        Arc::clone(&self.page.console)
    }

    /// Says whether the operator is present.
    pub fn publish_presence(&self, node: &Node) {
        let mut message = self.page.console.read(|state, now| {
            let (name, is_present) = state.sessions.presence(now).unwrap_or(("", false));
            OperatorPresence {
                operator_name: name.to_owned(),
                is_present,
                ..OperatorPresence::default()
            }
        });
        message.header.stamp = node.now();
        self.presence.publish(message);
    }

    pub fn carry_out(&self, node: &Node, command: Command) {
        match command {
            Command::Confirm(confirmation) => self.confirm(node, &confirmation),
            Command::Presence => self.publish_presence(node),
            Command::Propose(proposal) => self.propose(&proposal),
            Command::Home(name) => self.ask_for_home(node, &name),
            Command::SetStep(step, name) => self.set_step(node, step, &name),
            Command::Load(demonstration, path, name) => {
                self.load(node, demonstration, path, &name);
            }
            Command::LoadCheckpoint(path, name) => self.load_checkpoint(node, path, &name),
            Command::Record(event) => {
                let libraries = Arc::clone(&self.page.libraries);
                self.write(node, "how a run went", move || {
                    let added = libraries.history.add(event);
                    added.map_err(|error| error.to_string())
                });
            }
            Command::Keep(correction) => {
                let libraries = Arc::clone(&self.page.libraries);
                let (name, demonstration) = *correction;
                info!("correction {name}");
                self.write(node, "a correction", move || {
                    let saved = libraries.corrections.save(&name, &demonstration);
                    saved.map_err(|refusal| refusal.reason)
                });
            }
        }
    }

    fn confirm(&self, node: &Node, confirmation: &Confirmation) {
        let Confirmation {
            proposal_id,
            decision,
            operator_name,
            ..
        } = confirmation;
        info!(
            "`{operator_name}`: decision {} on proposal {proposal_id}",
            decision.name()
        );
        self.publish_presence(node);
        match convert::confirmation_to_msg(confirmation) {
            Ok(mut message) => {
                message.header.stamp = node.now();
                self.confirmations.publish(message);
            }
            Err(error) => error!("the decision on proposal {proposal_id} cannot be sent: {error}"),
        }
    }

    fn propose(&self, proposal: &Proposal) {
        let id = proposal.id;
        info!("an operator's proposal {id}");
        match convert::proposal_to_msg(proposal) {
            Ok(message) => self.proposals.publish(message),
            Err(error) => error!("the operator's proposal {id} cannot be sent: {error}"),
        }
    }

    fn ask_for_home(&self, node: &Node, name: &str) {
        info!("`{name}` asks for the way home");
        self.publish_presence(node);
        let (client, console) = (Arc::clone(&self.home), self.console());
        node.spawn(async move {
            // The executor has to hear that the operator is present before the call, also where they have just taken control.
            tokio::time::sleep(PRESENCE_PERIOD).await;
            let request = ProposeHomeRequest::default();
            let reason = match client.call(&request, &HOME_TIMEOUT).await {
                Ok(answer) if answer.success => {
                    let (id, asks) = (ProposalId(answer.proposal_id), answer.needs_approval);
                    return console.change(|state, _| state.on_home(id, asks));
                }
                Ok(answer) => answer.message,
                Err(error) => error.to_string(),
            };
            let advice = console::advice(&reason);
            let text = format!("There is no way home: {reason}");
            console.change(|state, now| state.run.note("refusal", text, advice, now));
        });
    }

    fn set_step(&self, node: &Node, step: u32, name: &str) {
        info!("`{name}`: continue with step {step}");
        let (client, console) = (Arc::clone(&self.set_step), self.console());
        let request = SetStepRequest {
            request_id: console::secret(),
            step,
        };
        node.spawn(async move {
            let reason = match client.call(&request, &CallOptions::default()).await {
                Ok(answer) if answer.success => return,
                Ok(answer) => answer.message,
                Err(error) => error.to_string(),
            };
            let reason = format!("The run did not continue: {reason}");
            let advice = "Look whether the goal oracle is at work.";
            console.change(|state, now| state.run.note("refusal", reason, advice, now));
        });
    }

    fn load(&self, node: &Node, demonstration: String, path: PathBuf, name: &str) {
        info!("`{name}`: repeat {}", path.display());
        let (client, console) = (Arc::clone(&self.load), self.console());
        let request = LoadDemonstrationRequest {
            request_id: console::secret(),
            path: path.display().to_string(),
        };
        let shown = node.clone();
        node.spawn(async move {
            let goals = show_demonstration(&shown, &console, path).await;
            let refused = match client.call(&request, &CallOptions::default()).await {
                Ok(answer) if answer.success => {
                    let reason = format!("The run repeats {}.", answer.message);
                    return console.change(|state, now| {
                        if let Some(goals) = goals {
                            state.on_loaded(demonstration, goals);
                        }
                        state.run.note("note", reason, "", now);
                    });
                }
                Ok(answer) => answer.message,
                Err(error) => error.to_string(),
            };
            let reason = format!("The demonstration was not loaded: {refused}");
            console.change(|state, now| state.run.note("refusal", reason, CHOOSE_ANOTHER, now));
        });
    }

    fn load_checkpoint(&self, node: &Node, path: PathBuf, name: &str) {
        info!("`{name}`: checkpoint {}", path.display());
        let client = Arc::clone(&self.load_checkpoint);
        let (trainings, console) = (Arc::clone(&self.page.trainings), self.console());
        let request = LoadCheckpointRequest {
            request_id: console::secret(),
            path: path.display().to_string(),
        };
        node.spawn(async move {
            let refused = match client.call(&request, &CallOptions::default()).await {
                Ok(answer) if answer.success => {
                    let shown = path.file_stem().unwrap_or_default().to_string_lossy();
                    let reason = format!("The policy uses {shown} from its next proposal on.");
                    trainings.begin_with(&answer.path);
                    return console.change(|state, now| {
                        state.run.note("note", reason, "", now);
                        state.policy = Some(PolicyState {
                            checkpoint: answer.path,
                            previous: answer.previous,
                        });
                    });
                }
                Ok(answer) => answer.message,
                Err(error) => error.to_string(),
            };
            let reason = format!("The policy has kept its checkpoint: {refused}.");
            let advice = "Choose another checkpoint, or look whether the policy is at work.";
            console.change(|state, now| state.run.note("refusal", reason, advice, now));
        });
    }

    /// Writes something of the library on a thread of its own; viewers are told.
    fn write(
        &self,
        node: &Node,
        what: &'static str,
        write: impl FnOnce() -> Result<(), String> + Send + 'static,
    ) {
        let console = self.console();
        node.spawn_blocking(move || match write() {
            Ok(()) => console.change(|state, _| state.library_changed()),
            Err(error) => {
                warn!("{what} was not kept: {error}");
                let reason =
                    format!("What was learned from the run was not kept ({what}): {error}");
                let advice = "Look at the parameter library and at the disk.";
                console.change(|state, now| state.run.note("fault", reason, advice, now));
            }
        });
    }
}

/// Name and goal images of a demonstration.
fn read_demonstration(path: &Path) -> anyhow::Result<(String, Vec<Heightmap>)> {
    let demonstration = Demonstration::read(path)?;
    let images = demonstration.goals().into_iter().cloned().collect();
    Ok((demonstration.name(), images))
}

/// Shows the images of a demonstration before they are latched. Returns its name in the goals; nothing where it cannot be read.
pub async fn show_demonstration(node: &Node, console: &Console, path: PathBuf) -> Option<String> {
    let reading = path.clone();
    let read = node.spawn_blocking(move || read_demonstration(&reading));
    match read.await.context("reading panicked").flatten() {
        Ok((name, images)) => {
            let shown = name.clone();
            console.change(|state, now| state.run.on_demonstration(shown, images, now));
            Some(name)
        }
        Err(error) => {
            warn!("demonstration {}: {error:#}", path.display());
            None
        }
    }
}
