"""The messages and the view of each sensor of a live session: pictures, unusable messages, sharpness."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from calgraph.config.settings import ViewSettings
from calgraph.live.live_captures import explain_rejection
from calgraph.live.view_pictures import SensorView
from calgraph.sensors import RecordedMessage

# Number of images that this median is of: 20 s.
_SHARPNESS_IMAGES = 60
# Sharpness of an image over its median of late, below which it is blurred: rest and small boards change it by
# less.
_SHARPNESS_RATIO = 0.5


@dataclass
class SensorActivity:
    """The messages of one sensor that wait for other processes, and its last view."""

    settings: ViewSettings
    waiting: deque[RecordedMessage] = field(default_factory=deque)
    """Messages whose change is to be measured."""
    measuring: Sequence[RecordedMessage] = ()
    """Messages whose change is being measured."""
    background: list[RecordedMessage] = field(default_factory=list)
    """Of a scanner, the messages that it learns the room from."""
    latest: RecordedMessage | None = None
    """The last message that has not been drawn."""
    drawing: bool = False
    drawn_at: float = float("-inf")
    """Arrival of the message that was drawn last, s."""
    view: SensorView | None = None
    pictures: int = 0
    malformed: int = 0
    """Number of its messages that could not be used."""
    problem: str = ""
    """Why the last of them could not."""
    sharpness: deque[float] = field(init=False)

    def __post_init__(self) -> None:
        self.sharpness = deque(maxlen=_SHARPNESS_IMAGES)

    @property
    def oldest_unmeasured(self) -> float | None:
        """Arrival of the first message whose change is not known yet, s; None if there is none."""
        return next((record.arrival for record in (*self.measuring, *self.waiting)), None)

    def note_malformed(self, problem: str) -> None:
        """Counts a message that cannot be used."""
        self.malformed += 1
        self.problem = problem

    def set_view(self, view: SensorView) -> None:
        """Takes a new picture."""
        self.view = view
        if view.picture:
            self.pictures += 1
            self.sharpness.append(view.sharpness)

    @property
    def is_blurred(self) -> bool:
        """Whether the last image is blurred, compared with those of late."""
        if not self.sharpness:
            return False
        return self.sharpness[-1] < _SHARPNESS_RATIO * float(np.median(list(self.sharpness)))

    def explain_view(self) -> str:
        """Why the sensor does not detect the board now; empty if it does, or if that is not known."""
        if self.view is None or self.view.sees_board is not False:
            return ""
        return "blurred" if self.is_blurred else explain_rejection(self.view.reason)
