"""The detectors of a live session: made when intrinsics have arrived, and scanners have learned the room."""

from collections.abc import Mapping

import numpy as np

from calgraph.config import Rig
from calgraph.errors import Rejected
from calgraph.live.analysis_jobs import encode_detector, reduce_camera
from calgraph.live.live_rig import list_intrinsics_topics
from calgraph.live.view_pictures import find_reduction
from calgraph.rig.captures.detectors import Background, draw_seeds
from calgraph.rig.options import RigOptions
from calgraph.sensors import CameraInfo, CameraModel, RecordedMessage


class LiveDetectors:
    """Intrinsics and backgrounds that have been found so far, and the detectors made from them.

    Args:
        rig: of the session.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        # As calibrate_rig draws them first of all.
        self.seeds = draw_seeds(rig, np.random.default_rng(RigOptions().seed))
        """Of the detectors' samples, by sensor."""
        self.cameras: dict[str, CameraModel] = rig.camera_models()
        """Intrinsics by camera, as far as they are known."""
        self._backgrounds: dict[str, Background | Rejected] = {}
        self._preferred: dict[str, str] = {}
        self._topics = list_intrinsics_topics(rig)
        self._encoded: dict[tuple[str, int], bytes] = {}

    @property
    def intrinsics_topics(self) -> frozenset[str]:
        """Topics that may have intrinsics."""
        return frozenset(topic for topics in self._topics.values() for topic in topics)

    def add_intrinsics(self, record: RecordedMessage) -> None:
        """Takes the intrinsics of a message, for the cameras that its topic is of; the first message counts.

        Raises:
            RecordingError: its content is unusable.
        """
        wanted = [name for name in self.cameras_of(record.topic) if self._is_better(name, record.topic)]
        if not wanted:
            return
        self._preferred |= dict.fromkeys(wanted, record.topic)
        message = record.decode()
        if isinstance(message, CameraInfo):
            for name in wanted:
                self.cameras[name] = message.camera
                self._forget(name)

    def cameras_of(self, topic: str) -> list[str]:
        """The cameras whose intrinsics a topic may have."""
        return [name for name, topics in self._topics.items() if topic in topics]

    def _is_better(self, name: str, topic: str) -> bool:
        topics = self._topics[name]
        known = self._preferred.get(name)
        return known is None or topics.index(topic) < topics.index(known)

    def set_background(self, name: str, background: Background | Rejected) -> None:
        """Takes what a scanner has learned, or why it has not."""
        self._backgrounds[name] = background
        self._forget(name)

    def _forget(self, name: str) -> None:
        self._encoded = {key: one for key, one in self._encoded.items() if key[0] != name}

    def is_ready(self, name: str) -> bool:
        """Whether messages of a sensor can be searched: scanners learn the room first."""
        return self._rig.sensors[name].kind == "camera" or name in self._backgrounds

    def reduction(self, name: str) -> int:
        """The factor by which images of a camera are reduced for pictures; 1 of scanners."""
        camera = self.cameras.get(name)
        return find_reduction(camera) if camera else 1

    def reduced_camera(self, name: str) -> CameraModel | None:
        """The intrinsics of a camera's reduced images; None of scanners, and where they are not known."""
        camera = self.cameras.get(name)
        return reduce_camera(camera, self.reduction(name)) if camera else None

    def encode(self, name: str, *, reduced: bool = False) -> bytes:
        """The detector of a sensor that is ready, for other processes.

        Args:
            name: of the sensor.
            reduced: whether it is for reduced images.
        """
        factor = self.reduction(name) if reduced else 1
        if (name, factor) not in self._encoded:
            camera = self.reduced_camera(name) if reduced else self.cameras.get(name)
            background = self._backgrounds.get(name)
            self._encoded[name, factor] = encode_detector(
                self._rig, name, camera, None if isinstance(background, Rejected) else background, self.seeds
            )
        return self._encoded[name, factor]

    def restore(self, cameras: Mapping[str, CameraModel]) -> None:
        """Takes intrinsics that are in a recording, by camera."""
        self.cameras |= cameras
        self._preferred |= {name: self._topics[name][0] for name in cameras if name in self._topics}
        self._encoded = {}
