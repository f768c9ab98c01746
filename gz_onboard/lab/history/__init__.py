"""``gz-onboard history``: the rides of months in one SQLite file."""
