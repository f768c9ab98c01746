"""The backends of the SOC filter by name."""

from __future__ import annotations

from gz_onboard.estimator.ekf import FilterMaker, ScalarFilter


def filter_maker(name: str) -> FilterMaker:
    """The backend called `name`: ``scalar`` or ``filterpy``; the second imports numpy and scipy."""
    if name == "filterpy":
        from gz_onboard.estimator.ekf_filterpy import FilterpyFilter

        return FilterpyFilter
    return ScalarFilter
