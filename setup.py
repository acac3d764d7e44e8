"""What pyproject.toml cannot say: the README as a package index shows it.

An index has neither the picture nor the files that the README links. So links to files become
their names, with the path where the name does not tell it, and the picture is left out. With the
address of a public repository they could be whole links; there is none yet.
"""

import re
from pathlib import Path

from setuptools import setup

LINK = re.compile(r"\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()\s]+)\)")


def text_of(link: re.Match[str]) -> str:
    """Return a link as it is if it leads to the web, else its name and path."""
    name, target = link.groups()
    if "://" in target:
        return link[0]
    path = target.partition("#")[0]
    return name if "`" in name or name == path else f"{name} (`{path}`)"


def index_page(readme: str) -> str:
    """Return the README without picture, marks and links to files."""
    text = re.sub(r"^!\[.*\n\n|^<!-- .* -->\n", "", readme, flags=re.MULTILINE)
    return LINK.sub(text_of, text)


setup(
    long_description=index_page((Path(__file__).parent / "README.md").read_text(encoding="utf-8")),
    long_description_content_type="text/markdown",
)
