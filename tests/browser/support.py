"""A real browser without a screen, and what is to be seen on the dashboard's page."""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from tests.support import wait_for

if TYPE_CHECKING:
    from playwright.sync_api import BrowserContext, Page

CHROMIUM = shutil.which("chromium") or ""
FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
LONG = 60.0  # s: no wait is as long, on whatever machine


@contextmanager
def opened_browser() -> Iterator[BrowserContext]:
    """Debian's Chromium with an empty profile."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as profile:
        context = playwright.chromium.launch_persistent_context(
            profile, executable_path=CHROMIUM, headless=True, args=FLAGS, timeout=LONG * 1000, locale="en-GB"
        )
        context.set_default_timeout(LONG * 1000)
        yield context
        context.close()


TEXTS = """() => Object.fromEntries([...document.querySelectorAll("[id]")].map(
  (e) => [e.id, e.checkVisibility() ? e.innerText.trim() : ""]))"""


def texts(page: Page) -> dict[str, str]:
    """What stands on the page at one moment, by the id of its place."""
    return {place: plain(text) for place, text in page.evaluate(TEXTS).items()}


def plain(text: str) -> str:
    """With spaces where the page has such as end no line."""
    return text.replace("\u00a0", " ")


def shows(page: Page, **wanted: str) -> None:
    """Wait until the page shows these texts at these places, all at one moment."""
    seen: dict[str, str] = {}

    def all_there() -> bool:
        seen.update(texts(page))
        return all(seen.get(place.replace("_", "-")) == text for place, text in wanted.items())

    try:
        wait_for(all_there, str(wanted))
    except AssertionError as error:
        found = {place: seen.get(place.replace("_", "-")) for place in wanted}
        raise AssertionError(f"{found} instead of {wanted}") from error


def alerts(page: Page) -> list[str]:
    """Those that stand on the page."""
    return [line for line in texts(page)["alerts"].splitlines() if line]


def numbers(page: Page) -> list[str]:
    """Every number in what the page says of the vehicle, and in its title."""
    shown = page.inner_text("main") + page.title() + (page.get_attribute("#band", "aria-label") or "")
    return re.findall(r"\d[\d.,]*", shown)
