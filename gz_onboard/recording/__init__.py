"""Recorded rides: readers of log formats, decoding by columns, export and replay."""
