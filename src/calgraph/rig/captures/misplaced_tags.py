"""Tags that are not where rig.yaml states them on a board."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence

from calgraph.boards.detections import BoardCorners, Detection, InconsistentTags
from calgraph.result.finding import Finding

# Minimum number of captures in which a tag is an outlier: one or two may be accidents.
_MIN_CAPTURES = 3
# The same over the captures in which the camera detected several tags: a misplaced tag is an outlier in all in
# which the others are the majority, or in half where two tags contradict each other.
_MIN_SHARE = 0.5


def find_misplaced_tags(
    camera: str,
    detected: Iterable[Sequence[Detection]],
    inconsistent: Sequence[InconsistentTags],
) -> Iterator[Finding]:
    """A finding if tags are outliers in most captures of a camera in which it detected more than one.

    Args:
        camera: name of the camera.
        detected: the detected boards of each capture.
        inconsistent: of each capture in which tags were detected that do not fit together.
    """
    boards = [one for found in detected for one in found if isinstance(one, BoardCorners)]
    several = sum(len(one.corners_board) > 4 or bool(one.outlier_tags) for one in boards) + len(inconsistent)
    outliers = Counter(tag for one in boards for tag in one.outlier_tags)
    outliers.update(tag for one in inconsistent for tag in one.tags)
    least = max(_MIN_CAPTURES, _MIN_SHARE * several)
    tags = sorted(tag for tag, count in outliers.items() if count >= least)
    if tags:
        names = (
            f"tag {tags[0]} is an outlier" if len(tags) == 1 else f"tags {', '.join(map(str, tags))} are outliers"
        )
        yield Finding(
            f"{names} in up to {max(outliers[tag] for tag in tags)} of the {several} captures in which {camera} "
            "detected several tags: the board is not as in rig.yaml; check the tags' ids, centres, orientation "
            "and size there",
            (camera,),
        )
