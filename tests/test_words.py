"""Words of the glossary: those that have another name must not return.

They are looked for in the names of modules, classes, functions, arguments and variables, in
docstrings and in comments of the program.
"""

import ast
import functools
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("schemas", "io", "tasks", "flows")
MODULES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
# In text, with the uses that are allowed; in names, as words between underscores or capitals.
TEXTS = {
    "place": r"(?<!in )(?<!into )\bplaces?\b",
    "claim": r"\bclaim(s|ed|ing)?\b(?!-|``)",
    "told": r"\btold\b",
    "own": r"\bown\b",
    "held": r"\bheld\b",
    "fewest": r"\bfewest\b",
    "so many": r"\bso many\b",
    "is none": r"(?<!there )\b(is|has) none\b",
    "is no": r"(?<!there )\bis no (?!longer|more)\w+",
    "by chance": r"\bby chance\b",
    "speaks for": r"\b(speaks? for|counts? against)\b",
    "sift": r"\b(sie?ves?|sift\w*)\b",
    "partner": r"\bpartners?\b",
    "contest": r"\bcontests?\b",
    "union": r"\bunions?\b",
}
NAMES = {
    "place": {"place", "places", "placed"},
    "claim": {"claim", "claims", "claimed"},
    "told": {"told"},
    "own": {"own"},
    "held": {"held"},
    "fewest": {"fewest"},
    "sift": {"sieve", "sift", "sifted"},
    "partner": {"partner", "partners"},
    "contest": {"contest", "contests"},
    "union": {"union", "unions"},
}
# Names that a file format fixes: scenes, reports. Publication puts nights "in place".
ALLOWED_NAMES = {
    "place_km", "position_told", "prior_told", "stars_claimed",
    "put_in_place", "_put_all_in_place", "in_place",
}  # fmt: skip


@functools.cache
def texts(path: Path) -> list[str]:
    """Return the docstrings and comments of a module, each as one line."""
    return list(_texts(path.read_text()))


def _texts(source: str) -> Iterator[str]:
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Module):
            yield " ".join((ast.get_docstring(node) or "").split())
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.string


@functools.cache
def names(path: Path) -> list[str]:
    """Return the names that a module gives: to itself, classes, functions, arguments, variables."""
    return [path.stem, *_names(path.read_text())]


def _names(source: str) -> Iterator[str]:
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.attr


def words(name: str) -> set[str]:
    """Return the words of a name, in lower case: ``N_Stars`` and ``NStars`` have two."""
    return {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)}


def found(word: str, path: Path) -> list[str]:
    """Return where a module has a word, in a name or in text."""
    where = [
        text[max(match.start() - 40, 0) : match.end() + 40]
        for text in texts(path)
        for match in re.finditer(TEXTS[word], text, re.IGNORECASE)
    ]
    bad = NAMES.get(word, set())
    return where + [n for n in names(path) if n not in ALLOWED_NAMES and words(n) & bad]


@pytest.mark.parametrize("word", TEXTS)
def test_a_word_that_has_a_better_one_does_not_return(word):
    """See docs/glossary.md for the word to use."""
    modules = {path: path.relative_to(ROOT).as_posix() for path in MODULES}
    assert {name: where for path, name in modules.items() if (where := found(word, path))} == {}


@pytest.mark.parametrize("word", TEXTS)
def test_the_glossary_names_the_word_as_one_to_avoid(word):
    avoided = (ROOT / "docs" / "glossary.md").read_text().split("## Words that we avoid")[1]
    assert word in avoided


def test_names_are_read_word_by_word():
    assert words("OF_PLACES") == {"of", "places"}
    assert words("LogPlaces_own2") == {"log", "places", "own"}
    assert words("replaced") == {"replaced"}


# Names in backticks: what they name must exist.

REFERENCE = re.compile(r"(?<!`)`([A-Za-z_]\w*(?:\.\w+)*)`(?!`)")
# Names of other packages and formats.
NOT_OURS = {
    "epipole", "erfa", "foxglove", "log_", "log_time", "publish_time", "ros2msg", "savefig",
    "setup",
}  # fmt: skip


@functools.cache
def known_names() -> set[str]:
    """Return all names in the code of the program, of its modules and in its short strings."""
    known = {part for path in MODULES for part in (path.stem, *path.relative_to(ROOT).parts[:-1])}
    for path in MODULES:
        for token in tokenize.generate_tokens(io.StringIO(path.read_text()).readline):
            if token.type == tokenize.NAME:
                known.add(token.string)
            elif token.type == tokenize.STRING and re.fullmatch(r"[a-z]*\W\w+\W", token.string):
                known.add(token.string.strip("rbf\"'"))
    return known


def test_names_in_backticks_exist():
    missing = {
        f"{path.relative_to(ROOT)}: {reference}"
        for path in MODULES
        for text in texts(path)
        for reference in REFERENCE.findall(text)
        if reference.split(".")[0] not in NOT_OURS
        and not set(reference.split(".")) <= known_names()
    }
    assert missing == set()
