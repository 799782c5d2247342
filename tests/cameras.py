"""A driver of three RGB-D cameras, written with rclpy: a flat table with one box, seen from straight above."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from builtin_interfaces.msg import Time
from cell_operator import LATCHED, Operator
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

NAMES = ("front", "left", "right")
# Colour, depth, and their calibrations, below the camera's name.
TOPICS = ("color/image_raw", "depth/image_rect_raw", "color/camera_info", "depth/camera_info")
WIDTH, HEIGHT, FOCAL_PX = 640, 480, 450.0

CAMERA_HEIGHT_M = 1.0
BOX_HEIGHT_M = 0.05
# Where depth is not registered.
DEPTH_CAMERA_UP_M = 0.02
BOX_COLOR = (200, 30, 30)
# Rows and columns of the image that show the box: the middle, which is the point (0.5, 0) of the world.
BOX = np.s_[220:260, 300:340]

# Coefficients as of real cameras, in the order of CameraInfo.d.
LENSES = {
    "plumb_bob": (0.3, -0.1, 0.004, -0.003, 0.02),
    # As the colour camera of an Azure Kinect or a Femto Bolt.
    "rational_polynomial": (0.5179, -2.5816, 0.0007, -0.0002, 1.4943, 0.3954, -2.4092, 1.4233),
    "equidistant": (-0.0079, 0.0447, -0.0418, 0.0076),
}

IMAGES = QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.VOLATILE)


@dataclass
class View:
    """What one camera says at one time."""

    color: Image
    depth: Image
    info: CameraInfo
    # Where the depth image has a frame of its own.
    depth_info: CameraInfo | None = None


Change = Callable[[View], None]


class Cameras:
    """Publishes views of all three cameras, each time with a later stamp."""

    def __init__(self, operator: Operator, names: tuple[str, ...] = NAMES, topics: tuple[str, str, str, str] = TOPICS) -> None:
        self._operator = operator
        self._seconds = 100
        node = operator.node
        self._publishers = {
            name: (
                node.create_publisher(Image, f"{name}/{topics[0]}", IMAGES),
                node.create_publisher(Image, f"{name}/{topics[1]}", IMAGES),
                node.create_publisher(CameraInfo, f"{name}/{topics[2]}", IMAGES),
                node.create_publisher(CameraInfo, f"{name}/{topics[3]}", IMAGES),
            )
            for name in names
        }
        self._transforms = node.create_publisher(TFMessage, "/tf_static", LATCHED)

    def wait_for_fusion(self) -> None:
        """Waits until somebody listens to every topic."""
        publishers = [publisher for group in self._publishers.values() for publisher in group]
        self._operator.until(
            lambda: all(publisher.get_subscription_count() for publisher in [*publishers, self._transforms]),
            "node that listens to the cameras",
            60.0,
        )

    def publish_extrinsics(self, names: tuple[str, ...] = NAMES) -> None:
        """Says where the cameras stand: over the middle of the workspace, looking down."""
        # Half a turn about x + y: the image's right is the world's +y, its down the world's +x.
        downwards = Quaternion(x=np.sqrt(0.5), y=np.sqrt(0.5), z=0.0, w=0.0)
        self._transforms.publish(
            TFMessage(
                transforms=[
                    TransformStamped(
                        header=Header(frame_id="world"),
                        child_frame_id=optical_frame(name),
                        transform=Transform(translation=Vector3(x=0.5, y=0.0, z=CAMERA_HEIGHT_M), rotation=downwards),
                    )
                    for name in names
                ]
            )
        )

    def publish_depth_frames(self, names: tuple[str, ...] = NAMES) -> None:
        """Says where the depth cameras of `unregistered` views stand: further up than those of colour."""
        transforms = [
            TransformStamped(
                header=Header(frame_id=optical_frame(name)),
                child_frame_id=f"{name}_depth_optical_frame",
                transform=Transform(
                    translation=Vector3(x=0.0, y=0.0, z=-DEPTH_CAMERA_UP_M), rotation=Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)
                ),
            )
            for name in names
        ]
        self._transforms.publish(TFMessage(transforms=transforms))

    def publish_view(self, name: str, view: View) -> None:
        """Publishes a view of one camera as it is."""
        color, depth, info, depth_info = self._publishers[name]
        info.publish(view.info)
        if view.depth_info is not None:
            depth_info.publish(view.depth_info)
        color.publish(view.color)
        depth.publish(view.depth)

    def publish(self, change: Change = lambda _: None, changed: str | None = "left", leave_out: str | None = None) -> Time:
        """Publishes one view of each camera and returns their stamp. `change` alters the view of the camera `changed`, or of all."""
        self._seconds += 1
        stamp = Time(sec=self._seconds)
        for name in self._publishers:
            if name == leave_out:
                continue
            view = good_view(Header(stamp=stamp, frame_id=optical_frame(name)))
            if changed in (name, None):
                change(view)
            self.publish_view(name, view)
        return stamp


def optical_frame(name: str) -> str:
    """The frame of a camera's images."""
    return f"{name}_color_optical_frame"


def good_view(header: Header) -> View:
    """The table with the box."""
    color = np.full((HEIGHT, WIDTH, 3), 120, dtype=np.uint8)
    color[BOX] = BOX_COLOR
    depth = np.full((HEIGHT, WIDTH), CAMERA_HEIGHT_M, dtype=np.float32)
    depth[BOX] = CAMERA_HEIGHT_M - BOX_HEIGHT_M
    centre_x, centre_y = (WIDTH - 1) / 2, (HEIGHT - 1) / 2
    return View(
        color=image(header, "rgb8", 3 * WIDTH, color),
        depth=image(header, "32FC1", 4 * WIDTH, depth),
        info=CameraInfo(
            header=header,
            width=WIDTH,
            height=HEIGHT,
            distortion_model="plumb_bob",
            d=[0.0] * 5,
            k=[FOCAL_PX, 0.0, centre_x, 0.0, FOCAL_PX, centre_y, 0.0, 0.0, 1.0],
            r=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            p=[FOCAL_PX, 0.0, centre_x, 0.0, 0.0, FOCAL_PX, centre_y, 0.0, 0.0, 0.0, 1.0, 0.0],
        ),
    )


def image(header: Header, encoding: str, step: int, pixels: np.ndarray) -> Image:
    """An image message of little-endian pixels."""
    message = Image(header=header, width=WIDTH, height=HEIGHT, encoding=encoding, step=step, is_bigendian=0)
    message.data.frombytes(pixels.tobytes())
    return message


def unregistered(view: View) -> None:
    """Depth as of a camera beside that of colour, with a frame and a calibration of its own."""
    name = view.color.header.frame_id.removesuffix("_color_optical_frame")
    set_depth(view, depth_pixels(view) + np.float32(DEPTH_CAMERA_UP_M))
    view.depth.header = Header(stamp=view.color.header.stamp, frame_id=f"{name}_depth_optical_frame")
    view.depth_info = copy.deepcopy(view.info)
    view.depth_info.header = view.depth.header


def depth_pixels(view: View) -> np.ndarray:
    """A copy of the depth image [m]."""
    return np.frombuffer(view.depth.data.tobytes(), dtype=np.float32).reshape(HEIGHT, WIDTH).copy()


def set_depth(view: View, pixels: np.ndarray) -> None:
    """Replaces the depth image, in its own encoding."""
    view.depth = image(view.depth.header, view.depth.encoding, pixels.itemsize * WIDTH, pixels)


def through_lens(model: str, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where a lens shows ideal points, as OpenCV documents it."""
    square = x * x + y * y
    if model == "equidistant":
        k1, k2, k3, k4 = LENSES[model]
        radius = np.sqrt(square)
        angle = np.arctan(radius)
        shown = angle * (1 + k1 * angle**2 + k2 * angle**4 + k3 * angle**6 + k4 * angle**8)
        return x * shown / radius, y * shown / radius
    k1, k2, p1, p2, k3, k4, k5, k6 = (*LENSES[model], 0.0, 0.0, 0.0)[:8]
    radial = (1 + k1 * square + k2 * square**2 + k3 * square**3) / (1 + k4 * square + k5 * square**2 + k6 * square**3)
    return (
        x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
        y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
    )
