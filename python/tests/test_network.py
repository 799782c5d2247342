"""Checkpoints in PyTorch against the decisions of the Rust side."""

from __future__ import annotations

import json
import pathlib
import struct
import subprocess

import gymnasium
import numpy as np
import pytest

import multiravens

CHECKPOINTS = pathlib.Path(__file__).resolve().parents[2] / "config/checkpoints"


@pytest.fixture(scope="module")
def network(torch):
    from multiravens import network

    return network


@pytest.fixture(scope="module")
def shown(sctn, tmp_path_factory):
    """A demonstration's bag, and what it shows."""
    folder = tmp_path_factory.mktemp("demonstrations")
    sctn("demos", "--problem", "placing_stacking", "--episodes", 1, "--seed", 10_000, "--out", folder)
    bag = folder / "placing_stacking/010000"
    return bag, multiravens.read_demonstration(bag)


def observations(demonstration):
    """What a policy is shown before each step."""
    images = [{"color": c, "height": h} for c, h in zip(demonstration.colors, demonstration.heights, strict=True)]
    for step in range(len(demonstration)):
        following = [index for index in demonstration.goals if index > step]
        before = [index for index in demonstration.goals if index <= step]
        yield images[step] | {
            "goal": images[following[0]],
            "previous_goal": images[before[-1] if before else 0],
        }


@pytest.mark.parametrize("name", ["placing", "ten_problems", "any_start"])
def test_a_policy_decides_what_the_rust_side_decides(name, network, shown, sctn):
    bag, demonstration = shown
    checkpoint = CHECKPOINTS / f"{name}.safetensors"
    expected = json.loads(sctn("decide", bag, "--checkpoint", checkpoint))
    policy = network.Policy.load(checkpoint)
    assert len(expected) == len(demonstration) > 10
    for observation, rust in zip(observations(demonstration), expected, strict=True):
        decision = policy.decide(observation)
        assert np.abs(decision.action - [*rust["pick"], *rust["place"]]).max() < 1e-5
        for score in ("pick_score", "place_score", "done", "success"):
            ours, theirs = getattr(decision, score), rust[score]
            assert (ours is None) == (theirs is None)
            # The logits of places are sums of some 100,000 products in single precision: another order of
            # summation moves them by up to 4e-5.
            tolerance = 5e-5 * theirs if score == "place_score" else 1e-5
            assert theirs is None or abs(ours - theirs) < tolerance
        assert abs(decision.pick_map.sum() - 1) < 1e-4
    assert (expected[0]["done"] is not None) == (expected[0]["success"] is not None) == (name == "any_start")


def test_an_excluded_pick_is_left_out(network, shown):
    policy = network.Policy.load(CHECKPOINTS / "ten_problems.safetensors")
    observation = next(observations(shown[1]))
    first = policy.decide(observation).action
    other = policy.decide(observation, exclude=[first[:2]]).action
    assert np.hypot(*(other - first)[:2]) > 0.02
    with pytest.raises(ValueError, match="exclude: leaves nothing to pick"):
        policy.decide(observation, exclude=[[0.5, 0.0]], radius_m=2.0)


def test_an_observation_without_its_goal_is_refused(network, shown):
    policy = network.Policy.load(CHECKPOINTS / "any_start.safetensors")
    observation = next(observations(shown[1]))
    for name in ("goal", "previous_goal"):
        rest = {key: value for key, value in observation.items() if key != name}
        with pytest.raises(ValueError, match=f"observation: has no '{name}', expected it for the conditioning 'sequence'"):
            policy.decide(rest)
    with pytest.raises(ValueError, match=r"heights of the shape \(10, 10\), expected \(320, 160\)"):
        policy.decide(observation | {"height": np.zeros((10, 10), np.float32)})
    with pytest.raises(ValueError, match="heights that are not finite"):
        policy.decide(observation | {"height": np.full((320, 160), np.nan, np.float32)})


def test_a_checkpoint_completes_an_episode_of_the_environment(network):
    policy = network.Policy.load(CHECKPOINTS / "ten_problems.safetensors")
    environment = gymnasium.make("MultiRavens/stacking-v0", demonstrator=False)
    observation, info = environment.reset(seed=10_000)
    over = False
    while not over:
        observation, _, terminated, truncated, info = environment.step(policy.decide(observation).action)
        over = terminated or truncated
    assert terminated
    assert info["step"] == 6


def rewritten(source, target, change):
    """A copy of a checkpoint whose head and tensor table were changed."""
    data = source.read_bytes()
    (size,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + size])
    head = json.loads(header["__metadata__"]["gctn"])
    change(header, head)
    header["__metadata__"]["gctn"] = json.dumps(head)
    text = json.dumps(header).encode()
    target.write_bytes(struct.pack("<Q", len(text)) + text + data[8 + size :])


def test_a_file_that_is_no_checkpoint_of_the_network_is_refused(network, tmp_path):
    good = CHECKPOINTS / "ten_problems.safetensors"
    with pytest.raises(network.CheckpointError, match=r"embedding.safetensors: format is 'gctn-embedding', expected 'gctn-checkpoint'"):
        network.Policy.load(CHECKPOINTS / "embedding.safetensors")
    with pytest.raises(network.CheckpointError, match=r"none.safetensors: No such file"):
        network.Policy.load(tmp_path / "none.safetensors")
    bad = tmp_path / "bad.safetensors"
    for data in (b"", b"PK\x03\x04 a pickle of torch.save", good.read_bytes()[:100_000]):
        bad.write_bytes(data)
        with pytest.raises(network.CheckpointError, match=r"bad.safetensors: (no|a truncated) safetensors file"):
            network.Policy.load(bad)

    def config(**changes):
        def change(_, head):
            whole = json.loads(head["network"])
            whole["network"].update(changes)
            head["network"] = json.dumps(whole)

        return change

    def without_key(header, _):
        del header["key.bias"]

    def more(header, _):
        header["extra"] = header["key.bias"]

    def version(_, head):
        head["version"] = "2"

    for change, expected in [
        (config(feature_channels=9), r"tensor (query|key)\.weight: shape \(8, 16, 1, 1\), expected \(9, 16, 1, 1\)"),
        (config(kind="vision"), r"network.kind: is 'vision', expected one of"),
        (without_key, r"tensor key.bias: missing, though the configured network has it"),
        (more, r"tensor extra: the configured network has no such tensor"),
        (version, r"version is '2', expected '1'"),
    ]:
        rewritten(good, bad, change)
        with pytest.raises(network.CheckpointError, match=rf"bad.safetensors: {expected}"):
            network.Policy.load(bad)


def test_a_published_folder_holds_the_policy_and_says_what_it_reaches(network, sctn, tmp_path):
    result = tmp_path / "stacking.json"
    sctn("evaluate", "--problem", "stacking", "--episodes", 2, "--seed", 10_000, "--out", result)
    folder = tmp_path / "a-model"
    sctn("publish", folder, "--results", result)
    assert sorted(path.name for path in folder.iterdir()) == ["README.md", "config.json", "model.safetensors", "results"]
    measured = json.loads(result.read_text())
    assert json.loads((folder / "results/stacking.json").read_text()) == measured
    policy = network.Policy.load(folder / "model.safetensors")
    config = json.loads((folder / "config.json").read_text())
    assert network.complete(config["network"]) == policy.network.config
    assert config["card"] == policy.card
    _, header, page = (folder / "README.md").read_text().split("---\n", 2)
    fields = dict(line.split(": ", 1) for line in header.splitlines())
    assert (fields["license"], fields["library_name"]) == ("apache-2.0", "multiravens")
    ((model),) = json.loads(fields["model-index"])
    assert model["name"] == "a-model"
    (entry,) = model["results"]
    assert entry["dataset"]["name"] == "MultiRavens stacking, same start"
    assert [metric["value"] for metric in entry["metrics"]] == [measured["completion"], measured["reward"]]
    assert "| stacking, same start | 2 |" in page
    with pytest.raises(subprocess.CalledProcessError) as error:
        sctn("publish", folder)
    assert "a-model" in error.value.stderr


def test_a_network_can_be_trained_further(network, torch, shown):
    net = network.Policy.load(CHECKPOINTS / "ten_problems.safetensors").network
    observation = next(observations(shown[1]))
    read = network.encode(net.config, observation, observation["goal"])
    optimiser = torch.optim.Adam(net.parameters(), 1e-4)
    wanted = torch.tensor([4321])
    losses = []
    for _ in range(3):
        said = net(read)
        places = net.place_logits(said, [80.0, 100.0])
        loss = sum(torch.nn.functional.cross_entropy(logits.reshape(1, -1), wanted) for logits in (said.pick, places))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[2] < losses[0]
    assert all(parameter.grad is not None for parameter in net.parameters())
