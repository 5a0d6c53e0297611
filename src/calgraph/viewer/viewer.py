"""The server of the page in the browser."""

from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from io import StringIO
from typing import TYPE_CHECKING, Self

import numpy as np

from calgraph.errors import InputError
from calgraph.geometry import Array, se3
from calgraph.result import Calibration
from calgraph.sensors import CameraModel
from calgraph.viewer.colored_clouds import place_drive
from calgraph.viewer.panel import Panel
from calgraph.viewer.scene_display import SceneDisplay
from calgraph.viewer.view_state import ViewState, root_in_drive, up_direction

if TYPE_CHECKING:
    from viser import ViserServer


class Viewer:
    """Serves the 3-D view of a calibration; a context manager that stops the server at its end."""

    def __init__(
        self,
        calibration: Calibration,
        cameras: Mapping[str, CameraModel],
        host: str = "127.0.0.1",
        port: int = 8080,
    ) -> None:
        """Starts the server.

        Args:
            calibration: with snapshots, outlines and floor, as :func:`calgraph.result.load_scene` gives it.
            cameras: intrinsics by camera.
            host: address of the server.
            port: the first free port from this one on is used.

        Raises:
            InputError: the extra ``view`` is not installed.
        """
        self._server = _start_server(host, port)
        self.host = host
        self.display = SceneDisplay(self._server.scene, calibration, cameras)
        self.panel = Panel(self._server.gui, calibration, cameras, self.display)
        eye, target = initial_view(calibration)
        self._server.initial_camera.position = eye
        self._server.initial_camera.look_at = target
        self._server.initial_camera.up = up_direction(calibration)

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{self.host}:{self._server.get_port()}"

    def serve(self) -> None:
        """Blocks until interrupted."""
        self._server.sleep_forever()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.panel.close()
        with _suppress_output():
            self._server.stop()


def initial_view(calibration: Calibration) -> tuple[Array, Array]:
    """Position and target (3,) of the initial camera, m: from above, and a rig from behind it, too."""
    origins = np.array([sensor.T_root_sensor[:3, 3] for sensor in calibration.sensors])
    vertical = up_direction(calibration)
    if calibration.pictures.floor_views:
        T_plan_root = calibration.pictures.T_plan_root
        on_plan = se3.apply(T_plan_root, origins)[:, :2]
        middle, extent = _find_extent([on_plan, *(view.background for view in calibration.pictures.floor_views)])
        middle = np.append(middle, 0.0)
        eye = middle + extent * np.array([0.0, -0.45, 0.85])
        position, target = se3.apply(se3.inverse(T_plan_root), np.stack([eye, middle]))
        return position, target
    if calibration.pictures.drive_paths:
        middle, extent = _find_extent([origins, *(x_root for _, x_root in place_drive(calibration, ViewState(0)))])
        ahead = root_in_drive(calibration, 0)[1, :3]
        return middle + extent * (0.85 * vertical - 0.45 * ahead), middle
    middle = origins.mean(axis=0)
    boards = np.array([outline.corners.mean(axis=0) for outline in calibration.pictures.board_outlines]).reshape(
        -1, 3
    )
    reach = float(np.percentile(np.linalg.norm(boards - middle, axis=1), 80)) if len(boards) else 2.0
    ahead = boards.mean(axis=0) - middle if len(boards) else np.array([1.0, 0, 0])
    ahead -= (ahead @ vertical) * vertical
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    return middle + reach * (1.0 * vertical - 1.1 * ahead), middle + 0.3 * reach * ahead


def _find_extent(points: Sequence[Array]) -> tuple[Array, float]:
    """The middle of nearly all points, and their longest side, m."""
    low, high = np.percentile(np.concatenate(points), [1, 99], axis=0)
    return (low + high) / 2, float(np.max(high - low))


def _suppress_output() -> redirect_stdout[StringIO]:
    """Suppresses viser's output, which it prints even if not verbose: commands print their own."""
    return redirect_stdout(StringIO())


def _start_server(host: str, port: int) -> "ViserServer":
    try:
        from viser import ViserServer
    except ImportError as error:
        raise InputError('the viewer needs viser: pip install "calgraph[view]"') from error
    with _suppress_output():
        server = ViserServer(host=host, port=port, label="calgraph", verbose=False)
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()
    server.gui.set_panel_label("calgraph")
    return server
