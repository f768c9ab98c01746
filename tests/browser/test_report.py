"""The page of a ride in Chromium says what the estimates say, on phone and desktop, and is self-contained."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import gz_onboard as gz
from gz_onboard.api import EstimatedRide
from gz_onboard.cli import main
from tests.support import LOGS

if TYPE_CHECKING:
    from playwright.sync_api import BrowserContext, Page

SECONDS = 50  # of the ride


@pytest.fixture(scope="module")
def ride(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first part of a recorded ride."""
    log = tmp_path_factory.mktemp("report") / "part of <a> ride.blf"
    assert main(["export", str(LOGS / "city_34C.blf"), str(log), "--to", str(SECONDS)]) == 0
    return log


@pytest.fixture(scope="module")
def estimated(ride: Path) -> EstimatedRide:
    return gz.estimate(ride)


@pytest.fixture(scope="module")
def file(ride: Path) -> Path:
    """Its page."""
    made = ride.with_name("ride.html")
    assert main(["report", str(ride), "-o", str(made), "--quiet"]) == 0
    return made


@pytest.fixture
def shown(browser: BrowserContext, file: Path) -> Iterator[Page]:
    """The page as a phone shows it; fails on any request beside that for the file."""
    page = browser.new_page()
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.set_viewport_size({"width": 390, "height": 844})
    page.emulate_media(color_scheme="light")
    page.goto(file.as_uri())
    yield page
    page.close()
    assert asked == [file.as_uri()]


def text(page: Page, of: str) -> str:
    return page.inner_text(f"[data-of={of}]").replace("\u00a0", " ")


def table(page: Page, of: str) -> dict[str, list[str]]:
    """The cells of each row, by the first."""
    rows = page.eval_on_selector_all(
        f"[data-of={of}] tr", "rows => rows.map(row => [...row.cells].map(cell => cell.innerText.trim()))"
    )
    return {row[0]: row[1:] for row in rows}


def test_the_page_says_what_the_estimates_say(shown: Page, estimated: EstimatedRide):
    s, rows = estimated.summary, [row for row in estimated.estimates.rows if row["range"] is not None]
    assert s.energy_wh is not None
    assert s.consumption_wh_km is not None
    assert text(shown, "distance") == f"{s.distance_km:.2f} km"
    assert text(shown, "energy") == f"{s.energy_wh:.0f} Wh"
    assert text(shown, "consumption") == f"{s.consumption_wh_km:.1f} Wh/km"
    assert text(shown, "soc") == f"{100 * (s.soc_start or 0):.1f} → {100 * (s.soc_end or 0):.1f} %"
    assert text(shown, "range") == f"{s.range_end_km:.1f} km"
    said = re.findall(r"(\d+\.\d) km \((\d+\.\d) to (\d+\.\d)\)", text(shown, "forecast"))
    names = ("range", "range_p10", "range_p90")
    assert said == [tuple(f"{1e-3 * float(str(row[n])):.1f}" for n in names) for row in (rows[0], rows[-1])]
    assert "part of <a> ride" in shown.inner_text("h2")
    assert str(s.frames) in shown.inner_text(".summary")


def test_the_causes_lead_from_the_rated_range_to_the_range(shown: Page, estimated: EstimatedRide):
    why, told = estimated.summary.why, {n: float(cells[1]) for n, cells in table(shown, "why").items()}
    assert why is not None
    rated, left = told.pop("rated range"), told.pop("range")
    assert (rated, left) == (round(why.reference_km, 1), round(why.range_km, 1))
    assert told["charge"] == round(why.causes_km["charge"], 1)
    assert rated + sum(told.values()) == pytest.approx(left, abs=0.06 * (len(why.causes_km) + 1))


def test_nothing_in_it_can_be_fetched(file: Path):
    assert not re.search(r"""<(script|link|img|iframe)|\b(src|href)=(?!["']?#)|url\((?!#)|@import""", file.read_text())
