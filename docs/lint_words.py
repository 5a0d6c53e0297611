"""Lint of words: `python docs/lint_words.py` lists the expressions that have a standard term, and exits with 1.

It reads the pages, the templates of pages, and the docstrings, comments and messages of all modules but tests.
Each line it prints has the file, the line, the expression and what replaces it. Two rules go with the vocabulary:
sentences of pages have at most 40 words, and only the command line names options of commands.
"""

import argparse
import ast
import io
import re
import sys
import tokenize
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SOURCE = "src/calgraph/"
TEXTS = (
    "*.md", "docs/*.md", "docs/decisions/*.md", "docs/method/*.md", "src/**/*.html", "src/**/*.jinja",
    "src/**/*.js", "src/**/*.py", "docs/*.py", "docs/examples/*.py", "benchmarks/*.py",
)  # fmt: skip

VOCABULARY = {
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
"""Expressions, as regular expressions, that no text contains, and what to write instead."""
ALLOWED = {(f"{SOURCE}result/scene.py", "/seen"): "a member of scene.npz, see docs/formats.md"}
"""Expressions that are right in one place: file and words around them, with the reason."""
MAX_WORDS = 40
"""Of a sentence."""
OPTION = re.compile(r"(?<![\w-])--[a-z][\w-]*")
NAMES_OPTIONS = {
    "cli/": "options of calgraph",
    "parallel/open_cluster.py": "options of dask worker",
    "report/figures.py": "variables of CSS",
    "result/exports/launch.py": "options of tf2_ros's static_transform_publisher",
    "result/exports/tf.py": "options of ros2 topic pub",
}
"""Modules that name options; all others name their own parameters."""


@dataclass(frozen=True, order=True)
class Finding:
    """One expression to replace."""

    file: Path
    line: int
    words: str
    instead: str

    def __str__(self) -> str:
        return f"{self.file.as_posix()}:{self.line}: {self.words!r}: {self.instead}"


@dataclass(frozen=True)
class Text:
    """Text with single spaces between its words, and the line of the file that each of its characters is from."""

    words: str
    starts: tuple[int, ...]
    """Where lines with words begin in the text."""
    numbers: tuple[int, ...]
    """The numbers of those lines in the file."""

    def line_at(self, character: int) -> int:
        """Line of the file."""
        return self.numbers[max(0, bisect_right(self.starts, character) - 1)] if self.numbers else 1


def flatten(text: str, first: int = 1, last: int | None = None) -> Text:
    """A text that begins at line `first` of its file, and ends at `last` at the latest."""
    parts, starts, numbers, length = [], [], [], 0
    for number, line in enumerate(text.split("\n"), first):
        words = " ".join(line.split())
        if words:
            parts.append(words)
            starts.append(length)
            numbers.append(min(number, last or number))
            length += len(words) + 1
    return Text(" ".join(parts), tuple(starts), tuple(numbers))


def read_prose(markdown: str) -> str:
    """Prose of a page, on the same lines: without code, formulas, addresses and the frames of tables."""

    def empty(match: re.Match[str]) -> str:
        return "\n" * match[0].count("\n")

    text = re.sub(r"^(`{3,}|\$\$).*?^\1", empty, markdown, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"``[^`\n]*``|`[^`\n]*`|\$[^$\n]*\$|<[^>\n]*>", "X", text)
    text = re.sub(r"\]\([^)]*\)", "]", text)
    return re.sub(r"^#+ .*$|^[-\d.|: ]*[-|][-|: ]*$", "", text, flags=re.MULTILINE)


def read_module(code: str) -> Iterator[Text]:
    """String constants, docstrings included, and comments of a module."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.JoinedStr):
            words = "".join(str(part.value) if isinstance(part, ast.Constant) else "X" for part in node.values)
            yield flatten(words, node.lineno, node.end_lineno)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            words = re.sub(r"``[^`\n]*``|`[^`\n]*`", "X", node.value)
            yield flatten(words, node.lineno, node.end_lineno)
    for token in tokenize.generate_tokens(io.StringIO(code).readline):
        if token.type == tokenize.COMMENT:
            yield flatten(token.string, token.start[0])


def read_texts(path: Path) -> list[Text]:
    """All texts of a page, template or module."""
    content = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        return list(read_module(content))
    return [flatten(read_prose(content) if path.suffix == ".md" else content)]


def find_words(text: Text, file: Path) -> Iterator[Finding]:
    """Expressions that have a standard term, unless they are allowed in the file."""
    allowed = [words for name, words in ALLOWED if name == file.as_posix()]
    for expression, instead in VOCABULARY.items():
        for match in re.finditer(rf"\b(?:{expression})\b", text.words, re.IGNORECASE):
            around = text.words[max(0, match.start() - 30) : match.end() + 30]
            if not any(words in around for words in allowed):
                yield Finding(file, text.line_at(match.start()), match[0], f"write: {instead}")


def find_long_sentences(markdown: str, file: Path) -> Iterator[Finding]:
    """Sentences, items and cells of tables of a page with more than 40 words."""
    prose = read_prose(markdown)
    start = 0
    for end in re.finditer(r"(?<=[.:;!?])\s+(?=[\"(*\w])|\n\s*\n|\n\s*[-*\d]+\.? |\||\n(?=\|)|\Z", prose):
        sentence = prose[start : end.start()]
        words = len(re.findall(r"[A-Za-z]{2,}", sentence))
        if words > MAX_WORDS:
            line = prose.count("\n", 0, start) + 1
            beginning = " ".join(sentence.split()[:6])
            yield Finding(file, line, f"{beginning} …", f"{words} words: write sentences of at most {MAX_WORDS}")
        start = end.end()


def find_options(code: str, file: Path) -> Iterator[Finding]:
    """Options that a module of the library names, where they are not those of another program."""
    name = file.as_posix()
    if name.startswith(SOURCE) and not name.removeprefix(SOURCE).startswith(tuple(NAMES_OPTIONS)):
        for number, line in enumerate(code.splitlines(), 1):
            for option in OPTION.findall(line):
                yield Finding(file, number, option, "write: the name of the parameter")


def lint(root: Path = ROOT) -> list[Finding]:
    """What is to be replaced in a checkout, by file and line."""
    found: set[Finding] = set()
    used = set()
    for path in sorted({path for pattern in TEXTS for path in root.glob(pattern)} - {Path(__file__).resolve()}):
        file = path.relative_to(root)
        content = path.read_text(encoding="utf-8")
        texts = read_texts(path)
        found.update(finding for text in texts for finding in find_words(text, file))
        used |= {key for key in ALLOWED if key[0] == file.as_posix() and any(key[1] in t.words for t in texts)}
        if path.suffix == ".md":
            found.update(find_long_sentences(content, file))
        elif path.suffix == ".py":
            found.update(find_options(content, file))
    unused = [key for key in ALLOWED if key not in used and (root / key[0]).exists()]
    found.update(
        Finding(Path(name), 1, words, "is not there any more: remove it from ALLOWED") for name, words in unused
    )
    return sorted(found)


def main() -> int:
    """Command line: 1 if there is an expression to replace."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("root", nargs="?", type=Path, default=ROOT, help="checkout to read (this one)")
    findings = lint(parser.parse_args().root.resolve())
    for finding in findings:
        print(finding)
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
