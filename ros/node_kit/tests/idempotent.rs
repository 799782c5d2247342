//! A service whose requests are carried out once each, over real DDS on loopback.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use msgs::sctn_msgs::{ResetCell, ResetCellRequest, ResetCellResponse};
use node_kit::{
    CallOptions, Context, IdempotentServer, Network, NoParameters, Node, ReplyCache, RosArguments,
    ServiceClient,
};

const LIMIT: Duration = Duration::from_secs(60);

fn node(context: &Context, name: &str) -> Node {
    let node = context.node::<NoParameters>(name, &RosArguments::default());
    node.unwrap().0
}

fn not_reset(message: String) -> ResetCellResponse {
    ResetCellResponse {
        message,
        ..Default::default()
    }
}

/// Answers each request with its number; those of seed 0 it cannot carry out now.
async fn count_resets(mut server: IdempotentServer<ResetCell>, count: Arc<AtomicU32>) {
    loop {
        let (call, request) = server.recv(not_reset).await;
        let number = count.fetch_add(1, Ordering::Relaxed) + 1;
        let answer = not_reset(number.to_string());
        match request.seed {
            0 => server.respond_for_now(call, answer),
            _ => server.respond(call, answer),
        }
    }
}

async fn reset(
    client: &ServiceClient<ResetCell>,
    request_id: &str,
    seed: u64,
    attempts: u32,
) -> String {
    let options = CallOptions {
        attempts,
        timeout: LIMIT / attempts,
    };
    let request = ResetCellRequest {
        request_id: request_id.into(),
        seed,
        ..Default::default()
    };
    client.call(&request, &options).await.unwrap().message
}

#[tokio::test(flavor = "multi_thread")]
async fn a_request_that_comes_again_is_carried_out_once_also_by_a_server_of_later() {
    let network = Network::unused().unwrap();
    let (serving, calling) = (Context::new(network), Context::new(network));
    let server = node(&serving, "server");
    let (replies, count) = (ReplyCache::default(), Arc::new(AtomicU32::new(0)));
    let start = || {
        let service = server.idempotent_server::<ResetCell>("reset", &replies);
        server.spawn(count_resets(service.unwrap(), Arc::clone(&count)))
    };
    let first = start();
    let client = node(&calling, "client").service_client("reset").unwrap();
    client.wait_for_server(LIMIT).await.unwrap();
    // Both ends may still be discovering each other.
    assert_eq!(reset(&client, "a", 1, 60).await, "1");
    assert_eq!(reset(&client, "a", 1, 1).await, "1");
    assert_eq!(reset(&client, "b", 0, 1).await, "2");
    assert_eq!(reset(&client, "b", 0, 1).await, "3");
    let refused = reset(&client, "", 1, 1).await;
    assert!(refused.starts_with("request_id is"), "{refused}");
    first.abort();
    let _ = first.await;
    let _second = start();
    // The client may not know the second server yet.
    assert_eq!(reset(&client, "a", 1, 60).await, "1");
    assert_eq!(count.load(Ordering::Relaxed), 3);
}
