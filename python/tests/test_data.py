"""Demonstrations, bags, fusion and poses as arrays."""

from __future__ import annotations

import json
import pathlib

import gymnasium
import numpy as np
import pytest

import multiravens
from multiravens import RAVENS, Camera, MultiRavensEnv, Workspace

REPOSITORY = pathlib.Path(__file__).resolve().parents[2]


def same(one, other):
    """Whether two demonstrations are equal to the last bit."""
    arrays = ("colors", "heights", "actions", "rewards")
    equal = all(getattr(one, name).tobytes() == getattr(other, name).tobytes() for name in arrays)
    words = ("problem", "seed", "start_seed", "modules", "outcomes", "goals", "complete")
    return equal and all(getattr(one, name) == getattr(other, name) for name in words)


@pytest.mark.parametrize("problem", ["stacking", "placing_chaining", "kitting"])
def test_episodes_are_those_of_sctn_demos_to_the_last_bit(problem, sctn, tmp_path):
    sctn("demos", "--problem", problem, "--episodes", 2, "--seed", 20_000, "--out", tmp_path)
    for seed in (20_000, 20_002):
        recorded = multiravens.read_demonstration(tmp_path / problem / f"{seed:06}")
        assert same(recorded, multiravens.demonstrate(problem, seed))
        # By hand, with the demonstrator's actions and with those of the bag.
        for actions in (None, recorded.actions):
            environment = MultiRavensEnv(problem, goal="none")
            observation, info = environment.reset(seed=seed)
            for index, reward in enumerate(recorded.rewards):
                assert observation["color"].tobytes() == recorded.colors[index].tobytes()
                assert observation["height"].tobytes() == recorded.heights[index].tobytes()
                action = info["demonstrator_action"] if actions is None else actions[index]
                assert action.tobytes() == recorded.actions[index].tobytes()
                observation, given, terminated, _, info = environment.step(action)
                assert given == reward
            assert terminated
            assert observation["height"].tobytes() == recorded.heights[-1].tobytes()


def test_a_demonstration_survives_its_bag(tmp_path):
    shown = multiravens.demonstrate("stacking", 3, start=8)
    assert (shown.problem, shown.seed, shown.start_seed, shown.complete) == ("stacking", 3, 8, True)
    assert len(shown) == len(shown.actions) == len(shown.modules) == len(shown.colors) - 1
    assert shown.goals == [index + 1 for index, reward in enumerate(shown.rewards) if reward > 0]
    assert (shown.colors.shape[1:], shown.heights.dtype) == ((320, 160, 3), np.float32)
    shown.write(tmp_path / "bag")
    assert same(multiravens.read_demonstration(tmp_path / "bag"), shown)
    with pytest.raises(ValueError, match="bag"):
        shown.write(tmp_path / "bag")


def test_a_recorded_run_is_a_demonstration_too():
    run = multiravens.read_demonstration(REPOSITORY / "bags/sample/placing")
    assert len(run) > 0
    assert run.goals


def test_a_data_set_of_lerobot_s_layout_comes_back_as_bags(sctn, tmp_path):
    sctn("demos", "--problem", "stacking", "--episodes", 2, "--seed", 20_000, "--out", tmp_path / "demos")
    bags = [tmp_path / f"demos/stacking/{seed:06}" for seed in (20_000, 20_002)]
    sctn("bag", "export", *bags, "--out", tmp_path / "set")
    report = json.loads(sctn("bag", "import", tmp_path / "set", "--out", tmp_path / "again", "--json"))
    assert (report["episodes"], report["frames"]) == (2, 12)
    for bag in bags:
        before = multiravens.read_demonstration(bag)
        after = multiravens.read_demonstration(tmp_path / "again/stacking" / bag.name)
        assert np.array_equal(after.colors, before.colors)
        assert np.array_equal(after.heights, before.heights)
        assert np.allclose(after.actions, before.actions, rtol=0, atol=1e-14)
        assert np.allclose(after.rewards, before.rewards, rtol=0, atol=1e-14)
        for name in ("problem", "seed", "start_seed", "modules", "outcomes", "goals"):
            assert getattr(after, name) == getattr(before, name)


def test_what_is_no_demonstration_is_refused_by_name(tmp_path):
    with pytest.raises(ValueError, match="nothing"):
        multiravens.read_demonstration(tmp_path / "nothing")
    with pytest.raises(ValueError, match=r"expected .* one of .*stacking"):
        multiravens.demonstrate("juggling", 0)
    with pytest.raises(OverflowError):
        multiravens.demonstrate("stacking", -1)


def test_the_images_of_the_cameras_fuse_to_the_observation():
    environment = gymnasium.make("MultiRavens/stacking-v0", cameras=True, goal="none")
    observation, _ = environment.reset(seed=0)
    cameras = Camera.ravens()
    views = [observation["cameras"][camera.name] for camera in cameras]
    color, height = multiravens.fuse(cameras, [view["color"] for view in views], [view["depth"] for view in views])
    assert np.array_equal(color, observation["color"])
    assert np.array_equal(height, observation["height"])


def test_fusion_is_what_its_definition_says():
    camera = Camera.ravens()[1]
    generator = np.random.default_rng(0)
    color = generator.integers(0, 256, (480, 640, 3), np.uint8)
    depth = generator.uniform(0.3, 1.5, (480, 640)).astype(np.float32)
    workspace = Workspace(rows=40, cols=20, pixel_size_m=0.025)
    found_color, found_height = multiravens.fuse([camera], [color], [depth], workspace)
    fx, fy, cx, cy = camera.intrinsics_px
    v, u = np.mgrid[:480, :640]
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u, float), 1 / depth], -1) * depth[..., None]
    x, y, z, _ = np.moveaxis(rays.reshape(-1, 4) @ camera.world_from_camera.T, -1, 0)
    row, col = np.floor((y + 0.5) / 0.025).astype(int), np.floor((x - 0.25) / 0.025).astype(int)
    inside = (row >= 0) & (row < 40) & (col >= 0) & (col < 20) & (z >= -0.002) & (z <= 0.28)
    height = np.full((40, 20), -np.inf)
    np.maximum.at(height, (row[inside], col[inside]), z[inside])
    seen = np.isfinite(height)
    assert seen.mean() > 0.5
    assert np.abs(found_height - np.where(seen, height, 0.0)).max() < 1e-5
    assert not found_color[~seen].any()


def test_bad_images_and_cameras_are_refused_by_name():
    front = Camera.ravens()[0]
    color, depth = np.zeros((480, 640, 3), np.uint8), np.zeros((480, 640), np.float32)
    with pytest.raises(ValueError, match=r"color of camera front: has the shape \[480, 640\], expected \[480, 640, 3\]"):
        multiravens.fuse([front], [color[..., 0]], [depth])
    with pytest.raises(ValueError, match="depths: has 0 images, expected 1"):
        multiravens.fuse([front], [color], [])
    with pytest.raises(TypeError, match="colors"):
        multiravens.fuse([front], [depth], [depth])
    numbers = {"width": 640, "height": 480, "fx_px": 450.0, "fy_px": 450.0, "cx_px": 320.0, "cy_px": 240.0}
    place = {"position_m": [1, 0, 1], "orientation_xyzw": [0, 0, 0, 1]}
    assert Camera("mine", **numbers, **place).intrinsics_px == [450.0, 450.0, 320.0, 240.0]
    with pytest.raises(ValueError, match="camera mine: fx is NaN"):
        Camera("mine", **{**numbers, "fx_px": np.nan}, **place)
    with pytest.raises(ValueError, match=r"camera mine: orientation_xyzw is .* expected a quaternion"):
        Camera("mine", **numbers, position_m=[1, 0, 1], orientation_xyzw=[0, 0, 0, 0])
    with pytest.raises(ValueError, match="rows"):
        Workspace(rows=0)


def test_poses_and_pixels_are_inverse():
    assert RAVENS == Workspace()
    pixels = np.random.default_rng(1).uniform(-5, 330, (4, 7, 3))
    poses = RAVENS.poses_from_pixels(pixels)
    assert np.allclose(RAVENS.pixels_from_poses(poses), pixels, atol=1e-9)
    assert np.allclose(RAVENS.poses_from_pixels(np.array([0.0, 0.0, 1.0])), [0.2515625, -0.4984375, 1.0], atol=1e-12)
    with pytest.raises(ValueError, match=r"poses: has the shape \[2\], expected 3 at its end"):
        RAVENS.pixels_from_poses(np.zeros(2))
