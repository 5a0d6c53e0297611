"""All text that users and readers meet uses the standard terms, in sentences of moderate length."""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "calgraph"
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("docs/decisions/*.md")])
TEMPLATES = sorted([*SOURCE.rglob("*.html"), *SOURCE.rglob("*.js")])
MODULES = sorted(
    path
    for pattern in ("src/**/*.py", "docs/*.py", "docs/examples/*.py", "benchmarks/*.py")
    for path in ROOT.glob(pattern)
)
FILES = [*PAGES, *TEMPLATES, *MODULES]

STANDARD_TERMS = {
    r"seen|saw|sees|(?:sensors?|cameras?|scanners?|lidars?|both|it|they|others?) see": "detect, observe, measure",
    r"(?:of|on) (?:its|their|one's|your) own(?! \w)": "separate",
    r"says?|said|tells?|told|telling": "state, report, name; distinguish for 'tell apart'",
    r"sway(?:s|ed|ing)?": "view bias",
    r"nobody|somebody|anybody|everybody|whoever|whatever|whichever": "no person, any, all",
    r"laid|lays?|laying": "place, fit, register",
    r"mend(?:s|ed|ing)?": "correct, repair",
    r"hangs?|hung|hanging": "has the parent",
    r"imagin(?:e|es|ed|ing)": "predicted",
    r"overlook(?:s|ed|ing)?|unnoticed": "missed",
    r"doubt(?:s|ed|ful)?": "conflicting, inconsistent",
    r"believ(?:e|es|ed|ing)|beliefs?": "estimated, stated",
    r"rivals?": "ambiguous pose, alternative",
    r"alike|faint(?:ly)?|glimpses?|visits?|knobs?": "the technical term",
    r"honest(?:ly|y)?": "consistent",
    r"trust(?:s|ed|ing|worthy)?(?! region)": "reliable, verdict",
    r"anew": "again",
    r"(?<!ground )truth(?!\.yaml)": "ground truth",
    r"so many|for want of|held off|holds? off|at once|all the same": "how many, for lack of, jointly",
    r"now and then|out comes?|come about|came about": "sometimes; the result is; originate",
    r"errs?|erred|erring": "has an error",
    r"(?<!data )sheets? (?:of|is|was|are|on|has|with)(?! paper| A\d)": "board, board outline",
    r"likeliest": "most likely",
    r"stor(?:y|ies)": "pipeline",
    r"(?:row|folder|files|topic) a (?:sensor|capture|scanner|corner|measurement)": "one row per sensor",
    r"amidst|whilst|thereof|therein|hereby|wherein|whereby|upon|lest|unto": "plain words",
}  # fmt: skip
"""Expressions that the pages and messages do not use, and what they use instead."""
ALLOWED: dict[tuple[str, str], str] = {
    ("src/calgraph/result/scene.py", "/seen"): "a member of scene.npz, see docs/formats.md",
}
"""Expressions that are right in one place: file and words around them, with the reason."""
MAX_WORDS = 40
"""Of a sentence."""


def plain(markdown: str) -> str:
    """Prose of a page: without code, formulas, addresses and the frames of tables."""
    text = re.sub(r"^(`{3,}|\$\$).*?^\1", "", markdown, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"``[^`\n]*``|`[^`\n]*`|\$[^$\n]*\$|<[^>\n]*>", "X", text)
    text = re.sub(r"\]\([^)]*\)", "]", text)
    return re.sub(r"^#+ .*$|^[-\d.|: ]*[-|][-|: ]*$", "\n", text, flags=re.MULTILINE)


def texts_of_module(path: Path) -> Iterator[str]:
    """String constants, docstrings included, and comments of a module."""
    code = path.read_text(encoding="utf-8")
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.JoinedStr):
            yield "".join(str(part.value) if isinstance(part, ast.Constant) else "X" for part in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield re.sub(r"``[^`\n]*``|`[^`\n]*`", "X", node.value)
    comments = [t for t in tokenize.generate_tokens(io.StringIO(code).readline) if t.type == tokenize.COMMENT]
    yield from (comment.string for comment in comments)


def texts(path: Path) -> list[str]:
    if path.suffix == ".py":
        return list(texts_of_module(path))
    content = path.read_text(encoding="utf-8")
    return [plain(content) if path.suffix == ".md" else content]


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def is_allowed(path: Path, around: str) -> bool:
    return any(name_of(path) == file and words in around for file, words in ALLOWED)


def replaceable(text: str) -> dict[str, str]:
    """Expressions of a text that have a standard term, with the words around them, and the term."""
    text = " ".join(text.split())
    return {
        text[max(0, match.start() - 30) : match.end() + 30]: instead
        for words, instead in STANDARD_TERMS.items()
        for match in re.finditer(rf"\b(?:{words})\b", text, re.IGNORECASE)
    }


@pytest.mark.parametrize(
    "sentence",
    [
        "its 28 captures contradict what all sensors together say",
        "the mean square distance between what the two saw",
        "camera · hangs from lidar",
        "Captures are drawn anew, again and again",
        "Whatever nobody trusts still holds together what nothing else does.",
        "each noise and sway holds on to what it is",
        "all three sensors are placed at once",
        "the board as cameras see it",
    ],
)
def test_expressions_are_found(sentence: str) -> None:
    assert replaceable(sentence)


@pytest.mark.parametrize(
    "sentence",
    [
        "all 28 shared captures were rejected as outliers by the joint solution",
        "inliers / shared captures, and RMS residual; see `docs/method.md`",
        "camera · parent: lidar",
        "scipy's trust region; truth.yaml has the ground truth of each sensor's own frame",
    ],
)
def test_standard_terms_are_accepted(sentence: str) -> None:
    assert not replaceable(sentence)


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_terms_are_the_standard_ones(path: Path) -> None:
    found = {around: instead for text in texts(path) for around, instead in replaceable(text).items()}
    assert {around: instead for around, instead in found.items() if not is_allowed(path, around)} == {}


def sentences(text: str) -> list[str]:
    """Sentences, items and cells of tables."""
    return re.split(r"(?<=[.:;!?])\s+(?=[\"(*\w])|\n\s*\n|\n\s*[-*\d]+\.? |\||\n(?=\|)", text)


@pytest.mark.parametrize("path", PAGES, ids=name_of)
def test_sentences_are_not_longer_than_a_reader_can_hold(path: Path) -> None:
    long = [s for text in texts(path) for s in sentences(text) if len(re.findall(r"[A-Za-z]{2,}", s)) > MAX_WORDS]
    assert [" ".join(sentence.split()) for sentence in long] == []


@pytest.mark.parametrize("place", ALLOWED, ids=str)
def test_exception_is_still_needed(place: tuple[str, str]) -> None:
    file, words = place
    assert any(words in " ".join(text.split()) for text in texts(ROOT / file))
