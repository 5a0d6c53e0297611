"""Systematic errors of scanners that contradict their priors."""

import numpy as np

from calgraph.network.checks.model_assessment import find_systematic_errors
from calgraph.network.joint.planar_poses import NearCovariances
from calgraph.network.joint.scanner_unknowns import CLOCK_DRIFT, STRETCH_X, SystematicErrors
from dense_covariances import relate_all

NAMES = ("root", "east")
PRIOR = np.array([[0.02, 0.003, 0.002, 6e-4, 6e-4, 0.0], [0.02, 0.003, 0.002, 6e-4, 6e-4, 3e-5]])


def find(scanner: int, kind: int, deviations: float, learned: float = 0.99) -> list[tuple[str, tuple[str, ...]]]:
    """Findings for one error, in prior standard deviations, of which the data removed a share of the variance."""
    values = np.zeros(PRIOR.shape)
    values[scanner, kind] = deviations * PRIOR[scanner, kind]
    errors = SystematicErrors(values, relate_all(np.diag((1 - learned) * PRIOR.ravel() ** 2), 2), PRIOR)
    found = find_systematic_errors(errors, NAMES)
    return [(finding.text, finding.sensors) for finding in found]


def test_errors_within_their_priors_are_not_named() -> None:
    assert find(1, 0, 2.9) == []


def test_an_error_beyond_its_prior_is_named_with_its_size() -> None:
    [(text, scanners)] = find(1, 0, -4.0)
    assert text.startswith(
        "ranges of east are 80 mm shorter than they should be; this is 4.0 times its uncertainty in "
        "rig.yaml (σ 20 mm): check it"
    )
    assert scanners == ("east",)


def test_an_error_of_the_root_makes_all_poses_weak() -> None:
    [(text, scanners)] = find(0, 2, 5.0)
    assert (text.startswith("angles between beams of root are 1 % larger"), scanners) == (True, NAMES)


def test_a_clock_that_drifts_is_named() -> None:
    [(text, _)] = find(1, CLOCK_DRIFT, 10.0)
    assert text.startswith("the clock of east is 300 ppm faster than that of the root; this is 10.1 times")


def test_stretches_are_compared_as_the_tilts_that_cause_them() -> None:
    """Three standard deviations of tilt stretch ranges by 4.5 prior standard deviations."""
    assert find(1, STRETCH_X, 4.4) == []
    [(text, scanners)] = find(1, STRETCH_X, -5.0)
    assert text.startswith(
        "ranges of east along its x axis are 0.3 % shorter than on average, as by a tilt of its scan plane; this "
        "is 3.3 times its uncertainty in rig.yaml (σ 0.09 %): check it"
    )
    assert scanners == ("east",)


def test_estimates_are_tested_by_what_the_data_removed() -> None:
    """With a quarter of the variance removed, right values have half the prior standard deviation."""
    assert len(find(1, 1, 1.6, learned=0.25)) == 1
    assert find(1, 1, 1.4, learned=0.25) == []


def find_correlated(correlation: float, *, known: bool = True) -> list[tuple[str, tuple[str, ...]]]:
    """Findings for range scales of two scanners whose estimates are correlated, which may not be known."""
    values, names = np.zeros((3, PRIOR.shape[1])), ("root", "east", "west")
    prior = PRIOR[[0, 1, 1]]
    values[1:, 1] = 0.012, 0.006 if known else 0.014
    covariance = np.diag(0.01 * prior.ravel() ** 2)
    east, west = PRIOR.shape[1] * np.array([1, 2]) + 1
    covariance[east, west] = covariance[west, east] = correlation * covariance[east, east]
    pairs = relate_all(covariance, 3)
    if not known:
        kept = (pairs.pairs != [1, 2]).any(axis=1)
        pairs = NearCovariances(3, pairs.pairs[kept], pairs.blocks[kept])
    found = find_systematic_errors(SystematicErrors(values, pairs, prior), names)
    return [(finding.text, finding.sensors) for finding in found]


def test_errors_that_the_data_do_not_distinguish_are_named_together() -> None:
    """Each with the size that explains the data alone: 1.2 % - 0.95 * 0.6 %, and 0.6 % - 0.95 * 1.2 %."""
    [(text, scanners)] = find_correlated(0.95)
    assert text.startswith(
        "ranges of east are 0.63 % longer than they should be, or ranges of west are 0.54 % shorter than they "
        "should be (these 2 cannot be distinguished here); this is 4.0 times"
    )
    assert scanners == ("east", "west")


def test_errors_that_the_data_distinguish_are_named_alone() -> None:
    [(text, scanners)] = find_correlated(0.85)
    assert (text.startswith("ranges of east are 1.2 % longer"), scanners) == (True, ("east",))


def test_errors_of_scanners_far_from_each_other_are_named_apart() -> None:
    found = find_correlated(0.95, known=False)
    assert [(text.split(" than")[0], scanners) for text, scanners in found] == [
        ("ranges of east are 1.2 % longer", ("east",)),
        ("ranges of west are 1.4 % longer", ("west",)),
    ]
