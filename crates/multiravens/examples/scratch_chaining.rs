//! scratch
use multiravens::*;
use pick_place::*;
use std::collections::BTreeMap;
use ur5::*;
fn cpu() -> f64 {
    let s = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap();
    s.split(' ').next().unwrap().parse::<f64>().unwrap() * 1e-9
}
struct Watched<'a> {
    cell: &'a mut Cell,
    w: &'a mut Watch,
}
#[derive(Default, Clone)]
struct Watch {
    speed: f64,
    gap: f64,
    peg: f64,
    low: f64,
}
impl Watched<'_> {
    fn run(&mut self, t: &JointTrajectory, c: bool) -> Result<MotionEnd, CellError> {
        self.cell.begin(t.clone(), c)?;
        loop {
            let t = self.cell.tick()?;
            self.look();
            if let Tick::Ended(e) = t {
                return Ok(e);
            }
        }
    }
    fn look(&mut self) {
        let w = self.cell.world();
        self.w.speed = self.w.speed.max(w.fastest_m_s());
        let mut pegs = vec![];
        let mut beads = vec![];
        for b in w.bodies() {
            match w.shape(b) {
                Shape::Cylinder { radius_m, .. } => pegs.push((w.position(b), radius_m)),
                Shape::Sphere { .. } => beads.push(w.position(b)),
                _ => {}
            }
        }
        for (i, b) in beads.iter().enumerate() {
            let n = &beads[(i + 1) % beads.len()];
            self.w.gap = self.w.gap.max(((b - n).norm() - 0.01414).abs());
            self.w.low = self.w.low.max(0.006 - b.z);
            for (p, r) in &pegs {
                if b.z < 0.03 {
                    self.w.peg = self.w.peg.max(r + 0.006 - (b.xy() - p.xy()).norm());
                }
            }
        }
    }
}
impl Robot for Watched<'_> {
    type Error = CellError;
    fn joints(&mut self) -> Result<Joints, CellError> {
        Ok(self.cell.joint_positions())
    }
    fn follow(&mut self, t: &JointTrajectory) -> Result<bool, CellError> {
        Ok(self.run(t, false)? == MotionEnd::Reached)
    }
    fn follow_until_contact(&mut self, t: &JointTrajectory) -> Result<bool, CellError> {
        Ok(self.run(t, true)? == MotionEnd::Contact)
    }
    fn set_suction(&mut self, on: bool) -> Result<(), CellError> {
        self.cell.set_suction(on);
        Ok(())
    }
    fn holds(&mut self) -> Result<bool, CellError> {
        Ok(self.cell.is_holding())
    }
}
fn main() {
    let arg = |i: usize, d: u64| std::env::args().nth(i).map_or(d, |a| a.parse().unwrap());
    let (from, n) = (arg(1, 0), arg(2, 10));
    let watch = std::env::var("WATCH").is_ok();
    let verbose = std::env::var("V").is_ok();
    let picture: Option<String> = std::env::var("PIC").ok();
    let problem = Problem::load(
        std::path::Path::new("config/problems"),
        &std::env::var("PROBLEM").unwrap_or("chaining".into()),
    )
    .unwrap();
    let mut env = Environment::new(&problem, &WorkCell::builtin().unwrap());
    let arm = WorkCell::builtin().unwrap().arm;
    let (mut ok, mut steps, mut sim) = (0, 0, 0.0);
    let mut hist: BTreeMap<String, usize> = BTreeMap::new();
    let mut montage: Option<image::RgbImage> = None;
    let mut worst = Watch::default();
    let t0 = cpu();
    for seed in from..from + n {
        let c0 = cpu();
        env.reset(seed).unwrap();
        env.observe().unwrap();
        let mut trace = String::new();
        let mut w = Watch::default();
        let reset = cpu() - c0;
        let mut shot = |env: &mut Environment, name: String| {
            if let Some(dir) = &picture {
                let h = env.observe().unwrap();
                // crop rows where y > 0.2
                let (rows, cols) = (h.workspace.rows, h.workspace.cols);
                let r0 = rows * 7 / 10;
                let _ = (&dir, &name);
                let im = image::RgbImage::from_raw(
                    cols as u32,
                    (rows - r0) as u32,
                    h.rgb[r0 * cols * 3..].to_vec(),
                )
                .unwrap();
                let im = image::imageops::resize(
                    &im,
                    2 * im.width(),
                    2 * im.height(),
                    image::imageops::FilterType::Nearest,
                );
                let (tw, th) = (im.width() + 6, im.height() + 6);
                let m = montage.get_or_insert_with(|| {
                    image::RgbImage::from_pixel(5 * tw, n as u32 * th, image::Rgb([255, 0, 0]))
                });
                let col: u32 = name.parse().unwrap();
                image::imageops::replace(
                    m,
                    &im,
                    (col * tw) as i64,
                    ((seed - from) as u32 * th) as i64,
                );
            }
        };
        shot(&mut env, "0".into());
        while !env.is_done() {
            let Some(a) = env.demonstrate() else {
                trace += "none";
                break;
            };
            let (o, d, settled) = if watch {
                let settings = env.settings().unwrap();
                let mut r = Watched {
                    cell: env.cell_mut(),
                    w: &mut w,
                };
                let o = execute(&mut r, &arm, &a, &settings, |_| ()).unwrap();
                let s = env.assess();
                (o, s.delta_reward, env.cell().is_settled())
            } else {
                let r = env.step(&a).unwrap();
                (r.outcome, r.delta_reward, r.settled)
            };
            env.observe().unwrap();
            steps += 1;
            let name = env.steps().to_string();
            shot(&mut env, name);
            trace += &format!("{o:?}{d:+}{} ", if settled { "" } else { "!UNSETTLED" });
        }
        sim += env.cell().time().as_secs_f64();
        ok += u32::from(env.is_complete());
        worst.speed = worst.speed.max(w.speed);
        worst.gap = worst.gap.max(w.gap);
        worst.peg = worst.peg.max(w.peg);
        worst.low = worst.low.max(w.low);
        *hist.entry(trace.clone()).or_default() += 1;
        if verbose || !env.is_complete() {
            println!(
                "seed {seed} {} {trace} cpu {:.2} reset {reset:.2} speed {:.2} gap {:.2}mm peg {:.2} low {:.2}",
                env.cell().world().bodies().count(),
                cpu() - c0,
                w.speed,
                w.gap * 1e3,
                w.peg * 1e3,
                w.low * 1e3
            );
        }
    }
    for (k, v) in &hist {
        println!("{v:4} {k}");
    }
    println!(
        "{ok}/{n} steps {:.2} sim {:.1}s cpu {:.2}s worst speed {:.2} gap {:.2}mm peg {:.2}mm low {:.2}mm",
        steps as f64 / n as f64,
        sim / n as f64,
        (cpu() - t0) / n as f64,
        worst.speed,
        worst.gap * 1e3,
        worst.peg * 1e3,
        worst.low * 1e3
    );
    if let Some(m) = montage {
        m.save(std::env::var("PIC").unwrap()).unwrap();
    }
}
