"""Where a ride begins and ends in a log of the daemon, and which rides of several logs are one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from gz_onboard.api import AddedRides, History, add_to_history, read_history
from gz_onboard.events import Activity, State
from gz_onboard.lab.history.log_rides import BREAK, CHARGED, About, moments_of, rides_of
from gz_onboard.lab.history.ride import KeptRide
from gz_onboard.lab.history.store import Store
from gz_onboard.log_rows import STATUS_TOPIC
from gz_onboard.recording.logs import read_samples
from tests.lab.history.logs import CURRENT, NOON, SPEED, STEP, VOLTAGE, Told, ride, stand, write_log
from tests.support import S

HOUR = 3600 * S
HOSTILE: tuple[object, ...] = (None, [], {}, True, "x", 2**70)
ABOUT = About("scooter", "", Path("a.mcap"), "", None, None, {})


def rides_in(file: Path) -> list[KeptRide]:
    return rides_of(*moments_of(read_samples(file)), ABOUT)


def add(folder: Path, *logs: Path, name: str = "") -> AddedRides:
    return add_to_history(logs, folder / "h.sqlite", name=name)


def history(folder: Path) -> History:
    return read_history(folder / "h.sqlite")


def rows(folder: Path) -> list[KeptRide]:
    """The rows of a history, as they are."""
    with Store(folder / "h.sqlite") as store:
        return [one for _, one in store.rides()]


@pytest.mark.parametrize("old", [False, True])
@pytest.mark.parametrize(
    ("told", "km"),
    [
        ([ride(600)], [6.0]),
        ([ride(300), stand(120), ride(300)], [6.0]),  # a short stop
        ([ride(600), stand(round(BREAK) + 2 * STEP), ride(200)], [6.0, 2.0]),
        ([ride(600), stand(round(CHARGED) + 2 * STEP, Activity.CHARGING), ride(200)], [6.0, 2.0]),
        ([stand(2000), ride(300), stand(2000, Activity.CHARGING)], [3.0]),
        ([ride(600), stand(900), stand(900, Activity.ASLEEP), ride(100)], [6.0, 1.0]),
        ([ride(600), stand(900), ride(5), stand(900), ride(100)], [6.0, 1.0]),  # pushed into the garage
        ([stand(2000)], []),
        ([stand(2000, Activity.CHARGING)], []),
        ([ride(5)], []),
    ],
)
def test_where_rides_end(tmp_path: Path, told: Sequence[Told], km: Sequence[float], old: bool):
    found = rides_in(write_log(tmp_path / "a.mcap", told, old=old))
    assert [one.distance_km for one in found] == pytest.approx(km, abs=0.051)
    for one in found:
        length = one.distance_km * 1000
        assert one.energy_wh == pytest.approx(VOLTAGE * CURRENT * length / SPEED / 3600, rel=0.06)
        assert one.start_ns >= NOON
        assert one.capacity == (None if old else 1.0)


def test_a_hole_in_a_log_ends_a_ride_if_it_is_long(tmp_path):
    samples = list(read_samples(write_log(tmp_path / "a.mcap", [ride(3000)])))
    for hole, count in (300, 1), (1000, 2):
        left = [x for i, x in enumerate(samples) if not 400 <= i < 400 + 2 * hole // STEP]
        found = rides_of(*moments_of(left), ABOUT)
        assert len(found) == count
        assert sum(one.distance_km for one in found) == pytest.approx(
            30.0 - (hole / 100 if count == 2 else 0), abs=0.11
        )


def test_what_a_hole_hides_before_a_stand_is_no_ride(tmp_path):
    samples = list(read_samples(write_log(tmp_path / "a.mcap", [ride(2000), stand(1000)])))
    (found,) = rides_of(*moments_of(samples[:200] + samples[-300:]), ABOUT)
    assert found.distance_km == pytest.approx(5.0, abs=0.051)
    assert found.duration_s == pytest.approx(500, abs=6)


@pytest.mark.parametrize(
    "status",
    [{"ride": 7, "learned": []}, {"ride": {"rider": "x"}}, {"learned": {"capacity": {"factor": "old"}}}, {"ride": {}}],
)
def test_a_status_of_somebody_else_is_passed_over(tmp_path, status):
    samples = read_samples(write_log(tmp_path / "a.mcap", [ride(100)]))
    others = [(topic, time, status if topic == STATUS_TOPIC else values) for topic, time, values in samples]
    (found,) = rides_of(*moments_of(others), ABOUT)
    assert found.distance_km == pytest.approx(1.0, abs=0.051)
    assert found.capacity is None


def test_values_that_are_none(tmp_path):
    """Of a log that somebody else wrote, or changed: what cannot be is not kept."""
    samples = list(read_samples(write_log(tmp_path / "a.mcap", [ride(400)])))
    with Store(tmp_path / "h.sqlite", begin=True) as store:
        for key in "state", "activity", "distrusted", "route_state", "faults", "kernel_lost", "learned":
            for value in HOSTILE:
                changed = [(topic, time, values | {key: value}) for topic, time, values in samples[60:]]
                (found,) = rides_of(*moments_of(samples[:60] + changed), ABOUT)
                store.add("", "", [found], replace=True)


def test_what_is_doubtful_is_told(tmp_path):
    told = [ride(100), ride(60, state=State.DEGRADED), ride(30, state=State.INVALID), ride(10, rider="B")]
    (found,) = rides_in(write_log(tmp_path / "a.mcap", told))
    assert (found.degraded_s, found.invalid_s, found.rider) == (60, 30, "B")
    assert found.range_end_km == pytest.approx(45 - 2.0, abs=0.051)


# --- clocks ---------------------------------------------------------------------------------------------------------


def test_a_clock_that_is_set_on_the_way(tmp_path):
    """From 1970 to the right time, and an hour on: the ride has the date of afterwards."""
    for before in 5 * S, NOON - HOUR:
        log = write_log(
            tmp_path / "a.mcap",
            [ride(600)],
            clock=lambda t, before=before: (NOON if t > 200 else before) + round(t * S),  # type: ignore[misc]
        )
        (found,) = rides_in(log)
        assert (found.start_ns, found.duration_s) == (NOON, 596)


def test_a_clock_that_was_never_set(tmp_path):
    """Two boots of a board without a clock are two rides, however their times overlap; each is there once."""
    one = write_log(tmp_path / "a.mcap", [ride(600)], 5 * S)
    other = write_log(tmp_path / "b.mcap", [ride(700)], 5 * S)
    copy = write_log(tmp_path / "c.mcap", [ride(600)], 6 * S)
    assert [len(add(tmp_path, log).rides) for log in (one, other, copy)] == [1, 1, 0]
    (vehicle,) = history(tmp_path).vehicles
    assert [(month.of, month.rides) for month in vehicle.months] == [("no date", 2)]
    assert read_history(tmp_path / "h.sqlite", since="2000").vehicles == []


@pytest.mark.parametrize(
    ("apart", "same"), [(2 * HOUR, True), (HOUR // 4, True), (HOUR + 60 * S, False), (24 * HOUR, False)]
)
def test_a_copy_in_another_zone_of_time(tmp_path, apart, same):
    add(tmp_path, write_log(tmp_path / "a.mcap", [ride(200)]))
    said = add(tmp_path, write_log(tmp_path / "b.mcap", [ride(200)], NOON + apart))
    assert len(said.rides) == (0 if same else 1)


def test_months_are_those_of_the_zone(tmp_path, monkeypatch):
    """22:30 UTC of the last of June is July in Rome."""
    import time

    add(tmp_path, write_log(tmp_path / "a.mcap", [ride(200)], 1_719_786_600 * S))
    for zone, month in ("UTC", "2024-06"), ("Europe/Rome", "2024-07"), ("America/Los_Angeles", "2024-06"):
        monkeypatch.setenv("TZ", zone)
        time.tzset()
        (vehicle,) = history(tmp_path).vehicles
        assert [one.of for one in vehicle.months] == [month]
        assert len(read_history(tmp_path / "h.sqlite", since=month, until=month).vehicles) == 1
    monkeypatch.undo()
    time.tzset()


# --- several logs ---------------------------------------------------------------------------------------------------


def test_a_ride_goes_on_in_the_next_log(tmp_path):
    """The daemon begins a new file on the way; a day later there is another ride."""
    whole = rides_in(write_log(tmp_path / "whole.mcap", [ride(1000)]))[0]
    first = write_log(tmp_path / "a.mcap", [ride(600)])
    rest = write_log(tmp_path / "b.mcap", [ride(400, capacity=0.9)], NOON + 600 * S, begin=(600, 6000))
    later = write_log(tmp_path / "c.mcap", [ride(100)], NOON + 24 * HOUR)
    add(tmp_path, rest, later)
    add(tmp_path, first)
    (vehicle,) = history(tmp_path).vehicles
    one, other = (one.ride for one in vehicle.rides)
    assert (one.start_ns, one.soc_end, one.range_end_km) == (whole.start_ns, whole.soc_end, whole.range_end_km)
    assert (one.soc_start, one.range_start_km) == (whole.soc_start, whole.range_start_km)
    for key in ("duration_s", "distance_km", "energy_wh", "consumption_wh_km"):
        assert getattr(one, key) == pytest.approx(getattr(whole, key), rel=0.02), key
    assert one.capacity == 0.9
    assert other.distance_km == pytest.approx(1.0, abs=0.051)
    assert vehicle.total.distance_km == pytest.approx(11.0, abs=0.16)


def test_a_log_that_was_cut_short_makes_place_for_the_whole(tmp_path):
    short = write_log(tmp_path / "short.mcap", [ride(300)])
    whole = write_log(tmp_path / "whole.mcap", [ride(900)])
    assert len(add(tmp_path, short).rides) == 1
    said = add(tmp_path, whole)
    assert (len(said.rides), said.replaced) == (1, 1)
    again = write_log(tmp_path / "again.mcap", [ride(400)])
    assert (add(tmp_path, again).known, [one.log for one in rows(tmp_path)]) == ([str(again)], ["whole.mcap"])


def test_rides_that_overlap_are_said(tmp_path):
    add(tmp_path, write_log(tmp_path / "a.mcap", [ride(600)]))
    other = write_log(tmp_path / "b.mcap", [ride(600)], NOON + 333 * S)
    for _ in range(2):  # as long as it is so
        said = add(tmp_path, other)
        assert said.rides == []
        assert "at the same time as a.mcap" in said.failed[0].error
    assert [one.log for one in rows(tmp_path)] == ["a.mcap"]
    assert len(add(tmp_path, other, name="another scooter").rides) == 1
    with Store(tmp_path / "h.sqlite") as store:
        store.remove([1])
    assert len(add(tmp_path, other).rides) == 1


def test_rides_of_a_board_that_begins_each_boot_at_the_same_date_are_all_kept(tmp_path):
    lengths = {"monday": (420, 0.9), "tuesday": (720, 0.8), "wednesday": (260, 0.6)}
    logs = [write_log(tmp_path / f"{day}.mcap", [ride(s)], soc=soc) for day, (s, soc) in lengths.items()]
    for order in (logs, logs[::-1]):
        for log in order:
            add(tmp_path, log)
    assert sorted(one.log for one in rows(tmp_path)) == ["monday.mcap", "tuesday.mcap", "wednesday.mcap"]


def test_two_scooters_of_one_file(tmp_path):
    log = write_log(tmp_path / "a.mcap", [ride(600)])
    other = write_log(tmp_path / "b.mcap", [ride(300)], vehicle="moped")
    for _ in range(2):
        add(tmp_path, log, other)
        add(tmp_path, log, name="red")
    assert [one.vehicle for one in rows(tmp_path)] == ["moped", "red", "scooter"]


def test_of_a_folder_the_estimates_stand_for_their_logs(tmp_path):
    (tmp_path / "logs").mkdir()
    write_log(tmp_path / "logs/a.b.estimate.mcap", [ride(600)])
    for name in "a.b.blf", "a.b.log.gz":
        (tmp_path / "logs" / name).write_bytes(b"not even a log")
    said = add(tmp_path, tmp_path / "logs")
    assert (len(said.rides), said.failed) == (1, [])
