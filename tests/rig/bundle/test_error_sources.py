"""The covariance of a bundle as a sum over the sources of its errors."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.result.budget import ErrorSource
from calgraph.rig.bundle.bundle_parameters import SensorPrior
from calgraph.rig.bundle.bundle_solver import Bundle, MinimizedBundle, minimize_bundle
from calgraph.rig.bundle.covariances import pose_covariance
from calgraph.rig.bundle.error_sources import split_covariance
from calgraph.rig.bundle.solution import SolvedBundle
from detected_rigs import detect_rig


def split(bundle: Bundle, minimized: MinimizedBundle) -> dict[ErrorSource, Array]:
    return split_covariance(bundle, minimized)


@pytest.fixture(scope="module")
def solved() -> SolvedBundle:
    """A camera, a 2-D scanner and a 3-D LiDAR, with outlines."""
    found = detect_rig().solve().solved_bundle
    assert found is not None
    return found


def relative_difference(parts: dict[ErrorSource, Array], covariance: Array) -> float:
    scale = np.sqrt(np.diag(covariance))
    scale[scale == 0] = 1.0
    return float(np.max(np.abs(sum(parts.values()) - covariance) / scale / scale[:, None]))


def test_sources_add_up_to_the_covariance_of_all_poses(solved: SolvedBundle) -> None:
    bundle, minimized = solved.bundle, solved.minimized
    covariance = pose_covariance(bundle, minimized.state, minimized.equations)
    parts = split(bundle, minimized)
    assert relative_difference(parts, covariance) < 1e-9
    kinds = {source.kind for source in parts}
    assert kinds >= {"noise", "view bias", "edges", "focal length", "principal point", "print scale", "range bias"}


def test_a_stated_pose_is_a_source(solved: SolvedBundle) -> None:
    prior = SensorPrior(1, solved.minimized.state.T_root_sensor[1], np.eye(6) * 1e6)
    bundle = replace(solved.bundle, priors=(prior,))
    minimized = minimize_bundle(bundle, solved.minimized.state)
    parts = split(bundle, minimized)
    assert relative_difference(parts, pose_covariance(bundle, minimized.state, minimized.equations)) < 1e-9
    assert parts[ErrorSource("stated pose", bundle.sensors[1])][6, 6] > 1e-9


def test_no_source_has_a_negative_variance(solved: SolvedBundle) -> None:
    for source, part in split(solved.bundle, solved.minimized).items():
        assert np.linalg.eigvalsh(part)[0] > -1e-9 * np.trace(part) - 1e-18, source


def test_views_without_bias_have_no_part_by_it(solved: SolvedBundle) -> None:
    views = len(solved.bundle.views)
    variance = solved.bundle.bias_variance.copy()
    variance[:views] = 0
    bundle = replace(solved.bundle, bias_variance=variance)
    parts = split(bundle, minimize_bundle(bundle, solved.minimized.state))
    assert all(not part.any() for source, part in parts.items() if source.kind == "view bias")


def test_a_prior_as_narrow_as_a_hundredth_leaves_a_hundredth_of_its_part(solved: SolvedBundle) -> None:
    """The part of a source whose prior is almost exact is its influence times its prior variance."""
    bundle, source = solved.bundle, ErrorSource("print scale", "board")
    narrow = [
        replace(one, prior_stddev=one.prior_stddev / 100) if one.quantity == "print scale" else one
        for one in bundle.extra_parameters
    ]
    exact = replace(bundle, extra_parameters=tuple(narrow))
    before = split(bundle, solved.minimized)[source]
    after = split(exact, minimize_bundle(exact, solved.minimized.state))[source]
    assert np.trace(after) < 2e-3 * np.trace(before)
