"""Every mechanism of the ablation is found in the package, and does or leaves undone what it is there for."""

import pytest

from ablation import MECHANISMS, SOURCES, WHOLE, replaced, run, show
from frozen import list_problems, select


@pytest.mark.parametrize("mechanism", MECHANISMS)
def test_each_mechanism_can_be_replaced(mechanism: str) -> None:
    with replaced(mechanism, MECHANISMS[mechanism].without):
        pass


def test_the_corpus_has_all_kinds_of_problems() -> None:
    names = select(list(list_problems()), SOURCES, 1)
    assert all(select(names, [source], 1) for source in SOURCES)


@pytest.mark.slow
def test_without_bumps_a_bumped_sensor_is_far_off(capsys: pytest.CaptureFixture[str]) -> None:
    [name] = select(list(list_problems()), ["model_errors/five/bump_rotation/0.0174533/0"], 1)
    rows = {row.left_out: row for row in run(name, ["bumps", "refusal_of_errors"])}
    assert rows["bumps"].fired
    assert not rows["refusal_of_errors"].fired
    assert rows["bumps"].moved > 5 > rows[WHOLE].moved
    show(list(rows.values()))
    assert capsys.readouterr().out.startswith("1 worlds, 1 with true poses")
