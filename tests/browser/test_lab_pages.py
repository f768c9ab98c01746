"""The pages of discovery and calibration in Chromium: for phone and desktop, day and night, with nothing cut off."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from gz_onboard.calibration.report import write_report
from gz_onboard.calibration.result import Panel, PlotLine, Result
from gz_onboard.reports.page import drawn, html_table, tiles, write_page
from gz_onboard.reports.style import new_figure

if TYPE_CHECKING:
    from playwright.sync_api import BrowserContext

GROUNDS = {"light": "rgb(255, 255, 255)", "dark": "rgb(18, 24, 31)"}
SIZES = [(390, 844), (844, 390), (800, 480), (1280, 800)]
X = np.linspace(0.0, 60.0, 3000)


def calibration(file: Path) -> None:
    lines = PlotLine("measured", X, np.sin(X), "."), PlotLine("model", X, np.cos(X))
    one = [Panel(f"panel {i}", "time [s]", "temperature [degC]", lines) for i in range(2)]
    write_report(file, "Calibration of reference-scooter", [Result("pulse", panels=one, notes=["a note " * 40])])


def discovery(file: Path) -> None:
    figure = new_figure(12.5, 4.0)
    figure.add_subplot().plot(X, np.sin(X))
    table = html_table([f"of the energy {i}" for i in range(9)], [["+0.1%"] * 9])
    picture = f'<div class="scroll">{drawn(figure, "overview")}</div>'
    cards = tiles([("rides", "4", "rides"), ("distance", "31.9 km", "ridden")])
    write_page(file, "reference-scooter: none", [cards, table, picture])


@pytest.mark.parametrize("make", [calibration, discovery])
def test_it_fits_phone_and_desktop_day_and_night(browser: BrowserContext, tmp_path, make):
    file = tmp_path / "page.html"
    make(file)
    page = browser.new_page()
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url.partition(",")[0]))
    for scheme, ground in GROUNDS.items():
        page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
        for width, height in SIZES:
            page.set_viewport_size({"width": width, "height": height})
            page.goto(file.as_uri())
            assert page.evaluate("document.documentElement.scrollWidth") == width
            assert page.evaluate("getComputedStyle(document.body).backgroundColor") == ground
            assert page.evaluate("[...document.querySelectorAll('.drawn')].every((e) => e.clientWidth > 300)")
            scrolled = (
                "[...document.querySelectorAll('table, .drawn')].filter((e) => !e.closest('.scroll') && "
                "e.getBoundingClientRect().right > innerWidth).length"
            )
            assert page.evaluate(scrolled) == 0
    page.close()
    assert {url for url in asked if not url.startswith("data:")} == {file.as_uri()}
