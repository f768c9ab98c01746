"""The scooter, and its model before any ride."""

from __future__ import annotations

import pytest

from gz_onboard.discovery.mixed_model import MixedModel, initial
from gz_onboard.vehicle import Vehicle, read_vehicle


@pytest.fixture(scope="session")
def scooter() -> Vehicle:
    return read_vehicle("reference")


@pytest.fixture(scope="session")
def mixed(scooter: Vehicle) -> MixedModel:
    return initial(scooter)
