//! The player: publishes the messages of a bag at their recorded pace.

use crate::{LARGE_TYPES, TransportError};
use bags::{BagError, BagReader, RawMessage, Topic};
use msgs::builtin_interfaces::Time;
use msgs::rosbag2_interfaces as services;
use msgs::rosgraph_msgs::Clock;
use msgs::tf2_msgs::TFMessage;
use msgs::{Interface, to_cdr};
use node_kit::{Node, RawPublisher, RawQos, stamp_from_ns, when};
use regex::RegexSet;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::sync::mpsc;
use tokio::time::{Instant, sleep_until};

/// Messages that are read ahead of their time.
const READ_AHEAD: usize = 32;
/// How long the subscribers may take to acknowledge the last messages.
const ACKNOWLEDGEMENT_TIMEOUT: Duration = Duration::from_secs(5);
/// [`Order::Faster`] and [`Order::Slower`] change the rate by this factor.
const RATE_STEP: f64 = 1.1;
/// Range of `clock_hz`.
const MAX_CLOCK_HZ: f64 = 10_000.0;

type Result<T, E = TransportError> = std::result::Result<T, E>;

/// What to play, and how.
#[derive(Clone, Debug)]
pub struct PlayerOptions {
    /// Play only these topics, by name, and those of `patterns`; all topics when both are empty.
    pub topics: BTreeSet<String>,
    /// Play only topics whose name matches one of these, and those of `topics`.
    pub patterns: RegexSet,
    /// Leave out topics whose name matches one of these.
    pub exclude: RegexSet,
    /// Bag time per wall time, above 0.
    pub rate: f64,
    /// Begin this long after the first message.
    pub start: Duration,
    /// End this long after the begin; `None`: after the last message.
    pub duration: Option<Duration>,
    /// Begin again at the end.
    pub repeat: bool,
    /// Publish `/clock` at this rate (Hz) in place of the recorded one.
    pub clock_hz: Option<f64>,
    /// Begin paused.
    pub paused: bool,
    /// Before the first message wait at most this long until every topic has a subscription.
    pub wait: Duration,
}

impl Default for PlayerOptions {
    fn default() -> Self {
        Self {
            topics: BTreeSet::new(),
            patterns: RegexSet::empty(),
            exclude: RegexSet::empty(),
            rate: 1.0,
            start: Duration::ZERO,
            duration: None,
            repeat: false,
            clock_hz: None,
            paused: false,
            wait: Duration::ZERO,
        }
    }
}

/// What a keyboard or a service asks of a running player.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Order {
    /// Pause or play on.
    Pause(bool),
    /// Pause if playing, else play on.
    Toggle,
    /// While paused: publish the next message.
    Next,
    /// Set the rate.
    Rate(f64),
    /// A little faster.
    Faster,
    /// A little slower.
    Slower,
    /// End.
    End,
}

/// What was played.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Played {
    /// Messages that the middleware took.
    pub messages: u64,
    /// Messages that it did not take.
    pub unsent: u64,
}

/// Answer of the services.
#[derive(Clone, Copy, Debug)]
struct State {
    paused: bool,
    rate: f64,
}

/// Bag time against wall time. The time of the wall is passed in.
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

    /// Time of the bag at a moment of the wall.
    fn bag_time(&self, wall: Instant) -> Duration {
        let State { paused, rate } = self.state();
        if paused {
            return self.bag;
        }
        self.bag + wall.saturating_duration_since(self.wall).mul_f64(rate)
    }

    /// When a time of the bag comes; never while paused.
    fn when(&self, time: Duration) -> Option<Instant> {
        let State { paused, rate } = self.state();
        let wait = time.saturating_sub(self.bag).div_f64(rate);
        (!paused).then(|| self.wall + wait)
    }

    /// Changes the state from a moment of the wall on.
    fn change(&mut self, wall: Instant, change: impl FnOnce(&mut State)) {
        self.jump(wall, self.bag_time(wall));
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        change(&mut state);
    }

    /// Goes on from a time of the bag.
    fn jump(&mut self, wall: Instant, bag: Duration) {
        (self.wall, self.bag) = (wall, bag);
    }
}

/// The publishers of the topics that are played.
struct Publishers {
    by_topic: BTreeMap<String, RawPublisher>,
    played: Played,
}

impl Publishers {
    fn publish(&mut self, message: RawMessage) {
        if let Some(publisher) = self.by_topic.get(&message.topic.name) {
            if publisher.publish(message.data) {
                self.played.messages += 1;
            } else {
                self.played.unsent += 1;
            }
        }
    }

    /// Waits until every subscriber has acknowledged the last messages, then removes the publishers.
    async fn close(self) -> Result<Played> {
        let publishers = self.by_topic;
        let acknowledged = tokio::task::spawn_blocking(move || {
            publishers
                .values()
                .all(|publisher| publisher.wait_until_heard(ACKNOWLEDGEMENT_TIMEOUT))
        });
        if !acknowledged
            .await
            .map_err(|_| TransportError::Panicked("acknowledgements"))?
        {
            tracing::warn!("not every subscription has acknowledged the last messages");
        }
        Ok(self.played)
    }
}

/// Publishes a bag. It has the services of rosbag2's player under the name of its node.
pub struct Player {
    bag: BagReader,
    options: PlayerOptions,
    topics: Vec<Topic>,
    /// Times of the bag that are played.
    begin: Duration,
    end: Duration,
    node: Node,
    publishers: Publishers,
    clock: Option<RawPublisher>,
    pace: Pace,
    orders: mpsc::UnboundedSender<Order>,
    asked: mpsc::UnboundedReceiver<Order>,
}

impl Player {
    /// Opens a bag (a folder, or a single file), and makes the publishers and services on `node`.
    ///
    /// # Errors
    /// Options out of range, a bag that cannot be read, or no message on any chosen topic.
    pub fn open(node: &Node, bag: &Path, options: PlayerOptions) -> Result<Self> {
        let range = |option, value: String, ok: bool, expected: String| {
            ok.then_some(()).ok_or(TransportError::Option {
                option,
                value,
                expected,
            })
        };
        let rate_fits = options.rate.is_finite() && options.rate > 0.0;
        let expected = "a number above 0".to_owned();
        range("rate", options.rate.to_string(), rate_fits, expected)?;
        if let Some(hz) = options.clock_hz {
            let expected = format!("a rate above 0 and at most {MAX_CLOCK_HZ} Hz");
            let fits = hz > 0.0 && hz <= MAX_CLOCK_HZ;
            range("clock", format!("{hz} Hz"), fits, expected)?;
        }
        let bag = BagReader::open(bag)?;
        let topics = chosen(&bag, &options)?;
        let Some((first, last)) = bag.span() else {
            return Err(nothing_to_play(&bag, "holds no message"));
        };
        let begin = first + options.start;
        let start = format!("{} s", options.start.as_secs_f64());
        let length_s = (last - first).as_secs_f64();
        let expected = format!(
            "at most the {length_s:.3} s that {} lasts",
            bag.path().display()
        );
        range("start", start, begin <= last, expected)?;
        let end = match options.duration {
            Some(duration) => begin + duration,
            None => last + Duration::from_nanos(1),
        };
        let mut by_topic = BTreeMap::new();
        for topic in &topics {
            let publisher = node.raw_publisher(&topic.name, &topic.type_name, offered(topic))?;
            by_topic.insert(topic.name.clone(), publisher);
        }
        let (orders, asked) = mpsc::unbounded_channel();
        let state = Arc::new(Mutex::new(State {
            paused: options.paused,
            rate: options.rate,
        }));
        serve(node, &orders, &state)?;
        let clock_qos = RawQos {
            reliable: false,
            transient_local: false,
            depth: 8,
        };
        let clock = options
            .clock_hz
            .map(|_| node.raw_publisher("/clock", Clock::TYPE_NAME, clock_qos))
            .transpose()?;
        Ok(Self {
            bag,
            topics,
            begin,
            end,
            node: node.clone(),
            publishers: Publishers {
                by_topic,
                played: Played {
                    messages: 0,
                    unsent: 0,
                },
            },
            clock,
            pace: Pace {
                state,
                wall: Instant::now(),
                bag: begin,
            },
            orders,
            asked,
            options,
        })
    }

    /// Where to send orders.
    pub fn orders(&self) -> mpsc::UnboundedSender<Order> {
        self.orders.clone()
    }

    /// Plays until the end of the bag, [`Order::End`], or until `stop` completes.
    pub async fn play(mut self, stop: impl Future<Output = ()>) -> Result<Played> {
        if !self.options.wait.is_zero() {
            let publishers = self.publishers.by_topic.values();
            let names: Vec<String> = publishers
                .map(|publisher| publisher.topic().to_owned())
                .collect();
            let graph = self.node.graph();
            for topic in graph
                .wait_for_subscriptions(&names, self.options.wait)
                .await
            {
                tracing::warn!("nobody subscribes to {topic}");
            }
        }
        let played = tokio::select! {
            played = self.passes() => played,
            () = stop => Ok(()),
        };
        let count = self.publishers.close().await?;
        played?;
        Ok(count)
    }

    /// Plays once, or again and again.
    async fn passes(&mut self) -> Result<()> {
        loop {
            self.pace.jump(Instant::now(), self.begin);
            self.publish_latched_before_begin()?;
            let asked_to_end = !self.pass().await?;
            if asked_to_end || !self.options.repeat {
                return Ok(());
            }
        }
    }

    /// Plays from begin to end. `false`: somebody asked for the end.
    async fn pass(&mut self) -> Result<bool> {
        let mut messages = read_ahead(&self.bag, &self.topics, self.begin, self.end);
        let tick = Duration::from_secs_f64(1.0 / self.options.clock_hz.unwrap_or(1.0));
        let mut ticks = tokio::time::interval(tick);
        ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        while let Some(message) = messages.recv().await {
            let message = message?;
            loop {
                let due = self.pace.when(message.log_time);
                tokio::select! {
                    biased;
                    order = self.asked.recv() => match order {
                        Some(Order::End) => return Ok(false),
                        Some(Order::Next) if self.pace.state().paused => {
                            self.pace.jump(Instant::now(), message.log_time);
                            break;
                        }
                        Some(order) => obey(order, &mut self.pace, Instant::now()),
                        None => {}
                    },
                    _ = ticks.tick(), if self.clock.is_some() => {
                        if let Some(clock) = &self.clock {
                            publish_clock(clock, self.pace.bag_time(Instant::now()));
                        }
                    }
                    () = when(due.map(sleep_until)) => break,
                }
            }
            self.publishers.publish(message);
        }
        Ok(true)
    }

    /// What latched topics held where the play begins: of each topic the last message, of transforms all.
    fn publish_latched_before_begin(&mut self) -> Result<()> {
        for topic in self
            .topics
            .iter()
            .filter(|topic| offered(topic).transient_local)
        {
            if topic.type_name == TFMessage::TYPE_NAME {
                let before = self
                    .bag
                    .messages_between(&[&topic.name], Duration::ZERO, self.begin);
                for message in before {
                    self.publishers.publish(message?);
                }
            } else if let Some(message) = self.bag.last_before(&topic.name, self.begin)? {
                self.publishers.publish(message);
            }
        }
        Ok(())
    }
}

fn nothing_to_play(bag: &BagReader, reason: impl Into<String>) -> TransportError {
    TransportError::NothingToPlay {
        bag: bag.path().to_owned(),
        reason: reason.into(),
    }
}

/// The topics of the bag that the options choose and that have messages.
fn chosen(bag: &BagReader, options: &PlayerOptions) -> Result<Vec<Topic>> {
    for name in &options.topics {
        if !bag.topics().iter().any(|topic| topic.name == *name) {
            return Err(nothing_to_play(bag, format!("has no topic {name}")));
        }
    }
    let some = !options.topics.is_empty() || !options.patterns.is_empty();
    let chosen = bag.topics().iter().filter(|topic| {
        let named = options.topics.contains(&topic.name) || options.patterns.is_match(&topic.name);
        let clock = options.clock_hz.is_some() && topic.type_name == Clock::TYPE_NAME;
        (named || !some)
            && !options.exclude.is_match(&topic.name)
            && !clock
            && topic.message_count > 0
    });
    let chosen: Vec<Topic> = chosen.cloned().collect();
    if chosen.is_empty() {
        return Err(nothing_to_play(
            bag,
            "no message on any topic that was chosen",
        ));
    }
    if let Some(topic) = chosen.iter().find(|topic| topic.message_encoding != "cdr") {
        let (name, encoding) = (&topic.name, &topic.message_encoding);
        let reason = format!(
            "messages of topic {name} are {encoding:?}, expected \"cdr\"; leave it out with --exclude"
        );
        return Err(nothing_to_play(bag, reason));
    }
    Ok(chosen)
}

fn obey(order: Order, pace: &mut Pace, wall: Instant) {
    pace.change(wall, |state| match order {
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

fn publish_clock(clock: &RawPublisher, now: Duration) {
    let stamp: Time = stamp_from_ns(i64::try_from(now.as_nanos()).unwrap_or(i64::MAX));
    match to_cdr(&Clock { clock: stamp }) {
        Ok(bytes) => {
            clock.publish(bytes);
        }
        Err(error) => tracing::error!("/clock: {error}"),
    }
}

/// Messages in order of their times, read by a thread of its own.
fn read_ahead(
    bag: &BagReader,
    topics: &[Topic],
    begin: Duration,
    end: Duration,
) -> mpsc::Receiver<Result<RawMessage, BagError>> {
    let (sender, receiver) = mpsc::channel(READ_AHEAD);
    let path = bag.path().to_owned();
    let names: Vec<String> = topics.iter().map(|topic| topic.name.clone()).collect();
    // Opened again: a bag's reader stays on its thread.
    std::thread::spawn(move || {
        let read = || -> Result<(), BagError> {
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
            (true, false) if LARGE_TYPES.contains(&topic.type_name.as_str()) => 32,
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bag_time_follows_the_rate_and_stands_still_while_paused() {
        let start = Instant::now();
        let at = |seconds| start + Duration::from_secs(seconds);
        let bag = Duration::from_secs;
        let state = State {
            paused: false,
            rate: 2.0,
        };
        let mut pace = Pace {
            state: Arc::new(Mutex::new(state)),
            wall: start,
            bag: bag(100),
        };
        assert_eq!(pace.when(bag(110)), Some(at(5)));
        assert_eq!(pace.bag_time(at(1)), bag(102));
        obey(Order::Pause(true), &mut pace, at(1));
        assert_eq!(pace.bag_time(at(2)), bag(102));
        assert_eq!(pace.when(bag(103)), None);
        obey(Order::Rate(0.5), &mut pace, at(2));
        obey(Order::Toggle, &mut pace, at(2));
        assert_eq!(pace.bag_time(at(4)), bag(103));
    }
}
