"""The range for the rider: in a terminal and on a web page."""

LATE_PERIODS = 3  # of a message, after which its numbers are shown in grey; after STALE_PERIODS not at all
