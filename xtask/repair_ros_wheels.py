"""Makes the CMake files in the ROS wheels of this virtual environment usable.

They name Python and numpy header folders of the machine that built the wheels. Arguments: none; run with the environment's Python.
"""

import pathlib
import re
import sys
import sysconfig

REPAIRS = (
    (re.compile(r"/opt/python/[^/;\"]+/include/python[0-9.]+"), sysconfig.get_path("include")),
    (re.compile(r"/opt/python/[^/;\"]+/lib/python[0-9.]+/site-packages"), sysconfig.get_path("purelib")),
)

for path in sorted(pathlib.Path(sys.prefix, "share").rglob("*.cmake")):
    text = repaired = path.read_text()
    for pattern, replacement in REPAIRS:
        repaired = pattern.sub(lambda _, replacement=replacement: replacement, repaired)
    if repaired != text:
        path.write_text(repaired)
