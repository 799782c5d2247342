"""MultiRavens on Rapier: multi-step pick-and-place problems as Gymnasium environments, with demonstrators.

>>> import gymnasium, multiravens
>>> environment = gymnasium.make("MultiRavens/placing-v0")
>>> observation, info = environment.reset(seed=10000)
>>> observation, reward, terminated, truncated, info = environment.step(info["demonstrator_action"])

Every problem of the package is registered as ``MultiRavens/NAME-v0``; ``MultiRavens/File-v0`` takes ``problem="my.yaml"``.

Conventions, everywhere: the world is the robot's base frame (x forward, y left, z up; metres). Rows of a heightmap run along
+y, columns along +x; cell (0, 0) has the smallest x and y. Yaw is about +z, from columns towards rows (radians).
"""

import gymnasium

from multiravens._multiravens import (
    Camera,
    Demonstration,
    Episodes,
    Workspace,
    demonstrate,
    fuse,
    is_held_out,
    problem_names,
    read_demonstration,
)
from multiravens.environment import RAVENS, MultiRavensEnv
from multiravens.vector import MultiRavensVectorEnv

__all__ = [
    "RAVENS",
    "Camera",
    "Demonstration",
    "Episodes",
    "MultiRavensEnv",
    "MultiRavensVectorEnv",
    "Workspace",
    "demonstrate",
    "fuse",
    "is_held_out",
    "problem_names",
    "read_demonstration",
]


def _register(name: str, **arguments: str) -> None:
    gymnasium.register(
        id=f"MultiRavens/{name}-v0",
        entry_point="multiravens.environment:MultiRavensEnv",
        vector_entry_point="multiravens.vector:MultiRavensVectorEnv",
        kwargs=arguments,
    )


for _name in problem_names():
    _register(_name, problem=_name)
_register("File")
