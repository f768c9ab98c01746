"""One browser for the tests of a worker, one page for each."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from tests.browser.support import CHROMIUM, opened_browser

if TYPE_CHECKING:
    from playwright.sync_api import BrowserContext, Page


@pytest.fixture(scope="package")  # not longer: its event loop runs in this thread
def browser() -> Iterator[BrowserContext]:
    pytest.importorskip("playwright", reason="no Playwright: .ci/setup venv")
    if not CHROMIUM:
        pytest.skip("no chromium: .ci/setup browser")
    with opened_browser() as context:
        yield context


@pytest.fixture
def page(browser: BrowserContext) -> Iterator[Page]:
    """A new page; it fails on any error of a script, and on any request to elsewhere than this machine."""
    page = browser.new_page()
    wrong: list[str] = []
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on("request", lambda request: None if "//127.0.0.1:" in request.url else wrong.append(request.url))
    page.emulate_media(color_scheme="light")
    yield page
    page.close()
    assert wrong == []
