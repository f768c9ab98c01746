from __future__ import annotations

import pytest

from gz_onboard.simulation.turning.machine import Machine
from gz_onboard.vehicle import read_vehicle


@pytest.fixture(scope="session")
def machine() -> Machine:
    return Machine.of(read_vehicle("reference").parameters)
