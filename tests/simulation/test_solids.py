import numpy as np
import pytest
from numpy.typing import NDArray

from calgraph.geometry import Array, se3, so3
from calgraph.simulation.solids import BoxShape, CylinderShape, RectangleShape, Shape, Solid, cast_rays

ORIGIN = np.zeros((1, 3))


def at(shape: Shape, x: float, y: float = 0.0, z: float = 0.0) -> Solid:
    return Solid(shape, se3.pose(np.eye(3), np.array([x, y, z])))


def towards(*directions: tuple[float, float, float]) -> Array:
    d = np.array(directions, dtype=np.float64)
    return np.asarray(d / np.linalg.norm(d, axis=1, keepdims=True))


def facing(x: float, yaw: float) -> Solid:
    """A 2 x 1 m rectangle whose plane is vertical and whose normal is turned from -x by yaw about z."""
    upright = np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]])
    turned = so3.exp(np.array([0.0, 0.0, yaw])) @ upright
    return Solid(RectangleShape(2.0, 1.0), se3.pose(turned, np.array([x, 0.0, 0.0])))


@pytest.mark.parametrize(
    ("direction", "expected"),
    [
        ((1, 0, 0), 2.0),
        ((1, 0.4, 0), 2 * np.hypot(1, 0.4)),
        ((1, 0, 0.24), 2 * np.hypot(1, 0.24)),
        ((1, 0.51, 0), np.inf),
        ((1, 0, 0.26), np.inf),
        ((-1, 0, 0), np.inf),
        ((0, 1, 0), np.inf),
    ],
)
def test_rectangle_is_hit_inside_its_edges_only(direction: tuple[float, float, float], expected: float) -> None:
    assert cast_rays([facing(2.0, 0.0)], ORIGIN, towards(direction)).ranges == pytest.approx([expected])


def test_rotated_rectangle_is_hit_in_its_plane() -> None:
    # The plane through (2, 0, 0) with normal (-cos 30°, -sin 30°): x cos + y sin = 2 cos.
    ranges = cast_rays([facing(2.0, np.pi / 6)], ORIGIN, towards((1, 0.2, 0))).ranges
    expected = 2 * np.cos(np.pi / 6) / (np.cos(np.pi / 6) + 0.2 * np.sin(np.pi / 6)) * np.hypot(1, 0.2)
    assert ranges == pytest.approx([expected])


def test_box_is_hit_on_its_near_face() -> None:
    assert cast_rays([at(BoxShape(1.0, 2.0, 2.0), 3.0)], ORIGIN, towards((1, 0, 0))).ranges == pytest.approx([2.5])


def test_box_is_a_room_from_inside() -> None:
    directions = towards((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, 0, -1), (1, 1, 0))
    ranges = cast_rays([at(BoxShape(10.0, 6.0, 3.0), 1.0)], ORIGIN, directions).ranges
    assert ranges == pytest.approx([6.0, 4.0, 3.0, 1.5, 3 * np.sqrt(2)])


def test_cylinder_is_hit_on_its_side_and_on_its_cap() -> None:
    cylinder = at(CylinderShape(0.5, 2.0), 3.0)
    above = np.array([[3.2, 0.0, 4.0]])
    assert cast_rays([cylinder], ORIGIN, towards((1, 0, 0))).ranges == pytest.approx([2.5])
    assert cast_rays([cylinder], above, towards((0, 0, -1))).ranges == pytest.approx([3.0])


def test_cylinder_is_missed_beside_and_above() -> None:
    directions = towards((3, 0.6, 0), (3, 0, 1.3))
    assert np.isinf(cast_rays([at(CylinderShape(0.5, 2.0), 3.0)], ORIGIN, directions).ranges).all()


def test_nearest_solid_hides_those_behind() -> None:
    hits = cast_rays(
        [at(BoxShape(1, 1, 1), 5.0), at(BoxShape(1, 1, 1), 3.0)], ORIGIN, towards((1, 0, 0), (0, 1, 0))
    )
    assert hits.ranges == pytest.approx([2.5, np.inf])
    assert hits.solid.tolist() == [1, -1]


def test_rays_may_have_different_origins() -> None:
    origins = np.array([[0.0, 0, 0], [1.0, 0, 0], [0.0, 3, 0]])
    ranges = cast_rays([at(BoxShape(1, 1, 1), 5.0)], origins, towards((1, 0, 0), (1, 0, 0), (1, 0, 0))).ranges
    assert ranges == pytest.approx([4.5, 3.5, np.inf])


def test_distances_in_a_cluttered_scene_agree_with_marching_along_the_rays(rng: np.random.Generator) -> None:
    turn = so3.exp(np.array([0.3, -0.5, 0.8]))
    box, cylinder = BoxShape(0.8, 0.5, 0.6), CylinderShape(0.3, 0.9)
    solids = [Solid(box, se3.pose(turn, np.array([2.0, 0.2, 0.0]))), at(cylinder, 1.0, -1.0, 0.3)]
    directions = towards(*(tuple(v) for v in rng.standard_normal((400, 3)) * [1, 1, 0.4]))
    steps = np.arange(0, 4, 0.002)
    points = steps[None, :, None] * directions[:, None]

    def inside(solid: Solid) -> NDArray[np.bool_]:
        p = np.abs(se3.apply(se3.inverse(solid.T_world_shape), points))
        if isinstance(solid.shape, BoxShape):
            within = p <= np.array([solid.shape.length, solid.shape.width, solid.shape.height]) / 2
            return np.asarray(within.all(axis=-1))
        assert isinstance(solid.shape, CylinderShape)
        round_part = np.hypot(p[..., 0], p[..., 1]) <= solid.shape.radius
        return np.asarray(round_part & (p[..., 2] <= solid.shape.height / 2))

    full = inside(solids[0]) | inside(solids[1])
    marched = np.where(full.any(axis=1), steps[full.argmax(axis=1)], np.inf)
    ranges = cast_rays(solids, ORIGIN, directions).ranges
    both = np.isfinite(marched)
    assert both.sum() > 15
    assert ranges[both] == pytest.approx(marched[both], abs=0.003)
