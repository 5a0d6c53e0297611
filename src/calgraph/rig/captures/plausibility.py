"""Checks of a rig.yaml against its recording that find likely mistakes: intrinsics and background window."""

from collections.abc import Iterator, Mapping

import numpy as np

from calgraph.config import Rig
from calgraph.result.finding import Finding
from calgraph.rig.captures.timeline import RecordingTimeline
from calgraph.sensors import CameraModel

# Maximum relative difference of fx and fy without a remark: pixels are square within 1 %, and those of analog
# cameras within 10 %.
_MAX_FOCAL_DIFFERENCE = 0.1
# Maximum distance of a principal point from the middle of the image, as a share of its size, without a remark:
# lenses are mounted within 5 %; K of half the resolution is off by 25 %.
_MAX_PRINCIPAL_POINT_OFFSET = 0.15


def check_intrinsics(cameras: Mapping[str, CameraModel]) -> Iterator[Finding]:
    """Reports intrinsics in another order than fx, fy, cx, cy, or of another image size."""
    for name, camera in cameras.items():
        fx, fy = camera.focal
        difference = abs(fx / fy - 1)
        if difference > _MAX_FOCAL_DIFFERENCE:
            yield Finding(
                f"fx and fy of {name} differ by {100 * difference:.0f} %, those of usual lenses do not: "
                "check that K is fx, fy, cx, cy"
            )
        size = (camera.width, camera.height)
        offset = np.abs((camera.principal_point + 0.5) / size - 0.5).max()
        if offset > _MAX_PRINCIPAL_POINT_OFFSET:
            yield Finding(
                f"the principal point of {name} is {100 * offset:.0f} % of the image's size away from its middle: "
                f"check that K belongs to images of {size[0]} x {size[1]} pixels"
            )


def check_background(rig: Rig, timeline: RecordingTimeline) -> Iterator[Finding]:
    """Reports a background window that contains triggers, at which the board was in view."""
    window = rig.capture.background
    if window is None:
        return
    times = timeline.triggers - timeline.start
    covered = int(np.sum((times >= window[0]) & (times <= window[1])))
    if covered:
        yield Finding(
            f"capture.background [{window[0]:g}, {window[1]:g}] contains {covered} of {len(times)} messages of "
            f"{rig.capture.trigger}, whose captures are not used: it must end before the board is in view"
        )
