"""The networks, their losses and slopes once more, in numpy and straight from the definitions.

Called by src/network/cross_check.rs with a folder that holds case.json and case.safetensors; fails
where the two differ by more than the case's tolerance, relative to the largest number.
"""

import json
import struct
import sys
from pathlib import Path

import numpy as np


def read_safetensors(path):
    data = path.read_bytes()
    (header_size,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + header_size])
    tensors = {}
    for name, entry in header.items():
        if name == "__metadata__":
            continue
        assert entry["dtype"] == "F64", name
        start, end = (8 + header_size + offset for offset in entry["data_offsets"])
        tensors[name] = np.frombuffer(data[start:end], "<f8").reshape(entry["shape"])
    return tensors


def relu(x):
    return np.maximum(x, 0.0)


def pad(x, top_bottom, left_right):
    return np.pad(x, ((0, 0), (top_bottom, top_bottom), (left_right, left_right)))


class Net:
    """Layers that look up their weights by name."""

    def __init__(self, weights):
        self.weights = weights

    def conv(self, name, x, stride=1):
        weight, bias = self.weights[name + ".weight"], self.weights[name + ".bias"]
        size = weight.shape[2]
        x = pad(x, (size - 1) // 2, (size - 1) // 2)
        rows, cols = ((length - size) // stride + 1 for length in x.shape[1:])
        out = np.zeros((weight.shape[0], rows * cols))
        for i in range(size):
            for j in range(size):
                part = x[:, i : i + stride * rows : stride, j : j + stride * cols : stride]
                out += weight[:, :, i, j] @ part.reshape(len(x), -1)
        return (out + bias[:, None]).reshape(-1, rows, cols)


def doubling(length):
    """Matrix of linear interpolation between the centres of cells, from length to twice as many."""
    matrix = np.zeros((2 * length, length))
    for index in range(2 * length):
        source = min(max((index + 0.5) / 2 - 0.5, 0.0), length - 1.0)
        low = int(source)
        matrix[index, low] += 1 - (source - low)
        matrix[index, min(low + 1, length - 1)] += source - low
    return matrix


def upsample(x):
    return np.einsum("ir,crs,js->cij", doubling(x.shape[1]), x, doubling(x.shape[2]), optimize=True)


def hourglass(net, name, x):
    x = relu(net.conv(f"{name}.stem", x))
    for stage, stride in enumerate([1, 2, 2, 2, 1, 1, 1, 1]):
        for part in "ab":
            at = f"{name}.stage{stage}.{part}"
            own = stride if part == "a" else 1
            y = relu(net.conv(f"{at}.first", x, own))
            y = net.conv(f"{at}.third", relu(net.conv(f"{at}.second", y)))
            x = y + (net.conv(f"{at}.shortcut", x, own) if part == "a" else x)
            if stage < 7:
                x = relu(x)
        if stage in (4, 5, 6):
            x = upsample(x)
    return x


def published(net, config, observation, goal):
    """Pick logits, query and key features with their margin, scale."""

    def image(heightmap, margins):
        rgb = pad(heightmap["rgb"].transpose(2, 0, 1), *margins)
        height = pad(heightmap["height_m"][None], *margins)
        rgb = (rgb / 255 - 0.18877631) / 0.07276466
        height = (height - 0.00509261) / 0.00903967
        return np.concatenate([rgb, height, height, height])

    rows, cols = config["rows"], config["cols"]
    edge = max(rows, cols)
    top, left = (edge - rows) // 2, (edge - cols) // 2
    stacked = np.concatenate([image(heightmap, (top, left)) for heightmap in (observation, goal)])
    pick = hourglass(net, "pick", stacked)[0, top : top + rows, left : left + cols]
    half = config["network"]["crop_px"] // 2
    seen, wanted = (image(heightmap, (half, half)) for heightmap in (observation, goal))
    goal_features = hourglass(net, "goal", wanted)
    query = hourglass(net, "query", seen) * goal_features
    key = hourglass(net, "key", seen) * goal_features
    return pick, query, key, (2 * half) ** -2.0


def compact_input(observation, goal):
    """The 14 channels that the compact network reads."""
    seen, wanted = (np.concatenate([h["rgb"].transpose(2, 0, 1) / 128 - 1.1, h["height_m"][None] / 0.04]) for h in (observation, goal))
    change = wanted - seen
    color, height = np.abs(change[:3]).mean(0, keepdims=True), np.abs(change[3:])
    return np.concatenate([seen, wanted, change, color, height])


def sequence_input(observation, previous, image):
    """The 24 channels that the matching network reads."""
    seen, before, after = (
        np.concatenate([h["rgb"].transpose(2, 0, 1) / 128 - 1.1, h["height_m"][None] / 0.04]) for h in (observation, previous, image)
    )
    changes = after - before, after - seen
    sizes = [part for c in changes for part in (np.abs(c[:3]).mean(0, keepdims=True), np.abs(c[3:]))]
    return np.concatenate([seen, before, after, *changes, *sizes])


def trunk(net, config, x):
    """The U-Net of the compact and of the matching network."""

    def block(name, x):
        return relu(x + net.conv(f"{name}.second", relu(net.conv(f"{name}.first", x))))

    skips = []
    for level, blocks in enumerate(config["network"]["blocks"]):
        x = relu(net.conv("stem" if level == 0 else f"level{level}.down", x, 2))
        for index in range(blocks):
            x = block(f"level{level}.block{index}", x)
        skips.append(x)
    for level in (2, 1, 0):
        x = upsample(net.conv(f"rise{level}.lateral", x)) + skips[level]
        x = block(f"rise{level}.block", x)
    return x


def matching(net, config, x, attention=None):
    """Pick logits, query features, key features with their margin, scale, first place logits, logit of done, attention.

    The attention is a constant to every gradient: slopes give the one of the case's own weights.
    """
    network = config["network"]
    place_head, bias_head, context_head, key_head, done_head = np.split(relu(net.conv("heads", trunk(net, config, x))), 5)
    place = net.conv("place", place_head)[0]
    if attention is None:
        attention = np.exp(place - log_sum_exp(place))

    def embedded(image):
        for name in ("first", "second"):
            image = relu(net.conv(f"embedding.{name}", image, 2 if name == "first" else 1))
        image = net.conv("embedding.third", image)
        vectors, features = np.split(image, [network["appearance_channels"]])
        return vectors / np.linalg.norm(vectors, axis=0), features

    seen, seen_features = embedded(x[0:4])
    shown, shown_features = embedded(x[8:12])
    moved = (shown * attention).sum((1, 2))
    cosine = np.tensordot(moved / np.linalg.norm(moved), seen, 1)
    pick = net.weights["match_scale"][0] * cosine + net.conv("bias", bias_head)[0]
    gate = 1 / (1 + np.exp(-net.conv("gate", key_head)))
    query = np.concatenate([seen_features, net.conv("query", context_head)])
    key = np.concatenate([shown_features * gate, net.conv("key", key_head)])
    margin = network["window_cells"] // 2
    done = (net.conv("done", done_head)[0] * attention).sum()
    return pick, query, pad(key, margin, margin), net.weights["scale"][0], place, done, attention


def compact(net, config, x):
    """Pick logits, query features, key features with their margin, scale."""
    x = trunk(net, config, x)
    heads = np.split(relu(net.conv("heads", x)), 3)
    pick, query, key = (net.conv(name, head) for name, head in zip(("pick", "query", "key"), heads, strict=False))
    margin = config["network"]["window_cells"] // 2
    return pick[0], query, pad(key, margin, margin), net.weights["scale"][0]


def at(features, row, col):
    """The features of a cell, zero outside."""
    inside = 0 <= row < features.shape[1] and 0 <= col < features.shape[2]
    return features[:, row, col] if inside else np.zeros(len(features))


def sample(features, x, y, bilinear):
    if not bilinear:
        return at(features, round(y), round(x))
    row, col = int(np.floor(y)), int(np.floor(x))
    down, right = y - row, x - col
    return (
        (1 - down) * (1 - right) * at(features, row, col)
        + (1 - down) * right * at(features, row, col + 1)
        + down * (1 - right) * at(features, row + 1, col)
        + down * right * at(features, row + 1, col + 1)
    )


def window(features, center, angle, size, bilinear):
    """What an object looks like that was turned by `angle` after it was picked at `center` (x, y)."""
    out = np.zeros((len(features), size, size))
    cos, sin = np.cos(angle), np.sin(angle)
    for i in range(size):
        for j in range(size):
            v, u = i - size // 2, j - size // 2
            # Where the turned object now is at (u, v), the lying one was at R(-angle) (u, v).
            x, y = center[0] + cos * u + sin * v, center[1] - sin * u + cos * v
            if not bilinear:
                # Ties between cells, at right angles, must not depend on the last bit.
                x, y = round(x, 9), round(y, 9)
            out[:, i, j] = sample(features, x, y, bilinear)
    return out


def correlation(key, kernel, rows, cols):
    size = kernel.shape[1]
    out = np.zeros((rows, cols))
    for i in range(size):
        for j in range(size):
            out += np.tensordot(kernel[:, i, j], key[:, i : i + rows, j : j + cols], 1)
    return out


def log_sum_exp(x):
    return x.max() + np.log(np.exp(x - x.max()).sum())


class Case:
    def __init__(self, folder):
        self.case = json.loads((folder / "case.json").read_text())
        self.tensors = read_safetensors(folder / "case.safetensors")
        self.config = self.case["network"]
        self.kind = self.config["network"]["kind"]
        self.compact = self.kind in ("compact", "matching")
        self.stride = 2 if self.compact else 1
        self.rows = self.config["rows"] // self.stride
        self.cols = self.config["cols"] // self.stride
        self.weights = self.named("weight")
        self.attention = None

    def named(self, prefix):
        prefix += "/"
        return {name[len(prefix) :]: x for name, x in self.tensors.items() if name.startswith(prefix)}

    def index(self, point_px):
        """Image coordinates -> x, y counted in cells from the centre of the first."""
        return [coordinate / self.stride - 0.5 for coordinate in point_px]

    def target(self, point_px):
        x, y = self.index(point_px)
        sigma = self.case["sigma_cells"]
        row, col = int(np.floor(y + 0.5)), int(np.floor(x + 0.5))
        out = np.zeros((self.rows, self.cols))
        if sigma == 0:
            out[row, col] = 1
            return out
        reach = int(np.ceil(4 * sigma))
        for i in range(max(row - reach, 0), min(row + reach + 1, self.rows)):
            for j in range(max(col - reach, 0), min(col + reach + 1, self.cols)):
                out[i, j] = np.exp(-((j - x) ** 2 + (i - y) ** 2) / (2 * sigma**2))
        return out / out.sum()

    def run(self, weights, all_rotations):
        """Pick logits, place logits by rotation, and the two losses."""
        observation, goal = self.named("observation"), self.named("goal")
        net = Net(weights)
        first = None
        if self.compact:
            # Images are encoded in 32 bits; from there on the two must agree to the last digits.
            if self.kind == "matching":
                read = sequence_input(observation, self.named("last"), goal)
                read_by = self.tensors["input"], self.attention
                pick, query, key, scale, first, done, self.attention = matching(net, self.config, *read_by)
            else:
                read = compact_input(observation, goal)
                pick, query, key, scale = compact(net, self.config, self.tensors["input"])
            compare("input", read, self.tensors["input"], 1e-6, quiet=True)
        else:
            pick, query, key, scale = published(net, self.config, observation, goal)
        network, rotations = self.config["network"], self.config["rotations"]
        size = network["window_cells"] if self.compact else network["crop_px"]
        bilinear = self.compact or network["rotation_sampling"] == "bilinear"
        margin = 0 if self.compact else size // 2
        center = [coordinate + margin for coordinate in self.index(self.case["pick_px"])]
        right, wrong = self.case["rotation"], self.case["wrong_rotation"]
        cheap = self.case["place_loss"] == "right_and_one_wrong"
        kernels = [window(query, center, 2 * np.pi * r / rotations, size, bilinear) for r in range(rotations)]
        wanted = range(rotations) if all_rotations or not cheap else (right, wrong)
        before = 0.0 if first is None else first
        place = {r: before + scale * correlation(key, kernels[r], self.rows, self.cols) for r in wanted}

        pick_loss = log_sum_exp(pick) - (self.target(self.case["pick_px"]) * pick).sum()
        covered = (self.target(self.case["place_px"]) * place[right]).sum()
        if cheap:
            there = [coordinate + size // 2 for coordinate in self.index(self.case["place_px"])]
            there = window(key, there, 0.0, size, True)
            dots = np.array([scale * (kernel * there).sum() for kernel in kernels])
            place_loss = log_sum_exp(dots) - dots[right]
            place_loss += log_sum_exp(np.stack([place[right], place[wrong]])) - covered
        else:
            place_loss = log_sum_exp(np.stack([place[r] for r in range(rotations)])) - covered
        losses = [pick_loss, place_loss]
        if first is not None:
            losses.append(log_sum_exp(first) - (self.target(self.case["place_px"]) * first).sum())
            losses.append(np.log1p(np.exp(done)))
        return pick, place, np.array(losses)

    def slope(self, direction):
        """How the sum of the losses changes along a direction in weights."""
        # Short enough that few ReLUs switch on the way, long enough that rounding does not show.
        step = 1e-5 / np.sqrt(sum(x.size for x in direction.values()))

        def loss(step):
            weights = {name: x + step * direction.get(name, 0.0) for name, x in self.weights.items()}
            return self.run(weights, False)[2].sum()

        return (loss(step) - loss(-step)) / (2 * step)


def compare(what, ours, theirs, tolerance, quiet=False):
    error = np.abs(ours - theirs).max() / np.abs(ours).max()
    if not quiet:
        print(f"{what}: off by {error:.1e} of the largest")
    assert error <= tolerance, f"{what}: off by {error}, allowed {tolerance}"


def main():
    case = Case(Path(sys.argv[1]))
    tolerance = case.case["tolerance"]
    pick, place, losses = case.run(case.weights, True)
    compare("pick logits", pick, case.tensors["expected/pick"], tolerance)
    place = np.stack([place[r] for r in range(case.config["rotations"])])
    compare("place logits", place, case.tensors["expected/place"], tolerance)
    compare("losses", losses, np.array(case.case["expected_losses"]), tolerance)
    if not case.case["slopes"]:
        return

    # Central differences are good to some 1e-8, but to 1e-5 where a ReLU switches on the way.
    gradients = case.named("gradient")
    rng = np.random.default_rng(1)

    def size(names):
        return np.sqrt(sum((gradients[name] ** 2).sum() for name in names))

    def check(what, names):
        direction = {name: rng.standard_normal(case.weights[name].shape) for name in names}
        expected = sum((gradients[name] * direction[name]).sum() for name in names)
        # The floor is for the pick bias, whose gradient is 0: a softmax does not see it.
        error = abs(case.slope(direction) - expected) / (size(names) + 1e-4 * size(gradients))
        assert error < 1e-4, f"slope along {what}: off by {error} of the gradient"
        return error

    groups = [[name] for name in case.weights] if case.compact else []
    errors = [check(f"{group}", group) for group in groups]
    errors += [check("all weights", list(case.weights)) for _ in range(2)]
    print(f"{len(errors)} slopes: off by at most {max(errors):.1e} of the gradient")


main()
