"""What is installed: its types, its wheel, its examples."""

from __future__ import annotations

import importlib.metadata
import json
import math
import pathlib
import subprocess
import sys

import pytest

import multiravens

FOLDER = pathlib.Path(__file__).resolve().parents[1]


def run(*arguments: str, timeout: float = 1200.0) -> str:
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, cwd=FOLDER, timeout=timeout, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_one_wheel_serves_every_cpython_from_3_10_on():
    extension = pathlib.Path(multiravens._multiravens.__file__)
    assert extension.name == "_multiravens.abi3.so"
    wheel = importlib.metadata.distribution("multiravens").read_text("WHEEL")
    assert "Tag: cp310-abi3-" in wheel
    assert (extension.parent / "py.typed").exists()


def test_everything_public_has_a_docstring():
    for name in multiravens.__all__:
        found = getattr(multiravens, name)
        if not isinstance(found, multiravens.Workspace) and callable(found):
            assert found.__doc__, name
            members = (value for member, value in getattr(found, "__dict__", {}).items() if not member.startswith("_"))
            assert all(value.__doc__ for value in members if callable(value)), name


def test_the_types_are_sound_and_the_stubs_are_those_of_the_extension_module(tmp_path):
    settings = str(FOLDER / "pyproject.toml")
    run("-m", "mypy", "--config-file", settings, "--cache-dir", str(tmp_path))
    run("-m", "mypy.stubtest", "--mypy-config-file", settings, "--ignore-disjoint-bases", "multiravens._multiravens")


def test_the_random_example_earns_next_to_nothing():
    lines = run("examples/random_actions.py", "stacking").splitlines()
    assert len(lines) == 3
    assert all("8 steps, reward 0.00" in line for line in lines)


def test_the_transporter_example_learns_and_acts(torch):
    out = run("examples/transporter.py", "--demonstrations", "4", "--steps", "200", "--episodes", "1")
    losses = [float(line.split()[-1]) for line in out.splitlines() if line.startswith("step")]
    assert len(losses) == 2
    # Where nothing is learned: the logarithms of 160 x 80 picks and of 8 times as many places.
    nothing = 2 * math.log(160 * 80) + math.log(8)
    assert losses[1] < 0.7 * losses[0] < 0.7 * nothing
    assert "completed" in out


def test_the_evaluation_example_says_what_sctn_evaluate_says(torch, sctn):
    checkpoint = FOLDER.parent / "config/checkpoints/any_start.safetensors"
    arguments = ["--problem", "stacking", "--episodes", "3", "--seed", "10000", "--start", "other"]
    measured = json.loads(sctn("evaluate", "--checkpoint", checkpoint, *arguments, "--json"))
    lines = run("examples/evaluate_checkpoint.py", str(checkpoint), *arguments).splitlines()
    expected = [f"seed {one['seed']}: {one['steps']} steps, reward {one['reward']:.3f}" for one in measured["reports"]]
    assert lines[:-1] == expected


@pytest.mark.parametrize("name", ["random_actions", "transporter", "evaluate_checkpoint"])
def test_each_example_says_how_it_is_run(name):
    assert f"python examples/{name}.py" in (FOLDER / f"examples/{name}.py").read_text().splitlines()[0]
