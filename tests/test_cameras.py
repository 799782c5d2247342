"""camera_fusion with good and bad views, from a camera driver written with rclpy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from sctn_msgs.msg import Heightmap

from cameras import BOX_COLOUR, BOX_HEIGHT_M, HEIGHT, WIDTH, Cameras, Change, View, depth_pixels, image, set_depth
from cell_operator import Operator
from processes import Process, free_domain

# Heights come from depths in f32 or whole millimetres.
TOLERANCE_M = 1e-3


@pytest.fixture(scope="module")
def fusion(start_for_module) -> Process:
    return start_for_module("camera_fusion")


@pytest.fixture(scope="module")
def cameras(fusion: Process, operator_for_module: Operator) -> Cameras:
    cameras = Cameras(operator_for_module)
    cameras.wait_for_fusion()
    cameras.publish_extrinsics()
    fused(operator_for_module, cameras)
    return cameras


def fused(operator: Operator, cameras: Cameras, change: Change = lambda _: None) -> Heightmap:
    """The heightmap of one set of views; they are sent again until one arrives, as images are best effort."""
    stamps = []

    def heightmap() -> Heightmap | None:
        stamps.append(cameras.publish(change))
        operator.spin(0.3)
        return next((made for made in reversed(operator.received["heightmap"]) if made.header.stamp in stamps), None)

    return operator.until(heightmap, "heightmap of these views", 20.0)


def heights(heightmap: Heightmap) -> np.ndarray:
    return np.asarray(heightmap.height_m).reshape(heightmap.rows, heightmap.cols)


def test_three_views_of_a_box_give_its_height_and_colour_where_it_stands(cameras, operator_for_module) -> None:
    heightmap = fused(operator_for_module, cameras)
    assert (heightmap.rows, heightmap.cols, heightmap.views) == (320, 160, 3)
    assert heightmap.header.frame_id == "world"
    middle = heights(heightmap)[155:165, 75:85]
    assert np.abs(middle - BOX_HEIGHT_M).max() < TOLERANCE_M
    assert np.abs(heights(heightmap)[20:60, 20:60]).max() < TOLERANCE_M
    rgb = np.asarray(heightmap.rgb).reshape(320, 160, 3)
    assert np.abs(rgb[160, 80].astype(int) - BOX_COLOUR).max() <= 1


def test_depth_in_millimetres_gives_the_same_heights(cameras, operator_for_module) -> None:
    def in_millimetres(view: View) -> None:
        millimetres = np.round(depth_pixels(view) * 1000).astype(np.uint16)
        view.depth.encoding = "16UC1"
        set_depth(view, millimetres)

    heightmap = fused(operator_for_module, cameras, in_millimetres)
    assert np.abs(heights(heightmap)[155:165, 75:85] - BOX_HEIGHT_M).max() < TOLERANCE_M


@pytest.mark.parametrize("hole", [math.nan, 0.0, -1.0, math.inf])
def test_holes_in_the_depth_are_no_points(cameras, operator_for_module, hole: float) -> None:
    def put_holes(view: View) -> None:
        pixels = depth_pixels(view)
        pixels[::3] = hole
        set_depth(view, pixels)

    heightmap = fused(operator_for_module, cameras, put_holes)
    assert np.isfinite(heights(heightmap)).all()
    assert np.abs(heights(heightmap)[155:165, 75:85] - BOX_HEIGHT_M).max() < TOLERANCE_M


def wrong_size(view: View) -> None:
    view.depth.height, view.depth.width = HEIGHT // 2, WIDTH // 2


def wrong_encoding(view: View) -> None:
    view.colour.encoding = "yuv422"


def wrong_depth_encoding(view: View) -> None:
    view.depth.encoding = "rgb8"


def truncated(view: View) -> None:
    view.colour.data = view.colour.data[: len(view.colour.data) // 2]


def colour_of_other_size(view: View) -> None:
    small = np.zeros((HEIGHT // 2, WIDTH // 2, 3), dtype=np.uint8)
    view.colour = image(view.colour.header, "rgb8", 3 * WIDTH // 2, small)
    view.colour.height, view.colour.width = HEIGHT // 2, WIDTH // 2


def no_focal_length(view: View) -> None:
    view.info.k[0] = 0.0


def intrinsics_that_are_no_number(view: View) -> None:
    view.info.k[2] = math.nan


def unknown_frame(view: View) -> None:
    for message in (view.colour, view.depth, view.info):
        message.header.frame_id = "nowhere"


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (wrong_size, ["left/depth"]),
        (wrong_encoding, ["left/color", "yuv422"]),
        (wrong_depth_encoding, ["left/depth", "rgb8"]),
        (truncated, ["left/color"]),
        (colour_of_other_size, ["left/color"]),
        (no_focal_length, ["left/color/camera_info"]),
        (intrinsics_that_are_no_number, ["left/color/camera_info"]),
        (unknown_frame, ["nowhere"]),
    ],
)
def test_a_bad_view_is_named_and_the_node_lives_on(cameras, operator_for_module, fusion, spoil: Change, said) -> None:
    before = len(fusion.errors())

    def complaint() -> bool:
        cameras.publish(spoil)
        operator_for_module.spin(0.3)
        log = fusion.errors()[before:]
        return all(word in log for word in said)

    operator_for_module.until(complaint, f"complaint that names {said} in the log of camera_fusion", 10.0)
    assert fusion.exit_code is None
    assert heights(fused(operator_for_module, cameras)).max() == pytest.approx(BOX_HEIGHT_M, abs=TOLERANCE_M)


def test_a_missing_camera_is_named_and_no_heightmap_of_two_views_passes_as_one_of_three(
    cameras, operator_for_module, fusion
) -> None:
    before = len(fusion.errors())
    heightmaps = operator_for_module.count("heightmap")

    def complaint() -> bool:
        cameras.publish(leave_out="right")
        operator_for_module.spin(0.3)
        return "right" in fusion.errors()[before:]

    operator_for_module.until(complaint, "complaint that names the camera right", 15.0)
    assert all(made.views < 3 for made in operator_for_module.received["heightmap"][heightmaps:])
    assert fused(operator_for_module, cameras).views == 3


def test_without_extrinsics_nothing_is_fused_and_the_camera_is_named(start) -> None:
    other = free_domain()
    fusion = start("camera_fusion", domain=other)
    with Operator(other) as operator:
        cameras = Cameras(operator)
        cameras.wait_for_fusion()
        cameras.publish_extrinsics(("front", "left"))

        def complaint() -> bool:
            cameras.publish()
            operator.spin(0.3)
            return "right_color_optical_frame" in fusion.errors()

        operator.until(complaint, "complaint about the frame without extrinsics", 15.0)
        assert fusion.exit_code is None
        assert all(made.views < 3 for made in operator.received["heightmap"])
        cameras.publish_extrinsics()
        assert fused(operator, cameras).views == 3
