//! Time of one demonstration: reset, and per step the action, three rendered views and their
//! fusion, on one thread.

use criterion::{Criterion, criterion_group, criterion_main};
use multiravens::{Environment, Problem};
use std::path::Path;
use ur5::WorkCell;

fn demonstration(c: &mut Criterion) {
    let problems = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/problems");
    let work_cell = WorkCell::builtin().expect("the work cell of this repository");
    let mut group = c.benchmark_group("demonstration");
    group.sample_size(10);
    for name in Problem::names(&problems).expect("config/problems") {
        let problem = Problem::load(&problems, &name).expect("a problem of this repository");
        let mut environment = Environment::new(&problem, &work_cell);
        let mut seed = 0;
        group.bench_function(&name, |b| {
            b.iter(|| {
                environment.reset(seed).expect("a scene at rest");
                environment.observe().expect("views");
                while let (false, Some(action)) = (environment.is_done(), environment.demonstrate())
                {
                    environment.step(&action).expect("a step");
                    environment.observe().expect("views");
                }
                seed += 2;
            });
        });
    }
    group.finish();
}

criterion_group!(benches, demonstration);
criterion_main!(benches);
