//! DDS security over real DDS on loopback: who is heard, and what is refused at start. The keystores are made by
//! `tests/keystore.sh` with openssl, in the layout of `ros2 security`.
#![cfg(feature = "security")]

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
    time::Duration,
};

use msgs::{
    sctn_msgs::{Heightmap, StepConfirmation},
    ur_msgs::{SetIO, SetIORequest, SetIOResponse},
};
use node_kit::{
    CallOptions, Context, Network, NoParameters, Node, Publisher, Qos, RosArguments, Subscription,
};
use tempfile::TempDir;
use tokio::time::{sleep, timeout};

const LIMIT: Duration = Duration::from_secs(60);
const EXECUTOR: &str = "/sctn/suction_executor";
const OPERATOR: &str = "/sctn/operator";

/// What every node needs, and all topics and services besides.
const ALL: &str =
    "<topic>ros_discovery_info</topic><topic>rt/*</topic><topic>rq/*</topic><topic>rr/*</topic>";

struct Keystore {
    folder: TempDir,
    network: Network,
}

impl Keystore {
    /// For a domain of its own.
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let network = Network::unused().unwrap();
        let domain = network.domain_id.to_string();
        run("create", &[folder.path().to_str().unwrap(), &domain], None);
        Self { folder, network }
    }

    fn path(&self) -> &str {
        self.folder.path().to_str().unwrap()
    }

    fn file(&self, enclave: &str, name: &str) -> PathBuf {
        self.folder.path().join(format!("enclaves{enclave}/{name}"))
    }

    /// An enclave that may do everything.
    fn enclave(&self, name: &str) {
        self.enclave_with(name, &permissions(name, self.network.domain_id, ""));
    }

    fn enclave_with(&self, name: &str, permissions: &str) {
        self.make(name, permissions, None);
    }

    fn make(&self, name: &str, permissions: &str, days: Option<&str>) {
        let file = self.folder.path().join("permissions.xml");
        fs::write(&file, permissions).unwrap();
        run(
            "enclave",
            &[self.path(), name, file.to_str().unwrap()],
            days,
        );
    }

    /// A signed governance document of its own for an enclave, made from that of all.
    fn change_governance(&self, enclave: &str, change: impl Fn(&str) -> String) {
        let common =
            fs::read_to_string(self.folder.path().join("enclaves/governance.xml")).unwrap();
        let changed = change(&common);
        assert_ne!(changed, common);
        let file = self.folder.path().join("governance.xml");
        fs::write(&file, changed).unwrap();
        run(
            "governance",
            &[self.path(), enclave, file.to_str().unwrap()],
            None,
        );
    }

    /// As the environment gives it to a node.
    fn context(&self) -> Context {
        let domain = self.network.domain_id.to_string();
        Context::from_variables(|name| {
            let value = match name {
                "ROS_DOMAIN_ID" => domain.as_str(),
                "ROS_AUTOMATIC_DISCOVERY_RANGE" => "LOCALHOST",
                "ROS_SECURITY_ENABLE" => "true",
                "ROS_SECURITY_STRATEGY" => "Enforce",
                "ROS_SECURITY_KEYSTORE" => self.path(),
                _ => return None,
            };
            Some(value.to_owned())
        })
        .unwrap()
    }

    fn node(&self, name: &str, enclave: &str) -> Node {
        self.try_node(name, enclave).expect("a protected node")
    }

    fn try_node(&self, name: &str, enclave: &str) -> anyhow::Result<Node> {
        let words = ["--ros-args", "--enclave", enclave].map(str::to_owned);
        let (arguments, _) = RosArguments::parse(words).unwrap();
        Ok(self.context().node::<NoParameters>(name, &arguments)?.0)
    }
}

fn run(what: &str, arguments: &[&str], days: Option<&str>) {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/keystore.sh");
    let mut command = Command::new(&script);
    command.arg(what).args(arguments);
    if let Some(days) = days {
        command.env("DAYS", days);
    }
    let output = command.output().expect("tests/keystore.sh");
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "keystore.sh {what}: {errors}");
}

/// A permissions document that allows everything but what `rules` say before.
fn permissions(enclave: &str, domain: u16, rules: &str) -> String {
    let domains = format!("<domains><id>{domain}</id></domains>");
    let rules = rules.replace("DOMAINS", &domains);
    format!(
        "<dds><permissions><grant name=\"{enclave}\"><subject_name>CN={enclave}</subject_name>\
         <validity><not_before>2020-01-01T00:00:00</not_before><not_after>2100-01-01T00:00:00</not_after></validity>{rules}\
         <allow_rule>{domains}<publish><topics>{ALL}</topics></publish><subscribe><topics>{ALL}</topics></subscribe></allow_rule>\
         <default>DENY</default></grant></permissions></dds>"
    )
}

/// Everything but to confirm a step.
fn permissions_without_confirmations(enclave: &str, domain: u16) -> String {
    let rule = "<deny_rule>DOMAINS<publish><topics><topic>rt/step_confirmation</topic></topics></publish></deny_rule>";
    permissions(enclave, domain, rule)
}

fn unprotected(network: Network, name: &str) -> Node {
    let arguments = RosArguments::default();
    let context = Context::new(network);
    context
        .node::<NoParameters>(name, &arguments)
        .expect("node")
        .0
}

fn confirmations(node: &Node) -> Subscription<StepConfirmation> {
    node.subscription("step_confirmation", Qos::Event).unwrap()
}

fn confirmation(proposal_id: u64) -> StepConfirmation {
    StepConfirmation {
        proposal_id,
        decision: StepConfirmation::APPROVE,
        ..StepConfirmation::default()
    }
}

/// Says it until it is heard.
async fn until_heard(
    publisher: &Publisher<StepConfirmation>,
    subscription: &mut Subscription<StepConfirmation>,
    id: u64,
) {
    let saying = async {
        loop {
            publisher.publish(confirmation(id));
            let heard = timeout(Duration::from_millis(200), subscription.recv()).await;
            match heard {
                Ok(heard) if heard.proposal_id == id => break,
                Ok(other) => panic!("{id} was said, {} was heard", other.proposal_id),
                Err(_) => {}
            }
        }
    };
    let heard = timeout(LIMIT, saying).await;
    heard.unwrap_or_else(|_| panic!("proposal {id}: nobody heard that it was approved"));
}

#[tokio::test(flavor = "multi_thread")]
async fn an_operator_with_a_certificate_is_heard_and_one_without_is_not() {
    let keystore = Keystore::new();
    keystore.enclave(EXECUTOR);
    keystore.enclave(OPERATOR);
    let executor = keystore.node("suction_executor", EXECUTOR);
    let mut heard_by_executor = confirmations(&executor);

    // It is heard by others of its kind, so that it does speak.
    let intruder = unprotected(keystore.network, "intruder");
    let outsider = unprotected(keystore.network, "outsider");
    let mut heard_outside = confirmations(&outsider);
    let false_voice = intruder.publisher("step_confirmation", Qos::Event).unwrap();
    until_heard(&false_voice, &mut heard_outside, 666).await;

    let operator = keystore.node("operator", OPERATOR);
    let voice = operator.publisher("step_confirmation", Qos::Event).unwrap();
    until_heard(&voice, &mut heard_by_executor, 1).await;
    // Once more, now that everybody has had the time to find everybody.
    until_heard(&false_voice, &mut heard_outside, 666).await;
    until_heard(&voice, &mut heard_by_executor, 2).await;

    assert_eq!(
        intruder.graph().subscriptions("/step_confirmation"),
        1,
        "only the outsider's"
    );
    while let Ok(heard) = timeout(Duration::from_millis(1), heard_outside.recv()).await {
        assert_eq!(heard.proposal_id, 666, "the outsider heard the operator");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_certificate_of_another_keystore_is_not_heard() {
    let keystore = Keystore::new();
    keystore.enclave(EXECUTOR);
    keystore.enclave(OPERATOR);
    let foreign = Keystore {
        folder: tempfile::tempdir().unwrap(),
        network: keystore.network,
    };
    run(
        "create",
        &[foreign.path(), &foreign.network.domain_id.to_string()],
        None,
    );
    foreign.enclave(OPERATOR);

    let executor = keystore.node("suction_executor", EXECUTOR);
    let mut heard = confirmations(&executor);
    let stranger = foreign.node("stranger", OPERATOR);
    let false_voice = stranger.publisher("step_confirmation", Qos::Event).unwrap();
    let operator = keystore.node("operator", OPERATOR);
    let voice = operator.publisher("step_confirmation", Qos::Event).unwrap();
    for id in 1..20 {
        false_voice.publish(confirmation(666));
        until_heard(&voice, &mut heard, id).await;
        sleep(Duration::from_millis(50)).await;
    }
    assert_eq!(stranger.graph().subscriptions("/step_confirmation"), 0);
}

/// A participant that does not keep to its own permissions: its governance document, signed as all are, has it believe that
/// `step_confirmation` may be published by anybody. Others know better.
async fn is_heard_with(keystore: &Keystore, permissions: &str) -> bool {
    keystore.enclave(EXECUTOR);
    keystore.enclave(OPERATOR);
    keystore.enclave_with("/sctn/viewer", permissions);
    keystore.change_governance("/sctn/viewer", |common| {
        common.replace(
            "<enable_write_access_control>true</enable_write_access_control>",
            "<enable_write_access_control>false</enable_write_access_control>",
        )
    });
    let executor = keystore.node("suction_executor", EXECUTOR);
    let mut heard = confirmations(&executor);
    let viewer = keystore.node("viewer", "/sctn/viewer");
    let viewers = viewer.publisher("step_confirmation", Qos::Event).unwrap();
    let operator = keystore.node("operator", OPERATOR);
    let voice = operator.publisher("step_confirmation", Qos::Event).unwrap();
    // What it may publish is known to the executor, so that all else would be too.
    let _heartbeat = viewer
        .publisher::<StepConfirmation>("heartbeat", Qos::Event)
        .unwrap();
    let known = async {
        while executor.graph().publishers("/heartbeat") == 0 {
            sleep(Duration::from_millis(20)).await;
        }
    };
    timeout(LIMIT, known)
        .await
        .expect("the executor knows the viewer");
    let mut viewer_was_heard = false;
    let saying = async {
        for id in 1..=20 {
            viewers.publish(confirmation(666));
            voice.publish(confirmation(id));
            sleep(Duration::from_millis(100)).await;
        }
        voice.publish(confirmation(1000));
        loop {
            match heard.recv().await.proposal_id {
                666 => viewer_was_heard = true,
                1000 => break,
                _ => {}
            }
        }
    };
    timeout(LIMIT, saying).await.expect("the operator is heard");
    viewer_was_heard
}

#[tokio::test(flavor = "multi_thread")]
async fn a_certificate_without_the_permission_to_confirm_is_not_heard() {
    let keystore = Keystore::new();
    let domain = keystore.network.domain_id;
    let permissions = permissions_without_confirmations("/sctn/viewer", domain);
    assert!(!is_heard_with(&keystore, &permissions).await);
}

#[tokio::test(flavor = "multi_thread")]
async fn the_same_participant_is_heard_with_the_permission() {
    let keystore = Keystore::new();
    let permissions = permissions("/sctn/viewer", keystore.network.domain_id, "");
    assert!(is_heard_with(&keystore, &permissions).await);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_node_that_may_not_publish_a_topic_is_told_so_by_name() {
    let keystore = Keystore::new();
    let domain = keystore.network.domain_id;
    keystore.enclave_with(
        "/sctn/viewer",
        &permissions_without_confirmations("/sctn/viewer", domain),
    );
    let viewer = keystore.node("viewer", "/sctn/viewer");
    confirmations(&viewer);
    let refused = viewer.publisher::<StepConfirmation>("step_confirmation", Qos::Event);
    let text = refused.err().expect("refused").to_string();
    assert!(text.contains("/step_confirmation"), "{text}");
    assert!(
        text.contains("ermission") || text.contains("security"),
        "{text}"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn large_latched_messages_and_services_work_protected() {
    let keystore = Keystore::new();
    keystore.enclave(EXECUTOR);
    keystore.enclave(OPERATOR);
    let executor = keystore.node("suction_executor", EXECUTOR);
    let cells = 320 * 160;
    let heightmaps = executor
        .publisher::<Heightmap>("heightmap", Qos::Latched)
        .unwrap();
    heightmaps.publish(Heightmap {
        rows: 320,
        cols: 160,
        rgb: (0..3 * cells)
            .map(|byte| byte as u8)
            .collect::<Vec<_>>()
            .into(),
        height_m: (0..cells).map(|cell| cell as f32).collect(),
        ..Heightmap::default()
    });
    let server = executor.service_server::<SetIO>("set_io").unwrap();
    executor.spawn(server.serve(|request: SetIORequest| SetIOResponse {
        success: request.pin == 16,
    }));

    let operator = keystore.node("operator", OPERATOR);
    let mut seen = operator
        .subscription::<Heightmap>("heightmap", Qos::Latched)
        .unwrap();
    let heightmap = timeout(LIMIT, seen.recv())
        .await
        .expect("the latched heightmap");
    assert_eq!(heightmap.rgb.len(), 3 * cells);
    assert!(
        heightmap
            .height_m
            .iter()
            .enumerate()
            .all(|(cell, height)| *height == cell as f32)
    );
    let client = operator.service_client::<SetIO>("set_io").unwrap();
    let request = SetIORequest {
        pin: 16,
        ..SetIORequest::default()
    };
    let answer = timeout(LIMIT, client.call(&request, &CallOptions::default())).await;
    assert!(answer.expect("an answer").unwrap().success);
}

/// Why a node of that enclave does not start.
fn refusal(keystore: &Keystore) -> String {
    match keystore.try_node("suction_executor", EXECUTOR) {
        Ok(_) => panic!("the node started"),
        Err(error) => format!("{error:#}"),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn wrong_files_are_refused_by_name_and_nothing_starts() {
    type Spoil = fn(&Keystore);
    let other = "/sctn/other";
    let cases: [(&str, &str, Spoil); 9] = [
        ("key.pem", "is not the private key", |keystore| {
            let key = keystore.file("/sctn/other", "key.pem");
            fs::copy(key, keystore.file(EXECUTOR, "key.pem")).unwrap();
        }),
        ("key.pem", "PRIVATE KEY", |keystore| {
            let certificate = keystore.file(EXECUTOR, "cert.pem");
            fs::copy(certificate, keystore.file(EXECUTOR, "key.pem")).unwrap();
        }),
        ("cert.pem", "PEM", |keystore| {
            fs::write(keystore.file(EXECUTOR, "cert.pem"), "nothing").unwrap();
        }),
        ("cert.pem", "Signature", |keystore| {
            let foreign = Keystore::new();
            foreign.enclave(EXECUTOR);
            fs::copy(
                foreign.file(EXECUTOR, "cert.pem"),
                keystore.file(EXECUTOR, "cert.pem"),
            )
            .unwrap();
            fs::copy(
                foreign.file(EXECUTOR, "key.pem"),
                keystore.file(EXECUTOR, "key.pem"),
            )
            .unwrap();
        }),
        ("governance.p7s", "hash", |keystore| {
            let path = keystore.file(EXECUTOR, "governance.p7s");
            let text = fs::read_to_string(&path).unwrap();
            let changed = text.replace(
                "<allow_unauthenticated_participants>false",
                "<allow_unauthenticated_participants>true",
            );
            assert_ne!(changed, text);
            fs::write(path, changed).unwrap();
        }),
        ("governance.p7s", "domain", |keystore| {
            let domain = keystore.network.domain_id;
            keystore.change_governance(EXECUTOR, |common| {
                common.replace(&format!("<id>{domain}</id>"), "<id>150</id>")
            });
        }),
        ("permissions.p7s", "Signature", |keystore| {
            let foreign = Keystore::new();
            foreign.enclave(EXECUTOR);
            let path = keystore.file(EXECUTOR, "permissions.p7s");
            fs::copy(foreign.file(EXECUTOR, "permissions.p7s"), path).unwrap();
        }),
        ("permissions.p7s", "CN=/sctn/suction_executor", |keystore| {
            let path = keystore.file("/sctn/other", "permissions.p7s");
            fs::copy(path, keystore.file(EXECUTOR, "permissions.p7s")).unwrap();
        }),
        ("crl.pem", "not supported", |keystore| {
            fs::write(keystore.file(EXECUTOR, "crl.pem"), "").unwrap();
        }),
    ];
    for (file, what, spoil) in cases {
        let keystore = Keystore::new();
        keystore.enclave(EXECUTOR);
        keystore.enclave(other);
        spoil(&keystore);
        let text = refusal(&keystore);
        let named = format!("enclaves{EXECUTOR}/{file}");
        assert!(
            text.contains(&named) && text.contains(what),
            "{file}, {what}: {text}"
        );
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_no_longer_valid_is_refused_by_name() {
    let keystore = Keystore::new();
    let domain = keystore.network.domain_id;
    keystore.make(EXECUTOR, &permissions(EXECUTOR, domain, ""), Some("-1"));
    let text = refusal(&keystore);
    assert!(
        text.contains("cert.pem") && text.contains("not valid now"),
        "{text}"
    );

    let keystore = Keystore::new();
    let domain = keystore.network.domain_id;
    let expired = permissions(EXECUTOR, domain, "").replace("2100-", "2021-");
    keystore.enclave_with(EXECUTOR, &expired);
    let text = refusal(&keystore);
    assert!(
        text.contains("permissions.p7s") && text.contains("valid now"),
        "{text}"
    );

    let keystore = Keystore::new();
    keystore.enclave_with(EXECUTOR, &permissions(EXECUTOR, 150, ""));
    let text = refusal(&keystore);
    assert!(text.contains("ccess control"), "{text}");
}
