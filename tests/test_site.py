"""Site of the documentation: built strictly, and read as files in a real browser."""

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
    pages = {path.name: path.read_text(encoding="utf-8") for path in site.rglob("*.html")}
    role = re.compile(r":(meth|func|class|attr|mod|data):")
    assert pages and [name for name, text in pages.items() if role.search(text)] == []


@browsing
def test_search_works_from_files(browser, site: Path) -> None:
    browser.get((site / "reports.html").as_uri())
    browser.get_log("browser")
    until(browser, "document.querySelector('.md-search__input')")
    browser.execute_script(
        "const field = document.querySelector('.md-search__input'); field.focus();"
        "field.value = 'interquartile'; field.dispatchEvent(new Event('keyup'))"
    )
    result = "document.querySelector('.md-search-result__item')"
    until(browser, result)
    assert "Statistics of reports" in browser.execute_script(f"return {result}.textContent")
    assert browser.get_log("browser") == []
