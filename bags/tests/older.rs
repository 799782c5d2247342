//! Recordings from before fields were added at the end of messages are read, with defaults in their place.

use std::path::{Path, PathBuf};

use bags::{BagInfo, BagReader, Demonstration};
use msgs::sctn_msgs::{self, Goal, PickPlace, StepResult};
use msgs::{Interface, from_recorded_cdr, to_cdr};

fn older_run() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/older_run")
}

fn messages<T: Interface>(topic: &str) -> Vec<T> {
    let bag = BagReader::open(&older_run()).unwrap();
    let messages = bag.messages().map(Result::unwrap);
    let of_topic = messages.filter(|message| message.topic.name == topic);
    of_topic.map(|message| message.decode().unwrap()).collect()
}

#[test]
fn what_an_older_recording_lacks_has_its_default_and_the_rest_is_there() {
    // The hashes of the older definitions, from an implementation that is not ours.
    let metadata = std::fs::read_to_string(older_run().join("metadata.yaml")).unwrap();
    for earlier in [
        Goal::EARLIER_TYPE_HASHES,
        PickPlace::EARLIER_TYPE_HASHES,
        StepResult::EARLIER_TYPE_HASHES,
    ] {
        let oldest = earlier.last().unwrap();
        assert!(metadata.contains(oldest), "{oldest}");
    }

    let goals: Vec<Goal> = messages("/goal");
    assert_eq!((goals[1].step, goals[1].heightmap.rows), (2, 4));
    assert_eq!(goals[1].heightmap.coverage, 1.0);
    assert_eq!(goals[1].previous, sctn_msgs::Heightmap::default());

    let proposals: Vec<PickPlace> = messages("/pick_place");
    assert_eq!(
        (proposals[0].id, proposals[0].module.as_str()),
        (1, "placing")
    );
    assert_eq!(proposals[0].success_probability, -1.0);
    assert_eq!(proposals[0].done_probability, -1.0);
    assert_eq!(
        (
            proposals[0].checkpoint.as_str(),
            proposals[0].author.as_str()
        ),
        ("", "")
    );

    let results: Vec<StepResult> = messages("/step_result");
    assert_eq!(
        (results[1].reason.as_str(), results[1].duration.sec),
        ("donedone", 2)
    );
    assert_eq!(results[1].proposal_status, 0);
}

#[test]
fn an_older_run_is_still_a_demonstration() {
    let (demonstration, left_out) = Demonstration::read_run(&older_run()).unwrap().unwrap();
    assert_eq!((demonstration.steps.len(), left_out.len()), (2, 0));
    assert_eq!(demonstration.goals().len(), 2);
    assert_eq!(
        BagInfo::read(&older_run()).unwrap().run.unwrap().results["placed"],
        2
    );
}

#[test]
fn only_whole_fields_that_were_added_may_be_missing() {
    let message = PickPlace {
        checkpoint: "a checkpoint".into(),
        author: "somebody".into(),
        module: "placing".into(),
        done_probability: 0.25,
        ..PickPlace::default()
    };
    let bytes = to_cdr(&message).unwrap();
    let read: PickPlace = from_recorded_cdr(&bytes).unwrap();
    assert_eq!(read, message);
    let accepted: Vec<usize> = (4..bytes.len())
        .filter(|length| from_recorded_cdr::<PickPlace>(&bytes[..*length]).is_ok())
        .collect();
    // Before success_probability, checkpoint, author or done_probability; and with padding of zeros.
    let first = accepted[0];
    let whole: PickPlace = from_recorded_cdr(&bytes[..first]).unwrap();
    assert_eq!(
        (whole.module.as_str(), whole.author.as_str()),
        ("placing", "")
    );
    for length in &accepted {
        let read: PickPlace = from_recorded_cdr(&bytes[..*length]).unwrap();
        assert!(
            ["", "a checkpoint"].contains(&read.checkpoint.as_str()),
            "{read:?}"
        );
        assert!(["", "somebody"].contains(&read.author.as_str()), "{read:?}");
        // Cut or whole: the default, or what was written.
        assert_eq!(
            read.done_probability,
            if *length == bytes.len() {
                message.done_probability
            } else {
                -1.0
            }
        );
    }
    for length in 4..first {
        let cut = from_recorded_cdr::<PickPlace>(&bytes[..length]);
        assert!(cut.is_err(), "{length} of {} bytes", bytes.len());
    }
}
