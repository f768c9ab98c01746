"""Readers of log formats, one file each; `gz_onboard.bus.logs` chooses between them."""
