//! Disturbances: the demonstrator goes on from what a bad action has left.

mod episode;

/// Solves an episode that is disturbed before every other step or so; says how often, and whether it was solved.
fn solve(problem: &str, seed: u64, probability: f64) -> (usize, bool) {
    let mut environment = episode::environment(problem);
    environment.reset(seed).unwrap();
    let mut disturbed = 0;
    while !environment.is_done() {
        let before = (environment.state_hash(), environment.steps());
        if environment.disturb(probability).unwrap() {
            disturbed += 1;
            assert_ne!(environment.state_hash(), before.0);
        } else {
            assert_eq!(environment.state_hash(), before.0);
        }
        assert_eq!(environment.steps(), before.1, "a disturbance is no step");
        let Some(action) = environment.demonstrate() else {
            break;
        };
        environment.step(&action).unwrap();
    }
    (disturbed, environment.is_complete())
}

#[test]
fn demonstrators_go_on_from_what_a_disturbance_has_left() {
    for (problem, expected) in [
        ("placing", 9),
        ("stacking", 8),
        ("two_towers", 8),
        ("kitting", 9),
    ] {
        let episodes: Vec<_> = (0..10)
            .map(|seed| solve(problem, 10_000 + seed, 0.4))
            .collect();
        let disturbed: usize = episodes.iter().map(|(disturbed, _)| disturbed).sum();
        let solved = episodes.iter().filter(|(_, solved)| *solved).count();
        assert!(disturbed >= 10, "{problem}: {disturbed}");
        assert!(solved >= expected, "{problem}: {solved} of 10");
    }
}

#[test]
fn without_a_disturbance_nothing_changes() {
    assert_eq!(solve("placing", 1, 0.0), (0, true));
}

/// Where nothing is gripped the action is a mistake; where the demonstrator's is taken for one it is none.
#[test]
fn a_mistake_is_carried_out_and_what_reaches_a_goal_is_not() {
    for problem in ["stacking", "chaining", "routing"] {
        let mut environment = episode::environment(problem);
        environment.reset(1).unwrap();
        let good = environment.demonstrate().unwrap();
        let before = environment.state_hash();
        assert!(!environment.mistake(&good).unwrap());
        assert_eq!(environment.state_hash(), before, "{problem}");
        let mut bad = good;
        // Back to where it was picked.
        bad.place = bad.pick;
        assert!(environment.mistake(&bad).unwrap());
        assert_ne!(environment.state_hash(), before, "{problem}");
        assert_eq!(environment.steps(), 0, "a mistake is no step");
        while let Some(action) = environment.demonstrate() {
            environment.step(&action).unwrap();
        }
        assert!(environment.is_complete(), "{problem}");
        bad.place.translation.x = 7.0;
        assert!(environment.mistake(&bad).is_err());
    }
}
