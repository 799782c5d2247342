"""A Transporter in plain PyTorch that learns a problem from demonstrations: python examples/transporter.py --problem placing."""

import argparse
import math
from concurrent.futures import ThreadPoolExecutor

import gymnasium
import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

import multiravens

STRIDE, CROP, ROTATIONS = 2, 25, 8  # cells are 2 x 2 pixels; the query is 25 x 25 cells


def image(seen):
    """What is seen and what is wanted as 8 channels: colors and heights (m), and the change of both."""
    now, goal = (np.dstack([part["color"] / 255, 20 * part["height"]]) for part in (seen, seen["goal"]))
    return torch.from_numpy(np.dstack([now, goal - now])).float().permute(2, 0, 1)[None]


class Transporter(nn.Module):
    def __init__(self, width=32, features=8):
        super().__init__()
        layers = [nn.Conv2d(8, width, 5, STRIDE, 2), nn.ReLU()]
        for dilation in (1, 2, 4, 8, 1):
            layers += [nn.Conv2d(width, width, 3, 1, dilation, dilation), nn.ReLU()]
        # Without it the place logits, products of two features, grow while the pick learns, and either may stay at chance.
        self.trunk = nn.Sequential(*layers, nn.GroupNorm(4, width))
        self.pick, self.query, self.key = (nn.Conv2d(width, size, 1) for size in (1, features, features))

    def forward(self, seen, pick=None):
        """Logits of picks (rows, cols) and, for the given or the best pick, of places (rotations, rows, cols)."""
        trunk = self.trunk(seen)
        picks = self.pick(trunk)[0, 0]
        row, col = divmod(int(picks.argmax()), picks.shape[1]) if pick is None else pick
        half = CROP // 2
        crop = F.pad(self.query(trunk), (half,) * 4)[:, :, row : row + CROP, col : col + CROP]
        turns = torch.arange(ROTATIONS) * (2 * math.pi / ROTATIONS)
        zero = torch.zeros(ROTATIONS)
        # Where the object turned by yaw is now, it was at R(-yaw) of that.
        matrices = torch.stack([turns.cos(), turns.sin(), zero, -turns.sin(), turns.cos(), zero], 1).view(-1, 2, 3)
        grid = F.affine_grid(matrices, (ROTATIONS, *crop.shape[1:]), align_corners=True)
        kernels = F.grid_sample(crop.expand(ROTATIONS, -1, -1, -1), grid, align_corners=True)
        return picks, F.conv2d(self.key(trunk), kernels, padding=half)[0] / CROP, (row, col)


def samples(demonstration):
    """Image, pick and place in cells, and rotation of each step; its goal is the image after the next reward."""
    cells = multiravens.RAVENS.pixels_from_poses(demonstration.actions.reshape(-1, 2, 3)).round().astype(int)
    colors, heights = demonstration.colors, demonstration.heights
    for step, (pick, place) in enumerate(cells // STRIDE):
        goal = next((index for index in demonstration.goals if index > step), None)
        if goal is not None:
            views = ({"color": colors[index], "height": heights[index]} for index in (step, goal))
            yaw = demonstration.actions[step, 5] - demonstration.actions[step, 2]
            turn = round(yaw * ROTATIONS / (2 * math.pi)) % ROTATIONS
            yield (*views, tuple(pick[:2]), (turn, *place[:2]))


def train(net, data, steps, generator):
    optimiser = torch.optim.Adam(net.parameters(), 1e-3)
    losses = []
    for step in range(steps):
        seen, goal, pick, place = data[generator.integers(len(data))]
        picks, places, _ = net(image(seen | {"goal": goal}), pick)
        wanted = torch.tensor([np.ravel_multi_index(at, x.shape) for at, x in ((pick, picks), (place, places))])
        loss = F.cross_entropy(picks.view(1, -1), wanted[:1]) + F.cross_entropy(places.view(1, -1), wanted[1:])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
        if (step + 1) % 100 == 0:
            print(f"step {step + 1}: mean loss {np.mean(losses[-100:]):.2f}", flush=True)


@torch.no_grad()
def decide(net, seen):
    """The action in pixels: row, col, yaw (rad) of pick and place."""
    _, places, (row, col) = net(image(seen))
    turn, to_row, to_col = np.unravel_index(int(places.argmax()), places.shape)
    middle = (STRIDE - 1) / 2
    pick, place = (STRIDE * np.array(at) + middle for at in ((row, col), (to_row, to_col)))
    return np.array([*pick, 0.0, *place, math.remainder(turn * 2 * math.pi / ROTATIONS, 2 * math.pi)])


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problem", default="placing")
    parser.add_argument("--demonstrations", type=int, default=100)
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--episodes", type=int, default=20)
    arguments = parser.parse_args()
    torch.manual_seed(0)
    with ThreadPoolExecutor() as threads:  # the simulation lets go of Python's lock
        shown = threads.map(lambda index: multiravens.demonstrate(arguments.problem, 2 * index), range(arguments.demonstrations))
        data = [sample for demonstration in shown if demonstration.complete for sample in samples(demonstration)]
    print(f"{len(data)} steps to learn from")
    net = Transporter()
    train(net, data, arguments.steps, np.random.default_rng(0))
    environment = gymnasium.make(f"MultiRavens/{arguments.problem}-v0", action="pixels", demonstrator=False)
    completed = 0
    for episode in range(arguments.episodes):
        seen, _ = environment.reset(seed=10_000 + episode)
        terminated = truncated = False
        while not (terminated or truncated):
            seen, _, terminated, truncated, _ = environment.step(decide(net, seen))
        completed += terminated
    print(f"completed {completed} of {arguments.episodes} episodes")


if __name__ == "__main__":
    main()
