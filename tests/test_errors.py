"""What was meant by a name that is none."""

from __future__ import annotations

from pathlib import Path

import pytest

from gz_onboard.errors import near_file, nearest
from gz_onboard.events import ROLES


@pytest.mark.parametrize(
    ("name", "known", "meant"),
    [
        ("vehicle_sped", ROLES, "vehicle_speed"),
        ("Pack_Voltage", ROLES, "pack_voltage"),
        ("ECE15", ["r40", "ece15"], "ece15"),
        ("PackVoltage", ["BMS_PackVoltage", "Other"], "BMS_PackVoltage"),
        ("mass", ["drag_area", "vehicle_mass"], "vehicle_mass"),
        ("kalman", ["scalar", "filterpy"], None),
        ("c2", ["r0", "c1"], "c1"),
        ("", ["a"], None),
        ("x" * 10_000, ["x"], None),
    ],
)
def test_the_nearest_name_is_named_if_there_is_one(name, known, meant):
    assert nearest(name, known) == (f" (did you mean {meant!r}?)" if meant else "")


def test_the_nearest_file_is_named_for_one_that_is_not_there(tmp_path: Path):
    (tmp_path / "coastdown.blf").touch()
    assert near_file(tmp_path / "coastdwn.blf") == " (did you mean 'coastdown.blf'?)"
    assert near_file(tmp_path / "other.blf") == ""
    assert near_file(tmp_path / "coastdown.blf") == near_file(tmp_path / "nowhere" / "x") == ""
