//! The player's services, which are those of rosbag2's: over real DDS, on a domain of its own.

use anyhow::{Context as _, Result};
use bags::{BagWriter, Compression, Qos};
use msgs::{Service, rosbag2_interfaces as services, std_msgs};
use node_kit::{CallOptions, Context, Network, NoParameters, Node, RosArguments, Subscription};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

/// Killed when the test ends, however it ends.
struct Player(Child);

impl Drop for Player {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

async fn call<S: Service + 'static>(
    node: &Node,
    name: &str,
    request: S::Request,
) -> Result<S::Response> {
    let client = node.service_client::<S>(&format!("/rosbag2_player/{name}"))?;
    client.wait_for_server(Duration::from_secs(60)).await?;
    Ok(client.call(&request, &CallOptions::default()).await?)
}

async fn next(texts: &mut Subscription<std_msgs::String>) -> Result<String> {
    let text = tokio::time::timeout(Duration::from_secs(60), texts.recv()).await;
    Ok(text.context("no message")?.data)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_paused_player_goes_message_by_message_and_on_when_told() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let bag = folder.path().join("bag");
    let mut writer = BagWriter::create(&bag, Compression::None)?;
    let topic = writer.add::<std_msgs::String>("/chatter", Qos::LATCHED)?;
    for second in 0..4u64 {
        let data = second.to_string();
        // The last one is an hour off, at the recorded rate.
        let time = Duration::from_secs(if second == 3 { 3600 } else { second });
        writer.write(topic, time, &std_msgs::String { data })?;
    }
    writer.finish()?;

    let network = Network::unused()?;
    let context = Context::new(network);
    let (node, _) = context.node::<NoParameters>("tester", &RosArguments::default())?;
    let mut texts = node.subscription::<std_msgs::String>("/chatter", node_kit::Qos::Latched)?;
    let player = Command::new(env!("CARGO_BIN_EXE_sctn"))
        .args(["bag", "play", "--paused", "--wait", "60"])
        .arg(&bag)
        .env("ROS_DOMAIN_ID", network.domain_id.to_string())
        .env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        .stdin(Stdio::null())
        .spawn()?;
    let mut player = Player(player);

    assert!(
        call::<services::IsPaused>(&node, "is_paused", Default::default())
            .await?
            .paused
    );
    for expected in ["0", "1"] {
        assert!(
            call::<services::PlayNext>(&node, "play_next", Default::default())
                .await?
                .success
        );
        assert_eq!(next(&mut texts).await?, expected);
    }
    let refused =
        call::<services::SetRate>(&node, "set_rate", services::SetRateRequest { rate: 0.0 });
    assert!(!refused.await?.success);
    let set =
        call::<services::SetRate>(&node, "set_rate", services::SetRateRequest { rate: 2000.0 });
    assert!(set.await?.success);
    // At this rate the next one would have come.
    assert!(
        call::<services::IsPaused>(&node, "is_paused", Default::default())
            .await?
            .paused
    );
    assert!(texts.try_recv().is_none(), "it is paused");
    call::<services::Resume>(&node, "resume", Default::default()).await?;
    assert_eq!(next(&mut texts).await?, "2");
    assert_eq!(next(&mut texts).await?, "3");
    assert!(player.0.wait()?.success());
    context.shutdown();
    Ok(())
}
