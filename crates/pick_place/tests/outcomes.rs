//! Every way in which a primitive ends, played by a robot that follows a script.

use nalgebra::{Isometry2, Vector2};
use pick_place::{
    ExecuteError, Outcome, Phase, PickPlace, Primitive, PrimitiveError, PrimitiveSettings, PutDown,
    Report, Robot, Touchdown, execute, execute_on, go_home, put_down,
};
use ur5::{Arm, JointTrajectory, Joints, WorkCell};

/// A command as the robot saw it, with where the tip ended.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Seen {
    Follow { height_m: f64 },
    Descend { height_m: f64 },
    Suction(bool),
}

/// Perfect joints, a scripted world.
struct ScriptedRobot {
    arm: Arm,
    joints: Joints,
    suction: bool,
    /// What suction holds when it is on.
    grasps: bool,
    /// Height of the first contact at pick and at place; none: no contact.
    contacts_m: [Option<f64>; 2],
    /// The object falls off during this motion (counted from 0).
    drops_at: Option<usize>,
    /// The tip lags during this motion.
    lags_at: Option<usize>,
    /// Commands from this one on fail.
    fails_at: Option<usize>,
    /// A protective stop half-way through this motion.
    stops_in: Option<usize>,
    dropped: bool,
    motions: usize,
    descents: usize,
    calls: usize,
    seen: Vec<Seen>,
    path: Vec<JointTrajectory>,
}

impl ScriptedRobot {
    fn new() -> Self {
        let arm = WorkCell::builtin().unwrap().arm;
        Self {
            joints: arm.home,
            arm,
            suction: false,
            grasps: true,
            contacts_m: [Some(0.04), Some(0.045)],
            drops_at: None,
            lags_at: None,
            fails_at: None,
            stops_in: None,
            dropped: false,
            motions: 0,
            descents: 0,
            calls: 0,
            seen: Vec::new(),
            path: Vec::new(),
        }
    }

    fn command(&mut self) -> Result<(), String> {
        self.calls += 1;
        match self.fails_at {
            Some(call) if self.calls > call => {
                Err(format!("protective stop at call {}", self.calls))
            }
            _ => Ok(()),
        }
    }

    fn begin(&mut self, trajectory: &JointTrajectory) {
        trajectory.check_limits(&self.arm).unwrap();
        let start = trajectory.points()[0].positions_rad;
        assert!(
            (start - self.joints).amax() < 1e-9,
            "a motion starts where the arm is not"
        );
        self.path.push(trajectory.clone());
        if self.drops_at == Some(self.motions) {
            self.dropped = true;
        }
        self.motions += 1;
    }

    fn protective_stop(&mut self, trajectory: &JointTrajectory) -> Result<(), String> {
        if self.stops_in == Some(self.motions) {
            self.joints = trajectory.sample(trajectory.duration() / 2);
            return Err("protective stop".into());
        }
        Ok(())
    }

    fn height_m(&self) -> f64 {
        self.arm.tip(&self.joints).translation.z
    }

    fn run(
        &mut self,
        settings: &PrimitiveSettings,
    ) -> (Result<Outcome, ExecuteError<String>>, Vec<Phase>) {
        let arm = self.arm.clone();
        let mut phases = Vec::new();
        let outcome = execute(self, &arm, &action(), settings, |phase| phases.push(phase));
        (outcome, phases)
    }

    fn run_on(&mut self, touchdown: &Touchdown) -> Result<Outcome, ExecuteError<String>> {
        let (arm, settings) = (self.arm.clone(), PrimitiveSettings::RIGID);
        execute_on(self, &arm, &action(), &settings, Some(touchdown), |_| ())
    }

    fn is_home(&self) -> bool {
        (self.joints - self.arm.home).amax() < 1e-9
    }
}

impl Robot for ScriptedRobot {
    type Error = String;

    fn joints(&mut self) -> Result<Joints, String> {
        Ok(self.joints)
    }

    fn follow(&mut self, trajectory: &JointTrajectory) -> Result<bool, String> {
        self.command()?;
        self.protective_stop(trajectory)?;
        let lags = self.lags_at == Some(self.motions);
        self.begin(trajectory);
        let duration = if lags {
            trajectory.duration() / 2
        } else {
            trajectory.duration()
        };
        self.joints = trajectory.sample(duration);
        self.seen.push(Seen::Follow {
            height_m: self.height_m(),
        });
        Ok(!lags)
    }

    fn follow_until_contact(&mut self, trajectory: &JointTrajectory) -> Result<bool, String> {
        self.command()?;
        self.protective_stop(trajectory)?;
        self.begin(trajectory);
        let contact_m = self.contacts_m[self.descents];
        self.descents += 1;
        let mut touched = false;
        for point in trajectory.points() {
            self.joints = point.positions_rad;
            touched = contact_m.is_some_and(|height_m| self.height_m() <= height_m);
            if touched {
                break;
            }
        }
        self.seen.push(Seen::Descend {
            height_m: self.height_m(),
        });
        Ok(touched)
    }

    fn set_suction(&mut self, on: bool) -> Result<(), String> {
        self.command()?;
        self.suction = on;
        self.seen.push(Seen::Suction(on));
        Ok(())
    }

    fn holds(&mut self) -> Result<bool, String> {
        self.command()?;
        Ok(self.suction && self.grasps && !self.dropped)
    }
}

fn action() -> PickPlace {
    PickPlace {
        pick: Isometry2::new(Vector2::new(0.4, -0.2), 0.0),
        place: Isometry2::new(Vector2::new(0.6, 0.25), 1.2),
    }
}

fn suctions(robot: &ScriptedRobot) -> Vec<bool> {
    let suction = |seen: &Seen| match seen {
        Seen::Suction(on) => Some(*on),
        _ => None,
    };
    robot.seen.iter().filter_map(suction).collect()
}

use Phase::*;

#[test]
fn a_pick_and_place_goes_through_every_phase_in_order_and_ends_at_home() {
    let mut robot = ScriptedRobot::new();
    let (outcome, phases) = robot.run(&PrimitiveSettings::RIGID);
    assert_eq!(outcome, Ok(Outcome::Placed));
    assert_eq!(
        phases,
        [
            Approach,
            DescendToPick,
            Grasp,
            Lift,
            CheckGrasp,
            Transfer,
            DescendToPlace,
            Release,
            Retreat,
            Home
        ]
    );
    assert!(robot.is_home());
    assert!(!robot.suction);
    let heights: Vec<String> = robot
        .seen
        .iter()
        .map(|seen| match seen {
            Seen::Follow { height_m } => format!("follow {height_m:.2}"),
            Seen::Descend { height_m } => format!("descend {height_m:.2}"),
            Seen::Suction(on) => format!("suction {on}"),
        })
        .collect();
    assert_eq!(
        heights,
        [
            "follow 0.24",
            "descend 0.04",
            "suction true",
            "follow 0.24",
            "follow 0.24",
            "descend 0.04",
            "suction false",
            "follow 0.24",
            "follow 0.32",
        ]
    );
}

#[test]
fn the_object_is_carried_to_the_place_and_turned_by_the_difference_of_the_yaws() {
    let mut robot = ScriptedRobot::new();
    robot.run(&PrimitiveSettings::RIGID).0.unwrap();
    let (grasp, release) = (&robot.path[2], &robot.path[4]);
    let grasp = robot.arm.tip(&grasp.points()[0].positions_rad);
    let release = robot.arm.tip(&release.last().positions_rad);
    assert!((grasp.translation.vector.xy() - action().pick.translation.vector).norm() < 1e-9);
    assert!((release.translation.vector.xy() - action().place.translation.vector).norm() < 1e-9);
    let turn = (release.rotation * grasp.rotation.inverse()).scaled_axis();
    assert!(
        (turn - nalgebra::Vector3::new(0.0, 0.0, 1.2)).norm() < 1e-9,
        "{turn}"
    );
}

#[test]
fn beads_are_carried_low() {
    let mut robot = ScriptedRobot::new();
    robot.contacts_m = [Some(0.012), Some(0.012)];
    robot.run(&PrimitiveSettings::BEADS).0.unwrap();
    let contact_m = robot
        .arm
        .tip(&robot.path[2].points()[0].positions_rad)
        .translation
        .z;
    for point in robot.path[3].points() {
        let height_m = robot.arm.tip(&point.positions_rad).translation.z;
        assert!((height_m - contact_m - PrimitiveSettings::BEADS.lift_m).abs() < 1e-9);
    }
}

#[test]
fn without_contact_nothing_is_grasped() {
    let mut robot = ScriptedRobot::new();
    robot.contacts_m[0] = None;
    let (outcome, phases) = robot.run(&PrimitiveSettings::RIGID);
    assert_eq!(outcome, Ok(Outcome::NoContact));
    assert_eq!(phases, [Approach, DescendToPick, Retreat, Home]);
    assert_eq!(suctions(&robot), [] as [bool; 0]);
    assert!(robot.is_home());
}

#[test]
fn a_failed_grasp_is_released_and_goes_home() {
    let mut robot = ScriptedRobot::new();
    robot.grasps = false;
    let (outcome, phases) = robot.run(&PrimitiveSettings::RIGID);
    assert_eq!(outcome, Ok(Outcome::GraspFailed));
    assert!(!phases.contains(&Transfer));
    assert_eq!(suctions(&robot), [true, false]);
    assert!(robot.is_home());
}

#[test]
fn an_object_lost_on_the_way_is_noticed() {
    // Motions: 0 approach, 1 descend, 2 lift, 3 transfer, 4 descend.
    for drops_at in [3, 4] {
        let mut robot = ScriptedRobot::new();
        robot.drops_at = Some(drops_at);
        let (outcome, _) = robot.run(&PrimitiveSettings::RIGID);
        assert_eq!(
            outcome,
            Ok(Outcome::Dropped),
            "dropped in motion {drops_at}"
        );
        assert_eq!(suctions(&robot), [true, false]);
        assert!(robot.is_home());
    }
}

#[test]
fn a_lagging_tip_lets_go_and_goes_home() {
    for lags_at in [2, 3] {
        let mut robot = ScriptedRobot::new();
        robot.lags_at = Some(lags_at);
        let (outcome, phases) = robot.run(&PrimitiveSettings::BEADS);
        assert_eq!(
            outcome,
            Ok(Outcome::LagAborted),
            "lagged in motion {lags_at}"
        );
        assert_eq!(suctions(&robot), [true, false]);
        assert_eq!(phases[phases.len() - 3..], [Release, Retreat, Home]);
        assert!(!phases.contains(&DescendToPlace));
        assert!(robot.is_home());
    }
}

#[test]
fn a_lagging_tip_with_nothing_held_stops_everything() {
    let mut robot = ScriptedRobot::new();
    robot.lags_at = Some(5);
    let (outcome, _) = robot.run(&PrimitiveSettings::RIGID);
    assert_eq!(
        outcome,
        Err(PrimitiveError::Blocked { phase: Retreat }.into())
    );
    assert_eq!(robot.motions, 6);
}

#[test]
fn after_an_error_nothing_moves_and_suction_stays_as_it_was() {
    let mut complete = ScriptedRobot::new();
    complete.run(&PrimitiveSettings::RIGID).0.unwrap();
    for fails_at in 0..complete.calls {
        let mut robot = ScriptedRobot::new();
        robot.fails_at = Some(fails_at);
        let (outcome, _) = robot.run(&PrimitiveSettings::RIGID);
        assert!(
            matches!(outcome, Err(ExecuteError::Robot { .. })),
            "{outcome:?}"
        );
        assert_eq!(robot.calls, fails_at + 1, "a command followed the error");
        assert_eq!(robot.seen[..], complete.seen[..robot.seen.len()]);
    }
}

#[test]
fn an_arm_that_starts_low_rises_first() {
    let mut robot = ScriptedRobot::new();
    let low = Arm::tip_down(&Isometry2::new(Vector2::new(0.5, 0.1), 0.3), 0.02);
    robot.joints = robot.arm.solve(&low, &robot.arm.ready).unwrap();
    let (outcome, _) = robot.run(&PrimitiveSettings::RIGID);
    assert_eq!(outcome, Ok(Outcome::Placed));
    let rise = robot.path[0].points();
    for point in rise {
        let tip = robot.arm.tip(&point.positions_rad).translation.vector;
        assert!((tip.xy() - Vector2::new(0.5, 0.1)).norm() < 1e-9);
    }
    let end = robot.arm.tip(&rise[rise.len() - 1].positions_rad);
    assert!((end.translation.z - PrimitiveSettings::RIGID.clearance_m).abs() < 1e-9);
}

#[test]
fn a_full_gripper_is_refused_before_anything_moves() {
    let mut robot = ScriptedRobot::new();
    robot.suction = true;
    let (outcome, _) = robot.run(&PrimitiveSettings::RIGID);
    assert_eq!(outcome, Err(PrimitiveError::AlreadyHolding.into()));
    assert_eq!(robot.seen, []);
}

#[test]
fn bad_actions_and_settings_are_refused_by_name_before_anything_moves() {
    let mut robot = ScriptedRobot::new();
    let arm = robot.arm.clone();
    let mut refusal = |action: PickPlace, settings: PrimitiveSettings| {
        execute(&mut robot, &arm, &action, &settings, |_| ())
            .unwrap_err()
            .to_string()
    };
    let rigid = PrimitiveSettings::RIGID;
    let mut bad = action();
    bad.pick.translation.y = f64::NAN;
    assert_eq!(refusal(bad, rigid), "the pick pose is not finite");
    let mut bad = action();
    bad.place.translation.x = 1.1;
    let text = refusal(bad, rigid);
    assert!(
        text.starts_with("the place pose is out of reach") && text.contains("1.1"),
        "{text}"
    );
    for (settings, name) in [
        (
            PrimitiveSettings {
                clearance_m: 0.0,
                ..rigid
            },
            "clearance_m",
        ),
        (
            PrimitiveSettings {
                lift_m: f64::NAN,
                ..rigid
            },
            "lift_m",
        ),
        (
            PrimitiveSettings {
                travel_m_s: -1.0,
                ..rigid
            },
            "travel_m_s",
        ),
        (
            PrimitiveSettings {
                carry_m_s: 20.0,
                ..rigid
            },
            "carry_m_s",
        ),
        (
            PrimitiveSettings {
                descend_m_s: 0.0,
                ..rigid
            },
            "descend_m_s",
        ),
        (
            PrimitiveSettings {
                acceleration_m_s2: f64::INFINITY,
                ..rigid
            },
            "acceleration_m_s2",
        ),
    ] {
        let text = refusal(action(), settings);
        assert!(
            text.starts_with(name) && text.contains("expected"),
            "{text}"
        );
    }
    assert_eq!(robot.calls, 0);
}

#[test]
fn after_a_fault_the_arm_can_be_taken_home_with_what_it_holds() {
    for motion in 0..7 {
        let mut robot = ScriptedRobot::new();
        robot.stops_in = Some(motion);
        robot.run(&PrimitiveSettings::RIGID).0.unwrap_err();
        robot.stops_in = None;
        let (arm, suction, commands) = (robot.arm.clone(), robot.suction, robot.seen.len());
        go_home(&mut robot, &arm, &PrimitiveSettings::RIGID).unwrap();
        assert!(robot.is_home());
        assert_eq!(robot.suction, suction);
        let heights: Vec<_> = robot.seen[commands..].iter().collect();
        assert!(
            matches!(heights[..], [.., Seen::Follow { height_m }] if (height_m - 0.324).abs() < 1e-2),
            "{heights:?}"
        );
    }
}

/// Where the pick has lifted it from.
fn back() -> PutDown {
    PutDown {
        at: action().tips().0,
        contact_m: 0.04,
        slow_from_m: 0.03,
        slow_m_s: 0.05,
        window_m: 0.015,
        senses: true,
    }
}

#[test]
fn after_a_fault_what_is_held_is_put_down_where_it_was_picked() {
    // Lift, transfer and the descent to the place.
    for motion in 2..5 {
        let mut robot = ScriptedRobot::new();
        robot.stops_in = Some(motion);
        robot.run(&PrimitiveSettings::RIGID).0.unwrap_err();
        robot.stops_in = None;
        robot.contacts_m = [Some(0.04); 2];
        assert!(robot.suction, "motion {motion}");
        let (arm, commands) = (robot.arm.clone(), robot.seen.len());
        put_down(&mut robot, &arm, &back(), &PrimitiveSettings::RIGID).unwrap();
        assert!(robot.is_home() && !robot.suction);
        let seen = &robot.seen[commands..];
        let release = seen.iter().position(|seen| *seen == Seen::Suction(false));
        let Seen::Descend { height_m } = seen[release.unwrap() - 1] else {
            panic!("{seen:?}");
        };
        assert!((height_m - 0.04).abs() < 1e-3, "{seen:?}");
        // Slowly from 30 mm above it, and straight down: the tip turned as at the pick.
        let descent = &robot.path[robot.path.len() - 3];
        let start = arm.tip(&descent.points()[0].positions_rad);
        assert!((start.translation.z - 0.07).abs() < 1e-3, "{start}");
        let expected = Arm::tip_down(&back().at, 0.07);
        assert!(start.rotation.angle_to(&expected.rotation) < 1e-3);
    }
}

#[test]
fn nothing_is_put_down_that_is_not_held_or_meets_something_too_early_or_nothing() {
    let arm = WorkCell::builtin().unwrap().arm;
    let mut robot = ScriptedRobot::new();
    let error = put_down(&mut robot, &arm, &back(), &PrimitiveSettings::RIGID).unwrap_err();
    assert_eq!(error, ExecuteError::Primitive(PrimitiveError::HoldsNothing));
    assert!(robot.seen.is_empty());
    let mut robot = ScriptedRobot::new();
    robot.stops_in = Some(3);
    robot.run(&PrimitiveSettings::RIGID).0.unwrap_err();
    robot.stops_in = None;
    // Somebody has put something there.
    robot.contacts_m = [Some(0.06); 2];
    let error = put_down(&mut robot, &arm, &back(), &PrimitiveSettings::RIGID).unwrap_err();
    let ExecuteError::Primitive(PrimitiveError::UnexpectedContact {
        phase: Phase::DescendToPlace,
        height_m,
        highest_m,
    }) = error
    else {
        panic!("{error}");
    };
    // It is noticed at the next point of the way down.
    assert!((0.059..=0.06).contains(&height_m), "{height_m}");
    assert!((highest_m - 0.055).abs() < 1e-9, "{highest_m}");
    // It holds what it held.
    assert!(robot.suction);
    // What stood under it is gone.
    robot.descents = 0;
    robot.contacts_m = [None; 2];
    let error = put_down(&mut robot, &arm, &back(), &PrimitiveSettings::RIGID).unwrap_err();
    assert!(
        error.to_string().contains("DescendToPlace: no contact"),
        "{error}"
    );
    assert!(robot.suction);
    let far = PutDown {
        at: Isometry2::new(Vector2::new(3.0, 0.0), 0.0),
        ..back()
    };
    let error = put_down(&mut robot, &arm, &far, &PrimitiveSettings::RIGID).unwrap_err();
    assert!(
        error.to_string().contains("put-down pose is out of reach"),
        "{error}"
    );
}

#[test]
fn a_report_that_answers_another_command_is_refused() {
    let arm = WorkCell::builtin().unwrap().arm;
    let fresh = || Primitive::new(&arm, &action(), &PrimitiveSettings::RIGID, &arm.home).unwrap();
    for report in [
        Report::Contact(arm.home),
        Report::NoContact(arm.home),
        Report::SuctionSet,
    ] {
        let mut primitive = fresh();
        primitive.next(Report::Holds(false)).unwrap();
        let phase = primitive.phase();
        let error = primitive.next(report).unwrap_err();
        assert_eq!(error, PrimitiveError::UnexpectedReport { phase, report });
    }
    assert!(fresh().next(Report::SuctionSet).is_err());
}

#[test]
fn the_highest_settings_still_work_in_the_middle_of_the_workspace() {
    let mut robot = ScriptedRobot::new();
    let highest = PrimitiveSettings {
        clearance_m: 0.5,
        lift_m: 0.5,
        ..PrimitiveSettings::RIGID
    };
    assert_eq!(robot.run(&highest).0, Ok(Outcome::Placed));
    assert!(robot.is_home());
}

/// An object of 40 mm on the table, to be put on the table.
const TOUCHDOWN: Touchdown = Touchdown {
    pick_m: 0.04,
    pick_ground_m: 0.0,
    place_m: 0.0,
    slow_from_m: 0.03,
    slow_m_s: 0.05,
    window_m: 0.01,
    press_m: 0.0,
    senses_pick: true,
    senses_place: true,
};

/// Highest speed of the tip in a motion (m/s).
fn fastest_m_s(arm: &Arm, motion: &JointTrajectory) -> f64 {
    let heights = motion.points().iter().map(|point| {
        let tip = arm.tip(&point.positions_rad).translation.vector;
        (point.time.as_secs_f64(), tip)
    });
    let heights: Vec<_> = heights.collect();
    let speeds = heights.windows(2).map(|pair| {
        let ((t0, p0), (t1, p1)) = (pair[0], pair[1]);
        (p1 - p0).norm() / (t1 - t0)
    });
    speeds.fold(0.0, f64::max)
}

#[test]
fn the_tip_slows_down_above_a_surface_that_is_known() {
    let mut robot = ScriptedRobot::new();
    robot.contacts_m = [Some(0.041), Some(0.042)];
    assert_eq!(robot.run_on(&TOUCHDOWN), Ok(Outcome::Placed));
    let mut descents = robot
        .path
        .iter()
        .filter(|motion| {
            let height_m = |joints: &Joints| robot.arm.tip(joints).translation.z;
            let (from_m, to_m) = (
                height_m(&motion.points()[0].positions_rad),
                height_m(&motion.last().positions_rad),
            );
            (from_m - 0.07).abs() < 2e-3 && to_m < 0.045
        })
        .map(|motion| fastest_m_s(&robot.arm, motion));
    for _ in 0..2 {
        let speed_m_s = descents.next().expect("a slow descent");
        assert!(speed_m_s < 0.0505, "{speed_m_s}");
    }
    let fast = robot
        .seen
        .iter()
        .filter(|seen| matches!(seen, Seen::Follow { height_m } if (height_m - 0.07).abs() < 2e-3));
    assert_eq!(fast.count(), 2);
}

#[test]
fn contact_where_nothing_was_seen_ends_the_primitive_and_holds_what_is_held() {
    let mut robot = ScriptedRobot::new();
    robot.contacts_m[0] = Some(0.06);
    let error = robot.run_on(&TOUCHDOWN).unwrap_err();
    assert!(
        error.to_string().contains("DescendToPick: contact at"),
        "{error}"
    );
    assert_eq!(suctions(&robot), [false; 0]);

    // At the place the tip is expected at the height of the object, 41 mm.
    let mut robot = ScriptedRobot::new();
    robot.contacts_m = [Some(0.041), Some(0.06)];
    let error = robot.run_on(&TOUCHDOWN).unwrap_err();
    assert!(
        error.to_string().contains("DescendToPlace: contact at"),
        "{error}"
    );
    assert_eq!(suctions(&robot), [true]);
}

#[test]
fn a_descent_that_meets_nothing_ends_below_the_window() {
    let mut robot = ScriptedRobot::new();
    robot.contacts_m[0] = None;
    assert_eq!(robot.run_on(&TOUCHDOWN), Ok(Outcome::NoContact));
    let lowest_m = robot.seen.iter().find_map(|seen| match seen {
        Seen::Descend { height_m } => Some(*height_m),
        _ => None,
    });
    assert!((lowest_m.unwrap() - 0.03).abs() < 1e-6, "{lowest_m:?}");
}

#[test]
fn the_cup_is_pressed_on_after_contact() {
    let touchdown = Touchdown {
        press_m: 0.002,
        ..TOUCHDOWN
    };
    let mut robot = ScriptedRobot::new();
    robot.contacts_m = [Some(0.04), Some(0.04)];
    assert_eq!(robot.run_on(&touchdown), Ok(Outcome::Placed));
    let at = robot
        .seen
        .iter()
        .position(|seen| *seen == Seen::Suction(true))
        .unwrap();
    let (
        Seen::Descend {
            height_m: contact_m,
        },
        Seen::Follow { height_m },
    ) = (robot.seen[at - 2], robot.seen[at - 1])
    else {
        panic!("{:?}", robot.seen);
    };
    assert!((contact_m - 0.002 - height_m).abs() < 1e-6);
}

#[test]
fn without_a_sense_of_contact_the_heights_that_were_seen_are_taken_for_it() {
    let touchdown = Touchdown {
        senses_pick: false,
        senses_place: false,
        press_m: 0.003,
        place_m: 0.01,
        ..TOUCHDOWN
    };
    let mut robot = ScriptedRobot::new();
    // Such a robot says contact at the end of its way.
    robot.contacts_m = [Some(0.0371), None];
    assert_eq!(robot.run_on(&touchdown), Ok(Outcome::Placed));
    let ends: Vec<f64> = robot
        .seen
        .iter()
        .filter_map(|seen| match seen {
            Seen::Descend { height_m } => Some(*height_m),
            _ => None,
        })
        .collect();
    // Down to 37 mm, which is as high as the object then hangs below the tip.
    assert!(
        (ends[0] - 0.037).abs() < 2e-4 && (ends[1] - 0.047).abs() < 2e-4,
        "{ends:?}"
    );
}

#[test]
fn what_is_held_is_put_down_by_height_where_only_the_empty_tool_senses_contact() {
    let touchdown = Touchdown {
        senses_place: false,
        ..TOUCHDOWN
    };
    let mut robot = ScriptedRobot::new();
    robot.contacts_m = [Some(0.041), None];
    assert_eq!(robot.run_on(&touchdown), Ok(Outcome::Placed));
    let end_m = robot.seen.iter().rev().find_map(|seen| match seen {
        Seen::Descend { height_m } => Some(*height_m),
        _ => None,
    });
    // Not to below the table: the object hangs below the tip, as high as it stood.
    assert!((end_m.unwrap() - 0.041).abs() < 1e-3, "{end_m:?}");
}

#[test]
fn what_is_held_stays_held_where_contact_is_expected_and_does_not_come() {
    let mut robot = ScriptedRobot::new();
    robot.contacts_m = [Some(0.041), None];
    let error = robot.run_on(&TOUCHDOWN).unwrap_err();
    let ExecuteError::Primitive(PrimitiveError::MissedContact {
        phase: DescendToPlace,
        height_m,
    }) = error
    else {
        panic!("{error}");
    };
    // The window is 10 mm, the table at 0.
    assert!((height_m + 0.01).abs() < 1e-6, "{height_m}");
    assert_eq!(suctions(&robot), [true]);
    assert!(!robot.is_home());

    // Where it was lost on the way down there is nothing to hold.
    let mut robot = ScriptedRobot::new();
    robot.contacts_m = [Some(0.041), None];
    // Motions: 0 approach, 1 and 2 descent, 3 lift, 4 transfer, 5 and 6 descent.
    robot.drops_at = Some(6);
    assert_eq!(robot.run_on(&TOUCHDOWN), Ok(Outcome::Dropped));
    assert_eq!(suctions(&robot), [true, false]);
    assert!(robot.is_home());
}

#[test]
fn without_known_surfaces_what_is_held_is_released_at_the_end_of_the_way_down() {
    let mut robot = ScriptedRobot::new();
    robot.contacts_m = [Some(0.04), None];
    let (outcome, _) = robot.run(&PrimitiveSettings::RIGID);
    assert_eq!(outcome, Ok(Outcome::Placed));
    assert_eq!(suctions(&robot), [true, false]);
}

#[test]
fn heights_out_of_range_are_refused_by_name() {
    let touchdown = Touchdown {
        window_m: f64::NAN,
        ..TOUCHDOWN
    };
    let error = ScriptedRobot::new().run_on(&touchdown).unwrap_err();
    assert!(error.to_string().contains("window_m"), "{error}");
}
