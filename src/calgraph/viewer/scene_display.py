"""The scene in the browser: what stands in it, and how it changes with the choice."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from calgraph.geometry import Array, plane, so3
from calgraph.result import Calibration, SensorPose
from calgraph.sensors import CameraModel
from calgraph.viewer.colored_clouds import Cloud, clouds, color_of, heights_of
from calgraph.viewer.frustums import beams, ellipsoid, through_window, window
from calgraph.viewer.trails import trails
from calgraph.viewer.view_state import Choice, poses, up

if TYPE_CHECKING:
    from viser import SceneApi, SceneNodeHandle

LAYERS = ("names", "axes", "camera views", "beams", "clouds", "boards", "walks")
EXAGGERATIONS = (0, 1, 10, 100, 1000)
# How far the ground reaches, m.
_FAR = 25.0
_BOARD, _NOW = (120, 124, 132), (255, 190, 60)


class Stage:
    """Puts a calibration into a scene; each sensor's things hang from its frame."""

    def __init__(self, scene: "SceneApi", calibration: Calibration, cameras: Mapping[str, CameraModel]) -> None:
        self._scene, self._calibration, self._cameras = scene, calibration, cameras
        self._heights = heights_of(calibration)
        self.size = size_of_axes(calibration)
        self._point_size = 0.035 if calibration.pictures.floor_views else 0.012
        self._number = {sensor.name: k for k, sensor in enumerate(calibration.sensors)}
        self._drawn: dict[str, Cloud] = {}
        self._moment: tuple[float | None, ...] = ()
        self._hidden: set[str] = set()
        self._nodes: dict[str, dict[str, SceneNodeHandle]] = {layer: {} for layer in (*LAYERS, "uncertainty")}
        scene.set_up_direction(up(calibration))
        # Shadows and reflections tell nothing of a calibration, and cost most of the time without a graphics card.
        scene.configure_default_lights(cast_shadow=False)
        scene.configure_environment_map(hdri=None)
        self._lay_ground()
        self._frames = {sensor.name: self._place(sensor) for sensor in calibration.sensors}

    def show(self, choice: Choice) -> None:
        """Brings the scene to what is chosen."""
        for name, T in poses(self._calibration, choice).items():
            self._frames[name].position = T[:3, 3]
            self._frames[name].wxyz = _wxyz(T[:3, :3])
        self._show_clouds(clouds(self._calibration, self._cameras, choice, self._heights), choice.moment)
        if self._moment != (choice.moment,):
            self._show_pictures(choice.moment)
            self._show_boards(choice.moment)
            self._show_walks(choice)
            self._moment = (choice.moment,)

    def show_sensor(self, name: str, visible: bool) -> None:
        """Shows or hides all that is of one sensor."""
        self._frames[name].visible = visible

    def show_layer(self, layer: str, visible: bool) -> None:
        """Shows or hides things of one kind."""
        (self._hidden.discard if visible else self._hidden.add)(layer)
        for node in self._nodes[layer].values():
            node.visible = visible

    def show_uncertainty(self, exaggeration: float) -> None:
        """Draws the 95 % ellipsoids of positions so many times as large as they are; 0 for none."""
        for node in self._nodes["uncertainty"].values():
            node.remove()
        self._nodes["uncertainty"] = {
            sensor.name: self._ellipsoid(sensor, exaggeration)
            for sensor in self._calibration.sensors
            if exaggeration and sensor.covariance[:3, :3].any()
        }

    def show_points(self, size: float) -> None:
        """Draws points of another size, m."""
        self._point_size = size
        for name, cloud in self._drawn.items():
            self._draw_cloud(name, cloud)

    def _place(self, sensor: SensorPose) -> "SceneNodeHandle":
        """A sensor's frame, with its axes, name and view."""
        at = self._at(sensor.name)
        frame = self._scene.add_frame(at, show_axes=False)
        self._nodes["axes"][sensor.name] = self._scene.add_frame(
            f"{at}/axes", axes_length=1.3 * self.size, axes_radius=self.size / 22, origin_radius=self.size / 9,
            origin_color=color_of(self._calibration, sensor.name),
        )  # fmt: skip
        self._nodes["names"][sensor.name] = self._scene.add_label(
            f"{at}/name",
            sensor.name,
            position=sensor.T_root_sensor[:3, :3].T @ (0.35 * self.size * up(self._calibration)),
            anchor="bottom-center",
        )
        if sensor.kind == "camera" and sensor.name in self._cameras:
            self._draw_view(sensor.name, None)
        return frame

    def _at(self, name: str) -> str:
        return f"/sensors/{self._number[name]}"

    def _lay_ground(self) -> None:
        """A grid of metres at the height of the floor: of lines, as viser's is slow without a graphics card."""
        vertical = up(self._calibration)
        level = 0.0 if self._calibration.pictures.floor_views else self._heights[0]
        self._scene.add_line_segments(
            "/ground", ground(vertical) + level * vertical, (52, 55, 62), thickness=1.0, thickness_units="screen"
        )

    def _show_clouds(self, found: Mapping[str, Cloud], moment: float | None) -> None:
        for name in self._drawn.keys() - found.keys():
            for layer in ("clouds", "beams"):
                if name in self._nodes[layer]:
                    self._nodes[layer].pop(name).remove()
        for name, cloud in found.items():
            before = self._drawn.get(name)
            same = before is not None and np.array_equal(before.points, cloud.points)
            if before is None or not same or not np.array_equal(before.colors, cloud.colors):
                self._draw_cloud(name, cloud)
            if not same:
                self._draw_beams(name, None if moment is None else cloud)
        self._drawn = dict(found)

    def _draw_cloud(self, name: str, cloud: Cloud) -> None:
        # Scans are thin lines, and would be lost among a cloud's many points.
        wide = (
            1.6
            if self._calibration[name].kind == "lidar2d" and not self._calibration.pictures.floor_views
            else 1.0
        )
        self._nodes["clouds"][name] = self._scene.add_point_cloud(
            f"{self._at(name)}/cloud", cloud.points, cloud.colors, point_size=wide * self._point_size,
            point_shape="circle", precision="float32", point_shading="flat", visible="clouds" not in self._hidden,
        )  # fmt: skip

    def _draw_beams(self, name: str, cloud: Cloud | None) -> None:
        """Lines to what a 2-D scanner measured; of all captures at once there would be too many."""
        if name in self._nodes["beams"]:
            self._nodes["beams"].pop(name).remove()
        if (
            cloud is not None
            and self._calibration[name].kind == "lidar2d"
            and not self._calibration.pictures.floor_views
        ):
            red, green, blue = color_of(self._calibration, name)
            self._nodes["beams"][name] = self._scene.add_line_segments(
                f"{self._at(name)}/beams", beams(cloud.points), (red // 3, green // 3, blue // 3), thickness=1.0,
                thickness_units="screen", visible="beams" not in self._hidden,
            )  # fmt: skip

    def _show_pictures(self, moment: float | None) -> None:
        pictures = {s.sensor: s for s in self._calibration.pictures.snapshots if s.image and s.capture == moment}
        for name in self._nodes["camera views"]:
            picture = pictures.get(name)
            self._draw_view(name, through_window(picture.picture, self._cameras[name]) if picture else None)

    def _draw_view(self, name: str, image: "np.ndarray | None") -> None:
        angle, aspect = window(self._cameras[name])
        self._nodes["camera views"][name] = self._scene.add_camera_frustum(
            f"{self._at(name)}/view", angle, aspect, scale=3 * self.size, thickness=2.0, thickness_units="screen",
            image=image, format="jpeg",
            color=color_of(self._calibration, name), visible="camera views" not in self._hidden,
        )  # fmt: skip

    def _show_boards(self, moment: float | None) -> None:
        """Sheets with a rim: faint if they are those of all captures."""
        corners = np.array(
            [o.corners for o in self._calibration.pictures.board_outlines if moment in (None, o.capture)]
        )
        corners = corners.reshape(-1, 4, 3)
        visible, color = "boards" not in self._hidden, _BOARD if moment is None else _NOW
        rims = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 3)
        self._nodes["boards"]["rims"] = self._scene.add_line_segments(
            "/boards/rims", rims, color, thickness=1.0 if moment is None else 3.0, thickness_units="screen",
            visible=visible,
        )  # fmt: skip
        triangles = 4 * np.arange(len(corners))[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
        self._nodes["boards"]["sheets"] = self._scene.add_mesh_simple(
            "/boards/sheets", corners.reshape(-1, 3), triangles.reshape(-1, 3), color=color, side="double",
            opacity=0.04 if moment is None else 0.25, cast_shadow=False, receive_shadow=False, visible=visible,
        )  # fmt: skip

    def _show_walks(self, choice: Choice) -> None:
        for name, trail in trails(self._calibration, choice).items():
            color = color_of(self._calibration, name)
            visible = "walks" not in self._hidden
            self._nodes["walks"][f"{name} trail"] = self._scene.add_line_segments(
                f"{self._at(name)}/trail", trail.segments, color, thickness=1.5 if choice.moment is None else 3,
                thickness_units="screen", visible=visible,
            )  # fmt: skip
            self._nodes["walks"][f"{name} people"] = self._scene.add_point_cloud(
                f"{self._at(name)}/people", trail.people, color, point_size=0.25, point_shape="circle",
                precision="float32", visible=visible,
            )  # fmt: skip

    def _ellipsoid(self, sensor: SensorPose, exaggeration: float) -> "SceneNodeHandle":
        half, R = ellipsoid(sensor.T_root_sensor, sensor.covariance, 3 * self.size / exaggeration)
        # A network's ellipsoids are flat, and would not be seen from the side.
        half = np.maximum(exaggeration * half, 0.02 * self.size)
        return self._scene.add_icosphere(
            f"{self._at(sensor.name)}/uncertainty", radius=1.0, scale=(half[0], half[1], half[2]), wxyz=_wxyz(R),
            color=(255, 150, 215), opacity=0.55, material="toon5", cast_shadow=False, receive_shadow=False,
        )  # fmt: skip


def ground(vertical: Array) -> Array:
    """(K, 2, 3) lines, a metre apart, across the plane through the origin that a unit vector (3,) is normal to."""
    at = np.arange(-_FAR, _FAR + 1.0)
    along = np.stack([np.stack([at, 0 * at + end], axis=-1) for end in (-_FAR, _FAR)], axis=1)
    flat = np.concatenate([along, along[..., ::-1]])
    return np.asarray(flat @ plane.tangent_basis(vertical).T)


def size_of_axes(calibration: Calibration) -> float:
    """Length of a frame's axes, m: clear of its neighbours, yet to be seen."""
    origins = np.array([sensor.T_root_sensor[:3, 3] for sensor in calibration.sensors])
    distances = np.linalg.norm(origins[:, None] - origins, axis=-1)
    np.fill_diagonal(distances, np.inf)
    nearest = distances.min(axis=1)
    return float(np.clip(0.4 * np.median(nearest), 0.05, 1.0)) if np.isfinite(nearest).all() else 0.25


def _wxyz(R: Array) -> Array:
    return np.roll(so3.quaternion(R), 1)
