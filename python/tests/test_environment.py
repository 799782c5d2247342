"""Problems as Gymnasium environments."""

from __future__ import annotations

import pathlib
import threading

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence

import multiravens
from multiravens import MultiRavensEnv

REPOSITORY = pathlib.Path(__file__).resolve().parents[2]
FAR_LEFT = np.array([0.3, 0.45, 0.0, 0.3, 0.4, 0.0])


def make(problem="stacking", **arguments):
    return gymnasium.make(f"MultiRavens/{problem}-v0", **arguments).unwrapped


# All but one warning, a recommendation: metres are what they are.
@pytest.mark.filterwarnings("error", "ignore:.*symmetric and normalized space")
@pytest.mark.parametrize(
    "arguments",
    [{"cameras": True, "render_mode": "rgb_array"}, {"goal": "final", "action": "pixels", "start": "other"}, {"goal": "none"}],
)
def test_the_checker_of_gymnasium_finds_no_fault(arguments):
    check_env(make("placing", **arguments))


def test_every_problem_file_is_an_environment_that_begins():
    names = sorted(path.stem for path in (REPOSITORY / "config/problems").glob("*.yaml"))
    assert multiravens.problem_names() == names
    for name in names:
        environment = make(name, goal="none", demonstrator=False)
        observation, info = environment.reset(seed=10_000)
        assert observation in environment.observation_space
        assert environment.problem == name
        assert (info["seed"], info["step"], info["total_reward"]) == (10_000, 0, 0.0)


def test_a_problem_is_also_read_from_a_file(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("modules: [{name: stacking, anchor: {x_m: 0.5, y_m: 0.2}}]")
    environment = gymnasium.make("MultiRavens/File-v0", problem=str(file), goal="none")
    _, info = environment.reset(seed=0)
    assert (environment.unwrapped.problem, info["module"]) == ("mine", "stacking")


def test_the_demonstrator_completes_an_episode_and_each_goal_is_what_is_seen_next():
    environment = make("stacking")
    observation, info = environment.reset(seed=10_002)
    first = observation
    total, terminated = 0.0, False
    while not terminated:
        assert info["module"] == "stacking"
        goal = observation["goal"]
        observation, reward, terminated, truncated, info = environment.step(info["demonstrator_action"])
        total += reward
        # From the same start the demonstrator does what it showed, to the last bit.
        assert reward > 0
        assert not truncated
        assert np.array_equal(goal["color"], observation["color"])
        assert np.array_equal(goal["height"], observation["height"])
        if info["step"] == 1:
            assert np.array_equal(observation["previous_goal"]["height"], observation["height"])
            assert not np.array_equal(first["height"], observation["height"])
    assert total == pytest.approx(1.0)
    assert info["outcome"] == "placed"
    assert "demonstrator_action" not in info


def test_from_another_start_the_goal_shows_other_places():
    observation, info = make("placing", start="other").reset(seed=10_000)
    assert not np.array_equal(observation["previous_goal"]["color"], observation["color"])
    same, _ = make("placing").reset(seed=10_000)
    assert np.array_equal(same["color"], observation["color"])
    assert np.array_equal(same["previous_goal"]["color"], observation["color"])
    other, info = make("placing").reset(seed=10_000, options={"start": 10_001})
    assert info["start_seed"] == 10_001
    assert np.array_equal(other["color"], observation["previous_goal"]["color"])


def test_equal_seeds_and_actions_give_equal_bits_and_episodes_without_a_seed_are_of_the_split():
    environment = make("placing", goal="none", split="validation")
    environment.action_space.seed(3)
    actions = [environment.action_space.sample() for _ in range(2)]
    runs = []
    for _ in range(2):
        frames = [environment.reset(seed=6), *(environment.step(action) for action in actions)]
        runs.append((frames, environment.reset()))
    assert data_equivalence(runs[0], runs[1], exact=True)
    seed = runs[0][1][1]["seed"]
    assert seed % 2 == 1
    assert seed < 10_000


def test_pixels_name_the_middle_of_cells():
    by_metres, by_pixels = make(goal="none"), make(goal="none", action="pixels")
    _, info = by_metres.reset(seed=4)
    _, in_pixels = by_pixels.reset(seed=4)
    x_m, y_m, yaw = info["demonstrator_action"][:3]
    row, col, same_yaw = in_pixels["demonstrator_action"][:3]
    assert np.allclose([x_m, y_m, yaw], [0.25 + (col + 0.5) / 320, -0.5 + (row + 0.5) / 320, same_yaw], atol=1e-12)
    pixel = np.round(in_pixels["demonstrator_action"])
    pixel[[2, 5]] = in_pixels["demonstrator_action"][[2, 5]]
    metres = multiravens.RAVENS.poses_from_pixels(pixel.reshape(2, 3)).reshape(6)
    one, other = by_metres.step(metres), by_pixels.step(pixel)
    assert np.array_equal(one[0]["height"], other[0]["height"])
    assert one[1] == other[1] > 0


def test_an_episode_that_runs_out_of_steps_is_truncated():
    environment = make("stacking", goal="none", demonstrator=False)
    environment.reset(seed=2)
    truncated = False
    while not truncated:
        _, reward, terminated, truncated, info = environment.step(FAR_LEFT)
        assert (reward, terminated, info["outcome"]) == (0.0, False, "grasp_failed")
    assert info["step"] == 8
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"over.*expected reset\(\)"):
        environment.step(FAR_LEFT)
    environment.reset(seed=2)
    environment.step(FAR_LEFT)


@pytest.mark.parametrize(
    ("action", "expected"),
    [
        (np.zeros(5), r"action: has the shape \(5,\), expected \(6,\)"),
        ([[0.5] * 6], r"action: has the shape \(1, 6\), expected \(6,\)"),
        ("left", r"action: .* expected numbers of the shape \(6,\)"),
        (None, r"action: "),
        ([0.5, np.nan, 0, 0.5, 0, 0], "pick pose .* y NaN m.*expected finite and in x 0.25..0.75"),
        ([0.5, 0, 0, 0.5, 0, np.inf], "place pose .* expected finite"),
        ([0.5, 0, 0, 0.5, 0.6, 0], "place pose x 0.5 m, y 0.6 m.* expected finite and in"),
    ],
)
def test_a_bad_action_is_refused_and_nothing_moves(action, expected):
    environment = make(goal="none")
    before, info = environment.reset(seed=2)
    with pytest.raises(ValueError, match=expected):
        environment.step(action)
    after, _, _, _, after_info = environment.step(info["demonstrator_action"])
    assert after_info["step"] == 1
    assert not np.array_equal(before["height"], after["height"])


def test_bad_arguments_are_refused_with_the_field_and_what_was_expected(tmp_path):
    for arguments, expected in [
        ({"problem": "plcing"}, 'no problem "plcing", expected .*NAME.yaml or one of .*placing'),
        ({"problem": str(tmp_path / "none.yaml")}, "none.yaml"),
        ({"problem": "placing", "goal": "last"}, 'goal: is "last", expected "next"'),
        ({"problem": "placing", "start": "elsewhere"}, 'start: is "elsewhere", expected "same"'),
        ({"problem": "placing", "action": "feet"}, "action: is 'feet', expected \"metres\""),
        ({"problem": "placing", "split": "all"}, "split: is 'all', expected \"train\""),
        ({"problem": "placing", "render_mode": "ascii"}, "render_mode: is 'ascii', expected"),
    ]:
        with pytest.raises(ValueError, match=expected):
            MultiRavensEnv(**arguments)
    file = tmp_path / "bad.yaml"
    file.write_text("modules: [{name: stacking, anchor: {x_m: 0.5}}]")
    with pytest.raises(ValueError, match=r"bad.yaml: .*y_m"):
        MultiRavensEnv(str(file))
    environment = make(goal="none")
    for seed, options, expected in [
        (-1, None, "(?i)seed"),
        (0, {"begin": 3}, r"options: has \['begin'\], expected \"start\""),
        (0, {"start": "x"}, r"options\[\"start\"\]: is 'x', expected a whole number"),
        (None, {"start": 3}, "options: need a seed"),
    ]:
        with pytest.raises((ValueError, gymnasium.error.Error), match=expected):
            environment.reset(seed=seed, options=options)


def test_a_step_before_the_first_reset_is_refused():
    with pytest.raises(gymnasium.error.ResetNeeded, match="has not begun"):
        make().step(FAR_LEFT)
    with pytest.raises(RuntimeError, match="has not begun: expected a reset"):
        multiravens.Episodes("placing").advance(np.zeros((1, 6)), [[]])


def test_a_picture_is_what_the_front_camera_sees():
    environment = make(cameras=True, goal="none", render_mode="rgb_array")
    observation, info = environment.reset(seed=0)
    assert np.array_equal(environment.render(), observation["cameras"]["front"]["color"])
    environment.step(info["demonstrator_action"])
    assert not np.array_equal(environment.render(), observation["cameras"]["front"]["color"])


def test_a_window_shows_it(monkeypatch):
    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    environment = make(cameras=True, goal="none", render_mode="human")
    observation, _ = environment.reset(seed=0)
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).transpose(1, 0, 2)
    assert np.array_equal(shown, observation["cameras"]["front"]["color"])
    environment.close()


def test_python_goes_on_while_the_simulation_works():
    done = threading.Event()

    def work():
        multiravens.demonstrate("routing", 10_000)
        done.set()

    thread = threading.Thread(target=work)
    thread.start()
    turns = 0
    while not done.wait(0.001):
        turns += 1
    thread.join()
    assert turns > 20
