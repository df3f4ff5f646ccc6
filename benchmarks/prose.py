"""Sentences of a page, without code, tables, pictures and comments."""

from __future__ import annotations

import re


def prose(text: str) -> list[str]:
    """Paragraphs, headings and list items of a page, without code, tables, pictures and comments."""
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r"^```.*?^```", "\n", text, flags=re.DOTALL | re.MULTILINE)
    blocks: list[str] = []
    begin, listed = True, False
    for line in text.splitlines():
        item = re.match(r"\s*(?:[-*]|\d+\.) +", line)
        if not line.strip():
            begin = True
        elif line.startswith("|") or (begin and not listed and not item and re.match(r" {4}", line)):
            continue  # a table, or code that is indented
        elif line.startswith("#"):
            blocks.append(line.lstrip("# "))
            begin, listed = True, False
        elif item:
            blocks.append(line[item.end() :])
            begin, listed = False, True
        elif begin:
            blocks.append(line.strip())
            begin, listed = False, line.startswith(" ") and listed
        else:
            blocks[-1] += " " + line.strip()
    return blocks


def sentences(text: str) -> list[str]:
    """Sentences of a page; each ends by . ! ? : or ; before a space."""
    found = []
    for block in prose(text):
        block = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", block)
        block = re.sub(r"`[^`]*`", "code", block)
        found += [part.strip() for part in re.split(r"(?<=[.!?:;])[)*_\"]*\s+", block) if part.strip()]
    return found
