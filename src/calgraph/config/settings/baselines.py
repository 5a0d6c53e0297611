"""Settings of the papers' estimators."""

import numpy as np
from pydantic import Field

from calgraph.config.strict_model import StrictModel


class BaselineSettings(StrictModel):
    """The hypergraph, the published averages and the published features."""

    held_stddev: float = Field(default=0.01, gt=0)
    """m and rad; the hypergraph holds a direction that a pair of the tree does not observe with this standard
    deviation at its start value: small compared with the limit of an observed direction
    (`pairwise.board.max_stddev`)."""
    max_steps: int = Field(default=50, ge=1)
    """Limit on steps of the hypergraph's solution, which states whether it converged: the tests of this estimator
    need up to 46, where poses start far from the solution."""
    prior_translation_stddev: float = Field(default=10.0, gt=0)
    """m; standard deviation that the hypergraph states for unobservable positions: the size of a scene."""
    prior_rotation_stddev: float = Field(default=float(np.pi), gt=0)
    """rad; the same for unobservable rotations: any angle."""
    max_inlier_angle: float = Field(default=float(np.radians(5)), gt=0)
    """rad (5°); edges that differ more from the averaged rotations are outliers: above the noise of pairs (0.2 to
    2°), and small compared with the error of wrong ones."""
    centroid_depth_stddev: float = Field(default=0.2, gt=0)
    """m; prior standard deviation of the distance from centroids to true centres along the beam: that of a half
    circle lies 0.6 to 0.8 of the radius before the centre."""
    linearizations: int = Field(default=4, ge=1)
    """Linearizations of the cycle constraints of rotations in space: each error is of second order in the last
    correction."""
    min_ellipse_radius: float = Field(default=0.3, gt=0, lt=1)
    """Minimum radius of a plausible direct ellipse, over the target's smaller one: bodies vary by less, but short
    arcs give narrow ellipses."""
    max_ellipse_radius: float = Field(default=2.0, gt=1)
    """Maximum radius, and distance from the centroid, of a plausible direct ellipse, over the target's larger
    radius."""
    direct_ellipse_stddev: float = Field(default=0.5, gt=0)
    """Standard deviation of the centre of a direct ellipse along the beam, over the target's radius: its size is
    unknown, and residuals do not measure by how much the centre follows it."""
    replaced_ellipse_stddev: float = Field(default=0.25, gt=0)
    """The same of the centroid that replaces an implausible ellipse: centroids of visible halves lie 0.6 to 0.8 of
    the radius before the centre."""
    direct_ellipse_depth_stddev: float = Field(default=0.05, gt=0)
    """m; the same for direct ellipse fits, whose size is unknown."""
