"""Page templates, with a common head and navigation bar in ``web/base.html``."""

from __future__ import annotations

from importlib.resources import files
from typing import Any

from jinja2 import Environment, FunctionLoader, StrictUndefined

_OWN = "plab.report"


def asset(name: str, package: str = _OWN) -> str:
    """Return a file of a package's folder ``web``."""
    return (files(package) / "web" / name).read_text(encoding="utf-8")


def render(template: str, package: str = _OWN, **values: Any) -> str:
    """Return a page.

    Args:
        template: Template that extends ``base.html``.
        package: Package with the template in its folder ``web``.
        **values: Variables of the template.
    """

    def load(file: str) -> str:
        return asset(file, package if file == template else _OWN)

    environment = Environment(autoescape=True, undefined=StrictUndefined, loader=FunctionLoader(load))
    return environment.get_template(template).render(**values)
