"""A recorded ride through the real daemon: the page shows what the frames say, and nothing else."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cantools.database.namedsignalvalue import NamedSignalValue

from tests.browser.support import LONG, numbers, shows, texts, wait_for
from tests.support import ROOT, range_database

SAMPLES = 40


@contextmanager
def ride(log: Path) -> Iterator[str]:
    """The dashboard's address while the ride goes on."""
    command = [sys.executable, "-m", "tests.browser.ride", str(log)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT, env=environment) as process:
        try:
            assert process.stdout is not None
            told = next((found for line in process.stdout if (found := re.search(r"http://\S+", line))), None)
            assert told, "no address of a dashboard"
            yield told[0]
        finally:
            process.terminate()
            process.wait(LONG)


def sent(log: Path) -> dict[str, list[dict[str, Any]]]:
    """What the frames so far say, by message, as cantools reads them."""
    found: dict[str, list[dict[str, Any]]] = {}
    text = log.read_text()
    for line in text[: text.rfind("\n") + 1].splitlines():
        identifier, _, data = line.partition("#")
        message = range_database().get_message_by_frame_id(int(identifier, 16))
        values: Any = message.decode(bytes.fromhex(data))
        found.setdefault(message.name, []).append(values)
    return found


def near(shown: str, value: float) -> bool:
    """Whether `shown` is `value`, rounded to the digits that it has."""
    digits = len(shown.partition(".")[2])
    return bool(abs(float(shown) - value) <= 0.5 * 10**-digits + 1e-6)


def of_a_frame(shown: Sequence[str], frames: Sequence[Mapping[str, Any]], *signals: str) -> bool:
    """Whether one frame says all of `shown`."""
    rows = [[frame[signal] for signal in signals] for frame in frames]
    return any(all(map(near, shown, row)) for row in rows if not any(isinstance(v, NamedSignalValue) for v in row))


def test_the_page_shows_the_frames_of_a_ride(page, tmp_path):
    log = tmp_path / "range.log"
    with ride(log) as address:
        page.goto(address)
        wait_for(lambda: texts(page)["range-value"] != "–", "a range")
        seen: list[dict[str, str]] = []
        while len(seen) < SAMPLES:
            one = texts(page)
            if "–" not in (one["range-value"], one["soc-value"], one["energy"]):  # as when the machine is too busy
                seen.append(one)
            page.wait_for_timeout(200)
        frames = sent(log)
        for one in seen:
            found = [one["range-value"], *re.findall(r"[\d.]+", one["interval"])]
            told = [f"RANGE_Remaining{part}" for part in ("", "P10", "P90")]
            assert of_a_frame(found, frames["RANGE_Estimate"], *told), found
            found = [one["soc-value"], one["soc-sigma"].removeprefix("± ")]
            assert of_a_frame(found, frames["RANGE_Status"], "RANGE_StateOfCharge", "RANGE_StateOfChargeSigma"), found
            found = [one["energy"].removesuffix(" Wh left"), one["expected"]]
            assert of_a_frame(found, frames["RANGE_Energy"], "RANGE_EnergyLeft", "RANGE_ConsumptionExpected"), found
        assert len({one["energy"] for one in seen}) > 1  # it moves

        def newest() -> bool:
            energy: Any = sent(log)["RANGE_Energy"][-1]["RANGE_EnergyLeft"]
            shown = texts(page)["energy"].removesuffix(" Wh left")
            return shown != "–" and near(shown, energy)

        wait_for(newest, "the newest energy on the page")
    shows(page, range_value="–", alerts="Dashboard not responding. Trying again.")
    assert numbers(page) == []
