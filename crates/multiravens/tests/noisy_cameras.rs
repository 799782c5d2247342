//! What noisy cameras do to observations, and what the change test makes of it.

use camera_noise::{ClutterItem, Color, Perturbation};
use collision::{CollisionChecker, Margins};
use heightmap::{ChangeRules, Heightmap, largest_change};
use multiravens::{Environment, Problem, render::LIGHT};
use nalgebra::{Isometry3, Point2, Translation3, UnitQuaternion, Vector3};
use pick_place::{ContactSettings, ContactSign, PickPlace, PrimitiveSettings};
use rehearsal::{RobotNow, Subject};
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use step_protocol::{
    ApprovalGate, GateAction, GateRules, OperatorDecision, Proposal, ProposalId, Proposed,
    RequireApproval, StepOutcome,
};
use ur5::{AtHome, Joints, WorkCell};

fn folder() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../config"))
}

fn model(name: &str) -> Perturbation {
    Perturbation::load(&folder().join(format!("perturbations/{name}.yaml"))).unwrap()
}

fn environment(problem: &str) -> Environment {
    let problem = Problem::load(&folder().join("problems"), problem).unwrap();
    Environment::new(&problem, &WorkCell::builtin().unwrap())
}

#[test]
fn the_same_seed_and_session_give_the_same_observation_and_another_session_another() {
    let realsense = model("realsense");
    let observe = |perturbed: bool, session: u64| {
        let mut environment = environment("placing");
        environment.set_perturbation(perturbed.then_some(&realsense));
        environment.set_session(session);
        environment.reset(10_000).unwrap();
        environment.observe().unwrap().clone()
    };
    let first = observe(true, 0);
    assert_eq!(first, observe(true, 0));
    assert_ne!(first, observe(true, 1));
    let clean = observe(false, 0);
    assert_ne!(first, clean);
    // It is the same scene.
    let seen =
        (0..clean.height_m.len()).filter(|index| first.is_seen(*index) && clean.is_seen(*index));
    let errors: Vec<f32> = seen
        .map(|index| (first.height_m[index] - clean.height_m[index]).abs())
        .collect();
    let large = errors.iter().filter(|error| **error > 0.01).count();
    assert!(errors.len() > 45_000, "{}", errors.len());
    assert!(large < errors.len() / 50, "{large} of {}", errors.len());
}

#[test]
fn perfect_cameras_come_back_when_the_perturbation_is_taken_away() {
    let mut environment = environment("placing");
    environment.reset(10_000).unwrap();
    let clean = environment.observe().unwrap().clone();
    environment.set_perturbation(Some(&model("harsh")));
    environment.reset(10_000).unwrap();
    assert_ne!(clean, *environment.observe().unwrap());
    environment.set_perturbation(None);
    environment.reset(10_000).unwrap();
    assert_eq!(clean, *environment.observe().unwrap());
}

/// A free place for a small object within 15 to 45 mm of a point, and the height of what it stands on.
fn free_place(
    heightmap: &Heightmap,
    about: &Point2<f64>,
    start: usize,
) -> Option<(Point2<f64>, f64)> {
    (0..24).find_map(|step| {
        let angle = (start * 7 + step) as f64 * 0.9;
        let distance_m = 0.016 + 0.003 * ((start + step) % 10) as f64;
        let at = about + distance_m * nalgebra::Vector2::new(angle.cos(), angle.sin());
        let pixel = heightmap.workspace.pixel(&at)?;
        let (rows, cols) = (heightmap.workspace.rows, heightmap.workspace.cols);
        if pixel.row < 6 || pixel.col < 6 || pixel.row + 6 >= rows || pixel.col + 6 >= cols {
            return None;
        }
        let cells = (pixel.row - 5..=pixel.row + 5)
            .flat_map(|row| (pixel.col - 5..=pixel.col + 5).map(move |col| row * cols + col));
        let heights: Vec<f32> = cells
            .filter(|index| heightmap.is_seen(*index))
            .map(|index| heightmap.height_m[index])
            .collect();
        let (low, high) = heights
            .iter()
            .fold((1.0f32, -1.0f32), |(low, high), height| {
                (low.min(*height), high.max(*height))
            });
        (heights.len() == 121 && high - low < 1e-3).then_some((at, f64::from(low)))
    })
}

/// Approvals of each untouched scene.
const APPROVALS: u64 = 10;
/// Objects that are put into each scene, one after the other.
const OBJECTS: usize = 5;

/// A proposal, and the executor's answer to its approval after the view has become another one: the gate with the rules that are shipped, and
/// the motion rehearsed on the view that the proposal was made from.
struct Executor {
    proposal: Proposal,
    source: Arc<Heightmap>,
    robot: RobotNow,
}

impl Executor {
    fn new(environment: &Environment, action: PickPlace, source: Arc<Heightmap>) -> Self {
        let work_cell = WorkCell::builtin().unwrap();
        let stamp = Duration::from_secs(10);
        let proposal = Proposal {
            id: ProposalId(1),
            frame: "world".into(),
            stamp,
            problem: environment.problem().name().into(),
            step: 1,
            attempt: 0,
            module: environment.module().unwrap().into(),
            action,
            settings: environment.settings().unwrap(),
            pick_score: 1.0,
            place_score: 1.0,
            success_probability: None,
            done_probability: None,
            checkpoint: String::new(),
            author: "demonstrator".into(),
        };
        let mut at_home = AtHome::default();
        let home = work_cell.arm.home;
        at_home.read(Duration::from_secs(9), &home, &Joints::zeros(), &home);
        let mut robot = RobotNow {
            checker: Arc::new(CollisionChecker::new(&work_cell, Margins::default()).unwrap()),
            arm: work_cell.arm,
            obstacle: None,
            joints_rad: Some(home),
            holds: Some(false),
            at_home,
            time: stamp,
            seen: Some((Arc::clone(&source), stamp)),
            unseen: false,
            needs_home: true,
            observation_max_age: Duration::from_secs(3),
            changes: ChangeRules::default(),
            // As config/hardware/realistic.yaml.
            contact: ContactSettings {
                slow_from_m: 0.03,
                slow_m_s: 0.05,
                window_m: 0.015,
                press_m: 0.0,
            },
            sign: ContactSign::UntilAction,
            without_arm: Some(Arc::clone(&source)),
            picked: None,
            rehearsed: None,
            rehearsed_recovery: None,
        };
        let rehearsed = robot.rehearse(Subject::Proposal(Box::new(proposal.clone())));
        robot.rehearsed = Some(Arc::new(rehearsed));
        Self {
            proposal,
            source,
            robot,
        }
    }

    /// Approves the proposal when `latest` is seen.
    fn approve(&self, latest: &Arc<Heightmap>) -> Vec<GateAction> {
        let seconds = Duration::from_secs;
        let mut gate = ApprovalGate::new(GateRules {
            frame: "world".into(),
            limits: PrimitiveSettings {
                clearance_m: 0.5,
                lift_m: 0.5,
                travel_m_s: 1.5,
                carry_m_s: 1.5,
                descend_m_s: 0.5,
                acceleration_m_s2: 10.0,
            },
            changes: ChangeRules::default(),
            confirmation_grace: seconds(1),
            require_approval: RequireApproval::Always,
            operators: Vec::new(),
        });
        let id = self.proposal.id;
        gate.on_heightmap(self.proposal.stamp, Arc::clone(&self.source));
        let proposed = gate.on_proposal(id, Ok(self.proposal.clone()));
        assert_eq!(proposed, Proposed::Pending);
        gate.on_heightmap(seconds(12), Arc::clone(latest));
        let robot = RobotNow {
            time: seconds(13),
            seen: Some((Arc::clone(latest), seconds(12))),
            without_arm: Some(Arc::clone(latest)),
            ..self.robot.clone()
        };
        gate.on_confirmation(id, OperatorDecision::Approve, &robot, seconds(100))
    }
}

/// What came of the approvals of one scene.
#[derive(Default)]
struct Counts {
    approved: usize,
    /// Approvals of the untouched scene that moved nothing.
    refused: Vec<String>,
    placed: usize,
    /// Objects in spite of which the arm would have moved.
    missed: Vec<String>,
}

fn approvals_of_scene(problem: &str, number: usize, seed: u64, realsense: &Perturbation) -> Counts {
    let mut counts = Counts::default();
    let mut environment = environment(problem);
    environment.reset(seed).unwrap();
    let clean = environment.observe().unwrap().clone();
    let action = environment.demonstrate().unwrap();
    environment.set_perturbation(Some(realsense));
    environment.reset(seed).unwrap();
    let source = Arc::new(environment.observe().unwrap().clone());
    let executor = Executor::new(&environment, action, source);
    for _ in 0..APPROVALS {
        let latest = Arc::new(environment.observe().unwrap().clone());
        counts.approved += 1;
        let answer = executor.approve(&latest);
        if !matches!(&answer[..], [GateAction::Move(_)]) {
            counts.refused.push(format!("{problem} {seed}: {answer:?}"));
        }
    }
    let light = environment.rig().unwrap().light(&LIGHT);
    let place = Point2::from(action.place.translation.vector);
    for start in 0..OBJECTS {
        let Some((at, floor_m)) = free_place(&clean, &place, OBJECTS * number + start) else {
            continue;
        };
        counts.placed += 1;
        let yaw = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), start as f64);
        let item = ClutterItem {
            size_m: Vector3::new(0.015, 0.015, 0.01),
            pose: Isometry3::from_parts(Translation3::new(at.x, at.y, floor_m + 0.005), yaw),
            rgb: [200, 180, 40],
        };
        environment.cell_mut().perturb(light, vec![item]);
        let latest = Arc::new(environment.observe().unwrap().clone());
        let answer = executor.approve(&latest);
        // It is the object that was noticed, not something else.
        let refusal = match &answer[..] {
            [GateAction::Report(report)] if report.outcome == StepOutcome::Refused => {
                report.reason.as_str()
            }
            _ => "",
        };
        let around = [action.pick, action.place].map(|pose| pose.translation.vector.into());
        let rules = ChangeRules::default();
        let change = largest_change(&executor.source, &latest, &rules, &around).unwrap();
        let is_there = change.is_some_and(|change| (change.center_m - at).norm() < 0.02);
        if !refusal.contains("the observation has changed") || !is_there {
            let missed = format!("{problem} {seed} at {at}: {answer:?}, {change:?}");
            counts.missed.push(missed);
        }
    }
    counts
}

#[test]
fn no_approval_is_refused_for_noise_and_a_small_object_beside_the_place_always_is_noticed() {
    let mut realsense = model("realsense");
    // The gate compares heights, and no height depends on the colours: their noise is drawn last for each image. They take half of the time.
    realsense.color = Color {
        noise: 0.0,
        gain: 0.0,
        tint: 0.0,
    };
    let problems = ["placing", "stacking", "chaining", "routing"];
    let scenes: Vec<_> = problems
        .iter()
        .enumerate()
        .flat_map(|(number, problem)| {
            let seeds = (20_000..20_010u64).step_by(2);
            seeds.map(move |seed| (number, *problem, seed))
        })
        .collect();
    let (next, all) = (AtomicUsize::new(0), Mutex::new(Counts::default()));
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    std::thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(|| {
                while let Some((number, problem, seed)) =
                    scenes.get(next.fetch_add(1, Ordering::Relaxed))
                {
                    let counts = approvals_of_scene(problem, *number, *seed, &realsense);
                    let mut all = all.lock().unwrap();
                    all.approved += counts.approved;
                    all.refused.extend(counts.refused);
                    all.placed += counts.placed;
                    all.missed.extend(counts.missed);
                }
            });
        }
    });
    let counts = all.into_inner().unwrap();
    println!(
        "{} approvals, {} refused; {} objects, {} missed",
        counts.approved,
        counts.refused.len(),
        counts.placed,
        counts.missed.len()
    );
    assert_eq!(counts.approved, 200);
    assert!(counts.placed >= 40, "{}", counts.placed);
    assert!(counts.refused.is_empty(), "{:?}", counts.refused);
    assert!(counts.missed.is_empty(), "{:?}", counts.missed);
}
