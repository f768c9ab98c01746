"""A picture of a dashboard's page: ``python -m tests.browser.photograph ADDRESS FILE.png``, once it shows a range."""

from __future__ import annotations

import sys
import urllib.request

from tests.browser.support import opened_browser, texts, wait_for

SIZE = {"width": 800, "height": 480}
SHOWN = 500  # ms that the page has for its last transition


def answers(address: str) -> bool:
    """Whether somebody serves there by now."""
    try:
        return bool(urllib.request.urlopen(address, timeout=30).read())
    except OSError:
        return False


def main() -> None:
    """Wait for the page, and for a number on it."""
    address, file = sys.argv[1:]
    wait_for(lambda: answers(address), f"a page at {address}")
    with opened_browser() as context:
        page = context.new_page()
        page.set_viewport_size(SIZE)  # type: ignore[arg-type]
        page.goto(f"{address}?theme=day")
        wait_for(lambda: texts(page)["range-value"].replace(".", "").isdigit(), "a range on the page")
        page.wait_for_timeout(SHOWN)
        page.screenshot(path=file, full_page=True)


if __name__ == "__main__":
    main()
