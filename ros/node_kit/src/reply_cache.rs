//! Requests that are carried out once, however often they come: a reply can be lost, and a caller
//! that asks again must not do a thing twice.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Answers that are kept.
const ANSWERS: usize = 64;
/// Longest id of a request.
const MAX_ID: usize = 64;

/// The answers to the last requests of an [`IdempotentServer`](crate::IdempotentServer), by the ids that their callers chose. A node keeps
/// them while it is inactive and has no server; clones share them.
#[derive(Clone, Debug)]
pub struct ReplyCache<R> {
    answers: Arc<Mutex<VecDeque<(String, R)>>>,
}

/// A request without a proper id.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "request_id is {0:?}, expected 1 to {MAX_ID} printable ASCII characters, for instance a UUID"
)]
struct InvalidRequestId(String);

impl<R> Default for ReplyCache<R> {
    fn default() -> Self {
        Self {
            answers: Arc::default(),
        }
    }
}

impl<R: Clone> ReplyCache<R> {
    /// The answer of a request that needs no work: the earlier one where it has come before, a `refusal` that says why where its id is
    /// not valid. `None` where it is new.
    pub(crate) fn known(&self, request_id: &str, refusal: impl FnOnce(String) -> R) -> Option<R> {
        match self.answered(request_id) {
            Ok(answer) => answer,
            Err(invalid) => Some(refusal(invalid.to_string())),
        }
    }

    fn answered(&self, request_id: &str) -> Result<Option<R>, InvalidRequestId> {
        let good = |byte: u8| byte.is_ascii_graphic() || byte == b' ';
        if !(1..=MAX_ID).contains(&request_id.len()) || !request_id.bytes().all(good) {
            let shown = request_id.chars().take(MAX_ID).collect();
            return Err(InvalidRequestId(shown));
        }
        let answers = self.lock();
        let known = answers.iter().find(|(known, _)| known == request_id);
        Ok(known.map(|(_, answer)| answer.clone()))
    }

    /// Keeps an answer for when the request comes again.
    pub(crate) fn remember(&self, request_id: &str, answer: R) {
        let mut answers = self.lock();
        if answers.len() == ANSWERS {
            answers.pop_front();
        }
        answers.push_back((request_id.to_owned(), answer));
    }

    fn lock(&self) -> MutexGuard<'_, VecDeque<(String, R)>> {
        self.answers.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_that_comes_again_has_the_same_answer_and_old_ones_are_forgotten() {
        let cache = ReplyCache::default();
        assert_eq!(cache.answered("a"), Ok(None));
        cache.remember("a", 1);
        assert_eq!(cache.clone().answered("a"), Ok(Some(1)));
        assert_eq!(cache.answered("b"), Ok(None));
        for number in 0..ANSWERS {
            cache.remember(&format!("later {number}"), 2);
        }
        assert_eq!(cache.answered("a"), Ok(None));
        assert_eq!(cache.lock().len(), ANSWERS);
    }

    #[test]
    fn an_id_that_is_none_is_refused() {
        let cache = ReplyCache::<u8>::default();
        for id in ["", "a\nb", "\u{1}", "größer", &"x".repeat(MAX_ID + 1)] {
            let error = cache.answered(id).unwrap_err().to_string();
            assert!(error.contains("request_id"), "{error}");
            assert_eq!(cache.known(id, |_| 7), Some(7));
        }
    }
}
