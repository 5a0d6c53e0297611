"""Variants of the estimators: what the papers do in one step, where calgraph does something else by default."""

from typing import Literal

from calgraph.config.strict_model import StrictModel
from calgraph.errors import InputError

AveragingMethod = Literal["consensus", "l1mc", "triangles", "spectral", "irls"]
"""How pairs become poses: consensus over trees, or one of the published rotation averagings."""
CenterFeature = Literal["com", "ellipse", "nls"]
"""What is tracked of a person: centre of mass, direct ellipse, or ellipse of fixed radii (nls)."""
MatchFilter = Literal["ransac", "none"]
"""Matches that the joint solution uses: the inliers (``ransac``), or the first candidates of each capture."""
PlaneMethod = Literal["pnp", "mean_plane"]
"""A camera's plane of the board: one PnP over all corners of tags, or the paper's mean over tags."""
RigStart = Literal["tree", "identity", "consensus", "l1mc", "triangles", "spectral", "irls"]
"""Start poses of a rig's joint solution: a spanning tree, identity, or a method that averages all pairs."""
Weights = Literal["uniform", "weighted"]
"""Weights of pairs of scanners: all equal, or by their information."""

_OF_RIGS = ("keep", "start", "tags")
_OF_NETWORKS = ("average", "feature", "icp", "weights")


class PublishedSettings(StrictModel):
    """Single steps of calgraph's method or the papers', instead of those that the estimator implies.

    Without a value, a key follows the estimator: ``joint`` is calgraph's method, ``published`` the paper's.
    """

    estimator: Literal["bundle", "hypergraph", "joint", "averaging"] | None = None
    """The last step. Rigs: bundle (joint) or hypergraph (published). Networks: joint, or averaging (published),
    which ends with the average of pairs, as the paper does."""
    keep: MatchFilter | None = None
    """Rigs: matches of two sensors that are used, the inliers (ransac, as in the paper) or all (none), as in
    figure 5c of the paper."""
    start: RigStart | None = None
    """Rigs: start poses of the joint solution: tree (as in the paper), identity, or a method that averages all
    pairs, which one wrong pair misleads less than a tree."""
    tags: PlaneMethod | None = None
    """Rigs: a camera's plane of the board: one PnP over all corners (pnp, calgraph's), or the mean over tags
    (mean_plane, the paper's), which is less accurate."""
    average: AveragingMethod | None = None
    """Networks: averaging of pairwise poses: consensus (calgraph's), l1mc (the paper's), triangles, spectral or
    irls, which the paper compares."""
    feature: CenterFeature | None = None
    """Networks: centre of a tracked object: the ellipse of fixed radii (nls, calgraph's), a direct fit (ellipse,
    the paper's), or the centre of mass (com), which lies before the true centre."""
    icp: bool | None = None
    """Networks: whether static backgrounds (walls) are registered as well; both methods do so, since people may
    walk on one line."""
    weights: Weights | None = None
    """Networks: weights of pairs: their information (weighted, calgraph's), or uniform, which is sufficient for
    the paper's average below half of outliers."""

    def check_kind(self, *, is_network: bool) -> None:
        """Checks that no key of the other kind of target is stated.

        Args:
            is_network: whether the target is people or a cylinder, instead of a board.

        Raises:
            InputError: there is one.
        """
        others, kind = (_OF_RIGS, "rigs with a board") if is_network else (_OF_NETWORKS, "networks")
        if stated := [f"published.{key}" for key in others if getattr(self, key) is not None]:
            raise InputError(f"{', '.join(stated)}: only for {kind}")
