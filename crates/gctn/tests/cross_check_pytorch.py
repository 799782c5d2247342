"""The networks, their losses and every gradient once more, in PyTorch and straight from the definitions.

Called by src/network/cross_check.rs with a folder that holds case.json, case.safetensors and, for weights in 32 bits, the
checkpoint model.safetensors; fails where the two differ by more than the case's tolerance, relative to the largest number.
Convolutions are PyTorch's own and so is every derivative; windows are sampled and correlated without Fourier transforms.
"""

import json
import math
import struct
import sys
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

KINDS = {"F64": "<f8", "F32": "<f4", "F16": "<f2"}


def read_safetensors(path):
    """Tensors by name, and the metadata."""
    data = path.read_bytes()
    (header_size,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + header_size])
    metadata = header.pop("__metadata__", {})
    tensors = {}
    for name, entry in header.items():
        start, end = (8 + header_size + offset for offset in entry["data_offsets"])
        numbers = np.frombuffer(data[start:end], KINDS[entry["dtype"]]).reshape(entry["shape"])
        tensors[name] = torch.from_numpy(numbers.copy())
    return tensors, metadata


class Net:
    """Layers that look up their weights by name."""

    def __init__(self, weights):
        self.weights = weights

    def conv(self, name, x, stride=1):
        weight = self.weights[name + ".weight"]
        return F.conv2d(x, weight, self.weights[name + ".bias"], stride, (weight.shape[2] - 1) // 2)


def upsample(x):
    return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)


def hourglass(net, name, x):
    """ResNet43_8s of Ravens."""
    x = F.relu(net.conv(f"{name}.stem", x))
    for stage, stride in enumerate([1, 2, 2, 2, 1, 1, 1, 1]):
        for part in "ab":
            at = f"{name}.stage{stage}.{part}"
            own = stride if part == "a" else 1
            y = F.relu(net.conv(f"{at}.first", x, own))
            y = net.conv(f"{at}.third", F.relu(net.conv(f"{at}.second", y)))
            x = y + (net.conv(f"{at}.shortcut", x, own) if part == "a" else x)
            if stage < 7:
                x = F.relu(x)
        if stage in (4, 5, 6):
            x = upsample(x)
    return x


def published(net, config, observation, *goals):
    """Pick logits, query and key features with their margin, scale."""

    def image(heightmap, rows, cols):
        rgb = F.pad(heightmap["rgb"].permute(2, 0, 1)[None], (cols, cols, rows, rows))
        height = F.pad(heightmap["height_m"][None, None], (cols, cols, rows, rows))
        rgb = (rgb / 255 - 0.18877631) / 0.07276466
        height = (height - 0.00509261) / 0.00903967
        return torch.cat([rgb, height, height, height], 1)

    rows, cols = config["rows"], config["cols"]
    edge = max(rows, cols)
    top, left = (edge - rows) // 2, (edge - cols) // 2
    stacked = torch.cat([image(seen, top, left) for seen in (observation, *goals)], 1)
    pick = hourglass(net, "pick", stacked)[0, 0, top : top + rows, left : left + cols]
    half = config["network"]["crop_px"] // 2
    seen, wanted = image(observation, half, half), [image(goal, half, half) for goal in goals]
    goal_features = hourglass(net, "goal", torch.cat(wanted, 1))
    query = hourglass(net, "query", seen) * goal_features
    key = hourglass(net, "key", seen) * goal_features
    return pick, query[0], key[0], (2 * half) ** -2.0


def block(net, name, x):
    return F.relu(x + net.conv(f"{name}.second", F.relu(net.conv(f"{name}.first", x))))


def compact_trunk(net, config, x):
    skips = []
    for level, blocks in enumerate(config["network"]["blocks"]):
        x = F.relu(net.conv("stem" if level == 0 else f"level{level}.down", x, 2))
        for index in range(blocks):
            x = block(net, f"level{level}.block{index}", x)
        skips.append(x)
    for level in (2, 1, 0):
        x = upsample(net.conv(f"rise{level}.lateral", x)) + skips[level]
        x = block(net, f"rise{level}.block", x)
    return x


def gr_convnet_trunk(net, config, x):
    for index in range(3):
        x = F.relu(net.conv(f"down{index}", x, 2))
    for index in range(config["network"]["blocks"]):
        x = block(net, f"block{index}", x)
    for index in range(2):
        x = F.relu(net.conv(f"up{index}", upsample(x)))
    return x


TRUNKS = {"compact": compact_trunk, "gr_convnet": gr_convnet_trunk}


def shared(net, config, x):
    """Pick logits, query features, key features with their margin, scale."""
    x = TRUNKS[config["network"]["kind"]](net, config, x)
    heads = F.relu(net.conv("heads", x)).chunk(3, 1)
    pick, query, key = (net.conv(name, head)[0] for name, head in zip(("pick", "query", "key"), heads, strict=False))
    margin = config["network"]["window_cells"] // 2
    return pick[0], query, F.pad(key, (margin,) * 4), net.weights["scale"]


def matching(net, config, x):
    """As `shared`, and first place logits, logit of done."""
    network = config["network"]
    heads = F.relu(net.conv("heads", compact_trunk(net, config, x))).chunk(5, 1)
    place, bias, query, key = (net.conv(name, head) for name, head in zip(("place", "bias", "query", "key"), heads, strict=False))
    gate, done = torch.sigmoid(net.conv("gate", heads[3])), net.conv("done", heads[4])[0, 0]
    place = place[0, 0]
    attention = torch.softmax(place.detach().flatten(), 0).view_as(place)

    def embedded(image):
        image = F.relu(net.conv("embedding.first", image, 2))
        image = net.conv("embedding.third", F.relu(net.conv("embedding.second", image)))[0]
        vectors, features = image.split([network["appearance_channels"], network["feature_channels"]])
        return F.normalize(vectors, dim=0), features

    seen, seen_features = embedded(x[:, 0:4])
    shown, shown_features = embedded(x[:, 8:12])
    moved = F.normalize((shown * attention).sum((1, 2)), dim=0)
    pick = net.weights["match_scale"] * torch.einsum("c,cij->ij", moved, seen) + bias[0, 0]
    query = torch.cat([seen_features, query[0]])
    key = torch.cat([shown_features * gate[0], key[0]])
    margin = network["window_cells"] // 2
    return pick, query, F.pad(key, (margin,) * 4), net.weights["scale"], place, (done * attention).sum()


def cells(features, rows, cols):
    """The features of cells, zero outside."""
    inside = (rows >= 0) & (rows < features.shape[1]) & (cols >= 0) & (cols < features.shape[2])
    found = features[:, rows.clamp(0, features.shape[1] - 1), cols.clamp(0, features.shape[2] - 1)]
    return torch.where(inside, found, torch.zeros((), dtype=features.dtype))


def window(features, center, angle, size, bilinear):
    """What an object looks like that was turned by `angle` after it was picked at `center` (x, y)."""
    offsets = torch.arange(size, dtype=torch.float64) - size // 2
    v, u = torch.meshgrid(offsets, offsets, indexing="ij")
    # Where the turned object now is at (u, v), the lying one was at R(-angle) (u, v).
    x = center[0] + math.cos(angle) * u + math.sin(angle) * v
    y = center[1] - math.sin(angle) * u + math.cos(angle) * v
    if not bilinear:
        # Half way between two cells the even one is taken, whatever the last bit.
        row, col = (torch.round(torch.round(at * 1e9) / 1e9).long() for at in (y, x))
        return cells(features, row, col)
    row, col = torch.floor(y).long(), torch.floor(x).long()
    down, right = (y - row).to(features.dtype), (x - col).to(features.dtype)
    return (
        (1 - down) * (1 - right) * cells(features, row, col)
        + (1 - down) * right * cells(features, row, col + 1)
        + down * (1 - right) * cells(features, row + 1, col)
        + down * right * cells(features, row + 1, col + 1)
    )


class Case:
    def __init__(self, folder):
        self.case = json.loads((folder / "case.json").read_text())
        self.tensors, _ = read_safetensors(folder / "case.safetensors")
        self.config = self.case["network"]
        if self.case["slopes"]:
            self.kind = torch.float64
            self.weights = self.named("weight")
        else:
            self.kind = torch.float32
            self.weights, metadata = read_safetensors(folder / "model.safetensors")
            self.weights = {name: x.to(self.kind) for name, x in self.weights.items()}
            stored = json.loads(json.loads(metadata["gctn"])["network"])
            assert stored == self.config, "the checkpoint is of another network"
        for x in self.weights.values():
            x.requires_grad_(self.case["slopes"])
        self.matching = self.config["network"]["kind"] == "matching"
        self.shared = self.matching or self.config["network"]["kind"] in TRUNKS
        self.stride = 2 if self.shared else 1
        self.rows = self.config["rows"] // self.stride
        self.cols = self.config["cols"] // self.stride

    def named(self, prefix):
        prefix += "/"
        return {name[len(prefix) :]: x for name, x in self.tensors.items() if name.startswith(prefix)}

    def images(self):
        both = self.config["conditioning"] == "both"
        return ("observation", "goal", "last") if both else ("observation", "goal")

    def index(self, point_px):
        """Image coordinates -> x, y counted in cells from the centre of the first."""
        return [coordinate / self.stride - 0.5 for coordinate in point_px]

    def target(self, point_px):
        x, y = self.index(point_px)
        sigma = self.case["sigma_cells"]
        row, col = math.floor(y + 0.5), math.floor(x + 0.5)
        rows = torch.arange(self.rows, dtype=torch.float64)[:, None]
        cols = torch.arange(self.cols, dtype=torch.float64)
        if sigma == 0:
            return ((rows == row) & (cols == col)).double()
        reach = math.ceil(4 * sigma)
        near = ((rows - row).abs() <= reach) & ((cols - col).abs() <= reach)
        out = torch.exp(-((cols - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2)) * near
        return out / out.sum()

    def run(self):
        """Pick logits, place logits of every rotation, and the two losses."""
        net = Net(self.weights)
        first = done = None
        if self.matching:
            read = self.tensors["input"].to(self.kind)[None]
            pick, query, key, scale, first, done = matching(net, self.config, read)
            first, done = first.double(), done.double()
        elif self.shared:
            pick, query, key, scale = shared(net, self.config, self.tensors["input"].to(self.kind)[None])
        else:
            images = [{name: x.to(self.kind) for name, x in self.named(of).items()} for of in self.images()]
            pick, query, key, scale = published(net, self.config, *images)
        # From the features on in 64 bits, so that what rounding there is is the other side's.
        pick, query, key = pick.double(), query.double(), key.double()
        network, rotations = self.config["network"], self.config["rotations"]
        size = network["window_cells"] if self.shared else network["crop_px"]
        bilinear = network["rotation_sampling"] == "bilinear"
        margin = 0 if self.shared else size // 2
        center = [coordinate + margin for coordinate in self.index(self.case["pick_px"])]
        right, wrong = self.case["rotation"], self.case["wrong_rotation"]
        kernels = torch.stack([window(query, center, 2 * math.pi * r / rotations, size, bilinear) for r in range(rotations)])
        place = scale * F.conv2d(key[None], kernels)[0, :, : self.rows, : self.cols]
        if first is not None:
            place = place + first

        def log_sum_exp(x):
            return torch.logsumexp(x.flatten(), 0)

        pick_loss = log_sum_exp(pick) - (self.target(self.case["pick_px"]) * pick).sum()
        covered = (self.target(self.case["place_px"]) * place[right]).sum()
        if self.case["place_loss"] == "right_and_one_wrong":
            there = [coordinate + size // 2 for coordinate in self.index(self.case["place_px"])]
            there = window(key, there, 0.0, size, True)
            dots = scale * (kernels * there).flatten(1).sum(1)
            place_loss = log_sum_exp(dots) - dots[right]
            place_loss = place_loss + log_sum_exp(place[[right, wrong]]) - covered
        else:
            place_loss = log_sum_exp(place) - covered
        losses = [pick_loss, place_loss]
        if first is not None:
            losses.append(log_sum_exp(first) - (self.target(self.case["place_px"]) * first).sum())
            losses.append(F.softplus(done))
        return pick, place, torch.stack(losses)


def compare(what, ours, theirs, tolerance):
    error = ((ours - theirs).abs().max() / ours.abs().max()).item()
    print(f"{what}: off by {error:.1e} of the largest")
    assert error <= tolerance, f"{what}: off by {error}, allowed {tolerance}"


def main():
    torch.set_num_threads(1)
    case = Case(Path(sys.argv[1]))
    tolerance = case.case["tolerance"]
    with torch.set_grad_enabled(case.case["slopes"]):
        pick, place, losses = case.run()
    compare("pick logits", pick.detach(), case.tensors["expected/pick"], tolerance)
    compare("place logits", place.detach(), case.tensors["expected/place"], tolerance)
    expected = torch.tensor(case.case["expected_losses"], dtype=torch.float64)
    compare("losses", losses.detach(), expected, tolerance)
    if not case.case["slopes"]:
        return

    theirs = case.named("gradient")
    assert theirs.keys() == case.weights.keys()
    ours = dict(zip(case.weights, torch.autograd.grad(losses.sum(), list(case.weights.values())), strict=False))
    largest = max(gradient.abs().max() for gradient in ours.values())
    worst = 0.0
    for name, gradient in ours.items():
        # The floor is for the pick bias, whose gradient is 0: a softmax does not see it.
        size = gradient.abs().max() + 1e-4 * largest
        error = ((gradient - theirs[name]).abs().max() / size).item()
        assert error <= tolerance, f"gradient of {name}: off by {error} of its largest, allowed {tolerance}"
        worst = max(worst, error)
    print(f"{len(ours)} gradients: off by at most {worst:.1e} of the largest of each")


main()
