"""Browser fixture for tests of pages; skipped without a browser."""

from __future__ import annotations

import shutil
from collections.abc import Iterator

import pytest

__all__ = ["browser", "browsing", "press", "until"]

BROWSER, DRIVER = (shutil.which(name) for name in ("chromium", "chromedriver"))
browsing = pytest.mark.skipif(
    not (BROWSER and DRIVER), reason="chromium and chromedriver are not installed: make browser-packages"
)


@pytest.fixture(scope="module")
def browser() -> Iterator:
    selenium = pytest.importorskip("selenium.webdriver")
    options = selenium.ChromeOptions()
    options.binary_location = BROWSER
    # WebGL without a graphics card.
    software = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
    for argument in ("--headless=new", "--no-sandbox", "--window-size=1300,900", *software):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = selenium.Chrome(options, selenium.ChromeService(DRIVER))
    driver.set_script_timeout(60)
    yield driver
    driver.quit()


def until(browser, script: str) -> None:
    """Wait until a condition in the page is true; selenium limits scripts to one minute."""
    wait = (
        "const done = arguments[0]; const look = () => (SCRIPT) ? done(true) : setTimeout(look, 30); look();"
    )
    assert browser.execute_async_script(wait.replace("SCRIPT", script))


def press(browser, selector: str) -> None:
    button = browser.find_element("css selector", selector)
    # Not only into view, where the bar at the top may cover it.
    browser.execute_script("arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})", button)
    button.click()
