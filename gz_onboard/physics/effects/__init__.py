"""One file for each physical effect; see `gz_onboard.physics.effect` for what such a file holds."""
