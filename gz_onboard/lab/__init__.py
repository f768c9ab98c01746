"""Offline work on recorded rides; never imported on board."""
