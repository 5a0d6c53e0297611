"""The transform between any two sensors of a calibrated rig."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from calgraph.errors import CalibrationError, InputError
from calgraph.geometry import Array, se3


@dataclass(frozen=True, eq=False)
class TransformTree:
    """Sensor poses in the frame of one root, which answer for any pair."""

    root: str
    """The sensor whose frame the poses are expressed in."""
    poses: Mapping[str, Array]
    """``T_root_sensor`` (4, 4) by sensor, the root with the identity."""
    unconnected: Mapping[str, str] = field(default_factory=dict)
    """Sensors that nothing connects to the root, each with the reason in words."""

    def transform(self, a: str, b: str) -> Array:
        """``T_a_b`` (4, 4), which maps coordinates in sensor b to coordinates in sensor a.

        Raises:
            InputError: there is no sensor a or b.
            CalibrationError: a or b is not connected to the root.
        """
        self.check_connected(a)
        self.check_connected(b)
        return se3.inverse(self.poses[a]) @ self.poses[b]

    def check_connected(self, name: str) -> None:
        """Refuses a sensor without a pose; raises as :meth:`transform` does."""
        if name in self.poses:
            return
        if name in self.unconnected:
            raise CalibrationError(
                f"sensor {name!r} has no pose: nothing connects it to {self.root!r} ({self.unconnected[name]})"
            )
        raise InputError(f"there is no sensor {name!r} in this calibration; it has {', '.join(self.poses)}")
