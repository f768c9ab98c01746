"""Drive cycles: the regulations' figures, files of one's own, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from gz_onboard.errors import InputError
from gz_onboard.simulation.cycles import NAMES, Cycle, cycle, find_cycle, read_cycle


def distance_of(ridden: Cycle) -> float:
    """[m], the speed being linear between samples."""
    return float(np.trapezoid(ridden.speed, ridden.time))


# Published: duration [s], distance [km], highest speed [km/h].
PUBLISHED = {
    "ece15": (195, 0.994, 50.0),
    "r40": (1170, 6 * 0.994, 50.0),
    "udds": (1369, 11.99, 91.25),
    "wmtc_part1": (600, 4.065, 60.0),
    "wmtc_part1_reduced": (600, 3.944, 50.0),
    "wmtc_part2": (600, 9.111, 94.9),
    "wmtc_part3": (600, 15.736, 125.3),
    "wmtc_class1": (1200, 2 * 3.944, 50.0),
    "wmtc_class1_3": (1200, 2 * 4.065, 60.0),
    "wmtc_class2_2": (1200, 4.065 + 9.111, 94.9),
    "wmtc_class3_2": (1800, 4.065 + 9.111 + 15.736, 125.3),
}


@pytest.mark.parametrize("name", NAMES)
def test_duration_distance_and_top_speed_are_those_published(name):
    ridden, (duration, distance, top) = cycle(name), PUBLISHED[name]
    assert ridden.name == name
    assert ridden.time == tuple(range(duration + 1))
    assert len(ridden.speed) == len(ridden.time)
    assert ridden.duration == duration
    assert distance_of(ridden) == pytest.approx(1000 * distance, abs=1 + 0.0003 * 1000 * distance)
    assert max(ridden.speed) * 3.6 == pytest.approx(top, abs=0.01)
    assert ridden.speed[0] == ridden.speed[-1] == 0.0


def test_single_seconds_stand_where_the_regulation_has_them():
    part1 = cycle("wmtc_part1")
    assert [round(3.6 * v, 1) for v in part1.speed[20:26]] == [0.0, 0.0, 1.0, 2.6, 4.8, 7.2]
    assert [round(v / 0.44704, 1) for v in cycle("udds").speed[20:25]] == [0.0, 3.0, 5.9, 8.6, 11.5]
    assert [round(3.6 * v, 2) for v in cycle("ece15").speed[10:16]] == [0.0, 0.0, 3.75, 7.5, 11.25, 15.0]


def test_a_cycle_that_ends_at_another_speed_is_not_repeated():
    with pytest.raises(InputError, match=r"begins at 0\.00 m/s, the one before ends at 5\.00 m/s"):
        Cycle("ramp", (0.0, 1.0), (0.0, 5.0)).check_closed()


def write(folder: Path, text: str) -> Path:
    file = folder / "mine.csv"
    file.write_text(text, encoding="utf-8")
    return file


@pytest.mark.parametrize(("unit", "factor"), [("mps", 1.0), ("kmh", 1 / 3.6), ("mph", 0.44704)])
def test_own_cycle_in_each_unit(tmp_path, unit, factor):
    mine = read_cycle(write(tmp_path, f"time_s, speed_{unit}\n10.0,0\n10.5,3\n\n11.0,4.5\n"))
    assert mine.name == "mine"
    assert mine.time == (0.0, 0.5, 1.0)
    assert mine.speed == pytest.approx((0.0, 3 * factor, 4.5 * factor))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"mine\.csv: is empty"),
        ("time_s,speed_kmh\n0,0\n", r"mine\.csv: has 1 rows .* at least 2"),
        ("time_s,speed_kph\n0,0\n1,1\n", r"mine\.csv:1: unknown column 'speed_kph' \(did you mean 'speed_kmh'\?\)"),
        ("time_s,speed_km/h\n0,0\n1,1\n", r"'speed_km/h' \(did you mean 'speed_kmh'\?\)"),
        ("time_s,speed_m/s\n0,0\n1,1\n", r"'speed_m/s' \(did you mean 'speed_mps'\?\)"),
        ("time_s,speed_kmh,speed_kmh\n0,0,0\n1,1,1\n", r":1: column 'speed_kmh' is there twice"),
        ("time_s\n0\n1\n", "must have one of the columns speed_mps, speed_kmh, speed_mph, has none"),
        ("time_s,speed_kmh,speed_mph\n0,0,0\n1,1,1\n", "has speed_kmh and speed_mph"),
        ("speed_kmh\n0\n1\n", "column time_s is missing"),
        ("time_s,speed_kmh\n0,0\n1\n", r":3: has 1 fields, the header has 2"),
        ("time_s,speed_kmh\n0,0\n1,fast\n", r":3: speed_kmh: 'fast' is not a number"),
        ("time_s,speed_kmh\n0,0\n1,nan\n", r":3: speed_kmh: must be a finite number, is 'nan'"),
        ("time_s,speed_kmh\n0,0\ninf,3\n", r":3: time_s: must be a finite number, is 'inf'"),
        ("time_s,speed_kmh\n0,0\n1,-3\n", r":3: speed_kmh: -3 kmh is outside 0 to 360 kmh"),
        ("time_s,speed_mps\n0,0\n1,120\n", r":3: speed_mps: 120 mps is outside 0 to 100 mps"),
        ("time_s,speed_kmh\n0,0\n1,1\n1,2\n", r":4: time_s: 1 s does not increase \(before: 1\)"),
        ("time_s,speed_kmh\n0,0\n2,1\n1,2\n", r":4: time_s: 1 s does not increase \(before: 2\)"),
        ("time_s,speed_kmh\n0,0\n1,1\n\n4,2\n5,2\n", r":5: time_s: gap from 1 s to 4 s, other steps are 1 s; resample"),
        ("time_s,speed_kmh\n0,0\n1.5,1\n2.5,2\n", r":3: time_s: gap from 0 s to 1\.5 s"),
    ],
)
def test_own_cycle_refused(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        read_cycle(write(tmp_path, text))


def test_file_that_is_no_text_or_not_there(tmp_path):
    (tmp_path / "mine.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match=r"mine\.csv: not a CSV file"):
        read_cycle(tmp_path / "mine.csv")
    with pytest.raises(InputError, match=r"none\.csv: cannot be read: No such file"):
        find_cycle(str(tmp_path / "none.csv"))
    with pytest.raises(InputError, match="is a folder; give the file in it"):
        find_cycle(str(tmp_path))


def test_finding_by_name_or_file(tmp_path):
    assert find_cycle("udds") is cycle("udds")
    assert find_cycle(str(write(tmp_path, "time_s,speed_mps\n0,0\n1,1\n"))).speed == (0.0, 1.0)
    for find in (find_cycle, cycle):
        with pytest.raises(InputError, match=r"did you mean 'wmtc_part1'\?"):
            find("wmtc_prt1")
