"""Some cases of every kind; ``make hardening`` runs many more."""

import pytest

from tests.hardening.kinds import kinds


@pytest.mark.parametrize("name", sorted(kinds()))
def test_keeps_its_promises(name):
    kind = kinds()[name]
    report = kind.run(kind.COUNT, seed=1)
    assert report.rows
    assert not report.failures, "\n".join(report.failures)
