"""A scooter that is not the package's model: rides to be found out, drawn by seed, with their truth.

Its own equations, its own integrator, its own sensors; of the package it knows only `Recording`, the form of a ride.
"""

from tests.plant.cases import Case, Truth, commissioning, commissioning_many, draw, draw_many, healthy, trial

__all__ = ["Case", "Truth", "commissioning", "commissioning_many", "draw", "draw_many", "healthy", "trial"]
