"""A problem as a Gymnasium environment."""

from __future__ import annotations

import math
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from multiravens._multiravens import Camera, Episodes, Workspace

Observation = dict[str, Any]
Action = NDArray[np.float64]
Goal = Literal["next", "final", "none"]
Start = Literal["same", "other"]
Units = Literal["metres", "pixels"]
Split = Literal["train", "validation", "test"]
Seeds = list[tuple[int, int]]

RAVENS = Workspace()
"""The workspace of Ravens, which all problems use: 320 x 160 cells of 3.125 mm."""

# A seed whose scene the demonstrator does not complete, about one in a hundred at most, is passed over.
_CANDIDATES = 20
_FAR_M = 10.0
_PARTS = "x_m, y_m, yaw_rad of the pick, then of the place"


def heightmap_space() -> spaces.Dict:
    """``color``, uint8, and ``height`` (m), float32, of each cell."""
    rows, cols = RAVENS.rows, RAVENS.cols
    return spaces.Dict(
        {
            "color": spaces.Box(0, 255, (rows, cols, 3), np.uint8),
            "height": spaces.Box(-0.01, 0.3, (rows, cols), np.float32),
        }
    )


def observation_space(goal: Goal, cameras: bool) -> spaces.Dict:
    """What is seen, the goal and, where asked for, the images of the cameras."""
    parts: dict[str, spaces.Space[Any]] = dict(heightmap_space().spaces)
    if goal != "none":
        parts["goal"] = heightmap_space()
    if goal == "next":
        parts["previous_goal"] = heightmap_space()
    if cameras:
        views: dict[str, spaces.Space[Any]] = {}
        for camera in Camera.ravens():
            size = (camera.height, camera.width)
            color = spaces.Box(0, 255, (*size, 3), np.uint8)
            views[camera.name] = spaces.Dict({"color": color, "depth": spaces.Box(0, _FAR_M, size, np.float32)})
        parts["cameras"] = spaces.Dict(views)
    return spaces.Dict(parts)


def action_space(units: Units) -> spaces.Space[Action]:
    """A pick and a place pose, each within the workspace."""
    low = np.array([RAVENS.x_m, RAVENS.y_m, -math.pi])
    size = RAVENS.pixel_size_m
    high = np.array([RAVENS.x_m + size * RAVENS.cols, RAVENS.y_m + size * RAVENS.rows, math.pi])
    if units == "pixels":
        low = np.array([-0.5, -0.5, -math.pi])
        high = np.array([RAVENS.rows - 0.5, RAVENS.cols - 0.5, math.pi])
    elif units != "metres":
        raise ValueError(f'action: is {units!r}, expected "metres" or "pixels"')
    # What lies on the far edge is outside.
    high[:2] = np.nextafter(high[:2], 0.0)
    box: Any = spaces.Box(np.tile(low, 2), np.tile(high, 2), dtype=np.float64)
    space: spaces.Space[Action] = box
    return space


def draw_seeds(generator: np.random.Generator, split: Split) -> Seeds:
    """Scenes of a split, each with its own start; the first that the demonstrator completes is taken."""
    numbers = generator.integers(0, 5000, _CANDIDATES)
    if split == "train":
        scenes = 2 * numbers
    elif split == "validation":
        scenes = 2 * numbers + 1
    elif split == "test":
        scenes = 10_000 + numbers
    else:
        raise ValueError(f'split: is {split!r}, expected "train", "validation" or "test"')
    return [(int(scene), int(scene)) for scene in scenes]


def given_seeds(seed: int, options: dict[str, Any] | None) -> Seeds:
    """The scene of a seed, with its own start or with that of the options."""
    options = dict(options or {})
    start = options.pop("start", seed)
    if options:
        raise ValueError(f'options: has {sorted(options)}, expected "start" or nothing')
    for name, value in (("seed", seed), ('options["start"]', start)):
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or not 0 <= value < 2**63:
            raise ValueError(f"{name}: is {value!r}, expected a whole number from 0 to 2**63 - 1")
    return [(int(seed), int(start))]


def to_metres(action: Any, count: int | None, units: Units) -> Action:
    """Actions as the simulation takes them, shape (count, 6)."""
    shape = (6,) if count is None else (count, 6)
    try:
        given = np.asarray(action, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"action: {error}, expected numbers of the shape {shape}: {_PARTS}") from error
    if given.shape != shape:
        raise ValueError(f"action: has the shape {given.shape}, expected {shape}: {_PARTS}")
    if units == "pixels":
        given = RAVENS.poses_from_pixels(given.reshape(-1, 2, 3))
    return given.reshape(-1, 6)


def in_units(info: dict[str, Any], units: Units) -> dict[str, Any]:
    """What the simulation says, with the demonstrator's action in the units of the actions."""
    if units == "pixels" and "demonstrator_action" in info:
        poses = info["demonstrator_action"].reshape(2, 3)
        info["demonstrator_action"] = RAVENS.pixels_from_poses(poses).reshape(6)
    return info


class MultiRavensEnv(gymnasium.Env[Observation, Action]):
    """A problem of MultiRavens: a UR5 with a suction gripper, seen by three cameras, picks and places until all goals are reached.

    Arguments:
        problem: a name of :func:`multiravens.problem_names`, or the path of a problem file ``NAME.yaml``.
        goal: ``"next"`` shows the image of the next step of a demonstration of the same scene as ``goal``, and the one before
            as ``previous_goal``; ``"final"`` shows the last image; ``"none"`` shows neither and makes no demonstration,
            which is faster.
        start: ``"same"``: the demonstration begins as the episode does; ``"other"``: its loose objects lie elsewhere.
        cameras: whether ``cameras`` of the observation holds color and depth (m) of ``front``, ``left`` and ``right``.
        action: units of the actions: ``"metres"``: x, y (m) and yaw (rad) of the pick, then of the place; ``"pixels"``:
            row, col and yaw (rad), whole numbers being the middle of a cell.
        demonstrator: whether ``info["demonstrator_action"]`` says what the demonstrator would do, where it knows something.
            For chains and cables that costs most of the time of a step.
        split: where seeds are drawn from that are not given: ``"train"`` even below 10,000, ``"validation"`` odd below
            10,000, ``"test"`` from 10,000 to 14,999.
        render_mode: ``"rgb_array"``: :meth:`render` returns what the front camera sees; ``"human"``: a window shows it.

    Observation: ``color`` (uint8, 320 x 160 x 3), ``height`` (float32, m, 320 x 160); the same within ``goal`` and
    ``previous_goal``. Reward: the change of the share of goals reached, averaged over the problem's modules. Terminated: all
    goals are reached; truncated: out of steps.

    ``reset(seed=N)`` begins the episode that ``sctn demos --seed N`` demonstrates; ``options={"start": M}`` takes another
    start of the scene. The same seed and actions give the same bits.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 2}  # noqa: RUF012

    def __init__(
        self,
        problem: str,
        *,
        goal: Goal = "next",
        start: Start = "same",
        cameras: bool = False,
        action: Units = "metres",
        demonstrator: bool = True,
        split: Split = "train",
        render_mode: str | None = None,
    ) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode: is {render_mode!r}, expected None or one of {self.metadata['render_modes']}")
        draw_seeds(np.random.default_rng(0), split)
        self.action_space: spaces.Space[Action] = action_space(action)
        self._episodes = Episodes(problem, threads=1, goal=goal, start=start, cameras=cameras, demonstrator=demonstrator)
        self.observation_space = observation_space(goal, cameras)
        self.render_mode = render_mode
        self._units: Units = action
        self._split: Split = split
        self._done = True
        self._window: Any = None

    @property
    def problem(self) -> str:
        """Name of the problem."""
        return self._episodes.problem

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Begins the episode of a seed, or of one that is drawn from the split."""
        super().reset(seed=seed)
        if seed is None:
            if options:
                raise ValueError('options: need a seed, expected reset(seed=N, options={"start": M})')
            seeds = draw_seeds(self.np_random, self._split)
        else:
            seeds = given_seeds(seed, options)
        self._done = True
        ((observation, _, self._done, _, info),) = self._episodes.advance(np.zeros((1, 6)), [seeds])
        self._show()
        return observation, in_units(info, self._units)

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Carries out a pick and a place."""
        if self._done:
            raise gymnasium.error.ResetNeeded("the episode is over or has not begun, expected reset() before step()")
        metres = to_metres(action, None, self._units)
        ((observation, reward, terminated, truncated, info),) = self._episodes.advance(metres, [[]])
        self._done = terminated or truncated
        self._show()
        return observation, reward, terminated, truncated, in_units(info, self._units)

    def render(self) -> NDArray[np.uint8] | None:
        """What the front camera sees, uint8, 480 x 640 x 3; in the mode ``"human"`` it is in the window already."""
        if self.render_mode == "rgb_array":
            return self._episodes.picture(0)
        return None

    def close(self) -> None:
        """Closes the window, if there is one."""
        if self._window is not None:
            import pygame

            pygame.quit()
            self._window = None

    def _show(self) -> None:
        if self.render_mode != "human":
            return
        try:
            import pygame
        except ImportError as error:
            message = 'render_mode "human" needs pygame: pip install "multiravens[human]"'
            raise gymnasium.error.DependencyNotInstalled(message) from error
        picture = self._episodes.picture(0)
        if self._window is None:
            pygame.init()
            pygame.display.set_caption(f"MultiRavens: {self.problem}")
            self._window = pygame.display.set_mode((picture.shape[1], picture.shape[0]))
        # pygame counts x before y.
        self._window.blit(pygame.surfarray.make_surface(picture.transpose(1, 0, 2)), (0, 0))
        pygame.event.pump()
        pygame.display.flip()
