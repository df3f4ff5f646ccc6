"""Makes README and metadata of a copy of the tree ready for a package index: `python index_readme.py TREE URL`.

A package index shows no file of the repository, so relative pictures and links of README get the address of the tagged
release at URL, such as https://github.com/OWNER/whill-mjx. The metadata gets the same address.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path


def absolute(text: str, url: str, tag: str) -> str:
    """README with pictures at URL/raw/TAG and links at URL/blob/TAG; code and whole addresses stay as they are."""

    def moved(match: re.Match[str]) -> str:
        mark, words, target = match.groups()
        if "://" in target or target.startswith("#"):
            return match[0]
        return f"{mark}[{words}]({url}/{'raw' if mark else 'blob'}/{tag}/{target})"

    parts = re.split(r"(^```.*?^```)", text, flags=re.DOTALL | re.MULTILINE)
    return "".join(
        part if part.startswith("```") else re.sub(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)", moved, part) for part in parts
    )


def with_urls(project: str, url: str) -> str:
    """pyproject.toml with the addresses of source, issues and changes."""
    urls = f'[project.urls]\nSource = "{url}"\nIssues = "{url}/issues"\nChanges = "{url}/blob/main/CHANGELOG.md"\n\n'
    before, mark, after = project.partition("[project.optional-dependencies]")
    return before + urls + mark + after


def main(tree: Path, url: str) -> None:
    """Change both files of the copy."""
    url = url.rstrip("/")
    version = re.search(r'__version__ = "(.*?)"', (tree / "whill_mjx" / "__init__.py").read_text())
    assert version, "whill_mjx/__init__.py has no version"
    readme, project = tree / "README.md", tree / "pyproject.toml"
    readme.write_text(absolute(readme.read_text(), url, f"v{version[1]}"))
    project.write_text(with_urls(project.read_text(), url))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
