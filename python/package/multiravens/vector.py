"""Several episodes of a problem at once, on threads without Python's lock."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array
from numpy.typing import NDArray

from multiravens._multiravens import Episodes
from multiravens.environment import (
    Action,
    Goal,
    Observation,
    Seeds,
    Split,
    Start,
    Units,
    action_space,
    draw_seeds,
    given_seeds,
    in_units,
    observation_space,
    to_metres,
)

Numbers = NDArray[np.float64]
Flags = NDArray[np.bool_]


class MultiRavensVectorEnv(VectorEnv[Observation, Action, NDArray[Any]]):
    """``num_envs`` episodes of a problem, stepped at once on ``threads`` threads (as many as there are cores unless said).

    The other arguments are those of :class:`multiravens.MultiRavensEnv`. An episode that is over begins anew at the next step,
    whose action it ignores (``AutoresetMode.NEXT_STEP``). All actions are checked before any is carried out.

    ``gymnasium.make_vec("MultiRavens/placing-v0", num_envs=8)`` makes one.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 2, "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        problem: str,
        num_envs: int = 1,
        *,
        threads: int | None = None,
        goal: Goal = "next",
        start: Start = "same",
        cameras: bool = False,
        action: Units = "metres",
        demonstrator: bool = True,
        split: Split = "train",
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f'render_mode: is {render_mode!r}, expected None or "rgb_array"')
        draw_seeds(np.random.default_rng(0), split)
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.single_action_space = action_space(action)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._episodes = Episodes(problem, num_envs, threads=threads, goal=goal, start=start, cameras=cameras, demonstrator=demonstrator)
        self.single_observation_space = observation_space(goal, cameras)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._units: Units = action
        self._split: Split = split
        self._begun = False
        self._done: Flags = np.zeros(num_envs, np.bool_)
        self._generators = [np.random.default_rng() for _ in range(num_envs)]

    @property
    def problem(self) -> str:
        """Name of the problem."""
        return self._episodes.problem

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins an episode everywhere: that of ``seed + i``, or of the i-th of several seeds; drawn where there is none."""
        given: list[int | None]
        if seed is None:
            given = [None] * self.num_envs
        elif isinstance(seed, int | np.integer):
            given = [int(seed) + index for index in range(self.num_envs)]
        else:
            given = list(seed)
        if len(given) != self.num_envs:
            raise ValueError(f"seed: has {len(given)} elements, expected {self.num_envs}")
        seeds: list[Seeds] = []
        for index, one in enumerate(given):
            if one is None:
                seeds.append(draw_seeds(self._generators[index], self._split))
            else:
                seeds.append(given_seeds(one, options))
                self._generators[index] = np.random.default_rng(one)
        self._begun = False
        observation, _, _, _, info = self._advance(np.zeros((self.num_envs, 6)), seeds)
        self._begun = True
        return observation, info

    def step(self, actions: Action) -> tuple[Observation, Numbers, Flags, Flags, dict[str, Any]]:
        """Carries out one action everywhere; where an episode is over, the next one begins instead."""
        if not self._begun:
            raise gymnasium.error.ResetNeeded("the episodes have not begun, expected reset() before step()")
        metres = to_metres(actions, self.num_envs, self._units)
        seeds = [draw_seeds(generator, self._split) if done else [] for generator, done in zip(self._generators, self._done, strict=True)]
        return self._advance(metres, seeds)

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """What the front camera of each episode sees, uint8, 480 x 640 x 3."""
        if self.render_mode is None:
            return None
        return tuple(self._episodes.picture(index) for index in range(self.num_envs))

    def _advance(self, metres: Action, seeds: list[Seeds]) -> tuple[Observation, Numbers, Flags, Flags, dict[str, Any]]:
        frames = self._episodes.advance(metres, seeds)
        info: dict[str, Any] = {}
        for index, frame in enumerate(frames):
            info = self._add_info(info, in_units(frame[4], self._units), index)
        space = self.single_observation_space
        observations = [frame[0] for frame in frames]
        empty: Any = create_empty_array(space, self.num_envs)
        batch: Any = concatenate(space, observations, empty)
        rewards = np.array([frame[1] for frame in frames], np.float64)
        terminated = np.array([frame[2] for frame in frames], np.bool_)
        truncated = np.array([frame[3] for frame in frames], np.bool_)
        self._done = terminated | truncated
        return batch, rewards, terminated, truncated, info
