"""One RGB-D camera as a process of its own: python tests/camera_process.py NAME BEGIN_S RATE_HZ SECONDS.

It sends its first set of images at the time BEGIN_S (since the epoch), as other processes may do with theirs, in the ROS domain and
with the Fast DDS profile of the environment.
"""

from __future__ import annotations

import os
import sys
import time

from builtin_interfaces.msg import Time
from cameras import Cameras, good_view, optical_frame
from cell_operator import Operator
from std_msgs.msg import Header


def main(name: str, begin_s: float, rate_hz: float, seconds: float) -> None:
    with Operator(int(os.environ["ROS_DOMAIN_ID"]), f"camera_{name}") as operator:
        cameras = Cameras(operator, (name,))
        cameras.wait_for_fusion()
        cameras.publish_extrinsics((name,))
        operator.spin(max(0.0, begin_s - 1.0 - time.time()))
        if time.time() > begin_s:
            sys.exit(f"camera {name}: ready {time.time() - begin_s:.1f} s too late")
        view = good_view(Header(frame_id=optical_frame(name)))
        for count in range(int(rate_hz * seconds) + 1):
            at_s = begin_s + count / rate_hz
            time.sleep(max(0.0, at_s - time.time()))
            stamp = Time(sec=int(at_s), nanosec=int((at_s % 1) * 1e9))
            for message in (view.color, view.depth, view.info):
                message.header.stamp = stamp
            cameras.publish_view(name, view)
        # What was lost is sent again while the publishers live.
        operator.spin(5.0)


if __name__ == "__main__":
    main(sys.argv[1], *map(float, sys.argv[2:5]))
