"""Metadata that name the repository's address, which is written once: in the README's ``pip install``."""

import re
from pathlib import Path

from setuptools import setup

README = Path("README.md").read_text(encoding="utf-8")
(ADDRESS,) = re.findall(r'git\+(https://[^"\s]+)', README)


def absolute(link: re.Match[str]) -> str:
    """Let a link of the README lead to the repository, for readers of a package index."""
    kind = "raw" if Path(link[1]).suffix in {".gif", ".png", ".svg"} else "blob"
    return f"]({ADDRESS}/{kind}/main/{link[1]})"


setup(
    long_description=re.sub(r"\]\((?!https?:|#)([^)]+)\)", absolute, README),
    project_urls={"Repository": ADDRESS, "Changelog": f"{ADDRESS}/blob/main/CHANGELOG.md"},
)
