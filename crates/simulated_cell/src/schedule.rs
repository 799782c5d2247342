//! When the driver and the cameras of a cell publish, and how fast simulated time runs beside the wall clock's.

use std::time::{Duration, Instant};

/// A client that sends commands reads the status; so long after the last command the status is published less often.
const ATTENTIVE: Duration = Duration::from_secs(1);
/// Factor of the status period while no client sends commands.
const INATTENTIVE_FACTOR: u32 = 5;
/// Simulated time between feedback messages, as the driver's controllers have it.
const FEEDBACK_PERIOD: Duration = Duration::from_millis(50);

/// When joints, pins and camera images are published next, by the wall clock.
#[derive(Clone, Copy, Debug)]
pub struct PublishSchedule {
    last_command: Instant,
    /// Joints and clock.
    status: Instant,
    pins: Instant,
    frames: Instant,
}

impl PublishSchedule {
    /// All of it now.
    pub fn new(now: Instant) -> Self {
        Self {
            last_command: now,
            status: now,
            pins: now,
            frames: now,
        }
    }

    /// A command has ended: whoever has sent it reads the status, each `period` from now on.
    pub fn on_command(&mut self, now: Instant, period: Duration) {
        self.last_command = now;
        self.status = self.status.min(now + period);
        self.pins = self.pins.min(now + period);
    }

    /// The driver was started again: the status is due.
    pub fn on_restart(&mut self, now: Instant) {
        self.status = now;
    }

    /// Joints and clock were published, which have this period while commands come.
    pub fn on_status(&mut self, now: Instant, period: Duration) {
        self.status = now + self.status_period(now, period);
    }

    /// The pins were published.
    pub fn on_pins(&mut self, now: Instant, period: Duration) {
        self.pins = now + self.status_period(now, period);
    }

    /// Images were published; the next ones are due after so long.
    pub fn on_frames(&mut self, now: Instant, after: Duration) {
        self.frames = now + after;
    }

    /// The cameras were to take images, and do so again after so long, however long something else took.
    pub fn on_shutter(&mut self, now: Instant, period: Duration) {
        self.frames = (self.frames + period).max(now);
    }

    fn status_period(&self, now: Instant, period: Duration) -> Duration {
        match now.saturating_duration_since(self.last_command) > ATTENTIVE {
            true => INATTENTIVE_FACTOR * period,
            false => period,
        }
    }

    /// Whether joints and clock are due.
    pub fn is_status_due(&self, now: Instant) -> bool {
        now >= self.status
    }

    /// Whether the pins are due.
    pub fn are_pins_due(&self, now: Instant) -> bool {
        now >= self.pins
    }

    /// Whether images are due.
    pub fn are_frames_due(&self, now: Instant) -> bool {
        now >= self.frames
    }

    /// When the first of them is due.
    pub fn next(&self) -> Instant {
        self.status.min(self.pins).min(self.frames)
    }
}

/// What is published of a motion as simulated time goes on.
#[derive(Clone, Copy, Debug)]
pub struct MotionTicks {
    begin: Duration,
    rate_hz: f64,
    /// Ticks of the joint states until now.
    ticks: u64,
    next_feedback: Duration,
}

impl MotionTicks {
    /// Of a motion that begins; joint states come at a rate of simulated time.
    pub fn new(begin: Duration, rate_hz: f64) -> Self {
        let mut ticks = Self {
            begin,
            rate_hz,
            ticks: 0,
            next_feedback: begin + FEEDBACK_PERIOD,
        };
        ticks.are_states_due(begin);
        ticks
    }

    /// Whether joint states are due, once for each tick.
    pub fn are_states_due(&mut self, time: Duration) -> bool {
        let ticks = (time.as_secs_f64() * self.rate_hz) as u64;
        let before = std::mem::replace(&mut self.ticks, ticks);
        ticks != before
    }

    /// How long the motion lasts, where feedback is due.
    pub fn feedback(&mut self, time: Duration) -> Option<Duration> {
        (time >= self.next_feedback).then(|| {
            self.next_feedback += FEEDBACK_PERIOD;
            time - self.begin
        })
    }
}

/// Keeps simulated time from running ahead of the wall clock's.
#[derive(Clone, Copy, Debug)]
pub struct Pace {
    /// Wall clock and simulated time at the beginning.
    begin: (Instant, Duration),
}

impl Pace {
    /// Both begin now.
    pub fn new(now: Instant, time: Duration) -> Self {
        Self { begin: (now, time) }
    }

    /// How long to wait at a simulated time that is to run at most `factor` times as fast as the wall clock's; 0 for as fast as it can.
    pub fn wait(&self, now: Instant, time: Duration, factor: f64) -> Duration {
        if factor <= 0.0 {
            return Duration::ZERO;
        }
        let due = time.saturating_sub(self.begin.1).div_f64(factor);
        due.saturating_sub(now.saturating_duration_since(self.begin.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: Duration = Duration::from_millis(20);

    #[test]
    fn the_status_comes_five_times_as_often_while_commands_do() {
        let start = Instant::now();
        let mut schedule = PublishSchedule::new(start);
        assert!(schedule.is_status_due(start) && schedule.next() == start);
        let late = start + Duration::from_secs(2);
        schedule.on_status(late, PERIOD);
        schedule.on_pins(late, PERIOD);
        schedule.on_frames(late, 100 * PERIOD);
        assert_eq!(schedule.next(), late + 5 * PERIOD);
        // Whoever sends a command is not kept waiting for what it has changed.
        let command = late + PERIOD / 2;
        schedule.on_command(command, PERIOD);
        assert_eq!(schedule.next(), command + PERIOD);
        assert!(!schedule.are_pins_due(command) && schedule.are_pins_due(command + PERIOD));
        schedule.on_status(command + PERIOD, PERIOD);
        assert!(schedule.is_status_due(command + 2 * PERIOD));
    }

    #[test]
    fn cameras_take_images_in_time_and_do_not_make_up_for_those_that_they_left_out() {
        let start = Instant::now();
        let mut schedule = PublishSchedule::new(start);
        schedule.on_shutter(start + PERIOD / 4, PERIOD);
        assert!(!schedule.are_frames_due(start + PERIOD / 2));
        assert!(schedule.are_frames_due(start + PERIOD));
        schedule.on_shutter(start + 9 * PERIOD, PERIOD);
        assert!(!schedule.are_frames_due(start + 8 * PERIOD));
        assert!(schedule.are_frames_due(start + 9 * PERIOD));
    }

    #[test]
    fn joint_states_come_at_their_rate_and_feedback_each_50_ms_of_simulated_time() {
        let millis = Duration::from_millis;
        let mut ticks = MotionTicks::new(millis(1000), 100.0);
        let due = |ticks: &mut MotionTicks, ms| ticks.are_states_due(millis(ms));
        assert!(!due(&mut ticks, 1005) && due(&mut ticks, 1012) && !due(&mut ticks, 1015));
        assert_eq!(ticks.feedback(millis(1049)), None);
        assert_eq!(ticks.feedback(millis(1052)), Some(millis(52)));
        assert_eq!(ticks.feedback(millis(1052)), None);
        assert_eq!(ticks.feedback(millis(1100)), Some(millis(100)));
    }

    #[test]
    fn simulated_time_waits_for_the_wall_clock_and_not_the_other_way_round() {
        let (start, second) = (Instant::now(), Duration::from_secs(1));
        let pace = Pace::new(start, 10 * second);
        assert_eq!(pace.wait(start, 12 * second, 0.0), Duration::ZERO);
        assert_eq!(pace.wait(start, 12 * second, 1.0), 2 * second);
        assert_eq!(pace.wait(start, 12 * second, 4.0), second / 2);
        assert_eq!(
            pace.wait(start + 3 * second, 12 * second, 1.0),
            Duration::ZERO
        );
    }
}
