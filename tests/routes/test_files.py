"""Route files: GPX and CSV, and what of them is refused."""

from __future__ import annotations

import csv
import gzip

import pytest

from gz_onboard.errors import InputError
from gz_onboard.routes.columns import MAX_BYTES
from gz_onboard.routes.route import CONFIG, read_route, read_route_columns, speed_profile

HEAD = '<?xml version="1.0"?>\n<gpx xmlns="http://www.topografix.com/GPX/1/1">\n'


def gpx(folder, points, kind="trkpt"):
    """A GPX of (latitude, longitude, altitude or None), a point each line from the third on."""
    around = ("<trk><trkseg>", "</trkseg></trk>") if kind == "trkpt" else ("<rte>", "</rte>")
    lines = [f'<{kind} lat="{y}" lon="{x}">{"" if z is None else f"<ele> {z} </ele>"}</{kind}>' for y, x, z in points]
    file = folder / "way.gpx"
    file.write_text(HEAD + around[0] + "\n".join(lines) + around[1] + "</gpx>\n", encoding="utf-8")
    return file


@pytest.mark.parametrize("kind", ["trkpt", "rtept"])
def test_a_gpx_is_read(tmp_path, kind):
    points = [(47.0 + 0.0002 * i, 8.0, 400.0 + 0.5 * i) for i in range(40)]
    route = read_route(gpx(tmp_path, points, kind))
    assert (route.name, route.grade_known) == ("way", True)
    assert route.length == pytest.approx(39 * 22.236, rel=1e-3)
    assert route.grade == pytest.approx([0.5 / 22.236] * 40, rel=1e-2)
    assert route.latitude[5] == pytest.approx(47.001)


def test_without_most_altitudes_it_is_level_and_says_so(tmp_path):
    points = [(47.0 + 0.0002 * i, 8.0, None if i % 2 else 400.0 + i) for i in range(40)]
    route = read_route(gpx(tmp_path, points))
    assert not route.grade_known
    assert set(route.grade) == {0.0}


@pytest.mark.parametrize("held", [None, 0.0, -9999.0])
@pytest.mark.parametrize("rows", [[0], [7], [39], [3, 20], [0, 1, 2], [19, 20, 21], list(range(12, 30))])
def test_missing_heights_are_filled_with_a_warning(tmp_path, caplog, held, rows):
    """A height of 0 is a missing one, too, unless others are near sea level."""
    points = [(47.0 + 0.0002 * i, 8.0, held if i in rows else 142.0 + 0.5 * i) for i in range(40)]
    file = gpx(tmp_path, points)
    columns, route = read_route_columns(file), read_route(file)
    assert route.grade_known
    assert route.grade == pytest.approx([0.5 / 22.236] * 40, abs=0.008)
    assert columns.values["altitude_m"][19] == pytest.approx(151.5, abs=2)
    assert f"way.gpx: point {rows[0] + 1}: {len(rows)} of 40 heights are missing" in caplog.text


PART = [(47.0 + 0.0002 * i, 8.0, 400.0) for i in range(20)]
AROUND = {"tracks": "</trkseg></trk><trk><trkseg>", "segments": "</trkseg><trkseg>", "routes": "</rte><rte>"}


def in_two(folder, first, second, around):
    """A GPX of two parts."""
    kind = "rtept" if around == "routes" else "trkpt"
    file = gpx(folder, [*first, *second], kind)
    lines = file.read_text().splitlines()
    lines[2 + len(first)] = AROUND[around] + lines[2 + len(first)]
    file.write_text("\n".join(lines))
    return file


@pytest.mark.parametrize("around", AROUND)
def test_parts_that_do_not_join_are_refused(tmp_path, around):
    away = [(y + 0.03, x, z) for y, x, z in PART]
    told = r"way\.gpx: point 21: has 2 tracks or segments, which do not join: 2\.9 km lie before this one"
    with pytest.raises(InputError, match=told):
        read_route(in_two(tmp_path, PART, away, around))


def test_stops_and_winds_of_a_csv(tmp_path):
    rows = "".join(f"{20 * i},{30 if i == 10 else 0},3\n" for i in range(20))
    file = tmp_path / "way.route.csv"
    file.write_text("distance_m,stop_s,headwind_mps\n" + rows)
    route = read_route(file)
    assert (route.stop[10], route.headwind[3]) == (30.0, 3.0)
    speed = dict(zip(*speed_profile(route, top_speed=12.0), strict=True))
    assert speed[200.0] == 0.0
    assert speed[190.0] > 3.0


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([], r"way\.gpx: has 0 points"),
        ([(47.0, 8.0, 1.0)], r"way\.gpx: has 1 points"),
        (
            [(47.0, 8.0, 1.0), (48.0, 8.0, 1.0)],
            r"way\.gpx: point 2: is 111\.2 km from the point before: that is no road",
        ),
        ([(47.0, 8.0, 1.0), (97.0, 8.0, 1.0)], r"way\.gpx: point 2: latitude_deg: 97 deg is outside"),
        ([(47.0, 8.0, 1.0), ("x", 8.0, 1.0)], r"way\.gpx: point 2: lat: 'x' is not a number"),
        ([(47.0, 8.0, 1.0), (47.001, "nan", 1.0)], r"way\.gpx: point 2: lon: must be a finite number"),
        ([(47.0, 8.0, 1.0), (47.001, 8.0, 90000.0)], r"way\.gpx: point 2: altitude_m: 90000 m is outside"),
        ([(47.0, 8.0, 1.0), (47.001, 8.0, 900.0)], r"way\.gpx: point 1: altitude_m: a grade of 809 %"),
    ],
)
def test_gpx_refused(tmp_path, points, message):
    with pytest.raises(InputError, match=message):
        read_route(gpx(tmp_path, points))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nonsense", r"way\.gpx:1: not a GPX file: syntax error"),
        (HEAD + "<trk>", r"way\.gpx:3: not a GPX file"),
        ('<?xml version="1.0" encoding="GBK"?><gpx/>', r"way\.gpx: cannot be read: multi-byte .*; save it as UTF-8"),
        ('<?xml version="1.0" encoding="klingon"?><gpx/>', r"way\.gpx: cannot be read: .*klingon; save it as UTF-8"),
        ('<!DOCTYPE x [<!ENTITY a "aaaa">]>' + HEAD[22:] + "</gpx>", r"way\.gpx: has a document type"),
    ],
)
def test_what_is_no_gpx_is_refused(tmp_path, text, message):
    file = tmp_path / "way.gpx"
    file.write_text(text)
    with pytest.raises(InputError, match=message):
        read_route(file)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("distance_m,speed_limit_kmh\n0,50\n20,500\n", r":3: speed_limit_kmh: 500 km/h is outside"),
        ("distance_m,headwind_mps\n0,20\n20,293\n", r":3: headwind_mps: 293 m/s is outside"),
        ("distance_m,stop\n0,20\n20,293\n", r":1: unknown column 'stop' \(did you mean 'stop_s'\?\)"),
        ("distance_m\n" + "".join(f"{4000 * i}\n" for i in range(252)), r"is 1004 km long, must be at most 1000"),
        ("distance_m\n0\n20\n20.0001\n", r":4: distance_m: 20\.0001 m does not increase"),
        ("distance_m\n0\n5e-324\n", r":3: distance_m: 4.94066e-324 m does not increase"),
        ("distance_m\n0\n20000\n", r":3: is 20\.0 km from the point before"),
        (
            "distance_m\n" + "".join(f"{i}\n" for i in range(CONFIG.max_points + 1)),
            rf"has {CONFIG.max_points + 1} points, must",
        ),
    ],
)
def test_csv_refused(tmp_path, text, message):
    file = tmp_path / "way.route.csv"
    file.write_text(text)
    with pytest.raises(InputError, match=message):
        read_route(file)


def test_a_packed_file_that_unpacks_to_a_huge_one_is_refused_before_it_is_parsed(tmp_path, monkeypatch):
    file = tmp_path / "way.csv.gz"
    file.write_bytes(gzip.compress(b"distance_m\n" + b"\n" * MAX_BYTES, 1))
    monkeypatch.setattr(csv, "reader", None)
    with pytest.raises(InputError, match=r"way\.csv\.gz: has more than 50 MB, unpacked"):
        read_route(file)
