"""Roles, such as :func:`plab.config.load_config`, and links to notebooks, as links of the site."""

from __future__ import annotations

import re
from typing import Any

_ROLE = re.compile(r":(?:attr|class|data|exc|func|meth|mod):<code>~?([\w.]+)</code>")

_NOTEBOOK = re.compile(r"\]\(\.\./examples/notebooks/(\w+)\.ipynb")


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Let links to notebooks lead to the pages that tools/docs_pages.py makes of them."""
    return _NOTEBOOK.sub(r"](notebooks/\1.md", markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Make each role the name that it stands for, linked where the site has a place for it."""
    return _ROLE.sub(_link, html)


def _link(role: re.Match[str]) -> str:
    name = role[1]
    text = f"<code>{name.rpartition('.')[2]}</code>"
    return f'<autoref optional identifier="{name}">{text}</autoref>' if "." in name else text
