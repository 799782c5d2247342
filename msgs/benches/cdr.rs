//! Writing and reading the two big messages as CDR.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use msgs::{ByteBuf, Interface, from_cdr, sctn_msgs, sensor_msgs, to_cdr, to_cdr_in};

fn both_ways<T: Interface>(criterion: &mut Criterion, name: &str, message: &T) {
    let bytes = to_cdr(message).unwrap();
    let mut group = criterion.benchmark_group(name);
    group.throughput(Throughput::Bytes(bytes.len() as u64));
    let mut buffer = Vec::new();
    group.bench_function("write", |bencher| {
        bencher.iter(|| to_cdr_in(message, &mut buffer).unwrap())
    });
    group.bench_function("read", |bencher| {
        bencher.iter(|| from_cdr::<T>(&bytes).unwrap())
    });
    group.finish();
}

fn cdr(criterion: &mut Criterion) {
    let cells = 320 * 160;
    let heightmap = sctn_msgs::Heightmap {
        rows: 320,
        cols: 160,
        rgb: ByteBuf::from(vec![128; 3 * cells]),
        height_m: (0..cells).map(|cell| cell as f32).collect(),
        ..Default::default()
    };
    both_ways(criterion, "heightmap_320x160", &heightmap);
    let image = sensor_msgs::Image {
        width: 640,
        height: 480,
        step: 1920,
        encoding: "rgb8".into(),
        data: ByteBuf::from(vec![128; 640 * 480 * 3]),
        ..Default::default()
    };
    both_ways(criterion, "image_640x480_rgb8", &image);
}

criterion_group!(benches, cdr);
criterion_main!(benches);
