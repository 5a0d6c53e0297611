"""The rig of a live session: captures are triggered, and scanners learn the room first."""

from calgraph.config import Capture, Rig
from calgraph.errors import InputError
from calgraph.live.source import LiveMessage, make_message
from calgraph.recording import list_camera_info_topics
from calgraph.sensors import Trigger
from calgraph.sensors.kinds import KINDS

TRIGGER_TOPIC = "/calgraph/trigger"
"""Topic of the messages that mark the captures of a live session."""


def prepare_live_rig(rig: Rig) -> Rig:
    """The rig that is calibrated at the end: one with a board has the session's trigger, and a background window.

    Raises:
        InputError: a sensor's images are to be converted, as those of a depth camera.
    """
    for name, spec in rig.sensors.items():
        if KINDS[spec.kind].convert:
            raise InputError(
                f"sensors.{name}: calgraph live does not take the images of a {KINDS[spec.kind].title}; record a "
                "bag, and give it to calgraph calibrate"
            )
    if rig.is_network or rig.is_drive:
        return rig
    background = rig.capture.background or (0.0, rig.settings.live.capture.background)
    capture = Capture(background=background, trigger=TRIGGER_TOPIC, exclude=rig.capture.exclude)
    return rig.model_copy(update={"capture": capture})


def list_intrinsics_topics(rig: Rig) -> dict[str, tuple[str, ...]]:
    """By camera whose intrinsics rig.yaml does not state, the topics that may have them, the preferred first."""
    return {name: list_camera_info_topics(spec) for name, spec in rig.cameras().items() if spec.intrinsics is None}


def make_trigger(stamp: float, arrival: float) -> LiveMessage:
    """The message that marks a capture.

    Args:
        stamp: start of the capture by the sensors' clock, s.
        arrival: of the message, s.
    """
    return make_message(TRIGGER_TOPIC, Trigger(stamp), round(arrival * 1e9))
