"""Hooks of the site: links to objects, notebooks and task files, and formulas as MathML."""

from __future__ import annotations

import re
from html import unescape
from typing import Any

from latex2mathml.converter import convert

_ROLE = re.compile(r":(?:attr|class|data|exc|func|meth|mod):<code>~?([\w.]+)</code>")

_NOTEBOOK = re.compile(r"\]\(\.\./examples/notebooks/(\w+)\.ipynb")
_TASK = re.compile(r"\]\(\.\./conf/task/(\w+)\.yaml")

_FORMULA = re.compile(r'<(div|span) class="arithmatex">\\[\[(](.*?)\\[\])]</\1>', re.DOTALL)
"""A formula as pymdownx.arithmatex leaves it in HTML."""


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Point links to notebooks and task files to the pages that tools/docs_pages.py makes of them."""
    markdown = _TASK.sub(r"](tasks/\1.md", markdown)
    return _NOTEBOOK.sub(r"](notebooks/\1.md", markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Convert roles, such as :func:`plab.config.load_config`, to links, and LaTeX formulas to MathML."""
    return _FORMULA.sub(_mathml, _ROLE.sub(_link, html))


def _mathml(formula: re.Match[str]) -> str:
    if formula[1] == "span":
        return convert(unescape(formula[2]))
    return f'<div class="formula">{convert(unescape(formula[2]), display="block")}</div>'


def _link(role: re.Match[str]) -> str:
    name = role[1]
    text = f"<code>{name.rpartition('.')[2]}</code>"
    return f'<autoref optional identifier="{name}">{text}</autoref>' if "." in name else text
