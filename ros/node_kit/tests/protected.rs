//! A participant with DDS security: RustDDS as published locks up within some hundreds of these readers (third_party/README.md).
#![cfg(feature = "security")]

use std::{
    net::{IpAddr, Ipv4Addr},
    path::Path,
    process::Command,
    sync::mpsc::channel,
    thread,
    time::Duration,
};

use rustdds::{
    CDRDeserializerAdapter, DomainParticipant, DomainParticipantBuilder,
    DomainParticipantSecurityConfigFiles, QosPolicies, Topic, TopicKind, no_key,
};

const DOMAIN: u16 = 97;
const READERS: usize = 1000;
const PATIENCE: Duration = Duration::from_secs(120);
const PERMISSIONS: &str = r#"<dds><permissions><grant name="/test"><subject_name>CN=/test</subject_name>
<validity><not_before>2020-01-01T00:00:00</not_before><not_after>2037-01-01T00:00:00</not_after></validity>
<allow_rule><domains><id>97</id></domains><publish><topics><topic>*</topic></topics></publish>
<subscribe><topics><topic>*</topic></topics></subscribe></allow_rule><default>DENY</default></grant></permissions></dds>"#;

fn keystore(command: &str, folder: &Path, arguments: &[&str]) {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/keystore.sh");
    let mut make = Command::new(script);
    make.arg(command).arg(folder).args(arguments);
    let made = make.output().unwrap();
    let said = String::from_utf8_lossy(&made.stderr);
    assert!(made.status.success(), "{said}");
}

fn protected_participant(folder: &Path) -> DomainParticipant {
    let store = folder.join("keystore");
    let permissions = folder.join("permissions.xml");
    std::fs::write(&permissions, PERMISSIONS).unwrap();
    keystore("create", &store, &[&DOMAIN.to_string()]);
    keystore("enclave", &store, &["/test", permissions.to_str().unwrap()]);
    let enclave = store.join("enclaves/test");
    let files =
        DomainParticipantSecurityConfigFiles::with_ros_default_names(enclave, String::new());
    DomainParticipantBuilder::new(DOMAIN)
        .with_only_networks([IpAddr::V4(Ipv4Addr::LOCALHOST)])
        .builtin_security(files)
        .build()
        .unwrap()
}

fn topic(participant: &DomainParticipant, name: &str) -> Topic {
    participant
        .create_topic(
            name.into(),
            "std_msgs::msg::dds_::Bool_".into(),
            &QosPolicies::qos_none(),
            TopicKind::NoKey,
        )
        .unwrap()
}

#[test]
fn topics_and_readers_of_a_protected_participant_are_made_side_by_side() {
    let folder = tempfile::tempdir().unwrap();
    let participant = protected_participant(folder.path());
    let (ended, all_ended) = channel();
    let (stop, stopped) = channel::<()>();
    let topics = (participant.clone(), ended.clone());
    thread::spawn(move || {
        let (participant, ended) = topics;
        while stopped.try_recv().is_err() {
            topic(&participant, "rt/others");
        }
        ended.send("topics").unwrap();
    });
    thread::spawn(move || {
        let topic = topic(&participant, "rt/own");
        let subscriber = participant
            .create_subscriber(&QosPolicies::qos_none())
            .unwrap();
        for _ in 0..READERS {
            let reader: no_key::DataReader<bool, CDRDeserializerAdapter<bool>> =
                subscriber.create_datareader_no_key(&topic, None).unwrap();
            drop(reader);
        }
        stop.send(()).unwrap();
        ended.send("readers").unwrap();
    });
    for _ in 0..2 {
        all_ended
            .recv_timeout(PATIENCE)
            .expect("they wait for one another");
    }
}
