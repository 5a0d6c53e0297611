"""The scene in the browser: its objects, and their update to a view state."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, plane, se3, so3
from calgraph.result import Calibration, SensorPose
from calgraph.result.sensor_pose import choose_axis_length, error_ellipsoid
from calgraph.sensors import CameraModel
from calgraph.sensors.kinds import KINDS
from calgraph.viewer.colored_clouds import Cloud, color_clouds, height_range, sensor_color
from calgraph.viewer.trails import compute_trails
from calgraph.viewer.view_state import ViewState, displaced_poses, root_in_drive, up_direction

if TYPE_CHECKING:
    from viser import SceneApi, SceneNodeHandle


LAYERS = ("names", "axes", "camera views", "beams", "clouds", "boards", "walks", "trajectory")
EXAGGERATIONS = (0, 1, 10, 100, 1000)
# Half the extent of the ground grid, m.
_GROUND_EXTENT = 25.0
_BOARD_COLOR, _CURRENT_BOARD_COLOR = (120, 124, 132), (255, 190, 60)


class SceneDisplay:
    """Displays a calibration in a scene; each sensor's objects are children of its frame."""

    def __init__(self, scene: "SceneApi", calibration: Calibration, cameras: Mapping[str, CameraModel]) -> None:
        self._scene, self._calibration, self._cameras = scene, calibration, cameras
        self.with_points = {False: calibration, True: calibration.with_corrected_points()}
        """The calibration with points as published, and with corrected ones."""
        self._heights = height_range(calibration)
        self.axis_length = choose_axis_length(calibration.sensors, longest=1.0)
        pictures = calibration.pictures
        self._point_size = 0.035 if pictures.floor_views or pictures.drive_paths else 0.012
        self._number = {sensor.name: k for k, sensor in enumerate(calibration.sensors)}
        self._drawn: dict[str, Cloud] = {}
        self._moment: tuple[float | None, ...] = ()
        self._hidden: set[str] = set()
        self._nodes: dict[str, dict[str, SceneNodeHandle]] = {layer: {} for layer in (*LAYERS, "uncertainty")}
        scene.set_up_direction(up_direction(calibration))
        # Shadows and reflections carry no information, and take most of the time without a graphics card.
        scene.configure_default_lights(cast_shadow=False)
        scene.configure_environment_map(hdri=None)
        self._draw_ground()
        self._frames = {sensor.name: self._add_sensor(sensor) for sensor in calibration.sensors}

    def show(self, state: ViewState) -> None:
        """Updates the scene to a view state."""
        for name, T in displaced_poses(self._calibration, state).items():
            self._frames[name].position = T[:3, 3]
            self._frames[name].wxyz = _wxyz(T[:3, :3])
        shown = self.with_points[state.corrected]
        self._show_clouds(color_clouds(shown, self._cameras, state, self._heights), state.moment)
        if self._moment != (state.moment,):
            self._show_pictures(state.moment)
            self._show_boards(state.moment)
            self._show_walks(state)
            self._show_paths(state.moment)
            self._moment = (state.moment,)

    def show_sensor(self, name: str, visible: bool) -> None:
        """Shows or hides all objects of one sensor."""
        self._frames[name].visible = visible

    def show_layer(self, layer: str, visible: bool) -> None:
        """Shows or hides all objects of one layer."""
        (self._hidden.discard if visible else self._hidden.add)(layer)
        for node in self._nodes[layer].values():
            node.visible = visible

    def show_uncertainty(self, exaggeration: float) -> None:
        """Draws the 95 % ellipsoids of positions, enlarged by a factor; 0 for none."""
        for node in self._nodes["uncertainty"].values():
            node.remove()
        self._nodes["uncertainty"] = {
            sensor.name: self._ellipsoid(sensor, exaggeration)
            for sensor in self._calibration.sensors
            if exaggeration and sensor.measured_covariance[:3, :3].any()
        }

    def show_points(self, size: float) -> None:
        """Sets the size of points, m."""
        self._point_size = size
        for name, cloud in self._drawn.items():
            self._draw_cloud(name, cloud)

    def _add_sensor(self, sensor: SensorPose) -> "SceneNodeHandle":
        """Adds a sensor's frame, with its axes, name and view."""
        at = self._node_path(sensor.name)
        frame = self._scene.add_frame(at, show_axes=False)
        self._nodes["axes"][sensor.name] = self._scene.add_frame(
            f"{at}/axes", axes_length=1.3 * self.axis_length, axes_radius=self.axis_length / 22,
            origin_radius=self.axis_length / 9,
            origin_color=sensor_color(self._calibration, sensor.name),
        )  # fmt: skip
        self._nodes["names"][sensor.name] = self._scene.add_label(
            f"{at}/name",
            sensor.name,
            position=sensor.T_root_sensor[:3, :3].T @ (0.35 * self.axis_length * up_direction(self._calibration)),
            anchor="bottom-center",
        )
        if KINDS[sensor.kind].shape == "frustum" and sensor.name in self._cameras:
            self._draw_view(sensor.name, None)
        return frame

    def _node_path(self, name: str) -> str:
        return f"/sensors/{self._number[name]}"

    def _draw_ground(self) -> None:
        """Draws a 1 m grid at the height of the floor, of lines: viser's grid is slow without a graphics card."""
        vertical = up_direction(self._calibration)
        pictures = self._calibration.pictures
        level = -pictures.T_plan_root[2, 3] if pictures.floor_views else self._heights[0]
        self._add_lines("/ground", ground_grid(vertical) + level * vertical, (52, 55, 62), 1.0)

    def _add_lines(
        self, at: str, lines: NDArray[Any], color: tuple[int, int, int], width: float, layer: str = ""
    ) -> "SceneNodeHandle":
        """Adds lines (K, 2, 3) of a width in pixels, which are visible if their layer is."""
        return self._scene.add_line_segments(
            at, lines, color, thickness=width, thickness_units="screen", visible=layer not in self._hidden
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
        # Scans are thin lines, and would not be visible among a cloud's many points.
        wide = (
            1.6
            if KINDS[self._calibration[name].kind].shape == "disc" and not self._calibration.pictures.floor_views
            else 1.0
        )
        self._nodes["clouds"][name] = self._scene.add_point_cloud(
            f"{self._node_path(name)}/cloud", cloud.points, cloud.colors, point_size=wide * self._point_size,
            point_shape="circle", precision="float32", point_shading="flat", visible="clouds" not in self._hidden,
        )  # fmt: skip

    def _draw_beams(self, name: str, cloud: Cloud | None) -> None:
        """Draws lines to the points of a 2-D scanner; of all captures there would be too many."""
        if name in self._nodes["beams"]:
            self._nodes["beams"].pop(name).remove()
        if (
            cloud is not None
            and KINDS[self._calibration[name].kind].shape == "disc"
            and not self._calibration.pictures.floor_views
            and not self._calibration.pictures.drive_paths
        ):
            red, green, blue = sensor_color(self._calibration, name)
            color = red // 3, green // 3, blue // 3
            self._nodes["beams"][name] = self._add_lines(
                f"{self._node_path(name)}/beams", sample_beams(cloud.points), color, 1.0, "beams"
            )

    def _show_pictures(self, moment: float | None) -> None:
        snapshots = {s.sensor: s for s in self._calibration.pictures.snapshots if s.image and s.capture == moment}
        for name in self._nodes["camera views"]:
            snapshot = snapshots.get(name)
            self._draw_view(name, rectify_image(snapshot.picture, self._cameras[name]) if snapshot else None)

    def _draw_view(self, name: str, image: "np.ndarray | None") -> None:
        angle, aspect = frustum_shape(self._cameras[name])
        self._nodes["camera views"][name] = self._scene.add_camera_frustum(
            f"{self._node_path(name)}/view", angle, aspect, scale=3 * self.axis_length, thickness=2.0,
            thickness_units="screen",
            image=image, format="jpeg",
            color=sensor_color(self._calibration, name), visible="camera views" not in self._hidden,
        )  # fmt: skip

    def _show_boards(self, moment: float | None) -> None:
        """Draws boards with a rim; translucent if those of all captures are shown."""
        corners = np.array(
            [o.corners for o in self._calibration.pictures.board_outlines if moment in (None, o.capture)]
        )
        corners = corners.reshape(-1, 4, 3)
        color = _BOARD_COLOR if moment is None else _CURRENT_BOARD_COLOR
        rims = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 3)
        self._nodes["boards"]["rims"] = self._add_lines(
            "/boards/rims", rims, color, 1.0 if moment is None else 3.0, "boards"
        )
        triangles = 4 * np.arange(len(corners))[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
        self._nodes["boards"]["faces"] = self._scene.add_mesh_simple(
            "/boards/faces", corners.reshape(-1, 3), triangles.reshape(-1, 3), color=color, side="double",
            opacity=0.04 if moment is None else 0.25, cast_shadow=False, receive_shadow=False,
            visible="boards" not in self._hidden,
        )  # fmt: skip

    def _show_walks(self, state: ViewState) -> None:
        for name, trail in compute_trails(self._calibration, state).items():
            color = sensor_color(self._calibration, name)
            self._nodes["walks"][f"{name} trail"] = self._add_lines(
                f"{self._node_path(name)}/trail",
                trail.segments,
                color,
                1.5 if state.moment is None else 3,
                "walks",
            )
            self._nodes["walks"][f"{name} people"] = self._scene.add_point_cloud(
                f"{self._node_path(name)}/people", trail.people, color, point_size=0.25, point_shape="circle",
                precision="float32", visible="walks" not in self._hidden,
            )  # fmt: skip

    def _show_paths(self, moment: float | None) -> None:
        """Draws the trajectory of a drive, relative to the root in the middle of its part."""
        for part, path in enumerate(self._calibration.pictures.drive_paths):
            T = se3.inverse(root_in_drive(self._calibration, part)) @ path.T_world_root
            self._nodes["trajectory"][f"{part}"] = self._scene.add_line_segments(
                f"/trajectory/{part}", np.stack([T[:-1, :3, 3], T[1:, :3, 3]], axis=1), _CURRENT_BOARD_COLOR,
                thickness=2.0, thickness_units="screen",
                visible="trajectory" not in self._hidden and moment in (None, part),
            )  # fmt: skip

    def _ellipsoid(self, sensor: SensorPose, exaggeration: float) -> "SceneNodeHandle":
        half, R = uncertainty_ellipsoid(
            sensor.T_root_sensor, sensor.measured_covariance, 3 * self.axis_length / exaggeration
        )
        # A network's ellipsoids are flat, and would not be visible from the side.
        half = np.maximum(exaggeration * half, 0.02 * self.axis_length)
        return self._scene.add_icosphere(
            f"{self._node_path(sensor.name)}/uncertainty", radius=1.0, scale=(half[0], half[1], half[2]),
            wxyz=_wxyz(R),
            color=(255, 150, 215), opacity=0.55, material="toon5", cast_shadow=False, receive_shadow=False,
        )  # fmt: skip


def ground_grid(vertical: Array) -> Array:
    """(K, 2, 3) lines with 1 m spacing in the plane through the origin with a unit normal (3,)."""
    at = np.arange(-_GROUND_EXTENT, _GROUND_EXTENT + 1.0)
    along = np.stack([np.stack([at, 0 * at + end], axis=-1) for end in (-_GROUND_EXTENT, _GROUND_EXTENT)], axis=1)
    flat = np.concatenate([along, along[..., ::-1]])
    return np.asarray(flat @ plane.tangent_basis(vertical).T)


def _wxyz(R: Array) -> Array:
    return np.roll(so3.quaternion(R), 1)


# A fisheye's image plane reaches to infinity; frustums are clipped at this angle to each side, rad.
_MAX_HALF_ANGLE = np.radians(65)
_MAX_BEAMS = 45


def frustum_shape(camera: CameraModel) -> tuple[float, float]:
    """The viewing frustum of a camera: its vertical angle, rad, and its aspect ratio, width over height."""
    half = np.minimum(np.array([camera.width, camera.height]) / 2 / camera.focal, np.tan(_MAX_HALF_ANGLE))
    return float(2 * np.arctan(half[1])), float(half[0] / half[1])


def rectify_image(picture: NDArray[np.uint8], camera: CameraModel, width: int = 400) -> NDArray[np.uint8]:
    """Rectifies an image (h, w, 3) to the :func:`frustum_shape`: undistorted and centred."""
    angle, aspect = frustum_shape(camera)
    half = np.tan(angle / 2) * np.array([aspect, 1])
    size = np.array([width, max(round(width / aspect), 1)])
    x, y = np.meshgrid(*((np.arange(n) + 0.5) * 2 / n - 1 for n in size))
    rays = np.stack([half[0] * x, half[1] * y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    shrunk = np.divide(picture.shape[1::-1], (camera.width, camera.height))
    at = ((camera.project(rays) + 0.5) * shrunk - 0.5).reshape(*x.shape, 2).astype(np.float32)
    # NaN, outside of the lens' field of view, is outside of the image as well.
    at = np.nan_to_num(at, nan=-9.0)
    return np.asarray(cv2.remap(picture, at[..., 0], at[..., 1], cv2.INTER_LINEAR), dtype=np.uint8)


def sample_beams(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """(K, 2, 3) lines from the origin to an evenly spaced subset of the points (N, 3) of a scan."""
    ends = points[:: len(points) // _MAX_BEAMS + 1]
    return np.stack([np.zeros_like(ends), ends], axis=1)


def uncertainty_ellipsoid(T_root_sensor: Array, covariance: Array, most: float) -> tuple[Array, Array]:
    """The 95 % ellipsoid of a sensor's position.

    Args:
        T_root_sensor: (4, 4).
        covariance: (6, 6) of its error in the root's fixed axes.
        most: longest semi-axis, m, at which unobservable directions are clipped.

    Returns:
        The semi-axes (3,), m, and the rotation (3, 3) from them to the sensor frame.
    """
    half, R_root_axes = error_ellipsoid(covariance[:3, :3])
    return np.minimum(half, most), T_root_sensor[:3, :3].T @ R_root_axes
