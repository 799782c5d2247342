//! Where nodes live: the network they look for others on, and their common end.

use std::{
    collections::BTreeMap,
    env,
    fs::{self, File},
    net::{IpAddr, Ipv4Addr, UdpSocket},
    os::unix::fs::MetadataExt as _,
    path::Path,
    process::{self, ExitCode},
    sync::{
        Mutex, PoisonError,
        atomic::{AtomicU16, Ordering},
    },
    time::Duration,
};

use anyhow::Context as _;
use rustdds::DomainParticipantBuilder;
#[cfg(feature = "security")]
use rustdds::DomainParticipantSecurityConfigFiles;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tracing::{Instrument, error, info};

use crate::{
    arguments::RosArguments,
    lifecycle::{Active, Lifecycle},
    logging,
    node::Node,
    parameter_services,
    parameter_store::ParameterStore,
    parameters::{self, Loaded, Parameters},
    security::{self, Security, SecurityError},
};

/// Where to look for other nodes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Network {
    /// ROS_DOMAIN_ID.
    pub domain_id: u16,
    /// Nothing leaves this host.
    pub localhost_only: bool,
}

/// Why there is no participant.
#[derive(Debug, thiserror::Error)]
pub enum ContextError {
    /// An environment variable makes no sense.
    #[error("environment variable {name}={value}: expected {expected}")]
    Environment {
        /// Its name.
        name: &'static str,
        /// Its value.
        value: String,
        /// What it may be.
        expected: &'static str,
    },
    /// Security is asked for, and the node cannot be protected.
    #[error(transparent)]
    Security(#[from] SecurityError),
    /// The middleware refused.
    #[error("DDS participant in domain {domain_id}: {reason}")]
    Middleware {
        /// The domain.
        domain_id: u16,
        /// The reason.
        reason: String,
    },
    /// Every domain id has participants.
    #[error("no ROS domain id from 1 to {LAST_DOMAIN_ID} is unused on this machine")]
    NoUnusedDomain,
}

/// The ports of domains above are among those that Linux hands out to anybody.
const LAST_DOMAIN_ID: u16 = 100;

/// Takes the lock of a domain id, which one process of this machine holds at a time until it ends: its ports tell of it only once it is
/// in the domain. The tests in Python take the same lock. `again`: one that this process holds already will do.
fn claim(domain_id: u16, again: bool) -> bool {
    static CLAIMS: Mutex<BTreeMap<u16, File>> = Mutex::new(BTreeMap::new());
    let mut claims = CLAIMS.lock().unwrap_or_else(PoisonError::into_inner);
    if claims.contains_key(&domain_id) {
        return again;
    }
    let user = fs::metadata("/proc/self").map_or(0, |process| process.uid());
    let path = env::temp_dir().join(format!("sctn_ros_domain_{user}_{domain_id}.lock"));
    match File::options().create(true).append(true).open(path) {
        Ok(lock) => {
            let taken = lock.try_lock().is_ok();
            if taken {
                claims.insert(domain_id, lock);
            }
            taken
        }
        // Where no lock can be made the ports alone decide.
        Err(_) => true,
    }
}

impl Network {
    /// This machine alone, in a domain whose discovery ports nobody has here, and which no other process was given; for each call
    /// another one.
    pub fn unused() -> Result<Self, ContextError> {
        static CALLS: AtomicU16 = AtomicU16::new(0);
        let call = CALLS.fetch_add(1, Ordering::Relaxed) % LAST_DOMAIN_ID;
        // Processes that ask at the same time begin elsewhere.
        let start = (process::id() % u32::from(LAST_DOMAIN_ID)) as u16 + 7 * call;
        let free = |port| UdpSocket::bind((Ipv4Addr::UNSPECIFIED, port)).is_ok();
        let mut ids = (0..LAST_DOMAIN_ID).map(|offset| 1 + (start + offset) % LAST_DOMAIN_ID);
        let unused = |id: &u16, again| {
            // Of the domain, then of its participants (DDSI-RTPS 2.5, 9.6.2.3).
            let first = 7400 + 250 * id;
            (first..first + 2).chain(first + 10..first + 20).all(free) && claim(*id, again)
        };
        // Two tests of one process must not meet, as long as there are others.
        let domain_id = ids.clone().find(|id| unused(id, false));
        let domain_id = domain_id.or_else(|| ids.find(|id| unused(id, true)));
        let domain_id = domain_id.ok_or(ContextError::NoUnusedDomain)?;
        Ok(Self {
            domain_id,
            localhost_only: true,
        })
    }

    fn from_variables(read: impl Fn(&str) -> Option<String>) -> Result<Self, ContextError> {
        let bad = |name, value: &str, expected| ContextError::Environment {
            name,
            value: value.to_owned(),
            expected,
        };
        let domain_id = match read("ROS_DOMAIN_ID").as_deref() {
            None | Some("") => 0,
            // Above 232 the port numbers of DDS overflow.
            Some(text) => text
                .parse()
                .ok()
                .filter(|id| *id <= 232)
                .ok_or_else(|| bad("ROS_DOMAIN_ID", text, "an integer from 0 to 232"))?,
        };
        let range = read("ROS_AUTOMATIC_DISCOVERY_RANGE");
        let localhost_only = match range.as_deref() {
            Some("LOCALHOST") => true,
            Some("SUBNET" | "SYSTEM_DEFAULT") => false,
            None | Some("") => match read("ROS_LOCALHOST_ONLY").as_deref() {
                Some("1") => true,
                None | Some("" | "0") => false,
                Some(other) => return Err(bad("ROS_LOCALHOST_ONLY", other, "0 or 1")),
            },
            Some(other) => {
                return Err(bad(
                    "ROS_AUTOMATIC_DISCOVERY_RANGE",
                    other,
                    "SUBNET, LOCALHOST or SYSTEM_DEFAULT (OFF is not supported)",
                ));
            }
        };
        Ok(Self {
            domain_id,
            localhost_only,
        })
    }
}

/// A node that lives as a task; how it ended, once it has.
pub type NodeLife = JoinHandle<anyhow::Result<()>>;

/// What the nodes of a process have in common.
///
/// Each node has a DDS participant of its own, in one process as in several: nodes of one participant
/// take discovery events from each other, and one event loop would carry all images. Without multicast
/// discovery finds a dozen participants per host.
#[derive(Clone)]
pub struct Context {
    network: Network,
    security: Option<Security>,
    shutdown: CancellationToken,
}

impl Context {
    /// Nodes made from this will live on that network, unprotected.
    pub fn new(network: Network) -> Self {
        Self {
            network,
            security: None,
            shutdown: CancellationToken::new(),
        }
    }

    /// As ROS 2 reads the environment: ROS_DOMAIN_ID, ROS_AUTOMATIC_DISCOVERY_RANGE (SUBNET, LOCALHOST,
    /// SYSTEM_DEFAULT), the older ROS_LOCALHOST_ONLY, and the ROS_SECURITY_ENABLE, _STRATEGY, _KEYSTORE and
    /// _ENCLAVE_OVERRIDE of DDS security.
    pub fn from_environment() -> Result<Self, ContextError> {
        Self::from_variables(|name| env::var(name).ok())
    }

    /// The same, with variables that `read` gives in place of the environment's.
    pub fn from_variables(read: impl Fn(&str) -> Option<String>) -> Result<Self, ContextError> {
        Ok(Self {
            network: Network::from_variables(&read)?,
            security: Security::from_variables(&read)?,
            shutdown: CancellationToken::new(),
        })
    }

    /// Makes a node without lifecycle and reads its parameters.
    pub fn node<P: Parameters>(
        &self,
        default_name: &str,
        arguments: &RosArguments,
    ) -> anyhow::Result<(Node, P)> {
        let (node, loaded) = self.load(default_name, arguments, true)?;
        Ok((node, loaded.parameters))
    }

    fn load<P: Parameters>(
        &self,
        default_name: &str,
        arguments: &RosArguments,
        configured: bool,
    ) -> anyhow::Result<(Node, Loaded<P>)> {
        let name = arguments.node_name(default_name);
        let namespace = arguments.namespace(default_name).trim_matches('/');
        let full_name = format!("/{namespace}/{name}").replace("//", "/");
        let loaded = parameters::load::<P>(&arguments.parameters, default_name, &full_name)?;
        let node = Node::new(
            self.join(arguments.enclave.as_deref())?,
            self.shutdown.child_token(),
            default_name,
            arguments,
            loaded.use_sim_time,
            ParameterStore::new(&loaded, configured)?,
            loaded.qos_overrides.clone(),
        )?;
        parameter_services::serve(&node, node.parameter_store())?;
        Ok((node, loaded))
    }

    /// Makes a node with a managed lifecycle and lets it live as a task, until it ends or the context shuts
    /// down. `configure` makes what the node does while it is active; it is called again when the node is
    /// configured again.
    pub fn start<P, A, F>(
        &self,
        default_name: &str,
        arguments: &RosArguments,
        configure: impl Fn(Node, P) -> F + Send + 'static,
    ) -> anyhow::Result<NodeLife>
    where
        P: Parameters,
        A: Active,
        F: Future<Output = anyhow::Result<A>> + Send + 'static,
    {
        let (node, loaded) = self
            .load::<P>(default_name, arguments, false)
            .with_context(|| format!("node {default_name}"))?;
        let lifecycle = node
            .span()
            .in_scope(|| Lifecycle::new(&node, loaded.autostart))?;
        let span = node.span().clone();
        let life = async move {
            let result = lifecycle.live(configure).await;
            if let Err(error) = &result {
                error!("{error:#}");
            }
            node.stop();
            result
        };
        Ok(tokio::spawn(life.instrument(span)))
    }

    /// Ends all nodes of this context.
    pub fn shutdown(&self) {
        self.shutdown.cancel();
    }
}

impl Context {
    /// A new participant of the domain.
    fn join(&self, enclave: Option<&str>) -> Result<ros2_client::Context, ContextError> {
        let Network {
            domain_id,
            localhost_only,
        } = self.network;
        let middleware = |reason| ContextError::Middleware { domain_id, reason };
        let mut builder = DomainParticipantBuilder::new(domain_id);
        if localhost_only {
            builder = builder.with_only_networks([IpAddr::V4(Ipv4Addr::LOCALHOST)]);
        }
        let folder = match &self.security {
            Some(security) => security.enclave(enclave)?,
            None => None,
        };
        if let Some(folder) = folder {
            security::check_supported(&folder)?;
            builder = protected(builder, &folder)?;
        }
        let participant = builder
            .build()
            .map_err(|error| middleware(error.to_string()))?;
        ros2_client::Context::from_domain_participant(participant)
            .map_err(|error| middleware(error.to_string()))
    }
}

/// With the files of that folder.
#[cfg(feature = "security")]
fn protected(
    builder: DomainParticipantBuilder,
    folder: &Path,
) -> Result<DomainParticipantBuilder, ContextError> {
    let files = DomainParticipantSecurityConfigFiles::with_ros_default_names(folder, String::new());
    Ok(builder.builtin_security(files))
}

#[cfg(not(feature = "security"))]
fn protected(
    _: DomainParticipantBuilder,
    _: &Path,
) -> Result<DomainParticipantBuilder, ContextError> {
    Err(SecurityError::NotBuilt.into())
}

/// The `main` of a node's own executable: ROS arguments, participant, node, and a clean end on
/// SIGINT and SIGTERM.
///
/// `--parameters` prints the parameters with their defaults. With the environment variable
/// NODE_KIT_EXIT_WITH_PARENT=1 the node ends when the process that started it is gone.
pub fn main<P: Parameters>(
    default_name: &'static str,
    start: impl FnOnce(&Context, &RosArguments) -> anyhow::Result<NodeLife>,
) -> ExitCode {
    match run_main::<P>(default_name, start) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{default_name}: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run_main<P: Parameters>(
    default_name: &'static str,
    start: impl FnOnce(&Context, &RosArguments) -> anyhow::Result<NodeLife>,
) -> anyhow::Result<()> {
    let (arguments, others) = RosArguments::parse(env::args().skip(1))?;
    match others.first().map(String::as_str) {
        None => {}
        Some("--parameters") => {
            print!("{}", serde_yaml_ng::to_string(&P::default())?);
            return Ok(());
        }
        Some(other) => anyhow::bail!(
            "unknown argument {other:?}; usage: {default_name} [--parameters] [--ros-args -r FROM:=TO \
             -p NAME:=VALUE --params-file FILE --log-level LEVEL --enclave ENCLAVE]"
        ),
    }
    logging::init(&arguments.log_levels)?;
    let context = Context::from_environment()?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .context("tokio runtime")?;
    let result = runtime.block_on(async {
        let ended = start(&context, &arguments)?;
        let signalled = tokio::spawn({
            let context = context.clone();
            async move {
                wait_for_end().await?;
                context.shutdown();
                anyhow::Ok(())
            }
        });
        let result = ended.await.context("node panicked")?;
        context.shutdown();
        signalled.abort();
        result
    });
    // Blocking work (a network, a simulation step) is not waited for.
    runtime.shutdown_timeout(Duration::from_millis(500));
    result
}

/// Waits for SIGINT, SIGTERM, or, where asked for, the end of the parent process.
pub async fn wait_for_end() -> anyhow::Result<()> {
    use tokio::signal::unix::{SignalKind, signal};
    let mut terminate = signal(SignalKind::terminate()).context("SIGTERM")?;
    let with_parent = env::var("NODE_KIT_EXIT_WITH_PARENT").is_ok_and(|value| value == "1");
    tokio::select! {
        result = tokio::signal::ctrl_c() => {
            result.context("SIGINT")?;
            info!("SIGINT: shutting down");
        }
        _ = terminate.recv() => info!("SIGTERM: shutting down"),
        () = parent_gone(), if with_parent => info!("parent process is gone: shutting down"),
    }
    Ok(())
}

async fn parent_gone() {
    let parent = std::os::unix::process::parent_id();
    while std::os::unix::process::parent_id() == parent {
        tokio::time::sleep(Duration::from_millis(500)).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn network(variables: &[(&str, &str)]) -> Result<Network, ContextError> {
        Network::from_variables(|name| {
            variables
                .iter()
                .find(|(key, _)| *key == name)
                .map(|(_, value)| (*value).to_owned())
        })
    }

    #[test]
    fn a_domain_that_somebody_is_in_is_not_unused() {
        let taken = Network::unused().unwrap();
        let _somebody = UdpSocket::bind(("0.0.0.0", 7400 + 250 * taken.domain_id + 10)).unwrap();
        let given: Vec<_> = (0..LAST_DOMAIN_ID)
            .map(|_| Network::unused().unwrap())
            .collect();
        assert!(given.iter().all(|network| network.localhost_only));
        assert!(!given.contains(&taken));
        assert_ne!(given[0], given[1]);
    }

    #[test]
    fn a_domain_that_another_process_was_given_is_not_unused() {
        let given = Network::unused().unwrap();
        let user = fs::metadata("/proc/self").unwrap().uid();
        let lock = format!("sctn_ros_domain_{user}_{}.lock", given.domain_id);
        let another = File::open(env::temp_dir().join(lock)).unwrap();
        assert!(another.try_lock().is_err());
        // Its own is not in its way.
        assert!(claim(given.domain_id, true));
    }

    #[test]
    fn the_environment_is_read_as_ros_does() {
        assert_eq!(network(&[]).unwrap(), Network::default());
        let set = network(&[
            ("ROS_DOMAIN_ID", "42"),
            ("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"),
        ]);
        assert_eq!(
            set.unwrap(),
            Network {
                domain_id: 42,
                localhost_only: true
            }
        );
        assert!(
            network(&[("ROS_LOCALHOST_ONLY", "1")])
                .unwrap()
                .localhost_only
        );
    }

    #[test]
    fn nonsense_in_the_environment_is_refused_by_name() {
        for (name, value) in [
            ("ROS_DOMAIN_ID", "233"),
            ("ROS_DOMAIN_ID", "one"),
            ("ROS_AUTOMATIC_DISCOVERY_RANGE", "HOME"),
            ("ROS_LOCALHOST_ONLY", "yes"),
        ] {
            let text = network(&[(name, value)]).unwrap_err().to_string();
            assert!(text.contains(name) && text.contains(value), "{text}");
        }
    }
}
