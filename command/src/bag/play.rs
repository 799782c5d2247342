//! `sctn bag play`.

use super::{DAMAGED, record::seconds, recorder::LARGE};
use crate::plain_node::plain_node;
use anyhow::{Context as _, Result, bail};
use bags::{BagReader, RawMessage, Topic};
use clap::Args;
use msgs::builtin_interfaces::Time;
use msgs::rosbag2_interfaces as services;
use msgs::rosgraph_msgs::Clock;
use msgs::tf2_msgs::TFMessage;
use msgs::{Interface, to_cdr};
use node_kit::{Node, RawPublisher, RawQos, stamp_from_ns, wait_for_end};
use regex::RegexSet;
use rustix::termios::{LocalModes, OptionalActions, Termios, tcgetattr, tcsetattr};
use std::collections::BTreeMap;
use std::io::{IsTerminal, Read};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::sync::mpsc;
use tokio::time::Instant;

/// Messages that are read ahead of their time.
const READ_AHEAD: usize = 32;
/// How long the last messages may take to be acknowledged.
const LAST_WORDS: Duration = Duration::from_secs(5);
/// One press of a key changes the rate by this factor.
const RATE_STEP: f64 = 1.1;

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

/// What keyboard and services ask for.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Order {
    Pause(bool),
    Toggle,
    Next,
    Rate(f64),
    Faster,
    Slower,
    End,
}

/// What services answer with.
#[derive(Clone, Copy, Debug)]
struct State {
    paused: bool,
    rate: f64,
}

/// Bag time against wall time.
struct Pace {
    state: Arc<Mutex<State>>,
    /// At this moment of the wall...
    wall: Instant,
    /// ... it was this time of the bag.
    bag: Duration,
}

impl Pace {
    fn state(&self) -> State {
        *self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Time of the bag now.
    fn now(&self) -> Duration {
        let State { paused, rate } = self.state();
        if paused {
            return self.bag;
        }
        self.bag + self.wall.elapsed().mul_f64(rate)
    }

    /// When a time of the bag comes; never while paused.
    fn when(&self, time: Duration) -> Option<Instant> {
        let State { paused, rate } = self.state();
        let wait = time.saturating_sub(self.bag).div_f64(rate);
        (!paused).then(|| self.wall + wait)
    }

    /// Changes the state from now on.
    fn change(&mut self, change: impl FnOnce(&mut State)) {
        self.jump(self.now());
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        change(&mut state);
    }

    fn jump(&mut self, bag: Duration) {
        (self.wall, self.bag) = (Instant::now(), bag);
    }
}

/// The topics that are played.
struct Stage {
    publishers: BTreeMap<String, RawPublisher>,
    sent: u64,
    unsent: u64,
}

impl Stage {
    fn publish(&mut self, message: RawMessage) {
        if let Some(publisher) = self.publishers.get(&message.topic.name) {
            if publisher.publish(message.data) {
                self.sent += 1;
            } else {
                self.unsent += 1;
            }
        }
    }
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

    fn chosen<'a>(&self, bag: &'a BagReader) -> Result<Vec<&'a Topic>> {
        let patterns = RegexSet::new(&self.regex).context("--regex")?;
        let exclude = RegexSet::new(&self.exclude).context("--exclude")?;
        let some = !self.topics.is_empty() || !self.regex.is_empty();
        for name in &self.topics {
            if !bag.topics().iter().any(|topic| topic.name == *name) {
                bail!("{}: has no topic {name}", self.bag.display());
            }
        }
        let chosen = bag.topics().iter().filter(|topic| {
            let named = self.topics.contains(&topic.name) || patterns.is_match(&topic.name);
            let clock = self.clock.is_some() && topic.type_name == Clock::TYPE_NAME;
            (named || !some) && !exclude.is_match(&topic.name) && !clock && topic.message_count > 0
        });
        let chosen: Vec<&Topic> = chosen.collect();
        if chosen.is_empty() {
            bail!(
                "{}: no message on any topic that was chosen",
                self.bag.display()
            );
        }
        if let Some(topic) = chosen.iter().find(|topic| topic.message_encoding != "cdr") {
            bail!(
                "{}: messages of topic {} are {:?}, expected \"cdr\"; leave it out with --exclude",
                self.bag.display(),
                topic.name,
                topic.message_encoding
            );
        }
        Ok(chosen)
    }

    async fn session(&self) -> Result<ExitCode> {
        if !self.rate.is_finite() || self.rate <= 0.0 {
            bail!("--rate is {}, expected a number above 0", self.rate);
        }
        if self.clock.is_some_and(|hz| !(hz > 0.0 && hz <= 10_000.0)) {
            bail!("--clock: expected a rate above 0 and at most 10,000 Hz");
        }
        let bag = BagReader::open(&self.bag)?;
        let (first, last) = bag
            .span()
            .with_context(|| format!("{}: holds no message", self.bag.display()))?;
        let begin = first + seconds(self.start).context("--start")?;
        if begin > last {
            bail!(
                "--start is {} s, expected at most the {:.3} s that {} lasts",
                self.start,
                (last - first).as_secs_f64(),
                self.bag.display()
            );
        }
        let end = match self.duration {
            Some(duration) => begin + seconds(duration).context("--duration")?,
            None => last + Duration::from_nanos(1),
        };
        let chosen = self.chosen(&bag)?;
        let names: Vec<String> = chosen.iter().map(|topic| topic.name.clone()).collect();

        let remaps = self
            .remap
            .iter()
            .flat_map(|rule| ["-r".to_owned(), rule.clone()]);
        let remaps: Vec<String> = remaps.collect();
        let (context, node) = plain_node("rosbag2_player", &remaps)?;
        let mut stage = Stage {
            publishers: BTreeMap::new(),
            sent: 0,
            unsent: 0,
        };
        for topic in &chosen {
            let publisher = node.raw_publisher(&topic.name, &topic.type_name, offered(topic))?;
            stage.publishers.insert(topic.name.clone(), publisher);
        }
        let (orders, mut asked) = mpsc::unbounded_channel();
        let state = Arc::new(Mutex::new(State {
            paused: self.paused,
            rate: self.rate,
        }));
        serve(&node, &orders, &state)?;
        let keyboard = (!self.no_keyboard)
            .then(|| Keyboard::open(&orders))
            .flatten();
        if let Some(hz) = self.clock {
            // Made here, so that who waits for subscriptions waits for it too.
            tracing::info!("/clock at {hz} Hz");
        }
        let clock = self
            .clock
            .map(|_| {
                let qos = RawQos {
                    reliable: false,
                    transient_local: false,
                    depth: 8,
                };
                node.raw_publisher("/clock", Clock::TYPE_NAME, qos)
            })
            .transpose()?;
        let wait = seconds(self.wait).context("--wait")?;
        if !wait.is_zero() {
            let published: Vec<String> = stage
                .publishers
                .values()
                .map(|publisher| publisher.topic().to_owned())
                .collect();
            for topic in node.graph().wait_for_subscriptions(&published, wait).await {
                tracing::warn!("nobody subscribes to {topic}");
            }
        }

        let mut pace = Pace {
            state,
            wall: Instant::now(),
            bag: begin,
        };
        let started = Instant::now();
        let signal = wait_for_end();
        tokio::pin!(signal);
        let played = tokio::select! {
            played = async {
                loop {
                    pace.jump(begin);
                    latched_before(&bag, &chosen, begin, &mut stage)?;
                    let through = self.pass(&bag, &names, (begin, end), &mut pace, &mut stage, &mut asked, clock.as_ref()).await?;
                    if !through || !self.repeat {
                        return anyhow::Ok(());
                    }
                }
            } => played,
            result = &mut signal => result,
        };
        drop(keyboard);
        let Stage {
            publishers,
            sent,
            unsent,
        } = stage;
        let last_words = tokio::task::spawn_blocking(move || {
            let heard = publishers
                .values()
                .all(|publisher| publisher.wait_until_heard(LAST_WORDS));
            (publishers, heard)
        });
        let (publishers, heard) = last_words.await?;
        if !heard {
            tracing::warn!("not every subscription has acknowledged the last messages");
        }
        drop(publishers);
        context.shutdown();
        played?;
        let seconds = started.elapsed().as_secs_f64();
        if self.json {
            println!(
                "{}",
                serde_json::json!({"bag": self.bag, "messages": sent, "unsent": unsent, "seconds": seconds})
            );
        } else {
            println!(
                "{sent} messages in {seconds:.1} s; {unsent} were not taken by the middleware"
            );
        }
        Ok(if unsent == 0 {
            ExitCode::SUCCESS
        } else {
            ExitCode::from(DAMAGED)
        })
    }

    /// Plays from `begin` to `end`. `false`: somebody asked for the end.
    #[allow(clippy::too_many_arguments)]
    async fn pass(
        &self,
        bag: &BagReader,
        names: &[String],
        (begin, end): (Duration, Duration),
        pace: &mut Pace,
        stage: &mut Stage,
        asked: &mut mpsc::UnboundedReceiver<Order>,
        clock: Option<&RawPublisher>,
    ) -> Result<bool> {
        let mut messages = read_ahead(bag, names, begin, end);
        let tick = Duration::from_secs_f64(1.0 / self.clock.unwrap_or(1.0));
        let mut ticks = tokio::time::interval(tick);
        ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        while let Some(message) = messages.recv().await {
            let message = message?;
            loop {
                let due = pace.when(message.log_time);
                tokio::select! {
                    biased;
                    order = asked.recv() => match order {
                        Some(Order::End) => return Ok(false),
                        Some(Order::Next) if pace.state().paused => {
                            pace.jump(message.log_time);
                            break;
                        }
                        Some(order) => obey(order, pace),
                        None => {}
                    },
                    _ = ticks.tick(), if clock.is_some() => {
                        if let Some(clock) = clock {
                            publish_clock(clock, pace.now())?;
                        }
                    }
                    () = until(due) => break,
                }
            }
            stage.publish(message);
        }
        Ok(true)
    }
}

fn obey(order: Order, pace: &mut Pace) {
    pace.change(|state| match order {
        Order::Pause(paused) => state.paused = paused,
        Order::Toggle => state.paused = !state.paused,
        Order::Rate(rate) => state.rate = rate,
        Order::Faster => state.rate *= RATE_STEP,
        Order::Slower => state.rate /= RATE_STEP,
        Order::Next | Order::End => {}
    });
    let State { paused, rate } = pace.state();
    tracing::info!(
        "{}, rate {rate:.2}",
        if paused { "paused" } else { "playing" }
    );
}

async fn until(due: Option<Instant>) {
    match due {
        Some(due) => tokio::time::sleep_until(due).await,
        None => std::future::pending().await,
    }
}

fn publish_clock(clock: &RawPublisher, now: Duration) -> Result<()> {
    let stamp: Time = stamp_from_ns(i64::try_from(now.as_nanos()).unwrap_or(i64::MAX));
    clock.publish(to_cdr(&Clock { clock: stamp })?);
    Ok(())
}

/// Messages in order of their times, read by a thread of its own.
fn read_ahead(
    bag: &BagReader,
    names: &[String],
    begin: Duration,
    end: Duration,
) -> mpsc::Receiver<Result<RawMessage>> {
    let (sender, receiver) = mpsc::channel(READ_AHEAD);
    let (path, names) = (bag.path().to_owned(), names.to_vec());
    // Opened again: a bag's reader stays on its thread.
    std::thread::spawn(move || {
        let read = || -> Result<()> {
            let bag = BagReader::open(&path)?;
            let names: Vec<&str> = names.iter().map(String::as_str).collect();
            for message in bag.messages_between(&names, begin, end) {
                if sender.blocking_send(Ok(message?)).is_err() {
                    return Ok(());
                }
            }
            Ok(())
        };
        if let Err(error) = read() {
            let _ = sender.blocking_send(Err(error));
        }
    });
    receiver
}

/// What stood on latched topics when the play begins in the middle: of each the last message, of transforms all.
fn latched_before(
    bag: &BagReader,
    chosen: &[&Topic],
    begin: Duration,
    stage: &mut Stage,
) -> Result<()> {
    let latched = chosen.iter().filter(|topic| offered(topic).transient_local);
    for topic in latched {
        if topic.type_name == TFMessage::TYPE_NAME {
            for message in bag.messages_between(&[&topic.name], Duration::ZERO, begin) {
                stage.publish(message?);
            }
        } else if let Some(message) = bag.last_before(&topic.name, begin)? {
            stage.publish(message);
        }
    }
    Ok(())
}

/// The least that the publishers of a recorded topic offered.
fn offered(topic: &Topic) -> RawQos {
    let reliable = topic.offered.iter().all(|qos| qos.reliable);
    let transient_local =
        !topic.offered.is_empty() && topic.offered.iter().all(|qos| qos.transient_local);
    let depth = topic.offered.iter().map(|qos| qos.depth).max().unwrap_or(0);
    RawQos {
        reliable,
        transient_local,
        // What a reliable topic keeps is what a slow reader may still ask for.
        depth: match (reliable, transient_local) {
            (_, true) if topic.type_name == TFMessage::TYPE_NAME => 64,
            (_, true) => depth.clamp(1, 64),
            // Of images a second's worth: a gigabyte of them would be kept otherwise.
            (true, false) if LARGE.contains(&topic.type_name.as_str()) => 32,
            (true, false) => 512,
            (false, false) => 8,
        },
    }
}

/// The services of rosbag2's player.
fn serve(
    node: &Node,
    orders: &mpsc::UnboundedSender<Order>,
    state: &Arc<Mutex<State>>,
) -> Result<()> {
    let name = |service: &str| format!("{}/{service}", node.full_name());
    let send = |order: Order| {
        let orders = orders.clone();
        move || {
            let _ = orders.send(order);
        }
    };
    let state = || {
        let state = Arc::clone(state);
        move || *state.lock().unwrap_or_else(PoisonError::into_inner)
    };
    let (pause, resume, toggle, next) = (
        send(Order::Pause(true)),
        send(Order::Pause(false)),
        send(Order::Toggle),
        send(Order::Next),
    );
    let server = node.service_server::<services::Pause>(&name("pause"))?;
    node.spawn(server.serve(move |_| {
        pause();
        services::PauseResponse::default()
    }));
    let server = node.service_server::<services::Resume>(&name("resume"))?;
    node.spawn(server.serve(move |_| {
        resume();
        services::ResumeResponse::default()
    }));
    let server = node.service_server::<services::TogglePaused>(&name("toggle_paused"))?;
    node.spawn(server.serve(move |_| {
        toggle();
        services::TogglePausedResponse::default()
    }));
    let now = state();
    let server = node.service_server::<services::IsPaused>(&name("is_paused"))?;
    node.spawn(server.serve(move |_| services::IsPausedResponse {
        paused: now().paused,
    }));
    let now = state();
    let server = node.service_server::<services::PlayNext>(&name("play_next"))?;
    node.spawn(server.serve(move |_| {
        let success = now().paused;
        if success {
            next();
        }
        services::PlayNextResponse { success }
    }));
    let now = state();
    let server = node.service_server::<services::GetRate>(&name("get_rate"))?;
    node.spawn(server.serve(move |_| services::GetRateResponse { rate: now().rate }));
    let orders = orders.clone();
    let server = node.service_server::<services::SetRate>(&name("set_rate"))?;
    node.spawn(server.serve(move |request| {
        let success = request.rate.is_finite() && request.rate > 0.0;
        if success {
            let _ = orders.send(Order::Rate(request.rate));
        }
        services::SetRateResponse { success }
    }));
    Ok(())
}

/// Keys without Enter, as long as it lives.
struct Keyboard {
    before: Termios,
}

impl Keyboard {
    /// None where standard input is no terminal.
    fn open(orders: &mpsc::UnboundedSender<Order>) -> Option<Self> {
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
        let orders = orders.clone();
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

#[cfg(test)]
mod tests {
    use super::*;

    fn pace(paused: bool, rate: f64) -> Pace {
        Pace {
            state: Arc::new(Mutex::new(State { paused, rate })),
            wall: Instant::now(),
            bag: Duration::from_secs(100),
        }
    }

    #[tokio::test(start_paused = true)]
    async fn bag_time_follows_the_rate_and_stands_still_while_paused() {
        let mut pace = pace(false, 2.0);
        assert_eq!(
            pace.when(Duration::from_secs(110)).unwrap() - pace.wall,
            Duration::from_secs(5)
        );
        tokio::time::advance(Duration::from_secs(1)).await;
        assert_eq!(pace.now(), Duration::from_secs(102));
        obey(Order::Pause(true), &mut pace);
        tokio::time::advance(Duration::from_secs(1)).await;
        assert_eq!(pace.now(), Duration::from_secs(102));
        assert_eq!(pace.when(Duration::from_secs(103)), None);
        obey(Order::Rate(0.5), &mut pace);
        obey(Order::Toggle, &mut pace);
        tokio::time::advance(Duration::from_secs(2)).await;
        assert_eq!(pace.now(), Duration::from_secs(103));
    }
}
