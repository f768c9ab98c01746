"""The riding expected before there has been any: what a vehicle file may say of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from gz_onboard.errors import InputError
from gz_onboard.vehicle import OWN, Vehicle, read_vehicle

REFERENCE = (OWN / "reference.toml").read_text(encoding="utf-8")
FORECAST = REFERENCE[REFERENCE.index("[forecast]") :].partition("\n\n")[0]


def with_riding(folder: Path, rows: str, effects: str = "") -> Vehicle:
    file = folder / "v.toml"
    text = REFERENCE.replace(FORECAST, f"[forecast]\nriding = {rows}\n")
    file.write_text(text.replace("effects = [", f"effects = [{effects}"), encoding="utf-8")
    return read_vehicle(str(file))


# Slowing down all the time gives energy back: the range was -300 km.
@pytest.mark.parametrize("rows", ["[[1.0, 10.0, -1.5]]", "[[0.2, 10.0, 0.0], [0.8, 8.0, -1.0]]"])
def test_a_riding_that_gives_energy_is_refused(tmp_path, rows):
    told = r"v\.toml:\d+: forecast\.riding: .* costs -[\d.]+ Wh/km .*acceleration is -[\d.]+"
    with pytest.raises(InputError, match=told):
        with_riding(tmp_path, rows)


@pytest.mark.parametrize("effects", ["", '"cornering_drag", "headwind", "tyre_warm_up", "ocv_hysteresis", '])
def test_one_that_costs_energy_is_taken(tmp_path, effects):
    assert with_riding(tmp_path, "[[0.5, 10.0, 0.5], [0.5, 8.0, -0.5]]", effects).riding.speed == 9.0
