"""Readers of log formats, one file each; `gz_onboard.recording.logs` chooses between them."""
