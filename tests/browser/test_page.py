"""The page in a real browser: what it shows of which frames, and what it does not."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from urllib.parse import urlsplit

import pytest

from gz_onboard.display.server import Feed, served
from gz_onboard.events import Reason, State
from tests.browser.support import alerts, numbers, plain, shows, texts
from tests.display.served import ESTIMATE, Sender, cells, dashboard, odometer, vehicle_frames
from tests.display.test_picture import HEALTHY, ON_ROUTE
from tests.support import wait_for

UNREACHABLE = replace(
    ON_ROUTE,
    state=State.DEGRADED,
    reasons=Reason.NO_GPS | Reason.SENSOR_DISTRUSTED,
    distrusted=("pack_current",),
    soc=0.12,
    energy_left=208 * 3600.0,
    consumption_recent=31.4 * 3.6,
    range=8200.0,
    range_p10=6100.0,
    range_p90=9900.0,
    arrival_soc=0.0,
    arrival_soc_p10=0.0,
    battery_ends_after=8300.0,
)


def test_everything_that_the_frames_say(page):
    with dashboard("all") as address, Sender("all", ESTIMATE):
        page.goto(address)
        shows(
            page,
            range_value="34",
            interval="27 to 44 km",
            soc_value="62",
            soc_sigma="± 1.2",
            energy="895 Wh left",
            recent="25",
            expected="26",
            compared="4 % less than expected",
            causes="temperature −3.4 km\nstops +1.6 km",
            rated="besides the charge; rated range 58 km",
            trust_word="degraded",
            activity="Riding",
            reasons="degraded because: no inertial unit, less than 3 km ridden",
            alerts="",
            charge="",
            route="",
        )
        assert plain(page.title()) == "34 km · gz-onboard"
        label = page.get_attribute("#band", "aria-label")
        assert plain(label) == "Range 34 km, between 27 km and 44 km with 80 % probability."
        scale = page.inner_text("#band .ticks").split("\n")
        assert scale[0] == "0"
        assert scale[-1] == "50"
        left, width, middle = page.evaluate(
            """() => [...document.querySelectorAll("#band .between, #band .middle")].flatMap(
                 (e) => [parseFloat(e.style.left), parseFloat(e.style.width)]).slice(0, 3)"""
        )
        assert left / 2 == pytest.approx(26.54, abs=0.01)
        assert (left + width) / 2 == pytest.approx(44.34, abs=0.01)
        assert middle / 2 == pytest.approx(34.21, abs=0.01)


def test_a_destination(page):
    with dashboard("route") as address, Sender("route", ON_ROUTE) as sender:
        page.goto(address)
        shows(page, route_left="18 km to go", route_arrival="31 % on arrival, 22 % in a bad case", alerts="")
        assert float(page.evaluate("parseFloat(document.querySelector('#band .goal').style.left)")) == pytest.approx(
            18.3 / 50 * 100, abs=0.1
        )
        sender.estimate = UNREACHABLE
        shows(page, route_arrival="battery empty in 8.3 km", range_value="8.2", interval="6.1 to 9.9 km")
        assert alerts(page) == [
            "Destination out of reach: battery empty in 8.3 km.",
            "Battery nearly empty: 12 %.",
            "Sensor lost: GPS, pack current.",
        ]
        shows(page, distrusted="sensors ignored: pack current")


def test_the_days_distance_and_the_cells(page):
    """What was ridden stands left of here, on one scale with what is left and the destination."""
    begun = vehicle_frames(1000.0)
    own = [odometer(1012.5), cells(22, 24, 27)]
    with dashboard("day", vehicle=begun) as address, Sender("day", ON_ROUTE, own) as sender:
        page.goto(address)
        shows(page, range_value="34", ridden="13 km ridden", cells="cells 22 to 27 °C", alerts="")
        assert plain(page.get_attribute("#band", "aria-label")).endswith("13 km ridden today.")
        assert page.inner_text("#band .ticks").split("\n") == ["−13", "0", "10", "20", "30", "40", "50"]
        behind, goal = page.evaluate(
            """() => [parseFloat(document.querySelector("#band .behind").style.width),
                      parseFloat(document.querySelector("#band .goal").style.left)]"""
        )
        assert behind == pytest.approx(12.5 / 62.5 * 100, abs=0.1)
        assert goal == pytest.approx((12.5 + 18.3) / 62.5 * 100, abs=0.1)
        sender.own = [cells(22, 40, 52)]
        shows(page, alerts="Battery cell too hot: 52 °C.", cells="cells 22 to 52 °C")
        shows(page, ridden="")
        assert page.is_hidden("#band .behind")
        sender.own = [cells(-8, -7, -7)]
        shows(page, alerts="Battery cell too cold: −8 °C.", cells="cells −8 to −7 °C")
        page.click("#language")
        shows(page, alerts="Batteriezelle zu kalt: −8 °C.", cells="Zellen −8 bis −7 °C")


def test_a_silent_bus_and_a_daemon_that_is_started_anew(page):
    with dashboard("quiet") as address:
        page.goto(address)
        shows(page, alerts="Waiting for the range estimator on quiet (range.dbc).")
        assert numbers(page) == []
        with Sender("quiet", HEALTHY):
            shows(page, range_value="34", soc_value="62", alerts="")
        shows(page, soc_value="–", range_value="34", alerts="Some values are no longer updated.")
        assert "no update from:" in texts(page)["missing"]
        shows(page, trust_word="unknown", energy="895 Wh left", range_value="34")
        shows(page, range_value="–", alerts="Range estimator stopped responding.")
        assert numbers(page) == []
        assert page.is_hidden("#band .between")
        with Sender("quiet", replace(HEALTHY, range=31_000.0)):
            shows(page, range_value="31", soc_value="62", alerts="", missing="")


def test_a_server_with_another_page_is_loaded_anew(page, monkeypatch):
    with Sender("new", HEALTHY):
        with dashboard("new") as address:
            page.goto(address)
            shows(page, range_value="34")
            page.evaluate("window.same = true")
        monkeypatch.setattr("gz_onboard.display.server.__version__", "another")
        with ExitStack() as stack:
            with page.expect_event("load"):
                stack.enter_context(dashboard("new", urlsplit(address).netloc))
            shows(page, range_value="34")
            assert not page.evaluate("window.same")


def test_a_server_that_hangs(page):
    """Its connection stands, and nothing comes: the last numbers do not stay."""
    feed = Feed()
    with dashboard("hang") as other, Sender("hang", HEALTHY), served(feed, "127.0.0.1:0") as address:
        page.goto(other)
        shows(page, range_value="34")
        data = page.evaluate("fetch('api/latest').then((r) => r.text())")
        page.goto(address)
        feed.publish(data.encode())
        shows(page, range_value="34")
        shows(page, range_value="–", alerts="Dashboard sends no data. Trying again.")
        assert numbers(page) == []

        # It is asked again, and what it sends then is shown.
        def back() -> bool:
            feed.publish(data.encode())
            return texts(page)["range-value"] == "34"

        wait_for(back, "the range back")
