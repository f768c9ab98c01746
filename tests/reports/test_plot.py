from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gz_onboard import cli
from gz_onboard.can.logfile import LogFile
from gz_onboard.errors import InputError
from gz_onboard.events import Cause, Explanation, words
from gz_onboard.lab import logged, plot
from gz_onboard.lab.why import draw_why
from gz_onboard.recording.readers.contents import LogDamage

LOGS = Path(__file__).resolve().parents[2] / "replay_logs"


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plot")
    assert cli.main(["estimate", str(LOGS / "coastdown.blf"), "--output", str(folder), "--no-plot"]) == 0
    return folder / "coastdown.estimate.mcap"


def pixels(file):
    from matplotlib.image import imread

    return imread(file)


@pytest.mark.parametrize("over", ["time", "distance"])
def test_the_overview(log, tmp_path, over):
    picture = tmp_path / "x.png"
    assert cli.main(["plot", str(log), str(picture), "--over", over]) == 0
    image = pixels(picture)
    assert image.shape[0] > 900
    assert image.shape[1] > 1000
    assert 0.02 < (image[..., :3].min(axis=2) < 0.9).mean() < 0.6  # neither empty nor black


def test_why_the_range_is_what_it_is(log, tmp_path, capsys):
    assert cli.main(["plot", str(log), "--why"]) == 0
    file = log.with_suffix(".why.png")
    assert capsys.readouterr().out == f"{file}\n"
    assert 0.02 < (pixels(file)[..., :3].min(axis=2) < 0.9).mean() < 0.6
    causes = {Cause.CHARGE: -20e3, Cause.SPEED: 1200.0, Cause.TEMPERATURE: -3000.0, Cause.WIND: 0.0}
    axis = draw_why(Explanation(60.0, 50e3, 28.2e3, causes), "ride").axes[0]
    assert [t.get_text() for t in axis.get_yticklabels()] == ["rated range", "charge", "temperature", "speed", "range"]
    bars: list[Any] = list(axis.patches)
    ends = [(bar.get_x(), bar.get_x() + bar.get_width()) for bar in bars]
    assert ends == [pytest.approx(pair) for pair in ((0, 50), (50, 30), (30, 27), (27, 28.2), (0, 28.2))]
    with (tmp_path / "empty.mcap").open("wb") as stream:
        LogFile(stream, 0).close()
    assert cli.main(["plot", str(tmp_path / "empty.mcap"), "--why"]) == 2
    assert "does not say why" in capsys.readouterr().err


def test_the_panels_show_what_the_log_says(log):
    rows, times, status = logged.read_ride(log)
    figure = plot.draw(rows, times, status, ("title", "subtitle"))
    lines = {line.get_label(): line for axis in figure.axes for line in axis.get_lines()}
    for label, name, factor in (
        ("range", "range", 1e-3),
        ("state of charge", "soc", 100),
        ("pack current", "pack_current", 1),
        ("expected", "consumption_expected", 1 / 3.6),
    ):
        expected = [float("nan") if row[name] is None else row[name] * factor for row in rows]
        assert np.asarray(lines[label].get_ydata()) == pytest.approx(expected, nan_ok=True)
    assert np.max(lines["speed"].get_ydata()) == pytest.approx(max(row["speed"] for row in rows) * 3.6)
    strip = figure.axes[6]
    shown = [label.get_text() for label in strip.get_yticklabels()]
    assert shown[0] == "state"
    assert set(shown[1:]) == {words(name) for row in rows for name in row["reasons"].split()}
    figure.savefig(io.BytesIO(), format="png", dpi=30)


def test_the_picture_counts_what_the_summary_counts(tmp_path, capsys):
    assert cli.main(["estimate", str(LOGS / "city_34C.blf"), "--output", str(tmp_path), "--no-plot", "--json"]) == 0
    (ride,) = json.loads(capsys.readouterr().out)["rides"]
    rows, times, status = logged.read_ride(tmp_path / "city_34C.estimate.mcap")
    figure = plot.draw(rows, times, status, ("", ""))
    (told,) = (t.get_text() for axis in figure.axes for t in axis.texts if "frames received" in t.get_text())
    withheld = sum(sum(places.values()) for places in ride["faults"].values()) - ride["dropped"]
    assert told == (
        f"{ride['frames']} frames received, {ride['lost']} lost, {ride['dropped']} dropped, "
        f"{ride['unknown']} unknown identifiers; {withheld} signals not available or implausible"
    )


def test_by_default_the_picture_is_beside_the_log(log, capsys):
    assert cli.main(["plot", str(log)]) == 0
    assert capsys.readouterr().out.strip() == str(log.with_suffix(".png"))
    assert log.with_suffix(".png").exists()


def test_for_a_paper_it_is_of_another_format(log, capsys):
    assert cli.main(["plot", str(log), "--why", "--format", "pdf"]) == 0
    assert capsys.readouterr().out.strip() == str(log.with_suffix(".why.pdf"))
    assert log.with_suffix(".why.pdf").read_bytes().startswith(b"%PDF")


def test_a_cut_log_is_drawn_as_far_as_it_goes(tmp_path, log):
    long = LOGS / "city_34C.blf"
    assert cli.main(["estimate", str(long), "--output", str(tmp_path), "--no-plot", "--frames"]) == 0
    whole = tmp_path / "city_34C.estimate.mcap"
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    rows, _, _ = logged.read_ride(cut)
    everything, _, _ = logged.read_ride(whole)
    assert 100 < len(rows) < len(everything)
    assert rows == everything[: len(rows)]
    assert cli.main(["plot", str(cut), str(tmp_path / "cut.png")]) == 0


@pytest.fixture
def holed(tmp_path):
    """A log of 30 s whose second chunk of three, 10 s, is broken."""
    path = tmp_path / "holed.mcap"
    ranges = {"range": 5.0, "range_p10": 4.0, "range_p90": 6.0, "speed": 10.0}
    file = LogFile(path.open("wb"), 0)
    file.channel("/estimate", {})
    for t in range(30):
        row = {"time": float(t), "distance": 10.0 * t, "soc": 0.5, "soc_sd": 0.1, "state": "VALID", "reasons": ""}
        file.sample("/estimate", t * 10**9, row | ranges)
        if t % 10 == 9:
            file.flush()
    file.close()
    data = bytearray(path.read_bytes())
    places = [at for at in range(len(data)) if data.startswith(b"\4\0\0\0zstd", at)]
    data[places[1] + 20] ^= 0xFF
    path.write_bytes(data)
    return path


def test_nothing_is_drawn_through_a_hole_in_the_log(holed):
    damages: list[LogDamage] = []
    rows, times, status = logged.read_ride(holed, damages.append)
    assert [row["time"] for row in rows] == [*range(10), *range(20, 30)]
    assert "a chunk is broken" in damages[0].reason
    figure = plot.draw(rows, times, status, ("", ""))
    (speed,) = (line for axis in figure.axes for line in axis.get_lines() if line.get_label() == "speed")
    x, y = np.asarray(speed.get_xdata()), np.asarray(speed.get_ydata())
    assert np.isnan(y[(x[:-1] < 15).sum() - 1])  # the last point before the hole
    assert np.isfinite(y).sum() == len(rows)
    state: Any = figure.axes[6].collections[1].get_paths()  # one bar before the hole, one after
    assert [(path.vertices[:, 0].min(), path.vertices[:, 0].max()) for path in state] == [(0, 9), (20, 29)]


def test_what_is_missing_of_a_log_is_told(holed, tmp_path, capsys, monkeypatch):
    titles: list[str] = []
    real = plot.draw

    def noted(*given: Any) -> Any:
        titles.append(given[3][1])
        return real(*given)

    monkeypatch.setattr(plot, "draw", noted)
    picture = tmp_path / "x.png"
    assert cli.main(["plot", str(holed), str(picture)]) == 0
    told = capsys.readouterr()
    assert "holed.mcap: byte" in told.err and "a chunk is broken" in told.err
    assert told.out.strip() == str(picture)
    assert "damaged log" in titles[0]


def test_what_cannot_be_drawn_is_told(tmp_path, log, capsys):
    (tmp_path / "text.mcap").write_text("no")
    for arguments, told in [
        (["none.mcap"], "none.mcap"),
        ([str(tmp_path / "text.mcap")], "not an MCAP file"),
        ([str(LOGS / "coastdown.blf")], "holds no estimates"),
        ([str(log), str(tmp_path / "x.jpg")], "has to end in one of .png, .svg, .pdf"),
        ([str(log), str(tmp_path / "x.svg"), "--format", "pdf"], "does not end in .pdf, as --format says"),
        ([str(log), "/dev/null/x.png"], "cannot be written"),
    ]:
        assert cli.main(["plot", *arguments]) == 2
        assert told in capsys.readouterr().err


def test_nothing_known_can_be_drawn_too():
    names = ("soc", "soc_sd", "range", "range_p10", "range_p90", "energy_left", "pack_voltage", "pack_current", "speed")
    row = {**dict.fromkeys(names), "time": 0.1, "distance": 0.0, "state": "STARTING", "reasons": "NO_IMU NO_GPS"}
    figure = plot.draw([row], [0], {}, ("", ""))
    figure.savefig(io.BytesIO(), format="png", dpi=30)


def test_rows_that_are_none_of_ours_are_passed_over(tmp_path):
    path = tmp_path / "e.mcap"
    ranges = {"range": 5.0, "range_p10": 4.0, "range_p90": 6.0}
    good: dict[str, Any] = {"time": 0.1, "distance": 0.0, "soc": None, "soc_sd": None, **ranges}
    good |= {"state": "VALID", "reasons": "NO_IMU"}
    wrong: list[dict[str, Any]] = [
        {},
        {**good, "time": None},
        {**good, "time": "late"},
        {**good, "distance": [1]},
        {**good, "speed": 1e300},
        {**good, "state": "GOOD"},
        {**good, "reasons": 7},
        {**good, "range_p90": None},
        {name: value for name, value in good.items() if name != "range"},
    ]
    file = LogFile(path.open("wb"), 0)
    file.channel("/estimate", {})
    file.channel("/status", {})
    for number, row in enumerate([*wrong, good, *wrong]):
        file.sample("/estimate", number * 10**9, row)
    statuses: list[dict[str, Any]] = [{"faults": 3}, {"lost": {"a": "b"}}, {"faults": {"crc": 3}}, {"unknown": None}]
    for status in statuses:
        file.sample("/status", 0, status)
    file.close()
    rows, times, last = logged.read_ride(path)
    assert (rows, times, last) == ([good], [len(wrong) * 10**9], {})
    plot.plot_log(path, tmp_path / "e.png")


def test_an_empty_log_is_told(tmp_path):
    with pytest.raises(InputError, match="holds no estimates"):
        LogFile((tmp_path / "e.mcap").open("wb"), 0).close()
        plot.plot_log(tmp_path / "e.mcap", tmp_path / "e.png")


@given(st.floats(5, 30), st.floats(20, 200), st.floats(1e5, 1e7), st.integers(2, 400))
def test_the_naive_range_of_steady_riding_is_energy_over_consumption(speed, consumption, left, seconds):
    power = speed * consumption
    rows = [
        {
            "time": float(t),
            "distance": t * speed,
            "pack_voltage": 50.0,
            "pack_current": power / 50.0,
            "energy_left": left,
        }
        for t in range(seconds)
    ]
    for row, naive in zip(rows, plot.naive_range(rows), strict=True):
        if row["distance"] < plot.NAIVE_FROM:
            assert naive is None
        else:
            assert naive == pytest.approx(left / consumption)


def test_the_naive_range_begins_anew_after_a_hole():
    steady = {"pack_voltage": 50.0, "pack_current": 16.0, "energy_left": 8e6}
    rows: list[logged.Logged] = [{"time": t, "distance": 10.0 * t, **steady} for t in range(900) if not 300 < t < 600]
    naive = plot.naive_range(rows)
    assert naive[301] is None
    assert naive[-1] == pytest.approx(100_000)


def test_the_naive_range_does_not_take_a_charge_for_recovered():
    riding = {"pack_voltage": 50.0, "pack_current": 16.0, "energy_left": 8e6, "activity": "RIDING"}
    charging = riding | {"pack_current": -10.0, "activity": "CHARGING"}
    rows: list[logged.Logged] = [{"time": t, "distance": 10.0 * t, **riding} for t in range(900)]
    rows += [{"time": t, "distance": 8990.0, **charging} for t in range(900, 4500)]
    rows += [{"time": t, "distance": 8990.0 + 10.0 * (t - 4499), **riding} for t in range(4500, 4700)]
    naive = plot.naive_range(rows)
    assert naive[899] == pytest.approx(naive[4499]) == pytest.approx(naive[-1]) == pytest.approx(100_000)


def test_the_naive_range_forgets_what_is_more_than_25_km_ago():
    rows: list[logged.Logged] = []
    distance = 0.0
    for t in range(12_000):  # 20 km at 160 J/m, then 100 km at 80 J/m
        rows.append(
            {
                "time": float(t),
                "distance": distance,
                "pack_voltage": 50.0,
                "pack_current": 10 * (160 if distance <= 20_000 else 80) / 50,
                "energy_left": 8e6,
            }
        )
        distance += 10
    naive = plot.naive_range(rows)
    assert naive[1900] == pytest.approx(50_000, rel=0.01)
    assert naive[3000] is not None
    assert 50_000 < naive[3000] < 100_000
    assert naive[5000] == naive[-1] == pytest.approx(100_000, rel=0.001)


@given(st.lists(st.booleans(), min_size=1, max_size=60))
def test_spans_cover_what_is_true(true):
    x = [float(i) for i in range(len(true))]
    spans = plot.spans(x, true)
    inside = [any(begin <= place < begin + length for begin, length in spans) for place in x[:-1]]
    assert inside == true[:-1]


def test_each_log_of_a_folder(log, tmp_path, capsys):
    for name in "a.mcap", "b.estimate.mcap":
        (tmp_path / name).write_bytes(log.read_bytes())
    (tmp_path / "b.blf").write_bytes(b"of which b.estimate.mcap is")
    assert cli.main(["plot", str(tmp_path), "--over", "distance"]) == 0
    assert capsys.readouterr().out.split() == [str(tmp_path / name) for name in ("a.png", "b.estimate.png")]
    (tmp_path / "a.mcap").write_bytes(log.read_bytes()[:9])
    assert cli.main(["plot", str(tmp_path), "--why"]) == 2
    assert (tmp_path / "b.estimate.why.png").exists()
    assert cli.main(["plot", str(tmp_path), "all.png"]) == 2
