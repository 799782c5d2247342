//! How long forward kinematics and planning take; `sctn bench inverse_kinematics` times the inverse.

use criterion::{Criterion, criterion_group, criterion_main};
use nalgebra::{Isometry2, Vector2};
use std::hint::black_box;
use std::time::Duration;
use ur5::{Arm, JointTrajectory, WorkCell};

fn kinematics(criterion: &mut Criterion) {
    let cell = WorkCell::builtin().expect("the cell is in order");
    let arm = &cell.arm;
    let over = |x, y| Arm::tip_down(&Isometry2::new(Vector2::new(x, y), 0.4), 0.1);
    let (start, end) = (over(0.4, -0.3), over(0.6, 0.3));
    let joints = arm.solve(&start, &arm.ready).expect("in reach");
    let plan = || JointTrajectory::line(arm, &joints, &end, 0.5, 2.0).expect("in reach");
    let line = plan();
    let half = line.duration() / 2 + Duration::from_nanos(12_345);
    criterion.bench_function("forward kinematics", |bencher| {
        bencher.iter(|| arm.tip(black_box(&joints)))
    });
    criterion.bench_function("plan a line of 0.6 m", |bencher| bencher.iter(plan));
    criterion.bench_function("sample", |bencher| {
        bencher.iter(|| line.sample(black_box(half)))
    });
}

criterion_group!(benches, kinematics);
criterion_main!(benches);
