"""Intrinsics of cameras that have none, from the same recording."""

import logging
from collections.abc import Iterator, Mapping, Sequence

from calgraph.calibrate.options import Progress, no_progress
from calgraph.captures import Hold, InputFinding, find_views_in_holds
from calgraph.config import Rig
from calgraph.detection import BoardViewFinder
from calgraph.errors import Rejected
from calgraph.estimation import IntrinsicsEstimate, estimate_intrinsics
from calgraph.recording import Recording

_log = logging.getLogger(__name__)


def estimate_unknown_intrinsics(
    rig: Rig, recording: Recording, holds: Sequence[Hold], jobs: int, progress: Progress = no_progress
) -> dict[str, IntrinsicsEstimate | Rejected]:
    """Estimates the intrinsics of the cameras without any from all captures.

    Args:
        rig: with the intrinsics of all other cameras.
        recording: open recording with the rig's topics.
        holds: the captures.
        jobs: maximum number of processes.
        progress: called with the step and the fraction done.

    Returns:
        By camera, the intrinsics, or why the captures do not determine them.
    """
    unknown = {name: spec for name, spec in rig.cameras().items() if spec.stated_intrinsics is None}
    if not unknown:
        return {}

    def searching(done: float) -> None:
        progress("intrinsics", done / max(len(holds) * len(unknown), 1))

    views = find_views_in_holds(
        recording.records([spec.topic for spec in unknown.values()]),
        holds,
        {name: spec.topic for name, spec in unknown.items()},
        {
            name: BoardViewFinder(rig.boards, spec.noise, settings=rig.settings.detection.camera)
            for name, spec in unknown.items()
        },
        jobs=jobs,
        progress=searching,
    )
    estimates = {
        name: estimate_intrinsics(rig, name, views[name], spec.lens_to_estimate) for name, spec in unknown.items()
    }
    for name, estimate in estimates.items():
        _log.info("%s: %s", name, estimate.reason if isinstance(estimate, Rejected) else _describe(estimate))
    return estimates


def _describe(estimate: IntrinsicsEstimate) -> str:
    """Model, number of views and fit; the values are those of the joint solution."""
    others = "".join(f"; {model}: {fit}" for model, fit in estimate.rejected_models.items())
    return f"{estimate.camera.model}, {len(estimate.detections)} views, RMS {estimate.noise:.2f} px{others}"


def find_intrinsics_remarks(
    rig: Rig, camera_infos: Mapping[str, str], estimates: Mapping[str, IntrinsicsEstimate | Rejected]
) -> Iterator[InputFinding]:
    """Remarks on the intrinsics that were estimated, or could not be.

    Args:
        rig: the rig.
        camera_infos: topic with its intrinsics, by camera that has one.
        estimates: by camera without intrinsics.
    """
    for name, estimate in estimates.items():
        if name in camera_infos and rig.cameras()[name].intrinsics is None:
            yield InputFinding(
                f"{camera_infos[name]} has no focal lengths, as the driver of {name} knows none: its intrinsics "
                "are estimated from this recording"
            )
        if isinstance(estimate, Rejected):
            continue
        yield InputFinding(f"the intrinsics of {name} were estimated from this recording: {_describe(estimate)}")
        for shortcoming in estimate.shortcomings:
            yield InputFinding(f"the intrinsics of {name} are not well determined: {shortcoming}")
