"""Draw docs/images/dashboard-*.png from frames of a daemon: ``python -m tests.browser.screenshots``."""

from __future__ import annotations

import io
from dataclasses import replace
from math import sin

from gz_onboard.events import Activity, Estimate
from tests.browser.support import opened_browser, shows
from tests.browser.test_page import UNREACHABLE
from tests.display.served import ESTIMATE, Sender, cells, dashboard, odometer, vehicle_frames
from tests.display.test_picture import CHARGING, HEALTHY, ON_ROUTE
from tests.support import ROOT

COLOURS = 48  # the pictures have few
PICTURES: list[tuple[int, int, str, Estimate, str]] = [
    (320, 240, "day", HEALTHY, "en"),
    (320, 240, "night", UNREACHABLE, "en"),
    (390, 844, "day", ON_ROUTE, "en"),
    (390, 844, "night", replace(CHARGING, soc=0.624), "de"),
    (800, 480, "day", HEALTHY, "en"),
    (800, 480, "night", ESTIMATE, "en"),
    (1280, 800, "day", UNREACHABLE, "en"),
    (1280, 800, "night", ON_ROUTE, "en"),
]


def main() -> None:
    """Write them all."""
    from PIL import Image

    with opened_browser() as context:
        for width, height, theme, estimate, language in PICTURES:
            name = f"{width}x{height}-{theme}"
            page = context.new_page()
            page.set_viewport_size({"width": width, "height": height})
            own = [odometer(1012.4), cells(22, 24, 27)]
            page.clock.set_fixed_time("2026-05-04T14:05:00")
            now, word = estimate.range or 0.0, {"en": estimate.state.name.lower(), "de": "gültig"}[language]
            trend = [now + 90.0 * (60 - i) + 150.0 * sin(i / 4) for i in range(60)]
            speed = 0.0 if estimate.activity is Activity.CHARGING else 38.0
            with (
                dashboard("can0", vehicle=vehicle_frames(1000.0), trend=trend) as address,
                Sender("can0", HEALTHY, own, speed) as sender,
            ):
                page.goto(f"{address}?theme={theme}&language={language}")
                shows(page, soc_value="62")  # all sensors are there before one is lost
                sender.estimate = estimate
                shows(page, range_value="8.2" if estimate is UNREACHABLE else "34", trust_word=word)
                page.wait_for_timeout(1200)  # a range frame comes each second
                picture = Image.open(io.BytesIO(page.screenshot()))
            page.close()
            file = ROOT / "docs" / "images" / f"dashboard-{name}.png"
            picture.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(file, optimize=True)
            print(f"{file.name} {file.stat().st_size // 1000} kB")


if __name__ == "__main__":
    main()
