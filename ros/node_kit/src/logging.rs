//! `tracing` to standard error and, inside a node's span, to `/rosout`.

use std::{
    collections::BTreeMap,
    fmt::{Debug, Write},
    io::{self, IsTerminal},
    sync::{Arc, PoisonError, RwLock},
};

use ros2_client::Log;
use tracing::{
    Event, Level, Subscriber,
    field::{Field, Visit},
    span::{Attributes, Id},
};
use tracing_subscriber::{
    EnvFilter, Layer, fmt,
    layer::{Context, SubscriberExt},
    registry::LookupSpan,
    util::SubscriberInitExt,
};

use crate::clock::Clock;

/// The span of each node, with its full name as field `node`.
const SPAN: &str = "node";

/// RustDDS logs harmless errors for every endpoint of a node that ends, and for types that it discovers (ros2-client reads `/clock`
/// with another type). By default only the errors of its two threads are shown, because a node without them receives nothing, and
/// the warning of a receive buffer that is too small. RUST_LOG=rustdds=warn shows all.
const DEFAULT_FILTER: &str = "info,rustdds=off,rustdds::receive_buffer=warn,rustdds::rtps::dp_event_loop=error,rustdds::discovery=error,\
    rustdds::discovery::discovery_db=off,ros2_client=error";

/// What writes to `/rosout` for each node of this process.
static WRITERS: RwLock<BTreeMap<String, RosoutWriter>> = RwLock::new(BTreeMap::new());

#[derive(Clone)]
struct RosoutWriter {
    publisher: Arc<Option<ros2_client::Publisher<Log>>>,
    clock: Clock,
}

/// A log filter that cannot be read.
#[derive(Debug, thiserror::Error)]
#[error("--log-level {level}: {reason}")]
pub struct LogLevelError {
    level: String,
    reason: String,
}

/// Sends the logs of this process to standard error and to `/rosout`. `levels` are those of
/// `--log-level`; the environment variable RUST_LOG sets the rest. Once per process; later calls
/// change nothing.
pub fn init(levels: &[String]) -> Result<(), LogLevelError> {
    let mut filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| DEFAULT_FILTER.into());
    for level in levels {
        // ROS writes `logger:=LEVEL`, and knows FATAL.
        let directive = level
            .replace(":=", "=")
            .to_lowercase()
            .replace("fatal", "error");
        let directive = directive.parse().map_err(|error| LogLevelError {
            level: level.clone(),
            reason: format!("expected debug, info, warn, error or fatal ({error})"),
        })?;
        filter = filter.add_directive(directive);
    }
    let stderr = fmt::layer()
        .with_writer(io::stderr)
        .with_ansi(io::stderr().is_terminal())
        .with_target(false);
    // A second call finds a subscriber in place and leaves it there.
    let _ = tracing_subscriber::registry()
        .with(filter)
        .with(stderr)
        .with(Rosout)
        .try_init();
    Ok(())
}

fn is_middleware(target: &str) -> bool {
    target.starts_with("rustdds") || target.starts_with("ros2_client")
}

/// The span in which everything a node does runs.
pub(crate) fn span(full_name: &str) -> tracing::Span {
    tracing::error_span!("node", node = full_name)
}

pub(crate) fn register(
    full_name: &str,
    publisher: Arc<Option<ros2_client::Publisher<Log>>>,
    clock: Clock,
) {
    WRITERS
        .write()
        .unwrap_or_else(PoisonError::into_inner)
        .insert(full_name.to_owned(), RosoutWriter { publisher, clock });
}

pub(crate) fn unregister(full_name: &str) {
    WRITERS
        .write()
        .unwrap_or_else(PoisonError::into_inner)
        .remove(full_name);
}

/// Publishes events of a node's span as rcl_interfaces/Log.
struct Rosout;

struct NodeName(String);

impl<S> Layer<S> for Rosout
where
    S: Subscriber + for<'a> LookupSpan<'a>,
{
    fn on_new_span(&self, attributes: &Attributes<'_>, id: &Id, context: Context<'_, S>) {
        if attributes.metadata().name() != SPAN {
            return;
        }
        let mut fields = Fields::default();
        attributes.record(&mut fields);
        if let (Some(node), Some(span)) = (fields.node, context.span(id)) {
            span.extensions_mut().insert(NodeName(node));
        }
    }

    fn on_event(&self, event: &Event<'_>, context: Context<'_, S>) {
        let metadata = event.metadata();
        // What the middleware says while it publishes this very log must not come back here.
        if is_middleware(metadata.target()) || metadata.target().starts_with("log") {
            return;
        }
        let node = context.event_scope(event).and_then(|mut scope| {
            scope.find_map(|span| {
                span.extensions()
                    .get::<NodeName>()
                    .map(|name| name.0.clone())
            })
        });
        let Some(node) = node else {
            return;
        };
        let writer = WRITERS
            .read()
            .unwrap_or_else(PoisonError::into_inner)
            .get(&node)
            .cloned();
        let Some(writer) = writer else {
            return;
        };
        let Some(publisher) = writer.publisher.as_ref() else {
            return;
        };
        let mut fields = Fields::default();
        event.record(&mut fields);
        // A log that cannot be published still stands on standard error.
        let _ = publisher.publish(Log {
            stamp: writer.clock.ros_time(),
            level: match *metadata.level() {
                Level::ERROR => Log::ERROR,
                Level::WARN => Log::WARN,
                Level::INFO => Log::INFO,
                _ => Log::DEBUG,
            },
            // As rclpy names loggers: /cell/fusion is cell.fusion.
            name: node.trim_start_matches('/').replace('/', "."),
            msg: fields.text,
            file: metadata.file().unwrap_or_default().to_owned(),
            function: metadata.module_path().unwrap_or_default().to_owned(),
            line: metadata.line().unwrap_or_default(),
        });
    }
}

/// The message first, other fields after it.
#[derive(Default)]
struct Fields {
    node: Option<String>,
    text: String,
}

impl Visit for Fields {
    fn record_str(&mut self, field: &Field, value: &str) {
        if field.name() == SPAN {
            self.node = Some(value.to_owned());
        } else {
            self.record_debug(field, &format_args!("{value}"));
        }
    }

    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        // Writing to a String cannot fail.
        let _ = if field.name() == "message" {
            write!(self.text, "{value:?}")
        } else {
            write!(self.text, " {}={value:?}", field.name())
        };
    }
}
