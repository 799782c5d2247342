//! What the operator has decided, carried out in the graph.

use std::path::PathBuf;
use std::sync::Arc;

use console::{Answer, Command, Page, PolicyState};
use msgs::sctn_msgs::{
    LoadCheckpoint, LoadCheckpointRequest, LoadCheckpointResponse, LoadDemonstration,
    LoadDemonstrationRequest, LoadDemonstrationResponse, OperatorPresence, PickPlace, ProposeHome,
    ProposeHomeRequest, ProposeHomeResponse, SetStep, SetStepRequest, SetStepResponse,
    StepConfirmation,
};
use msgs::{Service, convert};
use node_kit::{CallOptions, Node, Publisher, Qos, ServiceClient};
use step_protocol::{
    Confirmation, PRESENCE_PERIOD, Proposal, ProposalId, RECOVERY_TIMEOUT, Recovery,
};
use tracing::{error, info};

use crate::OperatorConsoleParameters;

/// Publishers and service clients.
pub struct Commands {
    page: Page,
    confirmations: Publisher<StepConfirmation>,
    proposals: Publisher<PickPlace>,
    presence: Publisher<OperatorPresence>,
    home: Arc<ServiceClient<ProposeHome>>,
    put_down: Arc<ServiceClient<ProposeHome>>,
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
            put_down: Arc::new(node.service_client(&format!("{executor}/propose_put_down"))?),
            set_step: Arc::new(node.service_client(&format!("{goal_oracle}/set_step"))?),
            load: Arc::new(node.service_client(&format!("{goal_oracle}/load_demonstration"))?),
            load_checkpoint: Arc::new(node.service_client(&format!("{policy}/load_checkpoint"))?),
        })
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
            Command::Recover(recovery, name) => self.ask_for_recovery(node, recovery, &name),
            Command::SetStep(step, name) => self.set_step(node, step, &name),
            Command::Load(demonstration, path, name) => {
                self.load(node, demonstration, path, &name);
            }
            Command::LoadCheckpoint(path, name) => self.load_checkpoint(node, path, &name),
            Command::Record(event) => {
                let page = self.page.clone();
                node.spawn_blocking(move || page.record(event));
            }
            Command::Keep(correction) => {
                let page = self.page.clone();
                node.spawn_blocking(move || page.keep(&correction.0, &correction.1));
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

    fn ask_for_recovery(&self, node: &Node, recovery: Recovery, name: &str) {
        let client = match recovery {
            Recovery::Home => &self.home,
            Recovery::PutDown => &self.put_down,
        };
        info!("`{name}` asks for {recovery:?}");
        self.publish_presence(node);
        let (client, console) = (Arc::clone(client), Arc::clone(&self.page.console));
        node.spawn(async move {
            let begun = console.now();
            let answer = loop {
                let answer = propose_recovery(&client).await;
                if !console.read(|state, now| state.repeats_recovery(&answer, begun, now)) {
                    break answer;
                }
                tokio::time::sleep(PRESENCE_PERIOD).await;
            };
            console.change(|state, now| state.on_recovery_answer(recovery, answer, now));
        });
    }

    fn set_step(&self, node: &Node, step: u32, name: &str) {
        info!("`{name}`: continue with step {step}");
        let (client, console) = (Arc::clone(&self.set_step), Arc::clone(&self.page.console));
        let request = SetStepRequest {
            request_id: console::secret(),
            step,
        };
        node.spawn(async move {
            let read = |said: SetStepResponse| (said.success, said.message, ());
            let answer = ask(&client, &request, &CallOptions::default(), read).await;
            console.change(|state, now| state.on_set_step_answer(answer, now));
        });
    }

    fn load(&self, node: &Node, demonstration: String, path: PathBuf, name: &str) {
        info!("`{name}`: repeat {}", path.display());
        let (client, page, blocking) = (Arc::clone(&self.load), self.page.clone(), node.clone());
        let request = LoadDemonstrationRequest {
            request_id: console::secret(),
            path: path.display().to_string(),
        };
        node.spawn(async move {
            let reader = page.clone();
            let goals = blocking.spawn_blocking(move || reader.show_demonstration(&path));
            let goals = goals.await.unwrap_or_else(|error| {
                error!("reading a demonstration: {error}");
                None
            });
            let read = |said: LoadDemonstrationResponse| {
                (said.success, said.message.clone(), said.message)
            };
            let answer = ask(&client, &request, &CallOptions::default(), read).await;
            page.console.change(|state, now| {
                state.on_load_answer(demonstration, goals, answer, now);
            });
        });
    }

    fn load_checkpoint(&self, node: &Node, path: PathBuf, name: &str) {
        info!("`{name}`: checkpoint {}", path.display());
        let (client, page) = (Arc::clone(&self.load_checkpoint), self.page.clone());
        let request = LoadCheckpointRequest {
            request_id: console::secret(),
            path: path.display().to_string(),
        };
        node.spawn(async move {
            let read = |said: LoadCheckpointResponse| {
                let policy = PolicyState {
                    checkpoint: said.path,
                    previous: said.previous,
                };
                (said.success, said.message, policy)
            };
            let answer = ask(&client, &request, &CallOptions::default(), read).await;
            page.on_checkpoint_answer(&path, answer);
        });
    }
}

/// The executor's proposal, and whether it needs an approval.
async fn propose_recovery(client: &ServiceClient<ProposeHome>) -> Answer<(ProposalId, bool)> {
    let options = CallOptions {
        attempts: 1,
        timeout: RECOVERY_TIMEOUT,
    };
    let read = |said: ProposeHomeResponse| {
        let proposed = (ProposalId(said.proposal_id), said.needs_approval);
        (said.success, said.message, proposed)
    };
    ask(client, &ProposeHomeRequest::default(), &options, read).await
}

/// What a service has done, or why not. `read`: whether it has, its reason why not, and what.
async fn ask<S: Service, T>(
    client: &ServiceClient<S>,
    request: &S::Request,
    options: &CallOptions,
    read: impl FnOnce(S::Response) -> (bool, String, T),
) -> Answer<T> {
    let said = client.call(request, options).await;
    match said.map(read) {
        Ok((true, _, done)) => Ok(done),
        Ok((false, reason, _)) => Err(reason),
        Err(error) => Err(error.to_string()),
    }
}
