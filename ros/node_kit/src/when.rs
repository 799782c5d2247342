//! Waiting for something that may not be there.

use std::future::{Future, pending};

/// Waits for something that may not be there: then for ever. For a branch of `select!`.
pub async fn when<T>(something: Option<impl Future<Output = T>>) -> T {
    match something {
        Some(something) => something.await,
        None => pending().await,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use futures::FutureExt as _;
    use std::future::ready;

    #[test]
    fn what_is_there_is_waited_for_and_what_is_not_never_comes() {
        assert_eq!(when(Some(ready(7))).now_or_never(), Some(7));
        assert_eq!(when(Some(pending::<i32>())).now_or_never(), None);
        assert_eq!(when(None::<std::future::Ready<i32>>).now_or_never(), None);
    }
}
