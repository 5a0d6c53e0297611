"""The lint of words finds what it must in every kind of text, and nothing in this checkout."""

from pathlib import Path

import pytest
from docs.lint_words import ALLOWED, MAX_WORDS, VOCABULARY, Finding, find_words, flatten, lint

PAGE = """\
# What the camera saw

The board is measured. ``seen`` and `seen` are code; scipy has a trust region.

```sh
calgraph what nobody runs
```
| a cell | the operator
lays the board down |

{sentence}
"""
MODULE = '''\
"""Draws captures
anew."""

LIMIT = 3  # nobody knows why


def check(name: str) -> None:
    """Raises an error."""
    raise ValueError(
        f"{name}: the scanner saw "
        "no board, use --force"
    )
'''


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    for folder in ("docs/decisions", "src/calgraph/cli"):
        (tmp_path / folder).mkdir(parents=True)
    long = " ".join(["word"] * (MAX_WORDS + 1))
    (tmp_path / "docs/page.md").write_text(PAGE.format(sentence=f"{long}."), encoding="utf-8")
    (tmp_path / "src/calgraph/module.py").write_text(MODULE, encoding="utf-8")
    (tmp_path / "src/calgraph/cli/command.py").write_text(MODULE.replace("saw", "measured"), encoding="utf-8")
    (tmp_path / "src/calgraph/page.html").write_text("<p>\n<b>Sensors see</b> it", encoding="utf-8")
    return tmp_path


def test_every_kind_of_text_is_read(checkout: Path) -> None:
    found = [(one.file.name, one.line, one.words) for one in lint(checkout)]
    assert found == [
        ("page.md", 9, "lays"),
        ("page.md", 11, "word word word word word word …"),
        ("command.py", 2, "anew"),
        ("command.py", 4, "nobody"),
        ("module.py", 2, "anew"),
        ("module.py", 4, "nobody"),
        ("module.py", 10, "saw"),
        ("module.py", 11, "--force"),
        ("page.html", 2, "Sensors see"),
    ]


def test_a_finding_has_place_expression_and_replacement() -> None:
    text = flatten("Captures\nare drawn anew", 7)
    (finding,) = find_words(text, Path("docs/page.md"))
    assert str(finding) == "docs/page.md:8: 'anew': write: again"


@pytest.mark.parametrize(
    ("sentence", "expression"),
    [
        ("its 28 captures contradict what all sensors together say", "say"),
        ("the mean square distance between what the two saw", "saw"),
        ("camera · hangs from lidar", "hangs"),
        ("each noise and sway of a sensor", "sway"),
        ("all three sensors are placed at once", "at once"),
        ("the board as cameras see it", "cameras see"),
    ],
)
def test_expressions_are_found(sentence: str, expression: str) -> None:
    assert [one.words for one in find_words(flatten(sentence), Path("page.md"))] == [expression]


def test_standard_terms_are_accepted() -> None:
    accepted = (
        "all 28 shared captures were rejected as outliers by the joint solution; camera · parent: lidar; "
        "scipy's trust region; truth.yaml has the ground truth of each sensor's own frame"
    )
    assert list(find_words(flatten(accepted), Path("page.md"))) == []


def test_an_exception_that_is_not_needed_any_more_is_found(checkout: Path) -> None:
    ((file, words), _) = next(iter(ALLOWED.items()))
    place = checkout / file
    place.parent.mkdir()
    place.write_text(f'A = "a member {words}"\n', encoding="utf-8")
    assert Path(file) not in {one.file for one in lint(checkout)}
    place.write_text('A = "a member"\n', encoding="utf-8")
    assert Finding(Path(file), 1, words, "is not there any more: remove it from ALLOWED") in lint(checkout)


def test_every_expression_has_a_replacement() -> None:
    assert [expression for expression, instead in VOCABULARY.items() if not instead] == []


def test_this_checkout_has_no_findings() -> None:
    assert lint() == []
