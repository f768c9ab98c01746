"""The thesis scooter, forward-looking, with its drive cycles, routes and turning models. Offline only."""
