"""Recorded rides: readers of log formats, decoding by columns, and replay."""
