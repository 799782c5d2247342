//! `sctn bag play`.

use super::{DAMAGED, seconds};
use anyhow::{Context as _, Result, anyhow};
use bag_transport::{Order, Played, Player, PlayerOptions, TransportError};
use clap::Args;
use node_kit::{plain_node, wait_for_end};
use regex::RegexSet;
use rustix::termios::{LocalModes, OptionalActions, Termios, tcgetattr, tcsetattr};
use std::io::{IsTerminal, Read};
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};
use tokio::sync::mpsc;

/// Arguments of `sctn bag play`.
#[derive(Args)]
pub struct Play {
    /// Folder of a bag, or a single .mcap or .db3 file
    bag: PathBuf,
    /// Play only these topics
    #[arg(long, num_args = 1.., value_name = "TOPIC")]
    topics: Vec<String>,
    /// Play only topics whose name matches this regular expression; may be repeated
    #[arg(long, value_name = "PATTERN")]
    regex: Vec<String>,
    /// Leave out topics whose name matches; may be repeated
    #[arg(long, value_name = "PATTERN")]
    exclude: Vec<String>,
    /// Publish a topic by another name; may be repeated
    #[arg(long, value_name = "FROM:=TO")]
    remap: Vec<String>,
    /// Twice as fast as recorded is 2
    #[arg(long, default_value_t = 1.0)]
    rate: f64,
    /// Begin this many seconds after the first message
    #[arg(long, value_name = "SECONDS", default_value_t = 0.0)]
    start: f64,
    /// End this many seconds after the begin
    #[arg(long, value_name = "SECONDS")]
    duration: Option<f64>,
    /// Begin again at the end
    #[arg(long = "loop")]
    repeat: bool,
    /// Publish /clock this many times a second, and leave out the recorded one
    #[arg(long, value_name = "HZ")]
    clock: Option<f64>,
    /// Begin paused
    #[arg(long)]
    paused: bool,
    /// Before the first message wait at most this long until every topic is subscribed to
    #[arg(long, value_name = "SECONDS", default_value_t = 0.0)]
    wait: f64,
    /// Keep the keyboard out of it (space: pause, n: next message, + and -: rate, q: end)
    #[arg(long)]
    no_keyboard: bool,
    /// Print a JSON object last
    #[arg(long)]
    json: bool,
}

impl Play {
    pub fn run(self) -> Result<ExitCode> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .enable_all()
            .build()
            .context("tokio runtime")?;
        let result = runtime.block_on(self.session());
        runtime.shutdown_timeout(Duration::from_millis(500));
        result
    }

    fn options(&self) -> Result<PlayerOptions> {
        Ok(PlayerOptions {
            topics: self.topics.iter().cloned().collect(),
            patterns: RegexSet::new(&self.regex).context("--regex")?,
            exclude: RegexSet::new(&self.exclude).context("--exclude")?,
            rate: self.rate,
            start: seconds(self.start).context("--start")?,
            duration: self
                .duration
                .map(seconds)
                .transpose()
                .context("--duration")?,
            repeat: self.repeat,
            clock_hz: self.clock,
            paused: self.paused,
            wait: seconds(self.wait).context("--wait")?,
        })
    }

    async fn session(&self) -> Result<ExitCode> {
        let options = self.options()?;
        let remaps = self.remap.iter();
        let remaps: Vec<String> = remaps
            .flat_map(|rule| ["-r".to_owned(), rule.clone()])
            .collect();
        let (context, node) = plain_node("rosbag2_player", &remaps)?;
        let player = Player::open(&node, &self.bag, options).map_err(|error| match error {
            TransportError::Option { .. } => anyhow!("--{error}"),
            other => other.into(),
        })?;
        let keyboard = (!self.no_keyboard)
            .then(|| Keyboard::open(player.orders()))
            .flatten();
        let started = Instant::now();
        let signals = async {
            if let Err(error) = wait_for_end().await {
                tracing::error!("{error:#}");
            }
        };
        let played = player.play(signals).await;
        drop(keyboard);
        context.shutdown();
        let Played { messages, unsent } = played?;
        let seconds = started.elapsed().as_secs_f64();
        if self.json {
            println!(
                "{}",
                serde_json::json!({"bag": self.bag, "messages": messages, "unsent": unsent, "seconds": seconds})
            );
        } else {
            println!(
                "{messages} messages in {seconds:.1} s; {unsent} were not taken by the middleware"
            );
        }
        Ok(if unsent == 0 {
            ExitCode::SUCCESS
        } else {
            ExitCode::from(DAMAGED)
        })
    }
}

/// Reads keys without Enter while it exists.
struct Keyboard {
    before: Termios,
}

impl Keyboard {
    /// `None` where standard input is not a terminal.
    fn open(orders: mpsc::UnboundedSender<Order>) -> Option<Self> {
        let input = std::io::stdin();
        if !input.is_terminal() {
            return None;
        }
        let before = tcgetattr(&input).ok()?;
        let mut keys = before.clone();
        keys.local_modes
            .remove(LocalModes::ICANON | LocalModes::ECHO);
        tcsetattr(&input, OptionalActions::Now, &keys).ok()?;
        tracing::info!("space: pause, n: next message, + and -: rate, q: end");
        std::thread::spawn(move || {
            for key in std::io::stdin().lock().bytes() {
                let order = match key {
                    Ok(b' ') => Order::Toggle,
                    Ok(b'n') => Order::Next,
                    Ok(b'+' | b'=') => Order::Faster,
                    Ok(b'-') => Order::Slower,
                    Ok(b'q') => Order::End,
                    Ok(_) => continue,
                    Err(_) => return,
                };
                if orders.send(order).is_err() {
                    return;
                }
            }
        });
        Some(Self { before })
    }
}

impl Drop for Keyboard {
    fn drop(&mut self) {
        let _ = tcsetattr(std::io::stdin(), OptionalActions::Now, &self.before);
    }
}
