"""The networks of the Python package, their losses and every gradient against those of this crate.

Called by src/network/cross_check.rs with a folder that holds case.json, case.safetensors and, for weights in 32 bits, the
checkpoint model.safetensors; fails where the two differ by more than the case's tolerance, relative to the largest number.
Convolutions are PyTorch's own and so is every derivative; windows are sampled and correlated without Fourier transforms.
"""

import importlib.util
import json
import math
import sys
from pathlib import Path

import torch
import torch.nn.functional as F

# The network of the Python package, from its file: the package itself need not be installed.
SOURCE = Path(__file__).resolve().parents[3] / "python/package/multiravens/network.py"
SPEC = importlib.util.spec_from_file_location("network", SOURCE)
network = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(network)


class Case:
    def __init__(self, folder):
        self.case = json.loads((folder / "case.json").read_text())
        self.tensors, _ = network.read_safetensors(folder / "case.safetensors")
        self.config = network.complete(self.case["network"])
        if self.case["slopes"]:
            self.net = network.Network(self.config).double()
            self.net.load_state_dict(self.named("weight"))
        else:
            self.net = network.Policy.load(folder / "model.safetensors").network
            assert self.net.config == self.config, "the checkpoint is of another network"
        self.kind = torch.float64 if self.case["slopes"] else torch.float32
        self.stride = self.net.stride
        self.rows, self.cols = self.net.grid

    def named(self, prefix):
        prefix += "/"
        return {name[len(prefix) :]: x for name, x in self.tensors.items() if name.startswith(prefix)}

    def images(self):
        two = self.config["conditioning"] in ("both", "sequence")
        names = ("observation", "goal", "last") if two else ("observation", "goal")
        return [{"color": self.tensors[f"{name}/rgb"], "height": self.tensors[f"{name}/height_m"]} for name in names]

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
        """Pick logits, place logits of every rotation, and the losses."""
        read = self.tensors["input"].to(self.kind)[None]
        said = self.net(read)
        # From the features on in 64 bits, so that what rounding there is is the other side's.
        said = network.Features(*(x.double() if torch.is_tensor(x) else x for x in said))
        pick, first = said.pick, said.place
        place = self.net.place_logits(said, self.case["pick_px"])
        right, wrong = self.case["rotation"], self.case["wrong_rotation"]

        def log_sum_exp(x):
            return torch.logsumexp(x.flatten(), 0)

        pick_loss = log_sum_exp(pick) - (self.target(self.case["pick_px"]) * pick).sum()
        covered = (self.target(self.case["place_px"]) * place[right]).sum()
        if self.case["place_loss"] == "right_and_one_wrong":
            # The rotation is told where the place is: what the windows say there, between cells.
            size = self.config["network"].get("window_cells") or self.config["network"]["crop_px"]
            margin = size // 2 if self.stride == 1 else 0
            center = [coordinate + margin for coordinate in self.index(self.case["pick_px"])]
            bilinear = self.config["network"]["rotation_sampling"] == "bilinear"
            turns = (2 * math.pi * turn / self.config["rotations"] for turn in range(self.config["rotations"]))
            kernels = torch.stack([network.window(said.query, center, turn, size, bilinear) for turn in turns])
            there = [coordinate + size // 2 for coordinate in self.index(self.case["place_px"])]
            there = network.window(said.key, there, 0.0, size, True)
            dots = said.scale * (kernels * there).flatten(1).sum(1)
            place_loss = log_sum_exp(dots) - dots[right]
            place_loss = place_loss + log_sum_exp(place[[right, wrong]]) - covered
        else:
            place_loss = log_sum_exp(place) - covered
        losses = [pick_loss, place_loss]
        if first is not None:
            losses.append(log_sum_exp(first) - (self.target(self.case["place_px"]) * first).sum())
            losses.append(F.softplus(said.done))
        return pick, place, torch.stack(losses)


def compare(what, ours, theirs, tolerance):
    error = ((ours - theirs).abs().max() / ours.abs().max()).item()
    print(f"{what}: off by {error:.1e} of the largest")
    assert error <= tolerance, f"{what}: off by {error}, allowed {tolerance}"


def main():
    torch.set_num_threads(1)
    case = Case(Path(sys.argv[1]))
    tolerance = case.case["tolerance"]
    # Single precision on both sides, whatever the weights.
    compare("input", case.tensors["input"], network.encode(case.config, *case.images())[0].double(), 1e-6)
    with torch.set_grad_enabled(case.case["slopes"]):
        pick, place, losses = case.run()
    compare("pick logits", pick.detach(), case.tensors["expected/pick"], tolerance)
    compare("place logits", place.detach(), case.tensors["expected/place"], tolerance)
    expected = torch.tensor(case.case["expected_losses"], dtype=torch.float64)
    compare("losses", losses.detach(), expected, tolerance)
    if not case.case["slopes"]:
        return

    theirs, weights = case.named("gradient"), dict(case.net.named_parameters())
    assert theirs.keys() == weights.keys()
    ours = dict(zip(weights, torch.autograd.grad(losses.sum(), list(weights.values())), strict=True))
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
