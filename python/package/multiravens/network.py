"""Checkpoints of SCTN in PyTorch: the networks with the weights' own names, and the decision that the Rust side makes.

>>> from multiravens.network import Policy
>>> policy = Policy.load("config/checkpoints/ten_problems.safetensors")
>>> action = policy.decide(observation).action  # observation of a MultiRavens environment

:class:`Network` is a plain module: its parameters can be trained further, frozen or copied. This file needs PyTorch and numpy,
nothing else of the package.
"""

from __future__ import annotations

import json
import math
import os
import struct
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

Config = Mapping[str, Any]
Image = Mapping[str, Any]

_KINDS = {"F64": "<f8", "F32": "<f4", "F16": "<f2"}
_GOALS = {"next_step": ("goal",), "final": ("goal",), "both": ("goal", "last_goal"), "sequence": ("goal", "previous_goal")}
_DEFAULTS: dict[str, dict[str, Any]] = {
    "compact": {
        "channels": [16, 32, 64, 128],
        "blocks": [1, 1, 1, 2],
        "feature_channels": 8,
        "window_cells": 25,
        "rotation_sampling": "bilinear",
    },
    "gr_convnet": {"channels": 32, "blocks": 5, "feature_channels": 8, "window_cells": 25, "rotation_sampling": "bilinear"},
    "matching": {
        "channels": [16, 32, 64, 96],
        "blocks": [1, 1, 1, 2],
        "hidden_channels": 24,
        "appearance_channels": 16,
        "feature_channels": 6,
        "context_channels": 4,
        "candidates": 0,
        "shape_weight": 0.0,
        "pick_shape_weight": 0.0,
        "pick_height_weight": 0.0,
        "fine_shapes": False,
        "window_cells": 21,
        "rotation_sampling": "bilinear",
    },
    "resnet43": {"crop_px": 64, "feature_channels": 3, "rotation_sampling": "nearest"},
}
# Mean and standard deviation of colour (as a fraction) and height (m) in Ravens, which the published network is fed with.
_COLOR, _HEIGHT_M = (0.18877631, 0.07276466), (0.00509261, 0.00903967)
# Candidates for the pick are more than so many cells apart; a window is looked for in so many cells around the place; every so
# manyth rotation is tried.
_APART_CELLS, _SHIFT_CELLS, _TURN_STRIDE = 4.0, 3, 2
# A candidate stands on the lowest of what is so many cells around it.
_AROUND_CELLS = 10
# The cells themselves take at most so much from the logit of a candidate, and of a turn. They take nothing from candidates where the
# best one differs by more than this. Heights count down to this below what is compared, and up to this above it (of 40 mm).
_MOST_TAKEN, _MOST_TAKEN_OF_TURNS, _UNLIKE, _DEEPEST = 2.0, 4.0, 0.1, 0.5
# The same of turns by the cells of the heightmap, which take nothing where the best turn differs by more than this, and the factor of
# their weight: where the learned features are sure of the turn, whose logit is then so much above the mean over turns, and where not.
_BESIDE_SURE, _BESIDE_UNSURE, _SURE_OF_TURN = (8.0, 0.2, 1.0), (12.0, 0.3, 2.0), 9.0
# What appeared has risen by more than this (of 40 mm), or its colour has changed by more than that (of 128, over three channels).
_RISEN, _RECOLORED = 0.1, 0.5


class CheckpointError(ValueError):
    """A file that is no checkpoint, or one of another network."""


class Features(NamedTuple):
    """What a network says of one input: logits of picks, and the features that places are found by."""

    pick: torch.Tensor
    """Logits of picks, rows x cols of the grid."""
    query: torch.Tensor
    """Features whose window at the pick is turned, channels x rows x cols."""
    key: torch.Tensor
    """Features that the windows are correlated with, half a window wider on each side."""
    scale: torch.Tensor | float
    """Factor from correlation to logit."""
    place: torch.Tensor | None
    """Of ``matching``: logits of places whatever the pick, rows x cols."""
    done: torch.Tensor | None
    """Of ``matching``: logit that the step is done already."""
    fit: tuple[torch.Tensor, torch.Tensor] | None = None
    """Of ``matching``: query and key whose correlation is minus half the squared difference of what is seen and shown."""
    cells: tuple[torch.Tensor, torch.Tensor, torch.Tensor] | None = None
    """Of ``matching``: colour and height, 4 x rows x cols, of the observation, the previous goal and the goal."""
    fine_cells: tuple[torch.Tensor, torch.Tensor, torch.Tensor] | None = None
    """Of ``matching``: the same by the cells of the heightmap, two for each of these along rows and columns."""


class Decision(NamedTuple):
    """Where to pick and where to place."""

    action: Any
    """x (m), y (m), yaw (rad) of the pick, then of the place: float64, (6,)."""
    pick_score: float
    """Probability of the picked cell."""
    place_score: float
    """Probability of the placed cell and rotation."""
    done: float | None
    """Probability that the step is done already, of a network that says so."""
    success: float | None
    """Probability that the step earns its reward, of a checkpoint with a calibration."""
    pick_map: Any
    """Probabilities of pick cells: float32, rows x cols of the grid."""
    place_map: Any
    """Probabilities of place cells at the rotation decided on: float32, rows x cols of the grid."""


def read_safetensors(path: str | os.PathLike[str]) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    """Tensors by name, and the metadata."""
    try:
        with open(path, "rb") as file:
            data = file.read()
        (size,) = struct.unpack("<Q", data[:8])
        header = json.loads(data[8 : 8 + size])
        metadata = header.pop("__metadata__", {})
        tensors = {}
        for name, entry in header.items():
            start, end = (8 + size + offset for offset in entry["data_offsets"])
            if end > len(data):
                raise CheckpointError(f"{path}: a truncated safetensors file, {name} ends at byte {end} of {len(data)}")
            numbers = np.frombuffer(data[start:end], _KINDS[entry["dtype"]]).reshape(entry["shape"])
            tensors[name] = torch.from_numpy(numbers.copy())
    except CheckpointError:
        raise
    except OSError as error:
        raise CheckpointError(f"{path}: {error.strerror}") from error
    except (struct.error, ValueError, KeyError, TypeError, AttributeError) as error:
        raise CheckpointError(f"{path}: no safetensors file, or a truncated one: {error!r}") from error
    return tensors, metadata


def complete(config: Config) -> dict[str, Any]:
    """A configuration with what it leaves out, as the Rust side reads it."""
    kind = config["network"]["kind"]
    if kind not in _DEFAULTS:
        raise CheckpointError(f"network.kind: is {kind!r}, expected one of {sorted(_DEFAULTS)}")
    whole = {"rows": 320, "cols": 160, "pixel_size_m": 0.003125, "rotations": 36, "conditioning": "next_step", **config}
    if whole["conditioning"] not in _GOALS:
        raise CheckpointError(f"conditioning: is {whole['conditioning']!r}, expected one of {sorted(_GOALS)}")
    return {**whole, "network": {**_DEFAULTS[kind], **config["network"]}}


def _channels(config: Config) -> int:
    goals = len(_GOALS[config["conditioning"]])
    return {"resnet43": 4 + 4 * goals, "matching": 24}.get(config["network"]["kind"], 4 + 10 * goals)


def shapes(config: Config) -> dict[str, tuple[int, ...]]:
    """The shape of each weight of a complete configuration, by its name in checkpoints."""
    found: dict[str, tuple[int, ...]] = {}
    network, inputs = config["network"], _channels(config)

    def conv(name: str, before: int, after: int, kernel: int) -> None:
        found[f"{name}.weight"] = (after, before, kernel, kernel)
        found[f"{name}.bias"] = (after,)

    def block(name: str, size: int) -> None:
        conv(f"{name}.first", size, size, 3)
        conv(f"{name}.second", size, size, 3)

    def unet(sizes: Sequence[int], blocks: Sequence[int]) -> None:
        for level, (size, count) in enumerate(zip(sizes, blocks, strict=True)):
            conv(f"level{level}.down" if level else "stem", sizes[level - 1] if level else inputs, size, 3 if level else 4)
            for index in range(count):
                block(f"level{level}.block{index}", size)
        for level in (2, 1, 0):
            conv(f"rise{level}.lateral", sizes[level + 1], sizes[level], 1)
            block(f"rise{level}.block", sizes[level])

    def hourglass(name: str, before: int, after: int) -> None:
        conv(f"{name}.stem", before, 64, 3)
        size = 64
        plan = [(64, 64), (128, 128), (256, 256), (512, 512), (256, 256), (128, 128), (64, 64), (16, after)]
        for stage, (hidden, out) in enumerate(plan):
            for part in "ab":
                at = f"{name}.stage{stage}.{part}"
                conv(f"{at}.first", size, hidden, 1)
                conv(f"{at}.second", hidden, hidden, 3)
                conv(f"{at}.third", hidden, out, 1)
                if part == "a":
                    conv(f"{at}.shortcut", size, out, 1)
                size = out

    if network["kind"] == "resnet43":
        goals = len(_GOALS[config["conditioning"]])
        hourglass("pick", 6 + 6 * goals, 1)
        for name, before in (("query", 6), ("key", 6), ("goal", 6 * goals)):
            hourglass(name, before, network["feature_channels"])
        return found
    if network["kind"] == "gr_convnet":
        width = network["channels"]
        sizes = [inputs, width, 2 * width, 4 * width]
        for index in range(3):
            conv(f"down{index}", sizes[index], sizes[index + 1], 4)
        for index in range(network["blocks"]):
            block(f"block{index}", sizes[3])
        for index in range(2):
            conv(f"up{index}", sizes[3 - index], sizes[2 - index], 3)
    else:
        width = network["channels"][0]
        unet(network["channels"], network["blocks"])
    found["scale"] = (1,)
    if network["kind"] != "matching":
        conv("heads", width, 3 * width, 3)
        for name, size in (("pick", 1), ("query", network["feature_channels"]), ("key", network["feature_channels"])):
            conv(name, width, size, 1)
        return found
    found["match_scale"] = (1,)
    hidden = network["hidden_channels"]
    conv("embedding.first", 4, hidden, 4)
    conv("embedding.second", hidden, hidden, 3)
    conv("embedding.third", hidden, network["appearance_channels"] + network["feature_channels"], 3)
    conv("heads", width, 5 * width, 3)
    context = network["context_channels"]
    for name, size in (("place", 1), ("bias", 1), ("query", context), ("key", context), ("gate", 1), ("done", 1)):
        conv(name, width, size, 1)
    return found


def encode(config: Config, observation: Image, *goals: Image) -> torch.Tensor:
    """What a network reads of an observation and its goals (``color``, uint8, and ``height``, m): float32, 1 x channels x rows x cols."""

    def cells(image: Image) -> torch.Tensor:
        color = torch.as_tensor(np.array(image["color"], np.float32))
        height = torch.as_tensor(np.array(image["height"], np.float32))
        return torch.cat([color.permute(2, 0, 1), height[None]])

    raw = [cells(image) for image in (observation, *goals)]
    kind = config["network"]["kind"]
    if kind == "resnet43":
        return torch.cat(raw)[None]
    # Heights of 40 mm, the edge of a block, count as much as half the range of a colour.
    scaled = [torch.cat([image[:3] * (1 / 128) - 1.1, image[3:] * (1 / 0.04)]) for image in raw]

    def sizes(change: torch.Tensor) -> torch.Tensor:
        return torch.stack([change[:3].abs().sum(0) * (1 / 3), change[3].abs()])

    seen, wanted = scaled[0], scaled[1:]
    if kind == "matching":
        goal, previous = wanted
        changes = [goal - previous, goal - seen]
        return torch.cat([seen, previous, goal, *changes, *map(sizes, changes)])[None]
    parts = [part for goal in wanted for part in (goal, goal - seen, sizes(goal - seen))]
    return torch.cat([seen, *parts])[None]


class Network(nn.Module):
    """A network of a configuration, as it stands under ``network`` in the head of a checkpoint; its weights start at random."""

    def __init__(self, config: Config) -> None:
        super().__init__()
        self.config = complete(config)
        for name, shape in shapes(self.config).items():
            *path, last = name.split(".")
            owner: nn.Module = self
            for part in path:
                if not hasattr(owner, part):
                    owner.add_module(part, nn.Module())
                owner = getattr(owner, part)
            weight = nn.Parameter(torch.empty(shape))
            if len(shape) == 4:
                nn.init.kaiming_uniform_(weight, a=math.sqrt(5))
            else:
                nn.init.constant_(weight, 10.0 if last == "match_scale" else 0.01 if last == "scale" else 0.0)
            owner.register_parameter(last, weight)

    @property
    def stride(self) -> int:
        """Heightmap cells for a cell of the grid that is answered on."""
        return 1 if self.config["network"]["kind"] == "resnet43" else 2

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of the answer."""
        return self.config["rows"] // self.stride, self.config["cols"] // self.stride

    def forward(self, read: torch.Tensor) -> Features:
        """Runs the convolutions on what :func:`encode` makes, of one sample."""
        kind = self.config["network"]["kind"]
        if kind == "resnet43":
            return self._published(read)
        trunk = self._gr_convnet if kind == "gr_convnet" else self._unet
        return self._matching(read) if kind == "matching" else self._heads(trunk(read))

    def place_logits(self, features: Features, pick_px: Sequence[float]) -> torch.Tensor:
        """Logits of places, rotations x rows x cols, of what is picked at x, y in image coordinates (px)."""
        network, rotations = self.config["network"], self.config["rotations"]
        size = network["crop_px"] if self.stride == 1 else network["window_cells"]
        margin = size // 2 if self.stride == 1 else 0
        center = [coordinate / self.stride - 0.5 + margin for coordinate in pick_px]
        bilinear = network["rotation_sampling"] == "bilinear"
        turns = (2 * math.pi * turn / rotations for turn in range(rotations))
        kernels = torch.stack([window(features.query, center, turn, size, bilinear) for turn in turns])
        rows, cols = self.grid
        logits = features.scale * F.conv2d(features.key[None], kernels)[0, :, :rows, :cols]
        if features.place is None:
            return logits
        logits = logits + features.place
        return self._add_shape(features, center, logits) if network.get("shape_weight", 0.0) > 0 else logits

    def _crop(self, place: torch.Tensor) -> tuple[int, int, int]:
        """First row and column, in a key with its margin, of what windows are compared with around the likeliest place; its edge."""
        size = self.config["network"]["window_cells"]
        edge = size + 2 * _SHIFT_CELLS
        at = divmod(int(place.argmax()), self.grid[1])
        row, col = (min(max(a - _SHIFT_CELLS, 0), whole + size // 2 * 2 - edge) for a, whole in zip(at, self.grid, strict=True))
        return row, col, edge

    def _windows(self, query: torch.Tensor, center: Sequence[float], stride: int, fine: bool = False) -> torch.Tensor:
        """Windows at every so manyth turn: turns x channels x size x size. Fine ones have twice as many cells along each edge, and
        their middle is between cells as the point is."""
        network, rotations = self.config["network"], self.config["rotations"]
        bilinear, size = network["rotation_sampling"] == "bilinear", network["window_cells"]
        turns = (2 * math.pi * turn / rotations for turn in range(0, rotations, stride))
        if fine:
            center, size = [2 * at + 0.5 for at in center], 2 * size
        return torch.stack([window(query, center, turn, size, bilinear, (size - 1) / 2) for turn in turns])

    def _shape_difference(self, features: Features, centers: Sequence[Sequence[float]], stride: int, fine: bool) -> torch.Tensor:
        """Minus half the squared difference between the cells at each point, at every so manyth turn, and those of the goal at the
        place: of colours where something appeared, and of heights there and around it; a mean over the cells where something appeared.
        Heights are relative to the point's and the place's own: an object may stand on another one. Points x turns x places x places.
        """
        cells = features.fine_cells if fine else features.cells
        assert features.place is not None and cells is not None
        factor, (rows, cols) = 2 if fine else 1, self.grid
        seen, before, shown = cells
        change = shown - before
        recolored = (change[:3].abs().sum(0) > _RECOLORED) & (change[3] > -_RISEN)
        appeared = ((change[3] > _RISEN) | recolored).to(shown.dtype)[None]
        # With 12 mm around it, so that it is told from a larger thing.
        around = F.max_pool2d(appeared, 4 * factor + 1, 1, 2 * factor)

        def relative(image: torch.Tensor, row: int, col: int) -> torch.Tensor:
            near = (slice(factor * max(at - 1, 0), factor * (at + 2)) for at in (row, col))
            return (image[3:] - image[(3, *near)].max()).clamp(-_DEEPEST, _DEEPEST)

        color, height = shown[:3], relative(shown, *divmod(int(features.place.argmax()), cols))
        squares = appeared * color.square().sum(0, keepdim=True) + around * height.square()
        key = torch.cat([appeared * color, -appeared / 2, around * height, -around / 2, -squares / 2, appeared])
        size = self.config["network"]["window_cells"]
        margin = factor * (size // 2)
        top, left, edge = (factor * at for at in self._crop(features.place))
        # The middle of a cell of the grid is between cells of the heightmap.
        key = F.pad(key, (margin, margin + factor - 1) * 2)[None, :, top : top + edge, left : left + edge]
        all_cells = torch.ones(1, 1, factor * size, factor * size)
        area = F.conv2d(key[:, 7:8], all_cells, stride=factor).clamp_min(1.0)[0]
        color = seen[:3]
        found = []
        for center in centers:
            col, row = (min(max(math.floor(at + 0.5), 0), end - 1) for at, end in zip(center, (cols, rows), strict=True))
            height = relative(seen, row, col)
            query = torch.cat([color, color.square().sum(0, keepdim=True), height, height.square(), torch.ones_like(height)])
            found.append(F.conv2d(key[:, :7], self._windows(query, center, stride, fine), stride=factor)[0] / area)
        return torch.stack(found)

    def _add_shape(self, features: Features, center: Sequence[float], logits: torch.Tensor) -> torch.Tensor:
        """Place logits with how well the cells at the pick, turned and shifted, fit what appeared at the place."""
        assert features.place is not None
        rows, cols = self.grid
        fine = self.config["network"]["fine_shapes"]
        most, unlike, factor = _MOST_TAKEN_OF_TURNS, math.inf, 1.0
        shape = self._shape_difference(features, [center], 1, fine)[0]
        top, left, _ = self._crop(features.place)
        high, wide = min(shape.shape[1], rows - top), min(shape.shape[2], cols - left)
        within = (slice(None), slice(top, top + high), slice(left, left + wide))
        if fine:
            tops = logits[within].amax((1, 2))
            most, unlike, factor = _BESIDE_SURE if tops.max() - tops.mean() >= _SURE_OF_TURN else _BESIDE_UNSURE
        # A cable has another shape wherever it lies.
        if shape.max() <= -unlike:
            return logits
        shape = (factor * self.config["network"]["shape_weight"] * (shape - shape.max())).clamp_min(-most)
        added = torch.full_like(logits, -most)
        added[within] = shape[:, :high, :wide]
        return logits + added

    def _taken(self, features: Features, peaks: Sequence[tuple[int, int]]) -> torch.Tensor:
        """What the cells themselves take from the logit of each candidate: the weighted difference of its shape, and of its height,
        beyond that of the candidate that fits best."""
        differences = self._shape_difference(features, [[col, row] for row, col in peaks], _TURN_STRIDE, False).amax((1, 2, 3))
        # A cable has another shape wherever it lies.
        if differences.max() <= -_UNLIKE:
            return torch.zeros_like(differences)
        network = self.config["network"]

        def beyond(weight: float, differences: torch.Tensor) -> torch.Tensor:
            return (weight * (differences - differences.max())).clamp_min(-_MOST_TAKEN)

        taken = beyond(network["pick_shape_weight"], differences)
        if network["pick_height_weight"] > 0:
            taken = taken + beyond(network["pick_height_weight"], self._height_difference(features, peaks))
        return taken

    def _height_difference(self, features: Features, peaks: Sequence[tuple[int, int]]) -> torch.Tensor:
        """Minus half the squared difference (of 40 mm each) between how high each candidate stands above the lowest cell around it and
        how high the goal has risen at the place."""
        assert features.place is not None and features.cells is not None

        def around(image: torch.Tensor, row: int, col: int, reach: int) -> torch.Tensor:
            return image[3, max(row - reach, 0) : row + reach + 1, max(col - reach, 0) : col + reach + 1]

        seen, before, shown = features.cells
        place = divmod(int(features.place.argmax()), self.grid[1])
        risen = around(shown, *place, 1).max() - around(before, *place, 1).max()
        stand = [around(seen, *peak, 1).max() - around(seen, *peak, _AROUND_CELLS).min() for peak in peaks]
        return (torch.stack(stand) - risen).square() / -2

    def add_fits(self, features: Features, picks: Any) -> Any:
        """Logits of picks (rows x cols, numpy) with how well their highest peaks fit what is to be placed: cells around a peak
        share its fit, all others have the worst."""
        network = self.config["network"]
        rows, cols = self.grid
        peaks: list[tuple[int, int]] = []
        for cell in np.argsort(-picks, axis=None, kind="stable"):
            row, col = divmod(int(cell), cols)
            if len(peaks) == network["candidates"] or picks[row, col] == -np.inf:
                break
            if all(math.hypot(row - peak[0], col - peak[1]) > _APART_CELLS for peak in peaks):
                peaks.append((row, col))
        if not peaks or features.place is None or features.fit is None:
            return picks
        query, key = features.fit
        top, left, edge = self._crop(features.place)
        key = key[None, :, top : top + edge, left : left + edge]
        fits = []
        for row, col in peaks:
            windows = self._windows(query, [col, row], _TURN_STRIDE)
            fits.append(float((features.scale * F.conv2d(key, windows)).max()))
        if network.get("pick_shape_weight", 0.0) > 0:
            fits = [fit + float(each) for fit, each in zip(fits, self._taken(features, peaks), strict=True)]
        y, x = np.mgrid[:rows, :cols]
        added = np.full_like(picks, min(fits))
        for (row, col), fit in reversed(list(zip(peaks, fits, strict=True))):
            added[np.hypot(y - row, x - col) <= _APART_CELLS] = fit
        return picks + added

    def _weight(self, name: str) -> torch.Tensor:
        return self.get_parameter(name)

    def _conv(self, name: str, x: torch.Tensor, stride: int = 1) -> torch.Tensor:
        weight = self._weight(name + ".weight")
        return F.conv2d(x, weight, self._weight(name + ".bias"), stride, (weight.shape[2] - 1) // 2)

    def _block(self, name: str, x: torch.Tensor) -> torch.Tensor:
        return F.relu(x + self._conv(f"{name}.second", F.relu(self._conv(f"{name}.first", x))))

    def _unet(self, x: torch.Tensor) -> torch.Tensor:
        skips = []
        for level, blocks in enumerate(self.config["network"]["blocks"]):
            x = F.relu(self._conv(f"level{level}.down" if level else "stem", x, 2))
            for index in range(blocks):
                x = self._block(f"level{level}.block{index}", x)
            skips.append(x)
        for level in (2, 1, 0):
            x = _doubled(self._conv(f"rise{level}.lateral", x)) + skips[level]
            x = self._block(f"rise{level}.block", x)
        return x

    def _gr_convnet(self, x: torch.Tensor) -> torch.Tensor:
        for index in range(3):
            x = F.relu(self._conv(f"down{index}", x, 2))
        for index in range(self.config["network"]["blocks"]):
            x = self._block(f"block{index}", x)
        for index in range(2):
            x = F.relu(self._conv(f"up{index}", _doubled(x)))
        return x

    def _heads(self, x: torch.Tensor) -> Features:
        heads = F.relu(self._conv("heads", x)).chunk(3, 1)
        pick, query, key = (self._conv(name, head)[0] for name, head in zip(("pick", "query", "key"), heads, strict=True))
        margin = self.config["network"]["window_cells"] // 2
        return Features(pick[0], query, F.pad(key, (margin,) * 4), self._weight("scale"), None, None)

    def _matching(self, x: torch.Tensor) -> Features:
        network = self.config["network"]
        heads = F.relu(self._conv("heads", self._unet(x))).chunk(5, 1)
        names = ("place", "bias", "query", "key")
        place, bias, query, key = (self._conv(name, head)[0] for name, head in zip(names, heads, strict=False))
        gate, done = torch.sigmoid(self._conv("gate", heads[3]))[0], self._conv("done", heads[4])[0, 0]
        place = place[0]
        # The place teaches the embedding what to look like, and not the other way round.
        attention = torch.softmax(place.detach().flatten(), 0).view_as(place)

        def embedded(image: torch.Tensor) -> Sequence[torch.Tensor]:
            image = F.relu(self._conv("embedding.first", image, 2))
            image = self._conv("embedding.third", F.relu(self._conv("embedding.second", image)))[0]
            vectors, features = image.split([network["appearance_channels"], network["feature_channels"]])
            return F.normalize(vectors, dim=0, eps=1e-6), features

        seen, seen_features = embedded(x[:, 0:4])
        shown, shown_features = embedded(x[:, 8:12])
        moved = F.normalize((shown * attention).sum((1, 2)), dim=0, eps=1e-6)
        pick = self._weight("match_scale") * torch.einsum("c,cij->ij", moved, seen) + bias[0]
        query = torch.cat([seen_features, query])
        key = torch.cat([shown_features * gate, key])
        margin = network["window_cells"] // 2
        # gate (seen shown - seen^2 / 2 - shown^2 / 2) is -gate (seen - shown)^2 / 2.
        half_square = [x.square().sum(0, keepdim=True) / 2 for x in (seen_features, shown_features)]
        fit_query = torch.cat([seen_features, half_square[0], torch.ones_like(gate)])
        fit_key = F.pad(torch.cat([shown_features * gate, -gate, -gate * half_square[1]]), (margin,) * 4)
        observation, previous, goal = (x[0, start : start + 4] for start in (0, 4, 8))
        fine = (observation, previous, goal)
        cells = (F.avg_pool2d(observation, 2), F.avg_pool2d(previous, 2), F.avg_pool2d(goal, 2))
        done = (done * attention).sum()
        return Features(pick, query, F.pad(key, (margin,) * 4), self._weight("scale"), place, done, (fit_query, fit_key), cells, fine)

    def _hourglass(self, name: str, x: torch.Tensor) -> torch.Tensor:
        """ResNet43_8s of Ravens."""
        x = F.relu(self._conv(f"{name}.stem", x))
        for stage, stride in enumerate([1, 2, 2, 2, 1, 1, 1, 1]):
            for part in "ab":
                at = f"{name}.stage{stage}.{part}"
                own = stride if part == "a" else 1
                y = F.relu(self._conv(f"{at}.first", x, own))
                y = self._conv(f"{at}.third", F.relu(self._conv(f"{at}.second", y)))
                x = y + (self._conv(f"{at}.shortcut", x, own) if part == "a" else x)
                if stage < 7:
                    x = F.relu(x)
            if stage in (4, 5, 6):
                x = _doubled(x)
        return x

    def _published(self, read: torch.Tensor) -> Features:
        def image(cells: torch.Tensor, rows: int, cols: int) -> torch.Tensor:
            # Padding comes before normalising: outside is black and at height 0.
            cells = F.pad(cells, (cols, cols, rows, rows))
            color, height = (cells[:, :3] / 255 - _COLOR[0]) / _COLOR[1], (cells[:, 3:] - _HEIGHT_M[0]) / _HEIGHT_M[1]
            return torch.cat([color, height, height, height], 1)

        observation, *goals = read.split(4, 1)
        rows, cols = self.config["rows"], self.config["cols"]
        # The pick net reads a square.
        top, left = ((max(rows, cols) - size) // 2 for size in (rows, cols))
        stacked = torch.cat([image(seen, top, left) for seen in (observation, *goals)], 1)
        pick = self._hourglass("pick", stacked)[0, 0, top : top + rows, left : left + cols]
        half = self.config["network"]["crop_px"] // 2
        seen = image(observation, half, half)
        goal = self._hourglass("goal", torch.cat([image(goal, half, half) for goal in goals], 1))
        query, key = ((self._hourglass(name, seen) * goal)[0] for name in ("query", "key"))
        return Features(pick, query, key, (2 * half) ** -2.0, None, None)


def _doubled(x: torch.Tensor) -> torch.Tensor:
    return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)


def _cells(features: torch.Tensor, rows: torch.Tensor, cols: torch.Tensor) -> torch.Tensor:
    """The features of cells, zero outside."""
    inside = (rows >= 0) & (rows < features.shape[1]) & (cols >= 0) & (cols < features.shape[2])
    found = features[:, rows.clamp(0, features.shape[1] - 1), cols.clamp(0, features.shape[2] - 1)]
    return torch.where(inside, found, torch.zeros((), dtype=features.dtype))


def window(
    features: torch.Tensor, center: Sequence[float], angle: float, size: int, bilinear: bool, middle: float | None = None
) -> torch.Tensor:
    """What an object looks like that was turned by ``angle`` after it was picked at ``center`` (x, y in cells), with the pick at the
    index ``middle`` of the window, ``size // 2`` where it is not said."""
    offsets = torch.arange(size, dtype=torch.float64) - (size // 2 if middle is None else middle)
    v, u = torch.meshgrid(offsets, offsets, indexing="ij")
    # Where the turned object now is at (u, v), the lying one was at R(-angle) (u, v).
    x = center[0] + math.cos(angle) * u + math.sin(angle) * v
    y = center[1] - math.sin(angle) * u + math.cos(angle) * v
    if not bilinear:
        # Half way between two cells the even one is taken, whatever the last bit.
        row, col = (torch.round(torch.round(at * 1e9) / 1e9).long() for at in (y, x))
        return _cells(features, row, col)
    row, col = torch.floor(y).long(), torch.floor(x).long()
    down, right = (y - row).to(features.dtype), (x - col).to(features.dtype)
    return (
        (1 - down) * (1 - right) * _cells(features, row, col)
        + (1 - down) * right * _cells(features, row, col + 1)
        + down * (1 - right) * _cells(features, row + 1, col)
        + down * right * _cells(features, row + 1, col + 1)
    )


class Policy:
    """A network with the weights of a checkpoint, what its maker wrote about it, and its calibration."""

    def __init__(self, network: Network, card: Mapping[str, str], calibration: Sequence[float] | None = None) -> None:
        self.network = network
        self.card = dict(card)
        self.calibration = calibration

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Policy:
        """Reads a checkpoint; refuses another format, missing, further and misshapen tensors, and numbers that are not finite."""
        tensors, metadata = read_safetensors(path)
        try:
            head = json.loads(metadata["gctn"])
            for key, expected in (("format", "gctn-checkpoint"), ("version", "1")):
                if head.get(key) != expected:
                    raise CheckpointError(f"{path}: {key} is {head.get(key)!r}, expected {expected!r}")
            network = Network(json.loads(head["network"]))
            card = json.loads(head["card"])
            calibration = json.loads(head["calibration"])["weights"] if "calibration" in head else None
            if calibration is not None and not 4 <= len(calibration) <= 6:
                raise CheckpointError(f"{path}: calibration: has {len(calibration)} weights, expected 4 to 6")
        except CheckpointError as error:
            prefix = "" if str(error).startswith(str(path)) else f"{path}: "
            raise CheckpointError(f"{prefix}{error}") from error
        except (KeyError, ValueError, TypeError) as error:
            raise CheckpointError(f'{path}: "gctn" in its metadata: {error!r}, expected the head of a checkpoint') from error
        expected_shapes = shapes(network.config)
        for name in tensors.keys() - expected_shapes.keys():
            raise CheckpointError(f"{path}: tensor {name}: the configured network has no such tensor")
        for name, shape in expected_shapes.items():
            if name not in tensors:
                raise CheckpointError(f"{path}: tensor {name}: missing, though the configured network has it")
            if tuple(tensors[name].shape) != shape:
                raise CheckpointError(f"{path}: tensor {name}: shape {tuple(tensors[name].shape)}, expected {shape}")
            if not torch.isfinite(tensors[name]).all():
                raise CheckpointError(f"{path}: tensor {name}: has numbers that are not finite")
        network.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
        return cls(network.eval(), card, calibration)

    @property
    def conditioning(self) -> str:
        """Which images it is shown as its goal: ``next_step``, ``final``, ``both`` or ``sequence``."""
        return str(self.network.config["conditioning"])

    @torch.no_grad()
    def decide(self, observation: Image, exclude: Iterable[Sequence[float]] = (), radius_m: float = 0.02) -> Decision:
        """Where to pick and to place. ``observation`` is that of an environment: ``color``, ``height`` and the goals that the
        network is conditioned on. Picks within ``radius_m`` of the excluded ones (x, y in metres) are left out."""
        net = self.network
        config, stride = net.config, net.stride
        images = [observation]
        for name in _GOALS[config["conditioning"]]:
            if name not in observation:
                raise ValueError(f"observation: has no {name!r}, expected it for the conditioning {config['conditioning']!r}")
            images.append(observation[name])
        for image in images:
            size, expected = np.shape(image["height"]), (config["rows"], config["cols"])
            if size != expected:
                raise ValueError(f"observation: heights of the shape {size}, expected {expected}")
            if not np.isfinite(image["height"]).all():
                raise ValueError("observation: has heights that are not finite")
        features = net(encode(config, *images))
        rows, cols = net.grid
        y, x = np.mgrid[:rows, :cols]
        x_px, y_px = (x + 0.5) * stride, (y + 0.5) * stride
        pixel = config["pixel_size_m"]

        learned = features.pick.double().numpy()
        picks = learned.copy()
        excluded_px = [((point[0] - 0.25) / pixel, (point[1] + 0.5) / pixel) for point in exclude]
        for point_px in excluded_px:
            away = np.hypot(x_px - point_px[0], y_px - point_px[1])
            picks[away <= radius_m / pixel] = -np.inf
        if not np.isfinite(picks.max()):
            raise ValueError("exclude: leaves nothing to pick, expected fewer or a smaller radius_m")
        if config["network"].get("candidates", 0):
            picks = net.add_fits(features, picks)
        row, col = divmod(int(picks.argmax()), cols)
        pick_px = [float(x_px[row, col]), float(y_px[row, col])]
        if features.place is not None:
            # Of the other networks picks are in the middle of a cell: that is how their checkpoints were measured.
            between_px = [
                pick_px[0] + stride * _between(learned[row], col),
                pick_px[1] + stride * _between(learned[:, col], row),
            ]
            if not any(math.dist(between_px, point_px) <= radius_m / pixel for point_px in excluded_px):
                pick_px = between_px
        pick_map = np.exp(picks - picks.max())
        pick_map = (pick_map / pick_map.sum()).astype(np.float32)

        places = net.place_logits(features, pick_px).double().numpy()
        turn, to_row, to_col = (int(index) for index in np.unravel_index(places.argmax(), places.shape))
        log_sum = places.max() + math.log(np.exp(places - places.max()).sum())
        place_map = np.minimum(np.exp(places[turn] - log_sum), 1.0).astype(np.float32)
        offset = [0.0, 0.0] if stride == 1 else [_between(places[turn, to_row], to_col), _between(places[turn, :, to_col], to_row)]
        place_px = [(to_col + offset[0] + 0.5) * stride, (to_row + offset[1] + 0.5) * stride]
        between = _between_turns(places, (turn, to_row, to_col)) if config["network"].get("fine_shapes") else 0.0
        yaw = 2 * math.pi * (turn + between) / config["rotations"]
        yaw = yaw - 2 * math.pi if yaw > math.pi else yaw

        done = None if features.done is None else float(torch.sigmoid(features.done))
        success = None
        if self.calibration is not None:

            def within(radius_px: float) -> list[float]:
                """Logarithms of the probability of picking and of placing so near to the decision."""
                maps = ((pick_map, pick_px), (place_map, place_px))
                shares = [scores[np.hypot(x_px - at[0], y_px - at[1]) <= radius_px].sum(dtype=float) for scores, at in maps]
                return [math.log(min(max(share, 1e-6), 1.0)) for share in shares]

            near, about = within(4.001), within(12.001)
            odds = 0.0 if done is None else float(np.clip(math.log(max(done, 1e-30) / max(1 - done, 1e-30)), -12.0, 12.0))
            said = [1.0, *near, odds, near[0] - about[0], near[1] - about[1]]
            # An older file has fewer weights: those that it leaves out are 0.
            success = 1 / (1 + math.exp(-sum(weight * part for weight, part in zip(self.calibration, said, strict=False))))
        poses = [(0.25 + px * pixel, -0.5 + py * pixel) for px, py in (pick_px, place_px)]
        return Decision(
            np.array([*poses[0], 0.0, *poses[1], yaw]),
            float(pick_map[row, col]),
            float(place_map[to_row, to_col]),
            done,
            success,
            pick_map,
            place_map,
        )


def _between(logits: Any, index: int) -> float:
    """Where between cells the maximum lies: labels are Gaussians, so logarithms of probabilities are parabolas."""
    if index == 0 or index + 1 == len(logits):
        return 0.0
    return _vertex(*(float(logits[index + step]) for step in (-1, 0, 1)))


def _between_turns(logits: Any, best: tuple[int, int, int]) -> float:
    """The same between rotations: an object that is turned by a little more or less may fit best a cell beside."""
    turn, row, col = best
    near = (slice(max(row - 1, 0), row + 2), slice(max(col - 1, 0), col + 2))
    before, after = (float(logits[(turn + step) % len(logits)][near].max()) for step in (-1, 1))
    return _vertex(before, float(logits[best]), after)


def _vertex(before: float, here: float, after: float) -> float:
    """Where the parabola through values at -1, 0 and 1 has its maximum, at most half a step from 0."""
    curvature = before - 2 * here + after
    return float(np.clip(0.5 * (before - after) / curvature, -0.5, 0.5)) if curvature < 0 else 0.0
