"""What the site has beyond docs/: pages from elsewhere in the repository, and the API from docstrings.

Links between pages are those of the repository, so they work on a code host too. Here they are turned into the site's.
A picture that stands alone gets its text as a caption, and opens in full size.
"""

from __future__ import annotations

import html
import importlib
import posixpath
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
ELSEWHERE = {
    "benchmarks/README.md": "figures.md",
    "benchmarks/plant/README.md": "plant.md",
    "CHANGELOG.md": "changes.md",
}
"""Pages outside docs/ and their places in the site."""
API = {
    "whill_mjx": ("Simulator", ()),
    "sysid": ("Identification", ()),
    "dreamer": ("Learner", ()),
    "bridge": ("ROS 2", ("bridge.ros_env.RosEnv", "bridge.episodes.EpisodeClient")),
}
"""Packages with the title of their page, and names that no `__all__` lists."""


def api_page(package: str) -> str:
    """Markdown that asks mkdocstrings for every public name of a package."""
    title, names = API[package]
    public = names or tuple(f"{package}.{name}" for name in importlib.import_module(package).__all__)
    entries = "\n".join(f"::: {defined_at(name)}" for name in public)
    return f"# `{package}`: {title.lower()}\n\nWhat each name is for is in [public names](../api.md).\n\n{entries}\n"


def defined_at(name: str) -> str:
    """Where a public name is defined, so that its docstring is found without running code."""
    package, _, attribute = name.rpartition(".")
    found = getattr(importlib.import_module(package), attribute)
    module = getattr(found, "__module__", package)
    return f"{module}.{attribute}" if hasattr(importlib.import_module(module), attribute) else name


def site_link(target: str, origin: str, page: str) -> str | None:
    """A link of a page at `origin` in the repository, as the site's `page` has it; None for what the site lacks."""
    path, mark, anchor = target.partition("#")
    if not path or "://" in path or path.startswith("mailto:"):
        return target
    place = posixpath.normpath(posixpath.join(posixpath.dirname(origin), path))
    if place in ELSEWHERE:
        inside = ELSEWHERE[place]
    elif place == "README.md":
        inside = "index.md"
    elif place.startswith("docs/"):
        inside = place.removeprefix("docs/")
    else:
        return None
    return posixpath.relpath(inside, posixpath.dirname(page) or ".") + mark + anchor


def captioned(match: re.Match[str]) -> str:
    """A figure of a picture that stands alone on its line; its text becomes the caption."""
    text, source = match[1], match[2]
    return (f'<figure markdown="1">\n[![{text}]({source})]({source})\n\n'
            f"<figcaption>{html.escape(text, quote=False)}</figcaption>\n</figure>")  # fmt: skip


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that docs/ does not have."""
    from mkdocs.structure.files import File

    for source, page in ELSEWHERE.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text(encoding="utf-8")))
    for package in API:
        files.append(File.generated(config, f"api/{package}.md", content=api_page(package)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Turn links of the repository into links of the site, and give pictures their captions."""
    here = page.file.src_uri
    origin = next((source for source, place in ELSEWHERE.items() if place == here), f"docs/{here}")

    def turned(match: re.Match[str]) -> str:
        link = site_link(match[2], origin, here)
        return f"`{match[1].strip('`')}`" if link is None else f"[{match[1]}]({link})"

    def text(part: str) -> str:
        linked = re.sub(r"\[([^\]]*)\]\(([^)\s]+)\)", turned, part)
        return re.sub(r"^!\[([^\]]*)\]\(([^)\s]+)\)$", captioned, linked, flags=re.MULTILINE)

    parts = re.split(r"(^```.*?^```)", markdown, flags=re.DOTALL | re.MULTILINE)
    return "".join(part if part.startswith("```") else text(part) for part in parts)
