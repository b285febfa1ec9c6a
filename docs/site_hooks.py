"""Hooks of the documentation site (mkdocs.yml): README.md is its first page, and files
outside docs/ are only named.
"""

from __future__ import annotations

import logging
import os
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
DOCS = ROOT / "docs"

LINK = re.compile(r"\[([^\]]*)\]\((?![a-z]+:|#)([^)#\s]+)(#[^)\s]*)?\)")
"""A link to a file: its text, its path, its heading."""

log = logging.getLogger("mkdocs.hooks")


def on_files(files: Files, config: Any) -> Files:
    """Add README.md as index.md."""
    files.append(
        File.generated(config, "index.md", content=README.read_text(encoding="utf-8"))
    )
    return files


def on_page_markdown(markdown: str, page: Page, config: Any, files: Files) -> str:
    """Make links that lead through README.md or out of docs/ fit the site: the latter
    become plain names.
    """
    source = DOCS / page.file.src_uri
    folder = ROOT if source == DOCS / "index.md" else source.parent

    def fitted(link: re.Match[str]) -> str:
        text, path, heading = link.groups()
        target = (folder / path).resolve()
        if not target.exists():
            log.warning(
                "%s: %s leads to no file of the repository", page.file.src_uri, link[0]
            )
        if target == README:
            target = DOCS / "index.md"
        if not target.is_relative_to(DOCS):
            return text
        return f"[{text}]({os.path.relpath(target, source.parent)}{heading or ''})"

    return LINK.sub(fitted, markdown)
