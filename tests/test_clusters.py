"""`sctn sweep` on a cluster: the results of one process, also after a worker was killed. Left out where Ray or Slurm is not installed."""

from __future__ import annotations

import json
import os
import pathlib
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator

import pytest
from processes import BINARIES, REPOSITORY

SCTN = BINARIES / "sctn"
# A Python with Ray: `python3 -m venv V && V/bin/python -m pip install ray==2.60.0`.
RAY_PYTHON = os.environ.get("RAY_PYTHON", sys.executable)
RECIPE = """
problems: [placing]
agents: [gctn, sctn_step]
demonstrations: [1]
seeds: [0, 1]
network:
  network: {kind: compact, channels: [4, 4, 8, 8], blocks: [0, 0, 0, 0], window_cells: 9}
training:
  seed: 0
  steps: 20
  batch: 1
  learning_rate: 0.001
  schedule: cosine
  warm_up_steps: 2
  weight_decay: 0.01
  gradient_clip: 5.0
  place_loss: right_and_one_wrong
  label_sigma_cells: 0.7
  augmentation: {rotation_sigma_deg: 60.0, translation_sigma_px: 26.67}
  threads: 1
snapshots: 2
validation: {episodes: 1, seed: 1}
test: {episodes: 1, seed: 10000}
"""
RUNS = 4


class Sweep:
    """Four short runs, and what they come to in one process."""

    expected: dict[str, dict]

    def __init__(self, folder: pathlib.Path) -> None:
        self.folder = folder
        (folder / "sweep.yaml").write_text(RECIPE)

    def run_here(self) -> None:
        self.sctn("demos", "--problem", "placing", "--episodes", "1", "--seed", "0", "--out", self.folder / "demos")
        self.run("local")
        self.expected = self.results("local")
        assert len(self.expected) == RUNS

    def sctn(self, *arguments: object) -> None:
        subprocess.run([SCTN, *map(str, arguments)], check=True, cwd=REPOSITORY, timeout=300)

    def arguments(self, out: str) -> list[str]:
        folder = self.folder
        return ["sweep", "--sweep", f"{folder}/sweep.yaml", "--demos", f"{folder}/demos", "--out", f"{folder}/{out}"]

    def run(self, out: str, *arguments: str) -> None:
        self.sctn(*self.arguments(out), *arguments)

    def results(self, out: str) -> dict[str, dict]:
        results = {path.name: json.loads(path.read_text()) for path in (self.folder / out).glob("*.json")}
        for result in results.values():
            assert result.pop("cpu_seconds") > 0
        return results


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Sweep:
    sweep = Sweep(tmp_path_factory.mktemp("sweep"))
    sweep.run_here()
    return sweep


def wait_for(found: Callable[[], object], seconds: float, what: str) -> object:
    """What `found` returns once that is something."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if result := found():
            return result
        time.sleep(0.02)
    raise AssertionError(f"{what}: not within {seconds} s")


def end(process: subprocess.Popen) -> None:
    process.send_signal(signal.SIGTERM)
    try:
        process.wait(30)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


@pytest.fixture
def ray_cluster() -> Iterator[dict[str, str]]:
    """A Ray of two workers on this host; gives the environment of those who use it."""
    program = pathlib.Path(RAY_PYTHON).with_name("ray")
    if not program.exists():
        pytest.skip(f"no Ray beside {RAY_PYTHON}: install it there (pip install ray), or let RAY_PYTHON name a Python that has it")
    address = f"127.0.0.1:{free_port()}"
    environment = os.environ | {"RAY_ADDRESS": address, "RAY_USAGE_STATS_ENABLED": "0", "RAY_AUTH_MODE": "disabled"}
    # Ray's workers have niceness 15 otherwise: beside other work they hardly get on.
    environment["RAY_worker_niceness"] = "0"
    # Ray's sockets are in this folder, and their paths are short.
    with tempfile.TemporaryDirectory(prefix="ray") as folder:
        command = [program, "start", "--head", "--block", "--num-cpus=2", "--num-gpus=0", "--include-dashboard=false"]
        command += ["--node-ip-address=127.0.0.1", f"--port={address.split(':')[1]}", f"--temp-dir={folder}"]
        head = subprocess.Popen(command, env=environment)
        try:

            def is_up() -> bool:
                status = [program, "status", f"--address={address}"]
                return subprocess.run(status, env=environment, capture_output=True, check=False).returncode == 0

            wait_for(is_up, 120, "Ray")
            yield environment
        finally:
            end(head)


def worker_of(out: pathlib.Path) -> int | None:
    """The Ray worker of a run that has kept its first state and is not done."""
    for state in out.glob("runs/*/state.safetensors"):
        if (out / f"{state.parent.name}.json").exists():
            continue
        for path in pathlib.Path("/proc").glob("[0-9]*"):
            try:
                command = (path / "cmdline").read_bytes().split(b"\0")
                if str(out).encode() in command and b"--part" in command and os.readlink(path / "exe") == str(SCTN.resolve()):
                    locks = (path / "fd").iterdir()
                    if any(os.readlink(lock).endswith(f"/{state.parent.name}.lock") for lock in locks):
                        return int((path / "stat").read_text().rsplit(")", 1)[1].split()[1])
            except OSError:
                continue
    return None


def test_a_sweep_on_ray_gives_the_same_results_though_a_worker_is_killed(ray_cluster: dict[str, str], sweep: Sweep) -> None:
    command = [SCTN, *sweep.arguments("ray"), "--engine", "ray", "--python", RAY_PYTHON]
    running = subprocess.Popen(command, env=ray_cluster, cwd=REPOSITORY, stderr=subprocess.PIPE, text=True)
    try:
        worker = wait_for(lambda: worker_of(sweep.folder / "ray"), 120, "a run that is half done")
        os.kill(worker, signal.SIGKILL)
        _, log = running.communicate(timeout=300)
    finally:
        running.kill()
    print(log)
    assert running.returncode == 0
    assert sweep.results("ray") == sweep.expected
    # Done is done: nothing is started, no Ray is asked for.
    sweep.run("ray", "--engine", "ray", "--python", "/nonexistent")


def test_a_python_without_ray_is_named(tmp_path: pathlib.Path) -> None:
    command = [SCTN, *Sweep(tmp_path).arguments("none"), "--engine", "ray", "--python", "/nonexistent"]
    refused = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert refused.returncode == 1
    assert "/nonexistent: expected a Python with the package ray; --python names one" in refused.stderr


SLURM = """
ClusterName=test
SlurmctldHost=localhost(127.0.0.1)
SlurmctldPort={controller}
SlurmdPort={node}
SlurmUser=root
AuthType=auth/munge
CryptoType=crypto/munge
AuthInfo=socket={folder}/munge.socket
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SchedulerParameters=sched_interval=2,batch_sched_delay=1
ReturnToService=2
NodeName=node NodeAddr=127.0.0.1 NodeHostname=localhost CPUs=2
PartitionName=all Nodes=node Default=YES MaxTime=INFINITE State=UP
"""


@pytest.fixture
def slurm_cluster() -> Iterator[dict[str, str]]:
    """A Slurm of one host with two cores; gives the environment of those who use it."""
    search = f"{os.environ['PATH']}:/usr/sbin"
    programs = {name: shutil.which(name, path=search) for name in ("munged", "slurmctld", "slurmd", "sinfo", "sbatch")}
    if missing := [name for name, path in programs.items() if path is None]:
        pytest.skip(f"no {', '.join(missing)} here: apt install --no-install-recommends slurm-wlm")
    if os.getuid() != 0:
        pytest.skip("a slurmd that starts jobs needs root")
    with tempfile.TemporaryDirectory(prefix="slurm") as name:
        folder = pathlib.Path(name)
        configuration = folder / "slurm.conf"
        ports = {"controller": free_port(), "node": free_port()}
        configuration.write_text(SLURM.format(folder=folder, **ports))
        key = folder / "munge.key"
        key.write_bytes(os.urandom(1024))
        key.chmod(0o600)
        environment = os.environ | {"SLURM_CONF": str(configuration)}
        files = [f"--{kind}-file={folder}/munge.{kind}" for kind in ("key", "log", "pid", "seed")]
        # A folder that everybody may write to is accepted with --force.
        munge = [programs["munged"], "--foreground", "--force", f"--socket={folder}/munge.socket", *files]
        running = []
        try:
            for command in (munge, [programs["slurmctld"], "-D"], [programs["slurmd"], "-D", "-N", "node"]):
                running.append(subprocess.Popen(command, env=environment))
                if command is munge:
                    wait_for((folder / "munge.socket").exists, 30, "munged")

            def is_idle() -> bool:
                status = [programs["sinfo"], "--noheader", "--format=%t"]
                return subprocess.run(status, env=environment, capture_output=True, text=True, check=False).stdout.strip() == "idle"

            wait_for(is_idle, 60, "Slurm's node")
            yield environment
        finally:
            for process in reversed(running):
                end(process)


def test_a_sweep_on_slurm_gives_the_same_results(slurm_cluster: dict[str, str], sweep: Sweep) -> None:
    command = [SCTN, *sweep.arguments("slurm"), "--engine", "slurm"]
    ended = subprocess.run(command, env=slurm_cluster, cwd=REPOSITORY, check=False, timeout=300)
    logs = [path.read_text() for path in (sweep.folder / "slurm/slurm").iterdir()]
    assert ended.returncode == 0, logs
    assert len(logs) == RUNS
    assert sweep.results("slurm") == sweep.expected
