//! `sctn bench idle`: what the graph costs while it waits for an operator.

use anyhow::{Context as _, Result, bail};
use serde_json::json;
use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// A domain of its own, on the loopback device only.
const DOMAIN_ID: &str = "99";
/// Until the first proposal is made, and then until nothing of the start is left.
const PATIENCE: Duration = Duration::from_secs(60);
const SETTLE: Duration = Duration::from_secs(5);
const MEASURED: Duration = Duration::from_secs(30);
/// What /proc counts processor time in, on every Linux.
const TICKS_PER_SECOND: f64 = 100.0;

/// The launch, and with it the nodes that it has started.
struct Graph(Child);

impl Drop for Graph {
    fn drop(&mut self) {
        let pid = rustix::process::Pid::from_child(&self.0);
        let _ = rustix::process::kill_process(pid, rustix::process::Signal::INT);
        let _ = self.0.wait();
    }
}

/// A process of the graph.
struct Node {
    pid: u32,
    name: String,
}

impl Node {
    /// Children of a process.
    fn children(parent: u32) -> Result<Vec<Self>> {
        let mut nodes = Vec::new();
        for entry in std::fs::read_dir("/proc")? {
            let Some(pid) = entry?
                .file_name()
                .to_str()
                .and_then(|name| name.parse().ok())
            else {
                continue;
            };
            // A process that has ended meanwhile uses nothing.
            let Some(fields) = stat(pid) else { continue };
            if fields.get(1).and_then(|field| field.parse().ok()) == Some(parent) {
                let path = std::fs::read_link(format!("/proc/{pid}/exe"))?;
                let name = path.file_name().unwrap_or_default();
                let name = name.to_string_lossy().into_owned();
                nodes.push(Self { pid, name });
            }
        }
        nodes.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(nodes)
    }

    /// Processor time so far, in s.
    fn processor_s(&self) -> Result<f64> {
        let fields = stat(self.pid).with_context(|| format!("{} has ended", self.name))?;
        let ticks = |index: usize| {
            fields
                .get(index)
                .and_then(|field| field.parse::<f64>().ok())
        };
        let (user, system) = ticks(11).zip(ticks(12)).context("/proc/PID/stat")?;
        Ok((user + system) / TICKS_PER_SECOND)
    }

    /// Memory, with its share of what it has in common with others, and how much of it is libtorch's code [MB].
    fn memory_mb(&self) -> Result<(f64, f64)> {
        let text = std::fs::read_to_string(format!("/proc/{}/smaps", self.pid))?;
        let (mut all, mut libtorch, mut in_libtorch) = (0.0, 0.0, false);
        for line in text.lines() {
            let mut fields = line.split_whitespace();
            match fields.next() {
                Some("Pss:") => {
                    let kilobytes: f64 = fields.next().context("/proc/PID/smaps")?.parse()?;
                    let megabytes = kilobytes * 1024.0 / 1e6;
                    all += megabytes;
                    libtorch += if in_libtorch { megabytes } else { 0.0 };
                }
                // A mapping: addresses, permissions, offset, device, inode, file.
                Some(addresses) if addresses.contains('-') => {
                    in_libtorch = fields
                        .nth(4)
                        .is_some_and(|file| file.contains("/libtorch") || file.contains("/libc10"));
                }
                _ => {}
            }
        }
        Ok((all, libtorch))
    }
}

/// What /proc says of a process after its name: state, parent, ...
fn stat(pid: u32) -> Option<Vec<String>> {
    let text = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    let (_, rest) = text.rsplit_once(')')?;
    Some(rest.split_whitespace().map(str::to_owned).collect())
}

/// Starts the graph as five processes, and measures them while they wait for the approval of the first proposal.
pub fn run(as_json: bool) -> Result<()> {
    let program = std::env::current_exe().context("path of the program")?;
    let mut child = Command::new(program)
        .args(["launch", "--problem", "placing", "--seed", "10000"])
        .args(["--operator", "none", "--processes"])
        .env("ROS_DOMAIN_ID", DOMAIN_ID)
        .env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .spawn()?;
    let output = BufReader::new(child.stdout.take().context("output of the launch")?);
    let graph = Graph(child);
    let (proposals, proposed) = std::sync::mpsc::channel();
    std::thread::spawn(move || {
        for line in output.lines().map_while(Result::ok) {
            if line.starts_with("step 1") {
                let _ = proposals.send(());
            }
        }
    });
    if proposed.recv_timeout(PATIENCE).is_err() {
        bail!("no proposal within {} s", PATIENCE.as_secs());
    }
    std::thread::sleep(SETTLE);
    let nodes = Node::children(graph.0.id())?;
    let started = Instant::now();
    let before = nodes.iter().map(Node::processor_s);
    let before: Vec<f64> = before.collect::<Result<_>>()?;
    std::thread::sleep(MEASURED);
    let (mut processor, mut memory_mb, mut libtorch_mb) = (0.0, 0.0, 0.0);
    let mut each = serde_json::Map::new();
    let said = |name: &str, used: f64, memory: f64, libtorch: f64| {
        if !as_json {
            println!(
                "{name:20} {:5.2} % of a core {memory:7.1} MB, of it {libtorch:5.1} MB libtorch's code",
                100.0 * used
            );
        }
        json!({"processor": used, "memory_mb": memory, "libtorch_mb": libtorch})
    };
    for (node, before) in nodes.iter().zip(before) {
        let used = (node.processor_s()? - before) / started.elapsed().as_secs_f64();
        let (memory, libtorch) = node.memory_mb()?;
        each.insert(node.name.clone(), said(&node.name, used, memory, libtorch));
        processor += used;
        memory_mb += memory;
        libtorch_mb += libtorch;
    }
    let mut together = said("together", processor, memory_mb, libtorch_mb);
    if as_json {
        together["nodes"] = each.into();
        println!("{together}");
    }
    Ok(())
}
