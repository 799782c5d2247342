"""Several episodes at once."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from multiravens import MultiRavensEnv, MultiRavensVectorEnv, benchmark


def demonstrate(environment, steps, seed=10_000):
    """Resets, and takes the demonstrators' actions; every result."""
    results = [environment.reset(seed=seed)]
    for _ in range(steps):
        info = results[-1][-1]
        idle = np.zeros((environment.num_envs, 6))
        results.append(environment.step(info.get("demonstrator_action", idle)))
    return results


def test_make_vec_gives_it_and_the_statistics_of_gymnasium_count_its_episodes():
    environment = gymnasium.make_vec("MultiRavens/stacking-v0", num_envs=2, goal="none")
    assert isinstance(environment.unwrapped, MultiRavensVectorEnv)
    results = demonstrate(RecordEpisodeStatistics(environment), 7)
    finished = results[6][4]["episode"]
    assert np.allclose(finished["r"], 1.0)
    assert list(finished["l"]) == [6, 6]


@pytest.mark.parametrize("threads", [1, 2])
def test_it_does_what_gymnasium_s_own_makes_of_single_environments(threads):
    arguments = {"goal": "next", "action": "pixels", "start": "other"}
    ours = MultiRavensVectorEnv("stacking", 3, threads=threads, **arguments)
    theirs = SyncVectorEnv([lambda: MultiRavensEnv("stacking", **arguments)] * 3)
    assert ours.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    for one, other in zip(demonstrate(ours, 6), demonstrate(theirs, 6), strict=True):
        assert one[0] in ours.observation_space
        assert data_equivalence(one[0], other[0], exact=True)
        assert all(np.array_equal(a, b) for a, b in zip(one[1:4], other[1:4], strict=False) if not isinstance(a, dict))
        for key in ("step", "seed", "total_reward", "module"):
            assert list(one[-1][key]) == list(other[-1][key])


def test_an_episode_that_is_over_begins_anew_at_the_next_step():
    environment = MultiRavensVectorEnv("stacking", 2, goal="none", split="test")
    results = demonstrate(environment, 7)
    assert list(results[6][2]) == [True, True]
    observation, reward, terminated, truncated, info = results[7]
    assert (list(info["step"]), list(reward)) == ([0, 0], [0.0, 0.0])
    assert not (terminated | truncated).any()
    assert all(seed >= 10_000 for seed in info["seed"])
    assert not np.array_equal(observation["height"][0], observation["height"][1])


def test_a_bad_action_names_its_environment_and_none_moves():
    environment = MultiRavensVectorEnv("stacking", 2, goal="none")
    with pytest.raises(gymnasium.error.ResetNeeded, match="have not begun"):
        environment.step(np.zeros((2, 6)))
    _, info = environment.reset(seed=[4, 6])
    good = info["demonstrator_action"]
    bad = good.copy()
    bad[1, 4] = np.nan
    for action, expected in [
        (bad, "environment 1: place pose"),
        (good[:1], r"action: has the shape \(1, 6\), expected \(2, 6\)"),
    ]:
        with pytest.raises(ValueError, match=expected):
            environment.step(action)
    _, reward, _, _, info = environment.step(good)
    assert list(info["step"]) == [1, 1]
    assert (reward > 0).all()
    with pytest.raises(ValueError, match="seed: has 3 elements, expected 2"):
        environment.reset(seed=[1, 2, 3])
    with pytest.raises(ValueError, match=r"count: is \"0\", expected at least 1"):
        MultiRavensVectorEnv("stacking", 0)


def test_the_benchmark_prints_steps_per_second_on_one_and_two_threads(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["benchmark", "--seconds", "1", "--envs", "2"])
    benchmark.main()
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(", ")[1].split(":")[0] for line in lines] == ["1 threads", "2 threads"]
    assert all(float(line.split(": ")[1].split()[0]) > 0 for line in lines)
