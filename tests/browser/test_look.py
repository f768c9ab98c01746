"""How the page looks: sizes, languages, day and night, contrast; by keyboard and for those who do not see."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from gz_onboard.events import Reason, State
from tests.browser.support import plain, shows, texts
from tests.browser.test_page import UNREACHABLE
from tests.display.served import ESTIMATE, Sender, cells, dashboard, odometer, vehicle_frames
from tests.display.test_picture import CHARGING, HEALTHY
from tests.support import wait_for

SIZES = [(320, 240), (480, 320), (390, 844), (800, 480), (1280, 800)]


def test_miles_and_german_are_kept(page):
    with dashboard("mi") as address, Sender("mi", replace(ESTIMATE, state=State.VALID)):
        page.goto(address)
        shows(page, range_value="34")
        page.click("#unit")
        shows(
            page, range_value="21", interval="16 to 28 mi", recent="40", rated="besides the charge; rated range 36 mi"
        )
        page.click("#language")
        shows(page, interval="16 bis 28 mi", compared="5 % weniger als erwartet", trust_word="gültig")
        shows(page, soc_sigma="± 1,2", causes="Temperatur −2,1 mi\nStopps +1,0 mi")
        assert page.get_attribute("html", "lang") == "de"
        page.reload()
        shows(page, interval="16 bis 28 mi", activity="Fährt")


def ground(page: Any) -> str:
    return str(page.evaluate("getComputedStyle(document.body).backgroundColor"))


def test_day_and_night(page):
    white, black = "rgb(255, 255, 255)", "rgb(0, 0, 0)"
    with dashboard("night") as address:
        page.goto(address)
        assert ground(page) == white
        page.emulate_media(color_scheme="dark")  # as the system says, at once
        assert wait_for(lambda: ground(page) == black, "night")
        page.click("#theme")  # the switch, against the system
        assert texts(page)["theme"] == "Day"
        assert ground(page) == white
        page.reload()
        assert ground(page) == white
        page.click("#theme")
        page.emulate_media(color_scheme="light")
        assert ground(page) == black
        page.goto(f"{address}?theme=day")  # for this page alone
        assert ground(page) == white
        page.goto(address)
        assert ground(page) == black


@pytest.mark.parametrize("language", ["en", "de"])
@pytest.mark.parametrize(("width", "height"), SIZES)
def test_it_fits(page, width, height, language):
    """Nothing wider than the screen, whatever stands on it; the range and the charge without scrolling."""
    page.set_viewport_size({"width": width, "height": height})
    name = f"fit-{width}-{language}"
    own = [odometer(1112.4), cells(-8, 24, 57)]
    with dashboard(name, vehicle=vehicle_frames(1000.0)) as address, Sender(name, UNREACHABLE, own) as sender:
        page.goto(f"{address}?language={language}")
        far = replace(HEALTHY, range=412e3, range_p10=365e3, range_p90=466e3)
        for estimate, km in (UNREACHABLE, ("8.2", "8,2")), (CHARGING, ("34",)), (far, ("412",)):
            sender.estimate = estimate
            wait_for(lambda km=km: texts(page)["range-value"] in km, f"{km} km")  # type: ignore[misc]
            assert page.evaluate("document.documentElement.scrollWidth") == width
            outside = page.evaluate(
                """() => [...document.querySelectorAll("main *, header *, footer *")].filter((e) => {
                     const box = e.getBoundingClientRect(), card = e.closest("section, header, footer");
                     return box.width > 1 && box.right > card.getBoundingClientRect().right + 1;
                   }).map((e) => e.id || e.className)"""
            )
            assert outside == []
            for place in "#range-value", "#band", "#soc-value", "#trust":
                box = page.locator(place).bounding_box()
                assert box["y"] >= 0
                assert box["y"] + box["height"] <= height + (18 if place == "#band" else 0), place
            assert page.locator("#range-value").bounding_box()["height"] >= min(width, height) / 5


def test_speed_clock_and_trend(page):
    page.clock.set_fixed_time("2026-05-04T07:08:00")
    with (
        dashboard("small", vehicle=vehicle_frames(1000.0), trend=[41e3, 40e3, 38e3, 37e3]) as address,
        Sender("small", HEALTHY, km_h=38) as sender,
    ):
        page.goto(address)
        shows(page, speed="38 km/h", clock="07:08")
        page.click("#unit")
        shows(page, speed="24 mph")
        page.click("#unit")
        shows(page, range_value="34")
        label = plain(page.get_attribute("#trend svg", "aria-label"))
        assert label == "Range over the last ten minutes: 41 km, now 34 km."
        heights = [
            float(y)
            for y in page.get_attribute("#trend path", "d").replace("L", "M").split("M")[1:]
            for y in y.split()[1:]
        ]
        assert heights[-1] > heights[0]  # downwards
        sender.estimate = replace(HEALTHY, state=State.INVALID)
        wait_for(lambda: not page.is_visible("#trend"), "no trend without a range")


CONTRASTS = """() => {
  const luminance = (c) => c.slice(0, 3).map((v) => v / 255)
    .map((v) => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
  const colour = (text) => text.match(/[\\d.]+/g).map(Number);
  const ground = (e) => { for (; e; e = e.parentElement) { const c = colour(getComputedStyle(e).backgroundColor);
    if (c.length < 4 || c[3] > 0) return c; } return [255, 255, 255]; };
  return [...document.querySelectorAll("body *")].filter((e) => e.checkVisibility() &&
      [...e.childNodes].some((n) => n.nodeType === 3 && n.textContent.trim())).map((e) => {
    const [a, b] = [luminance(colour(getComputedStyle(e).color)), luminance(ground(e))].sort((x, y) => y - x);
    return [e.id || e.className || e.tagName, (a + 0.05) / (b + 0.05)];
  });
}"""


@pytest.mark.parametrize("theme", ["day", "night"])
def test_all_can_be_read_in_the_sun(page, theme):
    """Contrast of 4.5 at least, as WCAG AA asks, of all texts; 12 of the numbers."""
    with dashboard(theme) as address, Sender(theme, UNREACHABLE) as sender:
        page.goto(f"{address}?theme={theme}")
        for estimate in UNREACHABLE, HEALTHY, replace(HEALTHY, state=State.INVALID):
            sender.estimate = estimate
            shows(page, trust_word=estimate.state.name.lower())
            found = dict(page.evaluate(CONTRASTS))
            assert len(found) > 20
            assert {name: value for name, value in found.items() if value < 4.5} == {}
            assert min(found[name] for name in ("range-value", "interval", "soc-value", "recent")) > 12


# --- keyboard and screen reader -------------------------------------------------------------------------------------


def test_a_screen_reader_hears_changes_of_state_and_not_every_tick(page):
    with dashboard("reader") as address, Sender("reader", HEALTHY) as sender:
        page.goto(address)
        shows(page, announcer="Range valid. riding.")
        page.evaluate(
            """() => { window.said = []; new MutationObserver(() => said.push(announcer.textContent)).observe(
                 announcer, {childList: true, characterData: true, subtree: true}); }"""
        )
        assert page.locator("[aria-live]").count() == 1
        assert page.get_attribute("#announcer", "aria-live") == "polite"
        for km in 33, 32, 31:
            sender.estimate = replace(HEALTHY, range=km * 1000.0)
            shows(page, range_value=str(km))
        page.wait_for_timeout(2500)  # longer than what is read out must have held
        assert page.evaluate("said") == []
        sender.estimate = replace(HEALTHY, state=State.DEGRADED, reasons=Reason.NO_GPS)
        shows(page, announcer="Range degraded. Sensor lost: GPS.")
        assert page.evaluate("said.length") == 1
