//! Who watches, and who of them decides. No clock, no network.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::Serialize;

use crate::refusal::Refusal;

/// A person whose page has shown no sign for this long is not present.
pub const PRESENCE_TIMEOUT: Duration = Duration::from_secs(1);
/// Longest name [characters].
const LONGEST_NAME: usize = 40;

/// Number of a viewer; never given twice.
pub type ViewerId = u64;

/// A person or program that is connected.
#[derive(Clone, Debug)]
struct Viewer {
    name: String,
    /// Secret that this viewer alone knows.
    key: String,
    /// Last sign, from any monotonic origin.
    heard: Duration,
    /// Whether its page is visible.
    visible: bool,
}

/// What others see of a viewer.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct ViewerState {
    /// Its number.
    pub id: ViewerId,
    /// Its name.
    pub name: String,
    /// Whether it is the operator.
    pub operator: bool,
    /// Whether its page is visible and its link is alive.
    pub present: bool,
}

/// The viewers and the one operator.
#[derive(Debug)]
pub struct Sessions {
    max_viewers: usize,
    timeout: Duration,
    viewers: BTreeMap<ViewerId, Viewer>,
    next: ViewerId,
    operator: Option<ViewerId>,
}

impl Sessions {
    /// Nobody is there. Viewers without a sign for `timeout` leave.
    pub fn new(max_viewers: usize, timeout: Duration) -> Self {
        Self {
            max_viewers,
            timeout,
            viewers: BTreeMap::new(),
            next: 1,
            operator: None,
        }
    }

    /// A viewer comes; `key` is the secret it has to show from now on.
    ///
    /// # Errors
    /// When the name is empty or too long, or there are too many viewers.
    pub fn join(&mut self, name: &str, key: String, now: Duration) -> Result<ViewerId, Refusal> {
        let name = name.trim();
        let length = name.chars().count();
        if !(1..=LONGEST_NAME).contains(&length) || name.chars().any(char::is_control) {
            return Err(Refusal::new(
                format!("A name has 1 to {LONGEST_NAME} characters, without control characters."),
                "Type your name: it is written into the record of the run.",
            ));
        }
        if self.viewers.len() >= self.max_viewers {
            return Err(Refusal::new(
                format!(
                    "{} people are connected, which is the most.",
                    self.max_viewers
                ),
                "Close another page of this console, or raise its parameter max_viewers.",
            ));
        }
        let id = self.next;
        self.next += 1;
        self.viewers.insert(
            id,
            Viewer {
                name: name.to_owned(),
                key,
                heard: now,
                visible: true,
            },
        );
        Ok(id)
    }

    /// The viewer whose key this is.
    pub fn find(&self, key: &str) -> Option<ViewerId> {
        let same = |viewer: &Viewer| {
            subtle::ConstantTimeEq::ct_eq(viewer.key.as_bytes(), key.as_bytes()).into()
        };
        let mut known = self.viewers.iter();
        known.find(|(_, viewer)| same(viewer)).map(|(id, _)| *id)
    }

    /// A sign of life.
    pub fn heard(&mut self, id: ViewerId, visible: bool, now: Duration) {
        if let Some(viewer) = self.viewers.get_mut(&id) {
            viewer.heard = now;
            viewer.visible = visible;
        }
    }

    /// A viewer leaves. Whether somebody left.
    pub fn leave(&mut self, id: ViewerId) -> bool {
        if self.operator == Some(id) {
            self.operator = None;
        }
        self.viewers.remove(&id).is_some()
    }

    /// Forgets viewers that have shown no sign for too long. Whether there was one.
    pub fn expire(&mut self, now: Duration) -> bool {
        let before = self.viewers.len();
        let timeout = self.timeout;
        self.viewers
            .retain(|_, viewer| now.saturating_sub(viewer.heard) <= timeout);
        if let Some(id) = self.operator
            && !self.viewers.contains_key(&id)
        {
            self.operator = None;
        }
        self.viewers.len() != before
    }

    /// Takes control. `from` is the operator whom it is taken from, or nothing where nobody decides: nobody takes over from
    /// somebody whom they have not seen.
    ///
    /// # Errors
    /// When somebody else decides than was named.
    pub fn take(&mut self, id: ViewerId, from: Option<ViewerId>) -> Result<(), Refusal> {
        if self.operator == Some(id) {
            return Ok(());
        }
        if self.operator != from {
            let who = match self.operator {
                Some(operator) => format!("{} decides now.", self.name(operator)),
                None => "Nobody decides any more.".to_owned(),
            };
            return Err(Refusal::new(
                who,
                "Look who decides, and take control again if you mean to.",
            ));
        }
        self.operator = Some(id);
        Ok(())
    }

    /// The operator gives control to another viewer, or to nobody.
    ///
    /// # Errors
    /// When `id` is not the operator, or `to` is not connected.
    pub fn hand_over(&mut self, id: ViewerId, to: Option<ViewerId>) -> Result<(), Refusal> {
        self.check_operator(id)?;
        if let Some(to) = to
            && !self.viewers.contains_key(&to)
        {
            return Err(Refusal::new(
                "That person is not connected any more.",
                "Choose somebody who is in the list of people.",
            ));
        }
        self.operator = to;
        Ok(())
    }

    /// Checks that this viewer decides.
    ///
    /// # Errors
    /// Says who decides.
    pub fn check_operator(&self, id: ViewerId) -> Result<(), Refusal> {
        match self.operator {
            Some(operator) if operator == id => Ok(()),
            Some(operator) => Err(Refusal::new(
                format!("{} decides, not you.", self.name(operator)),
                "Ask them to hand over, or take control.",
            )),
            None => Err(Refusal::new(
                "Nobody decides: you are watching.",
                "Take control first.",
            )),
        }
    }

    /// Who decides.
    pub fn operator(&self) -> Option<ViewerId> {
        self.operator
    }

    /// The operator's name, and whether they are present.
    pub fn presence(&self, now: Duration) -> Option<(&str, bool)> {
        let viewer = self.viewers.get(&self.operator?)?;
        Some((&viewer.name, viewer.is_present(now)))
    }

    /// A viewer's name.
    pub fn name(&self, id: ViewerId) -> &str {
        self.viewers.get(&id).map_or("", |viewer| &viewer.name)
    }

    /// Everybody, by number.
    pub fn states(&self, now: Duration) -> Vec<ViewerState> {
        let viewers = self.viewers.iter();
        viewers
            .map(|(id, viewer)| ViewerState {
                id: *id,
                name: viewer.name.clone(),
                operator: self.operator == Some(*id),
                present: viewer.is_present(now),
            })
            .collect()
    }
}

impl Viewer {
    fn is_present(&self, now: Duration) -> bool {
        self.visible && now.saturating_sub(self.heard) <= PRESENCE_TIMEOUT
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const START: Duration = Duration::ZERO;

    fn two() -> (Sessions, ViewerId, ViewerId) {
        let mut sessions = Sessions::new(3, Duration::from_secs(60));
        let ada = sessions.join("Ada", "key of Ada".into(), START).unwrap();
        let bob = sessions.join(" Bob ", "key of Bob".into(), START).unwrap();
        (sessions, ada, bob)
    }

    #[test]
    fn one_viewer_at_a_time_decides_and_control_changes_only_explicitly() {
        let (mut sessions, ada, bob) = two();
        assert!(sessions.check_operator(ada).is_err(), "nobody decides yet");
        sessions.take(ada, None).unwrap();
        sessions.check_operator(ada).unwrap();
        let refusal = sessions.take(bob, None).unwrap_err();
        assert!(refusal.reason.contains("Ada"), "{refusal:?}");
        sessions.take(bob, Some(ada)).unwrap();
        assert!(sessions.check_operator(ada).is_err());
        let refusal = sessions.hand_over(ada, Some(ada)).unwrap_err();
        assert!(refusal.reason.contains("Bob"), "{refusal:?}");
        sessions.hand_over(bob, Some(ada)).unwrap();
        assert_eq!(sessions.operator(), Some(ada));
        assert!(sessions.hand_over(ada, Some(99)).is_err());
        sessions.hand_over(ada, None).unwrap();
        assert_eq!(sessions.operator(), None);
    }

    #[test]
    fn two_who_take_at_once_do_not_both_get_control() {
        let (mut sessions, ada, bob) = two();
        // Both saw that nobody decides.
        sessions.take(ada, None).unwrap();
        assert!(sessions.take(bob, None).is_err());
        assert_eq!(sessions.operator(), Some(ada));
    }

    #[test]
    fn who_sleeps_hides_or_is_silent_is_not_present_and_leaves_after_the_timeout() {
        let (mut sessions, ada, bob) = two();
        sessions.take(ada, None).unwrap();
        let second = Duration::from_secs(1);
        assert_eq!(sessions.presence(second), Some(("Ada", true)));
        assert_eq!(sessions.presence(2 * second), Some(("Ada", false)));
        sessions.heard(ada, false, 2 * second);
        assert_eq!(sessions.presence(2 * second), Some(("Ada", false)));
        sessions.heard(ada, true, 3 * second);
        assert_eq!(sessions.presence(3 * second), Some(("Ada", true)));
        sessions.heard(bob, true, 60 * second);
        assert!(sessions.expire(64 * second));
        assert_eq!(sessions.operator(), None);
        assert_eq!(sessions.states(64 * second).len(), 1);
    }

    #[test]
    fn names_are_short_and_printable_and_viewers_few() {
        let (mut sessions, ..) = two();
        for name in ["", "   ", "a\nb", &"x".repeat(41)] {
            assert!(
                sessions.join(name, "key".into(), START).is_err(),
                "{name:?}"
            );
        }
        sessions.join("Eve", "key of Eve".into(), START).unwrap();
        let refusal = sessions.join("Mallory", "key".into(), START).unwrap_err();
        assert!(refusal.reason.contains("3 people"), "{refusal:?}");
        assert_eq!(sessions.find("key of Eve"), Some(3));
        assert_eq!(sessions.find("key of Mallory"), None);
    }
}
