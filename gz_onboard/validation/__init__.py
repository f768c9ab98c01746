"""Validation: measured rides against their simulation, by the limits of the thesis (Lord 2016, ch. 3)."""
