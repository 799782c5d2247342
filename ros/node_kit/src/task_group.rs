//! Tasks that outlive a node's active and configured states.

use std::future::Future;

use tokio_util::sync::{CancellationToken, DropGuard};
use tracing::Instrument;

/// Background tasks that end when this is dropped, not when the node is deactivated or told to end: for what has to be brought to its
/// end first, as a robot that has to be stopped and watched until it rests. Made by [`Node::task_group`](crate::Node::task_group).
#[derive(Debug)]
pub struct TaskGroup {
    span: tracing::Span,
    end: DropGuard,
}

impl TaskGroup {
    pub(crate) fn new(span: tracing::Span) -> Self {
        let end = CancellationToken::new().drop_guard();
        Self { span, end }
    }

    /// Runs a task in the node's span until it ends or the group is dropped.
    pub fn spawn(&self, task: impl Future<Output = ()> + Send + 'static) {
        let end = self.end.token().clone();
        let task = async move {
            end.run_until_cancelled(task).await;
        };
        tokio::spawn(task.instrument(self.span.clone()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::sync::oneshot;

    #[tokio::test]
    async fn a_task_ends_with_its_group() {
        let group = TaskGroup::new(tracing::Span::none());
        let (alive, ended) = oneshot::channel::<()>();
        group.spawn(async move {
            std::future::pending::<()>().await;
            drop(alive);
        });
        drop(group);
        assert!(ended.await.is_err());
    }
}
