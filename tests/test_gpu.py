"""`cargo xtask gpu`: what is run on a host with a GPU, tried on the processor with small numbers."""

from __future__ import annotations

import json
import pathlib
import subprocess

import pytest
from processes import BINARIES

RECIPE = """
problems: [placing]
demonstrations: 1
network: {network: {kind: compact, channels: [4, 4, 8, 8], blocks: [0, 0, 0, 0], window_cells: 5}, rotations: 4}
training: {seed: 0, steps: 100000, batch: 1, learning_rate: 0.001, schedule: constant, warm_up_steps: 1, weight_decay: 0.0,
  gradient_clip: 5.0, place_loss: right_and_one_wrong, label_sigma_cells: 0.7, augmentation: {}, threads: 1}
snapshots: 1
validation: {episodes: 0, seed: 1}
"""

# Built by `cargo xtask` itself, which a person may not have used.
pytestmark = pytest.mark.skipif(not (BINARIES / "xtask").exists(), reason="xtask was not built in release")


def xtask_gpu(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [BINARIES / "xtask", "gpu", "--programs", BINARIES, *arguments]
    return subprocess.run([str(word) for word in command], capture_output=True, text=True, timeout=300.0)


def test_the_script_for_a_gpu_runs_on_the_processor_and_one_file_comes_back(tmp_path: pathlib.Path) -> None:
    recipe, out = tmp_path / "tiny.yaml", tmp_path / "gpu.json"
    recipe.write_text(RECIPE)
    bench = "--bench=--networks compact --batches 1,2 --steps 2"
    run = xtask_gpu("--device", "cpu", "--minutes", 1.0, "--recipes", recipe, "--problems", "placing", "--demonstrations", 1,
                    "--episodes", 1, "--out", out, bench)  # fmt: skip
    assert run.returncode == 0, run.stdout + run.stderr
    report = json.loads(out.read_text())
    assert report["device"] == "cpu"
    assert report["card"] is None
    [parity] = report["parity"]["parity"]
    # The processor is compared with itself.
    assert (parity["network"], parity["steps"], parity["largest_difference"]) == ("compact", 2, 0.0)
    assert parity["last_losses"][0] > 0.0
    speed = report["speed"]["speed"]
    assert {(one["network"], one["batch"]) for one in speed} == {("compact", 1), ("compact", 2)}
    for one in speed:
        assert 0.0 < one["samples_per_s"] <= 1.5 * one["limit_samples_per_s"], one
    [training] = report["trainings"]
    assert training["training"]["stopped"] == "deadline"
    assert training["training"]["step"] >= 1
    assert training["test"]["episodes"] == 1
    # What is large stays there.
    assert not list(tmp_path.glob("gpu/**/*.safetensors"))
    assert list(tmp_path.glob("gpu/*.log"))


def test_what_fails_is_named_and_the_file_comes_back_all_the_same(tmp_path: pathlib.Path) -> None:
    out = tmp_path / "gpu.json"
    run = xtask_gpu("--device", "gpu", "--out", out, "--problems", "nothing")
    assert run.returncode != 0
    assert "device is gpu, expected cpu, cuda or cuda:N" in run.stderr
    report = json.loads(out.read_text())
    assert "device is gpu" in report["parity"]["error"]
    assert "nothing" in report["trainings"]["error"]
