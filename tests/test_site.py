"""The site of the documentation: built, and read as files in a real browser."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from browsing import browsing, until

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.skipif(find_spec("properdocs") is None, reason="the tools of the docs are not installed"),
]

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "properdocs", "build", "--strict", "-f", "mkdocs.yml", "-d", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder


def test_roles_are_links(site: Path) -> None:
    pages = {path: path.read_text(encoding="utf-8") for path in site.rglob("*.html")}
    roles = {
        path.name for path, text in pages.items() if re.search(r":(meth|func|class|attr|mod|data):", text)
    }
    assert pages and roles == set()


@browsing
def test_search_works_from_files(browser, site: Path) -> None:
    browser.get((site / "reports.html").as_uri())
    browser.get_log("browser")
    until(browser, "document.querySelector('.md-search__input')")
    browser.execute_script(
        "const field = document.querySelector('.md-search__input'); field.focus();"
        "field.value = 'interquartile'; field.dispatchEvent(new Event('keyup'))"
    )
    until(browser, "document.querySelector('.md-search-result__item')")
    assert "Statistics of reports" in browser.execute_script(
        "return document.querySelector('.md-search-result__item').textContent"
    )
    assert browser.get_log("browser") == []


@browsing
def test_code_fits_its_column_and_pages_lead_on(browser, site: Path) -> None:
    for page in ("index.html", "reports.html", "sweeps.html"):
        browser.get((site / page).as_uri())
        wide = "filter((code) => code.scrollWidth > code.clientWidth + 1).length"
        script = f"return [...document.querySelectorAll('pre > code')].{wide}"
        assert browser.execute_script(script) == 0
    assert browser.find_elements("css selector", ".md-footer__link--prev, .md-footer__link--next")
    assert browser.execute_script("return document.querySelector('.md-logo img').naturalWidth") > 0
