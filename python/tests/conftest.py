"""Fixtures of the tests of the package: the programs of this repository, and what a machine may lack."""

from __future__ import annotations

import os
import pathlib
import subprocess

import pytest

REPOSITORY = pathlib.Path(__file__).resolve().parents[2]
TARGET = REPOSITORY / os.environ.get("CARGO_TARGET_DIR", "target")


@pytest.fixture(scope="session")
def sctn():
    """Runs the command `sctn` and returns what it printed; `cargo build --release -p sctn` builds it."""

    def run(*arguments: object) -> str:
        command = [str(TARGET / "release/sctn"), *map(str, arguments)]
        return subprocess.run(command, check=True, capture_output=True, text=True, cwd=REPOSITORY).stdout

    return run


@pytest.fixture(scope="session")
def torch():
    """PyTorch, where this Python has it: required where CI is set."""
    try:
        import torch
    except ImportError:
        if "CI" in os.environ:
            raise
        pytest.skip("this Python has no PyTorch (CONTRIBUTING.md, Cross-checks)")
    torch.set_num_threads(1)
    return torch
