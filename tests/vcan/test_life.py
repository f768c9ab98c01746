"""Ordinary life with the daemon as a process on a vcan: standing, charging, restarts, joining a ride, wrong states.

The daemon goes by a clock that the test keeps (tests/vcan/paced.py): hours take seconds, however busy the machine is.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from gz_onboard.constants import WH
from gz_onboard.errors import BAD_INPUT, OK
from gz_onboard.events import Activity, State
from tests.estimator.life import Scooter, estimator, follow, knows
from tests.vcan.hours import LONG_ROUND, Hours, Told
from tests.vcan.support import Running

Begin = Callable[[Scooter], Hours]
CHARGER = 500.0  # W
OFTEN, SELDOM = 0.1, 0.5  # s: how often the messages come in a ride, and while it stands


@pytest.fixture
def begin(running: Running, tmp_path: Path) -> Iterator[Begin]:
    """Puts a scooter on vcan0."""
    begun: list[Hours] = []

    def beginning(scooter: Scooter) -> Hours:
        begun.append(Hours(running, tmp_path, scooter))
        return begun[-1]

    yield beginning
    running.kill()
    for hours in begun:
        hours.close()


def long_known(hours: Hours) -> dict[str, Any]:
    """What a daemon has saved that has known the scooter for long: its pack, its state of charge, a ride of it."""
    e, scooter = estimator(), hours.scooter
    for seconds, speed in ((20, 0.0), (540, 11.0), (60, 0.0)):
        follow(e, scooter.live(seconds, speed), scooter)
    knows(e, scooter)
    snapshot: dict[str, Any] = e.snapshot(hours.vehicle.key)
    return snapshot


def charge_known(rows: list[Told]) -> list[Told]:
    return [row for row in rows if row["RANGE_StateOfCharge"] is not None]


def worst(rows: list[Told]) -> float:
    """The largest error of the state of charge, in its own sigma."""
    return max(row.error for row in charge_known(rows))


def ranges(rows: list[Told]) -> list[float]:
    """Of those that tell one [km]."""
    return [row["RANGE_Remaining"] for row in rows if row["RANGE_Remaining"] is not None]


# --- standing and charging ------------------------------------------------------------------------------------------


def test_an_hour_of_standing_between_two_rides_costs_its_energy_and_no_more(begin: Begin):
    scooter = Scooter()
    hours = begin(scooter)
    hours.save(long_known(hours))
    daemon = hours.start()
    hours.live(scooter.live(10))
    hours.live(scooter.live(300, 11.0))
    before = hours.live(scooter.live(10))[-1]
    scooter.period = SELDOM
    stood = hours.live(scooter.live(3600), LONG_ROUND)
    after = stood[-1]
    scooter.period = OFTEN
    later = hours.live(scooter.live(300, 11.0))
    summary = hours.stop(daemon)

    assert {row["RANGE_Activity"] for row in stood} == {Activity.STANDING, Activity.PARKED}
    standing = (after.energy - before.energy) / WH / before["RANGE_ConsumptionExpected"]
    assert 1.5 < standing < 2.0  # km
    assert before["RANGE_Remaining"] - after["RANGE_Remaining"] == pytest.approx(standing, abs=1.0)
    assert after["RANGE_ConsumptionExpected"] < 1.03 * before["RANGE_ConsumptionExpected"]
    assert later[-1]["RANGE_ConsumptionExpected"] < 1.05 * before["RANGE_ConsumptionExpected"]
    assert worst(stood + later) < 3
    assert "dropped 0, lost 0" in summary


def test_charged_from_20_to_70_percent(begin: Begin):
    scooter = Scooter(soc=0.28)
    hours = begin(scooter)
    hours.save(long_known(hours))
    daemon = hours.start()
    ridden = hours.live(scooter.live(60, 10.0))[-1]
    hours.live(scooter.live(30))
    begun, soc = scooter.time, scooter.soc
    assert soc == pytest.approx(0.18, abs=0.02)
    amperes = CHARGER / 51.0  # net of what the scooter takes
    scooter.period = SELDOM
    rows = hours.live(scooter.live(0.5 * scooter.capacity / amperes * 3600, charge=amperes + 0.9), LONG_ROUND)
    charged = rows[-1]
    scooter.period = OFTEN
    pace = (scooter.time - begun) / (scooter.soc - soc)  # s for all of the charge, at this current
    after = hours.live(scooter.live(60, 10.0))
    hours.stop(daemon)

    charging = rows[10:]
    assert {row["RANGE_Activity"] for row in charging} == {Activity.CHARGING}
    assert {row["RANGE_StatusState"] for row in charging} == {State.VALID}
    assert worst(rows + after) < 3
    for row in charging[::50]:
        assert row["RANGE_ChargePower"] == pytest.approx(CHARGER, rel=0.1)
        # The current of now until it is full, and somewhat longer where a full cell's voltage takes less.
        assert 60 * row["RANGE_TimeToFull"] == pytest.approx(1.05 * pace * (1 - row.soc), rel=0.1)
        assert row["RANGE_RemainingFull"] == pytest.approx(charged["RANGE_RemainingFull"], rel=0.03)
    told = ranges(charging)
    assert all(b > a - 0.2 for a, b in pairwise(told))
    assert charged["RANGE_Remaining"] > 4 * ridden["RANGE_Remaining"]
    # Nothing was learned of the consumption, and the range is that of what is in the pack.
    assert charged["RANGE_ConsumptionExpected"] == pytest.approx(ridden["RANGE_ConsumptionExpected"], rel=0.04)
    reach = charged["RANGE_EnergyLeft"] / charged["RANGE_ConsumptionExpected"]
    assert charged["RANGE_Remaining"] == pytest.approx(reach, rel=0.08)
    share = charged["RANGE_Remaining"] / charged["RANGE_RemainingFull"]
    assert share == pytest.approx(charged["RANGE_StateOfCharge"] / 100, abs=0.07)
    assert after[-1]["RANGE_Activity"] == Activity.RIDING
    assert after[-1]["RANGE_TimeToFull"] is None
    assert after[-1]["RANGE_Remaining"] == pytest.approx(charged["RANGE_Remaining"], abs=1.0)


# --- restarts and joining -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["stopped", "killed"])
def test_a_restart_mid_ride_goes_on_where_it_was(begin: Begin, how: str):
    scooter = Scooter()
    hours = begin(scooter)
    hours.save(long_known(hours))
    daemon = hours.start()
    before = hours.live(scooter.live(200, 11.0))[-1]
    if how == "killed":
        hours.kill(daemon)
    else:
        hours.stop(daemon)
    scooter.away(8, 11.0)
    daemon = hours.start()
    assert "continuing from the state saved" in daemon.journal.splitlines()[-2]
    rows = hours.live(scooter.live(100, 11.0))
    hours.stop(daemon)

    told = ranges(rows)
    assert len(told) > 95
    assert all(abs(b - a) < 1.0 for a, b in pairwise([before["RANGE_Remaining"], *told]))
    assert worst(rows) < 1
    first = charge_known(rows)[0]
    drawn = 100 * (before.soc - first.soc)
    soc = before["RANGE_StateOfCharge"] - drawn
    assert first["RANGE_StateOfCharge"] == pytest.approx(soc, abs=first["RANGE_StateOfChargeSigma"])
    assert all(row["RANGE_Activity"] == Activity.RIDING for row in rows)


@pytest.mark.parametrize("soc", [0.85, 0.45])
def test_joined_mid_ride_it_knows_what_it_does_not_know(begin: Begin, soc: float):
    scooter = Scooter(soc=soc)
    scooter.away(20)
    scooter.away(700, 11.0)
    hours = begin(scooter)
    daemon = hours.start()
    joined = hours.live(scooter.live(200, 11.0))
    rested = hours.live(scooter.live(400))
    hours.stop(daemon)

    assert {row["RANGE_Activity"] for row in charge_known(joined)} == {Activity.JOINED}
    assert worst(joined + rested) < 3
    sigmas = [row["RANGE_StateOfChargeSigma"] for row in charge_known(joined)]
    assert min(sigmas) > 1.5  # what the cells' voltage lacks under a load is not known before a rest
    assert rested[-1]["RANGE_StateOfChargeSigma"] < 2.5
    assert rested[-1]["RANGE_Activity"] == Activity.PARKED
    assert rested[-1].error < 1.5


# --- states that are wrong ------------------------------------------------------------------------------------------


def another_pack(state: dict[str, Any]) -> None:
    state |= {"soc": 0.35, "soc_variance": 0.005**2}


def another_day(state: dict[str, Any]) -> None:
    state |= {"odometer": state["odometer"] - 40e3, "own_soc": None, "soc_variance": 0.005**2}


@pytest.mark.parametrize("wrong", [another_pack, another_day])
def test_a_state_that_is_wrong_makes_it_unsure_and_not_wrong(begin: Begin, wrong: Callable[[dict[str, Any]], None]):
    scooter = Scooter(soc=0.75)
    hours = begin(scooter)
    saved = long_known(hours)
    wrong(saved)
    scooter.away(20, 11.0)
    hours.save(saved, age=600.0)
    daemon = hours.start()
    rows = hours.live(scooter.live(150, 11.0))
    hours.stop(daemon)

    assert "continuing from the state saved 600 s ago" in daemon.journal
    first = charge_known(rows)[0]
    assert first["RANGE_SocUncertain"] == 1
    assert first["RANGE_StatusState"] == State.DEGRADED
    assert worst(rows) < 3
    assert abs(rows[-1]["RANGE_StateOfCharge"] / 100 - rows[-1].soc) < 0.02
    assert rows[-1]["RANGE_StatusState"] == State.VALID


def test_a_damaged_state_is_set_aside(begin: Begin):
    scooter = Scooter(soc=0.75)
    hours = begin(scooter)
    saved = long_known(hours)
    scooter.away(20, 11.0)
    file = hours.save(saved, age=600.0)
    text = bytearray(file.read_bytes())
    text[400] ^= 1
    file.write_bytes(text)
    daemon = hours.start()
    rows = hours.live(scooter.live(100, 11.0))
    hours.stop(daemon)

    assert "saved state not used, kept as" in daemon.journal
    assert "is damaged: its checksum is wrong" in daemon.journal
    assert file.with_name(f"{file.name}.refused").read_bytes() == text
    first = charge_known(rows)[0]
    assert first["RANGE_PriorRiding"] == 1
    assert {row["RANGE_Activity"] for row in charge_known(rows)} == {
        Activity.JOINED
    }  # it knows no more than one that is new
    assert worst(rows) < 3
    assert json.loads(file.read_text())["estimator"]["soc"] == pytest.approx(scooter.soc, abs=0.1)


# --- what was learned -----------------------------------------------------------------------------------------------


def learned(hours: Hours, file: Path, *options: str) -> tuple[int, dict[str, Any], str]:
    """(exit status, what it shows, what it complains of) of the command."""
    vehicle = "--vehicle", str(hours.file)
    command = [sys.executable, "-m", "gz_onboard", "learned", *vehicle, "--state", str(file), "--json", *options]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=120)
    return done.returncode, json.loads(done.stdout)["learned"] if done.stdout else {}, done.stderr


def test_what_a_daemon_has_learned_is_shown_and_forgotten(begin: Begin):
    scooter = Scooter(soc=0.75, capacity=26.0)  # an aged pack
    hours = begin(scooter)
    saved = long_known(hours)
    saved["learned"] |= {"inverse_capacity": 1.25, "capacity_variance": 0.01**2, "capacity_with_soc": 0.0}
    file = hours.save(saved)
    daemon = hours.start()
    hours.live(scooter.live(30))
    status, shown, _ = learned(hours, file)
    assert status == OK
    assert shown["capacity"]["factor"] == pytest.approx(0.8, abs=0.02)
    status, _, said = learned(hours, file, "--reset", "battery")
    assert status == BAD_INPUT
    assert "stop it first" in said
    before = hours.live(scooter.live(10))[-1]
    hours.stop(daemon)

    status, shown, _ = learned(hours, file, "--reset", "battery")
    assert status == OK
    assert shown["capacity"]["percent_learned"] == 0
    daemon = hours.start()
    rows = hours.live(scooter.live(30))
    hours.stop(daemon)
    status, shown, _ = learned(hours, file)
    assert shown["capacity"]["factor"] == pytest.approx(1.0, abs=0.02)
    assert rows[-1]["RANGE_Remaining"] > 1.15 * before["RANGE_Remaining"]  # as of a new pack
    assert abs(rows[-1]["RANGE_StateOfCharge"] - before["RANGE_StateOfCharge"]) < 2.0
    assert worst(rows) < 3
