"""Signals that are none: not available, beyond their physical range, no number."""

from __future__ import annotations

import pytest

from gz_onboard.can.codec import NOT_AVAILABLE
from tests.faults.support import BEGIN, END, absent, check_all, ride, spoilt
from tests.support import S, identifier, reference, ridden

MESSAGES = sorted({source.message for source in reference().mapping.sources})


@pytest.mark.parametrize("message", MESSAGES)
def test_not_available_is_never_a_number(message: str):
    """All the signals of a message that have a code for it, at once."""
    definition = reference().mapping.database.get_message_by_name(message)
    mapped = [s.signal for s in reference().mapping.sources if s.message == message]
    signals = [name for name in mapped if definition.get_signal_by_name(name).length >= 8]
    run = ridden(spoilt(absent(message, *signals)))
    check_all(run, soc=0.004, range_=0.04)
    sent = sum(f[1] == identifier(message) and BEGIN * S <= f[0] - ride()[0][0] < END * S for f in ride())
    assert all(run.faults.get((f"{message}.{signal}", NOT_AVAILABLE), 0) >= sent > 0 for signal in signals)
    assert run.pipeline.counts().dropped == 0  # the frames themselves are good
