"""camera_fusion with good and bad views, from a camera driver written with rclpy."""

from __future__ import annotations

import functools
import math
import time

import numpy as np
import pytest
from cameras import (
    BOX_COLOR,
    BOX_HEIGHT_M,
    CAMERA_HEIGHT_M,
    FOCAL_PX,
    HEIGHT,
    LENSES,
    WIDTH,
    Cameras,
    Change,
    View,
    depth_pixels,
    image,
    set_depth,
    through_lens,
)
from cell_operator import LATCHED, Operator, nanoseconds
from diagnostic_msgs.msg import DiagnosticStatus
from processes import Process, free_domain
from sctn_msgs.msg import Heightmap
from sensor_msgs.msg import CompressedImage, Image, PointCloud2

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


def fused(operator: Operator, cameras: Cameras, change: Change = lambda _: None, changed: str | None = "left") -> Heightmap:
    """The heightmap of one set of views; they are sent again until one arrives, as images are best effort."""
    stamps = []

    def heightmap() -> Heightmap | None:
        stamps.append(cameras.publish(change, changed))
        operator.spin(0.3)
        return next((made for made in reversed(operator.received["heightmap"]) if made.header.stamp in stamps), None)

    return operator.until(heightmap, "heightmap of these views", 60.0)


def heights(heightmap: Heightmap) -> np.ndarray:
    return np.asarray(heightmap.height_m).reshape(heightmap.rows, heightmap.cols)


def test_three_views_of_a_box_give_its_height_and_color_where_it_stands(cameras, operator_for_module) -> None:
    heightmap = fused(operator_for_module, cameras)
    assert (heightmap.rows, heightmap.cols, heightmap.views) == (320, 160, 3)
    assert heightmap.header.frame_id == "world"
    middle = heights(heightmap)[155:165, 75:85]
    assert np.abs(middle - BOX_HEIGHT_M).max() < TOLERANCE_M
    assert np.abs(heights(heightmap)[20:60, 20:60]).max() < TOLERANCE_M
    rgb = np.asarray(heightmap.rgb).reshape(320, 160, 3)
    assert np.abs(rgb[160, 80].astype(int) - BOX_COLOR).max() <= 1


def test_depth_in_millimetres_gives_the_same_heights(cameras, operator_for_module) -> None:
    def in_millimetres(view: View) -> None:
        millimetres = np.round(depth_pixels(view) * 1000).astype(np.uint16)
        view.depth.encoding = "16UC1"
        set_depth(view, millimetres)

    heightmap = fused(operator_for_module, cameras, in_millimetres)
    assert np.abs(heights(heightmap)[155:165, 75:85] - BOX_HEIGHT_M).max() < TOLERANCE_M


def as_mono16(view: View) -> None:
    view.depth.encoding = "mono16"
    set_depth(view, np.round(depth_pixels(view) * 1000).astype(np.uint16))


def half_size(view: View) -> None:
    small = np.ascontiguousarray(depth_pixels(view)[::2, ::2])
    view.depth = image(view.depth.header, "32FC1", 2 * WIDTH, small)
    view.depth.height, view.depth.width = HEIGHT // 2, WIDTH // 2


def inverse_brown_conrady(view: View) -> None:
    view.info.distortion_model = "inverse_brown_conrady"


@pytest.mark.parametrize("change", [as_mono16, half_size, inverse_brown_conrady])
def test_what_drivers_of_depth_cameras_send_gives_the_same_heights(cameras, operator_for_module, change: Change) -> None:
    heightmap = fused(operator_for_module, cameras, change, None)
    assert np.abs(heights(heightmap)[155:165, 75:85] - BOX_HEIGHT_M).max() < TOLERANCE_M
    assert (np.abs(heights(heightmap)) > TOLERANCE_M).sum() < 1.2 * (40 * 40 * (1 / 450 / 0.003125) ** 2)


@pytest.mark.parametrize("hole", [math.nan, 0.0, -1.0, math.inf])
def test_holes_in_the_depth_are_no_points(cameras, operator_for_module, hole: float) -> None:
    def put_holes(view: View) -> None:
        pixels = depth_pixels(view)
        pixels[::3] = hole
        set_depth(view, pixels)

    heightmap = fused(operator_for_module, cameras, put_holes)
    assert np.isfinite(heights(heightmap)).all()
    assert np.abs(heights(heightmap)[155:165, 75:85] - BOX_HEIGHT_M).max() < TOLERANCE_M


@pytest.mark.parametrize(("encoding", "channels"), [("bgr8", [2, 1, 0]), ("rgba8", [0, 1, 2, 0]), ("bgra8", [2, 1, 0, 0])])
def test_colors_are_read_in_every_order_with_padded_rows(cameras, operator_for_module, encoding: str, channels) -> None:
    def reorder(view: View) -> None:
        rgb = np.frombuffer(view.color.data.tobytes(), dtype=np.uint8).reshape(HEIGHT, WIDTH, 3)
        rows = rgb[:, :, channels].reshape(HEIGHT, -1)
        padded = np.pad(rows, ((0, 0), (0, 13)), constant_values=77)
        view.color = image(view.color.header, encoding, padded.shape[1], padded)

    heightmap = fused(operator_for_module, cameras, reorder, None)
    rgb = np.asarray(heightmap.rgb).reshape(320, 160, 3)
    assert np.abs(rgb[160, 80].astype(int) - BOX_COLOR).max() <= 1


def test_depth_of_the_other_byte_order_with_padded_rows_gives_the_same_heights(cameras, operator_for_module) -> None:
    def swap(view: View) -> None:
        rows = depth_pixels(view).byteswap().view(np.uint8).reshape(HEIGHT, -1)
        padded = np.pad(rows, ((0, 0), (0, 6)), constant_values=255)
        view.depth = image(view.depth.header, "32FC1", padded.shape[1], padded)
        view.depth.is_bigendian = 1

    heightmap = fused(operator_for_module, cameras, swap, None)
    assert np.abs(heights(heightmap)[155:165, 75:85] - BOX_HEIGHT_M).max() < TOLERANCE_M


@pytest.mark.parametrize("model", LENSES)
def test_a_camera_behind_a_lens_sees_the_box_where_the_others_do(cameras, operator_for_module, model: str) -> None:
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    seen_x, seen_y = (columns - (WIDTH - 1) / 2) / FOCAL_PX, (rows - (HEIGHT - 1) / 2) / FOCAL_PX
    # The box in a corner of the image, where the lens moves it by a dozen cells.
    inside = lambda x, y: (np.abs(x - 0.4) < 0.05) & (np.abs(y - 0.18) < 0.05)  # noqa: E731
    ideal_x, ideal_y = seen_x.copy(), seen_y.copy()
    for _ in range(300):
        shown_x, shown_y = through_lens(model, ideal_x, ideal_y)
        ideal_x, ideal_y = ideal_x + seen_x - shown_x, ideal_y + seen_y - shown_y
    assert max(np.abs(shown_x - seen_x).max(), np.abs(shown_y - seen_y).max()) < 1e-9

    def show(view: View, lens: bool) -> None:
        box = inside(ideal_x, ideal_y) if lens else inside(seen_x, seen_y)
        depth = np.where(box, CAMERA_HEIGHT_M - BOX_HEIGHT_M, CAMERA_HEIGHT_M).astype(np.float32)
        color = np.where(box[:, :, None], BOX_COLOR, 120).astype(np.uint8)
        set_depth(view, depth)
        view.color = image(view.color.header, "rgb8", 3 * WIDTH, color)
        if lens:
            view.info.distortion_model = model
            view.info.d = list(LENSES[model])

    straight = heights(fused(operator_for_module, cameras, lambda view: show(view, False), None))
    bent = heights(fused(operator_for_module, cameras, lambda view: show(view, view.info.header.frame_id.startswith("left")), None))
    assert (straight > BOX_HEIGHT_M / 2).sum() > 500
    # The same but for the edges of the box, in all three views.
    assert (np.abs(straight - bent) > TOLERANCE_M).sum() < 100
    all_bent = heights(fused(operator_for_module, cameras, lambda view: show(view, True), None))
    assert (np.abs(straight - all_bent) > TOLERANCE_M).sum() < 200


def wrong_size(view: View) -> None:
    view.depth.height, view.depth.width = HEIGHT // 2, WIDTH // 2


def wrong_encoding(view: View) -> None:
    view.color.encoding = "yuv422"


def wrong_depth_encoding(view: View) -> None:
    view.depth.encoding = "rgb8"


def truncated(view: View) -> None:
    view.color.data = view.color.data[: len(view.color.data) // 2]


def color_of_other_size(view: View) -> None:
    small = np.zeros((HEIGHT // 2, WIDTH // 2, 3), dtype=np.uint8)
    view.color = image(view.color.header, "rgb8", 3 * WIDTH // 2, small)
    view.color.height, view.color.width = HEIGHT // 2, WIDTH // 2


def no_focal_length(view: View) -> None:
    view.info.k[0] = 0.0


def intrinsics_that_are_no_number(view: View) -> None:
    view.info.k[2] = math.nan


def unknown_lens(view: View) -> None:
    view.info.distortion_model = "omnidirectional"
    view.info.d = [0.1, 0.0, 0.0, 0.0]


def coefficient_that_is_no_number(view: View) -> None:
    view.info.distortion_model = "equidistant"
    view.info.d = [0.1, 0.0, math.nan, 0.0]


def fisheye_that_sees_behind_itself(view: View) -> None:
    view.info.distortion_model = "equidistant"
    view.info.d = [0.0] * 4
    view.info.k[0] = view.info.k[4] = FOCAL_PX / 2


def lens_that_folds_the_image(view: View) -> None:
    view.info.d = [-2.0, 0.0, 0.0, 0.0, 0.0]


def unknown_frame(view: View) -> None:
    for message in (view.color, view.depth, view.info):
        message.header.frame_id = "nowhere"


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (wrong_size, ["left/depth"]),
        (wrong_encoding, ["left/color", "yuv422"]),
        (wrong_depth_encoding, ["left/depth", "rgb8"]),
        (truncated, ["left/color"]),
        (color_of_other_size, ["left/color"]),
        (no_focal_length, ["left/color/camera_info"]),
        (intrinsics_that_are_no_number, ["left/color/camera_info"]),
        (unknown_lens, ["left/color/camera_info", "omnidirectional", "plumb_bob"]),
        (coefficient_that_is_no_number, ["left/color/camera_info", "d[2]"]),
        (fisheye_that_sees_behind_itself, ["left/color/camera_info", "equidistant", "pixel"]),
        (lens_that_folds_the_image, ["left/color/camera_info", "distortion", "pixel"]),
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

    operator_for_module.until(complaint, f"complaint that names {said} in the log of camera_fusion", 60.0)
    assert fusion.exit_code is None
    assert heights(fused(operator_for_module, cameras)).max() == pytest.approx(BOX_HEIGHT_M, abs=TOLERANCE_M)


def test_a_missing_camera_is_named_and_no_heightmap_of_two_views_passes_as_one_of_three(cameras, operator_for_module, fusion) -> None:
    before = len(fusion.errors())
    stamps = []

    def complaint() -> bool:
        stamps.append(nanoseconds(cameras.publish(leave_out="right")))
        operator_for_module.spin(0.3)
        return "right" in fusion.errors()[before:]

    operator_for_module.until(complaint, "complaint that names the camera right", 60.0)
    # One of the views before may come late.
    made = [made for made in operator_for_module.received["heightmap"] if nanoseconds(made.header.stamp) >= stamps[0]]
    assert all(heightmap.views < 3 for heightmap in made)
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

        operator.until(complaint, "complaint about the frame without extrinsics", 60.0)
        assert fusion.exit_code is None
        assert all(made.views < 3 for made in operator.received["heightmap"])
        cameras.publish_extrinsics()
        assert fused(operator, cameras).views == 3


def test_transforms_that_come_some_seconds_after_the_images_are_waited_for_without_a_word(start) -> None:
    other = free_domain()
    fusion = start("camera_fusion", domain=other)
    with Operator(other) as operator:
        cameras = Cameras(operator)
        cameras.wait_for_fusion()
        for _ in range(10):
            cameras.publish()
            operator.spin(0.2)
        assert not operator.received["heightmap"]
        cameras.publish_extrinsics()
        assert fused(operator, cameras).views == 3
        operator.until(lambda: operator.diagnosed("camera_fusion: topics"), "diagnostics", 60.0)
        said = operator.diagnosed("camera_fusion: topics")
        counted = [said[f"/{name}/color/image_raw"] for name in ("front", "left", "right")]
        assert all("errors=0" in line for line in counted), counted
        assert "optical_frame" not in fusion.errors()


def test_the_standard_qos_overrides_are_accepted_and_those_that_break_the_protocol_refused_by_name(start, tmp_path) -> None:
    file = tmp_path / "cell.yaml"

    def start_with(overrides: str) -> Process:
        file.write_text(f"/**:\n  ros__parameters:\n    qos_overrides: {{{overrides}}}\n")
        return start("camera_fusion", "--ros-args", "--params-file", file, domain=free_domain())

    accepted = start_with("/parameter_events: {publisher: {depth: 10, history: keep_last}}")
    deadline = time.monotonic() + 60.0
    while "active" not in accepted.errors().split("activating")[-1]:
        assert accepted.exit_code is None and time.monotonic() < deadline, accepted.log()
        time.sleep(0.1)
    for overrides, name in [
        ("/heightmap: {publisher: {reliability: best_effort}}", "qos_overrides./heightmap.publisher.reliability"),
        ("/heightmap: {publisher: {depht: 3}}", "qos_overrides./heightmap.publisher.depht"),
    ]:
        refused = start_with(overrides)
        assert refused.wait(60.0) != 0
        assert name in refused.errors()


def test_a_camera_that_stops_and_comes_back_is_in_the_diagnostics_and_others_go_on_where_asked_to(start) -> None:
    other = free_domain()
    start("camera_fusion", "--ros-args", "-p", "fuse_without_silent:=true", "-p", "camera_timeout_s:=1.0", domain=other)
    with Operator(other) as operator:

        def said(level: bytes, words: str) -> bool:
            state = operator.states.get("/camera_fusion: camera right")
            return state is not None and state.level == level and words in state.message

        cameras = Cameras(operator)
        cameras.wait_for_fusion()
        cameras.publish_extrinsics()
        assert fused(operator, cameras).views == 3

        def without_right(views: int) -> bool:
            cameras.publish(leave_out="right" if views == 2 else None)
            operator.spin(0.2)
            return operator.newest("heightmap").views == views

        operator.until(lambda: without_right(2), "heightmap of two views", 60.0)
        operator.until(lambda: without_right(2) and said(DiagnosticStatus.ERROR, "no colour and depth image"), "error", 60.0)
        operator.until(lambda: without_right(3), "heightmap of three views", 60.0)
        operator.until(lambda: without_right(3) and said(DiagnosticStatus.OK, "images arrive"), "recovery", 60.0)

        def used() -> bool:
            fusion, right = (operator.diagnosed(f"camera_fusion: {state}") for state in ("fusion", "camera right"))
            return fusion["views"] == "3" and right["last_used_color_stamp_s"] == fusion["stamp_s"]

        # What was used, said once a second.
        operator.until(lambda: without_right(3) and used(), "report of three views", 60.0)
        assert float(operator.diagnosed("camera_fusion: fusion")["coverage"]) > 0.5


def test_a_calibration_file_says_where_the_cameras_are_without_tf(start, tmp_path) -> None:
    file = tmp_path / "cell.yaml"
    pose = "{translation_m: [0.5, 0.0, 1.0], rotation_xyzw: [0.7071067811865476, 0.7071067811865476, 0.0, 0.0]}"
    file.write_text("cameras:\n" + "".join(f"  {name}: {pose}\n" for name in ("front", "left", "right")))
    other = free_domain()
    start("camera_fusion", "--ros-args", "-p", f"calibration:={file}", domain=other)
    with Operator(other) as operator:
        cameras = Cameras(operator)
        cameras.wait_for_fusion()
        assert np.abs(heights(fused(operator, cameras))[155:165, 75:85] - BOX_HEIGHT_M).max() < TOLERANCE_M
    for spoiled, word in [(pose.replace("0.0, 0.0]}", "0.0, 0.5]}"), "left"), (pose.replace("translation_m", "place"), "place")]:
        file.write_text(f"cameras:\n  left: {spoiled}\n")
        refused = start("camera_fusion", "--ros-args", "-p", f"calibration:={file}", domain=other)
        assert refused.wait(60.0) != 0
        assert "cell.yaml" in refused.errors()
        assert word in refused.errors()


@pytest.mark.parametrize(
    ("preset", "topics"),
    [
        (
            "realsense_aligned",
            ["color/image_raw", "aligned_depth_to_color/image_raw", "color/camera_info", "aligned_depth_to_color/camera_info"],
        ),
        ("orbbec", ["color/image_raw", "depth/image_raw", "color/camera_info", "depth/camera_info"]),
        (
            "zed",
            [
                "zed_node/rgb/color/rect/image",
                "zed_node/depth/depth_registered",
                "zed_node/rgb/color/rect/camera_info",
                "zed_node/depth/camera_info",
            ],
        ),
        (
            "zed_5_0",
            ["zed_node/rgb/image_rect_color", "zed_node/depth/depth_registered", "zed_node/rgb/camera_info", "zed_node/depth/camera_info"],
        ),
    ],
)
def test_the_topics_of_a_real_driver_are_heard_by_its_preset(start, preset: str, topics: list[str]) -> None:
    other = free_domain()
    start("camera_fusion", "--ros-args", "-p", f"camera_preset:={preset}", domain=other)
    with Operator(other) as operator:
        cameras = Cameras(operator, topics=tuple(topics))
        cameras.wait_for_fusion()
        cameras.publish_extrinsics()
        assert fused(operator, cameras).views == 3


def test_an_unknown_preset_is_refused_by_name(start) -> None:
    refused = start("camera_fusion", "--ros-args", "-p", "camera_preset:=kinect", domain=free_domain())
    assert refused.wait(60.0) != 0
    assert "camera_preset" in refused.errors() and "realsense_aligned" in refused.errors()


def test_every_view_of_the_heightmap_comes_to_who_listens(start) -> None:
    other = free_domain()
    start("camera_fusion", domain=other)
    with Operator(other) as operator:
        cameras = Cameras(operator)
        cameras.wait_for_fusion()
        cameras.publish_extrinsics()
        fused(operator, cameras)
        # Who comes after the heightmap gets its views all the same.
        views: dict[str, object] = {}
        for kind, topic in [(PointCloud2, "heightmap/points"), (Image, "heightmap/image"), (CompressedImage, "heightmap/image/compressed")]:
            operator.node.create_subscription(kind, topic, functools.partial(views.__setitem__, topic), LATCHED)

        def of_the_newest() -> bool:
            stamp = operator.newest("heightmap").header.stamp
            return len(views) == 3 and all(view.header.stamp == stamp for view in views.values())

        operator.until(of_the_newest, "views of the newest heightmap", 60.0)
        heightmap = operator.newest("heightmap")
        cloud = views["heightmap/points"]
        points = np.frombuffer(cloud.data.tobytes(), dtype=np.dtype("<f4")).reshape(320, 160, 4)
        assert np.array_equal(points[:, :, 2], heights(heightmap))
        assert points[0, 0, 0] == pytest.approx(0.25 + 0.5 * 0.003125)
        assert views["heightmap/image"].data.tobytes() == np.asarray(heightmap.rgb).tobytes()
        compressed = views["heightmap/image/compressed"]
        assert compressed.format == "png"
        assert compressed.data.tobytes().startswith(b"\x89PNG")
