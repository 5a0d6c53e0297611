"""Settings of the pose graph."""

from pydantic import Field

from calgraph.config.strict_model import StrictModel


class GraphSettings(StrictModel):
    """Connectivity, start values and the consensus over trees."""

    outlier_probability: float = Field(default=1e-3, gt=0, lt=1)
    """Probability with which a right edge, or a cycle of right edges, is taken for an outlier: rare in a graph of
    ten sensors, and 4.0 (SE(2)) or 4.7 (SE(3)) standard deviations."""
    tree_gate_factor: float = Field(default=9.0, ge=1)
    """Factor of the gate of squared distances before refinement: noise of nine edges in a row along a tree."""
    tree_edges: int = Field(default=100_000, ge=1)
    """Random trees are drawn until they have this number of edges in total, within the limits below; it bounds
    the time."""
    min_trees: int = Field(default=8, ge=1)
    """Minimum number of random trees, for graphs of more than 12,500 edges."""
    max_trees: int = Field(default=600, ge=1)
    """Maximum number of random trees: with half of the edges wrong, 1 in 130 trees of seven edges has none of
    them, if drawn without regard to cycles."""
    refined_edges: int = Field(default=5_000, ge=1)
    """The best trees are refined until they have this number of edges in total, within the limits below."""
    min_refined_trees: int = Field(default=1, ge=1)
    """Minimum number of refined trees, for graphs of more than 5000 edges."""
    max_refined_trees: int = Field(default=6, ge=1)
    """Maximum number of refined trees: the score after refinement decides among those before it."""
    cycle_rounds: int = Field(default=6, ge=1)
    """Number of shortest cycles through every edge from which its support is computed: six distinguish consistent
    edges from others."""
    support_exponent: float = Field(default=2.0, ge=0)
    """Exponent of the inverse support in the cost of an edge in the first random tree; it falls to 0 in the last,
    because outliers that agree with each other have support, too."""
    min_edge_weight: float = Field(default=1e-3, gt=0, le=1)
    """Minimum weight of an edge, which keeps the graph connected: a thousand of them weigh as much as a right
    edge."""
    min_vote_gain: float = Field(default=0.5, gt=0)
    """Increase of votes, in edges of full weight, from which a node moves: less than one right edge, more than the
    noise of the others."""
    max_proposals: int = Field(default=30, ge=1)
    """Maximum number of poses proposed to one node: among 30 random edges of which 90 % are wrong, one is right
    with 96 %."""
    first_robust_scale: float = Field(default=64.0, gt=0)
    """Scale of the first robust loss of a refined tree, relative to the gate of squared distances: at eight
    times the gate's distance, an edge still has a quarter of its weight. Each next scale is half of it (graduated
    non-convexity)."""
    last_robust_scale: float = Field(default=0.25, gt=0)
    """Minimum of these scales: an edge at the gate has then a weight of 1/25."""
    rig_translation_floor: float = Field(default=0.01, ge=0)
    """m; standard deviation of the model error of a rig's pairs (bend of the board, range bias, stamps)."""
    rig_rotation_floor: float = Field(default=0.005, ge=0)
    """rad (0.3°); the same of rotations: the above over a lever of 2 m."""
    network_translation_floor: float = Field(default=0.02, gt=0)
    """m; initial model error of a network's pairs (bodies are not ellipses, clocks differ), scaled by the
    graph."""
    network_rotation_floor: float = Field(default=0.004, gt=0)
    """rad (0.2°); the same of rotations: the above over the 5 m that a walk is long."""
    min_floor_scale: float = Field(default=0.05, gt=0, lt=1)
    """Minimum scale of these floors: 1 mm and 0.01°, which no pair reaches."""
    max_floor_scale: float = Field(default=20.0, gt=1)
    """Maximum scale of these floors: 0.4 m and 5°, with which any pairs agree."""
    floor_prior_weight: float = Field(default=3.0, gt=0)
    """Weight of the prior that these floors are right, in residuals: those of one pair."""
    half_weight_evidence: float = Field(default=130.0, gt=0)
    """Weight of evidence at which an edge has half the full weight: a perfect fit of 5 s of one person, as long as
    people walk side by side; about that of the best wrong pairs in halls with a couple and no other people."""
    wall_evidence: float = Field(default=260.0, ge=0)
    """Weight of evidence of matching walls: almost no wrong pose aligns them; twice the above."""
    max_ambiguity: float = Field(default=0.7, gt=0, le=1)
    """Ratio of the evidence of another place of a part of the network to that of its place, above which it is
    ambiguous: 0.4 at most in 343 pairs of offices, labs and halls without couples, and above 0.7 in 10 of 11 wrong
    pairs of halls with a couple and no other people."""
    half_weight_positions: float = Field(default=50.0, gt=0)
    """Agreeing positions, times their share, at which a published average gives a pair half the full weight: 5 s
    of one person."""
    wall_positions: float = Field(default=100.0, ge=0)
    """Positions as which matching walls count there: twice the above."""
